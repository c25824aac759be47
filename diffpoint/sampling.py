"""Farthest point sampling."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffpoint import _bridge, _checks
from diffpoint.blocks import LANES, sort_into_blocks

_LARGE = 4096  # points from which the search with boxes is faster than updating every distance


def farthest_point_sample(
    points: Tensor,
    k: int | Tensor,
    *,
    start: int | Tensor | str = 0,
    lengths: Tensor | None = None,
    allow_fewer: bool = False,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Indices of k different points; each is the farthest from those chosen before it.

    Args:
        points: (*B, N, 3) or (*B, N, 2), any unit.
        k: how many points to choose, at most the size of a cloud; an integer, or (*B) int64 for as many of each cloud.
        start: index of the first chosen point; an integer, (*B) int64, or "random".
        lengths: (*B) int64, how many of the N points count; default all.
        allow_fewer: choose all points of a cloud that has fewer than k, instead of raising an error.
        generator: of the random numbers of `start="random"`; default torch's own.

    Returns:
        (*B, k) int64, with the largest k if there are several; -1 after the chosen points of a cloud. Equal distances
        go to the lowest index: the same input gives the same indices.

    Gradients: none; gather the points with the result to pass gradients to them.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, k or start out of range, NaN or infinite coordinates.

    Example:
        >>> line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
        >>> farthest_point_sample(line, 2).tolist()
        [0, 2]
        >>> farthest_point_sample(line[None].expand(2, -1, -1), torch.tensor([1, 3])).tolist()
        [[0, -1, -1], [0, 2, 1]]
    """
    name = "farthest_point_sample"
    points = _checks.check_points(name, "points", points, "N")
    batch = tuple(points.shape[:-2])
    lengths = _checks.check_lengths(name, "lengths", lengths, batch, points.shape[-2], points)
    allow_fewer = _checks.check_flag(name, "allow_fewer", allow_fewer)
    if not isinstance(generator, torch.Generator | None):
        raise TypeError(
            f"{name}: 'generator' must be a torch.Generator or None; got {type(generator).__name__}. "
            "For a seed: torch.Generator().manual_seed(0)."
        )
    if generator is not None and not isinstance(start, str):
        raise _checks.fail(name, "generator", "be None without start='random'", repr(generator))
    flat = points.reshape(_bridge.count_of(batch), *points.shape[-2:])
    lengths = _bridge.full_lengths(lengths, flat.shape[0], flat.shape[1], flat)
    counts, width = _integers("k", k, flat, batch), -1 if isinstance(k, Tensor) else int(k)
    if isinstance(start, str):
        if start != "random":
            raise _checks.fail(name, "start", "be an integer, a tensor of integers, or 'random'", repr(start))
        starts = _random_starts(lengths, generator)
    else:
        starts = _integers("start", start, flat, batch)
    chosen = _farthest(flat, lengths, counts, starts, width, allow_fewer)
    return chosen.reshape(*batch, chosen.shape[-1])


def _integers(name: str, value: int | Tensor, points: Tensor, batch: tuple[int, ...]) -> Tensor:
    """(B,) int64, one for each cloud."""
    if isinstance(value, Tensor):
        checked = _checks.check_lengths("farthest_point_sample", name, value, batch, points.shape[1], points)
        assert checked is not None
        return checked.reshape(points.shape[0])
    number = _checks.check_integer("farthest_point_sample", name, value, "be an integer of at least 0", 0)
    return torch.full((points.shape[0],), number, dtype=torch.int64, device=points.device)


def _random_starts(lengths: Tensor, generator: torch.Generator | None) -> Tensor:
    device = lengths.device if generator is None else generator.device
    share = torch.rand(lengths.shape, dtype=torch.float64, generator=generator, device=device)
    return (share.to(lengths.device) * lengths).to(torch.int64)


def _farthest_fake(
    points: Tensor, lengths: Tensor, counts: Tensor, starts: Tensor, width: int, allow_fewer: bool
) -> Tensor:
    if width < 0:
        width = torch.library.get_ctx().new_dynamic_size()
    return points.new_empty((points.shape[0], width), dtype=torch.int64)


@_bridge.register("farthest_point_sample", fake=_farthest_fake)
def _farthest(
    points: Tensor, lengths: Tensor, counts: Tensor, starts: Tensor, width: int, allow_fewer: bool
) -> Tensor:
    """(B, width), or (B, the largest of `counts`) if `width` is below 0."""
    batch, size, _ = points.shape
    _checks.check_picks(lengths, size, counts, starts, allow_fewer=allow_fewer)
    _checks.check_finite("farthest_point_sample", "points", points, lengths)
    if width < 0:
        width = int(counts.max()) if batch else 0
    chosen = torch.full((batch, width), -1, dtype=torch.int64)
    if chosen.numel() == 0 or size == 0:
        return chosen
    counts = torch.minimum(counts, lengths)
    points = _in_range(points, lengths)
    if size < _LARGE:
        axes = lanes(points)
        distance = _unset_distance(points, lengths, axes[0][0].numel())
        distances = distance.view(axes[0].shape), distance
        _bridge.launch(
            "sampling", "farthest", points.dtype, points, *axes, *distances, counts, starts, chosen
        )
        return chosen
    blocks = sort_into_blocks(points, lengths)
    sets = blocks.points, *lanes(blocks.points), blocks.order, blocks.box_lanes, blocks.group_lanes
    distance = _unset_distance(points, lengths, blocks.points.shape[1]).view(batch, -1, LANES)
    largest = (points.new_empty((batch, *x.shape[2:])) for x in (blocks.box_lanes, blocks.group_lanes))
    chosen_by = counts, starts, chosen
    _bridge.launch("sampling", "farthest_blocks", points.dtype, *sets, distance, *largest, *chosen_by)
    return chosen


def _in_range(points: Tensor, lengths: Tensor) -> Tensor:
    """The points; a cloud whose squared distances overflow or vanish times a power of two, which chooses the same."""
    if bool(_ordinary(_largest(points)).all()):
        return points
    padding = torch.arange(points.shape[1]) >= lengths[:, None]
    points = points.masked_fill(padding[..., None], 0)
    largest = _largest(points).double()
    exponent = torch.frexp(largest).exponent.masked_fill(_ordinary(largest), 0).to(torch.int64)
    half = ((1023 - exponent // 2) << 52).view(torch.float64)[:, None, None]  # 2^(-exponent / 2), by its bits
    return (points.double() * half * half).to(points.dtype)


def _largest(points: Tensor) -> Tensor:
    """(B,): the largest magnitude of a coordinate."""
    return points.flatten(1).abs().amax(1)


def _ordinary(largest: Tensor) -> Tensor:
    return (largest > 1e-12) & (largest < 1e18)


def _unset_distance(points: Tensor, lengths: Tensor, size: int) -> Tensor:
    """(B, size): +inf for points, and -1 in the padding, which is therefore never chosen."""
    return torch.where(torch.arange(size) < lengths[:, None], torch.inf, -1.0).to(points.dtype)


def lanes(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y and z of clouds (B, N, 3), each as (B, ceil(N / 16), 16), for kernels that load vectors of 16."""
    batch, size, _ = points.shape
    tiles = -(-size // LANES)
    by_axis = pad(points.detach().movedim(-1, 0), (0, tiles * LANES - size)).contiguous()
    x, y, z = by_axis.view(3, batch, tiles, LANES)
    return x, y, z
