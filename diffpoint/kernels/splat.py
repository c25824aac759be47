"""Point splatting to depth maps with the index of each pixel's point."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

TILE = 8  # points whose image positions are computed at once, in vector registers
EMPTY = 0x7F800000_FFFFFFFF  # the key of an empty pixel: the bits of +inf, then those of -1


def build(real):
    # A float32 depth and a point index form one 64-bit key: the bits of positive floats sort like their values, so the
    # smallest key is the nearest depth, then the lowest index. The index map holds the keys until they are decoded.
    packed = real == ti.f32
    # The camera in registers, clouds as flat arrays: indexing in three dimensions takes longer than the arithmetic.
    reals = ti.types.ndarray(dtype=real, ndim=1)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    flags = ti.types.ndarray(dtype=ti.u8, ndim=1)

    @ti.func
    def image_position(camera: ti.template(), x, y, z):
        """Pixel position and depth, of one point or of a vector of them: the same operations, hence the same bits."""
        d = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
        inverse = real(1.0) / d
        u = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) * inverse
        v = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) * inverse
        return u, v, d

    @ti.func
    def image_position_of(camera: ti.template(), points: ti.template(), i):
        return image_position(camera, points[3 * i], points[3 * i + 1], points[3 * i + 2])

    @ti.func
    def fill(values: ti.template(), start, stop, value):
        """Sixteen at a time, because a loop between two computed bounds is not vectorised."""
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
        """Point `i` takes its pixel of the map at start[0] if it is nearer; `visible` begins at start[1]."""
        if (d > real(0.0)) & (u >= real(0.0)) & (u < size[1]) & (v >= real(0.0)) & (v < size[0]):
            p = start[0] + ti.cast(v, ti.i32) * ti.cast(size[1], ti.i32) + ti.cast(u, ti.i32)
            # Selects instead of branches, which would be unpredictable and therefore slower.
            owner = ti.cast(index[p], ti.i32)
            before = depth[p]
            wins = d < before
            depth[p] = ti.select(wins, d, before)
            index[p] = ti.select(wins, i, owner)
            visible[start[1] + ti.select(wins & (owner >= 0), owner, i)] = ti.u8(0)
            visible[start[1] + i] = ti.cast(wins, ti.u8)

    @ti.func
    def clear(depth: ti.template(), index: ti.template(), start, stop):
        if ti.static(packed):
            fill(index, start, stop, ti.i64(EMPTY))
        else:
            fill(depth, start, stop, real(ti.math.inf))
            fill(index, start, stop, ti.i64(-1))

    @ti.func
    def offer(depth: ti.template(), index: ti.template(), p, i, d):
        """Point `i` of depth `d` takes pixel `p` if it is nearer; never with depth NaN.

        By selects, because a branch would be unpredictable.
        """
        if ti.static(packed):
            key = (ti.cast(ti.bit_cast(d, ti.i32), ti.i64) << 32) | ti.cast(i, ti.i64)
            before = index[p]
            index[p] = ti.select(key < before, key, before)
        else:
            before = depth[p]
            owner = index[p]
            wins = (d < before) | ((d == before) & (i < owner))
            depth[p] = ti.select(wins, d, before)
            index[p] = ti.select(wins, ti.cast(i, ti.i64), owner)

    @ti.func
    def decode_one(depth: ti.template(), index: ti.template(), p):
        key = index[p]
        depth[p] = ti.bit_cast(ti.cast(key >> 32, ti.i32), real)
        index[p] = ti.cast(ti.cast(key, ti.i32), ti.i64)

    @ti.func
    def decode(depth: ti.template(), index: ti.template(), start, stop):
        """Sixteen at a time, as in `fill`."""
        blocks = (stop - start) // 16
        for block in range(blocks):
            for s in ti.static(range(16)):
                decode_one(depth, index, start + block * 16 + s)
        for p in range(start + blocks * 16, stop):
            decode_one(depth, index, p)

    @ti.func
    def within(x, low, high):
        """Clamp to [low, high], NaN to low; in this form it compiles to two instructions."""
        above = ti.select(x > low, x, low)
        return ti.select(above < high, above, high)

    @ti.func
    def floor_of(x):
        """Floor of a value in the range of int32; ti.floor takes ten times as long."""
        cut = ti.cast(x, ti.i32)
        return ti.select(ti.cast(cut, real) > x, cut - 1, cut)

    @ti.func
    def cover_disc(depth: ti.template(), index: ti.template(), start, i, u, v, d, size, radius):
        """Point `i` takes its own pixel and those whose centre lies within `radius` pixels, where it is nearer."""
        half = real(0.5)
        margin = radius + real(1.0)
        if (d > real(0.0)) & (u > -margin) & (u < size[1] + margin) & (v > -margin) & (v < size[0] + margin):
            columns = ti.cast(size[1], ti.i32)
            own_row = floor_of(within(v, real(-1.0), size[0]))
            own_column = floor_of(within(u, real(-1.0), size[1]))
            # From ceil(v - radius - 1/2) to floor(v + radius - 1/2), and a quarter of a pixel for rounding.
            reach = ti.max(radius, half) - real(0.25)
            top = floor_of(within(v - reach, real(0.0), size[0]))
            bottom = floor_of(within(v + reach, real(-1.0), size[0] - real(1.0)))
            left = floor_of(within(u - reach, real(0.0), size[1]))
            right = floor_of(within(u + reach, real(-1.0), size[1] - real(1.0)))
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    du = ti.cast(column, real) + half - u
                    dv = ti.cast(row, real) + half - v
                    own = (row == own_row) & (column == own_column)
                    covered = own | (du * du + dv * dv <= radius * radius)
                    candidate = ti.select(covered, d, real(ti.math.nan))
                    offer(depth, index, start + row * columns + column, i, candidate)

    @ti.func
    def reaches(x_own, y_own, du, dv, reach):
        return (x_own & y_own) | (du * du + dv * dv <= reach)

    @ti.func
    def cover_four(
        depth: ti.template(), index: ti.template(), start, i: ti.template(), u, v, d, size, radius
    ):
        """`cover_disc` of a tile of points, of which `i` is the first, for a radius of at most 1.

        Only the four pixels with the nearest centres can be covered, so there is no loop and no branch. A pixel outside
        the map is replaced by its neighbour inside, with a depth that never wins.

        Returns:
            Whether a point is so near to its pixel's centre that it may cover more than these four.
        """
        zero = real(0.0)
        half = real(0.5)
        one = real(1.0)
        nan = real(ti.math.nan)
        # The lower right one of the four pixels; the others are its left and upper neighbours. As floats, for which
        # more vector instructions exist than for integers.
        right = ti.cast(ti.cast(within(u + half, zero, size[1]), ti.i32), real)
        bottom = ti.cast(ti.cast(within(v + half, zero, size[0]), ti.i32), real)
        du0 = right - half - u
        du1 = right + half - u
        dv0 = bottom - half - v
        dv1 = bottom + half - v
        own0 = u < right
        own1 = u >= right
        above = v < bottom
        below = v >= bottom
        reach = radius * radius
        in0 = (right >= one) & (d > zero)
        in1 = (right < size[1]) & (d > zero)
        in_top = bottom >= one
        in_bottom = bottom < size[0]
        d00 = ti.select(in_top & in0 & reaches(own0, above, du0, dv0, reach), d, nan)
        d01 = ti.select(in_top & in1 & reaches(own1, above, du1, dv0, reach), d, nan)
        d10 = ti.select(in_bottom & in0 & reaches(own0, below, du0, dv1, reach), d, nan)
        d11 = ti.select(in_bottom & in1 & reaches(own1, below, du1, dv1, reach), d, nan)
        column0 = ti.cast(ti.select(right > one, right - one, zero), ti.i32)
        column1 = ti.cast(ti.select(right < size[1] - one, right, size[1] - one), ti.i32)
        row0 = ti.cast(ti.select(bottom > one, bottom - one, zero), ti.i32)
        row1 = ti.cast(ti.select(bottom < size[0] - one, bottom, size[0] - one), ti.i32)
        width = ti.cast(size[1], ti.i32)
        for s in ti.static(range(TILE)):
            p0 = start + row0[s] * width
            p1 = start + row1[s] * width
            offer(depth, index, p0 + column0[s], i + s, d00[s])
            offer(depth, index, p0 + column1[s], i + s, d01[s])
            offer(depth, index, p1 + column0[s], i + s, d10[s])
            offer(depth, index, p1 + column1[s], i + s, d11[s])
        du = ti.select(du0 * du0 < du1 * du1, du0 * du0, du1 * du1)
        dv = ti.select(dv0 * dv0 < dv1 * dv1, dv0 * dv0, dv1 * dv1)
        nearest = ti.select(du < dv, du, dv).min()
        return nearest < real(1e-10)  # far more than the rounding errors of u + half

    @ti.func
    def mark_owners(index: ti.template(), visible: ti.template(), start, pixels):
        """Without a branch: an empty pixel sets the flag of point 0, which is corrected afterwards."""
        owned = ti.u8(0)
        for p in range(start[0], start[0] + pixels):
            owner = ti.cast(index[p], ti.i32)
            visible[start[1] + ti.max(owner, 0)] = ti.u8(1)
            owned = ti.select(owner == 0, ti.u8(1), owned)
        visible[start[1]] = owned

    def make_forward(disc, serial):
        """The splat of single pixels or of discs; on all threads, or on one for small clouds."""

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
            """One thread per map; the nearest depth is kept, then the lowest index.

            The points of a view may be divided among `parts` maps, which `merge` then combines. `total`
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
                    if ti.static(disc):
                        clear(depth, index, start[0], start[0] + pixels)
                    else:
                        fill(depth, start[0], start[0] + pixels, real(ti.math.inf))
                        fill(index, start[0], start[0] + pixels, ti.i64(-1))
                    share = (count + parts - 1) // parts
                    first = (at % parts) * share
                    stop = ti.min(first + share, count)
                    fill(visible, start[1] + first, start[1] + stop, ti.u8(0))
                    last = ti.min(ti.cast(lengths[cloud], ti.i32), stop)
                    camera = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
                    size = ti.Vector([ti.cast(height, real), ti.cast(width, real)])
                    tiles = ti.max(last - first, 0) // TILE
                    if ti.static(disc):
                        tiles = ti.select(radius > real(1.0), 0, tiles)
                    sums = ti.Vector([real(0.0) for _ in ti.static(range(TILE))])
                    for t in range(tiles):
                        i = first + t * TILE
                        offset = (cloud * count + i) * 3
                        x = ti.Vector([points[offset + 3 * s] for s in ti.static(range(TILE))])
                        y = ti.Vector([points[offset + 3 * s + 1] for s in ti.static(range(TILE))])
                        z = ti.Vector([points[offset + 3 * s + 2] for s in ti.static(range(TILE))])
                        u, v, d = image_position(camera, x, y, z)
                        sums += d
                        if ti.static(disc):
                            if cover_four(depth, index, start[0], i, u, v, d, size, radius):
                                for j in range(i, i + TILE):
                                    a, b, c = image_position_of(camera, points, cloud * count + j)
                                    cover_disc(depth, index, start[0], j, a, b, c, size, radius)
                        else:
                            for s in ti.static(range(TILE)):
                                cover_one(depth, index, visible, start, i + s, u[s], v[s], d[s], size)
                    rest = sums.sum()
                    for i in range(first + tiles * TILE, last):
                        u, v, d = image_position_of(camera, points, cloud * count + i)
                        rest += d
                        if ti.static(disc):
                            cover_disc(depth, index, start[0], i, u, v, d, size, radius)
                        else:
                            cover_one(depth, index, visible, start, i, u, v, d, size)
                    total[at] = rest
                    if ti.static(disc):
                        if ti.static(packed):
                            decode(depth, index, start[0], start[0] + pixels)
                        if parts == 1:
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
        """Combines the maps of parts of a cloud; parts are in the order of points, so the first of a tie is kept."""
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
        """depth = projection[2] @ (point, 1). One thread per cloud handles all its views, so no addition is atomic."""
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

    return SimpleNamespace(
        forward=make_forward(disc=False, serial=False),
        forward_alone=make_forward(disc=False, serial=True),
        forward_disc=make_forward(disc=True, serial=False),
        forward_disc_alone=make_forward(disc=True, serial=True),
        merge=merge,
        backward=backward,
    )
