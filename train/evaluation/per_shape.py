"""One split scored with one number of views and one seed: a value per shape for every figure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from diffpoint import chamfer_distance, consistency_loss
from models import Predictor
from train.config import InferenceConfig
from train.data.batches import Batch, LoadedSplit
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors, thin_out, transport_error

FIGURES = (
    "gt_to_pred",
    "pred_to_gt",
    "cd",
    "fps_cd",
    "consistency",
    "fps_gt_to_pred",
    "fps_pred_to_gt",
    "fscore_01",
    "emd",
)
"""What is known of a reconstruction beside the truth. Distances x100, un-squared; fscore_01 in [0, 1]."""

SHAPES_AT_ONCE = 16

Scores = dict[str, Tensor]
"""Figure -> one value per shape (M,), or per seed and shape (S, M). A figure that does not apply is absent."""


def score(
    model: Predictor,
    test: LoadedSplit,
    settings: InferenceConfig,
    *,
    views: int,
    seed: int,
    code_seed: int | None = None,
    done: Callable[[int], object] = lambda count: None,
) -> Scores:
    """Reconstructs every shape of a split from `views` of its views and compares it with the truth.

    Args:
        model: a generator, or another method's network.
        test: the split.
        settings: search and descent; one group and no steps are random codes. With `scored="each"` the figures are
            means over the views' predictions, and "best_cd" is the best one's chamfer distance.
        views: how many views each shape shows; which ones, the seed decides, and fewer are the first of more.
        seed: draws views and codes.
        code_seed: draws the codes in place of `seed`.
        done: told how many shapes have just been scored.

    Returns:
        The figures of `FIGURES`; "code_norm", the mean length of the codes; and where codes were sought "searched",
        the consistency loss x100 before the descent.
    """
    parts: list[Scores] = []
    order = view_order(test, seed)
    draw = seed if code_seed is None else code_seed
    for start in range(0, len(test), SHAPES_AT_ONCE):
        shapes = torch.arange(start, min(start + SHAPES_AT_ONCE, len(test)))
        images, truth = test.float_images(shapes, order[shapes, :views]), test.points[shapes]
        found = reconstruct(model, images, seed=draw * 10_000 + start, settings=settings)
        each = _predictions(model, found.points, views)
        if settings.scored == "each" and each is not None:
            by_view = compare(each, truth[:, None].expand(-1, views, -1, -1), points=model.points)
            scores = {name: values.mean(1) for name, values in by_view.items()}
            scores["best_cd"] = by_view["cd"].amin(1)
        else:
            scores = compare(found.points, truth, points=model.points)
        scores["code_norm"] = found.codes.norm(dim=-1).mean(1)
        if len(found.history):
            scores["searched"] = found.history[0]
            scores["consistency"] = found.history.gather(0, found.kept[None])[0]
        elif views > 1 and each is not None:
            scores["consistency"] = 100 * consistency_loss(each, reduction="none")
        parts.append(scores)
        done(len(shapes))
    return joined(parts)


def _predictions(model: Predictor, points: Tensor, views: int) -> Tensor | None:
    """Every view's own cloud in a reconstruction (B, V*N, 3): (B, V, N, 3); None where views are read together."""
    if model.reads_views_together:
        return None
    return points.unflatten(1, (views, -1))


def compare(predicted: Tensor, truth: Tensor, *, points: int) -> Scores:
    """Clouds (*B, N, 3) beside clouds (*B, M, 3).

    Args:
        predicted: the joined predictions.
        truth: what they should be.
        points: size of one prediction, to which the joined ones are thinned for the fps_ figures; for the earth
            mover's distance both clouds are.
    """
    errors, thinned = cloud_errors(predicted, truth), cloud_errors(thin_out(predicted, points), truth)
    return {
        "gt_to_pred": errors.gt_to_pred,
        "pred_to_gt": errors.pred_to_gt,
        "cd": errors.cd,
        "fps_cd": thinned.cd,
        "fps_gt_to_pred": thinned.gt_to_pred,
        "fps_pred_to_gt": thinned.pred_to_gt,
        "fscore_01": errors.fscore,
        "emd": transport_error(predicted, truth, points=points),
    }


@torch.no_grad()
def answers(
    model: Predictor, test: LoadedSplit, *, codes: int, seed: int
) -> Iterator[tuple[Tensor, Batch, Tensor]]:
    """What a network makes of one image of each shape with several random codes, some shapes at a time.

    Args:
        model: the network; the R predictions are equal if it takes no codes.
        test: the split whose images are shown.
        codes: how many, R.
        seed: draws views and codes.

    Yields:
        (B,) numbers of shapes, their batch with the one view that is shown, and (R, B, N, 3) predictions in the world
        frame.
    """
    generator = torch.Generator().manual_seed(seed)
    for shapes, shown in one_view_each(test, seed):
        drawn = torch.randn(codes, len(shapes), model.code_dim, generator=generator)
        yield shapes, shown, model(shown.images[:, 0], drawn).contiguous()


def one_view_each(test: LoadedSplit, seed: int) -> Iterator[tuple[Tensor, Batch]]:
    """Every shape with the first view of a seed's order, some at a time: (B,) shape numbers, and their batch."""
    first = view_order(test, seed)[:, :1]
    for shapes in torch.arange(len(test)).split(SHAPES_AT_ONCE):
        yield shapes, test.batch(shapes, first[shapes])


def distance_between(answers: Tensor) -> Tensor:
    """(R, B, N, 3) several predictions of each image -> (B,) mean chamfer distance x100 between any two of them."""
    return 100 * consistency_loss(answers.transpose(0, 1), reduction="none")


def diversity(model: Predictor, test: LoadedSplit, *, codes: int, seed: int) -> Tensor:
    """(M,) `distance_between` the predictions of one image with `codes` random codes."""
    found = answers(model, test, codes=codes, seed=seed)
    return torch.cat([distance_between(clouds) for _, _, clouds in found])


def distance_to_nearest(clouds: Tensor, among: Tensor) -> Tensor:
    """(M, N, 3) clouds, (K, P, 3) others -> (M,) chamfer distance x100 from each cloud to the nearest of the others."""
    among = among.contiguous()
    found = []
    for cloud in clouds:
        distance = chamfer_distance(cloud.expand(len(among), -1, -1).contiguous(), among, squared=False)
        found.append(100 * (distance.a_to_b + distance.b_to_a).amin())
    return torch.stack(found)


def view_order(test: LoadedSplit, seed: int) -> Tensor:
    """(M, V): for each shape its views in this seed's order."""
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(test.views, generator=generator) for _ in range(len(test))])


def joined(parts: Sequence[Scores]) -> Scores:
    """The scores of some shapes after those of others, (M,); or of some seeds, (S, M)."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def stacked(by_seed: Sequence[Scores]) -> Scores:
    """The scores of several seeds as one, (S, M)."""
    return {name: torch.stack([scores[name] for scores in by_seed]) for name in by_seed[0]}


def means(scores: Scores, shapes: Tensor | slice = slice(None)) -> dict[str, float | None]:
    """Every figure's mean over seeds and some shapes; None for one that does not apply."""
    return {
        name: scores[name][:, shapes].double().mean().item() if name in scores else None for name in FIGURES
    }


def spreads(scores: Scores) -> dict[str, float | None]:
    """Every figure's standard deviation over seeds of the mean over shapes; None for a single seed."""
    return {
        name: scores[name].double().mean(1).std().item() if name in scores and len(scores[name]) > 1 else None
        for name in FIGURES
    }


def average(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """The mean of several rows of figures, each counting once."""

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    return {name: mean([row[name] for row in rows]) for name in rows[0]}
