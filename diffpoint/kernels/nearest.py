"""Nearest neighbours: a tile of queries in registers against candidates broadcast one by one.

`forward` tries every candidate; `forward_blocks` skips boxes of candidates that are farther from the whole tile than
the nearest candidate found so far by each of its queries. Both give the same distances and the same indices.
"""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK, GROUP, LANES, ROWS, box_tests

CHUNK = 32  # candidates between two updates of the winning chunk
BOX_TILE = 16  # queries that are compared with the boxes together; 32 are no faster and compile twice as long


def build(real):
    tile = 32 if real == ti.f32 else 16  # queries held in vector registers
    clouds = ti.types.ndarray(dtype=real, ndim=3)
    reals = ti.types.ndarray(dtype=real, ndim=1)
    scalars = ti.types.ndarray(dtype=real, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    indices = ti.types.ndarray(dtype=ti.i64, ndim=2)
    orders = ti.types.ndarray(dtype=ti.i32, ndim=2)
    lanes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)

    tests = box_tests(real)
    clamped, gap, reached, most_central = tests.clamped, tests.gap, tests.reached, tests.most_central

    @ti.kernel
    def forward(
        a: clouds,
        b: clouds,
        a_lengths: integers,
        b_lengths: integers,
        squared_distance: scalars,
        index: indices,
        spread: ti.i32,
    ):
        tiles = (a.shape[1] + tile - 1) // tile
        for step in range(a.shape[0] * tiles * spread):
            if step % spread == 0:
                work = step // spread
                cloud = work // tiles
                first = (work - cloud * tiles) * tile
                n = ti.cast(a_lengths[cloud], ti.i32)
                m = ti.cast(b_lengths[cloud], ti.i32)
                if first < n and m > 0:
                    ax = ti.Vector([a[cloud, ti.min(first + s, n - 1), 0] for s in ti.static(range(tile))])
                    ay = ti.Vector([a[cloud, ti.min(first + s, n - 1), 1] for s in ti.static(range(tile))])
                    az = ti.Vector([a[cloud, ti.min(first + s, n - 1), 2] for s in ti.static(range(tile))])
                    least = ti.Vector([real(ti.math.inf) for s in ti.static(range(tile))])
                    winner = ti.Vector([0 for s in ti.static(range(tile))])
                    for chunk in range((m + CHUNK - 1) // CHUNK):
                        # Within a chunk only the minimum is tracked; its index is found afterwards by scanning
                        # that chunk again. This keeps the inner loop vectorised.
                        current = least
                        for j in range(chunk * CHUNK, ti.min(chunk * CHUNK + CHUNK, m)):
                            x = b[cloud, j, 0]
                            y = b[cloud, j, 1]
                            z = b[cloud, j, 2]
                            for s in ti.static(range(tile)):
                                dx = x - ax[s]
                                dy = y - ay[s]
                                dz = z - az[s]
                                d = dx * dx + dy * dy + dz * dz
                                current[s] = ti.select(d < current[s], d, current[s])
                        for s in ti.static(range(tile)):
                            winner[s] = ti.select(current[s] < least[s], chunk, winner[s])
                        least = current
                    for s in range(tile):
                        i = first + s
                        if i < n:
                            chunk = 0
                            for r in ti.static(range(tile)):
                                chunk = ti.select(r == s, winner[r], chunk)
                            best = real(ti.math.inf)
                            best_j = -1  # remains if every squared distance overflows
                            for j in range(chunk * CHUNK, ti.min(chunk * CHUNK + CHUNK, m)):
                                dx = b[cloud, j, 0] - a[cloud, i, 0]
                                dy = b[cloud, j, 1] - a[cloud, i, 1]
                                dz = b[cloud, j, 2] - a[cloud, i, 2]
                                d = dx * dx + dy * dy + dz * dz
                                closer = d < best
                                best_j = ti.select(closer, j, best_j)
                                best = ti.select(closer, d, best)
                            squared_distance[cloud, i] = best
                            index[cloud, i] = best_j
                for s in range(tile):
                    i = first + s
                    if i < squared_distance.shape[1] and (i >= n or m == 0):
                        squared_distance[cloud, i] = ti.select(i < n, real(ti.math.inf), real(0.0))
                        index[cloud, i] = -1

    @ti.kernel
    def forward_blocks(
        a: clouds,
        a_order: orders,
        b: clouds,
        b_order: orders,
        corners: clouds,
        box_lanes: lanes3,
        groups: clouds,
        a_lengths: integers,
        b_lengths: integers,
        squared_distance: scalars,
        index: indices,
        spread: ti.i32,
    ):
        """`a` and `b` as sorted by `blocks.sort`; results are stored in the order before sorting.

        `corners` and `box_lanes` are the same memory: the boxes of `b`.
        """
        tiles = (squared_distance.shape[1] + BOX_TILE - 1) // BOX_TILE
        for step in range(a.shape[0] * tiles * spread):
            if step % spread == 0:
                work = step // spread
                cloud = work // tiles
                first = (work - cloud * tiles) * BOX_TILE
                n = ti.cast(a_lengths[cloud], ti.i32)
                m = ti.cast(b_lengths[cloud], ti.i32)
                if first < n and m > 0:
                    ax = ti.Vector(
                        [a[cloud, ti.min(first + s, n - 1), 0] for s in ti.static(range(BOX_TILE))]
                    )
                    ay = ti.Vector(
                        [a[cloud, ti.min(first + s, n - 1), 1] for s in ti.static(range(BOX_TILE))]
                    )
                    az = ti.Vector(
                        [a[cloud, ti.min(first + s, n - 1), 2] for s in ti.static(range(BOX_TILE))]
                    )
                    low = ti.Vector([ax.min(), ay.min(), az.min()])
                    high = ti.Vector([ax.max(), ay.max(), az.max()])
                    least = ti.Vector([real(ti.math.inf) for s in ti.static(range(BOX_TILE))])
                    winner = ti.Vector([-1 for s in ti.static(range(BOX_TILE))])
                    farthest = real(ti.math.inf)  # of the nearest found so far, over the tile
                    # First the nearest box, then the rest of its group, then the other groups: with a near
                    # candidate found first, most of the rest is skipped.
                    count = corners.shape[2] // GROUP
                    own_group = most_central(groups, cloud, 0, count, low, high)
                    own_box = most_central(
                        corners, cloud, own_group * GROUP, (own_group + 1) * GROUP, low, high
                    )
                    for turn in range(count + 2):
                        group = ti.select(turn < 2, own_group, turn - 2)
                        rows = ROWS
                        if turn >= 2 and (
                            group == own_group or gap(groups, cloud, group, low, high) > farthest
                        ):
                            rows = 0
                        for row in range(group * ROWS, group * ROWS + rows):
                            boxes = ti.select(row == own_box // LANES, 1 << (own_box % LANES), 0)
                            if turn > 0:
                                boxes = reached(box_lanes, cloud, row, low, high, farthest) & ~boxes
                            for lane in range(ti.select(boxes != 0, LANES, 0)):
                                box = row * LANES + lane
                                within = (boxes >> lane) & 1
                                if within != 0:
                                    least_corner = ti.Vector(
                                        [corners[cloud, k, box] for k in ti.static(range(3))]
                                    )
                                    greatest = ti.Vector(
                                        [corners[cloud, k + 3, box] for k in ti.static(range(3))]
                                    )
                                    within = 0
                                    for s in ti.static(range(BOX_TILE)):
                                        dx = clamped(ax[s], least_corner[0], greatest[0]) - ax[s]
                                        dy = clamped(ay[s], least_corner[1], greatest[1]) - ay[s]
                                        dz = clamped(az[s], least_corner[2], greatest[2]) - az[s]
                                        within |= ti.select(dx * dx + dy * dy + dz * dz <= least[s], 1, 0)
                                if within != 0:
                                    current = ti.Vector(
                                        [real(ti.math.inf) for s in ti.static(range(BOX_TILE))]
                                    )
                                    source = ti.Vector([-1 for s in ti.static(range(BOX_TILE))])
                                    for candidate in range(BLOCK):
                                        j = box * BLOCK + candidate
                                        x = b[cloud, j, 0]
                                        y = b[cloud, j, 1]
                                        z = b[cloud, j, 2]
                                        before_sorting = b_order[cloud, j]
                                        for s in ti.static(range(BOX_TILE)):
                                            dx = x - ax[s]
                                            dy = y - ay[s]
                                            dz = z - az[s]
                                            e = dx * dx + dy * dy + dz * dz
                                            nearer = e < current[s]
                                            source[s] = ti.select(nearer, before_sorting, source[s])
                                            current[s] = ti.select(nearer, e, current[s])
                                    for s in ti.static(range(BOX_TILE)):
                                        # In a tie the one with the lowest index before sorting.
                                        other = winner[s]
                                        first_of_equals = ti.select(source[s] < other, source[s], other)
                                        equal = ti.select(current[s] == least[s], first_of_equals, other)
                                        nearer = current[s] < least[s]
                                        source[s] = ti.select(nearer, source[s], equal)
                                        current[s] = ti.select(nearer, current[s], least[s])
                                    least = current
                                    winner = source
                                    farthest = current.max()
                    for s in ti.static(
                        range(BOX_TILE)
                    ):  # without a branch; the last point's result may be stored repeatedly
                        place = a_order[cloud, ti.min(first + s, n - 1)]
                        squared_distance[cloud, place] = least[s]
                        index[cloud, place] = winner[s]
                for s in range(BOX_TILE):
                    i = first + s
                    if i < squared_distance.shape[1] and (i >= n or m == 0):
                        squared_distance[cloud, i] = ti.select(i < n, real(ti.math.inf), real(0.0))
                        index[cloud, i] = -1

    @ti.kernel
    def backward(
        a: reals,
        b: reals,
        index: integers,
        grad_squared_distance: reals,
        grad_a: reals,
        grad_b: reals,
        n: ti.i32,
        m: ti.i32,
        spread: ti.i32,
    ):
        """`index` and `grad_squared_distance` hold as many entries for each of the `n` points of `a` as it has
        neighbours among the `m` of `b`.

        One thread per cloud adds to the gradients in a fixed order, without atomics; in flat arrays, whose offsets take
        half the time, and with the sums of a point of `a` in registers. Shares of a cloud, each with a range of the
        targets and all indices, take as long on two threads as the whole does on one: every other index is then a
        branch that is predicted wrongly. Of both directions of a large pair, see `backward_both`.
        """
        for step in range(a.shape[0] // (3 * n) * spread):
            if step % spread == 0:
                cloud = step // spread
                neighbours = index.shape[0] // (a.shape[0] // 3)
                for i in range(cloud * n, cloud * n + n):
                    point = ti.Vector([a[3 * i + k] for k in ti.static(range(3))])
                    total = ti.Vector([grad_a[3 * i + k] for k in ti.static(range(3))])
                    for entry in range(i * neighbours, (i + 1) * neighbours):
                        j = ti.cast(index[entry], ti.i32)
                        if j >= 0:
                            at = 3 * (cloud * m + j)
                            g = real(2.0) * grad_squared_distance[entry]
                            before = ti.Vector([grad_b[at + k] for k in ti.static(range(3))])
                            component = g * (point - ti.Vector([b[at + k] for k in ti.static(range(3))]))
                            total += component
                            for k in ti.static(range(3)):
                                grad_b[at + k] = before[k] - component[k]  # not -=, which would be atomic
                    for k in ti.static(range(3)):
                        grad_a[3 * i + k] = total[k]

    @ti.func
    def of_one_direction(
        a: ti.template(),
        b: ti.template(),
        index: ti.template(),
        grad_squared_distance: ti.template(),
        grad_a: ti.template(),
        grad_b: ti.template(),
        n,
        m,
        cloud,
    ):
        """Writes the gradients of the distances from a cloud of `a` to its nearest neighbours."""
        for place in range(3 * cloud * m, 3 * (cloud + 1) * m):
            grad_b[place] = real(0.0)
        for i in range(cloud * n, cloud * n + n):
            component = ti.Vector([real(0.0)] * 3)
            j = ti.cast(index[i], ti.i32)
            if j >= 0:
                at = 3 * (cloud * m + j)
                g = real(2.0) * grad_squared_distance[i]
                before = ti.Vector([grad_b[at + k] for k in ti.static(range(3))])
                component = g * ti.Vector([a[3 * i + k] - b[at + k] for k in ti.static(range(3))])
                for k in ti.static(range(3)):
                    grad_b[at + k] = before[k] - component[k]  # not -=, which would be atomic
            for k in ti.static(range(3)):
                grad_a[3 * i + k] = component[k]

    @ti.kernel
    def backward_both(
        a: reals,
        b: reals,
        from_a: integers,
        from_b: integers,
        grad_from_a: reals,
        grad_from_b: reals,
        grad_a: reals,
        grad_b: reals,
        sum_a: reals,
        sum_b: reals,
        n: ti.i32,
        m: ti.i32,
        spread: ti.i32,
    ):
        """`backward` of both directions, one thread for each, with sums of its own: a lone pair takes two threads.

        `sum_a` and `sum_b` are room for what one direction adds to the targets of the other. On small clouds this takes
        half as long again as two calls of `backward` on one thread, and no less time on two.
        """
        directions = 2 * (a.shape[0] // (3 * n))
        for step in range(directions * spread):
            if step % spread == 0:
                cloud = step // spread // 2
                if step // spread % 2 == 0:
                    of_one_direction(a, b, from_a, grad_from_a, grad_a, sum_b, n, m, cloud)
                else:
                    of_one_direction(b, a, from_b, grad_from_b, grad_b, sum_a, m, n, cloud)
        for step in range(directions * spread):
            if step % spread == 0:
                cloud = step // spread // 2
                if step // spread % 2 == 0:
                    for place in range(3 * cloud * n, 3 * (cloud + 1) * n):
                        grad_a[place] = grad_a[place] + sum_a[place]
                else:
                    for place in range(3 * cloud * m, 3 * (cloud + 1) * m):
                        grad_b[place] = grad_b[place] + sum_b[place]

    return SimpleNamespace(
        forward=forward, forward_blocks=forward_blocks, backward=backward, backward_both=backward_both
    )
