"""The paper's losses on point clouds. The projection losses that it compares with are in `projection.py`.

All return a tensor: with reduction="mean" a scalar, with "none" one value per item. Distances are un-squared means in
the unit of the clouds; the paper's sums and factors of 100 are not applied here.
"""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from diffpoint import _checks
from diffpoint.camera import PinholeCamera, check_camera, check_views
from diffpoint.distances import chamfer_distance
from diffpoint.reproject import unproject
from diffpoint.transport import earth_mover_distance
from diffpoint.views import sample_view
from diffpoint.visibility import METHODS, Method, visible_points

Reduction = Literal["mean", "none"]
Distance = Literal["chamfer", "emd"]


class FrontSets(NamedTuple):
    """The visible points of the predicted cloud and the points of the true depth map, for each view."""

    predicted: Tensor
    """(B, V, M, 3) world frame: the predicted points that the view sees, then padding."""
    predicted_lengths: Tensor
    """(B, V) int64."""
    observed: Tensor
    """(B, V, P, 3) world frame: the points of the true depth map, then padding."""
    observed_lengths: Tensor
    """(B, V) int64; 0 for an empty depth map."""
    fallback: Tensor
    """(B, V) bool: no predicted point was visible, so `predicted` is the whole cloud."""


def front_sets(
    points: Tensor, camera: PinholeCamera, depth: Tensor, *, visibility: Method = "zbuffer"
) -> FrontSets:
    """The two point sets that the front constraint compares, for every view.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        visibility: how the predicted points that a view sees are found; a method of `visible_points`.

    Gradients: of `predicted` to x, y and z of the visible points; of `observed` to `depth` and the camera.

    Raises:
        ValueError, TypeError: as `visible_points` and `unproject`.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> depth = torch.full((1, 1, 4, 4), float("inf")); depth[0, 0, 1, 1] = 2.0
        >>> sets = front_sets(torch.zeros(1, 5, 3), camera, depth)
        >>> sets.predicted_lengths.tolist(), sets.observed_lengths.tolist()
        ([[1]], [[1]])
    """
    return _front_sets("front_sets", points, camera, depth, visibility)[0]


class _Counts(NamedTuple):
    """What is read of `FrontSets`, in one transfer, because each would wait for a GPU."""

    fallback: bool
    """Whether a view sees no predicted point."""
    fewest: int
    """Points of the depth map that has the fewest."""
    most: int
    """Points of the depth map that has the most."""


def _front_sets(
    function: str, points: Tensor, camera: PinholeCamera, depth: Tensor, visibility: Method
) -> tuple[FrontSets, _Counts | None]:
    """The sets, and what is known of their sizes; None where sizes must not depend on values (see `readable`)."""
    batch, views = check_maps(function, points, camera, depth)
    _checks.check_choice(function, "visibility", visibility, METHODS)
    sample = sample_view(points, visible_points(points, camera, method=visibility))
    seen = sample.points.expand(batch, views, -1, 3)
    lengths = sample.lengths.expand(batch, views)
    fallback = lengths == 0
    observed, observed_lengths = unproject(depth, camera)
    counts = None
    if not fallback.numel():
        counts = _Counts(False, 0, 0)
    elif _checks.readable(points, depth, lengths):
        numbers = fallback.any().long(), *observed_lengths.aminmax()
        some_fallback, fewest, most = torch.stack(numbers).cpu().tolist()
        counts = _Counts(bool(some_fallback), fewest, most)
    if counts is None or counts.fallback:
        extra = points.shape[1] - seen.shape[2]
        seen = torch.nn.functional.pad(seen, (0, 0, 0, extra))
        seen = torch.where(fallback[..., None, None], points[:, None], seen)
        lengths = torch.where(fallback, points.shape[1], lengths)
    if counts is not None:
        observed = observed[:, :, : counts.most]
    return FrontSets(seen, lengths, observed, observed_lengths, fallback), counts


class FrontTerms(NamedTuple):
    """The front constraint of each view, and how many points it compared."""

    loss: Tensor
    """(B, V) world units; 0, with gradient 0, where the depth map is empty."""
    matched: Tensor
    """(B, V) int64: size of the smaller of the two sets, which is the number of pairs of an assignment between them."""
    observed: Tensor
    """(B, V) int64: number of points of the depth map."""
    fallback: Tensor
    """(B, V) bool: no predicted point was visible though the depth map is not empty; the whole cloud was compared."""


