"""Soft splatting on CUDA tensors: pixels gather from the points, in the points' order, and points from the pixels."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint._common import least_fade
from diffpoint.cuda import errors
from diffpoint.cuda.launch import bits_of, launch, real

_POINTS = 128  # of a program of the backward pass
_SIDE = 8  # of the square of pixels of a program of the forward pass
_CANDIDATES = 32  # points at once there


@triton.jit
def _gather(
    pixels, point_depth, lengths, depth, coverage, nearest, weight, not_in_range,
    views, count, height, width, radius_bits, softness_bits, least_bits, SIDE: tl.constexpr, CANDIDATES: tl.constexpr,
):  # fmt: skip
    """A square of pixels against all points of the view; candidates whose disc misses the square are passed over.

    Each pixel has several lanes, which share the points among them and keep weights relative to the nearest depth that
    they have met; at the end they are brought to that of the pixel.
    """
    across = tl.cdiv(width, SIDE)
    squares = tl.cdiv(height, SIDE) * across
    view = (tl.program_id(0) // squares).to(tl.int64)
    square = tl.program_id(0) % squares
    p = tl.arange(0, SIDE * SIDE)
    row = square // across * SIDE + p // SIDE
    column = square % across * SIDE + p % SIDE
    dtype: tl.constexpr = point_depth.dtype.element_ty
    infinite = float("inf")
    radius = real(radius_bits, dtype)
    softness = real(softness_bits, dtype)
    least = real(least_bits, dtype)
    length = tl.load(lengths + view // views)
    if square == 0 and view % views == 0 and (length < 0 or length > count):
        tl.atomic_add(not_in_range, 1)
    length = tl.minimum(length, count).to(tl.int32)
    left = (square % across * SIDE).to(dtype) - radius
    top = (square // across * SIDE).to(dtype) - radius
    right = left + SIDE + 2.0 * radius
    bottom = top + SIDE + 2.0 * radius
    front = tl.full((SIDE * SIDE, CANDIDATES), infinite, dtype)
    total = tl.zeros((SIDE * SIDE, CANDIDATES), dtype)
    weighted = tl.zeros((SIDE * SIDE, CANDIDATES), dtype)
    covered = tl.zeros((SIDE * SIDE, CANDIDATES), dtype)
    for start in range(0, length, CANDIDATES):
        i = start + tl.arange(0, CANDIDATES)
        at = view * count + i
        u = tl.load(pixels + 2 * at, mask=i < length, other=infinite)
        v = tl.load(pixels + 2 * at + 1, mask=i < length, other=infinite)
        d = tl.load(point_depth + at, mask=i < length, other=-1.0)
        reaches = (d > 0.0) & (u > left) & (u < right) & (v > top) & (v < bottom)
        if tl.max(reaches.to(tl.int32), axis=0) > 0:
            du = (column[:, None].to(dtype) + 0.5 - tl.where(reaches, u, 0.0)[None, :]) / radius
            dv = (row[:, None].to(dtype) + 0.5 - tl.where(reaches, v, 0.0)[None, :]) / radius
            fade = 1.0 - du * du - dv * dv
            hit = reaches[None, :] & (fade > least)
            footprint = tl.where(hit, fade * fade, 0.0)
            z = d[None, :]
            leads = hit & (z < front)
            behind = tl.exp(-tl.abs(z - tl.where(front < infinite, front, z)) / softness)
            behind = tl.where(front < infinite, behind, 0.0)
            kept = tl.where(leads, behind, 1.0)
            gained = footprint * tl.where(leads, 1.0, tl.where(hit, behind, 0.0))
            total = total * kept + gained
            weighted = weighted * kept + gained * z
            covered += footprint
            front = tl.where(leads, z, front)
    foremost = tl.min(front, axis=1)
    some = front < infinite
    kept = tl.exp(-tl.where(some, front - tl.where(some, foremost[:, None], 0.0), 0.0) / softness)
    kept = tl.where(some, kept, 0.0)
    sum_of_weights = tl.sum(total * kept, axis=1)
    sum_of_depths = tl.sum(weighted * kept, axis=1)
    filled = sum_of_weights > 0.0
    mean = tl.where(filled, sum_of_depths / tl.where(filled, sum_of_weights, 1.0), infinite)
    inside = (row < height) & (column < width)
    at = view * height * width + row * width + column
    tl.store(depth + at, mean, mask=inside)
    tl.store(coverage + at, tl.sum(covered, axis=1), mask=inside)
    tl.store(nearest + at, foremost, mask=inside)
    tl.store(weight + at, sum_of_weights, mask=inside)


@triton.jit
def _to_points(
    pixels, point_depth, lengths, depth, nearest, weight, grad_depth, grad_coverage, grad_pixels, grad_point_depth,
    views, count, height, width, radius_bits, softness_bits, least_bits, reach, POINTS: tl.constexpr,
):  # fmt: skip
    """Some points of a view gather from the pixels of their discs."""
    tiles = tl.cdiv(count, POINTS)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    dtype: tl.constexpr = point_depth.dtype.element_ty
    radius = real(radius_bits, dtype)
    softness = real(softness_bits, dtype)
    least = real(least_bits, dtype)
    at = view * count + i
    inside = (i < count) & (i < tl.load(lengths + view // views))
    u = tl.load(pixels + 2 * at, mask=inside, other=float("inf"))
    v = tl.load(pixels + 2 * at + 1, mask=inside, other=float("inf"))
    d = tl.load(point_depth + at, mask=inside, other=-1.0)
    near = (d > 0.0) & (u + radius > 0.0) & (u - radius < width) & (v + radius > 0.0) & (v - radius < height)
    u = tl.where(near, u, 0.0)
    v = tl.where(near, v, 0.0)
    own_column = tl.floor(u).to(tl.int32)
    own_row = tl.floor(v).to(tl.int32)
    gu = tl.zeros((POINTS,), dtype)
    gv = tl.zeros((POINTS,), dtype)
    gd = tl.zeros((POINTS,), dtype)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            row = own_row + down
            column = own_column + across
            du = (column.to(dtype) + 0.5 - u) / radius
            dv = (row.to(dtype) + 0.5 - v) / radius
            fade = 1.0 - du * du - dv * dv
            hit = near & (row >= 0) & (row < height) & (column >= 0) & (column < width) & (fade > least)
            p = view * height * width + row * width + column
            g = tl.load(grad_coverage + p, mask=hit, other=0.0)
            share = tl.exp(tl.where(hit, tl.load(nearest + p, mask=hit, other=0.0) - d, 0.0) / softness)
            counts = hit & (share > 0.0)  # else 0 times infinity is possible
            pull = tl.load(grad_depth + p, mask=counts, other=0.0) * tl.where(counts, share, 0.0)
            pull = pull / tl.load(weight + p, mask=counts, other=1.0)
            off = d - tl.load(depth + p, mask=counts, other=0.0)
            g += tl.where(counts, pull * off, 0.0)
            gd += tl.where(counts, pull * fade * fade * (1.0 - off / softness), 0.0)
            gu += tl.where(hit, g * fade * du, 0.0)
            gv += tl.where(hit, g * fade * dv, 0.0)
    # The footprint is fade^2, and fade falls by 2 du / radius for each pixel.
    tl.store(grad_pixels + 2 * at, gu * 4.0 / radius, mask=i < count)
    tl.store(grad_pixels + 2 * at + 1, gv * 4.0 / radius, mask=i < count)
    tl.store(grad_point_depth + at, gd, mask=i < count)


def soft_splat(
    pixels: Tensor,
    point_depth: Tensor,
    lengths: Tensor,
    height: int,
    width: int,
    radius: float,
    softness: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As the operator."""
    batch, views, count = point_depth.shape
    shape = batch, views, height, width
    if point_depth.numel() == 0 or height * width == 0:
        depth, coverage, nearest, weight = (
            point_depth.new_full(shape, x) for x in (math.inf, 0.0, math.inf, 0.0)
        )
        return depth, coverage, nearest, weight
    depth, coverage, nearest, weight = (point_depth.new_empty(shape) for _ in range(4))
    inputs = pixels, point_depth, lengths, depth, coverage, nearest, weight
    not_in_range = errors.counter(point_depth, "soft_splat", "lengths", "length")
    programs = batch * views * triton.cdiv(height, _SIDE) * triton.cdiv(width, _SIDE)
    numbers = bits_of(radius), bits_of(softness), bits_of(least_fade(depth, radius))
    sizes = views, count, height, width, *numbers
    launch(_gather, programs, *inputs, not_in_range, *sizes, _SIDE, _CANDIDATES)
    errors.settle(point_depth, lambda: _checks.check_lengths_range("soft_splat", "lengths", lengths, count))
    return depth, coverage, nearest, weight


def soft_splat_backward(
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
    """As the operator."""
    batch, views, count = point_depth.shape
    if not (point_depth.numel() and depth.numel()):
        return torch.zeros_like(pixels), torch.zeros_like(point_depth)
    grad_pixels, grad_point_depth = torch.empty_like(pixels), torch.empty_like(point_depth)
    inputs = pixels, point_depth, lengths, depth, nearest, weight, grad_depth, grad_coverage
    numbers = (
        bits_of(radius),
        bits_of(softness),
        bits_of(least_fade(depth, radius)),
        math.floor(radius + 0.5),
    )
    sizes = views, count, *depth.shape[2:], *numbers
    programs = batch * views * triton.cdiv(count, _POINTS)
    launch(_to_points, programs, *inputs, grad_pixels, grad_point_depth, *sizes, _POINTS)
    return grad_pixels, grad_point_depth
