"""The soft matching of the paper's released code on CUDA tensors: one launch for each step of each level.

Sums over the other set are taken by each point for itself, lane by lane, so that the bits are the same in every run.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch
from diffpoint.cuda.values import count_bad_sets

_LEVELS = tl.constexpr(10)  # exponents -4^7, -4^6, ..., -4^-1, and 0
_POINTS, _OTHERS = 64, 32  # of a tile


@triton.jit
def _own_points(points, lengths, size, POINTS: tl.constexpr):
    """Of this program: the pair, indices, their number that counts, and coordinates, 0 in the padding."""
    tiles = tl.cdiv(size, POINTS)
    row = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    inside = i < tl.minimum(tl.load(lengths + row), size)
    at = (row * size + i) * 3
    x = tl.load(points + at, mask=inside, other=0.0)
    y = tl.load(points + at + 1, mask=inside, other=0.0)
    z = tl.load(points + at + 2, mask=inside, other=0.0)
    return row, i, x[:, None], y[:, None], z[:, None]


@triton.jit
def _weights(x, y, z, others, mass, at, inside, level):
    """Differences to a tile of the other set, squared distances, and weights times masses."""
    dx = x - tl.load(others + at * 3, mask=inside, other=0.0)[None, :]
    dy = y - tl.load(others + at * 3 + 1, mask=inside, other=0.0)[None, :]
    dz = z - tl.load(others + at * 3 + 2, mask=inside, other=0.0)[None, :]
    squared = dx * dx + dy * dy + dz * dz
    scale = (1 << (18 - 2 * level)).to(squared.dtype) * -0.0625
    scale = tl.where(level == _LEVELS - 1, 0.0, scale)
    return dx, dy, dz, squared, tl.exp(squared * scale) * tl.load(mass + at, mask=inside, other=0.0)[None, :]


@triton.jit(do_not_specialize=["level"])
def _absorb(
    points, others, lengths, other_lengths, mass, other_mass, result, size, other_size, level,
    OFFER: tl.constexpr, POINTS: tl.constexpr, OTHERS: tl.constexpr,
):  # fmt: skip
    """What each point of `a` offers per unit of weighted demand around it (OFFER), or what each point of `b` takes of
    the offers: no more than its demand, which is reduced."""
    row, i, x, y, z = _own_points(points, lengths, size, POINTS)
    count = tl.minimum(tl.load(other_lengths + row), other_size).to(tl.int32)
    sums = tl.zeros((POINTS, OTHERS), points.dtype.element_ty)
    for start in range(0, count, OTHERS):
        j = start + tl.arange(0, OTHERS)
        _, _, _, _, weight = _weights(x, y, z, others, other_mass, row * other_size + j, j < count, level)
        sums += weight
    total = tl.sum(sums, axis=1)
    at = row * size + i
    own = tl.load(mass + at, mask=i < size, other=0.0)
    if OFFER:
        tl.store(result + at, own / (total + 1e-9), mask=i < size)
    else:
        offered = total * own
        share = own / (offered + 1e-9)
        tl.store(result + at, tl.where(share < 1.0, share, 1.0) * own, mask=i < size)
        rest = own - offered
        tl.store(mass + at, tl.where(rest > 0.0, rest, 0.0), mask=i < size)


@triton.jit(do_not_specialize=["level"])
def _move(
    points, others, lengths, other_lengths, mass, other_mass, supply, cost, gradient, size, other_size, level,
    TAKE: tl.constexpr, GRADIENT: tl.constexpr, POINTS: tl.constexpr, OTHERS: tl.constexpr,
):  # fmt: skip
    """Adds a level to the cost of each point, takes what it gave from its supply (TAKE), and adds to its gradient the
    unit vectors from the other set's points, weighted by the match (GRADIENT)."""
    row, i, x, y, z = _own_points(points, lengths, size, POINTS)
    count = tl.minimum(tl.load(other_lengths + row), other_size).to(tl.int32)
    given = tl.zeros((POINTS, OTHERS), points.dtype.element_ty)
    way, gx, gy, gz = given, given, given, given
    for start in range(0, count, OTHERS):
        j = start + tl.arange(0, OTHERS)
        dx, dy, dz, squared, weight = _weights(
            x, y, z, others, other_mass, row * other_size + j, j < count, level
        )
        distance = tl.sqrt(squared)
        if TAKE:
            given += weight
            way += weight * distance
        if GRADIENT:
            share = weight / tl.where(distance > 1e-20, distance, 1e-20)
            gx += share * dx
            gy += share * dy
            gz += share * dz
    at = row * size + i
    own = tl.load(mass + at, mask=i < size, other=0.0)
    if TAKE:
        before = tl.load(cost + at, mask=i < size, other=0.0)
        tl.store(cost + at, before + (tl.sum(way, axis=1) * own).to(tl.float64), mask=i < size)
        left = tl.load(supply + at, mask=i < size, other=0.0) - tl.sum(given, axis=1) * own
        tl.store(supply + at, tl.where(left > 0.0, left, 0.0), mask=i < size)
    if GRADIENT:
        gradient += at * 3
        old_x = tl.load(gradient, mask=i < size, other=0.0)
        old_y = tl.load(gradient + 1, mask=i < size, other=0.0)
        old_z = tl.load(gradient + 2, mask=i < size, other=0.0)
        tl.store(gradient, old_x + tl.sum(gx, axis=1) * own, mask=i < size)
        tl.store(gradient + 1, old_y + tl.sum(gy, axis=1) * own, mask=i < size)
        tl.store(gradient + 2, old_z + tl.sum(gz, axis=1) * own, mask=i < size)


