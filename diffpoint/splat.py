"""Point splatting: clouds to depth maps, with the index of the point at each pixel."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint._runtime import runtime_info
from diffpoint.camera import PinholeCamera, check_views

_ALONE = 12_000  # points plus a quarter of the pixels, up to which a second thread costs more than it saves
_PART = 16_384  # least number of points per map when the points of a view are divided among several


class Splat(NamedTuple):
    """Depth maps of clouds, and the points that contributed to them."""

    depth: Tensor
    """(B, V, H, W) z in the camera frame of the nearest point; +inf where no point fell."""
    index: Tensor
    """(B, V, H, W) int64: index of that point; -1 where no point fell."""
    visible: Tensor
    """(B, V, N) bool: the points that are the nearest of at least one pixel."""


def splat_depth(
    points: Tensor, camera: PinholeCamera, *, radius: float = 0.0, lengths: Tensor | None = None
) -> Splat:
    """Render clouds to z-buffers: a point falls into pixel (floor(u), floor(v)), which keeps the nearest depth.

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V), for maps of camera.height x camera.width.
        radius: in pixels. With 0 a point covers one pixel, as in the paper; otherwise also the pixels whose centres lie
            within `radius` of it.
        lengths: (B,) int64, how many of the N points count; default all.

    Returns:
        `Splat`. Of points with equal depth the one with the lowest index is kept: the same input gives the same bits.

    Gradients: of `depth` to the contributing points (along the camera's z axis only: pixels are assigned by a step
    function) and to `camera.cam_from_world`. None through `index` and `visible`.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, a negative radius, NaN or infinite coordinates.

    Source: CVPR 2019 paper, section 3.2 (view based sampling); the released code rounds instead of flooring.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> cloud = torch.tensor([[[0.1, -0.1, 0.5], [0.1, -0.1, 0.0]]])
        >>> splat_depth(cloud, camera).visible.tolist()
        [[[False, True]]]
    """
    _checks.check_clouds("splat_depth", "points", points)
    radius = _checks.check_number(
        "splat_depth",
        "radius",
        radius,
        "be a finite number of pixels, at least 0",
        lambda r: 0 <= r < math.inf,
    )
    batch = points.shape[0]
    lengths = _checks.check_lengths("splat_depth", "lengths", lengths, (batch,), points.shape[1], points)
    views = check_views("splat_depth", "camera", camera, points)
    lengths = _bridge.full_lengths(lengths, batch, points.shape[1], points)
    return Splat(*_splat(points, lengths, views.projection, camera.height, camera.width, radius))


def _splat_fake(points: Tensor, lengths: Tensor, projection: Tensor, height: int, width: int, radius: float):
    shape = (*projection.shape[:2], height, width)
    return (
        points.new_empty(shape),
        points.new_empty(shape, dtype=torch.int64),
        points.new_empty((*projection.shape[:2], points.shape[1]), dtype=torch.bool),
    )


def _splat_setup(ctx, inputs, output) -> None:
    points, _, projection, *_ = inputs
    _, index, visible = output
    ctx.mark_non_differentiable(index, visible)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(points, projection, index)


def _splat_gradient(ctx, grad_depth: Tensor | None, _grad_index, _grad_visible):
    if grad_depth is None:
        return (None,) * 6
    points, projection, index = ctx.saved_tensors
    grad_points, grad_projection = _splat_backward(points, projection, index, grad_depth)
    return grad_points, None, grad_projection, None, None, None


@_bridge.register("splat", fake=_splat_fake, backward=_splat_gradient, setup=_splat_setup)
def _splat(
    points: Tensor, lengths: Tensor, projection: Tensor, height: int, width: int, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    _checks.check_lengths_range("splat_depth", "lengths", lengths, points.shape[1])
    batch, views = projection.shape[:2]
    count, rows, pixels = points.shape[1], batch * views, height * width
    depth = points.new_empty(rows * pixels)
    index = torch.empty(rows * pixels, dtype=torch.int64)
    visible = torch.empty(rows * count, dtype=torch.uint8)
    if visible.numel() == 0:
        _checks.check_finite("splat_depth", "points", points, lengths)
        depth.fill_(torch.inf)
        index.fill_(-1)
    else:
        parts = _parts(rows, count)
        maps = depth, index
        if parts > 1:
            maps = depth.new_empty(parts * rows * pixels), index.new_empty(parts * rows * pixels)
        total = points.new_empty(rows * parts)
        kernel = "forward_disc" if radius > 0 else "forward"
        if rows * (count + pixels // 4) < _ALONE:
            kernel += "_alone"
        inputs = points.reshape(-1), lengths, projection.reshape(-1)
        sizes = views, parts, count, height, width, radius
        _bridge.launch("splat", kernel, points.dtype, *inputs, *maps, visible, total, *sizes)
        if not math.isfinite(float(total.sum())):
            _checks.check_finite("splat_depth", "points", points, lengths)
        if parts > 1:
            _bridge.launch("splat", "merge", points.dtype, *maps, depth, index, visible, parts, count, pixels)
    shape = batch, views, height, width
    return depth.view(shape), index.view(shape), visible.view(torch.bool).view(batch, views, count)


def _parts(rows: int, count: int) -> int:
    """Number of maps that the points of a view are divided among, so that a few large clouds use every thread."""
    if rows > 8 or count < 2 * _PART:
        return 1
    return max(1, min(runtime_info().threads // rows, count // _PART))


@_bridge.register(
    "splat_backward",
    fake=lambda points, projection, index, grad_depth: (
        points.new_empty(points.shape),
        projection.new_empty(projection.shape),
    ),
)
def _splat_backward(
    points: Tensor, projection: Tensor, index: Tensor, grad_depth: Tensor
) -> tuple[Tensor, Tensor]:
    _, views, height, width = index.shape
    if points.numel() == 0 or index.numel() == 0:
        return points.new_zeros(points.shape), projection.new_zeros(projection.shape)
    grad_points = points.new_empty(points.shape)
    grad_projection = projection.new_empty(projection.shape)
    _bridge.launch(
        "splat",
        "backward",
        points.dtype,
        points.reshape(-1),
        projection.reshape(-1),
        index.view(-1),
        grad_depth.reshape(-1),
        grad_points.view(-1),
        grad_projection.view(-1),
        views,
        points.shape[1],
        height * width,
    )
    return grad_points, grad_projection
