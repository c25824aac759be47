"""Conversions between points, pixels and depth maps: project, unproject, reproject."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint._parts import sum_of_parts, summed_parts
from diffpoint.camera import PinholeCamera, PointSets, Projection, Views, check_camera, check_views

_TILE = 8  # as in kernels/reproject.py


class Reprojection(NamedTuple):
    """The pixels of one camera's depth map as seen by another camera."""

    points: Tensor
    """(B, V, H, W, 3) world frame; zeros where the source is empty."""
    pixels: Tensor
    """(B, V, H, W, 2) continuous image coordinates in the target; +inf where the source is empty, or the point
    is at or behind the camera's plane."""
    depth: Tensor
    """(B, V, H, W) z in the target's camera frame; +inf where the source is empty."""
    valid: Tensor
    """(B, V, H, W) bool: the source pixel is foreground, in front of the target camera and inside its image."""


def project(points: Tensor, camera: PinholeCamera) -> Projection:
    """(u d, v d, d) = K cam_from_world (x, y, z, 1).

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V).

    Returns:
        `Projection`. Points at or behind the camera's plane have no image: their pixels are +inf.

    Gradients: to `points`, `camera.K` and `camera.cam_from_world`; zero for pixels at infinity.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, NaN or infinite coordinates.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> project(torch.zeros(1, 1, 3), camera).pixels.tolist()
        [[[[2.0, 2.0]]]]
    """
    _checks.check_clouds("project", "points", points)
    views = check_views("project", "camera", camera, points)
    return Projection(*_project(points, views.projection))


def unproject(depth: Tensor, camera: PinholeCamera) -> PointSets:
    """The world points at the pixel centres of depth maps, foreground only.

    Args:
        depth: (B, V, H, W) z in the camera frame, +inf where empty.
        camera: batch shape (), (V,) or (B, V), of the maps' size.

    Returns:
        `PointSets` of points (B, V, H*W, 3): the foreground in row-major order, then zeros; and its lengths (B, V).

    Gradients: to `depth`, `camera.K` and `camera.cam_from_world`.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, depths that are NaN, zero or negative.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=1, width=1)
        >>> unproject(torch.full((1, 1, 1, 1), 2.0), camera).points.tolist()
        [[[[0.0, 0.0, 0.0]]]]
    """
    views = _depth_views("unproject", depth, "camera", camera)
    return PointSets(*_unproject(depth, views.back_projection))


def reproject(depth: Tensor, source: PinholeCamera, target: PinholeCamera) -> Reprojection:
    """Depth maps of `source` -> world points -> pixels and depth in `target`, pixel by pixel.

    Args:
        depth: (B, V, H, W) z in the source's camera frame, +inf where empty.
        source: cameras of the maps, batch shape (), (V,) or (B, V), of the maps' size.
        target: cameras to reproject into; view v of `source` goes to view v of `target`.

    Gradients: of points, pixels and depth to `depth` and both cameras.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, depths that are NaN, zero or negative.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=1, width=1)
        >>> reproject(torch.full((1, 1, 1, 1), 2.0), camera, camera).pixels.tolist()
        [[[[[0.5, 0.5]]]]]
    """
    views = _depth_views("reproject", depth, "source", source)
    targets = check_views("reproject", "target", target, depth, views=depth.shape[1])
    size = target.height, target.width
    return Reprojection(*_reproject(depth, views.back_projection, targets.projection, *size))


def _depth_views(function: str, depth: Tensor, name: str, camera: PinholeCamera) -> Views:
    """The camera expanded to the (B, V) of the depth maps, of their size and dtype."""
    _checks.check_tensor(function, "depth", depth, ("B", "V", "H", "W"))
    check_camera(function, name, camera)
    _, count, height, width = depth.shape
    if (height, width) != (camera.height, camera.width):
        raise _checks.fail(
            function,
            "depth",
            f"have the camera's size {camera.height} x {camera.width}",
            f"{height} x {width}",
            "Use camera.resize(height, width) if the map shows the same view at another size.",
        )
    return check_views(function, name, camera, depth, views=count)


def _project_fake(points: Tensor, projection: Tensor):
    shape = (*projection.shape[:2], points.shape[1])
    return points.new_empty((*shape, 2)), points.new_empty(shape)


def _project_setup(ctx, inputs, output) -> None:
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs)


