"""Points to pixels and depth, and depth maps to points, with gradients to points, depth and camera matrices."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

TILE = 8  # points at once, in vector registers


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    maps3 = ti.types.ndarray(dtype=real, ndim=3)
    matrices2 = ti.types.ndarray(dtype=real, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    reals = ti.types.ndarray(dtype=real, ndim=1)
    flags = ti.types.ndarray(dtype=ti.u8, ndim=1)

    @ti.kernel
    def project(
        points: reals,
        projection: reals,
        pixels: reals,
        depth: reals,
        total: reals,
        views: ti.i32,
        count: ti.i32,
        spread: ti.i32,
    ):
        """`total` receives the sum of each view's depths: NaN or infinite if a coordinate of a point is."""
        for step in range(projection.shape[0] // 12 * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                sum_of_depths = real(0.0)
                for i in range(count):
                    source = (cloud * count + i) * 3
                    x = points[source]
                    y = points[source + 1]
                    z = points[source + 2]
                    d = m[8] * x + m[9] * y + m[10] * z + m[11]
                    sum_of_depths += d
                    inverse = real(1.0) / d  # as in the splat, so that both assign a point to the same pixel
                    u = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inverse
                    v = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inverse
                    target = view * count + i
                    pixels[2 * target] = ti.select(d > 0, u, real(ti.math.inf))
                    pixels[2 * target + 1] = ti.select(d > 0, v, real(ti.math.inf))
                    depth[target] = d
                total[view] = sum_of_depths

    @ti.func
    def part_size(count, parts):
        """Points of a part: whole tiles."""
        return ((count + parts - 1) // parts + TILE - 1) // TILE * TILE

    @ti.func
    def pull_back(m: ti.template(), x, y, z, g_u, g_v, g_d):
        """Gradients to the rows times (x, y, z, 1), which are (u d, v d, d); of one point or of a vector of them."""
        d = m[8] * x + m[9] * y + m[10] * z + m[11]
        before = d > real(0.0)  # the camera
        inverse = real(1.0) / ti.select(before, d, real(1.0))
        g0 = ti.select(before, g_u * inverse, real(0.0))
        g1 = ti.select(before, g_v * inverse, real(0.0))
        u = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inverse
        v = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inverse
        return g0, g1, g_d - g0 * u - g1 * v

    @ti.kernel
    def project_backward(
        points: reals,
        projection: reals,
        grad_pixels: reals,
        grad_depth: reals,
        grad_points: reals,
        grad_projection: reals,
        pixels_step: ti.i32,
        depth_step: ti.i32,
        views: ti.i32,
        parts: ti.i32,
        count: ti.i32,
        spread: ti.i32,
    ):
        """One thread per part of a cloud handles all its views. (`a[i] += x` would be a slow atomic addition.)

        With a step of 0 the gradients of one tile are used for all. `grad_projection` (B, V, parts, 3, 4) receives the
        sums of each part.
        """
        share = part_size(count, parts)
        for step in range(points.shape[0] // (3 * count) * parts * spread):
            if step % spread == 0:
                cloud = step // spread // parts
                part = step // spread % parts
                start = ti.min(part * share, count)
                stop = ti.min(start + share, count)
                tiles = (stop - start) // TILE
                for view in range(cloud * views, cloud * views + views):
                    first = view == cloud * views
                    m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                    # Sums for the matrix: rows 0 to 2 of the gradients times x, y, z and 1, for each lane of the tile.
                    x0 = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                    y0, z0, w0, x1, y1, z1, w1, x2, y2, z2, w2 = x0, x0, x0, x0, x0, x0, x0, x0, x0, x0, x0
                    for t in range(tiles):
                        source = (cloud * count + start + t * TILE) * 3
                        target = view * count + start + t * TILE
                        x = ti.Vector([points[source + 3 * s] for s in ti.static(range(TILE))])
                        y = ti.Vector([points[source + 3 * s + 1] for s in ti.static(range(TILE))])
                        z = ti.Vector([points[source + 3 * s + 2] for s in ti.static(range(TILE))])
                        g_u = ti.Vector(
                            [grad_pixels[2 * target * pixels_step + 2 * s] for s in ti.static(range(TILE))]
                        )
                        g_v = ti.Vector(
                            [
                                grad_pixels[2 * target * pixels_step + 2 * s + 1]
                                for s in ti.static(range(TILE))
                            ]
                        )
                        g_d = ti.Vector([grad_depth[target * depth_step + s] for s in ti.static(range(TILE))])
                        g0, g1, g2 = pull_back(m, x, y, z, g_u, g_v, g_d)
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
                        grad_x = g0 * m[0] + g1 * m[4] + g2 * m[8]
                        grad_y = g0 * m[1] + g1 * m[5] + g2 * m[9]
                        grad_z = g0 * m[2] + g1 * m[6] + g2 * m[10]
                        if not first:  # once per tile, because it would be a branch in each lane
                            for s in ti.static(range(TILE)):
                                grad_x[s] += grad_points[source + 3 * s]
                                grad_y[s] += grad_points[source + 3 * s + 1]
                                grad_z[s] += grad_points[source + 3 * s + 2]
                        for s in ti.static(range(TILE)):
                            grad_points[source + 3 * s] = grad_x[s]
                            grad_points[source + 3 * s + 1] = grad_y[s]
                            grad_points[source + 3 * s + 2] = grad_z[s]
                    total = ti.Vector(
                        [
                            x0.sum(), y0.sum(), z0.sum(), w0.sum(),
                            x1.sum(), y1.sum(), z1.sum(), w1.sum(),
                            x2.sum(), y2.sum(), z2.sum(), w2.sum(),
                        ]
                    )  # fmt: skip
                    for i in range(start + tiles * TILE, stop):
                        source = (cloud * count + i) * 3
                        target = view * count + i
                        p = ti.Vector([points[source], points[source + 1], points[source + 2], real(1.0)])
                        g0, g1, g2 = pull_back(
                            m,
                            p[0],
                            p[1],
                            p[2],
                            grad_pixels[2 * target * pixels_step],
                            grad_pixels[2 * target * pixels_step + 1],
                            grad_depth[target * depth_step],
                        )
                        for k in ti.static(range(4)):
                            total[k] += g0 * p[k]
                            total[4 + k] += g1 * p[k]
                            total[8 + k] += g2 * p[k]
                        for k in ti.static(range(3)):
                            g = g0 * m[k] + g1 * m[4 + k] + g2 * m[8 + k]
                            grad_points[source + k] = ti.select(first, g, grad_points[source + k] + g)
                    for e in ti.static(range(12)):
                        grad_projection[(view * parts + part) * 12 + e] = total[e]

    @ti.kernel
    def unproject(
        depth: maps3,
        back_projection: matrices2,
        points: points3,
        lengths: integers,
        spread: ti.i32,
    ):
        """World points of the foreground pixels, stored contiguously."""
        for step in range(depth.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                m = ti.Vector([back_projection[view, e] for e in ti.static(range(12))])
                count = 0
                for row in range(depth.shape[1]):
                    v = ti.cast(row, real) + real(0.5)
                    for column in range(depth.shape[2]):
                        d = depth[view, row, column]
                        if d < ti.math.inf:
                            u = ti.cast(column, real) + real(0.5)
                            for k in ti.static(range(3)):
                                points[view, count, k] = (
                                    d * (m[4 * k] * u + m[4 * k + 1] * v + m[4 * k + 2]) + m[4 * k + 3]
                                )
                            count += 1
                lengths[view] = count

    @ti.kernel
    def unproject_backward(
        depth: maps3,
        back_projection: matrices2,
        grad_points: points3,
        grad_depth: maps3,
        grad_back_projection: matrices2,
        spread: ti.i32,
    ):
        for step in range(depth.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                m = ti.Vector([back_projection[view, e] for e in ti.static(range(12))])
                total = ti.Vector([real(0.0) for e in ti.static(range(12))])
                count = 0
                for row in range(depth.shape[1]):
                    v = ti.cast(row, real) + real(0.5)
                    for column in range(depth.shape[2]):
                        d = depth[view, row, column]
                        g_depth = real(0.0)
                        if d < ti.math.inf:
                            u = ti.cast(column, real) + real(0.5)
                            for k in ti.static(range(3)):
                                g = grad_points[view, count, k]
                                g_depth += g * (m[4 * k] * u + m[4 * k + 1] * v + m[4 * k + 2])
                                total[4 * k] += g * d * u
                                total[4 * k + 1] += g * d * v
                                total[4 * k + 2] += g * d
                                total[4 * k + 3] += g
                            count += 1
                        grad_depth[view, row, column] = g_depth
                for e in ti.static(range(12)):
                    grad_back_projection[view, e] = total[e]

    @ti.func
    def pixel_to_world(b: ti.template(), u, v, depth):
        """The direction from the camera to a pixel, to be multiplied by the depth, and the world point."""
        ray_x = b[0] * u + (b[1] * v + b[2])
        ray_y = b[4] * u + (b[5] * v + b[6])
        ray_z = b[8] * u + (b[9] * v + b[10])
        return ray_x, ray_y, ray_z, depth * ray_x + b[3], depth * ray_y + b[7], depth * ray_z + b[11]

    @ti.func
    def all_infinite(depth: ti.template()):
        """Whether all pixels of a tile are empty; NaN is not."""
        count = 0
        for s in ti.static(range(TILE)):
            count += ti.select(depth[s] == real(ti.math.inf), 1, 0)
        return count == TILE

    @ti.func
    def reproject_tile(b: ti.template(), m: ti.template(), size, u, v, depth):
        """World points, pixels, depths and validity of one or several pixels of a row.

        Last the sum of their coordinates, for the check that all is finite: NaN where the depth is not positive.
        """
        zero, infinite = real(0.0), real(ti.math.inf)
        full = depth < infinite
        _, _, _, x, y, z = pixel_to_world(b, u, v, ti.select(full, depth, zero))
        x, y, z = ti.select(full, x, zero), ti.select(full, y, zero), ti.select(full, z, zero)
        w = m[8] * x + m[9] * y + m[10] * z + m[11]
        before = full & (w > zero)
        inverse = real(1.0) / ti.select(before, w, real(1.0))
        column = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inverse
        row = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inverse
        inside = before & (column >= zero) & (column < size[1]) & (row >= zero) & (row < size[0])
        column, row = ti.select(before, column, infinite), ti.select(before, row, infinite)
        check = ti.select(depth > zero, x + y + z, real(ti.math.nan))
        return x, y, z, column, row, ti.select(full, w, infinite), ti.select(inside, 1, 0), check

    @ti.kernel
    def reproject(
        depth: reals,
        back_projection: reals,
        projection: reals,
        points: reals,
        pixels: reals,
        seen: reals,
        valid: flags,
        total: reals,
        height: ti.i32,
        width: ti.i32,
        target_height: ti.i32,
        target_width: ti.i32,
        spread: ti.i32,
    ):
        """Unproject and project in one pass over a map.

        `total` receives the sum of each map's coordinates: NaN or infinite if one is, and NaN if a depth is not
        positive.
        """
        tiles = width // TILE
        for step in range(total.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                b = ti.Vector([back_projection[view * 12 + e] for e in ti.static(range(12))])
                m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                size = ti.Vector([ti.cast(target_height, real), ti.cast(target_width, real)])
                sums = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                rest = real(0.0)
                for row in range(height):
                    v = ti.cast(row, real) + real(0.5)
                    u = ti.Vector([ti.cast(s, real) + real(0.5) for s in ti.static(range(TILE))])
                    start = (view * height + row) * width
                    for t in range(tiles):
                        at = start + t * TILE
                        d = ti.Vector([depth[at + s] for s in ti.static(range(TILE))])
                        if all_infinite(d):
                            for e in ti.static(range(3 * TILE)):
                                points[3 * at + e] = real(0.0)
                            for e in ti.static(range(2 * TILE)):
                                pixels[2 * at + e] = real(ti.math.inf)
                            for s in ti.static(range(TILE)):
                                seen[at + s] = real(ti.math.inf)
                                valid[at + s] = ti.u8(0)
                        else:
                            x, y, z, column, line, w, inside, check = reproject_tile(b, m, size, u, v, d)
                            sums += check
                            for s in ti.static(range(TILE)):
                                points[3 * (at + s)] = x[s]
                                points[3 * (at + s) + 1] = y[s]
                                points[3 * (at + s) + 2] = z[s]
                                pixels[2 * (at + s)] = column[s]
                                pixels[2 * (at + s) + 1] = line[s]
                                seen[at + s] = w[s]
                                valid[at + s] = ti.cast(inside[s], ti.u8)
                        u += ti.cast(TILE, real)
                    for at in range(start + tiles * TILE, start + width):
                        c = ti.cast(at - start, real) + real(0.5)
                        x, y, z, column, line, w, inside, check = reproject_tile(b, m, size, c, v, depth[at])
                        rest += check
                        points[3 * at] = x
                        points[3 * at + 1] = y
                        points[3 * at + 2] = z
                        pixels[2 * at] = column
                        pixels[2 * at + 1] = line
                        seen[at] = w
                        valid[at] = ti.cast(inside, ti.u8)
                total[view] = sums.sum() + rest

    @ti.func
    def pull_back_tile(b: ti.template(), m: ti.template(), u, v, depth, g_x, g_y, g_z, g_u, g_v, g_d):
        """Gradients of one or several pixels of a row; zero where the map is empty.

        To the target's rows times (x, y, z, 1), to the world point, to the depth; and the depth, 0 where empty.
        """
        zero = real(0.0)
        full = depth < real(ti.math.inf)
        d = ti.select(full, depth, zero)
        ray_x, ray_y, ray_z, x, y, z = pixel_to_world(b, u, v, d)
        g0, g1, g2 = pull_back(m, x, y, z, g_u, g_v, g_d)
        g0, g1, g2 = ti.select(full, g0, zero), ti.select(full, g1, zero), ti.select(full, g2, zero)
        to_x = ti.select(full, g_x, zero) + (g0 * m[0] + g1 * m[4] + g2 * m[8])
        to_y = ti.select(full, g_y, zero) + (g0 * m[1] + g1 * m[5] + g2 * m[9])
        to_z = ti.select(full, g_z, zero) + (g0 * m[2] + g1 * m[6] + g2 * m[10])
        return g0, g1, g2, to_x, to_y, to_z, to_x * ray_x + to_y * ray_y + to_z * ray_z, d

    @ti.func
    def add_row(total: ti.template(), i: ti.template(), sums: ti.template(), k: ti.template(), v):
        """Adds sums along a row of pixels (gradients times u d, d and 1) to a matrix's gradient."""
        total[i] += sums[k]
        total[i + 1] += sums[k + 1] * v
        total[i + 2] += sums[k + 1]
        total[i + 3] += sums[k + 2]

    @ti.kernel
    def reproject_backward(
        depth: reals,
        back_projection: reals,
        projection: reals,
        grad_points: reals,
        grad_pixels: reals,
        grad_seen: reals,
        grad_depth: reals,
        grad_back_projection: reals,
        grad_projection: reals,
        points_step: ti.i32,
        pixels_step: ti.i32,
        seen_step: ti.i32,
        parts: ti.i32,
        height: ti.i32,
        width: ti.i32,
        spread: ti.i32,
    ):
        """One thread per part of a map, some rows of it; the matrices' gradients (B, V, parts, 3, 4) receive its sums.

        With a step of 0 the gradients of one tile are used for all.
        Both matrices' gradients are sums of gradients times (u d, v d, d, 1): of those to the world points, and of
        those to the target's rows, whose (x, y, z, 1) are `back_projection` times the same four.
        """
        tiles = width // TILE
        share = (height + parts - 1) // parts
        for step in range(projection.shape[0] // 12 * parts * spread):
            if step % spread == 0:
                at_part = step // spread
                view = at_part // parts
                first = ti.min(at_part % parts * share, height)
                b = ti.Vector([back_projection[view * 12 + e] for e in ti.static(range(12))])
                m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                world = ti.Vector([real(0.0) for _ in ti.static(range(12))])
                image = ti.Vector([real(0.0) for _ in ti.static(range(12))])
                for row in range(first, ti.min(first + share, height)):
                    v = ti.cast(row, real) + real(0.5)
                    u = ti.Vector([ti.cast(s, real) + real(0.5) for s in ti.static(range(TILE))])
                    start = (view * height + row) * width
                    # Sums along the row of the gradients times u d, d and 1, for each lane of the tile.
                    none = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                    x0, x1, x2, y0, y1, y2, z0, z1, z2 = none, none, none, none, none, none, none, none, none
                    p0, p1, p2, q0, q1, q2, r0, r1, r2 = none, none, none, none, none, none, none, none, none
                    for t in range(tiles):
                        at = start + t * TILE
                        depths = ti.Vector([depth[at + s] for s in ti.static(range(TILE))])
                        if all_infinite(depths):
                            for s in ti.static(range(TILE)):
                                grad_depth[at + s] = real(0.0)
                        else:
                            g_x = ti.Vector(
                                [grad_points[3 * at * points_step + 3 * s] for s in ti.static(range(TILE))]
                            )
                            g_y = ti.Vector(
                                [
                                    grad_points[3 * at * points_step + 3 * s + 1]
                                    for s in ti.static(range(TILE))
                                ]
                            )
                            g_z = ti.Vector(
                                [
                                    grad_points[3 * at * points_step + 3 * s + 2]
                                    for s in ti.static(range(TILE))
                                ]
                            )
                            g_u = ti.Vector(
                                [grad_pixels[2 * at * pixels_step + 2 * s] for s in ti.static(range(TILE))]
                            )
                            g_v = ti.Vector(
                                [
                                    grad_pixels[2 * at * pixels_step + 2 * s + 1]
                                    for s in ti.static(range(TILE))
                                ]
                            )
                            g_d = ti.Vector([grad_seen[at * seen_step + s] for s in ti.static(range(TILE))])
                            g0, g1, g2, to_x, to_y, to_z, to_depth, d = pull_back_tile(
                                b, m, u, v, depths, g_x, g_y, g_z, g_u, g_v, g_d
                            )
                            for s in ti.static(range(TILE)):
                                grad_depth[at + s] = to_depth[s]
                            along = u * d
                            x0 += to_x * along
                            x1 += to_x * d
                            x2 += to_x
                            y0 += to_y * along
                            y1 += to_y * d
                            y2 += to_y
                            z0 += to_z * along
                            z1 += to_z * d
                            z2 += to_z
                            p0 += g0 * along
                            p1 += g0 * d
                            p2 += g0
                            q0 += g1 * along
                            q1 += g1 * d
                            q2 += g1
                            r0 += g2 * along
                            r1 += g2 * d
                            r2 += g2
                        u += ti.cast(TILE, real)
                    of_row = ti.Vector(
                        [
                            x0.sum(), x1.sum(), x2.sum(), y0.sum(), y1.sum(), y2.sum(), z0.sum(), z1.sum(), z2.sum(),
                            p0.sum(), p1.sum(), p2.sum(), q0.sum(), q1.sum(), q2.sum(), r0.sum(), r1.sum(), r2.sum(),
                        ]
                    )  # fmt: skip
                    for at in range(start + tiles * TILE, start + width):
                        c = ti.cast(at - start, real) + real(0.5)
                        g0, g1, g2, to_x, to_y, to_z, to_depth, d = pull_back_tile(
                            b,
                            m,
                            c,
                            v,
                            depth[at],
                            grad_points[3 * at * points_step],
                            grad_points[3 * at * points_step + 1],
                            grad_points[3 * at * points_step + 2],
                            grad_pixels[2 * at * pixels_step],
                            grad_pixels[2 * at * pixels_step + 1],
                            grad_seen[at * seen_step],
                        )
                        grad_depth[at] = to_depth
                        gradients = ti.Vector([to_x, to_y, to_z, g0, g1, g2])
                        for k in ti.static(range(6)):
                            of_row[3 * k] += gradients[k] * d * c
                            of_row[3 * k + 1] += gradients[k] * d
                            of_row[3 * k + 2] += gradients[k]
                    for k in ti.static(range(3)):
                        add_row(world, 4 * k, of_row, 3 * k, v)
                        add_row(image, 4 * k, of_row, 3 * k + 9, v)
                for k in ti.static(range(3)):
                    for e in ti.static(range(4)):
                        grad_back_projection[at_part * 12 + 4 * k + e] = world[4 * k + e]
                    for e in ti.static(range(3)):
                        grad_projection[at_part * 12 + 4 * k + e] = (
                            b[4 * e] * image[4 * k]
                            + b[4 * e + 1] * image[4 * k + 1]
                            + b[4 * e + 2] * image[4 * k + 2]
                            + b[4 * e + 3] * image[4 * k + 3]
                        )
                    grad_projection[at_part * 12 + 4 * k + 3] = image[4 * k + 3]

    return SimpleNamespace(
        project=project,
        project_backward=project_backward,
        unproject=unproject,
        unproject_backward=unproject_backward,
        reproject=reproject,
        reproject_backward=reproject_backward,
    )
