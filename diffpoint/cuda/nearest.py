"""Nearest neighbours on CUDA tensors: every candidate is tried, and gradients are gathered instead of scattered."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint._common import share_within
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch
from diffpoint.cuda.values import count_bad_sets

_QUERIES, _CANDIDATES = 64, 32  # of a tile


@triton.jit
def _search(
    a, b, a_lengths, b_lengths, squared_distance, index, size_a, size_b,
    QUERIES: tl.constexpr, CANDIDATES: tl.constexpr,
):  # fmt: skip
    """A tile of queries against all candidates. Each lane keeps the nearest of its own candidates, so that the loop has
    no reduction; the lanes are compared at the end."""
    tiles = tl.cdiv(size_a, QUERIES)
    row = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * QUERIES + tl.arange(0, QUERIES)
    n = tl.minimum(tl.load(a_lengths + row), size_a).to(tl.int32)
    m = tl.minimum(tl.load(b_lengths + row), size_b).to(tl.int32)
    m = tl.where(tl.program_id(0) % tiles * QUERIES < n, m, 0)  # padding needs no search
    a += row * size_a * 3
    b += row * size_b * 3
    infinite = float("inf")
    ax = tl.load(a + i * 3, mask=i < n, other=0.0)[:, None]
    ay = tl.load(a + i * 3 + 1, mask=i < n, other=0.0)[:, None]
    az = tl.load(a + i * 3 + 2, mask=i < n, other=0.0)[:, None]
    least = tl.full((QUERIES, CANDIDATES), infinite, a.dtype.element_ty)
    winner = tl.full((QUERIES, CANDIDATES), 2147483647, tl.int32)  # the start of the nearest candidate's tile
    for start in range(0, m, CANDIDATES):
        j = start + tl.arange(0, CANDIDATES)
        dx = tl.load(b + j * 3, mask=j < m, other=infinite)[None, :] - ax
        dy = tl.load(b + j * 3 + 1, mask=j < m, other=infinite)[None, :] - ay
        dz = tl.load(b + j * 3 + 2, mask=j < m, other=infinite)[None, :] - az
        d = dx * dx + dy * dy + dz * dz
        closer = d < least
        least = tl.where(closer, d, least)
        winner = tl.where(closer, start, winner)
    nearest = tl.min(least, axis=1)
    # Of equal distances the lowest index wins; none where every distance overflows.
    candidates = winner + tl.arange(0, CANDIDATES)[None, :]
    tied = (least == nearest[:, None]) & (least < infinite)
    chosen = tl.min(tl.where(tied, candidates, 2147483647), axis=1)
    found = chosen < 2147483647
    inside = i < n
    at = row * size_a + i
    tl.store(squared_distance + at, tl.where(inside, nearest, 0.0), mask=i < size_a)
    tl.store(index + at, tl.where(inside & found, chosen, -1).to(tl.int64), mask=i < size_a)


@triton.jit
def _gradient(
    a, b, from_a, from_b, grad_from_a, grad_from_b, grad_a, size_a, size_b,
    OWN: tl.constexpr, OTHERS: tl.constexpr, QUERIES: tl.constexpr, CANDIDATES: tl.constexpr,
):  # fmt: skip
    """Gradient to a tile of `a`: of each point's own distance (OWN), and of the distances of the points of `b` to which
    it is the nearest (OTHERS). Atomic additions would be in another order in every run; here each point looks for its
    terms, which takes about as long as the search."""
    tiles = tl.cdiv(size_a, QUERIES)
    row = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * QUERIES + tl.arange(0, QUERIES)
    inside = i < size_a
    a += row * size_a * 3
    b += row * size_b * 3
    gx = tl.zeros((QUERIES,), a.dtype.element_ty)
    gy = tl.zeros((QUERIES,), a.dtype.element_ty)
    gz = tl.zeros((QUERIES,), a.dtype.element_ty)
    if OWN:
        target = tl.load(from_a + row * size_a + i, mask=inside, other=-1)
        own = inside & (target >= 0)
        weight = 2.0 * tl.load(grad_from_a + row * size_a + i, mask=own, other=0.0)
        to = b + target * 3
        gx = weight * (tl.load(a + i * 3, mask=own, other=0.0) - tl.load(to, mask=own, other=0.0))
        gy = weight * (tl.load(a + i * 3 + 1, mask=own, other=0.0) - tl.load(to + 1, mask=own, other=0.0))
        gz = weight * (tl.load(a + i * 3 + 2, mask=own, other=0.0) - tl.load(to + 2, mask=own, other=0.0))
    if OTHERS:
        sum_x = tl.zeros((QUERIES, CANDIDATES), a.dtype.element_ty)
        sum_y = tl.zeros((QUERIES, CANDIDATES), a.dtype.element_ty)
        sum_z = tl.zeros((QUERIES, CANDIDATES), a.dtype.element_ty)
        for start in range(0, size_b, CANDIDATES):
            j = start + tl.arange(0, CANDIDATES)
            k = tl.load(from_b + row * size_b + j, mask=j < size_b, other=-1).to(tl.int32)
            matched = k >= 0
            g = 2.0 * tl.load(grad_from_b + row * size_b + j, mask=matched, other=0.0)
            dx = g * (
                tl.load(a + k * 3, mask=matched, other=0.0) - tl.load(b + j * 3, mask=matched, other=0.0)
            )
            dy = g * (
                tl.load(a + k * 3 + 1, mask=matched, other=0.0)
                - tl.load(b + j * 3 + 1, mask=matched, other=0.0)
            )
            dz = g * (
                tl.load(a + k * 3 + 2, mask=matched, other=0.0)
                - tl.load(b + j * 3 + 2, mask=matched, other=0.0)
            )
            mine = k[None, :] == i[:, None]
            sum_x += tl.where(mine, dx[None, :], 0.0)
            sum_y += tl.where(mine, dy[None, :], 0.0)
            sum_z += tl.where(mine, dz[None, :], 0.0)
        gx += tl.sum(sum_x, axis=1)
        gy += tl.sum(sum_y, axis=1)
        gz += tl.sum(sum_z, axis=1)
    at = row * size_a * 3 + i * 3
    tl.store(grad_a + at, gx, mask=inside)
    tl.store(grad_a + at + 1, gy, mask=inside)
    tl.store(grad_a + at + 2, gz, mask=inside)


def nearest(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor) -> tuple[Tensor, Tensor]:
    """As the operator."""
    result = _nearest(a, b, a_lengths, b_lengths)
    _check("nearest", a, b, a_lengths, b_lengths, smallest=0)
    return result


def nearest_both(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As the operator."""
    result = *_nearest(a, b, a_lengths, b_lengths), *_nearest(b, a, b_lengths, a_lengths)
    _check("chamfer_distance", a, b, a_lengths, b_lengths, smallest=1)
    return result


