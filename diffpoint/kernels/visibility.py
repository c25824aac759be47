"""Visibility of points without a mesh, from the horizons of the points themselves.

Image positions are (u, v, w): pixels, and w = focal length * log(depth), so that differences of all three are lengths
in pixels, at any distance of the object. w is +inf for points that are not in the frame.
"""

from types import SimpleNamespace

from diffpoint._horizon import CELL, DEEP
from diffpoint.kernels._backend import ti

FILTERS = 8
"""Number of filters of the horizon test; each is applied at the 8 rotations of the sectors."""
_LANES = 16  # points scored at once in the horizon test: one vector register


def build(real):
    reals = ti.types.ndarray(dtype=real, ndim=1)
    integers = ti.types.ndarray(dtype=ti.i64, ndim=1)
    small = ti.types.ndarray(dtype=ti.i32, ndim=1)
    flags = ti.types.ndarray(dtype=ti.u8, ndim=1)

    @ti.func
    def place(
        points: ti.template(),
        projection: ti.template(),
        image: ti.template(),
        cells: ti.template(),
        slot,
        view,
        cloud,
        count,
        length,
        height,
        width,
    ):
        """Fill `image`; returns ratio of focal lengths, spacing, low u, low v, extents of u and v, number of points."""
        camera = ti.Vector([projection[view * 12 + e] for e in ti.static(range(12))])
        across = ti.Vector([camera[0], camera[1], camera[2]])
        down = ti.Vector([camera[4], camera[5], camera[6]])
        forward = ti.Vector([camera[8], camera[9], camera[10]])
        # K's skew and principal point are parts along `forward`, which the cross products remove.
        focal = across.cross(forward).norm()
        aspect = focal / down.cross(forward).norm()
        columns = ti.cast(width, real)
        rows = ti.cast(height, real)
        low_u, low_v = columns, rows
        high_u, high_v = real(0.0), real(0.0)
        inside = 0
        for i in range(count):
            x = points[(cloud * count + i) * 3]
            y = points[(cloud * count + i) * 3 + 1]
            z = points[(cloud * count + i) * 3 + 2]
            d = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
            u = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) / d
            v = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) / d
            seen = (i < length) & (d > 0) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
            at = (slot * count + i) * 3
            image[at] = ti.select(seen, u, real(0.0))
            image[at + 1] = ti.select(seen, v, real(0.0))
            image[at + 2] = real(ti.math.inf)
            if seen:
                image[at + 2] = focal * ti.log(d)
                low_u = ti.select(u < low_u, u, low_u)
                low_v = ti.select(v < low_v, v, low_v)
                high_u = ti.select(u > high_u, u, high_u)
                high_v = ti.select(v > high_v, v, high_v)
                inside += 1
        extent_u = high_u - low_u
        extent_v = (high_v - low_v) * aspect
        spacing = real(1.0)
        if inside > 0:
            # n random points on a silhouette of A cells occupy A (1 - exp(-n / A)) of them: solved for A.
            n = ti.cast(inside, real)
            side = cell_side(extent_u, extent_v, n / real(2.0), n, real(1e-6))
            per_side = real(1.0) / side
            across_cells = ti.cast(extent_u * per_side, ti.i32) + 1
            down_cells = ti.cast(extent_v * per_side, ti.i32) + 1
            first = slot * (8 * count + 32)
            for c in range(first, first + across_cells * down_cells):
                cells[c] = 0
            for i in range(count):
                at = (slot * count + i) * 3
                if image[at + 2] < real(ti.math.inf):
                    column = ti.cast((image[at] - low_u) * per_side, ti.i32)
                    row = ti.cast((image[at + 1] - low_v) * aspect * per_side, ti.i32)
                    cells[first + row * across_cells + column] = 1
            occupied = real(0.0)
            for c in range(first, first + across_cells * down_cells):
                occupied += ti.cast(cells[c], real)
            area = occupied
            for _ in range(20):
                area = occupied / (real(1.0) - ti.exp(-n / area))
            spacing = side * ti.sqrt(area / n)
        return aspect, spacing, low_u, low_v, extent_u, extent_v, inside

    @ti.func
    def cell_side(extent_u, extent_v, cells, longest, smallest):
        """Side of square cells of which about `cells` cover the extents, and at most `longest` per direction."""
        even = ti.sqrt(extent_u * extent_v / cells)
        thin = ti.max(extent_u, extent_v) / longest
        return ti.max(even, thin, smallest)

    @ti.func
    def octant(dx, dy):
        """0 to 7: signs of dy and dx, and which is larger. Half-open, so that every direction has one."""
        return (
            4 * ti.cast(dy < 0, ti.i32)
            + 2 * ti.cast(dx < 0, ti.i32)
            + ti.cast(ti.abs(dy) > ti.abs(dx), ti.i32)
        )

    @ti.func
    def sort_open(
        image: ti.template(),
        cell: ti.template(),
        front: ti.template(),
        ends: ti.template(),
        order: ti.template(),
        packed: ti.template(),
        slot,
        count,
        low_u,
        low_v,
        aspect,
        per_side,
        across,
        down,
        deep,
    ):
        """Counting sort, cell by cell, of the points that are not enclosed (see `DEEP`).

        `packed` and `order` then hold the points and their indices, `ends` the end of each cell; returns their number.
        """
        first = slot * (8 * count + 32)
        for c in range(first, first + across * down):
            front[c] = real(ti.math.inf)
        for c in range(first, first + across * down):
            ends[c] = 0
        for i in range(slot * count, slot * count + count):
            w = image[i * 3 + 2]
            if w < real(ti.math.inf):
                column = ti.cast((image[i * 3] - low_u) * per_side, ti.i32) + 1
                row = ti.cast((image[i * 3 + 1] - low_v) * aspect * per_side, ti.i32) + 1
                c = first + row * across + column
                cell[i] = c
                front[c] = ti.select(w < front[c], w, front[c])
        for i in range(slot * count, slot * count + count):
            w = image[i * 3 + 2]
            if w < real(ti.math.inf):
                c = cell[i]
                first_line = higher(front[c - 1], front[c + 1])
                second_line = higher(front[c - across], front[c + across])
                third_line = higher(front[c - across - 1], front[c + across + 1])
                fourth_line = higher(front[c - across + 1], front[c + across - 1])
                level = lower(
                    higher(lower(first_line, second_line), lower(third_line, fourth_line)),
                    lower(higher(first_line, second_line), higher(third_line, fourth_line)),
                )
                enclosed = w > level + deep
                ends[c] = ends[c] + ti.select(enclosed, 0, 1)  # not +=, which would be atomic
                # Enclosed points go to the spare place at the end: faster than an unpredictable branch.
                cell[i] = ti.select(enclosed, -1, c)
            else:
                cell[i] = -1
        total = 0
        for c in range(first, first + across * down):
            here = ends[c]
            ends[c] = total
            total += here
        stride = count + _LANES + 1
        for i in range(count):
            at = (slot * count + i) * 3
            c = cell[slot * count + i]
            kept = c >= 0
            c = ti.select(kept, c, first)
            target = ti.select(kept, ends[c], stride - 1)
            ends[c] = ends[c] + ti.select(kept, 1, 0)
            order[slot * stride + target] = i
            packed[slot * stride * 3 + target] = image[at] - low_u
            packed[slot * stride * 3 + stride + target] = (image[at + 1] - low_v) * aspect
            packed[slot * stride * 3 + stride * 2 + target] = image[at + 2]
        for k in range(3):  # the last register is padded with the last point
            for rest in range(total, ti.select(total > 0, total + _LANES, total)):
                at = (slot * 3 + k) * stride
                packed[at + rest] = packed[at + total - 1]
        return total

    @ti.func
    def lower(a, b):
        return ti.select(a < b, a, b)

    @ti.func
    def higher(a, b):
        return ti.select(a > b, a, b)

    @ti.kernel
    def horizon(
        points: reals,
        lengths: integers,
        projection: reals,
        image: reals,
        cells: small,
        cell: small,
        front: reals,
        order: small,
        packed: reals,
        filters: reals,
        visible: flags,
        workers: ti.i32,
        views: ti.i32,
        count: ti.i32,
        height: ti.i32,
        width: ti.i32,
        radius: real,
        limit: real,
        spread: ti.i32,
    ):
        """Points whose 8 horizons within `radius` score at most `limit` under the filters."""
        for step in range(workers * spread):
            if step % spread == 0:
                slot = step // spread
                for turn in range((lengths.shape[0] * views - slot + workers - 1) // workers):
                    view = slot + turn * workers
                    cloud = view // views
                    length = ti.cast(lengths[cloud], ti.i32)
                    aspect, spacing, low_u, low_v, extent_u, extent_v, inside = place(
                        points, projection, image, cells, slot, view, cloud, count, length, height, width
                    )
                    for i in range(view * count, view * count + count):
                        visible[i] = ti.u8(0)
                    reach = radius * spacing
                    n = ti.cast(inside, real)
                    side = cell_side(extent_u, extent_v, real(2.0) * n, n / real(2.0), real(CELL) * spacing)
                    per_side = real(1.0) / side
                    across = ti.cast(extent_u * per_side, ti.i32) + 3  # a ring of empty cells all around
                    down = ti.cast(extent_v * per_side, ti.i32) + 3
                    remaining = 0
                    if inside > 0:
                        remaining = sort_open(
                            image,
                            cell,
                            front,
                            cells,
                            order,
                            packed,
                            slot,
                            count,
                            low_u,
                            low_v,
                            aspect,
                            per_side,
                            across,
                            down,
                            real(DEEP) * spacing,
                        )
                    first = slot * (8 * count + 32)
                    stride = count + _LANES + 1
                    xs = slot * stride * 3
                    ys, ws = xs + stride, xs + stride * 2
                    for tile in range((remaining + _LANES - 1) // _LANES):
                        begin = tile * _LANES
                        x = ti.Vector([packed[xs + begin + s] for s in ti.static(range(_LANES))])
                        y = ti.Vector([packed[ys + begin + s] for s in ti.static(range(_LANES))])
                        w = ti.Vector([packed[ws + begin + s] for s in ti.static(range(_LANES))])
                        # Eight variables, because a matrix would not stay in registers.
                        none = ti.Vector([real(-1.0) for _ in ti.static(range(_LANES))])
                        c0, c1, c2, c3, c4, c5, c6, c7 = none, none, none, none, none, none, none, none
                        left = ti.max(ti.cast((x.min() - reach) * per_side, ti.i32) + 1, 1)
                        right = ti.min(ti.cast((x.max() + reach) * per_side, ti.i32) + 1, across - 2)
                        top = ti.max(ti.cast((y.min() - reach) * per_side, ti.i32) + 1, 1)
                        bottom = ti.min(ti.cast((y.max() + reach) * per_side, ti.i32) + 1, down - 2)
                        for row in range(top, bottom + 1):
                            # The points of a row of cells are contiguous; a cell begins where the one before it ends.
                            start = cells[first + row * across + left - 1]
                            for j in range(start, cells[first + row * across + right]):
                                dx = packed[xs + j] - x
                                dy = packed[ys + j] - y
                                gap = w - packed[ws + j]
                                d = dx * dx + dy * dy
                                # Signed squared cosine between the view's axis and the direction to the neighbour; with
                                # `tiny` it is -1 (no horizon) for the point itself.
                                tiny = real(1e-30)
                                rise = (gap * ti.abs(gap) - tiny) / (d + gap * gap + tiny)
                                rise = ti.select(d <= reach * reach, rise, real(-1.0))
                                # The height counts in one sector only.
                                steep, left_of, above = ti.abs(dy) > ti.abs(dx), dx < 0, dy < 0
                                steep_any, flat_any = (
                                    ti.select(steep, rise, none),
                                    ti.select(steep, none, rise),
                                )
                                steep_left, steep_right = (
                                    ti.select(left_of, steep_any, none),
                                    ti.select(left_of, none, steep_any),
                                )
                                flat_left, flat_right = (
                                    ti.select(left_of, flat_any, none),
                                    ti.select(left_of, none, flat_any),
                                )
                                c0 = higher(ti.select(above, none, flat_right), c0)
                                c1 = higher(ti.select(above, none, steep_right), c1)
                                c2 = higher(ti.select(above, none, steep_left), c2)
                                c3 = higher(ti.select(above, none, flat_left), c3)
                                c4 = higher(ti.select(above, flat_left, none), c4)
                                c5 = higher(ti.select(above, steep_left, none), c5)
                                c6 = higher(ti.select(above, steep_right, none), c6)
                                c7 = higher(ti.select(above, flat_right, none), c7)
                        score = score_of(filters, c0, c1, c2, c3, c4, c5, c6, c7)
                        for s in ti.static(range(_LANES)):
                            if begin + s < remaining:
                                i = order[slot * stride + begin + s]
                                visible[view * count + i] = ti.cast(score[s] <= limit, ti.u8)

    @ti.func
    def score_of(filters: ti.template(), c0, c1, c2, c3, c4, c5, c6, c7):
        """Score of filters: 8 weights, a bias, and the weights of mean and maximum over the 8 rotations."""
        h0, h1, h2, h3 = signed_root(c0), signed_root(c1), signed_root(c2), signed_root(c3)
        h4, h5, h6, h7 = signed_root(c4), signed_root(c5), signed_root(c6), signed_root(c7)
        score = h0 * real(0.0)
        for f in range(FILTERS):
            a = ti.Vector([filters[f * 11 + e] for e in ti.static(range(11))])
            r = response(a, h0, h1, h2, h3, h4, h5, h6, h7)
            total, largest = r, r
            r = response(a, h1, h2, h3, h4, h5, h6, h7, h0)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h2, h3, h4, h5, h6, h7, h0, h1)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h3, h4, h5, h6, h7, h0, h1, h2)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h4, h5, h6, h7, h0, h1, h2, h3)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h5, h6, h7, h0, h1, h2, h3, h4)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h6, h7, h0, h1, h2, h3, h4, h5)
            total, largest = total + r, ti.select(r > largest, r, largest)
            r = response(a, h7, h0, h1, h2, h3, h4, h5, h6)
            total, largest = total + r, ti.select(r > largest, r, largest)
            score += a[9] * total / real(8.0) + a[10] * largest
        return score

    @ti.func
    def signed_root(c):
        return ti.select(c < 0, -ti.sqrt(ti.abs(c)), ti.sqrt(ti.abs(c)))

    @ti.func
    def response(a, h0, h1, h2, h3, h4, h5, h6, h7):
        r = (
            a[0] * h0
            + a[1] * h1
            + a[2] * h2
            + a[3] * h3
            + a[4] * h4
            + a[5] * h5
            + a[6] * h6
            + a[7] * h7
            + a[8]
        )
        return ti.select(r > 0, r, real(0.0))

    return SimpleNamespace(horizon=horizon)
