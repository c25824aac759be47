"""Point splatting to depth maps with a contributor index, and the compaction of visible points."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti


def build(real):
    # Flat arrays and the camera in registers: indexing in three dimensions would cost more than the arithmetic.
    reals = ti.types.ndarray(dtype=real, ndim=1)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    flags = ti.types.ndarray(dtype=ti.u8, ndim=1)
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    index2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
    flags2 = ti.types.ndarray(dtype=ti.u8, ndim=2)

    @ti.func
    def clear(depth: ti.template(), index: ti.template(), visible: ti.template(), view, pixels, count):
        for p in range(view * pixels, view * pixels + pixels):
            depth[p] = real(ti.math.inf)
        for p in range(view * pixels, view * pixels + pixels):
            index[p] = -1
        for i in range(view * count, view * count + count):
            visible[i] = ti.u8(0)

    @ti.func
    def mark_winners(index: ti.template(), visible: ti.template(), view, pixels, count):
        for p in range(view * pixels, view * pixels + pixels):
            i = ti.cast(index[p], ti.i32)
            if i >= 0:
                visible[view * count + i] = ti.u8(1)

    @ti.func
    def image_position(points: ti.template(), camera: ti.template(), offset):
        x = points[offset]
        y = points[offset + 1]
        z = points[offset + 2]
        d = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
        inverse = real(1.0) / d
        u = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) * inverse
        v = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) * inverse
        return u, v, d

    @ti.kernel
    def forward(
        points: reals,
        lengths: integers,
        projection: reals,
        depth: reals,
        index: integers,
        visible: flags,
        views: ti.i32,
        count: ti.i32,
        height: ti.i32,
        width: ti.i32,
        spread: ti.i32,
    ):
        """One pixel per point. One thread owns one map; the nearest depth wins, then the lowest index."""
        pixels = height * width
        for step in range(lengths.shape[0] * views * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                clear(depth, index, visible, view, pixels, count)
                camera = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                columns = ti.cast(width, real)
                rows = ti.cast(height, real)
                for i in range(ti.cast(lengths[cloud], ti.i32)):
                    u, v, d = image_position(points, camera, (cloud * count + i) * 3)
                    # Bitwise "and", and a select for the winner: both choices are cheaper than a missed branch.
                    if (d > real(0.0)) & (u >= real(0.0)) & (u < columns) & (v >= real(0.0)) & (v < rows):
                        p = view * pixels + ti.cast(v, ti.i32) * width + ti.cast(u, ti.i32)
                        wins = d < depth[p]
                        depth[p] = ti.select(wins, d, depth[p])
                        index[p] = ti.select(wins, ti.cast(i, ti.i64), index[p])
                mark_winners(index, visible, view, pixels, count)

    @ti.kernel
    def forward_disc(
        points: reals,
        lengths: integers,
        projection: reals,
        depth: reals,
        index: integers,
        visible: flags,
        views: ti.i32,
        count: ti.i32,
        height: ti.i32,
        width: ti.i32,
        radius: real,
        spread: ti.i32,
    ):
        """Each point covers its own pixel and those whose centre lies within `radius` pixels of it."""
        pixels = height * width
        for step in range(lengths.shape[0] * views * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                clear(depth, index, visible, view, pixels, count)
                camera = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                margin = radius + real(1.0)
                half = real(0.5)
                for i in range(ti.cast(lengths[cloud], ti.i32)):
                    u, v, d = image_position(points, camera, (cloud * count + i) * 3)
                    if (d > 0) & (u > -margin) & (u < width + margin) & (v > -margin) & (v < height + margin):
                        own_column = ti.cast(ti.floor(u), ti.i32)
                        own_row = ti.cast(ti.floor(v), ti.i32)
                        top = ti.max(ti.min(ti.cast(ti.ceil(v - radius - half), ti.i32), own_row), 0)
                        bottom = ti.min(
                            ti.max(ti.cast(ti.floor(v + radius - half), ti.i32), own_row), height - 1
                        )
                        left = ti.max(ti.min(ti.cast(ti.ceil(u - radius - half), ti.i32), own_column), 0)
                        right = ti.min(
                            ti.max(ti.cast(ti.floor(u + radius - half), ti.i32), own_column), width - 1
                        )
                        for row in range(top, bottom + 1):
                            for column in range(left, right + 1):
                                p = view * pixels + row * width + column
                                du = ti.cast(column, real) + half - u
                                dv = ti.cast(row, real) + half - v
                                covered = du * du + dv * dv <= radius * radius
                                own = (row == own_row) & (column == own_column)
                                wins = (covered | own) & (d < depth[p])
                                depth[p] = ti.select(wins, d, depth[p])
                                index[p] = ti.select(wins, ti.cast(i, ti.i64), index[p])
                mark_winners(index, visible, view, pixels, count)

    @ti.kernel
    def backward(
        points: reals,
        projection: reals,
        index: integers,
        grad_depth: reals,
        grad_points: reals,
        grad_projection: reals,
        views: ti.i32,
        count: ti.i32,
        pixels: ti.i32,
        spread: ti.i32,
    ):
        """depth = projection[2] @ (point, 1). One thread owns one cloud and all its views."""
        for step in range(points.shape[0] // (3 * count) * spread):
            if step % spread == 0:
                cloud = step // spread
                for view in range(cloud * views, cloud * views + views):
                    row = ti.Vector([projection[view * 12 + 8 + k] for k in ti.static(range(3))])
                    total = ti.Vector([real(0.0) for k in ti.static(range(4))])
                    for p in range(view * pixels, view * pixels + pixels):
                        i = ti.cast(index[p], ti.i32)
                        if i >= 0:
                            g = grad_depth[p]
                            offset = (cloud * count + i) * 3
                            for k in ti.static(range(3)):
                                grad_points[offset + k] += g * row[k]
                                total[k] += g * points[offset + k]
                            total[3] += g
                    for k in ti.static(range(4)):
                        grad_projection[view * 12 + 8 + k] = total[k]

    @ti.kernel
    def gather_visible(
        points: points3,
        visible: flags2,
        sampled: points3,
        index: index2,
        views: ti.i32,
        spread: ti.i32,
    ):
        """Visible points moved to the front of each view's row, in their own order; zeros and -1 behind."""
        for step in range(visible.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                slot = 0
                for i in range(points.shape[1]):
                    if visible[view, i] != 0:
                        for k in ti.static(range(3)):
                            sampled[view, slot, k] = points[cloud, i, k]
                        index[view, slot] = i
                        slot += 1
                for rest in range(slot, sampled.shape[1]):
                    for k in ti.static(range(3)):
                        sampled[view, rest, k] = real(0.0)
                    index[view, rest] = -1

    @ti.kernel
    def scatter_visible(
        index: index2, grad_sampled: points3, grad_points: points3, views: ti.i32, spread: ti.i32
    ):
        for step in range(grad_points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for view in range(cloud * views, cloud * views + views):
                    for slot in range(index.shape[1]):
                        i = ti.cast(index[view, slot], ti.i32)
                        if i >= 0:
                            for k in ti.static(range(3)):
                                grad_points[cloud, i, k] += grad_sampled[view, slot, k]

    return SimpleNamespace(
        forward=forward,
        forward_disc=forward_disc,
        backward=backward,
        gather_visible=gather_visible,
        scatter_visible=scatter_visible,
    )
