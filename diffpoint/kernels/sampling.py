"""Farthest point sampling: updates every distance at every step, or only those in boxes that a new point can change."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK, LANES, ROWS, box_tests

PARTS = BLOCK // LANES  # vectors in a box


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    indices2 = ti.types.ndarray(dtype=ti.i64, ndim=2)
    scalars2 = ti.types.ndarray(dtype=real, ndim=2)
    counts1 = ti.types.ndarray(dtype=ti.i64, ndim=1)

    @ti.kernel
    def farthest(
        points: points3,
        x_lanes: lanes2,
        y_lanes: lanes2,
        z_lanes: lanes2,
        distance: lanes2,
        distance_of: scalars2,
        counts: counts1,
        starts: counts1,
        chosen: indices2,
        spread: ti.i32,
    ):
        """`distance` must be +inf for points and -1 for padding, which is therefore never the farthest.

        `distance_of` is the same memory. Chosen points get -1 too, so that none is chosen twice.
        """
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                current = ti.cast(starts[cloud], ti.i32)
                for k in range(ti.cast(counts[cloud], ti.i32)):
                    chosen[cloud, k] = current
                    distance_of[cloud, current] = real(-1.0)
                    x = points[cloud, current, 0]
                    y = points[cloud, current, 1]
                    z = points[cloud, current, 2]
                    farthest_distance = ti.Vector([real(-2.0) for s in ti.static(range(LANES))])
                    farthest_tile = ti.Vector([0 for s in ti.static(range(LANES))])
                    for t in range(x_lanes.shape[1]):
                        dx = x_lanes[cloud, t] - x
                        dy = y_lanes[cloud, t] - y
                        dz = z_lanes[cloud, t] - z
                        to_current = dx * dx + dy * dy + dz * dz
                        least = distance[cloud, t]
                        for s in ti.static(range(LANES)):
                            least[s] = ti.select(to_current[s] < least[s], to_current[s], least[s])
                        distance[cloud, t] = least
                        for s in ti.static(range(LANES)):
                            farther = least[s] > farthest_distance[s]
                            farthest_tile[s] = ti.select(farther, t, farthest_tile[s])
                            farthest_distance[s] = ti.select(farther, least[s], farthest_distance[s])
                    best = farthest_distance[0]
                    current = farthest_tile[0] * LANES
                    for s in ti.static(range(1, LANES)):
                        candidate = farthest_tile[s] * LANES + s
                        d = farthest_distance[s]
                        better = (d > best) or (d == best and candidate < current)
                        current = ti.select(better, candidate, current)
                        best = ti.select(better, d, best)

    boxes3 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=3)
    gaps = box_tests(real).gaps
    orders2 = ti.types.ndarray(dtype=ti.i32, ndim=2)

    @ti.func
    def reached(boxes: ti.template(), farthest: ti.template(), cloud, t, x, y, z):
        """Bit s: box s of a row of 16 is no farther from (x, y, z) than the largest distance in it."""
        here = ti.Vector([x, y, z])
        gap = gaps(boxes, cloud, t, here, here)
        bits = 0
        for s in ti.static(range(LANES)):
            bits |= ti.select(gap[s] <= farthest[s], 1 << s, 0)
        return bits

    @ti.func
    def places_of(values: ti.template(), value):
        """Bit s: values[s] is `value`."""
        bits = 0
        for s in ti.static(range(LANES)):
            bits |= ti.select(values[s] == value, 1 << s, 0)
        return bits

    @ti.func
    def lowest(bits):
        """The position of the lowest bit that is set."""
        return ti.math.popcnt((bits & -bits) - 1)

    @ti.func
    def put(values: ti.template(), place, value):
        """values[place] = value, in registers."""
        for s in ti.static(range(LANES)):
            values[s] = ti.select(place == s, value, values[s])

    @ti.func
    def raise_to(values: ti.template(), others: ti.template()):
        for s in ti.static(range(LANES)):
            values[s] = ti.select(others[s] > values[s], others[s], values[s])

    @ti.func
    def largest_of(values: ti.template()):
        """In four steps: 15 comparisons one after the other would take longer."""
        v8 = ti.Vector(
            [ti.select(values[s + 8] > values[s], values[s + 8], values[s]) for s in ti.static(range(8))]
        )
        v4 = ti.Vector([ti.select(v8[s + 4] > v8[s], v8[s + 4], v8[s]) for s in ti.static(range(4))])
        v2 = ti.Vector([ti.select(v4[s + 2] > v4[s], v4[s + 2], v4[s]) for s in ti.static(range(2))])
        return ti.select(v2[1] > v2[0], v2[1], v2[0])

    @ti.kernel
    def farthest_blocks(
        points: points3,
        x_lanes: lanes2,
        y_lanes: lanes2,
        z_lanes: lanes2,
        order: orders2,
        boxes: boxes3,
        groups: boxes3,
        distance: lanes2,
        box_farthest: lanes2,
        group_farthest: lanes2,
        counts: counts1,
        starts: counts1,
        chosen: indices2,
        spread: ti.i32,
    ):
        """`points`, `order`, `boxes` and `groups` as sorted by `blocks.sort`; `distance` as above.

        A new point changes distances only in boxes that are no farther from it than the largest distance in them, and
        only groups that are no farther hold such boxes. In a tie the lowest index before sorting is chosen, as in the
        plain algorithm: within a box the first, because points keep their order there.
        """
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                current = 0
                for i in range(order.shape[1]):
                    if order[cloud, i] == starts[cloud]:
                        current = i
                for t in range(group_farthest.shape[1]):
                    in_groups = ti.Vector([real(-1.0) for s in ti.static(range(LANES))])
                    for row in range(t * LANES * ROWS, ti.min((t + 1) * LANES * ROWS, box_farthest.shape[1])):
                        in_boxes = ti.Vector([real(-1.0) for s in ti.static(range(LANES))])
                        for s in range(LANES):
                            # Only the last box may be filled in part, from the front.
                            put(in_boxes, s, distance[cloud, (row * LANES + s) * PARTS][0])
                        box_farthest[cloud, row] = in_boxes
                        if row % ROWS == 0:
                            put(in_groups, row // ROWS - t * LANES, in_boxes[0])
                    group_farthest[cloud, t] = in_groups
                for k in range(ti.cast(counts[cloud], ti.i32)):
                    chosen[cloud, k] = order[cloud, current]
                    own = distance[cloud, current // LANES]
                    put(own, current % LANES, real(-1.0))
                    distance[cloud, current // LANES] = own
                    x = points[cloud, current, 0]
                    y = points[cloud, current, 1]
                    z = points[cloud, current, 2]
                    best_lanes = ti.Vector([real(-2.0) for s in ti.static(range(LANES))])
                    for t in range(groups.shape[2]):
                        in_groups = group_farthest[cloud, t]
                        group_bits = reached(groups, in_groups, cloud, t, x, y, z)
                        while group_bits != 0:
                            group = lowest(group_bits)
                            group_bits &= group_bits - 1
                            in_group = ti.Vector([real(-1.0) for s in ti.static(range(LANES))])
                            for row in range((t * LANES + group) * ROWS, (t * LANES + group + 1) * ROWS):
                                in_boxes = box_farthest[cloud, row]
                                box_bits = reached(boxes, in_boxes, cloud, row, x, y, z)
                                while box_bits != 0:
                                    box = lowest(box_bits)
                                    box_bits &= box_bits - 1
                                    in_box = ti.Vector([real(-1.0) for s in ti.static(range(LANES))])
                                    for part in ti.static(range(PARTS)):
                                        at = (row * LANES + box) * PARTS + part
                                        dx = x_lanes[cloud, at] - x
                                        dy = y_lanes[cloud, at] - y
                                        dz = z_lanes[cloud, at] - z
                                        to_current = dx * dx + dy * dy + dz * dz
                                        least = distance[cloud, at]
                                        for s in ti.static(range(LANES)):
                                            least[s] = ti.select(
                                                to_current[s] < least[s], to_current[s], least[s]
                                            )
                                        distance[cloud, at] = least
                                        raise_to(in_box, least)
                                    put(in_boxes, box, largest_of(in_box))
                                box_farthest[cloud, row] = in_boxes
                                raise_to(in_group, in_boxes)
                            put(in_groups, group, largest_of(in_group))
                        group_farthest[cloud, t] = in_groups
                        raise_to(best_lanes, in_groups)
                    best = largest_of(best_lanes)
                    first = 2**31 - 1
                    for t in range(groups.shape[2]):
                        in_groups = group_farthest[cloud, t]
                        group_bits = places_of(in_groups, best)
                        while group_bits != 0:
                            group = t * LANES + lowest(group_bits)
                            group_bits &= group_bits - 1
                            for row in range(group * ROWS, (group + 1) * ROWS):
                                in_boxes = box_farthest[cloud, row]
                                box_bits = places_of(in_boxes, best)
                                while box_bits != 0:
                                    box = row * LANES + lowest(box_bits)
                                    box_bits &= box_bits - 1
                                    point_bits = 0
                                    for part in ti.static(range(PARTS)):
                                        of_points = distance[cloud, box * PARTS + part]
                                        point_bits |= places_of(of_points, best) << (part * LANES)
                                    candidate = box * BLOCK + lowest(point_bits)
                                    index = order[cloud, candidate]
                                    current = ti.select(index < first, candidate, current)
                                    first = ti.min(index, first)

    return SimpleNamespace(farthest=farthest, farthest_blocks=farthest_blocks)
