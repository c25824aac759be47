"""The k nearest neighbours: a tile of queries in registers against candidates broadcast one by one, box by box.

As in `nearest.py`, boxes of candidates that are farther than what the whole tile has found are skipped. The k best of
each query stand in order in memory, 16 queries to a vector; a candidate that is near enough for one of the queries is
compared with them from the nearest on, and takes the place of the first that it precedes, which is handed on.
"""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK, GROUP, LANES, ROWS, box_tests

NOBODY = 2**31 - 1  # the index of a neighbour that is not there; after those of all points
NEVER = 2**63 - 1  # a key after those of all distances
AROUND = 2  # boxes before and after the central one along the curve that are searched first


def build(real):
    # Neighbours are ordered by distance, then by index. The bits of a distance, which is not negative, are ordered as
    # the distance is. In float32 those of the index follow them in one integer, so that each comparison is a single
    # minimum and maximum; in float64 the indices are in an array of their own.
    packed = real == ti.f32
    bits_of = ti.i32 if packed else ti.i64
    clouds = ti.types.ndarray(dtype=real, ndim=3)
    counts = ti.types.ndarray(dtype=ti.i64, ndim=1)
    orders = ti.types.ndarray(dtype=ti.i32, ndim=2)
    box_lanes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)
    keys2 = ti.types.ndarray(dtype=ti.types.vector(LANES, ti.i64), ndim=2)
    keys3 = ti.types.ndarray(dtype=ti.i64, ndim=3)
    sources2 = ti.types.ndarray(dtype=ti.types.vector(LANES, ti.i32), ndim=2)
    sources3 = ti.types.ndarray(dtype=ti.i32, ndim=3)
    distances3 = ti.types.ndarray(dtype=real, ndim=3)
    indices3 = ti.types.ndarray(dtype=ti.i64, ndim=3)
    tests = box_tests(real)
    clamped, gap, reached, most_central = tests.clamped, tests.gap, tests.reached, tests.most_central

    @ti.func
    def key_of(distance, source):
        """Ordered as the pairs of distance and source; in float64 as the distances."""
        key = ti.cast(ti.bit_cast(distance, bits_of), ti.i64)
        if ti.static(packed):
            key = (key << 32) | ti.cast(source, ti.i64)
        return key

    @ti.func
    def distance_of(key):
        bits = key
        if ti.static(packed):
            bits = key >> 32
        return ti.bit_cast(ti.cast(bits, bits_of), real)

    @ti.kernel
    def forward(
        a: clouds,
        a_order: orders,
        b: clouds,
        b_order: orders,
        corners: clouds,
        box_lanes: box_lanes3,
        groups: clouds,
        a_lengths: counts,
        b_lengths: counts,
        keys: keys2,
        key_lanes: keys3,
        sources: sources2,
        source_lanes: sources3,
        squared_distance: distances3,
        index: indices3,
        largest: real,
        exclude_self: ti.i32,
        spread: ti.i32,
    ):
        """`a` and `b` as sorted by `blocks.sort`; results are stored in the order before sorting.

        `corners` and `box_lanes` are the same memory, the boxes of `b`. `keys` (W, k) and `key_lanes` (W, k, 16) are
        too, what W workers have found; and so are `sources` and `source_lanes`, which float32 does not use.
        Only squared distances of at most `largest`, a finite number, count.
        """
        tiles = (index.shape[1] + LANES - 1) // LANES
        k = index.shape[2]
        workers = keys.shape[0]
        for step in range(workers * spread):
            if step % spread == 0:
                worker = step // spread
                tile_count = ti.cast(a.shape[0] * tiles, ti.i64)
                begin = ti.cast(tile_count * worker // workers, ti.i32)
                end = ti.cast(tile_count * (worker + 1) // workers, ti.i32)
                for tile in range(begin, end):
                    cloud = tile // tiles
                    first = (tile - cloud * tiles) * LANES
                    n = ti.cast(a_lengths[cloud], ti.i32)
                    m = ti.cast(b_lengths[cloud], ti.i32)
                    if first < n and m > 0:
                        ax = ti.Vector(
                            [a[cloud, ti.min(first + s, n - 1), 0] for s in ti.static(range(LANES))]
                        )
                        ay = ti.Vector(
                            [a[cloud, ti.min(first + s, n - 1), 1] for s in ti.static(range(LANES))]
                        )
                        az = ti.Vector(
                            [a[cloud, ti.min(first + s, n - 1), 2] for s in ti.static(range(LANES))]
                        )
                        excluded = ti.Vector(
                            [
                                ti.select(exclude_self != 0, a_order[cloud, ti.min(first + s, n - 1)], -1)
                                for s in ti.static(range(LANES))
                            ]
                        )
                        low = ti.Vector([ax.min(), ay.min(), az.min()])
                        high = ti.Vector([ax.max(), ay.max(), az.max()])
                        # The last of the queries' k best that may still be replaced, and the largest over the tile.
                        last = ti.Vector([largest for s in ti.static(range(LANES))])
                        farthest = largest
                        for q in range(k):
                            keys[worker, q] = ti.Vector(
                                [key_of(largest, NOBODY) for s in ti.static(range(LANES))]
                            )
                            if ti.static(not packed):
                                sources[worker, q] = ti.Vector([NOBODY for s in ti.static(range(LANES))])
                        # First some boxes about the nearest, then the rest of its group, then the other groups: with
                        # near candidates found first, most of the rest is skipped.
                        boxes_in_use = (m + BLOCK - 1) // BLOCK
                        count = (boxes_in_use + GROUP - 1) // GROUP
                        own_group = most_central(groups, cloud, 0, count, low, high)
                        own_box = most_central(
                            corners, cloud, own_group * GROUP, (own_group + 1) * GROUP, low, high
                        )
                        before = ti.max(own_box % LANES - AROUND, 0)
                        nearest_boxes = ((1 << (2 * AROUND + 1)) - 1) << before
                        for turn in range(count + 2):
                            group = ti.select(turn < 2, own_group, turn - 2)
                            rows = ROWS
                            if turn >= 2 and (
                                group == own_group or gap(groups, cloud, group, low, high) > farthest
                            ):
                                rows = 0
                            for row in range(group * ROWS, group * ROWS + rows):
                                boxes = ti.select(row == own_box // LANES, nearest_boxes, 0)
                                if turn > 0:
                                    boxes = reached(box_lanes, cloud, row, low, high, farthest) & ~boxes
                                here = ti.max(ti.min(boxes_in_use - row * LANES, LANES), 0)
                                boxes &= (1 << here) - 1
                                while boxes != 0:
                                    box = row * LANES + ti.math.popcnt((boxes & -boxes) - 1)
                                    boxes &= boxes - 1
                                    least_corner = ti.Vector(
                                        [corners[cloud, c, box] for c in ti.static(range(3))]
                                    )
                                    greatest = ti.Vector(
                                        [corners[cloud, c + 3, box] for c in ti.static(range(3))]
                                    )
                                    within = 0
                                    for s in ti.static(range(LANES)):
                                        dx = clamped(ax[s], least_corner[0], greatest[0]) - ax[s]
                                        dy = clamped(ay[s], least_corner[1], greatest[1]) - ay[s]
                                        dz = clamped(az[s], least_corner[2], greatest[2]) - az[s]
                                        within |= ti.select(dx * dx + dy * dy + dz * dz <= last[s], 1, 0)
                                    if within != 0:
                                        for candidate in range(BLOCK):
                                            j = box * BLOCK + candidate
                                            x = b[cloud, j, 0]
                                            y = b[cloud, j, 1]
                                            z = b[cloud, j, 2]
                                            d = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
                                            for s in ti.static(range(LANES)):
                                                dx = x - ax[s]
                                                dy = y - ay[s]
                                                dz = z - az[s]
                                                d[s] = dx * dx + dy * dy + dz * dz
                                            near = 0
                                            for s in ti.static(range(LANES)):
                                                near |= ti.select(d[s] <= last[s], 1, 0)
                                            if near != 0:
                                                source = b_order[cloud, j]
                                                key = ti.Vector(
                                                    [ti.cast(0, ti.i64) for s in ti.static(range(LANES))]
                                                )
                                                stored = key
                                                origin = ti.Vector([source for s in ti.static(range(LANES))])
                                                stored_origin = origin
                                                for s in ti.static(range(LANES)):
                                                    candidate_key = key_of(d[s], source)
                                                    key[s] = ti.select(
                                                        source == excluded[s], ti.i64(NEVER), candidate_key
                                                    )
                                                for q in range(k):
                                                    kept = keys[worker, q]
                                                    if ti.static(packed):
                                                        for s in ti.static(range(LANES)):
                                                            closer = key[s] < kept[s]
                                                            stored[s] = ti.select(closer, key[s], kept[s])
                                                            key[s] = ti.select(closer, kept[s], key[s])
                                                    else:
                                                        kept_origin = sources[worker, q]
                                                        for s in ti.static(range(LANES)):
                                                            closer = (key[s] < kept[s]) | (
                                                                (key[s] == kept[s])
                                                                & (origin[s] < kept_origin[s])
                                                            )
                                                            stored[s] = ti.select(closer, key[s], kept[s])
                                                            key[s] = ti.select(closer, kept[s], key[s])
                                                            stored_origin[s] = ti.select(
                                                                closer, origin[s], kept_origin[s]
                                                            )
                                                            origin[s] = ti.select(
                                                                closer, kept_origin[s], origin[s]
                                                            )
                                                        sources[worker, q] = stored_origin
                                                    keys[worker, q] = stored
                                                for s in ti.static(range(LANES)):
                                                    last[s] = distance_of(stored[s])
                                        farthest = last.max()
                        for s in range(ti.min(LANES, n - first)):
                            place = a_order[cloud, first + s]
                            for q in range(k):
                                key = key_lanes[worker, q, s]
                                source = ti.cast(key, ti.i32)  # its low half
                                if ti.static(not packed):
                                    source = source_lanes[worker, q, s]
                                found = source != NOBODY
                                index[cloud, place, q] = ti.select(found, source, -1)
                                squared_distance[cloud, place, q] = ti.select(
                                    found, distance_of(key), real(ti.math.inf)
                                )
                    for i in range(
                        ti.max(first, ti.select(m > 0, n, 0)), ti.min(first + LANES, index.shape[1])
                    ):
                        for q in range(k):
                            squared_distance[cloud, i, q] = ti.select(i < n, real(ti.math.inf), real(0.0))
                            index[cloud, i, q] = -1

    return SimpleNamespace(forward=forward)
