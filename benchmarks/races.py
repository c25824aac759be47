"""What is raced: each op at the sizes of the paper's training step, beside every peer that is installed."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks.harness import Contender, Race


def races() -> Iterator[Race]:
    yield from _chamfer(80, 2048, 2048)
    yield from _chamfer(8, 16384, 2048)
    yield from _chamfer_backward(80, 2048)
    yield from _splat(80, 2048, 56)
    yield from _splat(80, 2048, 224)
    yield from _splat(1, 10_000, 56)
    yield from _project(80, 2048)
    yield from _transport(8, 512)
    yield from _transport(8, 2048)
    yield from _farthest(2, 16384, 2048)


def optional(name: str) -> ModuleType | None:
    """A peer that may not be installed (extra [bench])."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def surfaces(count: int, points: int, *, seed: int) -> Tensor:
    """Clouds (count, points, 3) on the surfaces of four random boxes each, with a little noise."""
    generator = torch.Generator().manual_seed(seed)
    centre = (torch.rand(count, 4, 3, generator=generator) - 0.5) * 0.5
    half = torch.rand(count, 4, 3, generator=generator) * 0.25 + 0.03
    box = torch.randint(0, 4, (count, points, 1), generator=generator).expand(-1, -1, 3)
    inside = torch.rand(count, points, 3, generator=generator) * 2 - 1
    axis = torch.randint(0, 3, (count, points, 1), generator=generator)
    on_face = inside.scatter(2, axis, inside.gather(2, axis).sign())
    noise = 0.005 * torch.randn(count, points, 3, generator=generator)
    return centre.gather(1, box) + on_face * half.gather(1, box) + noise


def pairs(count: int, n: int, m: int) -> tuple[Tensor, Tensor]:
    """A truth and a noisy prediction of it, as in the middle of a training."""
    both = surfaces(count, n + m, seed=0)
    noise = 0.03 * torch.randn(count, n, 3, generator=torch.Generator().manual_seed(1))
    return (both[:, :n] + noise).contiguous(), both[:, n:].contiguous()


def _each(pairs_of: int, function) -> list[Any]:
    return [function(i) for i in range(pairs_of)]


def _chamfer(count: int, n: int, m: int) -> Iterator[Race]:
    a, b = pairs(count, n, m)
    a_numpy, b_numpy = a.numpy(), b.numpy()

    def ours():
        return dp.nearest(a, b), dp.nearest(b, a)

    def torch_cdist():
        # A chunk at a time: the whole matrix of 80 pairs would not fit the caches, nor some memories.
        out = []
        for x, y in zip(a.split(4), b.split(4), strict=True):
            d = torch.cdist(x, y)
            out.append((d.min(2).values, d.min(1).values))
        return out

    peers = [Contender("torch cdist", torch_cdist, lambda r: torch.cat([p[0] for p in r]).square())]
    if tree := optional("scipy.spatial"):

        def kd_tree(i: int):
            forward = tree.cKDTree(b_numpy[i]).query(a_numpy[i], workers=os.cpu_count() or 1)
            return forward, tree.cKDTree(a_numpy[i]).query(b_numpy[i], workers=os.cpu_count() or 1)

        peers.append(
            Contender(
                "scipy cKDTree",
                lambda: _each(count, kd_tree),
                lambda r: torch.from_numpy(np.stack([p[0][0] for p in r])).square(),
            )
        )
    if pcu := optional("point_cloud_utils"):
        peers.append(
            Contender(
                "point-cloud-utils",
                lambda: _each(
                    count,
                    lambda i: (
                        pcu.k_nearest_neighbors(a_numpy[i], b_numpy[i], 1),
                        pcu.k_nearest_neighbors(b_numpy[i], a_numpy[i], 1),
                    ),
                ),
                lambda r: torch.from_numpy(np.stack([p[0][0] for p in r])).square().reshape(count, n),
            )
        )
    if open3d := optional("open3d"):
        core = open3d.core

        def search(x, y):
            index = core.nns.NearestNeighborSearch(core.Tensor.from_numpy(y))
            index.knn_index()
            return index.knn_search(core.Tensor.from_numpy(x), 1)

        peers.append(
            Contender(
                "open3d",
                lambda: _each(
                    count, lambda i: (search(a_numpy[i], b_numpy[i]), search(b_numpy[i], a_numpy[i]))
                ),
                lambda r: torch.from_numpy(np.stack([p[0][1].numpy()[:, 0] for p in r])),
            )
        )
    value = Contender("diffpoint", ours, lambda r: r[0].squared_distance)
    yield Race("nearest, both directions", f"{count} x {n} x {m}", value, peers, units=count)


