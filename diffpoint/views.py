"""View based sampling: the points of a cloud that a view sees, with gradients."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint.splat import Splat


class ViewSample(NamedTuple):
    """The points each view sees, padded to the largest count M."""

    points: Tensor
    """(B, V, M, 3) world frame, in the cloud's order; zeros in the padding."""
    index: Tensor
    """(B, V, M) int64 into the cloud; -1 in the padding."""
    lengths: Tensor
    """(B, V) int64."""


def sample_view(points: Tensor, splat: Splat | Tensor) -> ViewSample:
    """Gather the points that each view sees.

    Args:
        points: (B, N, 3) in the world, the cloud that `splat` was rendered from.
        splat: the result of `splat_depth`, whose `visible` points are gathered, or of `visible_points`, (B, V, N) bool.

    Returns:
        `ViewSample`; a view that sees no point has length 0.

    Gradients: of `points` to x, y and z of the chosen points; none through the choice of the points.

    Raises:
        ValueError, TypeError: `points` and `splat` of different sizes, wrong dtype or device, NaN or infinite
            coordinates of a point that a view sees.

    Source: CVPR 2019 paper, section 3.2.

    Example:
        >>> from diffpoint import PinholeCamera, splat_depth
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> cloud = torch.tensor([[[0.1, -0.1, 0.5], [0.1, -0.1, 0.0]]])
        >>> sample_view(cloud, splat_depth(cloud, camera)).index.tolist()
        [[[1]]]
    """
    _checks.check_clouds("sample_view", "points", points)
    visible = splat.visible if isinstance(splat, Splat) else splat
    if not isinstance(visible, Tensor) or visible.dtype != torch.bool:
        what = f"a tensor of {visible.dtype}" if isinstance(visible, Tensor) else type(splat).__name__
        raise TypeError(
            "sample_view: 'splat' must be the result of splat_depth, or of visible_points (a bool tensor); "
            f"got {what}."
        )
    _checks.check_device("sample_view", "splat", visible, points)
    _checks.check_shape("sample_view", "splat", visible, ("B", "V", "N"))
    batch, _, count = visible.shape
    if (batch, count) != tuple(points.shape[:2]):
        raise _checks.fail(
            "sample_view",
            "points",
            f"have shape ({batch}, {count}, 3) to match 'splat'",
            str(tuple(points.shape)),
            "Pass the cloud that splat_depth rendered.",
        )
    return ViewSample(*_sample_view(points, visible))


def _sample_fake(points: Tensor, visible: Tensor):
    largest = torch.library.get_ctx().new_dynamic_size()
    shape = (*visible.shape[:2], largest)
    return (
        points.new_empty((*shape, 3)),
        points.new_empty(shape, dtype=torch.int64),
        points.new_empty(shape[:2], dtype=torch.int64),
    )


def _sample_setup(ctx, inputs, output) -> None:
    ctx.mark_non_differentiable(output[1], output[2])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(output[1])
    ctx.count = inputs[0].shape[1]


def _sample_gradient(ctx, grad_points: Tensor | None, _grad_index, _grad_lengths):
    if grad_points is None:
        return None, None
    return _sample_view_backward(ctx.saved_tensors[0], grad_points, ctx.count), None


@_bridge.register("sample_view", fake=_sample_fake, backward=_sample_gradient, setup=_sample_setup)
def _sample_view(points: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    batch, views, count = visible.shape
    lengths = visible.sum(-1)
    largest = int(lengths.max()) if lengths.numel() else 0
    sampled = points.new_zeros((batch, views, largest, 3))
    index = torch.full((batch, views, largest), -1, dtype=torch.int64)
    if sampled.numel():
        flat = batch * views
        _bridge.launch(
            "views",
            "gather_visible",
            points.dtype,
            points,
            visible.view(torch.uint8).reshape(flat, count),
            sampled.view(flat, largest, 3),
            index.view(flat, largest),
            views,
        )
        if not math.isfinite(float(sampled.sum())):  # reads the sample, which is smaller than the cloud
            unseen = ~visible.any(1)
            _checks.check_finite("sample_view", "points", points.masked_fill(unseen[..., None], 0))
    return sampled, index, lengths


@_bridge.register(
    "sample_view_backward",
    fake=lambda index, grad_sampled, count: grad_sampled.new_empty((index.shape[0], count, 3)),
)
def _sample_view_backward(index: Tensor, grad_sampled: Tensor, count: int) -> Tensor:
    batch, views, largest = index.shape
    grad_points = grad_sampled.new_zeros((batch, count, 3))
    if index.numel():
        flat = batch * views
        _bridge.launch(
            "views",
            "scatter_visible",
            grad_sampled.dtype,
            index.view(flat, largest),
            grad_sampled.reshape(flat, largest, 3),
            grad_points,
            views,
        )
    return grad_points
