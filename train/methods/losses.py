"""The terms of the training loss, in the paper's units."""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor

from diffpoint import (
    PinholeCamera,
    chamfer_distance,
    diversity_loss,
    earth_mover_distance,
    projection_loss,
    soft_projection_loss,
)
from diffpoint.losses import FrontSets, front_sets
from diffpoint.visibility import Method as Visibility
from train.config import StageConfig

# The stage-1 distance is a sum over the matched points, whose number grows with the map's area; the paper's
# weights of the other terms belong to maps of 56 x 56.
_PAPER_MAP_SIZE = 56

# How far above the least a transport may be of which a network learns.
TRANSPORT_TOLERANCE = 0.02

# How far above the least the diversity loss may take a transport, where it has to know it at all. It is 2 % above in
# the mean then, a third faster than at 0.05, and the approximation of the paper's own code is 30 % above.
_SPREAD_TOLERANCE = 0.2

# A transport between the joined clouds of many views would take most of a step.
_JOINED_POINTS = 512


# Footprints of the soft projection loss: from a ninth of the map, so that points far from the silhouette reach it, to
# three quarters of a pixel at half of the stage: the radii of the study on free clouds.
_SOFT_START_SHARE, _SOFT_END_PIXELS = 1 / 9, 0.75

_LIN_UPSAMPLE = 2


class Scene(NamedTuple):
    """Clouds beside what is known of them.

    Attributes:
        points: (B, M, 3).
        camera: (B, V).
        depth: (B, V, S, S).
        logits: (B, M) of the points' existence, or None.
    """

    points: Tensor
    camera: PinholeCamera
    depth: Tensor
    logits: Tensor | None = None


class Front(NamedTuple):
    """The front constraint or what stands in its place, and how much it had to hold on to.

    Attributes:
        loss: scalar, the mean of `each`.
        each: (scenes, V), every view's own.
        shares: for the log; of the front constraint "matched_share", the mean share of observed points that have a
            visible predicted point to match (at most 1), and "fallback_share", the share of views in which no
            predicted point was visible and the whole cloud stood in.
    """

    loss: Tensor
    each: Tensor
    shares: dict[str, Tensor]


def arrange_scenes(
    clouds: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    *,
    joined_views: bool,
    logits: Tensor | None = None,
) -> Scene:
    """Puts predictions before the cameras that judge them.

    Args:
        clouds: (R, B*V, N, 3), one cloud for each code and image.
        camera: (B, V).
        depth: (B, V, S, S).
        joined_views: False: R*B*V scenes, each cloud before the one camera of its image. True: R*B scenes, the V
            clouds of one shape and code slot concatenated before the V cameras.
        logits: (R, B*V, N) of the points' existence, if it is known.
    """
    codes, points = clouds.shape[0], clouds.shape[2]
    shapes, views = depth.shape[:2]
    together = views if joined_views else 1
    scenes = codes * shapes * views // together

    def before_scenes(value: Tensor) -> Tensor:
        return value.expand(codes, *value.shape).reshape(scenes, together, *value.shape[2:])

    K, cam_from_world = before_scenes(camera.K), before_scenes(camera.cam_from_world)
    return Scene(
        clouds.reshape(scenes, together * points, 3),
        PinholeCamera(K, cam_from_world, camera.height, camera.width),
        before_scenes(depth),
        None if logits is None else logits.reshape(scenes, together * points),
    )


def supervise(scene: Scene, stage: StageConfig, *, step: int) -> Front:
    """Compares clouds with the depth maps of their views, as the stage says (`StageConfig.supervision`).

    The losses that stand in the place of the front constraint take its unit: where it is a sum over matched points,
    their mean over pixels counts once for every observed pixel, and where it is a mean, x100.
    """
    if stage.supervision == "front":
        return front_loss(scene, stage.front, visibility=stage.visibility)
    points, camera, depth = scene.points, scene.camera, scene.depth
    observed = depth.isfinite().sum((-2, -1))
    if stage.supervision == "soft":
        each = soft_projection_loss(
            points, camera, depth, radius=_soft_radius(stage, depth.shape[-1], step), reduction="none"
        )
    elif stage.supervision == "projection":
        each = projection_loss(points, camera, depth, reduction="none")
    else:
        # In sums over pixels both terms weigh the same; see `projection_loss`.
        pixels = depth.shape[-2] * depth.shape[-1]
        mask_weight = pixels / max(1.0, observed.float().mean().item())
        each = projection_loss(
            points, camera, depth,
            logits=scene.logits, mask_weight=mask_weight, upsample=_LIN_UPSAMPLE, reduction="none",
        )  # fmt: skip
    each = each * (100 if stage.front == "chamfer" else _same_area(depth) * observed)
    return Front(each.mean(), each, {})


def _soft_radius(stage: StageConfig, map_size: int, step: int) -> float:
    """Of soft footprints in pixels, on a geometric way to its end at half of the stage."""
    start = max(_SOFT_END_PIXELS, _SOFT_START_SHARE * map_size)
    return start * (_SOFT_END_PIXELS / start) ** min(1.0, 2 * step / max(1, stage.steps))


def _same_area(depth: Tensor) -> float:
    """What a pixel of the paper's maps would be in pixels of these."""
    return (_PAPER_MAP_SIZE / depth.shape[-1]) ** 2


def front_loss(
    scene: Scene,
    distance: Literal["emd", "chamfer"],
    *,
    visibility: Visibility = "zbuffer",
    tolerance: float = TRANSPORT_TOLERANCE,
) -> Front:
    """Compares the visible predicted points with the observed points of each view, in the paper's units.

    "emd": earth mover's distance as a SUM over matched points, scaled as if on a 56 x 56 map, with transports within
    `tolerance`. "chamfer": both directions, x100.
    """
    sets = front_sets(scene.points, scene.camera, scene.depth, visibility=visibility)
    if distance == "chamfer":
        terms = chamfer_distance(
            sets.predicted,
            sets.observed,
            squared=False,
            a_lengths=sets.predicted_lengths,
            b_lengths=sets.observed_lengths,
        )
        each = 100 * (terms.a_to_b + terms.b_to_a)
    else:
        transport = earth_mover_distance(
            sets.predicted,
            sets.observed,
            tolerance=tolerance,
            a_lengths=sets.predicted_lengths,
            b_lengths=sets.observed_lengths,
        )
        each = _same_area(scene.depth) * transport.cost * _matched(sets)
    shares = {
        "matched_share": (_matched(sets) / sets.observed_lengths.clamp(min=1)).mean(),
        "fallback_share": sets.fallback.float().mean(),
    }
    return Front(each.mean(), each, shares)


def _matched(sets: FrontSets) -> Tensor:
    """Pairs that an assignment makes: as many as the smaller set has points."""
    return sets.predicted_lengths.minimum(sets.observed_lengths)


def spread_loss(codes: Tensor, clouds: Tensor, stage: StageConfig, *, views: int, step: int) -> Tensor:
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
        codes[:, ::every],
        clouds[:, ::every, thin],
        alpha=stage.exact_alpha,
        tolerance=_SPREAD_TOLERANCE,
    )
