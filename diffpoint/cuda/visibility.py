"""The horizon test of visibility on CUDA tensors: as kernels/visibility.py, with all points as candidates.

Image positions are (x, y, w): pixels from the corner of the points' bounding box, and w = focal length * log(depth);
w is +inf for points that are not in the frame, or that are enclosed by nearer ones.
"""

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint._horizon import CELL, DEEP, FILTERS, limit_of
from diffpoint.cuda import errors
from diffpoint.cuda.launch import bits_of, launch, real
from diffpoint.cuda.splat import image_position
from diffpoint.cuda.values import count_bad_points

_TILE = 1024  # points at once in a view's program
_QUERIES, _CANDIDATES = 32, 32  # of a tile of the horizon test


@triton.jit
def _cross_norm(a0, a1, a2, b0, b1, b2):
    x = a1 * b2 - a2 * b1
    y = a2 * b0 - a0 * b2
    z = a0 * b1 - a1 * b0
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def _cell_side(extent_u, extent_v, cells, longest, smallest):
    """Side of square cells of which about `cells` cover the extents, and at most `longest` per direction."""
    even = tl.sqrt(extent_u * extent_v / cells)
    thin = tl.maximum(extent_u, extent_v) / longest
    return tl.maximum(tl.maximum(even, thin), smallest)


