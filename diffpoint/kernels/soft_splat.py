"""Soft splatting: footprints that fade towards their edge, and a soft minimum of the depths where they overlap.

A footprint is the square of a fade, 1 at the point and 0 at the edge. Fades up to `least` count as 0.
"""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti


def build(real):
    reals = ti.types.ndarray(dtype=real, ndim=1)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)

    @ti.func
    def window(u, v, d, size, radius):
        """First and last (exclusive) column and row whose centres the disc may cover; empty behind the camera."""
        bounds = ti.Vector([0, 0, 0, 0])
        half = real(0.5)
        zero = real(0.0)
        # Comparisons with NaN, the position of a point in the camera's plane, are false.
        if (
            (d > zero)
            & (u + radius > zero)
            & (u - radius < size[1])
            & (v + radius > zero)
            & (v - radius < size[0])
        ):
            bounds[0] = ti.cast(ti.max(u - radius + half, zero), ti.i32)
            bounds[1] = ti.cast(ti.min(u + radius + half, size[1]), ti.i32)
            bounds[2] = ti.cast(ti.max(v - radius + half, zero), ti.i32)
            bounds[3] = ti.cast(ti.min(v + radius + half, size[0]), ti.i32)
        return bounds

    @ti.kernel
    def forward(
        pixels: reals,
        point_depth: reals,
        lengths: integers,
        depth: reals,
        coverage: reals,
        nearest: reals,
        weight: reals,
        views: ti.i32,
        count: ti.i32,
        height: ti.i32,
        width: ti.i32,
        radius: real,
        softness: real,
        least: real,
        spread: ti.i32,
    ):
        """One thread per map. Weights are relative to the nearest depth so far: a nearer point rescales them."""
        zero = real(0.0)
        one = real(1.0)
        size = ti.Vector([ti.cast(height, real), ti.cast(width, real)])
        for step in range(point_depth.shape[0] // count * spread):
            if step % spread == 0:
                view = step // spread
                start = view * height * width
                for p in range(start, start + height * width):
                    depth[p] = zero  # the weighted sum, until it is divided
                    coverage[p] = zero
                    nearest[p] = real(ti.math.inf)
                    weight[p] = zero
                for i in range(view * count, view * count + ti.cast(lengths[view // views], ti.i32)):
                    u = pixels[2 * i]
                    v = pixels[2 * i + 1]
                    d = point_depth[i]
                    bounds = window(u, v, d, size, radius)
                    for row in range(bounds[2], bounds[3]):
                        dv = (ti.cast(row, real) + real(0.5) - v) / radius
                        for column in range(bounds[0], bounds[1]):
                            du = (ti.cast(column, real) + real(0.5) - u) / radius
                            fade = one - du * du - dv * dv
                            if fade > least:
                                p = start + row * width + column
                                footprint = fade * fade
                                front = nearest[p]
                                leads = d < front
                                behind = ti.exp(-ti.abs(d - front) / softness)
                                kept = ti.select(leads, behind, one)
                                gained = footprint * ti.select(leads, one, behind)
                                weight[p] = weight[p] * kept + gained
                                depth[p] = depth[p] * kept + gained * d
                                coverage[p] = coverage[p] + footprint
                                nearest[p] = ti.select(leads, d, front)
                for p in range(start, start + height * width):
                    hit = weight[p] > zero
                    depth[p] = ti.select(hit, depth[p] / ti.select(hit, weight[p], one), real(ti.math.inf))

    @ti.kernel
    def backward(
        pixels: reals,
        point_depth: reals,
        lengths: integers,
        depth: reals,
        nearest: reals,
        weight: reals,
        grad_depth: reals,
        grad_coverage: reals,
        grad_pixels: reals,
        grad_point_depth: reals,
        views: ti.i32,
        parts: ti.i32,
        count: ti.i32,
        height: ti.i32,
        width: ti.i32,
        radius: real,
        softness: real,
        least: real,
        spread: ti.i32,
    ):
        """One thread per part of a view's points gathers from the pixels of each."""
        zero = real(0.0)
        one = real(1.0)
        size = ti.Vector([ti.cast(height, real), ti.cast(width, real)])
        part_size = (count + parts - 1) // parts
        for step in range(point_depth.shape[0] // count * parts * spread):
            if step % spread == 0:
                view = step // spread // parts
                start = view * height * width
                first = ti.min(step // spread % parts * part_size, count)
                last = ti.min(first + part_size, count)
                length = ti.max(first, ti.min(last, ti.cast(lengths[view // views], ti.i32)))
                for i in range(view * count + length, view * count + last):
                    grad_pixels[2 * i] = zero
                    grad_pixels[2 * i + 1] = zero
                    grad_point_depth[i] = zero
                for i in range(view * count + first, view * count + length):
                    u = pixels[2 * i]
                    v = pixels[2 * i + 1]
                    d = point_depth[i]
                    grad_u = zero
                    grad_v = zero
                    grad_d = zero
                    bounds = window(u, v, d, size, radius)
                    for row in range(bounds[2], bounds[3]):
                        dv = (ti.cast(row, real) + real(0.5) - v) / radius
                        for column in range(bounds[0], bounds[1]):
                            du = (ti.cast(column, real) + real(0.5) - u) / radius
                            fade = one - du * du - dv * dv
                            if fade > least:
                                p = start + row * width + column
                                g = grad_coverage[p]
                                share = ti.exp((nearest[p] - d) / softness)
                                if share > zero:  # else 0 times infinity is possible
                                    pull = grad_depth[p] * share / weight[p]
                                    off = d - depth[p]
                                    g += pull * off
                                    grad_d += pull * fade * fade * (one - off / softness)
                                grad_u += g * fade * du
                                grad_v += g * fade * dv
                    # The footprint is fade^2, and fade falls by 2 du / radius for each pixel.
                    grad_pixels[2 * i] = grad_u * real(4.0) / radius
                    grad_pixels[2 * i + 1] = grad_v * real(4.0) / radius
                    grad_point_depth[i] = grad_d

    return SimpleNamespace(forward=forward, backward=backward)
