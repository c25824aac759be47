"""Reference implementations of every op in plain torch, slow and simple; the tests compare the kernels with them.

Cameras are passed as `K` (B, V, 3, 3) and `cam_from_world` (B, V, 4, 4), because this file imports torch and nothing
else. Shapes, units, frames and conventions are those of the public functions of the same names. Gradients come from
torch's autograd; distances are full matrices, so memory is O(N M).
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

# Not torch.cdist, which uses a less accurate formula for large sets.


def pairwise_squared_distance(a: Tensor, b: Tensor) -> Tensor:
    """(*B, N, D), (*B, M, D) -> (*B, N, M)."""
    return (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)


def project(points: Tensor, K: Tensor, cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (B, V, N, 2) and depth (B, V, N); pixels of points at or behind the camera's plane are +inf."""
    in_camera = points[:, None] @ cam_from_world[..., :3, :3].mT + cam_from_world[..., None, :3, 3]
    depth = in_camera[..., 2]
    front = depth > 0
    homogeneous = in_camera @ K.mT
    pixels = homogeneous[..., :2] / torch.where(front, depth, 1.0)[..., None]
    return torch.where(front[..., None], pixels, torch.inf), depth


def unproject_dense(depth: Tensor, K: Tensor, cam_from_world: Tensor) -> Tensor:
    """World points (B, V, H, W, 3) at the pixel centres; zeros where the map is empty."""
    height, width = depth.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack((columns + 0.5, rows + 0.5, torch.ones_like(rows)), dim=-1).to(depth.dtype)
    foreground = torch.isfinite(depth)
    rays = centres @ torch.linalg.inv(K)[..., None, :, :].mT
    in_camera = rays * torch.where(foreground, depth, 0.0)[..., None]
    world_from_cam = torch.linalg.inv(cam_from_world)[..., None, :, :]
    world = in_camera @ world_from_cam[..., :3, :3].mT + world_from_cam[..., None, :3, 3]
    return torch.where(foreground[..., None], world, 0.0)


def unproject(depth: Tensor, K: Tensor, cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Foreground points first (B, V, H*W, 3), and their number (B, V)."""
    batch, views, height, width = depth.shape
    dense = unproject_dense(depth, K, cam_from_world).flatten(2, 3)
    foreground = torch.isfinite(depth).flatten(2)
    points = dense.new_zeros(batch, views, height * width, 3)
    rows = []
    for b, v in itertools.product(range(batch), range(views)):
        kept = dense[b, v, foreground[b, v]]
        rows.append(torch.cat((kept, points[b, v, len(kept) :])))
    lengths = foreground.sum(-1)
    return (torch.stack(rows).view(points.shape) if rows else points), lengths


def reproject(
    depth: Tensor, source: tuple[Tensor, Tensor], target: tuple[Tensor, Tensor], size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, pixels, depth and validity in the target, whose maps have `size` (height, width)."""
    batch, views, height, width = depth.shape
    points = unproject_dense(depth, *source)
    flat = points.reshape(batch * views, height * width, 3)
    K, cam_from_world = (m.expand(batch, views, *m.shape[-2:]).reshape(-1, 1, *m.shape[-2:]) for m in target)
    pixels, seen = project(flat, K, cam_from_world)
    pixels, seen = pixels.view(batch, views, height, width, 2), seen.view(depth.shape)
    foreground = torch.isfinite(depth)
    u, v = pixels.unbind(-1)
    inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0]) & (seen > 0)
    return (
        points,
        torch.where(foreground[..., None], pixels, torch.inf),
        torch.where(foreground, seen, torch.inf),
        foreground & inside,
    )