def shares_within(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    from_a, _ = _nearest(a, b, a_lengths, b_lengths)
    from_b, _ = _nearest(b, a, b_lengths, a_lengths)
    _check("f_score", a, b, a_lengths, b_lengths, smallest=1)
    return share_within(from_a, a_lengths, threshold), share_within(from_b, b_lengths, threshold)


def nearest_backward(
    a: Tensor, b: Tensor, index: Tensor, grad_squared_distance: Tensor
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    return (
        _gradient_to(a, b, index, None, grad_squared_distance, None),
        _gradient_to(b, a, None, index, None, grad_squared_distance),
    )


def nearest_both_backward(
    a: Tensor, b: Tensor, from_a: Tensor, from_b: Tensor, grad_from_a: Tensor, grad_from_b: Tensor
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    return (
        _gradient_to(a, b, from_a, from_b, grad_from_a, grad_from_b),
        _gradient_to(b, a, from_b, from_a, grad_from_b, grad_from_a),
    )


def _nearest(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor) -> tuple[Tensor, Tensor]:
    squared_distance = a.new_empty(a.shape[:2])
    index = torch.empty_like(squared_distance, dtype=torch.int64)
    if index.numel():
        programs = a.shape[0] * triton.cdiv(a.shape[1], _QUERIES)
        inputs = a, b, a_lengths, b_lengths
        sizes = a.shape[1], b.shape[1]
        launch(_search, programs, *inputs, squared_distance, index, *sizes, _QUERIES, _CANDIDATES)
    return squared_distance, index


def _gradient_to(
    a: Tensor,
    b: Tensor,
    from_a: Tensor | None,
    from_b: Tensor | None,
    grad_from_a: Tensor | None,
    grad_from_b: Tensor | None,
) -> Tensor:
    grad_a = torch.empty_like(a)
    if a.numel() and b.numel():
        programs = a.shape[0] * triton.cdiv(a.shape[1], _QUERIES)
        own, others = from_a is not None, from_b is not None
        unused = a  # some pointer
        given = (unused if x is None else x for x in (from_a, from_b, grad_from_a, grad_from_b))
        launch(
            _gradient, programs, a, b, *given, grad_a, a.shape[1], b.shape[1], own, others, _QUERIES, _CANDIDATES
        )  # fmt: skip
    else:
        grad_a.zero_()
    return grad_a


def _check(
    function: str, a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, *, smallest: int
) -> None:
    """The values of two batches of sets, as `_checks.check_sets`."""
    count_bad_sets(function, a, b, a_lengths, b_lengths, smallest=smallest)
    errors.settle(a, lambda: _checks.check_sets(function, a, b, a_lengths, b_lengths, smallest=smallest))
