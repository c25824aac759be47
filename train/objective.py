"""The terms of the training loss, in the paper's units."""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor

from diffpoint import PinholeCamera, chamfer_distance, diversity_loss, earth_mover_distance
from diffpoint.losses import FrontSets, front_sets
from train.config import StageConfig

# The stage-1 distance is a sum over the matched points, whose number grows with the map's area; the paper's
# weights of the other terms belong to maps of 56 x 56.
_PAPER_MAP_SIZE = 56

# How far above the least the diversity loss may take a transport, where it has to know it at all. It is 2 % above in
# the mean then, a third faster than at 0.05, and the approximation of the paper's own code is 30 % above.
_SPREAD_TOLERANCE = 0.2

# A transport between the joined clouds of many views would take most of a step.
_JOINED_POINTS = 512


class Scene(NamedTuple):
    """Clouds beside what is known of them: points (B, M, 3), camera (B, V), depth (B, V, S, S)."""

    points: Tensor
    camera: PinholeCamera
    depth: Tensor


class Front(NamedTuple):
    """The front constraint, and how much it had to hold on to.

    Attributes:
        loss: scalar, the mean of `each`.
        each: (scenes, V), every view's own.
        matched_share: mean share of observed points that have a visible predicted point to match (at most 1).
        fallback_share: share of views in which no predicted point was visible and the whole cloud stood in.
    """

    loss: Tensor
    each: Tensor
    matched_share: Tensor
    fallback_share: Tensor


def arrange_scenes(clouds: Tensor, camera: PinholeCamera, depth: Tensor, *, joined_views: bool) -> Scene:
    """Puts predictions before the cameras that judge them.

    Args:
        clouds: (R, B*V, N, 3), one cloud for each code and image.
        camera: (B, V).
        depth: (B, V, S, S).
        joined_views: False: R*B*V scenes, each cloud before the one camera of its image. True: R*B scenes, the V
            clouds of one shape and code slot concatenated before the V cameras.
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
    )


def front_loss(scene: Scene, distance: Literal["emd", "chamfer"]) -> Front:
    """Compares the visible predicted points with the observed points of each view, in the paper's units.

    "emd": earth mover's distance as a SUM over matched points, scaled as if on a 56 x 56 map. "chamfer": both
    directions, x100.
    """
    sets = front_sets(scene.points, scene.camera, scene.depth)
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
            sets.predicted, sets.observed, a_lengths=sets.predicted_lengths, b_lengths=sets.observed_lengths
        )
        same_area = (_PAPER_MAP_SIZE / scene.depth.shape[-1]) ** 2
        each = same_area * transport.cost * _matched(sets)
    matched_share = (_matched(sets) / sets.observed_lengths.clamp(min=1)).mean()
    return Front(each.mean(), each, matched_share, sets.fallback.float().mean())


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
