"""Point splatting: clouds to depth maps, with the index of each pixel's contributor."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint.camera import PinholeCamera, check_views


class Splat(NamedTuple):
    """Depth maps of clouds, and who contributed to them."""

    depth: Tensor
    """(B, V, H, W) z in the camera frame of the nearest point; +inf where no point fell."""
    index: Tensor
    """(B, V, H, W) int64: that point; -1 where no point fell."""
    visible: Tensor
    """(B, V, N) bool: the points that own at least one pixel."""


def splat_depth(
    points: Tensor, camera: PinholeCamera, *, radius: float = 0.0, lengths: Tensor | None = None
) -> Splat:
    """Render clouds to z-buffers: a point falls in pixel floor(u), floor(v); the nearest depth wins.

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V), for maps of camera.height x camera.width.
        radius: in pixels. 0 gives each point its one pixel, as in the paper; otherwise it also covers the pixels
            whose centres lie within `radius` of it.
        lengths: (B,) int64, how many of the N points count; default all.

    Returns:
        `Splat`. Equal depths go to the lowest index, so the same input gives the same bits.

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
    if not radius >= 0 or radius == float("inf"):
        raise _checks.fail("splat_depth", "radius", "be a finite number of pixels, at least 0", repr(radius))
    batch = points.shape[0]
    lengths = _checks.check_lengths("splat_depth", "lengths", lengths, (batch,), points.shape[1])
    views = check_views("splat_depth", "camera", camera, points)
    lengths = _bridge.full_lengths(lengths, batch, points.shape[1])
    return Splat(*_splat(points, lengths, views.projection, camera.height, camera.width, float(radius)))


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
    ctx.save_for_backward(points, projection, index)


def _splat_gradient(ctx, grad_depth: Tensor, _grad_index, _grad_visible):
    points, projection, index = ctx.saved_tensors
    grad_points, grad_projection = _splat_backward(points, projection, index, grad_depth)
    return grad_points, None, grad_projection, None, None, None


@_bridge.register("splat", fake=_splat_fake, backward=_splat_gradient, setup=_splat_setup)
def _splat(
    points: Tensor, lengths: Tensor, projection: Tensor, height: int, width: int, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    _checks.check_lengths_range("splat_depth", "lengths", lengths, points.shape[1])
    _checks.check_finite("splat_depth", "points", points, lengths)
    batch, views = projection.shape[:2]
    count = points.shape[1]
    shape = (batch, views, height, width)
    if count == 0 or batch * views == 0:
        empty = points.new_full(shape, torch.inf), torch.full(shape, -1, dtype=torch.int64)
        return *empty, torch.zeros((batch, views, count), dtype=torch.bool)
    depth = points.new_empty(shape)
    index = torch.empty(shape, dtype=torch.int64)
    visible = torch.empty((batch, views, count), dtype=torch.uint8)
    outputs = depth.view(-1), index.view(-1), visible.view(-1)
    kernel, extra = ("forward", ()) if radius == 0 else ("forward_disc", (radius,))
    sizes = views, count, height, width
    inputs = points.reshape(-1), lengths, projection.reshape(-1)
    _bridge.launch("splat", kernel, points.dtype, *inputs, *outputs, *sizes, *extra)
    return depth, index, visible.view(torch.bool)


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
    grad_points = points.new_zeros(points.shape)
    grad_projection = projection.new_zeros(projection.shape)
    if points.numel() and index.numel():
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
