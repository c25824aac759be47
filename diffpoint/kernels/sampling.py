"""Farthest point sampling: every step updates all distances in vector lanes and takes the largest."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

LANES = 16


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    lanes2 = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    indices2 = ti.types.ndarray(dtype=ti.i64, ndim=2)

    @ti.kernel
    def farthest(
        points: points3,
        x_lanes: lanes2,
        y_lanes: lanes2,
        z_lanes: lanes2,
        distance: lanes2,
        chosen: indices2,
        start: ti.i32,
        spread: ti.i32,
    ):
        """`distance` comes in as +inf for points and -1 for padding, which is therefore never the farthest."""
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                current = start
                for k in range(chosen.shape[1]):
                    chosen[cloud, k] = current
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

    return SimpleNamespace(farthest=farthest)
