"""Point splatting on CUDA tensors: every point offers its depth to the pixels it covers, by an atomic minimum."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import bits_of, launch, real
from diffpoint.cuda.values import count_not_finite

_POINTS, _PIXELS = 128, 256  # of a program
_SUMMED = 1024  # pixels at once in the program that sums over a view
_NOBODY = tl.constexpr(2**62)  # the index of an empty pixel, until it is decoded
_EMPTY = tl.constexpr(0x7F800000_FFFFFFFF)  # the key of an empty pixel: the bits of +inf, then those of -1


@triton.jit
def image_position(camera, x, y, z):
    """Pixel position and depth of points; the same operations as on the CPU, hence the same pixels."""
    d = tl.load(camera + 8) * x + tl.load(camera + 9) * y + tl.load(camera + 10) * z + tl.load(camera + 11)
    inverse = 1.0 / d
    u = tl.load(camera) * x + tl.load(camera + 1) * y + tl.load(camera + 2) * z + tl.load(camera + 3)
    v = tl.load(camera + 4) * x + tl.load(camera + 5) * y + tl.load(camera + 6) * z + tl.load(camera + 7)
    return u * inverse, v * inverse, d


@triton.jit
def _own_pixel(u, v, d, inside, height, width, reach):
    """Whether points may cover a pixel, at most `reach` from their own; and the column and row of their own."""
    near = inside & (d > 0.0) & (u >= -reach - 1.0) & (u < width + reach + 1.0)
    near = near & (v >= -reach - 1.0) & (v < height + reach + 1.0)
    column = tl.floor(tl.where(near, u, 0.0)).to(tl.int32)
    row = tl.floor(tl.where(near, v, 0.0)).to(tl.int32)
    return near, column, row


@triton.jit
def _offer(
    points, lengths, projection, keys, depth_bits, index, not_finite, not_in_range,
    views, count, height, width, radius_bits, reach,
    DISC: tl.constexpr, PACKED: tl.constexpr, SECOND: tl.constexpr, POINTS: tl.constexpr,
):  # fmt: skip
    """Some points of one view. PACKED: depth and index form one key in `keys`, and the smallest key wins.

    Else they need 128 bits and two launches: the first finds the nearest depth of each pixel, the second (SECOND) the
    lowest index among the points that have it. The bits of positive floats are ordered as the floats are.
    """
    tiles = tl.cdiv(count, POINTS)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    cloud = view // views
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    dtype: tl.constexpr = points.dtype.element_ty
    length = tl.load(lengths + cloud)
    inside = (i < length) & (i < count)
    at = points + cloud * count * 3 + i * 3
    x = tl.load(at, mask=inside, other=0.0)
    y = tl.load(at + 1, mask=inside, other=0.0)
    z = tl.load(at + 2, mask=inside, other=0.0)
    if not SECOND:
        count_not_finite(x, y, z, not_finite)
        if tl.program_id(0) % tiles == 0 and (length < 0 or length > count):
            tl.atomic_add(not_in_range, 1)
    u, v, d = image_position(projection + view * 12, x, y, z)
    near, column, row = _own_pixel(u, v, d, inside, height, width, reach)
    radius = real(radius_bits, dtype)
    if PACKED:
        key = (d.to(tl.int32, bitcast=True).to(tl.int64) << 32) | i.to(tl.int64)
    else:
        key = d.to(tl.int64, bitcast=True)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            r = row + down
            c = column + across
            covered = near & (r >= 0) & (r < height) & (c >= 0) & (c < width)
            if DISC:
                du = c.to(dtype) + 0.5 - u
                dv = r.to(dtype) + 0.5 - v
                own = (r == row) & (c == column)
                covered = covered & (own | (du * du + dv * dv <= radius * radius))
            p = view * height * width + r * width + c
            if PACKED:
                tl.atomic_min(keys + p, key, mask=covered, sem="relaxed")
            elif SECOND:
                nearest = tl.load(depth_bits + p, mask=covered, other=0)
                tl.atomic_min(index + p, i.to(tl.int64), mask=covered & (nearest == key), sem="relaxed")
            else:
                tl.atomic_min(depth_bits + p, key, mask=covered, sem="relaxed")


@triton.jit
def _decode(keys, depth_bits, index, visible, pixels, count, PACKED: tl.constexpr, PIXELS: tl.constexpr):
    """Depth, index and visibility from the keys, PACKED as above. Several pixels may set a point's flag, all to 1."""
    blocks = tl.cdiv(pixels, PIXELS)
    view = (tl.program_id(0) // blocks).to(tl.int64)
    p = tl.program_id(0) % blocks * PIXELS + tl.arange(0, PIXELS)
    at = view * pixels + p
    if PACKED:
        key = tl.load(keys + at, mask=p < pixels, other=_EMPTY)
        owner = key.to(tl.int32).to(tl.int64)
        tl.store(depth_bits + at, (key >> 32).to(tl.int32), mask=p < pixels)
    else:
        owner = tl.load(index + at, mask=p < pixels, other=_NOBODY)
        owner = tl.where(owner == _NOBODY, -1, owner)
    tl.store(index + at, owner, mask=p < pixels)
    tl.store(visible + view * count + owner, owner >= 0, mask=(p < pixels) & (owner >= 0))


@triton.jit
def _to_points(
    points,
    projection,
    index,
    grad_depth,
    grad_points,
    views,
    count,
    height,
    width,
    reach,
    POINTS: tl.constexpr,
):
    """Gradient to some points of a cloud: each gathers from the pixels around it that it owns, because atomic additions
    would be in another order in every run."""
    tiles = tl.cdiv(count, POINTS)
    cloud = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    dtype: tl.constexpr = points.dtype.element_ty
    at = cloud * count * 3 + i * 3
    x = tl.load(points + at, mask=i < count, other=0.0)
    y = tl.load(points + at + 1, mask=i < count, other=0.0)
    z = tl.load(points + at + 2, mask=i < count, other=0.0)
    gx = tl.zeros((POINTS,), dtype)
    gy = tl.zeros((POINTS,), dtype)
    gz = tl.zeros((POINTS,), dtype)
    for of_cloud in range(views):
        view = cloud * views + of_cloud
        camera = projection + view * 12
        u, v, d = image_position(camera, x, y, z)
        near, column, row = _own_pixel(u, v, d, i < count, height, width, reach)
        total = tl.zeros((POINTS,), dtype)
        for down in range(-reach, reach + 1):
            for across in range(-reach, reach + 1):
                r = row + down
                c = column + across
                covered = near & (r >= 0) & (r < height) & (c >= 0) & (c < width)
                p = view * height * width + r * width + c
                owned = covered & (tl.load(index + p, mask=covered, other=-1) == i)
                total += tl.load(grad_depth + p, mask=owned, other=0.0)
        gx += total * tl.load(camera + 8)
        gy += total * tl.load(camera + 9)
        gz += total * tl.load(camera + 10)
    tl.store(grad_points + at, gx, mask=i < count)
    tl.store(grad_points + at + 1, gy, mask=i < count)
    tl.store(grad_points + at + 2, gz, mask=i < count)


@triton.jit
def _to_camera(points, index, grad_depth, grad_projection, views, count, pixels, PIXELS: tl.constexpr):
    """Gradient to the camera of one view: that of the third row, which gives the depth; zeros in the others."""
    view = tl.program_id(0).to(tl.int64)
    at = points + view // views * count * 3
    dtype: tl.constexpr = points.dtype.element_ty
    tx = tl.zeros((PIXELS,), dtype)
    ty = tl.zeros((PIXELS,), dtype)
    tz = tl.zeros((PIXELS,), dtype)
    tw = tl.zeros((PIXELS,), dtype)
    for start in range(0, pixels, PIXELS):
        p = start + tl.arange(0, PIXELS)
        owner = tl.load(index + view * pixels + p, mask=p < pixels, other=-1)
        hit = owner >= 0
        g = tl.load(grad_depth + view * pixels + p, mask=hit, other=0.0)
        tx += g * tl.load(at + owner * 3, mask=hit, other=0.0)
        ty += g * tl.load(at + owner * 3 + 1, mask=hit, other=0.0)
        tz += g * tl.load(at + owner * 3 + 2, mask=hit, other=0.0)
        tw += g
    out = grad_projection + view * 12
    for e in range(8):
        tl.store(out + e, 0.0)
    tl.store(out + 8, tl.sum(tx, axis=0))
    tl.store(out + 9, tl.sum(ty, axis=0))
    tl.store(out + 10, tl.sum(tz, axis=0))
    tl.store(out + 11, tl.sum(tw, axis=0))


def splat(
    points: Tensor, lengths: Tensor, projection: Tensor, height: int, width: int, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As the operator."""
    batch, views = projection.shape[:2]
    count, rows, pixels = points.shape[1], batch * views, height * width
    shape = batch, views, height, width
    packed, disc = points.dtype == torch.float32, radius > 0
    visible = points.new_zeros((batch, views, count), dtype=torch.uint8)
    if visible.numel() == 0 or pixels == 0:
        depth = points.new_full(shape, math.inf)
        return depth, torch.full_like(depth, -1, dtype=torch.int64), visible.view(torch.bool)
    if packed:
        keys = points.new_full(shape, _EMPTY.value, dtype=torch.int64)
        depth, index = torch.empty_like(keys, dtype=torch.float32), torch.empty_like(keys)
        depth_bits = depth.view(torch.int32)
    else:
        depth, index = (
            points.new_full(shape, math.inf),
            points.new_full(shape, _NOBODY.value, dtype=torch.int64),
        )
        depth_bits = keys = depth.view(torch.int64)
    counters = [
        errors.counter(points, "splat_depth", *kind) for kind in (("points", "finite"), ("lengths", "length"))
    ]
    inputs = points, lengths, projection, keys, depth_bits, index, *counters
    sizes = views, count, height, width, bits_of(radius), _reach(radius)
    programs = rows * triton.cdiv(count, _POINTS)
    launch(_offer, programs, *inputs, *sizes, disc, packed, False, _POINTS)
    if not packed:
        launch(_offer, programs, *inputs, *sizes, disc, packed, True, _POINTS)
    blocks = rows * triton.cdiv(pixels, _PIXELS)
    launch(_decode, blocks, keys, depth_bits, index, visible, pixels, count, packed, _PIXELS)

    def name_it() -> None:
        _checks.check_lengths_range("splat_depth", "lengths", lengths, count)
        _checks.check_finite("splat_depth", "points", points, lengths)

    errors.settle(points, name_it)
    return depth, index, visible.view(torch.bool)


def splat_backward(
    points: Tensor, projection: Tensor, index: Tensor, grad_depth: Tensor, radius: float
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    batch, views, height, width = index.shape
    count = points.shape[1]
    if points.numel() == 0 or index.numel() == 0:
        return torch.zeros_like(points), torch.zeros_like(projection)
    grad_points, grad_projection = torch.empty_like(points), torch.empty_like(projection)
    inputs = points, projection, index, grad_depth, grad_points
    sizes = views, count, height, width, _reach(radius)
    launch(_to_points, batch * triton.cdiv(count, _POINTS), *inputs, *sizes, _POINTS)
    inputs = points, index, grad_depth, grad_projection
    launch(_to_camera, batch * views, *inputs, views, count, height * width, _SUMMED)
    return grad_points, grad_projection


def _reach(radius: float) -> int:
    """How far from its own pixel a point can cover others."""
    return math.floor(radius + 0.5)