def front_terms(
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    *,
    distance: Distance = "chamfer",
    tolerance: float = 0.02,
    visibility: Method = "zbuffer",
) -> FrontTerms:
    """The front constraint of each view, before reduction and without warnings; see `front_constraint`.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        distance: "chamfer": sum of both directions' mean distances; "emd": mean distance of the assignment. The sum
            over matched points, as in the paper, is `loss * matched`.
        tolerance: of the earth mover's distance.
        visibility: how the predicted points that a view sees are found; a method of `visible_points`.

    Gradients: of `loss` to x, y and z of the visible points, and to `depth` and the camera; none through the choice
        of the points.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an unknown distance, a cloud without points, NaN or
            infinite coordinates.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> depth = torch.full((1, 2, 4, 4), float("inf")); depth[0, 0, 1, 1] = 2.0
        >>> terms = front_terms(torch.zeros(1, 5, 3), camera, depth)
        >>> terms.matched.tolist(), terms.observed.tolist(), terms.loss[0, 1].item()
        ([[1, 0]], [[1, 0]], 0.0)
    """
    return _front_terms("front_terms", points, camera, depth, distance, tolerance, visibility)[0]


def _front_terms(
    function: str,
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    distance: Distance,
    tolerance: float,
    visibility: Method,
) -> tuple[FrontTerms, _Counts | None]:
    _checks.check_choice(function, "distance", distance, ("chamfer", "emd"))
    sets, counts = _front_sets(function, points, camera, depth, visibility)
    if points.shape[1] == 0 and points.shape[0]:
        raise _checks.fail(function, "points", "hold at least one point", str(tuple(points.shape)))
    kept = sets.observed_lengths > 0
    if counts is None:
        # One point stands for each empty map; its loss is not used.
        compared = sets._replace(observed_lengths=sets.observed_lengths.clamp(min=1))
        loss = torch.where(kept, _compare_sets(compared, distance, tolerance), 0.0)
    elif not counts.most:
        # Depends on `points`, so that the backward pass of such a batch gives zeros and does not fail.
        loss = points.new_zeros(kept.shape) + (0 * points).sum()
    elif counts.fewest:
        loss = _compare_sets(sets, distance, tolerance)
    else:
        compared = _compare_sets(FrontSets(*(value[kept] for value in sets)), distance, tolerance)
        loss = points.new_zeros(kept.shape).masked_scatter(kept, compared)
    matched = sets.predicted_lengths.minimum(sets.observed_lengths)
    return FrontTerms(loss, matched, sets.observed_lengths, sets.fallback & kept), counts


def _compare_sets(sets: FrontSets, distance: Distance, tolerance: float) -> Tensor:
    """(*B) distances between sets that all hold at least one point."""
    a, b, a_lengths, b_lengths = sets.predicted, sets.observed, sets.predicted_lengths, sets.observed_lengths
    if distance == "chamfer":
        both = chamfer_distance(a, b, squared=False, a_lengths=a_lengths, b_lengths=b_lengths)
        return both.total
    return earth_mover_distance(a, b, tolerance=tolerance, a_lengths=a_lengths, b_lengths=b_lengths).cost


def front_constraint(
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    *,
    distance: Distance = "chamfer",
    tolerance: float = 0.02,
    visibility: Method = "zbuffer",
    reduction: Reduction = "mean",
) -> Tensor:
    """distance(predicted points that a view sees, points of its true depth map), in 3D, for each view.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        distance: "chamfer": sum of both directions' mean distances; "emd": mean distance of the assignment.
        tolerance: of the earth mover's distance.
        visibility: how the points that a view sees are found: "zbuffer" is the paper's; "horizon" passes on more of
            the visible points and fewer of the hidden ones. See `visible_points`.
        reduction: "mean" over all views, or "none" for (B, V).

    Returns:
        The loss in world units. A view whose depth map is empty has loss 0. In a view in which no predicted point is
        visible the whole cloud is compared, which pulls it into view. Both raise a `RuntimeWarning`, except under
        `torch.compile` and `torch.vmap`, which do not let it read values; `front_terms` returns them instead.

    Gradients: to x, y and z of the visible points; none through the choice of the points.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an unknown distance, a cloud without points, NaN or
            infinite coordinates.

    Source: CVPR 2019 paper, front constraint (section 3.2).

    Example:
        >>> from diffpoint import splat_depth
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
        >>> cloud = torch.rand(1, 50, 3) - 0.5
        >>> depth = splat_depth(cloud, camera).depth
        >>> same, shifted = (front_constraint(c, camera, depth).item() for c in (cloud, cloud + 0.2))
        >>> same < shifted  # not 0: the points of a pixel are compared with its centre
        True
    """
    terms, counts = _front_terms("front_constraint", points, camera, depth, distance, tolerance, visibility)
    for possible, happened, what in (
        (counts is not None and counts.fallback, terms.fallback, "no predicted point is visible"),
        (counts is not None and not counts.fewest, terms.observed == 0, "the depth map is empty"),
    ):
        if possible and bool(happened.any()):
            where = tuple(happened.nonzero()[0].tolist())
            warnings.warn(
                f"front_constraint: in {int(happened.sum())} of {happened.numel()} views {what}; "
                f"the first is (cloud, view) {where}.",
                RuntimeWarning,
                stacklevel=2,
            )
    return reduce_loss("front_constraint", terms.loss, reduction)