def _project_gradient(ctx, grad_pixels: Tensor | None, grad_depth: Tensor | None):
    points, projection = ctx.saved_tensors
    shape = (*projection.shape[:2], points.shape[1])
    grad_pixels = _bridge.or_zeros(grad_pixels, points, (*shape, 2))
    grad_depth = _bridge.or_zeros(grad_depth, points, shape)
    return _project_backward(points, projection, grad_pixels, grad_depth)


@_bridge.register("project", fake=_project_fake, backward=_project_gradient, setup=_project_setup)
def _project(points: Tensor, projection: Tensor) -> tuple[Tensor, Tensor]:
    batch, views = projection.shape[:2]
    count = points.shape[1]
    pixels = points.new_empty((batch, views, count, 2))
    depth = points.new_empty((batch, views, count))
    if depth.numel():
        total = points.new_empty(batch * views)
        inputs = points.reshape(-1), projection.reshape(-1)
        outputs = pixels.view(-1), depth.view(-1), total
        _bridge.launch("reproject", "project", points.dtype, *inputs, *outputs, views, count)
    if depth.numel() == 0 or not math.isfinite(float(total.sum())):
        _checks.check_finite("project", "points", points)
    return pixels, depth


@_bridge.register(
    "project_backward",
    strided=True,  # see `_walk`
    fake=lambda points, projection, grad_pixels, grad_depth: (
        points.new_empty(points.shape),
        projection.new_empty(projection.shape),
    ),
)
def _project_backward(
    points: Tensor, projection: Tensor, grad_pixels: Tensor, grad_depth: Tensor
) -> tuple[Tensor, Tensor]:
    views, count = projection.shape[1], points.shape[1]
    parts = summed_parts(count)
    if points.numel() == 0 or projection.numel() == 0:
        return points.new_zeros(points.shape), projection.new_zeros(projection.shape)
    grad_points = points.new_empty(points.shape)
    grad_projection = projection.new_empty((*projection.shape[:2], parts, 3, 4))
    (pixels_flat, pixels_step), (depth_flat, depth_step) = _walk(grad_pixels), _walk(grad_depth)
    inputs = points.reshape(-1), projection.reshape(-1), pixels_flat, depth_flat
    outputs = grad_points.view(-1), grad_projection.view(-1)
    sizes = pixels_step, depth_step, views, parts, count
    _bridge.launch("reproject", "project_backward", points.dtype, *inputs, *outputs, *sizes)
    return grad_points, sum_of_parts(grad_projection, 2)


def _walk(gradient: Tensor) -> tuple[Tensor, int]:
    """A flat tensor and its step: 1, or 0 for an expanded number (the gradient of a sum), of which one tile is made."""
    if any(gradient.stride()):
        return gradient.contiguous().view(-1), 1  # `reshape` would keep the strides of a slice
    return gradient.as_strided((3 * _TILE,), (0,)).contiguous(), 0


def _unproject_fake(depth: Tensor, back_projection: Tensor):
    batch, views, height, width = depth.shape
    return (
        depth.new_empty((batch, views, height * width, 3)),
        depth.new_empty((batch, views), dtype=torch.int64),
    )


def _unproject_setup(ctx, inputs, output) -> None:
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs)


def _unproject_gradient(ctx, grad_points: Tensor | None, _grad_lengths):
    if grad_points is None:
        return None, None
    depth, back_projection = ctx.saved_tensors
    return _unproject_backward(depth, back_projection, grad_points)


@_bridge.register("unproject", fake=_unproject_fake, backward=_unproject_gradient, setup=_unproject_setup)
def _unproject(depth: Tensor, back_projection: Tensor) -> tuple[Tensor, Tensor]:
    batch, views, height, width = depth.shape
    _checks.check_depth("unproject", "depth", depth)
    points = depth.new_zeros((batch * views, height * width, 3))
    lengths = torch.zeros(batch * views, dtype=torch.int64)
    if depth.numel():
        maps = depth.reshape(batch * views, height, width)
        matrices = back_projection.reshape(batch * views, 12)
        _bridge.launch("reproject", "unproject", depth.dtype, maps, matrices, points, lengths)
    return points.view(batch, views, height * width, 3), lengths.view(batch, views)


