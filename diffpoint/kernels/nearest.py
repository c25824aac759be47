"""Nearest neighbours: a tile of queries in registers against candidates broadcast one by one."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

CHUNK = 32  # candidates between two updates of the winning chunk


def build(real):
    tile = 32 if real == ti.f32 else 16  # queries held in vector registers
    largest = 3.0e38 if real == ti.f32 else 1.0e300
    clouds = ti.types.ndarray(dtype=real, ndim=3)
    scalars = ti.types.ndarray(dtype=real, ndim=2)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    indices = ti.types.ndarray(dtype=ti.i64, ndim=2)

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
                    if i < a.shape[1] and (i >= n or m == 0):
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
        # One thread owns one cloud: it scatters without atomics, in a fixed order.
        for step in range(a.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                for j in range(b.shape[1]):
                    for k in ti.static(range(3)):
                        grad_b[cloud, j, k] = real(0.0)
                for i in range(a.shape[1]):
                    j = ti.cast(index[cloud, i], ti.i32)
                    if j >= 0:
                        g = real(2.0) * grad_squared_distance[cloud, i]
                        for k in ti.static(range(3)):
                            component = g * (a[cloud, i, k] - b[cloud, j, k])
                            grad_a[cloud, i, k] = component
                            grad_b[cloud, j, k] -= component
                    else:
                        for k in ti.static(range(3)):
                            grad_a[cloud, i, k] = real(0.0)

    return SimpleNamespace(forward=forward, backward=backward)