@triton.jit
def _place(
    points, lengths, projection, image, spacing, cells, front, views, count, height, width,
    CELL: tl.constexpr, DEEP: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """One program per view: fills `image` and the spacing of the points.

    A point is enclosed if the cells on both sides of its own are nearer by DEEP spacings, on two of the four lines
    through it.
    """
    view = tl.program_id(0).to(tl.int64)
    camera = projection + view * 12
    points += view // views * count * 3
    image += view * count * 3
    cells += view * (8 * count + 32)
    front += view * (8 * count + 32)
    dtype: tl.constexpr = points.dtype.element_ty
    infinite = float("inf")
    length = tl.minimum(tl.load(lengths + view // views), count).to(tl.int32)
    a0, a1, a2 = tl.load(camera), tl.load(camera + 1), tl.load(camera + 2)
    b0, b1, b2 = tl.load(camera + 4), tl.load(camera + 5), tl.load(camera + 6)
    c0, c1, c2 = tl.load(camera + 8), tl.load(camera + 9), tl.load(camera + 10)
    # K's skew and principal point are parts along the forward axis, which the cross products remove.
    focal = _cross_norm(a0, a1, a2, c0, c1, c2)
    aspect = focal / _cross_norm(b0, b1, b2, c0, c1, c2)
    least_u = tl.full((TILE,), infinite, dtype)
    least_v = tl.full((TILE,), infinite, dtype)
    most_u = tl.full((TILE,), -infinite, dtype)
    most_v = tl.full((TILE,), -infinite, dtype)
    inside = tl.zeros((TILE,), tl.int32)
    for start in range(0, count, TILE):
        i = start + tl.arange(0, TILE)
        x = tl.load(points + i * 3, mask=i < length, other=0.0)
        y = tl.load(points + i * 3 + 1, mask=i < length, other=0.0)
        z = tl.load(points + i * 3 + 2, mask=i < length, other=0.0)
        u, v, d = image_position(camera, x, y, z)
        seen = (i < length) & (d > 0.0) & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        tl.store(image + i * 3, u, mask=i < count)
        tl.store(image + i * 3 + 1, v, mask=i < count)
        w = tl.where(seen, focal * tl.log(tl.where(seen, d, 1.0)), infinite)
        tl.store(image + i * 3 + 2, w, mask=i < count)
        least_u = tl.minimum(least_u, tl.where(seen, u, infinite))
        least_v = tl.minimum(least_v, tl.where(seen, v, infinite))
        most_u = tl.maximum(most_u, tl.where(seen, u, -infinite))
        most_v = tl.maximum(most_v, tl.where(seen, v, -infinite))
        inside += seen.to(tl.int32)
    n = tl.sum(inside, axis=0).to(dtype)
    if n > 0.0:
        low_u = tl.min(least_u, axis=0)
        low_v = tl.min(least_v, axis=0)
        extent_u = tl.max(most_u, axis=0) - low_u
        extent_v = (tl.max(most_v, axis=0) - low_v) * aspect
        # n random points on a silhouette of A cells occupy A (1 - exp(-n / A)) of them: solved for A.
        side = _cell_side(extent_u, extent_v, n / 2.0, n, 1e-6)
        per_side = 1.0 / side
        across = (extent_u * per_side).to(tl.int32) + 1
        number = across * ((extent_v * per_side).to(tl.int32) + 1)
        for start in range(0, number, TILE):
            c = start + tl.arange(0, TILE)
            tl.store(cells + c, 0, mask=c < number)
        tl.debug_barrier()
        for start in range(0, count, TILE):
            i = start + tl.arange(0, TILE)
            seen = tl.load(image + i * 3 + 2, mask=i < count, other=infinite) < infinite
            x = tl.load(image + i * 3, mask=seen, other=low_u) - low_u
            y = (tl.load(image + i * 3 + 1, mask=seen, other=low_v) - low_v) * aspect
            c = (y * per_side).to(tl.int32) * across + (x * per_side).to(tl.int32)
            tl.store(cells + c, 1, mask=seen)
            tl.store(image + i * 3, x, mask=i < count)
            tl.store(image + i * 3 + 1, y, mask=i < count)
        tl.debug_barrier()
        flags = tl.zeros((TILE,), tl.int32)
        for start in range(0, number, TILE):
            c = start + tl.arange(0, TILE)
            flags += tl.load(cells + c, mask=c < number, other=0)
        occupied = tl.sum(flags, axis=0).to(dtype)
        area = occupied
        for _ in range(20):
            area = occupied / (1.0 - tl.exp(-n / area))
        gap = side * tl.sqrt(area / n)
        tl.store(spacing + view, gap)
        side = _cell_side(extent_u, extent_v, 2.0 * n, n / 2.0, CELL * gap)
        per_side = 1.0 / side
        across = (extent_u * per_side).to(tl.int32) + 3  # a ring of empty cells all around
        number = across * ((extent_v * per_side).to(tl.int32) + 3)
        for start in range(0, number, TILE):
            c = start + tl.arange(0, TILE)
            tl.store(front + c, infinite, mask=c < number)
        tl.debug_barrier()
        for start in range(0, count, TILE):
            i = start + tl.arange(0, TILE)
            w = tl.load(image + i * 3 + 2, mask=i < count, other=infinite)
            seen = w < infinite
            x = tl.load(image + i * 3, mask=seen, other=0.0)
            y = tl.load(image + i * 3 + 1, mask=seen, other=0.0)
            c = ((y * per_side).to(tl.int32) + 1) * across + (x * per_side).to(tl.int32) + 1
            tl.atomic_min(front + c, w, mask=seen)
        tl.debug_barrier()
        for start in range(0, count, TILE):
            i = start + tl.arange(0, TILE)
            w = tl.load(image + i * 3 + 2, mask=i < count, other=infinite)
            seen = w < infinite
            x = tl.load(image + i * 3, mask=seen, other=0.0)
            y = tl.load(image + i * 3 + 1, mask=seen, other=0.0)
            at = front + ((y * per_side).to(tl.int32) + 1) * across + (x * per_side).to(tl.int32) + 1
            first = tl.maximum(tl.load(at - 1, mask=seen), tl.load(at + 1, mask=seen))
            second = tl.maximum(tl.load(at - across, mask=seen), tl.load(at + across, mask=seen))
            third = tl.maximum(tl.load(at - across - 1, mask=seen), tl.load(at + across + 1, mask=seen))
            fourth = tl.maximum(tl.load(at - across + 1, mask=seen), tl.load(at + across - 1, mask=seen))
            level = tl.minimum(
                tl.maximum(tl.minimum(first, second), tl.minimum(third, fourth)),
                tl.minimum(tl.maximum(first, second), tl.maximum(third, fourth)),
            )
            tl.store(image + i * 3 + 2, infinite, mask=seen & (w > level + DEEP * gap))


@triton.jit
def _signed_root(c):
    return tl.where(c < 0.0, -tl.sqrt(tl.abs(c)), tl.sqrt(tl.abs(c)))


@triton.jit
def _response(a, h0, h1, h2, h3, h4, h5, h6, h7):
    r = tl.load(a) * h0 + tl.load(a + 1) * h1 + tl.load(a + 2) * h2 + tl.load(a + 3) * h3
    r = r + tl.load(a + 4) * h4 + tl.load(a + 5) * h5 + tl.load(a + 6) * h6 + tl.load(a + 7) * h7
    return tl.maximum(r + tl.load(a + 8), 0.0)


@triton.jit
def _score(
    image, spacing, filters, visible, count, radius_bits, limit_bits,
    FILTERS: tl.constexpr, QUERIES: tl.constexpr, CANDIDATES: tl.constexpr,
):  # fmt: skip
    """The 8 horizons of a tile of points, and whether their score under the filters is at most the limit.

    A horizon is the largest signed squared cosine between the view's axis and the direction to a neighbour.
    """
    tiles = tl.cdiv(count, QUERIES)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    image += view * count * 3
    i = tl.program_id(0) % tiles * QUERIES + tl.arange(0, QUERIES)
    dtype: tl.constexpr = image.dtype.element_ty
    infinite = float("inf")
    w = tl.load(image + i * 3 + 2, mask=i < count, other=infinite)
    seen = w < infinite
    w = tl.where(seen, w, 0.0)[:, None]
    x = tl.load(image + i * 3, mask=seen, other=0.0)[:, None]
    y = tl.load(image + i * 3 + 1, mask=seen, other=0.0)[:, None]
    reach = real(radius_bits, dtype) * tl.load(spacing + view)
    none = tl.full((QUERIES, CANDIDATES), -1.0, dtype)
    c0, c1, c2, c3, c4, c5, c6, c7 = none, none, none, none, none, none, none, none
    if tl.max(seen.to(tl.int32), axis=0) > 0:
        for start in range(0, count, CANDIDATES):
            j = start + tl.arange(0, CANDIDATES)
            wj = tl.load(image + j * 3 + 2, mask=j < count, other=infinite)
            there = wj < infinite
            dx = tl.load(image + j * 3, mask=there, other=0.0)[None, :] - x
            dy = tl.load(image + j * 3 + 1, mask=there, other=0.0)[None, :] - y
            gap = w - tl.where(there, wj, 0.0)[None, :]
            d = dx * dx + dy * dy
            tiny = 1e-30  # with it the cosine of the point itself is -1
            rise = (gap * tl.abs(gap) - tiny) / (d + gap * gap + tiny)
            rise = tl.where((d <= reach * reach) & there[None, :], rise, -1.0)
            steep = tl.abs(dy) > tl.abs(dx)
            left = dx < 0.0
            above = dy < 0.0
            c0 = tl.where(~steep & ~left & ~above, tl.maximum(c0, rise), c0)
            c1 = tl.where(steep & ~left & ~above, tl.maximum(c1, rise), c1)
            c2 = tl.where(steep & left & ~above, tl.maximum(c2, rise), c2)
            c3 = tl.where(~steep & left & ~above, tl.maximum(c3, rise), c3)
            c4 = tl.where(~steep & left & above, tl.maximum(c4, rise), c4)
            c5 = tl.where(steep & left & above, tl.maximum(c5, rise), c5)
            c6 = tl.where(steep & ~left & above, tl.maximum(c6, rise), c6)
            c7 = tl.where(~steep & ~left & above, tl.maximum(c7, rise), c7)
    h0 = _signed_root(tl.max(c0, axis=1))
    h1 = _signed_root(tl.max(c1, axis=1))
    h2 = _signed_root(tl.max(c2, axis=1))
    h3 = _signed_root(tl.max(c3, axis=1))
    h4 = _signed_root(tl.max(c4, axis=1))
    h5 = _signed_root(tl.max(c5, axis=1))
    h6 = _signed_root(tl.max(c6, axis=1))
    h7 = _signed_root(tl.max(c7, axis=1))
    score = tl.zeros((QUERIES,), dtype)
    for f in range(FILTERS):
        a = filters + f * 11
        total = tl.zeros((QUERIES,), dtype)
        largest = tl.zeros((QUERIES,), dtype)
        for _ in range(8):
            r = _response(a, h0, h1, h2, h3, h4, h5, h6, h7)
            total += r
            largest = tl.maximum(largest, r)
            h0, h1, h2, h3, h4, h5, h6, h7 = h1, h2, h3, h4, h5, h6, h7, h0
        score += tl.load(a + 9) * total / 8.0 + tl.load(a + 10) * largest
    passed = seen & (score <= real(limit_bits, dtype))
    tl.store(visible + view * count + i, passed.to(tl.uint8), mask=i < count)


def visible(
    points: Tensor,
    lengths: Tensor,
    projection: Tensor,
    height: int,
    width: int,
    method: str,
    radius: float,
    tolerance: float,
) -> Tensor:
    """As the operator; method "hpr" is left to the CPU, whose library has the convex hull."""
    if method != "horizon":
        return NotImplemented
    batch, views = projection.shape[:2]
    count = points.shape[1]
    passed = torch.zeros((batch, views, count), dtype=torch.uint8, device=points.device)
    if passed.numel() == 0:
        return passed.view(torch.bool)
    count_bad_points("visible_points", "points", points, lengths)
    image = points.new_empty((batch, views, count, 3))
    spacing = points.new_ones((batch, views))
    cells = torch.empty((batch, views, 8 * count + 32), dtype=torch.int32, device=points.device)
    front = points.new_empty(cells.shape)
    inputs = points, lengths, projection
    sizes = views, count, height, width
    launch(_place, batch * views, *inputs, image, spacing, cells, front, *sizes, CELL, DEEP, _TILE, warps=8)
    programs = batch * views * triton.cdiv(count, _QUERIES)
    inputs = image, spacing, _filters(points.dtype, points.device), passed
    settings = bits_of(radius), bits_of(limit_of(tolerance)), len(FILTERS)
    launch(_score, programs, *inputs, count, *settings, _QUERIES, _CANDIDATES)

    def name_it() -> None:
        _checks.check_lengths_range("visible_points", "lengths", lengths, count)
        _checks.check_finite("visible_points", "points", points, lengths)

    errors.settle(points, name_it)
    return passed.view(torch.bool)


@functools.cache
def _filters(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(FILTERS, dtype=dtype, device=device)
