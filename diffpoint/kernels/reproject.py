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
                    inverse = real(1.0) / d  # as in the splat, so that both put a point in the same pixel
                    u = (m[0] * x + m[1] * y + m[2] * z + m[3]) * inverse
                    v = (m[4] * x + m[5] * y + m[6] * z + m[7]) * inverse
                    target = view * count + i
                    pixels[2 * target] = ti.select(d > 0, u, real(ti.math.inf))
                    pixels[2 * target + 1] = ti.select(d > 0, v, real(ti.math.inf))
                    depth[target] = d
                total[view] = sum_of_depths

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
        count: ti.i32,
        spread: ti.i32,
    ):
        """One thread owns one cloud and all its views. (`a[i] += x` would be an atomic addition, and slow.)

        A step of 0 makes of one number the gradient of everything.
        """
        tiles = count // TILE
        for step in range(points.shape[0] // (3 * count) * spread):
            if step % spread == 0:
                cloud = step // spread
                for view in range(cloud * views, cloud * views + views):
                    first = view == cloud * views
                    m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                    # Sums for the matrix: rows 0 to 2 of the gradients times x, y, z and 1, in each lane of the tile.
                    x0 = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                    y0, z0, w0, x1, y1, z1, w1, x2, y2, z2, w2 = x0, x0, x0, x0, x0, x0, x0, x0, x0, x0, x0
                    for t in range(tiles):
                        source = (cloud * count + t * TILE) * 3
                        target = view * count + t * TILE
                        x = ti.Vector([points[source + 3 * s] for s in ti.static(range(TILE))])
                        y = ti.Vector([points[source + 3 * s + 1] for s in ti.static(range(TILE))])
                        z = ti.Vector([points[source + 3 * s + 2] for s in ti.static(range(TILE))])
                        g_u = ti.Vector(
                            [grad_pixels[2 * (target + s) * pixels_step] for s in ti.static(range(TILE))]
                        )
                        g_v = ti.Vector(
                            [
                                grad_pixels[(2 * (target + s) + 1) * pixels_step]
                                for s in ti.static(range(TILE))
                            ]
                        )
                        g_d = ti.Vector(
                            [grad_depth[(target + s) * depth_step] for s in ti.static(range(TILE))]
                        )
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
                        if not first:  # once for the whole tile: in each lane it would be a branch
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
                    for i in range(tiles * TILE, count):
                        source = (cloud * count + i) * 3
                        target = view * count + i
                        p = ti.Vector([points[source], points[source + 1], points[source + 2], real(1.0)])
                        g0, g1, g2 = pull_back(
                            m,
                            p[0],
                            p[1],
                            p[2],
                            grad_pixels[2 * target * pixels_step],
                            grad_pixels[(2 * target + 1) * pixels_step],
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
                        grad_projection[view * 12 + e] = total[e]

    @ti.kernel
    def unproject(
        depth: maps3,
        back_projection: matrices2,
        points: points3,
        lengths: integers,
        spread: ti.i32,
    ):
        """Pixel centres at their depth, the foreground only, one behind the other."""
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
    def pixel_to_world(m: ti.template(), u, v):
        """The world point at a pixel is its depth times this direction, plus the optical centre m[3], m[7], m[11]."""
        return ti.Vector([m[4 * k] * u + m[4 * k + 1] * v + m[4 * k + 2] for k in ti.static(range(3))])

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
        """Unproject and project in one pass over a map. `total` receives the sum of its points' coordinates."""
        for step in range(total.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                b = ti.Vector([back_projection[view * 12 + e] for e in ti.static(range(12))])
                m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                rows = ti.cast(target_height, real)
                columns = ti.cast(target_width, real)
                sum_of_coordinates = real(0.0)
                for row in range(height):
                    for column in range(width):
                        at = (view * height + row) * width + column
                        d = depth[at]
                        x = ti.Vector([real(0.0) for _ in ti.static(range(3))])
                        u = real(ti.math.inf)
                        v = real(ti.math.inf)
                        w = real(ti.math.inf)
                        inside = False
                        if d < ti.math.inf:
                            ray = pixel_to_world(
                                b, ti.cast(column, real) + real(0.5), ti.cast(row, real) + real(0.5)
                            )
                            for k in ti.static(range(3)):
                                x[k] = d * ray[k] + b[4 * k + 3]
                            sum_of_coordinates += x[0] + x[1] + x[2]
                            w = m[8] * x[0] + m[9] * x[1] + m[10] * x[2] + m[11]
                            if w > real(0.0):
                                inverse = real(1.0) / w
                                u = (m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[3]) * inverse
                                v = (m[4] * x[0] + m[5] * x[1] + m[6] * x[2] + m[7]) * inverse
                                inside = (u >= real(0.0)) & (u < columns) & (v >= real(0.0)) & (v < rows)
                        for k in ti.static(range(3)):
                            points[3 * at + k] = x[k]
                        pixels[2 * at] = u
                        pixels[2 * at + 1] = v
                        seen[at] = w
                        valid[at] = ti.cast(inside, ti.u8)
                total[view] = sum_of_coordinates

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
        height: ti.i32,
        width: ti.i32,
        spread: ti.i32,
    ):
        for step in range(projection.shape[0] // 12 * spread):
            if step % spread == 0:
                view = step // spread
                b = ti.Vector([back_projection[view * 12 + e] for e in ti.static(range(12))])
                m = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                total_b = ti.Vector([real(0.0) for _ in ti.static(range(12))])
                total_m = ti.Vector([real(0.0) for _ in ti.static(range(12))])
                for row in range(height):
                    v = ti.cast(row, real) + real(0.5)
                    for column in range(width):
                        at = (view * height + row) * width + column
                        d = depth[at]
                        g_depth = real(0.0)
                        if d < ti.math.inf:
                            u = ti.cast(column, real) + real(0.5)
                            ray = pixel_to_world(b, u, v)
                            x = ti.Vector([d * ray[k] + b[4 * k + 3] for k in ti.static(range(3))])
                            g0, g1, g2 = pull_back(
                                m,
                                x[0],
                                x[1],
                                x[2],
                                grad_pixels[2 * at],
                                grad_pixels[2 * at + 1],
                                grad_seen[at],
                            )
                            for k in ti.static(range(3)):
                                total_m[k] += g0 * x[k]
                                total_m[4 + k] += g1 * x[k]
                                total_m[8 + k] += g2 * x[k]
                                g = grad_points[3 * at + k] + g0 * m[k] + g1 * m[4 + k] + g2 * m[8 + k]
                                g_depth += g * ray[k]
                                total_b[4 * k] += g * d * u
                                total_b[4 * k + 1] += g * d * v
                                total_b[4 * k + 2] += g * d
                                total_b[4 * k + 3] += g
                            total_m[3] += g0
                            total_m[7] += g1
                            total_m[11] += g2
                        grad_depth[at] = g_depth
                for e in ti.static(range(12)):
                    grad_back_projection[view * 12 + e] = total_b[e]
                    grad_projection[view * 12 + e] = total_m[e]

    return SimpleNamespace(
        project=project,
        project_backward=project_backward,
        unproject=unproject,
        unproject_backward=unproject_backward,
        reproject=reproject,
        reproject_backward=reproject_backward,
    )
