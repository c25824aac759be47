"""Terms of training losses that several methods or stages share, in the paper's units."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from diffpoint import (
    PinholeCamera,
    chamfer_distance,
    diversity_loss,
    earth_mover_distance,
    farthest_point_sample,
    front_terms,
    projection_loss,
    soft_projection_loss,
)
from models import Predictor
from train.config import StageConfig, Visibility
from train.data.batches import Batch, Targets
from train.device import moved
from train.methods.base import Noise

# The stage-1 distance is a sum over the matched points, whose number grows with the map's area; the paper's
# weights of the other terms belong to maps of 56 x 56.
_PAPER_MAP_SIZE = 56

# Relative tolerance of a transport that a network is trained on.
TRANSPORT_TOLERANCE = 0.02

# Relative tolerance of a transport that only selects which of several clouds is nearest. It is 2 % above the optimum in
# the mean, where the clouds of five codes differ by 30 %, and takes half the time.
_SELECTION_TOLERANCE = 0.2

# Relative tolerance of the diversity loss's transports, where they have to be computed at all. They are 2 % above the
# optimum in the mean then, a third faster than at 0.05; the approximation of the paper's own code is 30 % above.
_DIVERSITY_TOLERANCE = 0.2

# Points of the transports between predictions and whole shapes; more cost time in proportion to their square. To find
# the nearest of several predictions fewer are enough.
_TRANSPORT_POINTS, _SELECTION_POINTS = 512, 256

# A transport between the joined clouds of many views would take most of a step.
_JOINED_POINTS = 512

# Footprints of the soft projection loss: from a ninth of the map, so that points far from the silhouette reach it, to
# three quarters of a pixel at half of the stage: the radii of the study on free clouds.
_SOFT_START_SHARE, _SOFT_END_PIXELS = 1 / 9, 0.75

_LIN_UPSAMPLE = 2


class ViewLoss(NamedTuple):
    """A loss between clouds and the depth maps of their views.

    Attributes:
        loss: scalar, the mean of `each`.
        each: (clouds, V), of every cloud and view.
        statistics: for the log; of the front constraint "matched_share", the mean share of observed points that have a
            visible predicted point to match (at most 1), and "fallback_share", the share of views in which no
            predicted point is visible and the whole cloud is compared instead.
    """

    loss: Tensor
    each: Tensor
    statistics: dict[str, Tensor]


def view_loss(
    clouds: Tensor, batch: Batch, stage: StageConfig, *, step: int, logits: Tensor | None = None
) -> ViewLoss:
    """Compares predictions with the depth maps of their images, as `StageConfig.supervision` says.

    The losses that replace the front constraint have its unit: where it is a sum over matched points, their mean over
    pixels is multiplied by the number of observed pixels, and where it is a mean, by 100.

    Args:
        clouds: (R, B*V, N, 3), one cloud for each code and image, world frame.
        batch: the images' depth maps and cameras.
        stage: which loss; with `joined_views` the clouds of a shape's V views are concatenated for each code, and the
            whole is compared with the depth map of each view.
        step: number of the step within the stage, for the schedule of the soft footprints.
        logits: (R, B*V, N) occupancy logits of the points, if the network gives them.
    """
    points, camera, depth = pair_with_views(clouds, batch, joined_views=stage.joined_views)
    if stage.supervision == "front":
        return front_loss(points, camera, depth, stage.front, visibility=stage.visibility)
    observed = depth.isfinite().sum((-2, -1))
    if stage.supervision == "soft":
        radius = _soft_radius(stage, depth.shape[-1], step)
        each = soft_projection_loss(points, camera, depth, radius=radius, reduction="none")
    elif stage.supervision == "projection":
        each = projection_loss(points, camera, depth, reduction="none")
    else:
        # In sums over pixels both terms weigh the same; see `projection_loss`.
        pixels = depth.shape[-2] * depth.shape[-1]
        each = projection_loss(
            points, camera, depth,
            logits=None if logits is None else logits.reshape(points.shape[:2]),
            mask_weight=pixels / max(1.0, observed.float().mean().item()), upsample=_LIN_UPSAMPLE, reduction="none",
        )  # fmt: skip
    each = each * (100 if stage.front == "chamfer" else _area_factor(depth) * observed)
    return ViewLoss(each.mean(), each, {})


def pair_with_views(
    clouds: Tensor, batch: Batch, *, joined_views: bool
) -> tuple[Tensor, PinholeCamera, Tensor]:
    """Arranges clouds, cameras and depth maps so that each cloud lies beside the views that judge it.

    Args:
        clouds: (R, B*V, N, 3).
        batch: cameras (B, V) and depth maps (B, V, S, S).
        joined_views: False: R*B*V clouds, each with the one view of its image. True: R*B clouds, the V clouds of a
            shape concatenated, each with the shape's V views.

    Returns:
        Points (M, N', 3), cameras (M, V') and depth maps (M, V', S, S).
    """
    codes, points = clouds.shape[0], clouds.shape[2]
    shapes, views = batch.depth.shape[:2]
    together = views if joined_views else 1
    count = codes * shapes * views // together

    def for_each_code(value: Tensor) -> Tensor:
        return value.expand(codes, *value.shape).reshape(count, together, *value.shape[2:])

    camera = batch.camera
    K, cam_from_world = for_each_code(camera.K), for_each_code(camera.cam_from_world)
    return (
        clouds.reshape(count, together * points, 3),
        PinholeCamera(K, cam_from_world, camera.height, camera.width),
        for_each_code(batch.depth),
    )


def front_loss(
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    distance: Literal["emd", "chamfer"],
    *,
    visibility: Visibility = "zbuffer",
    tolerance: float = TRANSPORT_TOLERANCE,
) -> ViewLoss:
    """`diffpoint.front_terms` in the paper's units.

    "emd": earth mover's distance as a SUM over matched points, scaled as if on a 56 x 56 map. "chamfer": both
    directions, x100. A view whose depth map is empty constrains nothing and counts 0.
    """
    terms = front_terms(points, camera, depth, distance=distance, visibility=visibility, tolerance=tolerance)
    each = 100 * terms.loss if distance == "chamfer" else _area_factor(depth) * terms.loss * terms.matched
    statistics = {
        "matched_share": (terms.matched / terms.observed.clamp(min=1)).mean(),
        "fallback_share": terms.fallback.float().mean(),
    }
    return ViewLoss(each.mean(), each, statistics)


def diversity_term(codes: Tensor, clouds: Tensor, stage: StageConfig, *, views: int, step: int) -> Tensor:
    """The diversity loss on a part of the batch and of the points, as the stage says.

    Single-view clouds of one image must differ as much as their codes do; with `stage.joined_diversity`, the joined
    clouds of a shape as much as the codes of its views do on average (root mean square).

    Args:
        codes: (R, B*V, code_dim).
        clouds: (R, B*V, N, 3).
        stage: its alpha, and how much takes part.
        views: V.
        step: which of the strided points take part changes with every step.
    """
    if stage.joined_diversity:
        codes = codes.unflatten(1, (-1, views)).flatten(2) / views**0.5
        clouds = clouds.unflatten(1, (-1, views)).flatten(2, 3)
        stride = max(1, clouds.shape[2] // _JOINED_POINTS)
        every = 1
    else:
        stride = stage.diversity_stride
        # Spread over the batch, so that several processes with a part each take the images that one would take.
        every = max(1, stage.shapes * stage.views // stage.diversity_images)
    thin = slice(step % stride, None, stride)
    return diversity_loss(
        codes[:, ::every], clouds[:, ::every, thin], alpha=stage.exact_alpha, tolerance=_DIVERSITY_TOLERANCE
    )


def cloud_distances(
    clouds: Tensor,
    targets: Tensor,
    distance: Literal["emd", "chamfer"],
    *,
    step: int,
    tolerance: float = TRANSPORT_TOLERANCE,
) -> Tensor:
    """Distances x100 between predictions and whole target clouds.

    Args:
        clouds: (R, B, N, 3).
        targets: (B, P, 3) with P >= N; the earth mover's distance takes N of them, which ones changes with the step.
        distance: "chamfer" (both directions) or "emd".
        step: number of the step within the stage.
        tolerance: relative tolerance of the transports.

    Returns:
        (R, B).
    """
    if distance == "chamfer":
        both = chamfer_distance(clouds, targets.expand(len(clouds), *targets.shape), squared=False)
        return 100 * both.total
    every = max(1, targets.shape[1] // clouds.shape[2])
    thin = targets[:, step % every :: every][:, : clouds.shape[2]]
    thin = thin.expand(len(clouds), *thin.shape).contiguous()
    return 100 * earth_mover_distance(clouds, thin, tolerance=tolerance).cost


def nearest_prediction_loss(
    clouds: Tensor, targets: Tensor, stage: StageConfig, *, step: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """Conditional IMLE: of R predictions of an image, the distance (x100) of the nearest one to its whole shape.

    The predictions that are not the nearest are left free, so that other codes can predict other shapes, or nearly so
    with `shape_relaxation`, which gives a share of the loss to all of them.

    Args:
        clouds: (R, B, N, 3) predictions.
        targets: (B, P, 3) the images' shapes, points on the whole surface.
        stage: `shape_distance` and `shape_relaxation`. The earth mover's distance, by which the nearest is found in any
            case, is of a random part of the prediction and of points spread evenly over the target. Unlike chamfer it
            counts points: a prediction that puts a few of its points on each of several possible backs is far from all
            of them.
        step: draws the points that take part.

    Returns:
        The mean over the images, and statistics for the log: the mean over all predictions of the distance by which the
        nearest was found, and over the nearest alone.

    Sources: Li et al., "Multimodal image synthesis with conditional implicit maximum likelihood estimation" (IJCV
    2020); Rupprecht et al., "Learning in an uncertain world" (ICCV 2017) for the relaxation.
    """
    count = min(_TRANSPORT_POINTS, clouds.shape[2], targets.shape[1])
    random = torch.Generator().manual_seed(step)
    some = moved(torch.randperm(clouds.shape[2], generator=random)[:count], clouds.device)
    start = int(torch.randint(targets.shape[1], (), generator=random))
    evenly = farthest_point_sample(targets, count, start=start)  # its first points are spread evenly, too
    spread = torch.take_along_dim(targets, evenly[..., None], 1)

    few = min(_SELECTION_POINTS, count)
    coarse = spread[:, :few].expand(len(clouds), -1, few, 3).contiguous()
    distances = earth_mover_distance(
        clouds[:, :, some[:few]].contiguous(), coarse, tolerance=_SELECTION_TOLERANCE
    ).cost
    best = distances.detach().argmin(0)
    nearest = clouds[best, torch.arange(len(best), device=best.device)]

    loss = torch.zeros((), device=clouds.device)
    if stage.shape_distance in ("emd", "both"):
        transport = earth_mover_distance(nearest[:, some].contiguous(), spread, tolerance=TRANSPORT_TOLERANCE)
        loss = loss + 100 * transport.cost.mean()
    if stage.shape_distance in ("chamfer", "both"):
        loss = loss + cloud_distances(nearest[None], targets, "chamfer", step=step).mean()
    if stage.shape_relaxation:
        loss = torch.lerp(loss, 100 * distances.mean(), stage.shape_relaxation)
    return loss, {
        "shape": loss.detach(),
        "nearest_emd": 100 * distances.detach().amin(0).mean(),
        "mean_emd": 100 * distances.detach().mean(),
    }


def best_of_n(
    network: Predictor, batch: Batch, noise: Noise, distances: Callable[[Tensor, float], Tensor]
) -> dict[str, Tensor]:
    """Minimum over n: of the predictions from R codes, each image's nearest one is trained.

    All R clouds are compared without a graph; then the best one of each image is predicted again, with one.

    Args:
        network: takes codes.
        batch: B shapes with V images each.
        noise: R codes for each image.
        distances: (R, B*V, N, 3) clouds and a relative tolerance of transports -> (R, B*V).
    """
    images = batch.images.flatten(0, 1)
    with torch.no_grad():
        all_distances = distances(network(images, noise.codes), _SELECTION_TOLERANCE)
    best = all_distances.argmin(0)
    codes = noise.codes[best, torch.arange(len(best), device=best.device)][None]
    loss = distances(network(images, codes), TRANSPORT_TOLERANCE).mean()
    return {"loss": loss, "mean_of_all": all_distances.mean()}


def targets_of(batch: Batch) -> Targets:
    """The targets of a batch that was drawn with them."""
    assert batch.targets is not None
    return batch.targets


def for_each_image(values: Tensor, batch: Batch) -> Tensor:
    """(B, ...) of shapes -> (B*V, ...), once for each of their images."""
    return values.repeat_interleave(batch.images.shape[1], dim=0)


def target_cameras(batch: Batch, views: Tensor) -> PinholeCamera:
    """(B*V, K): K of the target cameras of each shape, for each of its images' predictions."""
    camera = targets_of(batch).camera
    K, pose = (for_each_image(matrix[:, views], batch) for matrix in (camera.K, camera.cam_from_world))
    return PinholeCamera(K, pose, camera.height, camera.width)


def _soft_radius(stage: StageConfig, map_size: int, step: int) -> float:
    """Radius of soft footprints in pixels: shrinks geometrically until half of the stage."""
    start = max(_SOFT_END_PIXELS, _SOFT_START_SHARE * map_size)
    return start * (_SOFT_END_PIXELS / start) ** min(1.0, 2 * step / max(1, stage.steps))


def _area_factor(depth: Tensor) -> float:
    """Area of a pixel of these maps in pixels of the paper's maps."""
    return (_PAPER_MAP_SIZE / depth.shape[-1]) ** 2
