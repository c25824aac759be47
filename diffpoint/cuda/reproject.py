"""Points to pixels and depth, and depth maps to points, on CUDA tensors."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch
from diffpoint.cuda.splat import image_position
from diffpoint.cuda.values import count_not_finite

_BLOCK = 256  # points or pixels of a program
_SUMMED = 512  # of a step of the programs that sum over a whole view


@triton.jit
def _row_times(m, k, x, y, z):
    """Row `k` of a 3 x 4 matrix times (x, y, z, 1)."""
    at = m + 4 * k
    return tl.load(at) * x + tl.load(at + 1) * y + tl.load(at + 2) * z + tl.load(at + 3)


@triton.jit
def _column_times(m, k, g0, g1, g2):
    """Column `k` of a 3 x 4 matrix times (g0, g1, g2)."""
    return g0 * tl.load(m + k) + g1 * tl.load(m + 4 + k) + g2 * tl.load(m + 8 + k)


@triton.jit
def _store_row(total, k, x, y, z, w):
    """Row `k` of the gradient to a 3 x 4 matrix, from sums that each lane has made of its own terms."""
    tl.store(total + 4 * k, tl.sum(x, axis=0))
    tl.store(total + 4 * k + 1, tl.sum(y, axis=0))
    tl.store(total + 4 * k + 2, tl.sum(z, axis=0))
    tl.store(total + 4 * k + 3, tl.sum(w, axis=0))


@triton.jit
def _pull_back(m, x, y, z, g_u, g_v, g_d):
    """Gradients to the rows of `m` times (x, y, z, 1), which are (u d, v d, d)."""
    d = _row_times(m, 2, x, y, z)
    before = d > 0.0  # the camera
    inverse = 1.0 / tl.where(before, d, 1.0)
    g0 = tl.where(before, g_u * inverse, 0.0)
    g1 = tl.where(before, g_v * inverse, 0.0)
    u = _row_times(m, 0, x, y, z) * inverse
    v = _row_times(m, 1, x, y, z) * inverse
    return g0, g1, g_d - g0 * u - g1 * v


@triton.jit
def _project(points, projection, pixels, depth, not_finite, views, count, BLOCK: tl.constexpr):
    tiles = tl.cdiv(count, BLOCK)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    source = points + (view // views * count + i) * 3
    x = tl.load(source, mask=inside, other=0.0)
    y = tl.load(source + 1, mask=inside, other=0.0)
    z = tl.load(source + 2, mask=inside, other=0.0)
    count_not_finite(x, y, z, not_finite)
    u, v, d = image_position(projection + view * 12, x, y, z)
    target = view * count + i
    tl.store(pixels + 2 * target, tl.where(d > 0.0, u, float("inf")), mask=inside)
    tl.store(pixels + 2 * target + 1, tl.where(d > 0.0, v, float("inf")), mask=inside)
    tl.store(depth + target, d, mask=inside)


@triton.jit
def _project_to_points(
    points, projection, grad_pixels, grad_depth, grad_points, views, count, BLOCK: tl.constexpr
):
    tiles = tl.cdiv(count, BLOCK)
    cloud = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    at = (cloud * count + i) * 3
    x = tl.load(points + at, mask=inside, other=0.0)
    y = tl.load(points + at + 1, mask=inside, other=0.0)
    z = tl.load(points + at + 2, mask=inside, other=0.0)
    gx = tl.zeros((BLOCK,), points.dtype.element_ty)
    gy = tl.zeros((BLOCK,), points.dtype.element_ty)
    gz = tl.zeros((BLOCK,), points.dtype.element_ty)
    for of_cloud in range(views):
        view = cloud * views + of_cloud
        m = projection + view * 12
        target = view * count + i
        g_u = tl.load(grad_pixels + 2 * target, mask=inside, other=0.0)
        g_v = tl.load(grad_pixels + 2 * target + 1, mask=inside, other=0.0)
        g_d = tl.load(grad_depth + target, mask=inside, other=0.0)
        g0, g1, g2 = _pull_back(m, x, y, z, g_u, g_v, g_d)
        gx += _column_times(m, 0, g0, g1, g2)
        gy += _column_times(m, 1, g0, g1, g2)
        gz += _column_times(m, 2, g0, g1, g2)
    tl.store(grad_points + at, gx, mask=inside)
    tl.store(grad_points + at + 1, gy, mask=inside)
    tl.store(grad_points + at + 2, gz, mask=inside)


@triton.jit
def _project_to_camera(
    points, projection, grad_pixels, grad_depth, grad_projection, views, count, BLOCK: tl.constexpr
):
    """One program per view."""
    view = tl.program_id(0).to(tl.int64)
    m = projection + view * 12
    zero = tl.zeros((BLOCK,), points.dtype.element_ty)
    x0, y0, z0, w0, x1, y1, z1, w1, x2, y2, z2, w2 = (
        zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
    )  # fmt: skip
    for start in range(0, count, BLOCK):
        i = start + tl.arange(0, BLOCK)
        inside = i < count
        source = points + (view // views * count + i) * 3
        x = tl.load(source, mask=inside, other=0.0)
        y = tl.load(source + 1, mask=inside, other=0.0)
        z = tl.load(source + 2, mask=inside, other=0.0)
        target = view * count + i
        g_u = tl.load(grad_pixels + 2 * target, mask=inside, other=0.0)
        g_v = tl.load(grad_pixels + 2 * target + 1, mask=inside, other=0.0)
        g_d = tl.load(grad_depth + target, mask=inside, other=0.0)
        g0, g1, g2 = _pull_back(m, x, y, z, g_u, g_v, g_d)
        x0 += g0 * x
        y0 += g0 * y
        z0 += g0 * z
        w0 += g0
        x1 += g1 * x
        y1 += g1 * y
        z1 += g1 * z
        w1 += g1
        x2 += g2 * x
        y2 += g2 * y
        z2 += g2 * z
        w2 += g2
    _store_row(grad_projection + view * 12, 0, x0, y0, z0, w0)
    _store_row(grad_projection + view * 12, 1, x1, y1, z1, w1)
    _store_row(grad_projection + view * 12, 2, x2, y2, z2, w2)


@triton.jit
def _pixel(p, width, dtype: tl.constexpr):
    """Image coordinates of the centres of pixels given by number."""
    return (p % width).to(dtype) + 0.5, (p // width).to(dtype) + 0.5


@triton.jit
def _ray(b, k, u, v):
    """Coordinate `k` of the direction from the camera to a pixel, to be multiplied by its depth."""
    return tl.load(b + 4 * k) * u + (tl.load(b + 4 * k + 1) * v + tl.load(b + 4 * k + 2))


@triton.jit
def _count_not_positive(depth, inside, not_positive):
    bad = tl.sum((inside & ~(depth > 0.0)).to(tl.int32), axis=0)
    if bad > 0:
        tl.atomic_add(not_positive, bad)


@triton.jit
def _unproject(depth, back_projection, order, points, not_positive, height, width, BLOCK: tl.constexpr):
    """`order`, from 1: the place of a pixel among the foreground pixels of its map."""
    pixels = height * width
    tiles = tl.cdiv(pixels, BLOCK)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    p = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    d = tl.load(depth + view * pixels + p, mask=p < pixels, other=float("inf"))
    _count_not_positive(d, p < pixels, not_positive)
    full = d < float("inf")
    b = back_projection + view * 12
    u, v = _pixel(p, width, depth.dtype.element_ty)
    target = points + (view * pixels + tl.load(order + view * pixels + p, mask=full, other=1) - 1) * 3
    for k in tl.static_range(3):
        tl.store(target + k, d * _ray(b, k, u, v) + tl.load(b + 4 * k + 3), mask=full)


@triton.jit
def _unproject_to_depth(
    depth, back_projection, order, grad_points, grad_depth, height, width, BLOCK: tl.constexpr
):
    pixels = height * width
    tiles = tl.cdiv(pixels, BLOCK)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    p = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    full = tl.load(depth + view * pixels + p, mask=p < pixels, other=float("inf")) < float("inf")
    b = back_projection + view * 12
    u, v = _pixel(p, width, depth.dtype.element_ty)
    source = grad_points + (view * pixels + tl.load(order + view * pixels + p, mask=full, other=1) - 1) * 3
    total = tl.zeros((BLOCK,), depth.dtype.element_ty)
    for k in tl.static_range(3):
        total += tl.load(source + k, mask=full, other=0.0) * _ray(b, k, u, v)
    tl.store(grad_depth + view * pixels + p, total, mask=p < pixels)


@triton.jit
def _unproject_to_camera(depth, order, grad_points, grad_back_projection, height, width, BLOCK: tl.constexpr):
    """One row of the gradient to the camera of one view."""
    view = (tl.program_id(0) // 3).to(tl.int64)
    k = tl.program_id(0) % 3
    pixels = height * width
    zero = tl.zeros((BLOCK,), depth.dtype.element_ty)
    tx, ty, tz, tw = zero, zero, zero, zero
    for start in range(0, pixels, BLOCK):
        p = start + tl.arange(0, BLOCK)
        d = tl.load(depth + view * pixels + p, mask=p < pixels, other=float("inf"))
        full = d < float("inf")
        u, v = _pixel(p, width, depth.dtype.element_ty)
        source = (view * pixels + tl.load(order + view * pixels + p, mask=full, other=1) - 1) * 3 + k
        g = tl.load(grad_points + source, mask=full, other=0.0)
        along = g * tl.where(full, d, 0.0)
        tx += along * u
        ty += along * v
        tz += along
        tw += g
    _store_row(grad_back_projection + view * 12, k, tx, ty, tz, tw)


@triton.jit
def _world_point(b, u, v, d, full):
    """The world point of a pixel; zeros where the map is empty."""
    x = tl.where(full, d * _ray(b, 0, u, v) + tl.load(b + 3), 0.0)
    y = tl.where(full, d * _ray(b, 1, u, v) + tl.load(b + 7), 0.0)
    z = tl.where(full, d * _ray(b, 2, u, v) + tl.load(b + 11), 0.0)
    return x, y, z


@triton.jit
def _reproject(
    depth, back_projection, projection, points, pixels, seen, valid, not_positive, not_finite,
    height, width, target_height, target_width, BLOCK: tl.constexpr,
):  # fmt: skip
    size = height * width
    tiles = tl.cdiv(size, BLOCK)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    p = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    inside = p < size
    infinite = float("inf")
    d = tl.load(depth + view * size + p, mask=inside, other=infinite)
    _count_not_positive(d, inside, not_positive)
    full = d < infinite
    u, v = _pixel(p, width, depth.dtype.element_ty)
    x, y, z = _world_point(back_projection + view * 12, u, v, tl.where(full, d, 0.0), full)
    count_not_finite(x, y, z, not_finite)
    m = projection + view * 12
    w = _row_times(m, 2, x, y, z)
    before = full & (w > 0.0)
    inverse = 1.0 / tl.where(before, w, 1.0)
    column = _row_times(m, 0, x, y, z) * inverse
    row = _row_times(m, 1, x, y, z) * inverse
    framed = before & (column >= 0.0) & (column < target_width) & (row >= 0.0) & (row < target_height)
    at = view * size + p
    tl.store(points + 3 * at, x, mask=inside)
    tl.store(points + 3 * at + 1, y, mask=inside)
    tl.store(points + 3 * at + 2, z, mask=inside)
    tl.store(pixels + 2 * at, tl.where(before, column, infinite), mask=inside)
    tl.store(pixels + 2 * at + 1, tl.where(before, row, infinite), mask=inside)
    tl.store(seen + at, tl.where(full, w, infinite), mask=inside)
    tl.store(valid + at, framed.to(tl.uint8), mask=inside)


@triton.jit
def _reproject_gradients(
    depth, back_projection, projection, grad_points, grad_pixels, grad_seen, view, p, height, width,
):  # fmt: skip
    """Gradients to the target's rows times (x, y, z, 1) and to the world points, zero where the map is empty; then the
    pixel, its depth (0 where empty) and its world point."""
    size = height * width
    at = view * size + p
    d = tl.load(depth + at, mask=p < size, other=float("inf"))
    full = d < float("inf")
    d = tl.where(full, d, 0.0)
    u, v = _pixel(p, width, depth.dtype.element_ty)
    x, y, z = _world_point(back_projection + view * 12, u, v, d, full)
    m = projection + view * 12
    g_u = tl.load(grad_pixels + 2 * at, mask=full, other=0.0)
    g_v = tl.load(grad_pixels + 2 * at + 1, mask=full, other=0.0)
    g_d = tl.load(grad_seen + at, mask=full, other=0.0)
    g0, g1, g2 = _pull_back(m, x, y, z, g_u, g_v, g_d)
    g0 = tl.where(full, g0, 0.0)
    g1 = tl.where(full, g1, 0.0)
    g2 = tl.where(full, g2, 0.0)
    to_x = tl.load(grad_points + 3 * at, mask=full, other=0.0) + _column_times(m, 0, g0, g1, g2)
    to_y = tl.load(grad_points + 3 * at + 1, mask=full, other=0.0) + _column_times(m, 1, g0, g1, g2)
    to_z = tl.load(grad_points + 3 * at + 2, mask=full, other=0.0) + _column_times(m, 2, g0, g1, g2)
    return g0, g1, g2, to_x, to_y, to_z, u, v, d, x, y, z


@triton.jit
def _reproject_to_depth(
    depth, back_projection, projection, grad_points, grad_pixels, grad_seen, grad_depth,
    height, width, BLOCK: tl.constexpr,
):  # fmt: skip
    size = height * width
    tiles = tl.cdiv(size, BLOCK)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    p = tl.program_id(0) % tiles * BLOCK + tl.arange(0, BLOCK)
    _, _, _, to_x, to_y, to_z, u, v, _, _, _, _ = _reproject_gradients(
        depth, back_projection, projection, grad_points, grad_pixels, grad_seen, view, p, height, width
    )
    b = back_projection + view * 12
    total = to_x * _ray(b, 0, u, v) + to_y * _ray(b, 1, u, v) + to_z * _ray(b, 2, u, v)
    tl.store(grad_depth + view * size + p, total, mask=p < size)


@triton.jit
def _reproject_to_cameras(
    depth, back_projection, projection, grad_points, grad_pixels, grad_seen, grad_back_projection, grad_projection,
    height, width, BLOCK: tl.constexpr,
):  # fmt: skip
    """One row of the gradients to both cameras of one view."""
    view = (tl.program_id(0) // 3).to(tl.int64)
    k = tl.program_id(0) % 3
    zero = tl.zeros((BLOCK,), depth.dtype.element_ty)
    sx, sy, sz, sw, tx, ty, tz, tw = zero, zero, zero, zero, zero, zero, zero, zero
    for start in range(0, height * width, BLOCK):
        p = start + tl.arange(0, BLOCK)
        g0, g1, g2, to_x, to_y, to_z, u, v, d, x, y, z = _reproject_gradients(
            depth, back_projection, projection, grad_points, grad_pixels, grad_seen, view, p, height, width
        )
        g = tl.where(k == 0, g0, tl.where(k == 1, g1, g2))
        to = tl.where(k == 0, to_x, tl.where(k == 1, to_y, to_z))
        sx += to * d * u
        sy += to * d * v
        sz += to * d
        sw += to
        tx += g * x
        ty += g * y
        tz += g * z
        tw += g
    _store_row(grad_back_projection + view * 12, k, sx, sy, sz, sw)
    _store_row(grad_projection + view * 12, k, tx, ty, tz, tw)


def project(points: Tensor, projection: Tensor) -> tuple[Tensor, Tensor]:
    """As the operator."""
    batch, views = projection.shape[:2]
    count = points.shape[1]
    pixels = points.new_empty((batch, views, count, 2))
    depth = points.new_empty((batch, views, count))
    if depth.numel():
        not_finite = errors.counter(points, "project", "points", "finite")
        programs = batch * views * triton.cdiv(count, _BLOCK)
        launch(_project, programs, points, projection, pixels, depth, not_finite, views, count, _BLOCK)
        errors.settle(points, lambda: _checks.check_finite("project", "points", points))
    return pixels, depth


def project_backward(
    points: Tensor, projection: Tensor, grad_pixels: Tensor, grad_depth: Tensor
) -> tuple[Tensor, Tensor]:
    """As the operator."""
    if points.numel() == 0 or projection.numel() == 0:
        return torch.zeros_like(points), torch.zeros_like(projection)
    points, projection = points.contiguous(), projection.contiguous()
    inputs = points, projection, grad_pixels.contiguous(), grad_depth.contiguous()
    grad_points, grad_projection = torch.empty_like(points), torch.empty_like(projection)
    sizes = projection.shape[1], points.shape[1]
    programs = points.shape[0] * triton.cdiv(points.shape[1], _BLOCK)
    launch(_project_to_points, programs, *inputs, grad_points, *sizes, _BLOCK)
    programs = projection.shape[0] * projection.shape[1]
    launch(_project_to_camera, programs, *inputs, grad_projection, *sizes, _SUMMED)
    return grad_points, grad_projection


def unproject(depth: Tensor, back_projection: Tensor) -> tuple[Tensor, Tensor]:
    """As the operator."""
    batch, views, height, width = depth.shape
    points = depth.new_zeros((batch, views, height * width, 3))
    if depth.numel() == 0:
        return points, torch.zeros((batch, views), dtype=torch.int64, device=depth.device)
    order = _foreground_order(depth)
    not_positive = errors.counter(depth, "unproject", "depth", "depth")
    programs = batch * views * triton.cdiv(height * width, _BLOCK)
    launch(_unproject, programs, depth, back_projection, order, points, not_positive, height, width, _BLOCK)
    errors.settle(depth, lambda: _checks.check_depth("unproject", "depth", depth))
    return points, order[..., -1].clone()


def unproject_backward(depth: Tensor, back_projection: Tensor, grad_points: Tensor) -> tuple[Tensor, Tensor]:
    """As the operator."""
    batch, views, height, width = depth.shape
    if depth.numel() == 0:
        return torch.zeros_like(depth), torch.zeros_like(back_projection)
    grad_depth, grad_back_projection = torch.empty_like(depth), torch.empty_like(back_projection)
    order = _foreground_order(depth)
    programs = batch * views * triton.cdiv(height * width, _BLOCK)
    inputs = depth, back_projection, order, grad_points, grad_depth
    launch(_unproject_to_depth, programs, *inputs, height, width, _BLOCK)
    inputs = depth, order, grad_points, grad_back_projection
    launch(_unproject_to_camera, batch * views * 3, *inputs, height, width, _SUMMED)
    return grad_depth, grad_back_projection


def _foreground_order(depth: Tensor) -> Tensor:
    """(B, V, H*W) int64: the place of each foreground pixel among those of its map, from 1."""
    return (depth < torch.inf).flatten(2).cumsum(-1)


def reproject(
    depth: Tensor, back_projection: Tensor, projection: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As the operator."""
    batch, views, rows, columns = depth.shape
    points, pixels = depth.new_empty((*depth.shape, 3)), depth.new_empty((*depth.shape, 2))
    seen, valid = torch.empty_like(depth), torch.empty_like(depth, dtype=torch.uint8)
    if depth.numel():
        not_positive = errors.counter(depth, "reproject", "depth", "depth")
        not_finite = errors.counter(depth, "reproject", "points", "finite")
        inputs = depth, back_projection, projection
        outputs = points, pixels, seen, valid, not_positive, not_finite
        programs = batch * views * triton.cdiv(rows * columns, _BLOCK)
        launch(_reproject, programs, *inputs, *outputs, rows, columns, height, width, _BLOCK)

        def name_it() -> None:
            _checks.check_depth("reproject", "depth", depth)
            _checks.check_finite("reproject", "points", points)

        errors.settle(depth, name_it)
    return points, pixels, seen, valid.view(torch.bool)


def reproject_backward(
    depth: Tensor,
    back_projection: Tensor,
    projection: Tensor,
    grad_points: Tensor,
    grad_pixels: Tensor,
    grad_seen: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """As the operator."""
    inputs = depth.contiguous(), back_projection.contiguous(), projection.contiguous()
    grad_depth, grad_back_projection, grad_projection = (torch.empty_like(x) for x in inputs)
    if depth.numel():
        gradients = grad_points.contiguous(), grad_pixels.contiguous(), grad_seen.contiguous()
        batch, views, *size = depth.shape
        programs = batch * views * triton.cdiv(size[0] * size[1], _BLOCK)
        launch(_reproject_to_depth, programs, *inputs, *gradients, grad_depth, *size, _BLOCK)
        outputs = grad_back_projection, grad_projection
        launch(_reproject_to_cameras, batch * views * 3, *inputs, *gradients, *outputs, *size, _SUMMED)
    return grad_depth, grad_back_projection, grad_projection
