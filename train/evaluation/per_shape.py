"""Per-shape metrics: one split evaluated with one number of views and one seed, a value per shape for every metric."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from diffpoint import chamfer_distance, consistency_loss
from models import Predictor
from train.config import InferenceConfig
from train.data.batches import Batch, LoadedSplit
from train.evaluation.inference import predict_images, reconstruct
from train.evaluation.metrics import cloud_errors, thin_out, transport_error

METRICS = (
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
"""Metrics of a reconstruction. Un-squared distances x100; fscore_01 in [0, 1]. "fps_": after predictions are thinned to
the size of one by farthest point sampling. "consistency": between the views' predictions, see `reconstruct`."""

SHAPES_AT_ONCE = 16

ShapeMetrics = dict[str, Tensor]
"""Metric -> one value per shape (M,), or per seed and shape (S, M). A metric that is not defined is absent."""


def evaluate_split(
    model: Predictor,
    test: LoadedSplit,
    settings: InferenceConfig,
    *,
    views: int,
    seed: int,
    code_seed: int | None = None,
    done: Callable[[int], object] = lambda count: None,
) -> ShapeMetrics:
    """Reconstructs every shape of a split from `views` of its views and compares it with the ground truth.

    Args:
        model: the network.
        test: the split.
        settings: search and descent on the codes; one group and no steps are random codes. With `scored="each"` the
            metrics are means over the views' own predictions, and "best_cd" is the smallest of their chamfer distances.
        views: number of input views; the seed determines which, and fewer are the first of more.
        seed: of the choice of views and of the codes.
        code_seed: of the codes, in place of `seed`.
        done: called with the number of shapes that have just been evaluated.

    Returns:
        On the CPU: the metrics of `METRICS`; "code_norm", the mean norm of the codes; after a search "searched", the
        consistency loss x100 before the descent.
    """
    parts: list[ShapeMetrics] = []
    test = test.to(model.device)
    order = view_order(test, seed)
    draw = seed if code_seed is None else code_seed
    for start in range(0, len(test), SHAPES_AT_ONCE):
        shapes = torch.arange(start, min(start + SHAPES_AT_ONCE, len(test)))
        images, target = test.float_images(shapes, order[shapes, :views]), test.points[shapes]
        found = reconstruct(model, images, seed=draw * 10_000 + start, settings=settings)
        by_view = None if model.reads_views_together else found.points.unflatten(1, (views, -1))
        if settings.scored == "each" and by_view is not None:
            each = compare_clouds(by_view, target[:, None].expand(-1, views, -1, -1), points=model.points)
            metrics = {name: values.mean(1) for name, values in each.items()}
            metrics["best_cd"] = each["cd"].amin(1)
        else:
            metrics = compare_clouds(found.points, target, points=model.points)
        metrics["code_norm"] = found.codes.norm(dim=-1).mean(1)
        if len(found.history):
            metrics["searched"] = found.history[0]
            metrics["consistency"] = found.history.gather(0, found.kept[None])[0]
        elif views > 1 and by_view is not None:
            metrics["consistency"] = 100 * consistency_loss(by_view, reduction="none")
        parts.append(metrics)
        done(len(shapes))
    return on_cpu(concatenate(parts))


def compare_clouds(predicted: Tensor, target: Tensor, *, points: int) -> ShapeMetrics:
    """Metrics of clouds (*B, N, 3) against ground truth (*B, M, 3), each (*B).

    Args:
        predicted: the predictions, concatenated over views.
        target: the ground truth.
        points: size of one prediction, to which predictions are thinned for the fps_ metrics, and both clouds for the
            earth mover's distance.
    """
    errors, thinned = cloud_errors(predicted, target), cloud_errors(thin_out(predicted, points), target)
    return {
        "gt_to_pred": errors.gt_to_pred,
        "pred_to_gt": errors.pred_to_gt,
        "cd": errors.cd,
        "fps_cd": thinned.cd,
        "fps_gt_to_pred": thinned.gt_to_pred,
        "fps_pred_to_gt": thinned.pred_to_gt,
        "fscore_01": errors.fscore,
        "emd": transport_error(predicted, target, points=points),
    }


