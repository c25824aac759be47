"""One split scored with one number of views and one seed: a value per shape for every figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from diffpoint import chamfer_distance, consistency_loss
from models import Generator, Predictor
from train.batches import LoadedSplit
from train.config import InferenceConfig
from train.inference import reconstruct
from train.metrics import cloud_errors, thin_out, transport_error

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
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _predictions(model: Predictor, points: Tensor, views: int) -> Tensor | None:
    """Every view's own cloud in a reconstruction (B, V*N, 3): (B, V, N, 3); None where views are read together."""
    if not isinstance(model, Generator) and model.reads_views_together:
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
def diversity(model: Generator, test: LoadedSplit, *, codes: int, seed: int) -> Tensor:
    """(M,) mean chamfer distance x100 between the predictions of one image with `codes` random codes."""
    first = view_order(test, seed)[:, :1]
    generator = torch.Generator().manual_seed(seed)
    found = []
    for shapes in torch.arange(len(test)).split(SHAPES_AT_ONCE):
        drawn = torch.randn(codes, len(shapes), model.code_dim, generator=generator)
        clouds = model(test.float_images(shapes, first[shapes])[:, 0], drawn)
        found.append(100 * consistency_loss(clouds.transpose(0, 1), reduction="none"))
    return torch.cat(found)


@torch.no_grad()
def novelty(model: Generator, test: LoadedSplit, shapes: Tensor, *, seed: int) -> Tensor:
    """(M,) chamfer distance x100 from the prediction of one image, with a random code, to the nearest of some shapes.

    Args:
        model: takes codes.
        test: the split whose images are shown.
        shapes: (K, P, 3) true surfaces; as many points of each as the model predicts are used.
        seed: draws views and codes.
    """
    first = view_order(test, seed)[:, :1]
    generator = torch.Generator().manual_seed(seed)
    clouds = []
    for numbers in torch.arange(len(test)).split(SHAPES_AT_ONCE):
        codes = torch.randn(1, len(numbers), model.code_dim, generator=generator)
        clouds.append(model(test.float_images(numbers, first[numbers])[:, 0], codes)[0])
    return distance_to_nearest(torch.cat(clouds), shapes[:, : model.points])


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