@_bridge.register(
    "unproject_backward",
    fake=lambda depth, back_projection, grad_points: (
        depth.new_empty(depth.shape),
        back_projection.new_empty(back_projection.shape),
    ),
)
def _unproject_backward(depth: Tensor, back_projection: Tensor, grad_points: Tensor) -> tuple[Tensor, Tensor]:
    batch, views, height, width = depth.shape
    flat = batch * views
    grad_depth = depth.new_zeros((flat, height, width))
    grad_back_projection = back_projection.new_zeros((flat, 12))
    if depth.numel():
        _bridge.launch(
            "reproject",
            "unproject_backward",
            depth.dtype,
            depth.reshape(flat, height, width),
            back_projection.reshape(flat, 12),
            grad_points.reshape(flat, height * width, 3),
            grad_depth,
            grad_back_projection,
        )
    return grad_depth.view(depth.shape), grad_back_projection.view(back_projection.shape)


def _reproject_fake(depth: Tensor, back_projection: Tensor, projection: Tensor, height: int, width: int):
    return (
        depth.new_empty((*depth.shape, 3)),
        depth.new_empty((*depth.shape, 2)),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape, dtype=torch.bool),
    )


def _reproject_setup(ctx, inputs, output) -> None:
    ctx.mark_non_differentiable(output[3])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:3])


def _reproject_gradient(
    ctx, grad_points: Tensor | None, grad_pixels: Tensor | None, grad_seen: Tensor | None, _grad_valid
):
    depth, back_projection, projection = ctx.saved_tensors
    grad_points = _bridge.or_zeros(grad_points, depth, (*depth.shape, 3))
    grad_pixels = _bridge.or_zeros(grad_pixels, depth, (*depth.shape, 2))
    grad_seen = _bridge.or_zeros(grad_seen, depth, depth.shape)
    gradients = _reproject_backward(depth, back_projection, projection, grad_points, grad_pixels, grad_seen)
    return *gradients, None, None


@_bridge.register("reproject", fake=_reproject_fake, backward=_reproject_gradient, setup=_reproject_setup)
def _reproject(
    depth: Tensor, back_projection: Tensor, projection: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    batch, views, rows, columns = depth.shape
    points = depth.new_empty((*depth.shape, 3))
    pixels = depth.new_empty((*depth.shape, 2))
    seen = depth.new_empty(depth.shape)
    valid = torch.empty(depth.shape, dtype=torch.uint8)
    if depth.numel():
        total = depth.new_empty(batch * views)
        inputs = depth.reshape(-1), back_projection.reshape(-1), projection.reshape(-1)
        outputs = points.view(-1), pixels.view(-1), seen.view(-1), valid.view(-1), total
        sizes = rows, columns, height, width
        _bridge.launch("reproject", "reproject", depth.dtype, *inputs, *outputs, *sizes)
        if not math.isfinite(float(total.sum())):
            _checks.check_depth("reproject", "depth", depth)
            _checks.check_finite("reproject", "points", points)
    return points, pixels, seen, valid.view(torch.bool)


@_bridge.register(
    "reproject_backward",
    strided=True,  # see `_walk`
    fake=lambda depth, back_projection, projection, *_: (
        depth.new_empty(depth.shape),
        back_projection.new_empty(back_projection.shape),
        projection.new_empty(projection.shape),
    ),
)
def _reproject_backward(
    depth: Tensor,
    back_projection: Tensor,
    projection: Tensor,
    grad_points: Tensor,
    grad_pixels: Tensor,
    grad_seen: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    batch, views, height, width = depth.shape
    parts = summed_parts(height * width)
    grad_depth = depth.new_empty(depth.shape)
    grad_back_projection, grad_projection = (depth.new_empty((batch, views, parts, 3, 4)) for _ in range(2))
    if depth.numel():
        gradients, steps = zip(*(_walk(g) for g in (grad_points, grad_pixels, grad_seen)), strict=True)
        outputs = grad_depth.view(-1), grad_back_projection.view(-1), grad_projection.view(-1)
        inputs = (x.reshape(-1) for x in (depth, back_projection, projection))
        sizes = *steps, parts, height, width
        _bridge.launch("reproject", "reproject_backward", depth.dtype, *inputs, *gradients, *outputs, *sizes)
    return grad_depth, sum_of_parts(grad_back_projection, 2), sum_of_parts(grad_projection, 2)