@torch.no_grad()
def sample_predictions(
    model: Predictor, test: LoadedSplit, *, codes: int, seed: int
) -> Iterator[tuple[Tensor, Batch, Tensor]]:
    """Predictions from one image of each shape with several random codes, for some shapes at a time.

    Args:
        model: the network; the R predictions are equal if it takes no codes.
        test: the split with the images.
        codes: number R of codes per image.
        seed: of the choice of views and of the codes.

    Yields:
        (B,) indices of shapes on the CPU; and on the network's device their batch with the one input view, and
        (R, B, N, 3) predictions in the world frame.
    """
    generator = torch.Generator().manual_seed(seed)
    for shapes, shown in one_view_each(test.to(model.device), seed):
        drawn = torch.randn(codes, len(shapes), model.code_dim, generator=generator)
        yield shapes, shown, predict_images(model, shown.images[:, 0], drawn).contiguous()


def one_view_each(test: LoadedSplit, seed: int) -> Iterator[tuple[Tensor, Batch]]:
    """Every shape with the first view of a seed's order, some at a time: (B,) shape indices, and their batch."""
    first = view_order(test, seed)[:, :1]
    for shapes in torch.arange(len(test)).split(SHAPES_AT_ONCE):
        yield shapes, test.batch(shapes, first[shapes])


def pairwise_distance(clouds: Tensor) -> Tensor:
    """(R, B, N, 3) several predictions from each image -> (B,) mean chamfer distance x100 over all pairs of them."""
    return 100 * consistency_loss(clouds.transpose(0, 1), reduction="none")


def diversity(model: Predictor, test: LoadedSplit, *, codes: int, seed: int) -> Tensor:
    """(M,) on the CPU: `pairwise_distance` of the predictions from one image of each shape with random codes."""
    sampled = sample_predictions(model, test, codes=codes, seed=seed)
    return torch.cat([pairwise_distance(clouds) for _, _, clouds in sampled]).cpu()


def distance_to_nearest(clouds: Tensor, among: Tensor) -> Tensor:
    """(M, N, 3) clouds, (K, P, 3) others -> (M,) chamfer distance x100 from each cloud to the nearest of the others."""
    among = among.contiguous()
    found = []
    for cloud in clouds:
        distance = chamfer_distance(cloud.expand(len(among), -1, -1).contiguous(), among, squared=False)
        found.append(100 * distance.total.amin())
    return torch.stack(found)


def view_order(test: LoadedSplit, seed: int) -> Tensor:
    """(M, V): for each shape a random permutation of its views."""
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(test.views, generator=generator) for _ in range(len(test))])


def concatenate(parts: Sequence[ShapeMetrics]) -> ShapeMetrics:
    """Joins the metrics of several groups of shapes, (M,), or of seeds, (S, M), along the first axis."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def on_cpu(metrics: ShapeMetrics) -> ShapeMetrics:
    """The same metrics on the CPU."""
    return {name: values.cpu() for name, values in metrics.items()}


def stack_seeds(by_seed: Sequence[ShapeMetrics]) -> ShapeMetrics:
    """The metrics (M,) of several seeds as one, (S, M)."""
    return {name: torch.stack([metrics[name] for metrics in by_seed]) for name in by_seed[0]}


def mean_metrics(metrics: ShapeMetrics, shapes: Tensor | slice = slice(None)) -> dict[str, float | None]:
    """Every metric's mean over seeds and the given shapes, of metrics (S, M); None for one that is not defined."""
    return {
        name: metrics[name][:, shapes].double().mean().item() if name in metrics else None for name in METRICS
    }


def std_over_seeds(metrics: ShapeMetrics) -> dict[str, float | None]:
    """Standard deviation over seeds of every metric's mean over shapes, of metrics (S, M); None for a single seed."""
    return {
        name: metrics[name].double().mean(1).std().item()
        if name in metrics and len(metrics[name]) > 1
        else None
        for name in METRICS
    }


def average_rows(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """The unweighted mean of several rows of metrics; None values are left out."""

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    return {name: mean([row[name] for row in rows]) for name in rows[0]}
