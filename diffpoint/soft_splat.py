"""Soft splatting: depth maps and silhouettes that change smoothly with x and y of a point."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint._common import least_fade
from diffpoint._parts import gathered_parts
from diffpoint.camera import PinholeCamera
from diffpoint.reproject import project


class SoftSplat(NamedTuple):
    """Soft depth maps of clouds, and how much of each pixel the points cover."""

    depth: Tensor
    """(B, V, H, W) z in the camera frame, a soft minimum over the footprints on the pixel; +inf where there is none."""
    coverage: Tensor
    """(B, V, H, W) sum of the footprints on the pixel; 0 where there is none."""

    @property
    def mask(self) -> Tensor:
        """(B, V, H, W) in [0, 1): 1 - exp(-coverage)."""
        return -torch.expm1(-self.coverage)


def soft_splat(
    points: Tensor,
    camera: PinholeCamera,
    *,
    radius: float = 2.0,
    softness: float = 0.02,
    lengths: Tensor | None = None,
) -> SoftSplat:
    """Render clouds with soft footprints and soft depth order, so that gradients reach x and y.

    A point at pixel position (u, v) covers the pixels whose centres lie within `radius` of it, with the footprint
    k = (1 - r^2 / radius^2)^2 at distance r: 1 at the point, 0 at the edge, with a continuous derivative; where k is so
    small that rounding may have made it, the point does not count. A pixel's depth is the mean of the depths z on it
    with weights k exp(-z / softness), its coverage the sum of the k.

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V), for maps of camera.height x camera.width.
        radius: of a footprint, in pixels. A pixel has gradients to x and y of points within this distance: start large
            and reduce it. From 0.75 on every point covers at least one pixel.
        softness: of the depth order, in world units. A point this far behind another has exp(-1) of its weight; near 0
            only the nearest point of a pixel counts, as in `splat_depth`.
        lengths: (B,) int64, how many of the N points count; default all.

    Returns:
        `SoftSplat`. Weight the depth by the mask: where the mask goes to 0, the depth does not.

    Gradients: of both maps to x, y and z of the points within `radius` of a pixel, and to the camera's matrices.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, a radius or softness that is not positive and finite,
            NaN or infinite coordinates.

    Source: weights exp(-z / softness) as in the soft rasterizer (Liu et al., ICCV 2019) and in Pulsar (Lassner and
        Zollhoefer, CVPR 2021), which has a footprint that fades to its edge too; smooth point footprints for learning
        clouds from silhouettes as in CAPNet (Navaneet et al., AAAI 2019) and in Insafutdinov and Dosovitskiy (NeurIPS
        2018), who also shrink them during the optimisation.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> cloud = torch.tensor([[[0.1, -0.1, 0.0]]], requires_grad=True)
        >>> soft = soft_splat(cloud, camera)
        >>> (gradient,) = torch.autograd.grad(soft.mask[0, 0, 1, 0], cloud)
        >>> bool(gradient[0, 0, 0] != 0)  # moving the point sideways changes how much of the pixel is covered
        True
    """
    _checks.check_clouds("soft_splat", "points", points)
    radius, softness = check_footprint("soft_splat", radius, softness)
    lengths = _checks.check_lengths(
        "soft_splat", "lengths", lengths, points.shape[:1], points.shape[1], points
    )
    whole = _bridge.full_lengths(lengths, points.shape[0], points.shape[1], points)
    if lengths is not None:  # the padding may hold NaN
        counts = torch.arange(points.shape[1], device=points.device) < lengths[:, None]
        points = torch.where(counts[..., None], points, 0.0)
    _checks.check_finite("soft_splat", "points", points.detach())
    pixels, depth = project(points, camera)
    maps = _soft_splat(pixels, depth, whole, camera.height, camera.width, radius, softness)
    return SoftSplat(maps[0], maps[1])


def check_footprint(function: str, radius: float, softness: float) -> tuple[float, float]:
    """Both are positive, finite numbers."""
    radius, softness = (
        _checks.check_number(function, name, value, "be positive and finite", lambda x: 0 < x < math.inf)
        for name, value in (("radius", radius), ("softness", softness))
    )
    return radius, softness


def _soft_splat_fake(
    pixels: Tensor,
    point_depth: Tensor,
    lengths: Tensor,
    height: int,
    width: int,
    radius: float,
    softness: float,
):
    return tuple(point_depth.new_empty((*point_depth.shape[:2], height, width)) for _ in range(4))


def _soft_splat_setup(ctx, inputs, output) -> None:
    pixels, point_depth, lengths, *ctx.sizes = inputs
    depth, _, nearest, weight = output
    depth = depth.detach().clone()  # the caller may change the result, as in depth[depth.isinf()] = 0
    ctx.mark_non_differentiable(nearest, weight)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(pixels, point_depth, lengths, depth, nearest, weight)


def _soft_splat_gradient(ctx, grad_depth: Tensor | None, grad_coverage: Tensor | None, *_):
    pixels, point_depth, lengths, depth, nearest, weight = ctx.saved_tensors
    grad_depth = _bridge.or_zeros(grad_depth, depth, depth.shape)
    grad_coverage = _bridge.or_zeros(grad_coverage, depth, depth.shape)
    saved = pixels, point_depth, lengths, depth, nearest, weight
    gradients = _soft_splat_backward(*saved, grad_depth, grad_coverage, *ctx.sizes[2:])
    return *gradients, *(None,) * 5


@_bridge.register("soft_splat", fake=_soft_splat_fake, backward=_soft_splat_gradient, setup=_soft_splat_setup)
def _soft_splat(
    pixels: Tensor,
    point_depth: Tensor,
    lengths: Tensor,
    height: int,
    width: int,
    radius: float,
    softness: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Depth and coverage; then for the backward pass the nearest depth and the sum of the weights."""
    batch, views, count = point_depth.shape
    _checks.check_lengths_range("soft_splat", "lengths", lengths, count)
    depth, coverage, nearest, weight = (
        point_depth.new_empty((batch, views, height, width)) for _ in range(4)
    )
    maps = [m.view(-1) for m in (depth, coverage, nearest, weight)]
    if point_depth.numel():
        inputs = pixels.reshape(-1), point_depth.reshape(-1), lengths
        sizes = views, count, height, width, radius, softness, least_fade(depth, radius)
        _bridge.launch("soft_splat", "forward", point_depth.dtype, *inputs, *maps, *sizes)
    else:
        for values, empty in zip(maps, (math.inf, 0.0, math.inf, 0.0), strict=True):
            values.fill_(empty)
    return depth, coverage, nearest, weight


