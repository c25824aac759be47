"""Clouds sorted along a Morton curve and cut into boxes, so that searches can skip whole blocks of points."""

from types import SimpleNamespace

from diffpoint.kernels._backend import ti

BLOCK = 32  # points in a box
GROUP = 32  # boxes in a box of boxes
LANES = 16  # boxes in a vector
ROWS = GROUP // LANES  # rows of boxes in a group


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


def box_tests(real):
    """Functions by which a search chooses its boxes, for a tile of queries that lie in the box from `low` to `high`."""

    @ti.func
    def clamped(x, least, greatest):
        """`x` clamped to the interval from `least` to `greatest`."""
        y = ti.select(x < least, least, x)
        return ti.select(y > greatest, greatest, y)

    @ti.func
    def gap(corners: ti.template(), cloud, box, low: ti.template(), high: ti.template()):
        """Squared distance between a box and the box from `low` to `high`."""
        total = real(0.0)
        for k in ti.static(range(3)):
            below = corners[cloud, k, box] - high[k]
            above = low[k] - corners[cloud, k + 3, box]
            outside = ti.select(below > above, below, above)
            outside = ti.select(outside > 0, outside, real(0.0))
            total += outside * outside
        return total

    @ti.func
    def gaps(boxes: ti.template(), cloud, row, low: ti.template(), high: ti.template()):
        """Squared distances of a row of 16 boxes from the box from `low` to `high`."""
        total = ti.Vector([real(0.0) for s in ti.static(range(LANES))])
        for k in ti.static(range(3)):
            below = boxes[cloud, k, row] - high[k]
            above = low[k] - boxes[cloud, k + 3, row]
            for s in ti.static(range(LANES)):
                outside = ti.select(below[s] > above[s], below[s], above[s])
                outside = ti.select(outside > 0, outside, real(0.0))
                total[s] += outside * outside
        return total

    @ti.func
    def reached(boxes: ti.template(), cloud, row, low: ti.template(), high: ti.template(), farthest):
        """Bit s: box s of a row of 16 is within the squared distance `farthest` of the box from `low` to `high`."""
        total = gaps(boxes, cloud, row, low, high)
        bits = 0
        for s in ti.static(range(LANES)):
            bits |= ti.select(total[s] <= farthest, 1 << s, 0)
        return bits

    @ti.func
    def most_central(corners: ti.template(), cloud, start, end, low: ti.template(), high: ti.template()):
        """Of the boxes `start` to `end`, the one whose centre is nearest to that of the box `low` to `high`."""
        least = real(ti.math.inf)
        best = start
        for box in range(start, end):
            d = real(0.0)
            for k in ti.static(range(3)):
                offset = corners[cloud, k, box] + corners[cloud, k + 3, box] - (low[k] + high[k])
                d += offset * offset
            closer = d < least
            best = ti.select(closer, box, best)
            least = ti.select(closer, d, least)
        return best

    return SimpleNamespace(clamped=clamped, gap=gap, gaps=gaps, reached=reached, most_central=most_central)
