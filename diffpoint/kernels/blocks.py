"""Clouds sorted along a Morton curve and cut into boxes, so that searches can skip whole blocks of points."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

BLOCK = 32  # points in a box
GROUP = 32  # boxes in a box of boxes
LANES = 16  # boxes in a vector


def build(real):
    points3 = ti.types.ndarray(dtype=real, ndim=3)
    boxes3 = ti.types.ndarray(dtype=real, ndim=3)
    counts1 = ti.types.ndarray(dtype=ti.i64, ndim=1)
    indices2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
    outside = ti.math.inf  # the padding: never the nearest point

    @ti.func
    def spread_bits(x: ti.i32):
        """Moves bits 0, 1, 2, ... to positions 0, 3, 6, ...; at most ten bits."""
        x = (x | (x << 16)) & 0x030000FF
        x = (x | (x << 8)) & 0x0300F00F
        x = (x | (x << 4)) & 0x030C30C3
        x = (x | (x << 2)) & 0x09249249
        return x

    @ti.kernel
    def sort(
        points: points3,
        lengths: counts1,
        ordered: points3,
        order: indices2,
        key: indices2,
        histogram: indices2,
        boxes: boxes3,
        groups: boxes3,
        bits: ti.i32,
        spread: ti.i32,
    ):
        """Counting sort by Morton key with `bits` bits for each axis, then the boxes of every 32 points.

        Within a box the points keep their order. ordered: padded to whole boxes with infinity. order: index of each
        sorted point before sorting. boxes and groups: (B, 6, count) minimum and maximum corners.
        """
        for step in range(points.shape[0] * spread):
            if step % spread == 0:
                cloud = step // spread
                n = ti.cast(lengths[cloud], ti.i32)
                low = ti.Vector([real(3.0e38) for k in ti.static(range(3))])
                high = -low
                for i in range(n):
                    for k in ti.static(range(3)):
                        value = points[cloud, i, k]
                        low[k] = ti.select(value < low[k], value, low[k])
                        high[k] = ti.select(value > high[k], value, high[k])
                extent = ti.max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
                cells = (1 << bits) - 1
                scale = ti.select(extent > 0, ti.cast(cells, real) / extent, real(0.0))
                for cell in range(histogram.shape[1]):
                    histogram[cloud, cell] = 0
                for i in range(n):
                    code = 0
                    for k in ti.static(range(3)):
                        place = ti.cast((points[cloud, i, k] - low[k]) * scale, ti.i32)
                        code |= spread_bits(ti.max(ti.min(place, cells), 0)) << k
                    key[cloud, i] = code
                    histogram[cloud, code] = histogram[cloud, code] + 1  # not +=, which would be atomic
                before = 0
                for cell in range(histogram.shape[1]):
                    here = histogram[cloud, cell]
                    histogram[cloud, cell] = before
                    before += here
                for i in range(n):
                    place = histogram[cloud, key[cloud, i]]
                    histogram[cloud, key[cloud, i]] = place + 1
                    key[cloud, i] = place // BLOCK
                for box in range(boxes.shape[2]):
                    histogram[cloud, box] = 0
                for i in range(n):
                    box = key[cloud, i]
                    place = box * BLOCK + histogram[cloud, box]
                    histogram[cloud, box] = histogram[cloud, box] + 1
                    order[cloud, place] = i
                    for k in ti.static(range(3)):
                        ordered[cloud, place, k] = points[cloud, i, k]
                for i in range(n, ordered.shape[1]):
                    for k in ti.static(range(3)):
                        ordered[cloud, i, k] = real(outside)
                for box in range(boxes.shape[2]):
                    least = ti.Vector([real(outside) for k in ti.static(range(3))])
                    greatest = least
                    if box * BLOCK < n:
                        greatest = -least
                    for i in range(box * BLOCK, ti.min(box * BLOCK + BLOCK, n)):
                        for k in ti.static(range(3)):
                            value = ordered[cloud, i, k]
                            least[k] = ti.select(value < least[k], value, least[k])
                            greatest[k] = ti.select(value > greatest[k], value, greatest[k])
                    for k in ti.static(range(3)):
                        boxes[cloud, k, box] = least[k]
                        boxes[cloud, k + 3, box] = greatest[k]
                for group in range(groups.shape[2]):
                    least = ti.Vector([real(outside) for k in ti.static(range(3))])
                    greatest = least
                    if group * GROUP * BLOCK < n:
                        greatest = -least
                    last = ti.min(group * GROUP + GROUP, (n + BLOCK - 1) // BLOCK)
                    for box in range(group * GROUP, last):
                        for k in ti.static(range(3)):
                            least[k] = ti.min(least[k], boxes[cloud, k, box])
                            greatest[k] = ti.max(greatest[k], boxes[cloud, k + 3, box])
                    for k in ti.static(range(3)):
                        groups[cloud, k, group] = least[k]
                        groups[cloud, k + 3, group] = greatest[k]

    return SimpleNamespace(sort=sort)