def splat_depth(
    points: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    height: int,
    width: int,
    *,
    radius: float = 0.0,
    lengths: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (B, V, H, W), index (B, V, H, W) and visible (B, V, N); tests every point at every pixel."""
    pixels, depth = project(points, K, cam_from_world)
    u, v = pixels[..., 0, None, None], pixels[..., 1, None, None]
    rows = torch.arange(height)[:, None]
    columns = torch.arange(width)[None, :]
    covers = (u.floor() == columns) & (v.floor() == rows)
    if radius > 0:
        covers = covers | ((columns + 0.5 - u).square() + (rows + 0.5 - v).square() <= radius * radius)
    covers = covers & (depth > 0)[..., None, None]
    if lengths is not None:
        covers = covers & (torch.arange(points.shape[1]) < lengths[:, None])[:, None, :, None, None]
    candidates = torch.where(covers, depth[..., None, None], torch.inf)
    if points.shape[1] == 0:
        maps = (*depth.shape[:2], height, width)
        return points.new_full(maps, torch.inf), torch.full(maps, -1), depth > 0
    nearest_depth, index = candidates.min(dim=2)
    # torch.min may return any index of a tie; the convention is the lowest.
    index = (candidates == nearest_depth[:, :, None]).to(torch.uint8).argmax(dim=2)
    empty = torch.isinf(nearest_depth)
    gathered = torch.take_along_dim(depth, index.flatten(2), dim=2).view(index.shape)
    index = torch.where(empty, -1, index)
    visible = torch.zeros_like(depth, dtype=torch.bool)
    for b, w in itertools.product(range(index.shape[0]), range(index.shape[1])):
        visible[b, w, index[b, w][index[b, w] >= 0]] = True
    return torch.where(empty, torch.inf, gathered), index, visible


def sample_view(points: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points (B, V, M, 3), index (B, V, M) and lengths (B, V) of the visible points."""
    batch, views, _ = visible.shape
    lengths = visible.sum(-1)
    largest = int(lengths.max()) if lengths.numel() else 0
    index = torch.full((batch, views, largest), -1)
    for b, v in itertools.product(range(batch), range(views)):
        chosen = visible[b, v].nonzero()[:, 0]
        index[b, v, : len(chosen)] = chosen
    gathered = torch.take_along_dim(points[:, None], index.clamp(min=0)[..., None], dim=2)
    return torch.where((index >= 0)[..., None], gathered, 0.0), index, lengths


def visible_points(
    points: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    size: tuple[int, int],
    *,
    filters: Tensor,
    radius: float,
    limit: float,
    lengths: Tensor | None = None,
) -> Tensor:
    """(B, V, N): the method "horizon"; `filters` (F, 11); points with a score of at most `limit` are visible."""
    batch, views = cam_from_world.shape[:2]
    visible = torch.zeros((batch, views, points.shape[1]), dtype=torch.bool)
    for b, v in itertools.product(range(batch), range(views)):
        image, framed = image_positions(points[b], K[b, v], cam_from_world[b, v], size)
        if lengths is not None:
            framed = framed & (torch.arange(len(framed)) < lengths[b])
        chosen = framed.nonzero()[:, 0]
        if len(chosen) == 0:
            continue
        aspect = float(K[b, v, 0, 0] / K[b, v, 1, 1])
        horizon, open_ = horizons(image[chosen], aspect, point_spacing(image[chosen], aspect), radius)
        visible[b, v, chosen[open_[horizon_score(horizon, filters) <= limit]]] = True
    return visible


def image_positions(
    points: Tensor, K: Tensor, cam_from_world: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """(u, v, focal length * log(depth)) (N, 3), all in pixels, and which of the points are in the frame (N,)."""
    pixels, depth = (x[0, 0] for x in project(points[None], K[None, None], cam_from_world[None, None]))
    framed = (depth > 0) & (pixels >= 0).all(1) & (pixels[:, 0] < size[1]) & (pixels[:, 1] < size[0])
    return torch.cat((pixels, K[0, 0] * torch.where(framed, depth, 1.0).log()[:, None]), dim=1), framed


def point_spacing(image: Tensor, aspect: float) -> float:
    """sqrt(area of the silhouette / points) in pixels, estimated from the share of occupied cells."""
    count = len(image)
    flat = image[:, :2] - image[:, :2].min(0).values
    flat = flat * flat.new_tensor([1.0, aspect])
    side = cell_side(flat, count / 2, count, 1e-6)
    occupied = len(torch.unique((flat / side).long(), dim=0))
    area = torch.tensor(occupied, dtype=torch.float64)
    for _ in range(20):
        area = occupied / (1 - (-count / area).exp())
    return side * float(area / count) ** 0.5


def cell_side(flat: Tensor, cells: float, longest: float, smallest: float) -> float:
    """Side of square cells of which about `cells` cover the extent of (n, 2), and at most `longest` per direction."""
    across, down = flat.max(0).values.tolist()
    return max((across * down / cells) ** 0.5, max(across, down) / longest, smallest)


def octant(dx: Tensor, dy: Tensor) -> Tensor:
    """Sector 0 to 7 of a direction, counted from +x to +y; half-open, so that every direction has one."""
    circle = torch.tensor([0, 1, 3, 2, 7, 6, 4, 5])
    return circle[4 * (dy < 0).long() + 2 * (dx < 0).long() + (dy.abs() > dx.abs()).long()]


def horizons(
    image: Tensor, aspect: float, spacing: float, radius: float, *, cell: float = 2.5, deep: float = 1.5
) -> tuple[Tensor, Tensor]:
    """Cosine to the view's axis of the highest neighbour in 8 sectors (m, 8), and the indices (m,) of the open points.

    "High" means near to the camera. The cosine is negative where the highest neighbour is farther than the point, -1 if
    there is none. A point is enclosed if on two of the four lines through its cell the cells on both sides are nearer
    by `deep`. Enclosed points are hidden, and are not used as neighbours; all others are open.
    """
    flat = (image[:, :2] - image[:, :2].min(0).values) * image.new_tensor([1.0, aspect])
    open_ = (~_enclosed(flat, image[:, 2], spacing, cell, deep)).nonzero()[:, 0]
    flat, w = flat[open_], image[open_, 2]
    way = flat - flat[:, None]
    gap = w[:, None] - w
    distance = way.square().sum(-1)
    whole = distance + gap.square()
    cosine = gap / whole.clamp(min=1e-30).sqrt()
    near = (distance <= (radius * spacing) ** 2) & (whole > 0)
    sector = octant(way[..., 0], way[..., 1])
    highest = [torch.where(near & (sector == k), cosine, -1.0).max(1).values for k in range(8)]
    return torch.stack(highest, dim=1), open_


def _enclosed(flat: Tensor, w: Tensor, spacing: float, cell: float, deep: float) -> Tensor:
    side = cell_side(flat, 2 * len(flat), len(flat) / 2, cell * spacing)
    column, row = (flat / side).long().unbind(1)
    front = w.new_full((int(row.max()) + 3, int(column.max()) + 3), torch.inf)
    front.view(-1).scatter_reduce_(0, (row + 1) * front.shape[1] + column + 1, w, "amin")
    sides = ((0, 1), (1, 0), (1, 1), (1, -1))
    pairs = [
        torch.maximum(front[row + 1 + dy, column + 1 + dx], front[row + 1 - dy, column + 1 - dx])
        for dy, dx in sides
    ]
    return w > torch.stack(pairs).sort(0).values[1] + deep * spacing


def horizon_score(horizon: Tensor, filters: Tensor) -> Tensor:
    """(m,) from horizons (m, 8) and filters (F, 11): each is applied at the 8 rotations of the sectors.

    A filter is 8 weights, a bias, and the weights of the mean and the maximum of its responses.
    """
    turned = torch.stack([horizon.roll(-k, 1) for k in range(8)])
    response = torch.relu(turned @ filters[:, :8].T + filters[:, 8])
    return response.mean(0) @ filters[:, 9] + response.amax(0) @ filters[:, 10]


def nearest(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Squared distance (*B, N) and index (*B, N)."""
    if b.shape[-2] == 0:
        d, index = a.new_full(a.shape[:-1], torch.inf), torch.full(a.shape[:-1], -1)
    else:
        matrix = pairwise_squared_distance(a, b)
        if b_lengths is not None:
            matrix = torch.where(_mask(b, b_lengths)[..., None, :], matrix, torch.inf)
        least = matrix.detach().min(-1, keepdim=True).values
        index = (matrix.detach() == least).to(torch.uint8).argmax(-1)
        d = torch.take_along_dim(matrix, index[..., None], dim=-1)[..., 0]
        index = torch.where(torch.isinf(d), -1, index)
    if a_lengths is not None:
        inside = _mask(a, a_lengths)
        d, index = torch.where(inside, d, 0.0), torch.where(inside, index, -1)
    return d, index


def knn(
    a: Tensor,
    b: Tensor,
    k: int,
    *,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
    radius: float | None = None,
    exclude_self: bool = False,
) -> tuple[Tensor, Tensor]:
    """Squared distance (*B, N, k) and index (*B, N, k)."""
    matrix = pairwise_squared_distance(a, b)
    if b_lengths is not None:
        matrix = torch.where(_mask(b, b_lengths)[..., None, :], matrix, torch.inf)
    if radius is not None:
        matrix = torch.where(matrix <= a.new_tensor(radius).square(), matrix, torch.inf)
    if exclude_self:
        matrix = torch.where(torch.eye(a.shape[-2], dtype=torch.bool), torch.inf, matrix)
    none = matrix.new_full((*matrix.shape[:-1], k), torch.inf)
    matrix = torch.cat((matrix, none), -1)
    index = matrix.detach().sort(dim=-1, stable=True).indices[..., :k]
    d = torch.take_along_dim(matrix, index, dim=-1)
    index = torch.where(torch.isinf(d), -1, index)
    if a_lengths is not None:
        inside = _mask(a, a_lengths)[..., None]
        d, index = torch.where(inside, d, 0.0), torch.where(inside, index, -1)
    return d, index


def chamfer_distance(
    a: Tensor,
    b: Tensor,
    *,
    squared: bool,
    reduction: str = "mean",
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """a_to_b (*B) and b_to_a (*B); (*B, N) and (*B, M) with reduction "none"."""
    directions = []
    for first, second, first_lengths, second_lengths in (
        (a, b, a_lengths, b_lengths),
        (b, a, b_lengths, a_lengths),
    ):
        d, _ = nearest(first, second, a_lengths=first_lengths, b_lengths=second_lengths)
        d = d if squared else _sqrt(d)
        count = first.shape[-2] if first_lengths is None else first_lengths
        if reduction == "mean":
            d = d.sum(-1) / count
        elif reduction != "none":
            d = d.sum(-1) if reduction == "sum" or d.shape[-1] == 0 else d.amax(-1)
        directions.append(d)
    return directions[0], directions[1]


def hausdorff_distance(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> Tensor:
    """(*B)."""
    lengths = {"a_lengths": a_lengths, "b_lengths": b_lengths}
    return torch.maximum(*chamfer_distance(a, b, squared=False, reduction="max", **lengths))


def f_score(
    a: Tensor,
    b: Tensor,
    threshold: float,
    *,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """F-score, precision and recall (*B)."""
    lengths = {"a_lengths": a_lengths, "b_lengths": b_lengths}
    distances = chamfer_distance(a, b, squared=False, reduction="none", **lengths)
    shares = []
    for points, d, count in zip((a, b), distances, (a_lengths, b_lengths), strict=True):
        count = torch.full(points.shape[:-2], points.shape[-2]) if count is None else count
        shares.append(((d <= threshold) & _mask(points, count)).sum(-1).to(a.dtype) / count)
    precision, recall = shares
    return (2 * precision * recall / (precision + recall)).nan_to_num(0.0), precision, recall


def earth_mover_distance(
    a: Tensor,
    b: Tensor,
    *,
    squared: bool = False,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Exact cost (*B) and assignment (*B, N), by shortest augmenting paths."""
    batch = a.shape[:-2]
    a3, b3 = a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:])
    la = torch.full((len(a3),), a.shape[-2]) if a_lengths is None else a_lengths.reshape(-1)
    lb = torch.full((len(b3),), b.shape[-2]) if b_lengths is None else b_lengths.reshape(-1)
    costs, assignments = [], []
    for x, y, n, m in zip(a3, b3, la.tolist(), lb.tolist(), strict=True):
        squares = pairwise_squared_distance(x[:n], y[:m])
        matrix = squares if squared else _sqrt(squares)
        columns = torch.full((len(x),), -1)
        if n <= m:
            columns[:n] = assign(matrix.detach())
        else:
            rows = assign(matrix.detach().T)
            columns[rows] = torch.arange(m)
        matched = (columns >= 0).nonzero()[:, 0]
        costs.append(matrix[matched, columns[matched]].mean())
        assignments.append(columns)
    return torch.stack(costs).reshape(batch), torch.stack(assignments).reshape(a.shape[:-1])


def assign(cost: Tensor) -> Tensor:
    """The column of each row in the optimal assignment, cost (n, m) with n <= m; O(n^2 m)."""
    n, m = cost.shape
    row_price = cost.new_zeros(n + 1)
    column_price = cost.new_zeros(m + 1)
    row_of = torch.zeros(m + 1, dtype=torch.long)  # rows and columns count from 1; 0 is "none"
    for row in range(1, n + 1):
        row_of[0] = row
        column = 0
        shortest = cost.new_full((m + 1,), torch.inf)
        previous = torch.zeros(m + 1, dtype=torch.long)
        used = torch.zeros(m + 1, dtype=torch.bool)
        while row_of[column] != 0:
            used[column] = True
            current = int(row_of[column])
            reduced = cost[current - 1] - row_price[current] - column_price[1:]
            better = ~used[1:] & (reduced < shortest[1:])
            shortest[1:][better] = reduced[better]
            previous[1:][better] = column
            step, free = torch.where(used[1:], torch.inf, shortest[1:]).min(0)
            row_price[row_of[used]] += step
            column_price[used] -= step
            shortest[~used] -= step
            column = int(free) + 1
        while column:
            row_of[column] = row_of[previous[column]]
            column = int(previous[column])
    columns = torch.empty(n, dtype=torch.long)
    taken = row_of[1:] > 0
    columns[row_of[1:][taken] - 1] = taken.nonzero()[:, 0]
    return columns


def approxmatch(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> Tensor:
    """Sum (*B) of matched masses times distances; the match is held fixed for the gradient."""
    batch = a.shape[:-2]
    a3, b3 = a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:])
    la = torch.full((len(a3),), a.shape[-2]) if a_lengths is None else a_lengths.reshape(-1)
    lb = torch.full((len(b3),), b.shape[-2]) if b_lengths is None else b_lengths.reshape(-1)
    costs = []
    for x, y, n, m in zip(a3, b3, la.tolist(), lb.tolist(), strict=True):
        squared = pairwise_squared_distance(x[:n], y[:m])
        match = soft_match(squared.detach())
        costs.append((match * _sqrt(squared)).sum())
    return torch.stack(costs).reshape(batch)