def approxmatch(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, with_gradient: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """As the operator."""
    count_bad_sets("approxmatch", a, b, a_lengths, b_lengths, smallest=1)
    grad_a, grad_b = torch.zeros_like(a), torch.zeros_like(b)
    cost = a.new_zeros(a.shape[:2], dtype=torch.float64)
    if a.numel() and b.numel():
        supply, demand = _masses(a, a_lengths, b_lengths), _masses(b, b_lengths, a_lengths)
        offer, request = torch.empty_like(supply), torch.empty_like(demand)
        from_a = a, b, a_lengths, b_lengths
        from_b = b, a, b_lengths, a_lengths
        sizes_a, sizes_b = (a.shape[1], b.shape[1]), (b.shape[1], a.shape[1])
        programs_a, programs_b = (len(a) * triton.cdiv(size, _POINTS) for size in sizes_a)
        tile = _POINTS, _OTHERS
        unused = cost  # some pointer
        for level in range(_LEVELS.value):
            launch(_absorb, programs_a, *from_a, supply, demand, offer, *sizes_a, level, True, *tile)
            launch(_absorb, programs_b, *from_b, demand, offer, request, *sizes_b, level, False, *tile)
            masses = offer, request, supply, cost, grad_a
            launch(_move, programs_a, *from_a, *masses, *sizes_a, level, True, with_gradient, *tile)
            if with_gradient:
                masses = request, offer, unused, unused, grad_b
                launch(_move, programs_b, *from_b, *masses, *sizes_b, level, False, True, *tile)
    total = cost.sum(1)
    errors.counter(a, "approxmatch", "a", "extent").add_((~torch.isfinite(total)).sum())

    def name_it() -> None:
        _checks.check_sets("approxmatch", a, b, a_lengths, b_lengths, smallest=1)
        _checks.check_cost("approxmatch", total)

    errors.settle(a, name_it)
    return total.to(a.dtype), grad_a, grad_b


def _masses(points: Tensor, lengths: Tensor, other_lengths: Tensor) -> Tensor:
    """(B, N): each point's mass, 0 in the padding."""
    mass = (other_lengths // lengths.clamp(min=1)).clamp(min=1)
    inside = torch.arange(points.shape[1], device=points.device) < lengths[:, None]
    return torch.where(inside, mass[:, None], 0).to(points.dtype)