def _chamfer_backward(count: int, n: int) -> Iterator[Race]:
    a, b = pairs(count, n, n)

    def ours():
        x, y = a.clone().requires_grad_(), b.clone().requires_grad_()
        sum(d.sum() for d in dp.chamfer_distance(x, y, squared=False)).backward()
        return x.grad

    def torch_gather():
        grads = []
        for first, second in zip(a.split(4), b.split(4), strict=True):
            x, y = first.clone().requires_grad_(), second.clone().requires_grad_()
            with torch.no_grad():
                d = torch.cdist(x, y)
                to_b, to_a = d.argmin(2), d.argmin(1)
            forward = (x - torch.take_along_dim(y, to_b[..., None], 1)).norm(dim=-1).mean(1)
            backward = (y - torch.take_along_dim(x, to_a[..., None], 1)).norm(dim=-1).mean(1)
            (forward + backward).sum().backward()
            grads.append(x.grad)
        return torch.cat(grads)

    yield Race(
        "chamfer, forward and backward",
        f"{count} x {n} x {n}",
        Contender("diffpoint", ours, lambda g: g),
        [Contender("torch cdist and gather", torch_gather, lambda g: g)],
        units=count,
        tolerance=0.5,  # two candidates equally near to a rounding: another unit vector for that point
    )


def circle_of_cameras(count: int, size: int) -> dp.PinholeCamera:
    azimuth = torch.linspace(0, 2 * math.pi, count + 1)[:-1]
    eyes = 2 * torch.stack((azimuth.cos() * 0.95, torch.full_like(azimuth, 0.3), azimuth.sin() * 0.95), -1)
    return dp.PinholeCamera.look_at(eyes, focal_px=420 * size / 224, height=size, width=size)[:, None]


def _splat(count: int, n: int, size: int) -> Iterator[Race]:
    points, camera = surfaces(count, n, seed=0), circle_of_cameras(count, size)
    projection = camera.projection[:, 0]

    def torch_packed():
        """Depth and index in one 64-bit key; the smallest key wins a pixel."""
        q = torch.baddbmm(projection[:, None, :, 3], points, projection[..., :3].mT)
        depth = q[..., 2]
        column, row = (q[..., :2] / depth[..., None]).floor().long().unbind(-1)
        ok = (depth > 0) & (column >= 0) & (column < size) & (row >= 0) & (row < size)
        pixel = torch.where(ok, row * size + column, size * size)
        key = (depth.view(torch.int32).long() << 32) | torch.arange(n)
        best = torch.full((count, size * size + 1), 2**63 - 1, dtype=torch.int64)
        best = best.scatter_reduce_(1, pixel, key, "amin")[:, :-1]
        filled = best != 2**63 - 1
        rendered = torch.where(filled, (best >> 32).int().view(torch.float32), torch.inf)
        index = torch.where(filled, best & 0xFFFFFFFF, -1)
        visible = torch.zeros(count, n + 1, dtype=torch.bool)
        visible.scatter_(1, torch.where(filled, index, n), True)
        return rendered, index, visible[:, :-1]

    def inverse(depth: Tensor) -> Tensor:
        return 1 / depth.reshape(count, -1)

    peers = [Contender("torch scatter_reduce", torch_packed, lambda r: inverse(r[0]))]
    if numba := optional("numba"):
        peers.append(_numba_splat(numba, points, projection, size, inverse))
    yield Race(
        "splat_depth",
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", lambda: dp.splat_depth(points, camera), lambda r: inverse(r.depth)),
        peers,
        units=count,
        tolerance=1.0,  # a point on the border of two pixels may fall into either
    )


def _numba_splat(numba: ModuleType, points: Tensor, projection: Tensor, size: int, inverse) -> Contender:
    @numba.njit(parallel=True, fastmath=True)
    def kernel(p, cameras, depth, index, visible):
        for b in numba.prange(p.shape[0]):
            depth[b] = np.inf
            index[b] = -1
            visible[b] = 0
            c = cameras[b]
            for i in range(p.shape[1]):
                x, y, z = p[b, i, 0], p[b, i, 1], p[b, i, 2]
                d = c[2, 0] * x + c[2, 1] * y + c[2, 2] * z + c[2, 3]
                u = (c[0, 0] * x + c[0, 1] * y + c[0, 2] * z + c[0, 3]) / d
                v = (c[1, 0] * x + c[1, 1] * y + c[1, 2] * z + c[1, 3]) / d
                if d > 0 and u >= 0 and u < depth.shape[2] and v >= 0 and v < depth.shape[1]:
                    row, column = int(v), int(u)
                    if index[b, row, column] < 0 or d < depth[b, row, column]:
                        depth[b, row, column] = d
                        index[b, row, column] = i
            for row in range(depth.shape[1]):
                for column in range(depth.shape[2]):
                    if index[b, row, column] >= 0:
                        visible[b, index[b, row, column]] = 1

    count, n, _ = points.shape
    p, cameras = points.numpy(), projection.contiguous().numpy()

    def run():
        depth = np.empty((count, size, size), np.float32)
        index = np.empty((count, size, size), np.int64)
        visible = np.empty((count, n), np.uint8)
        kernel(p, cameras, depth, index, visible)
        return depth

    return Contender("numba", run, lambda depth: inverse(torch.from_numpy(depth)))