def soft_match(squared_distance: Tensor) -> Tensor:
    """(n, m) masses that the released code moves between the points."""
    n, m = squared_distance.shape
    supply = squared_distance.new_full((n, 1), max(m // n, 1))
    demand = squared_distance.new_full((1, m), max(n // m, 1))
    match = torch.zeros_like(squared_distance)
    for level in [-(4.0**j) for j in range(7, -2, -1)] + [0.0]:
        near = (level * squared_distance).exp()
        offer = supply / ((near * demand).sum(1, keepdim=True) + 1e-9)
        offered = demand * (near * offer).sum(0, keepdim=True)
        request = demand * (demand / (offered + 1e-9)).clamp(max=1)
        demand = (demand - offered).clamp(min=0)
        moved = near * offer * request
        match = match + moved
        supply = (supply - moved.sum(1, keepdim=True)).clamp(min=0)
    return match


def farthest_point_sample(
    points: Tensor, k: int | Tensor, *, start: int | Tensor = 0, lengths: Tensor | None = None
) -> Tensor:
    """Indices (*B, k); -1 after the k points of a cloud, or after all that it has."""
    batch = points.shape[:-2]
    sizes = torch.full(batch, points.shape[-2]) if lengths is None else lengths
    counts = torch.as_tensor(k).expand(batch)
    distance = torch.where(_mask(points, sizes), torch.inf, -1.0).to(points.dtype)
    current = torch.as_tensor(start).expand(batch)
    chosen = torch.full((*batch, int(torch.as_tensor(k).max())), -1)
    for step in range(chosen.shape[-1] if points.shape[-2] else 0):
        chosen[..., step] = torch.where(step < torch.minimum(counts, sizes), current, -1)
        here = torch.take_along_dim(points, current[..., None, None], dim=-2)
        distance = torch.minimum(distance, (points - here).square().sum(-1))
        distance = distance.scatter(-1, current[..., None], -1.0)  # none is chosen twice
        current = (distance == distance.max(-1, keepdim=True).values).to(torch.uint8).argmax(-1)
    return chosen


def front_constraint(
    points: Tensor, K: Tensor, cam_from_world: Tensor, depth: Tensor, *, distance: str = "chamfer"
) -> Tensor:
    """(B, V), view by view; see the public function for views without points."""
    height, width = depth.shape[-2:]
    _, _, visible = splat_depth(points, K, cam_from_world, height, width)
    target, lengths = unproject(depth, K, cam_from_world)
    loss = []
    for b, v in itertools.product(*map(range, depth.shape[:2])):
        seen = points[b, visible[b, v]] if visible[b, v].any() else points[b]
        observed = target[b, v, : lengths[b, v]]
        if len(observed) == 0:
            loss.append(points.new_zeros(()))
        elif distance == "chamfer":
            loss.append(torch.stack(chamfer_distance(seen, observed, squared=False)).sum(0))
        else:
            loss.append(earth_mover_distance(seen, observed)[0])
    return torch.stack(loss).view(depth.shape[:2])


def diversity_loss(codes: Tensor, clouds: Tensor, *, alpha: float) -> Tensor:
    """(B,)."""
    terms = [
        torch.relu((codes[i] - codes[j]).norm(dim=-1) - alpha * earth_mover_distance(clouds[i], clouds[j])[0])
        for i, j in itertools.combinations(range(len(codes)), 2)
    ]
    return torch.stack(terms).mean(0)


def consistency_loss(clouds: Tensor) -> Tensor:
    """(*B)."""
    terms = [
        torch.stack(chamfer_distance(clouds[..., i, :, :], clouds[..., j, :, :], squared=False)).sum(0)
        for i, j in itertools.combinations(range(clouds.shape[-3]), 2)
    ]
    return torch.stack(terms).mean(0)


def minimal_matching_distance(samples: Tensor, references: Tensor, *, squared: bool) -> Tensor:
    """(*B, R)."""
    matched = []
    for reference in references.unbind(-3):
        distances = [
            torch.stack(chamfer_distance(sample, reference, squared=squared)).sum(0)
            for sample in samples.unbind(-3)
        ]
        matched.append(torch.stack(distances).min(0).values)
    return torch.stack(matched, -1)


def total_mutual_difference(clouds: Tensor, *, squared: bool) -> Tensor:
    """(*B)."""
    shapes = clouds.unbind(-3)
    total = clouds.new_zeros(clouds.shape[:-3])
    for i, one in enumerate(shapes):
        others = [shape for j, shape in enumerate(shapes) if j != i]
        distances = [torch.stack(chamfer_distance(one, other, squared=squared)).sum(0) for other in others]
        total = total + torch.stack(distances).mean(0)
    return total


def unidirectional_hausdorff_distance(
    partial: Tensor, completions: Tensor, *, partial_lengths: Tensor | None = None
) -> Tensor:
    """(*B)."""
    directed = [
        _sqrt(nearest(partial, completion, a_lengths=partial_lengths)[0].amax(-1))
        for completion in completions.unbind(-3)
    ]
    return torch.stack(directed).mean(0)


def _mask(points: Tensor, lengths: Tensor) -> Tensor:
    return torch.arange(points.shape[-2]) < lengths[..., None]


def _sqrt(x: Tensor) -> Tensor:
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)
