"""Point splatting to depth maps with a contributor index, and the compaction of visible points."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

TILE = 8  # points whose image positions are computed at once, in vector registers


def build(real):
    # The camera in registers, clouds as flat arrays: indexing in three dimensions would cost more than the arithmetic.
    reals = ti.types.ndarray(dtype=real, ndim=1)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    flags = ti.types.ndarray(dtype=ti.u8, ndim=1)
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    index2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
    flags2 = ti.types.ndarray(dtype=ti.u8, ndim=2)

    @ti.func
    def image_position(camera: ti.template(), x, y, z):
        """Pixel position and depth, of one point or of a vector of them: the same operations, hence the same bits."""
        d = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
        inverse = real(1.0) / d
        u = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) * inverse
        v = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) * inverse
        return u, v, d

    @ti.func
    def fill(values: ti.template(), start, stop, value):
        """Sixteen at a time, because a loop between two computed bounds is not packed."""
        blocks = (stop - start) // 16
        for block in range(blocks):
            for s in ti.static(range(16)):
                values[start + block * 16 + s] = value
        for i in range(start + blocks * 16, stop):
            values[i] = value

    @ti.func
    def cover_one(
        depth: ti.template(), index: ti.template(), visible: ti.template(), start, i, u, v, d, size
    ):
        """Point `i` competes for its pixel of the map at start[0]; visible, at start[1], follows who owns it."""
        if (d > real(0.0)) & (u >= real(0.0)) & (u < size[1]) & (v >= real(0.0)) & (v < size[0]):
            p = start[0] + ti.cast(v, ti.i32) * ti.cast(size[1], ti.i32) + ti.cast(u, ti.i32)
            # Selects instead of branches: whether a point wins cannot be foreseen, and a missed branch costs more.
            owner = ti.cast(index[p], ti.i32)
            before = depth[p]
            wins = d < before
            depth[p] = ti.select(wins, d, before)
            index[p] = ti.select(wins, i, owner)
            visible[start[1] + ti.select(wins & (owner >= 0), owner, i)] = ti.u8(0)
            visible[start[1] + i] = ti.cast(wins, ti.u8)

    @ti.func
    def floor_within(x, size):
        """floor(x) cut to [-1, size], so that it fits an integer; a call of ti.floor would cost ten times as much."""
        return ti.select(x >= real(0.0), ti.cast(ti.select(x < size, x, size), ti.i32), -1)

    @ti.func
    def ceil_within(x, size):
        below = floor_within(x, size)
        return ti.select(ti.cast(below, real) < x, below + 1, below)

    @ti.func
    def cover_disc(depth: ti.template(), index: ti.template(), start, i, u, v, d, size, radius):
        """Point `i` competes for its own pixel and for those whose centre lies within `radius` pixels of it."""
        margin = radius + real(1.0)
        half = real(0.5)
        if (d > real(0.0)) & (u > -margin) & (u < size[1] + margin) & (v > -margin) & (v < size[0] + margin):
            own_row = floor_within(v, size[0])
            own_column = floor_within(u, size[1])
            top = ti.max(ti.min(ceil_within(v - radius - half, size[0]), own_row), 0)
            left = ti.max(ti.min(ceil_within(u - radius - half, size[1]), own_column), 0)
            width = ti.cast(size[1], ti.i32)
            bottom = ti.max(floor_within(v + radius - half, size[0]), own_row)
            bottom = ti.min(bottom, ti.cast(size[0], ti.i32) - 1)
            right = ti.min(ti.max(floor_within(u + radius - half, size[1]), own_column), width - 1)
            # One loop over both: a loop over a row's few pixels would be unrolled and guarded at greater cost.
            row = top
            column = left
            for _ in range(ti.max(bottom - top + 1, 0) * ti.max(right - left + 1, 0)):
                p = start[0] + row * width + column
                du = ti.cast(column, real) + half - u
                dv = ti.cast(row, real) + half - v
                # Each select hangs on one comparison of floats: of several conditions a branch would be made.
                apart = ti.select((row == own_row) & (column == own_column), 0, 1)
                reached = ti.cast(apart, real) * (du * du + dv * dv) <= radius * radius
                candidate = ti.select(reached, d, real(ti.math.inf))
                before = depth[p]
                owner = index[p]
                wins = candidate < before
                depth[p] = ti.select(wins, candidate, before)
                index[p] = ti.select(wins, ti.cast(i, ti.i64), owner)
                ends = column == right
                row = ti.select(ends, row + 1, row)
                column = ti.select(ends, left, column + 1)

    @ti.func
    def cover_four(depth: ti.template(), index: ti.template(), start, i, u, v, d, size, radius):
        """`cover_disc` away from the map's edge, for a radius of at most 1: the own pixel, and on the nearer side of it
        one of its row, one of its column and one across. Without a loop, whose branches would be missed."""
        half = real(0.5)
        column = ti.cast(u, ti.i32)
        row = ti.cast(v, ti.i32)
        beside = ti.select(u - ti.cast(column, real) < half, -1, 1)
        above = ti.select(v - ti.cast(row, real) < half, -1, 1)
        width = ti.cast(size[1], ti.i32)
        for k in ti.static(range(4)):
            c = column + beside * (k % 2)
            r = row + above * (k // 2)
            du = ti.cast(c, real) + half - u
            dv = ti.cast(r, real) + half - v
            # Out of reach, it competes for its own pixel again, in vain: one select less, hence no branch.
            reached = du * du + dv * dv <= radius * radius
            offset = above * (k // 2) * width + beside * (k % 2)
            p = start[0] + row * width + column + ti.select(reached, offset, 0)
            before = depth[p]
            owner = ti.cast(index[p], ti.i32)
            wins = d < before
            depth[p] = ti.select(wins, d, before)
            index[p] = ti.select(wins, i, owner)

    @ti.func
    def mark_owners(index: ti.template(), visible: ti.template(), start, pixels):
        """Without a branch: an empty pixel marks point 0, whose own flag is put right afterwards."""
        owned = ti.u8(0)
        for p in range(start[0], start[0] + pixels):
            owner = ti.cast(index[p], ti.i32)
            visible[start[1] + ti.max(owner, 0)] = ti.u8(1)
            owned = ti.select(owner == 0, ti.u8(1), owned)
        visible[start[1]] = owned

    def make_forward(disc, serial):
        """The splat of single pixels or of discs; on all threads, or without waking them for a small cloud."""

        @ti.kernel
        def forward(
            points: reals,
            lengths: integers,
            projection: reals,
            depth: reals,
            index: integers,
            visible: flags,
            total: reals,
            views: ti.i32,
            parts: ti.i32,
            count: ti.i32,
            height: ti.i32,
            width: ti.i32,
            radius: real,
            spread: ti.i32,
        ):
            """One thread owns one map; the nearest depth wins, then the lowest index.

            The points of a view may be shared out among `parts` maps, which `merge` then brings together. `total`
            receives the sum of the depths of each map's points: it is NaN or infinite if one of their coordinates is.
            """
            ti.loop_config(serialize=serial)
            pixels = height * width
            for step in range(total.shape[0] * spread):
                if step % spread == 0:
                    at = step // spread
                    view = at // parts
                    cloud = view // views
                    start = ti.Vector([at * pixels, view * count])  # of the map, and of the view's flags
                    fill(depth, start[0], start[0] + pixels, real(ti.math.inf))
                    fill(index, start[0], start[0] + pixels, ti.i64(-1))
                    share = (count + parts - 1) // parts
                    first = (at % parts) * share
                    stop = ti.min(first + share, count)
                    fill(visible, start[1] + first, start[1] + stop, ti.u8(0))
                    last = ti.min(ti.cast(lengths[cloud], ti.i32), stop)
                    camera = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                    size = ti.Vector([ti.cast(height, real), ti.cast(width, real)])
                    # The loops over a disc outweigh the arithmetic of its point, and are not worth eight copies.
                    tiles = 0 if ti.static(disc) else ti.max(last - first, 0) // TILE
                    sums = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                    for t in range(tiles):
                        i = first + t * TILE
                        offset = (cloud * count + i) * 3
                        x = ti.Vector([points[offset + 3 * s] for s in ti.static(range(TILE))])
                        y = ti.Vector([points[offset + 3 * s + 1] for s in ti.static(range(TILE))])
                        z = ti.Vector([points[offset + 3 * s + 2] for s in ti.static(range(TILE))])
                        u, v, d = image_position(camera, x, y, z)
                        sums += d
                        for s in ti.static(range(TILE)):
                            cover_one(depth, index, visible, start, i + s, u[s], v[s], d[s], size)
                    rest = sums.sum()
                    for i in range(first + tiles * TILE, last):
                        offset = (cloud * count + i) * 3
                        u, v, d = image_position(
                            camera, points[offset], points[offset + 1], points[offset + 2]
                        )
                        rest += d
                        if ti.static(disc):
                            inner = (u >= real(1.0)) & (u < size[1] - real(1.0))
                            inner = inner & (v >= real(1.0)) & (v < size[0] - real(1.0)) & (d > real(0.0))
                            # A point in the middle of its pixel may be equally near to both sides.
                            inner = inner & (u - real(0.5) != ti.cast(ti.cast(u, ti.i32), real))
                            inner = inner & (v - real(0.5) != ti.cast(ti.cast(v, ti.i32), real))
                            if inner & (radius <= real(1.0)):
                                cover_four(depth, index, start, i, u, v, d, size, radius)
                            else:
                                cover_disc(depth, index, start, i, u, v, d, size, radius)
                        else:
                            cover_one(depth, index, visible, start, i, u, v, d, size)
                    total[at] = rest
                    if ti.static(disc) and parts == 1:
                        mark_owners(index, visible, start, pixels)

        return forward

    @ti.kernel
    def merge(
        part_depth: reals,
        part_index: integers,
        depth: reals,
        index: integers,
        visible: flags,
        parts: ti.i32,
        count: ti.i32,
        pixels: ti.i32,
        spread: ti.i32,
    ):
        """Maps of the parts of a cloud into one: parts are in the order of the points, so the first of equals wins."""
        for step in range(depth.shape[0] // pixels * spread):
            if step % spread == 0:
                view = step // spread
                for p in range(pixels):
                    d = real(ti.math.inf)
                    owner = ti.i64(-1)
                    for part in range(parts):
                        candidate = part_depth[(view * parts + part) * pixels + p]
                        wins = candidate < d
                        d = ti.select(wins, candidate, d)
                        owner = ti.select(wins, part_index[(view * parts + part) * pixels + p], owner)
                    depth[view * pixels + p] = d
                    index[view * pixels + p] = owner
                fill(visible, view * count, (view + 1) * count, ti.u8(0))
                mark_owners(index, visible, ti.Vector([view * pixels, view * count]), pixels)

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
        """depth = projection[2] @ (point, 1). One thread owns one cloud and all its views, so no addition is atomic."""
        for step in range(points.shape[0] // (3 * count) * spread):
            if step % spread == 0:
                cloud = step // spread
                for e in range(cloud * count * 3, (cloud + 1) * count * 3):
                    grad_points[e] = real(0.0)
                for view in range(cloud * views, cloud * views + views):
                    row = ti.Vector([projection[view * 12 + 8 + k] for k in ti.static(range(3))])
                    total = ti.Vector([real(0.0) for k in ti.static(range(4))])
                    for p in range(view * pixels, view * pixels + pixels):
                        i = ti.cast(index[p], ti.i32)
                        if i >= 0:
                            g = grad_depth[p]
                            offset = (cloud * count + i) * 3
                            for k in ti.static(range(3)):
                                grad_points[offset + k] = grad_points[offset + k] + g * row[k]
                                total[k] += g * points[offset + k]
                            total[3] += g
                    for e in ti.static(range(8)):
                        grad_projection[view * 12 + e] = real(0.0)
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
                                grad_points[cloud, i, k] = (
                                    grad_points[cloud, i, k] + grad_sampled[view, slot, k]
                                )

    return SimpleNamespace(
        forward=make_forward(disc=False, serial=False),
        forward_alone=make_forward(disc=False, serial=True),
        forward_disc=make_forward(disc=True, serial=False),
        forward_disc_alone=make_forward(disc=True, serial=True),
        merge=merge,
        backward=backward,
        gather_visible=gather_visible,
        scatter_visible=scatter_visible,
    )