@_bridge.register(
    "soft_splat_backward",
    fake=lambda pixels, point_depth, *_: (
        pixels.new_empty(pixels.shape),
        point_depth.new_empty(point_depth.shape),
    ),
)
def _soft_splat_backward(
    pixels: Tensor,
    point_depth: Tensor,
    lengths: Tensor,
    depth: Tensor,
    nearest: Tensor,
    weight: Tensor,
    grad_depth: Tensor,
    grad_coverage: Tensor,
    radius: float,
    softness: float,
) -> tuple[Tensor, Tensor]:
    batch, views, count = point_depth.shape
    grad_pixels, grad_point_depth = pixels.new_empty(pixels.shape), point_depth.new_empty(point_depth.shape)
    if point_depth.numel():
        inputs = pixels.reshape(-1), point_depth.reshape(-1), lengths
        maps = (m.reshape(-1) for m in (depth, nearest, weight, grad_depth, grad_coverage))
        outputs = grad_pixels.view(-1), grad_point_depth.view(-1)
        parts = gathered_parts(batch * views, count)
        sizes = views, parts, count, *depth.shape[2:], radius, softness, least_fade(depth, radius)
        _bridge.launch("soft_splat", "backward", point_depth.dtype, *inputs, *maps, *outputs, *sizes)
    return grad_pixels, grad_point_depth
