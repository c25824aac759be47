"""Point splatting to depth maps with a contributor index, and the compaction of visible points."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    cameras2 = ti.types.ndarray(dtype=real, ndim=2)
    maps3 = ti.types.ndarray(dtype=real, ndim=3)
    index3 = ti.types.ndarray(dtype=ti.i64, ndim=3)
    index2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    flags2 = ti.types.ndarray(dtype=ti.u8, ndim=2)

    @ti.func
    def image_position(points: ti.template(), camera: ti.template(), cloud: ti.i32, view: ti.i32, i: ti.i32):
        x = points[cloud, i, 0]
        y = points[cloud, i, 1]
        z = points[cloud, i, 2]
        d = camera[view, 8] * x + camera[view, 9] * y + camera[view, 10] * z + camera[view, 11]
        u = (camera[view, 0] * x + camera[view, 1] * y + camera[view, 2] * z + camera[view, 3]) / d
        v = (camera[view, 4] * x + camera[view, 5] * y + camera[view, 6] * z + camera[view, 7]) / d
        return u, v, d

    @ti.kernel
    def forward(
        points: points3,
        lengths: integers,
        projection: cameras2,
        depth: maps3,
        index: index3,
        visible: flags2,
        views: ti.i32,
        spread: ti.i32,
    ):
        """One pixel per point. One thread owns one map; the nearest depth wins, then the lowest index."""
        height = depth.shape[1]
        width = depth.shape[2]
        for step in range(depth.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                for row in range(height):
                    for column in range(width):
                        depth[view, row, column] = real(ti.math.inf)
                for row in range(height):
                    for column in range(width):
                        index[view, row, column] = -1
                for i in range(points.shape[1]):
                    visible[view, i] = ti.u8(0)
                for i in range(ti.cast(lengths[cloud], ti.i32)):
                    u, v, d = image_position(points, projection, cloud, view, i)
                    if d > 0 and u >= 0 and u < width and v >= 0 and v < height:
                        column = ti.cast(u, ti.i32)
                        row = ti.cast(v, ti.i32)
                        if d < depth[view, row, column]:
                            loser = ti.cast(index[view, row, column], ti.i32)
                            if loser >= 0:
                                visible[view, loser] = ti.u8(0)
                            depth[view, row, column] = d
                            index[view, row, column] = i
                            visible[view, i] = ti.u8(1)

    @ti.kernel
    def forward_disc(
        points: points3,
        lengths: integers,
        projection: cameras2,
        depth: maps3,
        index: index3,
        visible: flags2,
        views: ti.i32,
        radius: real,
        spread: ti.i32,
    ):
        """Each point covers its own pixel and those whose centre lies within `radius` pixels of it."""
        height = depth.shape[1]
        width = depth.shape[2]
        for step in range(depth.shape[0] * spread):
            if step % spread == 0:
                view = step // spread
                cloud = view // views
                for row in range(height):
                    for column in range(width):
                        depth[view, row, column] = real(ti.math.inf)
                        index[view, row, column] = -1
                for i in range(points.shape[1]):
                    visible[view, i] = ti.u8(0)
                for i in range(ti.cast(lengths[cloud], ti.i32)):
                    u, v, d = image_position(points, projection, cloud, view, i)
                    margin = radius + real(1.0)
                    if d > 0 and u > -margin and u < width + margin and v > -margin and v < height + margin:
                        own_column = ti.cast(ti.floor(u), ti.i32)
                        own_row = ti.cast(ti.floor(v), ti.i32)
                        first_row = ti.max(
                            ti.min(ti.cast(ti.ceil(v - radius - real(0.5)), ti.i32), own_row), 0
                        )
                        last_row = ti.min(
                            ti.max(ti.cast(ti.floor(v + radius - real(0.5)), ti.i32), own_row), height - 1
                        )
                        first_column = ti.max(
                            ti.min(ti.cast(ti.ceil(u - radius - real(0.5)), ti.i32), own_column), 0
                        )
                        last_column = ti.min(
                            ti.max(ti.cast(ti.floor(u + radius - real(0.5)), ti.i32), own_column), width - 1
                        )
                        for row in range(first_row, last_row + 1):
                            for column in range(first_column, last_column + 1):
                                du = ti.cast(column, real) + real(0.5) - u
                                dv = ti.cast(row, real) + real(0.5) - v
                                covered = du * du + dv * dv <= radius * radius
                                own = row == own_row and column == own_column
                                if (covered or own) and d < depth[view, row, column]:
                                    depth[view, row, column] = d
                                    index[view, row, column] = i
                for row in range(height):
                    for column in range(width):
                        i = ti.cast(index[view, row, column], ti.i32)
                        if i >= 0:
                            visible[view, i] = ti.u8(1)

    @ti.kernel
    def backward(
        points: points3,
        projection: cameras2,
        index: index3,
        grad_depth: maps3,
        grad_points: points3,
        grad_projection: cameras2,
        views: ti.i32,
        spread: ti.i32,
    ):
        """depth = projection[2] @ (point, 1). One thread owns one cloud and all its views."""
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for view in range(cloud * views, cloud * views + views):
                    for row in range(index.shape[1]):
                        for column in range(index.shape[2]):
                            i = ti.cast(index[view, row, column], ti.i32)
                            if i >= 0:
                                g = grad_depth[view, row, column]
                                for k in ti.static(range(3)):
                                    grad_points[cloud, i, k] += g * projection[view, 8 + k]
                                    grad_projection[view, 8 + k] += g * points[cloud, i, k]
                                grad_projection[view, 11] += g

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
