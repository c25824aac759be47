"""Farthest point sampling."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffpoint import _bridge, _checks
from diffpoint.blocks import sort_into_blocks

_LANES = 16  # as in kernels/sampling.py
_LARGE = 4096  # points from which the search with boxes is faster than updating every distance


def farthest_point_sample(points: Tensor, k: int, *, start: int = 0, lengths: Tensor | None = None) -> Tensor:
    """Indices of k points; each is the farthest from those chosen before it.

    Args:
        points: (*B, N, 3) or (*B, N, 2), any unit.
        k: how many points to choose, at most the size of the smallest cloud.
        start: index of the first chosen point.
        lengths: (*B) int64, how many of the N points count; default all.

    Returns:
        (*B, k) int64. Equal distances go to the lowest index: the same input gives the same indices.

    Gradients: none; gather the points with the result to pass gradients to them.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, k or start out of range, NaN or infinite coordinates.

    Example:
        >>> farthest_point_sample(torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2).tolist()
        [0, 2]
    """
    points = _checks.check_points("farthest_point_sample", "points", points, "N")
    batch = tuple(points.shape[:-2])
    lengths = _checks.check_lengths(
        "farthest_point_sample", "lengths", lengths, batch, points.shape[-2], points
    )
    k = _checks.check_integer("farthest_point_sample", "k", k, 0)
    start = _checks.check_integer("farthest_point_sample", "start", start, 0)
    flat = points.reshape(torch.Size(batch).numel(), *points.shape[-2:])
    lengths = _bridge.full_lengths(lengths, flat.shape[0], flat.shape[1], flat)
    return _farthest(flat, lengths, k, start).reshape(*batch, k)


@_bridge.register(
    "farthest_point_sample",
    fake=lambda points, lengths, k, start: points.new_empty((points.shape[0], k), dtype=torch.int64),
)
def _farthest(points: Tensor, lengths: Tensor, k: int, start: int) -> Tensor:
    batch, size, _ = points.shape
    smallest = int(lengths.min()) if batch else size
    _checks.check_lengths_range("farthest_point_sample", "lengths", lengths, size)
    for name, value, limit in (("k", k, smallest), ("start", start, max(smallest - 1, 0))):
        if value > limit and batch:
            raise _checks.fail(
                "farthest_point_sample",
                name,
                f"be at most {limit} (the smallest cloud has {smallest} points)",
                str(value),
            )
    _checks.check_finite("farthest_point_sample", "points", points, lengths)
    chosen = torch.empty((batch, k), dtype=torch.int64)
    if chosen.numel() == 0:
        return chosen
    if size < _LARGE:
        axes = lanes(points)
        distance = _unset_distance(points, lengths, axes[0][0].numel()).view(axes[0].shape)
        _bridge.launch("sampling", "farthest", points.dtype, points, *axes, distance, chosen, start)
        return chosen
    blocks = sort_into_blocks(points, lengths)
    distance = _unset_distance(points, lengths, blocks.points.shape[1]).view(batch, -1, _LANES)
    box_farthest = points.new_empty((batch, blocks.boxes.shape[2]))
    box_point = torch.zeros(box_farthest.shape, dtype=torch.int32)
    scratch = distance, box_farthest, box_farthest.view(batch, -1, _LANES), box_point
    axes = lanes(blocks.points)
    sorted_points = blocks.points, *axes, blocks.order, blocks.box_lanes
    _bridge.launch("sampling", "farthest_blocks", points.dtype, *sorted_points, *scratch, chosen, start)
    return chosen


def _unset_distance(points: Tensor, lengths: Tensor, size: int) -> Tensor:
    """(B, size): +inf for points, and -1 in the padding, which is therefore never chosen."""
    return torch.where(torch.arange(size) < lengths[:, None], torch.inf, -1.0).to(points.dtype)


def lanes(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z of clouds (B, N, 3), each as (B, ceil(N / 16), 16), for kernels that load vectors of 16."""
    batch, size, _ = points.shape
    tiles = -(-size // _LANES)
    by_axis = pad(points.detach().movedim(-1, 0), (0, tiles * _LANES - size)).contiguous()
    x, y, z = by_axis.view(3, batch, tiles, _LANES)
    return x, y, z
