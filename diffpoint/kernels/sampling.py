"""Farthest point sampling: updates every distance at every step, or only those in boxes that a new point can change."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti
from diffpoint.kernels.blocks import BLOCK

LANES = 16
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
    orders2 = ti.types.ndarray(dtype=ti.i32, ndim=2)

    @ti.kernel
    def farthest_blocks(
        points: points3,
        x_lanes: lanes2,
        y_lanes: lanes2,
        z_lanes: lanes2,
        order: orders2,
        box_lanes: boxes3,
        distance: lanes2,
        distance_of: scalars2,
        box_farthest: scalars2,
        box_farthest_lanes: lanes2,
        box_point: orders2,
        counts: counts1,
        starts: counts1,
        chosen: indices2,
        spread: ti.i32,
    ):
        """`points`, `order`, `box_lanes` as sorted by `blocks.sort`; `distance` and `distance_of` as above.

        A new point changes distances only in boxes that are nearer to it than the largest distance in them, and in its
        own, which may be as near. In a tie
        the lowest index before sorting is chosen, as in the plain algorithm: the first within a box, because points
        keep their order there.
        """
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                current = 0
                for i in range(order.shape[1]):
                    if order[cloud, i] == starts[cloud]:
                        current = i
                for box in range(box_farthest.shape[1]):
                    box_farthest[cloud, box] = distance[cloud, box * PARTS].max()
                for k in range(ti.cast(counts[cloud], ti.i32)):
                    chosen[cloud, k] = order[cloud, current]
                    distance_of[cloud, current] = real(-1.0)
                    x = points[cloud, current, 0]
                    y = points[cloud, current, 1]
                    z = points[cloud, current, 2]
                    best_lanes = ti.Vector([real(-2.0) for s in ti.static(range(LANES))])
                    tile_lanes = ti.Vector([0 for s in ti.static(range(LANES))])
                    tied_lanes = ti.Vector([0 for s in ti.static(range(LANES))])
                    for t in range(box_lanes.shape[2]):
                        gap = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
                        for axis in ti.static(range(3)):
                            here = points[cloud, current, axis]
                            below = box_lanes[cloud, axis, t] - here
                            above = here - box_lanes[cloud, axis + 3, t]
                            for s in ti.static(range(LANES)):
                                outside = ti.select(below[s] > above[s], below[s], above[s])
                                outside = ti.select(outside > 0, outside, real(0.0))
                                gap[s] += outside * outside
                        farthest_lanes = box_farthest_lanes[cloud, t]
                        reached = 0  # a bit for each box
                        for s in ti.static(range(LANES)):
                            reached |= ti.select(gap[s] <= farthest_lanes[s], 1 << s, 0)
                        if reached != 0:
                            while reached != 0:
                                box = t * LANES + ti.math.popcnt((reached & -reached) - 1)
                                reached &= reached - 1
                                farthest_here = real(-1.0)
                                point = 0
                                for part in ti.static(range(PARTS)):
                                    row = box * PARTS + part
                                    dx = x_lanes[cloud, row] - x
                                    dy = y_lanes[cloud, row] - y
                                    dz = z_lanes[cloud, row] - z
                                    to_current = dx * dx + dy * dy + dz * dz
                                    nearest = distance[cloud, row]
                                    for r in ti.static(range(LANES)):
                                        nearest[r] = ti.select(
                                            to_current[r] < nearest[r], to_current[r], nearest[r]
                                        )
                                    distance[cloud, row] = nearest
                                    for r in ti.static(range(LANES)):
                                        farther = nearest[r] > farthest_here
                                        point = ti.select(farther, part * LANES + r, point)
                                        farthest_here = ti.select(farther, nearest[r], farthest_here)
                                box_farthest[cloud, box] = farthest_here
                                box_point[cloud, box] = box * BLOCK + point
                            farthest_lanes = box_farthest_lanes[cloud, t]
                        for s in ti.static(range(LANES)):
                            farther = farthest_lanes[s] > best_lanes[s]
                            equal = farthest_lanes[s] == best_lanes[s]
                            tied_lanes[s] = ti.select(farther, 0, ti.select(equal, 1, tied_lanes[s]))
                            tile_lanes[s] = ti.select(farther, t, tile_lanes[s])
                            best_lanes[s] = ti.select(farther, farthest_lanes[s], best_lanes[s])
                    best = best_lanes[0]
                    best_box = tile_lanes[0] * LANES
                    tied = tied_lanes[0]
                    for s in ti.static(range(1, LANES)):
                        farther = best_lanes[s] > best
                        equal = best_lanes[s] == best
                        tied = ti.select(farther, tied_lanes[s], ti.select(equal, 1, tied))
                        best_box = ti.select(farther, tile_lanes[s] * LANES + s, best_box)
                        best = ti.select(farther, best_lanes[s], best)
                    if tied != 0:
                        for box in range(box_farthest.shape[1]):
                            lower = (
                                order[cloud, box_point[cloud, box]] < order[cloud, box_point[cloud, best_box]]
                            )
                            best_box = ti.select((box_farthest[cloud, box] == best) & lower, box, best_box)
                    current = box_point[cloud, best_box]

    return SimpleNamespace(farthest=farthest, farthest_blocks=farthest_blocks)
