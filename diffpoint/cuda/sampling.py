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
def _limits(lengths, counts, starts, too_many, cloud, size, allow_fewer):
    """Length, number of points to choose and first point of a cloud, within what it has.

    Counts numbers and first points that are not; `count_bad_points` has counted the lengths.
    """
    length = tl.load(lengths + cloud)
    count = tl.load(counts + cloud)
    start = tl.load(starts + cloud)
    if count < 0 or (count > length and allow_fewer == 0) or start < 0 or start > tl.maximum(length - 1, 0):
        tl.atomic_add(too_many, 1)
    length = tl.maximum(tl.minimum(length, size), 0)
    start = tl.maximum(tl.minimum(start, length - 1), 0)
    return length.to(tl.int32), tl.minimum(count, length).to(tl.int32), start.to(tl.int32)


@triton.jit
def _shrink(largest):
    """A power of two; coordinates of which `largest` is the largest magnitude are to be multiplied by it twice.

    It is 1 unless their squared distances may overflow or vanish; the product is then near 1. A scaled cloud has the
    same farthest points.
    """
    if largest.dtype == tl.float32:
        exponent = ((largest.to(tl.int32, bitcast=True) >> 23) & 255) - 127
        half = ((127 - exponent // 2) << 23).to(tl.float32, bitcast=True)
    else:
        exponent = ((largest.to(tl.int64, bitcast=True) >> 52) & 2047) - 1023
        half = ((1023 - exponent // 2) << 52).to(tl.float64, bitcast=True)
    return tl.where((largest > 1e-12) & (largest < 1e18), 1.0, half).to(largest.dtype)


@triton.jit
def _farthest(
    points,
    lengths,
    counts,
    starts,
    chosen,
    too_many,
    size,
    width,
    allow_fewer,
    BLOCK: tl.constexpr,
):
    cloud = tl.program_id(0).to(tl.int64)
    length, count, current = _limits(lengths, counts, starts, too_many, cloud, size, allow_fewer)
    points += cloud * size * 3
    i = tl.arange(0, BLOCK)
    inside = i < length
    x = tl.load(points + i * 3, mask=inside, other=0.0)
    y = tl.load(points + i * 3 + 1, mask=inside, other=0.0)
    z = tl.load(points + i * 3 + 2, mask=inside, other=0.0)
    half = _shrink(tl.max(tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z)), axis=0))
    x = x * half * half
    y = y * half * half
    z = z * half * half
    distance = tl.where(inside, float("inf"), -1.0).to(x.dtype)
    for pick in range(tl.minimum(count, width)):
        tl.store(chosen + cloud * width + pick, current.to(tl.int64))
        dx = x - tl.load(points + current * 3) * half * half
        dy = y - tl.load(points + current * 3 + 1) * half * half
        dz = z - tl.load(points + current * 3 + 2) * half * half
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
        distance = tl.where(i == current, -1.0, distance)  # not chosen twice
        current = tl.argmax(distance, axis=0)  # of equal distances the first


@triton.jit
def _farthest_of_many(
    points, lengths, counts, starts, distance, chosen, too_many, size, width, allow_fewer,
    TILE: tl.constexpr,
):  # fmt: skip
    """As `_farthest`, with the distances in memory. Lanes keep the best of their own points until the end of a pass."""
    cloud = tl.program_id(0).to(tl.int64)
    length, count, current = _limits(lengths, counts, starts, too_many, cloud, size, allow_fewer)
    points += cloud * size * 3
    distance += cloud * size
    dtype: tl.constexpr = points.dtype.element_ty
    largest = tl.zeros((TILE,), dtype)
    for first in range(0, length * 3, TILE):
        i = first + tl.arange(0, TILE)
        largest = tl.maximum(largest, tl.abs(tl.load(points + i, mask=i < length * 3, other=0.0)))
    half = _shrink(tl.max(largest, axis=0))
    for pick in range(tl.minimum(count, width)):
        tl.store(chosen + cloud * width + pick, current.to(tl.int64))
        px = tl.load(points + current * 3) * half * half
        py = tl.load(points + current * 3 + 1) * half * half
        pz = tl.load(points + current * 3 + 2) * half * half
        best = tl.full((TILE,), -1.0, dtype)
        tile = tl.zeros((TILE,), tl.int32)
        for first in range(0, length, TILE):
            i = first + tl.arange(0, TILE)
            inside = i < length
            dx = tl.load(points + i * 3, mask=inside, other=0.0) * half * half - px
            dy = tl.load(points + i * 3 + 1, mask=inside, other=0.0) * half * half - py
            dz = tl.load(points + i * 3 + 2, mask=inside, other=0.0) * half * half - pz
            before = tl.load(distance + i, mask=inside & (pick > 0), other=float("inf"))
            least = tl.minimum(before, dx * dx + dy * dy + dz * dz)
            least = tl.where(i == current, -1.0, least)  # not chosen twice
            tl.store(distance + i, least, mask=inside)
            farther = inside & (least > best)
            best = tl.where(farther, least, best)
            tile = tl.where(farther, first, tile)
        farthest = tl.max(best, axis=0)
        candidates = tl.where(best == farthest, tile + tl.arange(0, TILE), 2147483647)
        current = tl.minimum(tl.min(candidates, axis=0), size - 1)


def farthest_point_sample(
    points: Tensor, lengths: Tensor, counts: Tensor, starts: Tensor, width: int, allow_fewer: bool
) -> Tensor:
    """As the operator. With a `width` below 0 it waits for the GPU, for the largest of `counts`."""
    batch, size, _ = points.shape
    function = "farthest_point_sample"
    if width < 0:
        width = int(counts.max()) if batch else 0
    chosen = lengths.new_full((batch, width), -1)
    if batch:
        count_bad_points(function, "points", points, lengths)
        too_many = errors.counter(points, function, "k", "picks")
        inputs = points, lengths, counts, starts
        sizes = size, width, int(allow_fewer)
        if size <= _REGISTERS:
            block = max(64, triton.next_power_of_2(size))
            warps = 4 if block <= 1024 else 8 if block <= 2048 else 16
            launch(_farthest, batch, *inputs, chosen, too_many, *sizes, block, warps=warps)
        else:
            distance = points.new_empty((batch, size))
            launch(_farthest_of_many, batch, *inputs, distance, chosen, too_many, *sizes, _TILE, warps=16)

    def name_it() -> None:
        _checks.check_picks(lengths, size, counts, starts, allow_fewer=allow_fewer)
        _checks.check_finite(function, "points", points, lengths)

    errors.settle(points, name_it)
    return chosen
