"""The ops in plain torch, written to be fast: no loops over points, chunks that fit into the caches."""

from __future__ import annotations

import torch
from torch import Tensor

import diffpoint as dp

CHUNK = 4
"""Pairs whose distance matrices are held at a time."""


def nearest_both(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared distances and indices of both directions."""
    out = []
    for x, y in zip(a.split(CHUNK), b.split(CHUNK), strict=True):
        matrix = torch.cdist(x, y)
        to_b, to_a = matrix.min(2), matrix.min(1)
        out.append((to_b.values.square(), to_b.indices, to_a.values.square(), to_a.indices))
    d_ab, i_ab, d_ba, i_ba = (torch.cat(parts) for parts in zip(*out, strict=True))
    return d_ab, i_ab, d_ba, i_ba


def knn(a: Tensor, b: Tensor, k: int) -> Tensor:
    """Distances (B, N, k), ascending."""
    parts = zip(a.split(CHUNK), b.split(CHUNK), strict=True)
    return torch.cat([torch.cdist(x, y).topk(k, largest=False).values for x, y in parts])


def chamfer(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Mean distances (B) of both directions; the gradient flows through gathered neighbours, not the matrix."""
    with torch.no_grad():
        _, to_b, _, to_a = nearest_both(a, b)
    a_to_b = (a - torch.take_along_dim(b, to_b[..., None], 1)).norm(dim=-1).mean(1)
    b_to_a = (b - torch.take_along_dim(a, to_a[..., None], 1)).norm(dim=-1).mean(1)
    return a_to_b, b_to_a


def chamfer_of_parts(a: Tensor, a_lengths: Tensor, b: Tensor, b_lengths: Tensor) -> Tensor:
    """Sum (B) of both directions between the first `lengths` points."""
    in_a = torch.arange(a.shape[1]) < a_lengths[:, None]
    in_b = torch.arange(b.shape[1]) < b_lengths[:, None]
    with torch.no_grad():
        to_b, to_a = [], []
        for x, y, p, q in zip(
            a.split(CHUNK), b.split(CHUNK), in_a.split(CHUNK), in_b.split(CHUNK), strict=True
        ):
            matrix = torch.cdist(x, y)
            to_b.append(matrix.masked_fill(~q[:, None], torch.inf).argmin(2))
            to_a.append(matrix.masked_fill(~p[..., None], torch.inf).argmin(1))
    d = (a - torch.take_along_dim(b, torch.cat(to_b)[..., None], 1)).norm(dim=-1)
    e = (b - torch.take_along_dim(a, torch.cat(to_a)[..., None], 1)).norm(dim=-1)
    return torch.where(in_a, d, 0.0).sum(1) / a_lengths + torch.where(in_b, e, 0.0).sum(1) / b_lengths


def project(points: Tensor, projection: Tensor) -> Tensor:
    """(B, N, 3) points before one camera (B, 3, 4) each -> (u d, v d, d)."""
    return torch.baddbmm(projection[:, None, :, 3], points, projection[..., :3].mT)


def splat(points: Tensor, projection: Tensor, size: int, *, radius: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Depth and index in one 64-bit key; the smallest key wins a pixel. Depth keeps its gradient. Radius 0 or 1."""
    count, n = points.shape[:2]
    q = project(points, projection)
    with torch.no_grad():
        depth = q[..., 2]
        u, v = (q[..., :2] / depth[..., None]).unbind(-1)
        column, row = u.floor().long(), v.floor().long()
        key = (depth.contiguous().view(torch.int32).long() << 32) | torch.arange(n)
        best = torch.full((count, size * size + 1), 2**63 - 1, dtype=torch.int64)
        reach = range(-radius, radius + 1)
        for x, y in ((column + dx, row + dy) for dy in reach for dx in reach):
            ok = (depth > 0) & (x >= 0) & (x < size) & (y >= 0) & (y < size)
            if radius:
                own = (x == column) & (y == row)
                ok &= own | ((x + 0.5 - u).square() + (y + 0.5 - v).square() <= radius * radius)
            best.scatter_reduce_(1, torch.where(ok, y * size + x, size * size), key, "amin")
        best = best[:, :-1]
        filled = best != 2**63 - 1
        index = torch.where(filled, best & 0xFFFFFFFF, -1)
        visible = torch.zeros(count, n + 1, dtype=torch.bool)
        visible.scatter_(1, torch.where(filled, index, n), True)
    rendered = torch.where(filled, q[..., 2].gather(1, index.clamp(min=0)), torch.inf)
    return rendered.view(count, size, size), index.view(count, size, size), visible[:, :-1]


def sample(points: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
    """The visible points (B, M, 3), then padding, and their number."""
    lengths = visible.sum(-1)
    order = visible.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, : int(lengths.max())]
    inside = torch.arange(order.shape[1]) < lengths[:, None]
    return torch.where(inside[..., None], torch.take_along_dim(points, order[..., None], 1), 0.0), lengths


def unproject_dense(depth: Tensor, camera: dp.PinholeCamera) -> tuple[Tensor, Tensor]:
    """World points (B, 3, H*W) of maps (B, H, W), zeros where empty; and the foreground (B, H*W)."""
    K, cam_from_world = camera.K.flatten(0, 1), camera.cam_from_world.flatten(0, 1)
    world_from_cam = torch.linalg.inv(cam_from_world)
    rays = world_from_cam[:, :3, :3] @ torch.linalg.inv(K)
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    centres = torch.stack((columns + 0.5, rows + 0.5, torch.ones_like(rows))).flatten(1)
    flat = depth.flatten(1)
    foreground = torch.isfinite(flat)
    safe = torch.where(foreground, flat, 0.0)[:, None]
    world = torch.baddbmm(world_from_cam[:, :3, 3:], rays, centres.expand(len(rays), -1, -1) * safe)
    return torch.where(foreground[:, None], world, 0.0), foreground


def unproject(depth: Tensor, camera: dp.PinholeCamera) -> tuple[Tensor, Tensor]:
    """Foreground points first (B, H*W, 3), and their number."""
    world, foreground = unproject_dense(depth, camera)
    order = foreground.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
    return torch.take_along_dim(world, order[:, None], 2).mT, foreground.sum(-1)


def reproject(
    depth: Tensor, source: dp.PinholeCamera, target: dp.PinholeCamera
) -> tuple[Tensor, Tensor, Tensor]:
    """World points (B, 3, H*W), pixels (B, 2, H*W) and depth (B, H*W) in the target; +inf where empty."""
    world, foreground = unproject_dense(depth, source)
    projection = target.projection.flatten(0, 1)
    q = torch.baddbmm(projection[..., 3:], projection[..., :3], world)
    seen = foreground & (q[:, 2] > 0)
    pixels = q[:, :2] / torch.where(seen, q[:, 2], 1.0)[:, None]
    return (
        world,
        torch.where(seen[:, None], pixels, torch.inf),
        torch.where(foreground, q[:, 2], torch.inf),
    )


def farthest(points: Tensor, k: int) -> Tensor:
    """Indices (B, k)."""
    count, n = points.shape[:2]
    distance = torch.full((count, n), torch.inf)
    current, chosen = torch.zeros(count, dtype=torch.long), []
    for _ in range(k):
        chosen.append(current)
        here = points[torch.arange(count), current][:, None]
        distance = torch.minimum(distance, (points - here).square().sum(-1))
        current = distance.argmax(1)
    return torch.stack(chosen, 1)
