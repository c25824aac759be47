"""Farthest point sampling on CUDA tensors: one program per cloud, with its distances in registers if they fit."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch
from diffpoint.cuda.values import count_bad_points

_REGISTERS = 8192  # points whose distances and coordinates one program keeps in registers
_TILE = 4096  # points at once where they do not


@triton.jit
def _farthest(points, lengths, chosen, size, picks, start, BLOCK: tl.constexpr):
    cloud = tl.program_id(0).to(tl.int64)
    points += cloud * size * 3
    length = tl.minimum(tl.load(lengths + cloud), size)
    i = tl.arange(0, BLOCK)
    inside = i < length
    x = tl.load(points + i * 3, mask=inside, other=0.0)
    y = tl.load(points + i * 3 + 1, mask=inside, other=0.0)
    z = tl.load(points + i * 3 + 2, mask=inside, other=0.0)
    distance = tl.where(inside, float("inf"), -1.0).to(x.dtype)
    current = tl.minimum(start, size - 1)
    for pick in range(picks):
        tl.store(chosen + cloud * picks + pick, current.to(tl.int64))
        dx = x - tl.load(points + current * 3)
        dy = y - tl.load(points + current * 3 + 1)
        dz = z - tl.load(points + current * 3 + 2)
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
        current = tl.argmax(distance, axis=0)  # of equal distances the first


@triton.jit
def _farthest_of_many(points, lengths, distance, chosen, size, picks, start, TILE: tl.constexpr):
    """As `_farthest`, with the distances in memory. Lanes keep the best of their own points until the end of a pass."""
    cloud = tl.program_id(0).to(tl.int64)
    points += cloud * size * 3
    distance += cloud * size
    length = tl.minimum(tl.load(lengths + cloud), size).to(tl.int32)
    dtype: tl.constexpr = points.dtype.element_ty
    current = tl.minimum(start, size - 1)
    for pick in range(picks):
        tl.store(chosen + cloud * picks + pick, current.to(tl.int64))
        px = tl.load(points + current * 3)
        py = tl.load(points + current * 3 + 1)
        pz = tl.load(points + current * 3 + 2)
        best = tl.full((TILE,), -1.0, dtype)
        tile = tl.zeros((TILE,), tl.int32)
        for first in range(0, length, TILE):
            i = first + tl.arange(0, TILE)
            inside = i < length
            dx = tl.load(points + i * 3, mask=inside, other=0.0) - px
            dy = tl.load(points + i * 3 + 1, mask=inside, other=0.0) - py
            dz = tl.load(points + i * 3 + 2, mask=inside, other=0.0) - pz
            before = tl.load(distance + i, mask=inside & (pick > 0), other=float("inf"))
            least = tl.minimum(before, dx * dx + dy * dy + dz * dz)
            tl.store(distance + i, least, mask=inside)
            farther = inside & (least > best)
            best = tl.where(farther, least, best)
            tile = tl.where(farther, first, tile)
        farthest = tl.max(best, axis=0)
        candidates = tl.where(best == farthest, tile + tl.arange(0, TILE), 2147483647)
        current = tl.minimum(tl.min(candidates, axis=0), size - 1)


def farthest_point_sample(points: Tensor, lengths: Tensor, k: int, start: int) -> Tensor:
    """As the operator."""
    batch, size, _ = points.shape
    chosen = lengths.new_empty((batch, k))
    function = "farthest_point_sample"

    def name_it() -> None:
        _checks.check_picks(lengths, size, k, start)
        _checks.check_finite(function, "points", points, lengths)

    if chosen.numel():
        if size == 0:
            name_it()
        count_bad_points(function, "points", points, lengths, smallest=max(k, start + 1))
        if size <= _REGISTERS:
            block = max(64, triton.next_power_of_2(size))
            warps = 4 if block <= 1024 else 8 if block <= 2048 else 16
            launch(_farthest, batch, points, lengths, chosen, size, k, start, block, warps=warps)
        else:
            distance = points.new_empty((batch, size))
            inputs = points, lengths, distance, chosen, size, k, start
            launch(_farthest_of_many, batch, *inputs, _TILE, warps=16)
        errors.settle(points, name_it)
    return chosen
