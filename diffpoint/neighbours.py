"""The k nearest neighbours."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint.blocks import LANES, sort_into_blocks
from diffpoint.distances import add_nearest_gradients, nearest_setup, paired_sets

_WORKERS = 256  # runs of queries, more than any number of threads; each has its own place for what it finds
_LARGE_K = 256  # above this, sorting every row of distances is faster
_SORTED_AT_ONCE = 2**22  # distances


class Neighbours(NamedTuple):
    """For each point of the first set, its nearest points of the second, the nearest first."""

    squared_distance: Tensor
    """(*B, N, k); +inf where there are fewer than k neighbours; 0 in the padding of `a`."""
    index: Tensor
    """(*B, N, k) int64 into `b`; -1 where there are fewer than k neighbours and in the padding of `a`."""


def knn(
    a: Tensor,
    b: Tensor,
    k: int,
    *,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
    radius: float | None = None,
    exclude_self: bool = False,
) -> Neighbours:
    """The k smallest |a_i - b_j|^2 over j, ascending, and their j; exact, ties to the lower index.

    Gather the neighbours themselves with the index: `b[index]` for single clouds; `torch.take_along_dim` for batches.

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        k: how many neighbours, at least 1; may exceed M.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.
        radius: only neighbours at a distance of at most this, in the unit of the clouds; default any.
        exclude_self: a point is not its own neighbour. `b` must then hold the points of `a`; other points at the same
            place remain neighbours.

    Gradients: of `squared_distance` to `a` and `b`, with the neighbours held fixed; zero where there is no neighbour.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, k or radius out of range, lengths out of range, NaN or
            infinite coordinates, or other points in `b` with `exclude_self`.

    Example:
        >>> a = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
        >>> knn(a, a, 2, exclude_self=True).index.tolist()
        [[1, 2], [0, 2], [1, 0]]
    """
    a3, b3, la, lb, _ = paired_sets("knn", a, b, a_lengths, b_lengths)
    k = _checks.check_integer("knn", "k", k, "be a positive integer", 1)
    reach = torch.inf
    if radius is not None:
        reach = _checks.check_number("knn", "radius", radius, "be a number of at least 0", lambda r: r >= 0)
    exclude_self = _checks.check_flag("knn", "exclude_self", exclude_self)
    if exclude_self:
        _checks.check_shape(
            "knn", "b", b, tuple(a.shape), "With exclude_self=True, pass the points of 'a' again."
        )
    squared_distance, index = _knn(a3, b3, la, lb, k, reach, exclude_self)
    shape = (*a.shape[:-1], k)
    return Neighbours(squared_distance.reshape(shape), index.reshape(shape))


def _knn_fake(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, k: int, radius: float, exclude_self: bool
):
    shape = (*a.shape[:2], k)
    return a.new_empty(shape), a.new_empty(shape, dtype=torch.int64)


def _knn_gradient(ctx, grad_squared_distance: Tensor | None, _grad_index):
    if grad_squared_distance is None:
        return (None,) * 7
    a, b, index = ctx.saved_tensors
    return *_knn_backward(a, b, index, grad_squared_distance), None, None, None, None, None


@_bridge.register("knn", fake=_knn_fake, backward=_knn_gradient, setup=nearest_setup)
def _knn(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, k: int, radius: float, exclude_self: bool
) -> tuple[Tensor, Tensor]:
    _checks.check_sets("knn", a, b, a_lengths, b_lengths, smallest=0)
    if exclude_self:
        _check_same_points(a, b, a_lengths, b_lengths)
    # The largest square that counts; squares that overflow do not.
    largest = min(float(a.new_tensor(radius).square()), torch.finfo(a.dtype).max)
    if a.numel() == 0 or b.numel() == 0 or k > _LARGE_K:
        return _sort_all(a, b, a_lengths, b_lengths, k, largest, exclude_self)
    x, y = sort_into_blocks(a, a_lengths), sort_into_blocks(b, b_lengths)
    squared_distance = a.new_empty((*a.shape[:2], k))
    index = torch.empty(squared_distance.shape, dtype=torch.int64)
    workers = min(_WORKERS, a.shape[0] * -(-a.shape[1] // LANES))
    keys = torch.empty((workers, k, LANES), dtype=torch.int64)
    sources = torch.empty(
        (workers, k, LANES) if a.dtype == torch.float64 else (1, 1, LANES), dtype=torch.int32
    )
    sets = x.points, x.order, y.points, y.order, y.boxes, y.box_lanes, y.groups, a_lengths, b_lengths
    outputs = squared_distance, index, largest, int(exclude_self)
    _bridge.launch("neighbours", "forward", a.dtype, *sets, keys, keys, sources, sources, *outputs)
    return squared_distance, index


def _check_same_points(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor) -> None:
    padding = torch.arange(a.shape[1]) >= a_lengths[:, None]
    if not (torch.equal(a_lengths, b_lengths) and bool(((a == b).all(-1) | padding).all())):
        raise _checks.fail(
            "knn",
            "b",
            "hold the points of 'a' with exclude_self=True",
            "others",
            "Pass the same cloud (and lengths) twice.",
        )


def _sort_all(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, k: int, largest: float, exclude_self: bool
) -> tuple[Tensor, Tensor]:
    """By sorting all distances of some queries at a time, with the same bits as the kernel."""
    squared_distance = a.new_full((*a.shape[:2], k), torch.inf)
    index = torch.full(squared_distance.shape, -1, dtype=torch.int64)
    padding = torch.arange(b.shape[1]) >= b_lengths[:, None]
    rows = max(1, _SORTED_AT_ONCE // max(1, b.shape[0] * b.shape[1]))
    for first in range(0, a.shape[1] if b.numel() else 0, rows):
        part = slice(first, first + rows)
        x, y, z = (a[:, part, None] - b[:, None]).square().unbind(-1)
        d = x + y + z
        d.masked_fill_(padding[:, None] | ~(d <= largest), torch.inf)
        if exclude_self:
            d[:, :, part].diagonal(dim1=1, dim2=2).fill_(torch.inf)
        ordered, order = d.sort(dim=-1, stable=True)
        squared_distance[:, part, : d.shape[-1]] = ordered[..., :k]
        index[:, part, : d.shape[-1]] = order[..., :k].masked_fill(ordered[..., :k].isinf(), -1)
    no_query = (torch.arange(a.shape[1]) >= a_lengths[:, None])[..., None]
    return squared_distance.masked_fill_(no_query, 0), index.masked_fill_(no_query, -1)


@_bridge.register(
    "knn_backward",
    fake=lambda a, b, index, grad_squared_distance: (a.new_empty(a.shape), b.new_empty(b.shape)),
)
def _knn_backward(
    a: Tensor, b: Tensor, index: Tensor, grad_squared_distance: Tensor
) -> tuple[Tensor, Tensor]:
    grad_a, grad_b = a.new_zeros(a.shape), b.new_zeros(b.shape)
    add_nearest_gradients(a, b, index.flatten(1), grad_squared_distance.flatten(1), grad_a, grad_b)
    return grad_a, grad_b
