"""Nearest neighbours: a tile of queries in registers against candidates broadcast one by one.

`forward` tries every candidate; `forward_blocks` passes over boxes of candidates that are farther from the whole tile
than what each of its queries has found. Both give the same distances and the same indices.
"""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK, GROUP

CHUNK = 32  # candidates between two updates of the winning chunk


def build(real):
    tile = 32 if real == ti.f32 else 16  # queries held in vector registers
    largest = 3.0e38 if real == ti.f32 else 1.0e300
    clouds = ti.types.ndarray(dtype=real, ndim=3)
    scalars = ti.types.ndarray(dtype=real, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    indices = ti.types.ndarray(dtype=ti.i64, ndim=2)
    orders = ti.types.ndarray(dtype=ti.i32, ndim=2)
    boxes3 = ti.types.ndarray(dtype=real, ndim=3)

    @ti.func
    def apart(boxes: ti.template(), cloud, box, low: ti.template(), high: ti.template()):
        """Squared distance between a box and the box from `low` to `high`; 0 where they meet."""
        total = real(0.0)
        for k in ti.static(range(3)):
            gap = ti.max(ti.max(boxes[cloud, k, box] - high[k], low[k] - boxes[cloud, k + 3, box]), real(0.0))
            total += gap * gap
        return total

    @ti.func
    def nearest_of(boxes: ti.template(), cloud, start, end, low: ti.template(), high: ti.template()):
        """The box whose centre is nearest to the centre of the box from `low` to `high`."""
        best = start
        least = real(largest)
        for box in range(start, end):
            d = real(0.0)
            for k in ti.static(range(3)):
                offset = boxes[cloud, k, box] + boxes[cloud, k + 3, box] - low[k] - high[k]
                d += offset * offset
            best = ti.select(d < least, box, best)
            least = ti.select(d < least, d, least)
        return best

    @ti.func
    def outwards(start, turn):
        """start, start + 1, start - 1, start + 2, ..."""
        return start + ti.select(turn % 2 == 1, (turn + 1) // 2, -(turn // 2))

    @ti.func
    def scan_box(b: ti.template(), b_order: ti.template(), cloud, box, m, here: ti.template(), best, best_j):
        """The nearer of what was found before and the points of a box; of equals the one that came first unsorted."""
        for j in range(box * BLOCK, ti.min(box * BLOCK + BLOCK, m)):
            dx = b[cloud, j, 0] - here[0]
            dy = b[cloud, j, 1] - here[1]
            dz = b[cloud, j, 2] - here[2]
            d = dx * dx + dy * dy + dz * dz
            source = b_order[cloud, j]
            closer = (d < best) | ((d == best) & (source < best_j))
            best_j = ti.select(closer, source, best_j)
            best = ti.select(closer, d, best)
        return best, best_j

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
                    least = ti.Vector([real(largest) for s in ti.static(range(tile))])
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
                            best = real(largest)
                            best_j = chunk * CHUNK
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
        b_boxes: boxes3,
        b_groups: boxes3,
        a_lengths: integers,
        b_lengths: integers,
        squared_distance: scalars,
        index: indices,
        spread: ti.i32,
    ):
        """`a` and `b` as sorted by `blocks.sort`; results go to the points' places before sorting."""
        tiles = (squared_distance.shape[1] + tile - 1) // tile
        groups = b_groups.shape[2]
        for step in range(a.shape[0] * tiles * spread):
            if step % spread == 0:
                work = step // spread
                cloud = work // tiles
                first = (work - cloud * tiles) * tile
                n = ti.cast(a_lengths[cloud], ti.i32)
                m = ti.cast(b_lengths[cloud], ti.i32)
                if first < n and m > 0:
                    boxes = (m + BLOCK - 1) // BLOCK
                    ax = ti.Vector([a[cloud, ti.min(first + s, n - 1), 0] for s in ti.static(range(tile))])
                    ay = ti.Vector([a[cloud, ti.min(first + s, n - 1), 1] for s in ti.static(range(tile))])
                    az = ti.Vector([a[cloud, ti.min(first + s, n - 1), 2] for s in ti.static(range(tile))])
                    low = ti.Vector([ax.min(), ay.min(), az.min()])
                    high = ti.Vector([ax.max(), ay.max(), az.max()])
                    least = ti.Vector([real(largest) for s in ti.static(range(tile))])
                    winner = ti.Vector([0 for s in ti.static(range(tile))])
                    tied = ti.Vector([0 for s in ti.static(range(tile))])
                    farthest = real(largest)  # of the nearest found so far, over the tile
                    start_group = nearest_of(b_groups, cloud, 0, groups, low, high)
                    start = nearest_of(
                        b_boxes,
                        cloud,
                        start_group * GROUP,
                        ti.min(start_group * GROUP + GROUP, boxes),
                        low,
                        high,
                    )
                    # Outwards from the nearest box of the nearest group: neighbours on the curve are neighbours in
                    # space, and what is found first lets most of the rest be passed over.
                    for group_turn in range(2 * groups):
                        group = outwards(start_group, group_turn)
                        reachable = group >= 0 and group < groups
                        if reachable:
                            reachable = apart(b_groups, cloud, group, low, high) <= farthest
                        if reachable:
                            first_box = group * GROUP
                            last_box = ti.min(first_box + GROUP, boxes) - 1
                            for turn in range(2 * GROUP):
                                box = outwards(ti.max(ti.min(start, last_box), first_box), turn)
                                worthwhile = box >= first_box and box <= last_box
                                if worthwhile:
                                    worthwhile = apart(b_boxes, cloud, box, low, high) <= farthest
                                if worthwhile:
                                    current = ti.Vector([real(largest) for s in ti.static(range(tile))])
                                    for candidate in range(BLOCK):
                                        j = box * BLOCK + candidate
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
                                        equal = current[s] == least[s]
                                        closer = current[s] < least[s]
                                        tied[s] = ti.select(equal, 1, ti.select(closer, 0, tied[s]))
                                        winner[s] = ti.select(closer, box, winner[s])
                                        least[s] = ti.select(closer, current[s], least[s])
                                    farthest = least.max()
                    for s in range(tile):
                        if first + s < n:
                            box = 0
                            ties = 0
                            for r in ti.static(range(tile)):
                                box = ti.select(r == s, winner[r], box)
                                ties = ti.select(r == s, tied[r], ties)
                            here = ti.Vector([a[cloud, first + s, k] for k in ti.static(range(3))])
                            best, best_j = scan_box(
                                b, b_order, cloud, box, m, here, real(largest), b_order[cloud, box * BLOCK]
                            )
                            if ties != 0:
                                # Equally near in several boxes: the lowest index of them all, as without boxes.
                                for other in range(boxes):
                                    if apart(b_boxes, cloud, other, here, here) <= best:
                                        best, best_j = scan_box(
                                            b, b_order, cloud, other, m, here, best, best_j
                                        )
                            place = a_order[cloud, first + s]
                            squared_distance[cloud, place] = best
                            index[cloud, place] = best_j
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
        # One thread owns one cloud: it scatters without atomics, in a fixed order. Gradients come in as zeros.
        for step in range(a.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for i in range(a.shape[1]):
                    j = ti.cast(index[cloud, i], ti.i32)
                    if j >= 0:
                        g = real(2.0) * grad_squared_distance[cloud, i]
                        for k in ti.static(range(3)):
                            component = g * (a[cloud, i, k] - b[cloud, j, k])
                            grad_a[cloud, i, k] = component
                            grad_b[cloud, j, k] -= component

    return SimpleNamespace(forward=forward, forward_blocks=forward_blocks, backward=backward)