def _project(count: int, n: int) -> Iterator[Race]:
    points, camera = surfaces(count, n, seed=0), circle_of_cameras(count, 56)

    def ours():
        p = points.clone().requires_grad_()
        E = camera.cam_from_world.clone().requires_grad_()
        pixels, depth = dp.project(p, dp.PinholeCamera(camera.K, E, 56, 56))
        (pixels.sum() + depth.sum()).backward()
        return p.grad

    def torch_matmul():
        p = points.clone().requires_grad_()
        E = camera.cam_from_world.clone().requires_grad_()
        m = (camera.K @ E[..., :3, :])[:, 0]
        q = torch.baddbmm(m[:, None, :, 3], p, m[..., :3].mT)
        ((q[..., :2] / q[..., 2:]).sum() + q[..., 2].sum()).backward()
        return p.grad

    yield Race(
        "project, forward and backward to points and cameras",
        f"{count} x {n}",
        Contender("diffpoint", ours, lambda g: g),
        [Contender("torch", torch_matmul, lambda g: g)],
        units=count,
    )


def _transport(count: int, n: int) -> Iterator[Race]:
    a, b = pairs(count, n, n)
    one = slice(0, 1)  # exact solvers take a second a pair: they race on one of the pairs
    peers = []
    if optimize := optional("scipy.optimize"):
        matrix = torch.cdist(a[one].double(), b[one].double())[0].numpy()
        rows, columns = optimize.linear_sum_assignment(matrix)
        exact = matrix[rows, columns].mean()

        def assignment():
            cost = torch.cdist(a[one].double(), b[one].double())[0].numpy()
            r, c = optimize.linear_sum_assignment(cost)
            return torch.tensor([cost[r, c].mean()])

        peers.append(Contender("scipy exact", assignment, lambda r: r))
        excess = dp.earth_mover_distance(a[one], b[one]).cost.item() / exact - 1
    else:
        excess = float("nan")
    if ot := optional("ot"):
        weights = np.full(n, 1 / n)
        peers.append(
            Contender(
                "POT emd2",
                lambda: torch.tensor(
                    [ot.emd2(weights, weights, torch.cdist(a[one].double(), b[one].double())[0].numpy())]
                ),
                lambda r: r,
            )
        )
    if geomloss := optional("geomloss"):
        sinkhorn = geomloss.SamplesLoss("sinkhorn", p=1, blur=0.005, debias=False, backend="tensorized")
        peers.append(
            Contender("geomloss", lambda: sinkhorn(a[one], b[one]), lambda r: r.detach(), "approximate")
        )
    yield Race(
        f"earth_mover_distance ({excess:.2%} above exact)",
        f"1 x {n}",
        Contender("diffpoint", lambda: dp.earth_mover_distance(a[one], b[one]), lambda r: r.cost),
        peers,
        tolerance=0.02,
    )
    yield Race(
        "earth_mover_distance, batch",
        f"{count} x {n}",
        Contender("diffpoint", lambda: dp.earth_mover_distance(a, b), lambda r: r.cost),
        units=count,
    )


def _farthest(count: int, n: int, k: int) -> Iterator[Race]:
    points = surfaces(count, n, seed=0)
    numpy_points = points.numpy()
    peers = []
    if fpsample := optional("fpsample"):
        for height in (5, 7, 9):
            peers.append(
                Contender(
                    f"fpsample bucket h={height}",
                    lambda h=height: _each(
                        count,
                        lambda i: fpsample.bucket_fps_kdline_sampling(numpy_points[i], k, h=h, start_idx=0),
                    ),
                    remark="another order",
                )
            )
        peers.append(
            Contender(
                "fpsample plain",
                lambda: _each(count, lambda i: fpsample.fps_sampling(numpy_points[i], k, start_idx=0)),
                remark="another order",
            )
        )

    def torch_loop():
        distance = torch.full((count, n), torch.inf)
        current, chosen = torch.zeros(count, dtype=torch.long), []
        for _ in range(k):
            chosen.append(current)
            here = points[torch.arange(count), current][:, None]
            distance = torch.minimum(distance, (points - here).square().sum(-1))
            current = distance.argmax(1)
        return torch.stack(chosen, 1)

    peers.append(Contender("torch", torch_loop, lambda r: r))
    yield Race(
        "farthest_point_sample",
        f"{count} x {n} -> {k}",
        Contender("diffpoint", lambda: dp.farthest_point_sample(points, k), lambda r: r),
        peers,
        units=count,
        tolerance=1e-9,
    )