def diversity_loss(
    codes: Tensor, clouds: Tensor, *, alpha: float, tolerance: float = 0.05, reduction: Reduction = "mean"
) -> Tensor:
    """mean over pairs i < j of relu(|r_i - r_j| - alpha EMD(S_i, S_j)): different codes must give different shapes.

    Args:
        codes: (R, B, D) random inputs of a generator.
        clouds: (R, B, N, 3) the shapes generated from them, world frame.
        alpha: weight of the distance between shapes, the mean earth mover's distance. The paper's 0.2 and 0.1 multiply
            a sum over 2048 points of an approximation that is about 1.3 times the distance; here they correspond to
            0.2 * 2048 * 1.3 and 0.1 * 2048 * 1.3.
        tolerance: of the earth mover's distance.
        reduction: "mean" over all, or "none" for (B,).

    Gradients: to `clouds` and `codes`.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, fewer than two codes, NaN or infinite coordinates.

    Source: CVPR 2019 paper, diversity constraint (section 3.3).

    Example:
        >>> codes = torch.tensor([[[0.0, 0.0]], [[3.0, 4.0]]])
        >>> diversity_loss(codes, torch.zeros(2, 1, 8, 3), alpha=1.0).item()
        5.0
    """
    _checks.check_tensor("diversity_loss", "codes", codes, ("R", "B", "D"))
    _checks.check_tensor("diversity_loss", "clouds", clouds, (*codes.shape[:2], "N", 3))
    _checks.check_same_dtype("diversity_loss", codes=codes, clouds=clouds)
    alpha = _checks.check_number("diversity_loss", "alpha", alpha, "be finite", math.isfinite)
    _checks.check_finite("diversity_loss", "codes", codes.detach())
    _checks.check_filled("diversity_loss", "clouds", clouds)
    first, second = pairs("diversity_loss", "codes", codes.shape[0])
    apart = (codes[first] - codes[second]).norm(dim=-1)
    # From this distance on the hinge is 0, so the exact distance is not needed.
    enough = apart / alpha if alpha > 0 else None
    moved = earth_mover_distance(clouds[first], clouds[second], tolerance=tolerance, enough=enough).cost
    return reduce_loss("diversity_loss", torch.relu(apart - alpha * moved).mean(0), reduction)


def consistency_loss(clouds: Tensor, *, reduction: Reduction = "mean") -> Tensor:
    """mean over pairs i < j of the chamfer distance between S_i and S_j, predictions of one shape.

    Args:
        clouds: (*B, V, N, 3) V predictions of each shape, world frame.
        reduction: "mean" over all shapes, or "none" for (*B).

    Returns:
        The loss in world units: both directions' mean distances, added.

    Gradients: to `clouds`, with the assignments held fixed.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, fewer than two clouds, NaN or infinite coordinates.

    Source: CVPR 2019 paper, consistency loss (section 3.5).

    Example:
        >>> consistency_loss(torch.tensor([[[0.0, 0, 0]], [[1.0, 0, 0]], [[0.0, 0, 0]]])).item()
        1.3333333730697632
    """
    _checks.check_tensor("consistency_loss", "clouds", clouds, ("*", "V", "N", 3))
    _checks.check_filled("consistency_loss", "clouds", clouds)
    first, second = pairs("consistency_loss", "clouds", clouds.shape[-3])
    both = chamfer_distance(clouds[..., first, :, :], clouds[..., second, :, :], squared=False)
    return reduce_loss("consistency_loss", both.total.mean(-1), reduction)


def pairs(function: str, argument: str, count: int) -> tuple[list[int], list[int]]:
    """All i < j < `count`, as the list of i and the list of j."""
    if count < 2:
        raise _checks.fail(function, argument, "hold at least two to compare", str(count))
    first, second = zip(*itertools.combinations(range(count), 2), strict=True)
    return list(first), list(second)


def check_maps(function: str, points: Tensor, camera: PinholeCamera, depth: Tensor) -> tuple[int, int]:
    """Check depth maps against clouds and cameras; returns (B, V)."""
    _checks.check_clouds(function, "points", points)
    check_camera(function, "camera", camera)
    _checks.check_tensor(function, "depth", depth, (points.shape[0], "V", camera.height, camera.width))
    _checks.check_same_dtype(function, points=points, depth=depth)
    check_views(function, "camera", camera, points, views=depth.shape[1])
    return points.shape[0], depth.shape[1]


def reduce_loss(function: str, loss: Tensor, reduction: Reduction) -> Tensor:
    _checks.check_choice(function, "reduction", reduction, ("mean", "none"))
    if reduction == "mean" and loss.numel() == 0:
        raise _checks.fail(
            function, "reduction", "be 'none' where there is nothing to take the mean of", "'mean'"
        )
    return loss.mean() if reduction == "mean" else loss
