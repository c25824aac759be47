"""Nearest neighbours: a tile of queries in registers against candidates broadcast one by one.

`forward` tries every candidate; `forward_blocks` passes over boxes of candidates that are farther from the whole tile
than what each of its queries has found. Both give the same distances and the same indices.
"""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK, GROUP, LANES

CHUNK = 32  # candidates between two updates of the winning chunk
ROWS = GROUP // LANES  # rows of boxes in a group


def build(real):
    tile = 32 if real == ti.f32 else 16  # queries held in vector registers
    clouds = ti.types.ndarray(dtype=real, ndim=3)
    scalars = ti.types.ndarray(dtype=real, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    indices = ti.types.ndarray(dtype=ti.i64, ndim=2)
    orders = ti.types.ndarray(dtype=ti.i32, ndim=2)
    lanes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)

    @ti.func
    def span(x: ti.template(), least, greatest):
        """Squared distance from each coordinate in `x` to the span from least to greatest; 0 within."""
        squares = least - x
        for s in ti.static(range(tile)):
            below = least - x[s]
            above = x[s] - greatest
            outside = ti.select(below > above, below, above)
            outside = ti.select(outside > 0, outside, real(0.0))
            squares[s] = outside * outside
        return squares

    @ti.func
    def reached(boxes: ti.template(), cloud, row, low: ti.template(), high: ti.template(), farthest):
        """Bit s: box s of a row of 16 is within the squared distance `farthest` of the box from `low` to `high`."""
        total = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
        for k in ti.static(range(3)):
            below = boxes[cloud, k, row] - high[k]
            above = low[k] - boxes[cloud, k + 3, row]
            for s in ti.static(range(LANES)):
                outside = ti.select(below[s] > above[s], below[s], above[s])
                outside = ti.select(outside > 0, outside, real(0.0))
                total[s] += outside * outside
        bits = 0
        for s in ti.static(range(LANES)):
            bits |= ti.select(total[s] <= farthest, 1 << s, 0)
        return bits

    @ti.func
    def most_central(boxes: ti.template(), cloud, start, end, low: ti.template(), high: ti.template()):
        """Of the boxes in vectors `start` to `end`, the one whose centre is nearest to that of `low` to `high`."""
        least = ti.Vector([real(ti.math.inf) for s in ti.static(range(LANES))])
        where = ti.Vector([start for s in ti.static(range(LANES))])
        for t in range(start, end):
            d = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
            for k in ti.static(range(3)):
                offset = boxes[cloud, k, t] + boxes[cloud, k + 3, t] - (low[k] + high[k])
                d += offset * offset
            for s in ti.static(range(LANES)):
                closer = d[s] < least[s]
                where[s] = ti.select(closer, t, where[s])
                least[s] = ti.select(closer, d[s], least[s])
        best = where[0] * LANES
        for s in ti.static(range(1, LANES)):
            closer = least[s] < least[0]
            best = ti.select(closer, where[s] * LANES + s, best)
            least[0] = ti.select(closer, least[s], least[0])
        return best

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
                        # Only the minimum is tracked among the candidates of a chunk; which of them it was is
                        # found by scanning the winning chunk again. This keeps the inner loop packed.
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
                            best_j = -1  # stays where every squared distance is beyond the number format
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
        group_lanes: lanes3,
        a_lengths: integers,
        b_lengths: integers,
        squared_distance: scalars,
        index: indices,
        spread: ti.i32,
    ):
        """`a` and `b` as sorted by `blocks.sort`; results go to the points' places before sorting.

        `corners` and `box_lanes` are the same memory: the boxes of `b`.
        """
        tiles = (squared_distance.shape[1] + tile - 1) // tile
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
                    low = ti.Vector([ax.min(), ay.min(), az.min()])
                    high = ti.Vector([ax.max(), ay.max(), az.max()])
                    least = ti.Vector([real(ti.math.inf) for s in ti.static(range(tile))])
                    winner = ti.Vector([-1 for s in ti.static(range(tile))])
                    farthest = real(ti.math.inf)  # of the nearest found so far, over the tile
                    # First the box in the middle of the tile, then the rest of its group, then the other groups:
                    # what is found first lets most of the rest be passed over.
                    own_group = most_central(group_lanes, cloud, 0, group_lanes.shape[2], low, high)
                    own_row = own_group * ROWS
                    own_box = most_central(box_lanes, cloud, own_row, own_row + ROWS, low, high)
                    for turn in range(group_lanes.shape[2] + 2):
                        group_row = ti.select(turn < 2, own_group // LANES, turn - 2)
                        groups = 1 << (own_group % LANES)
                        if turn >= 2:
                            same = ti.select(group_row == own_group // LANES, groups, 0)
                            groups = reached(group_lanes, cloud, group_row, low, high, farthest) & ~same
                        for group_step in range(ti.select(groups != 0, LANES * ROWS, 0)):
                            row = group_row * LANES * ROWS + group_step
                            boxes = 0
                            # Where squares overflow even the padding of the groups is within reach.
                            if (groups >> (group_step // ROWS)) & 1 != 0 and row < box_lanes.shape[2]:
                                own = ti.select(row == own_box // LANES, 1 << (own_box % LANES), 0)
                                if turn == 0:
                                    boxes = own
                                else:
                                    boxes = reached(box_lanes, cloud, row, low, high, farthest) & ~own
                            for lane in range(ti.select(boxes != 0, LANES, 0)):
                                box = row * LANES + lane
                                within = (boxes >> lane) & 1
                                if within != 0:
                                    d = span(ax, corners[cloud, 0, box], corners[cloud, 3, box])
                                    d += span(ay, corners[cloud, 1, box], corners[cloud, 4, box])
                                    d += span(az, corners[cloud, 2, box], corners[cloud, 5, box])
                                    within = 0
                                    for s in ti.static(range(tile)):
                                        within |= ti.select(d[s] <= least[s], 1, 0)
                                if within != 0:
                                    current = ti.Vector([real(ti.math.inf) for s in ti.static(range(tile))])
                                    source = ti.Vector([-1 for s in ti.static(range(tile))])
                                    for candidate in range(BLOCK):
                                        j = box * BLOCK + candidate
                                        x = b[cloud, j, 0]
                                        y = b[cloud, j, 1]
                                        z = b[cloud, j, 2]
                                        before_sorting = b_order[cloud, j]
                                        for s in ti.static(range(tile)):
                                            dx = x - ax[s]
                                            dy = y - ay[s]
                                            dz = z - az[s]
                                            e = dx * dx + dy * dy + dz * dz
                                            nearer = e < current[s]
                                            source[s] = ti.select(nearer, before_sorting, source[s])
                                            current[s] = ti.select(nearer, e, current[s])
                                    for s in ti.static(range(tile)):
                                        # Of equally near ones the one that came first before sorting.
                                        earlier = (current[s] == least[s]) & (source[s] < winner[s])
                                        nearer = (current[s] < least[s]) | earlier
                                        winner[s] = ti.select(nearer, source[s], winner[s])
                                        least[s] = ti.select(nearer, current[s], least[s])
                                    farthest = least.max()
                    for s in ti.static(range(tile)):
                        if first + s < n:
                            place = a_order[cloud, first + s]
                            squared_distance[cloud, place] = least[s]
                            index[cloud, place] = winner[s]
                for s in range(tile):
                    i = first + s
                    if i < squared_distance.shape[1] and (i >= n or m == 0):
                        squared_distance[cloud, i] = ti.select(i < n, real(ti.math.inf), real(0.0))
                        index[cloud, i] = -1

    @ti.kernel
    def backward(
        a: clouds,
        b: clouds,
        index: indices,
        grad_squared_distance: scalars,
        grad_a: clouds,
        grad_b: clouds,
        spread: ti.i32,
    ):
        # One thread owns one cloud: it scatters without atomics, in a fixed order, to what the gradients hold.
        for step in range(a.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for i in range(a.shape[1]):
                    j = ti.cast(index[cloud, i], ti.i32)
                    if j >= 0:
                        g = real(2.0) * grad_squared_distance[cloud, i]
                        for k in ti.static(range(3)):
                            component = g * (a[cloud, i, k] - b[cloud, j, k])
                            grad_a[cloud, i, k] += component
                            grad_b[cloud, j, k] -= component

    return SimpleNamespace(forward=forward, forward_blocks=forward_blocks, backward=backward)
