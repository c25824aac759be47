"""Races of `nearest`, `chamfer_distance` and `consistency_loss`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Contender, Race
from benchmarks.inputs import gradient, leaf, pairs, surfaces
from benchmarks.peers import each, keops, optional


def races() -> Iterator[Race]:
    yield _nearest(16, 2048, 2048)
    yield _chamfer_forward(80, 2048, 2048)
    yield _chamfer_backward(80, 2048, 2048)
    yield _chamfer_forward(8, 16384, 2048)
    yield _chamfer_backward(8, 16384, 2048)
    yield _chamfer_forward(2, 16384, 16384)
    yield _consistency(1, 8, 2048)


def _nearest(count: int, n: int, m: int) -> Race:
    a, b = pairs(count, n, m)

    def ours() -> Tensor:
        dp.nearest(b, a)
        return dp.nearest(a, b).squared_distance

    return Race(
        "nearest, both ways",
        f"{count} x {n} x {m}",
        Contender("diffpoint", ours, lambda d: d),
        [Contender("torch cdist", lambda: torch_peers.nearest_both(a, b)[0], lambda d: d)],
        units=count,
    )


def _chamfer_forward(count: int, n: int, m: int) -> Race:
    a, b = pairs(count, n, m)
    return Race(
        "chamfer_distance",
        f"{count} x {n} x {m}",
        Contender("diffpoint", lambda: dp.chamfer_distance(a, b, squared=False), lambda c: c.a_to_b),
        [Contender("torch cdist", lambda: torch_peers.chamfer(a, b), lambda c: c[0]), *_searches(a, b)],
        units=count,
        tolerance=1e-3,
    )


def _searches(a: Tensor, b: Tensor) -> Iterator[Contender]:
    """Libraries that search both ways and hand out distances and indices; the means are left to the user."""
    count, n = a.shape[:2]
    a_numpy, b_numpy = a.numpy(), b.numpy()

    def both(search: Callable[[np.ndarray, np.ndarray], Any]) -> Callable[[], list[Any]]:
        return lambda: each(count, lambda i: (search(a_numpy[i], b_numpy[i]), search(b_numpy[i], a_numpy[i])))

    def means(distance: Callable[[Any], np.ndarray]) -> Callable[[list[Any]], Tensor]:
        """From the results of every pair."""
        return lambda results: torch.tensor([float(np.mean(distance(forward))) for forward, _ in results])

    if tree := optional("scipy.spatial"):
        workers = os.cpu_count() or 1
        search = both(lambda x, y: tree.cKDTree(y).query(x, workers=workers))
        yield Contender("scipy cKDTree", search, means(lambda r: r[0]))
    if pcu := optional("point_cloud_utils"):
        search = both(lambda x, y: pcu.k_nearest_neighbors(x, y, 1))
        yield Contender("point-cloud-utils", search, means(lambda r: r[0]))
    if open3d := optional("open3d"):
        core = open3d.core

        def knn(x: np.ndarray, y: np.ndarray):
            index = core.nns.NearestNeighborSearch(core.Tensor.from_numpy(y))
            index.knn_index()
            return index.knn_search(core.Tensor.from_numpy(x), 1)

        yield Contender("open3d", both(knn), means(lambda r: np.sqrt(r[1].numpy())))
    if (module := keops()) and n <= 4096:  # it tries every pair

        def lazy() -> tuple[Any, Any]:
            x, y = module.LazyTensor(a[:, :, None]), module.LazyTensor(b[:, None])
            matrix = (x - y).square().sum(-1)
            return matrix.min_argmin(dim=2), matrix.min_argmin(dim=1)

        yield Contender("pykeops", lazy, lambda r: r[0][0][..., 0].sqrt().mean(1))
    if ops := optional("pytorch3d.ops"):
        yield Contender(
            "pytorch3d",
            lambda: (ops.knn_points(a, b), ops.knn_points(b, a)),
            lambda r: r[0].dists[..., 0].sqrt().mean(1),
        )


def _chamfer_backward(count: int, n: int, m: int) -> Race:
    a, b = pairs(count, n, m)

    def descend(chamfer: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Callable[[], Tensor]:
        def run() -> Tensor:
            x, y = leaf(a), leaf(b)
            forward, backward = chamfer(x, y)
            (forward.sum() + backward.sum()).backward()
            return torch.cat((gradient(x), gradient(y)), 1)

        return run

    peers = [Contender("torch cdist", descend(torch_peers.chamfer), lambda g: g)]
    if ops := optional("pytorch3d.ops"):
        knn = ops.knn_points
        peers.append(
            Contender(
                "pytorch3d",
                descend(
                    lambda x, y: tuple(
                        knn(p, q).dists[..., 0].clamp(min=1e-20).sqrt().mean(1) for p, q in ((x, y), (y, x))
                    )
                ),
                lambda g: g,
            )
        )
    return Race(
        "chamfer_distance",
        f"{count} x {n} x {m}",
        Contender("diffpoint", descend(lambda x, y: dp.chamfer_distance(x, y, squared=False)), lambda g: g),
        peers,
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
        share=0.01,  # two candidates equally near to a rounding: another unit vector for that point
    )


def _consistency(count: int, views: int, n: int) -> Race:
    clouds = surfaces(count * views, n).view(count, views, n, 3)
    first, second = torch.triu_indices(views, views, 1)

    def ours() -> Tensor:
        x = leaf(clouds)
        dp.consistency_loss(x).backward()
        return gradient(x)

    def in_torch() -> Tensor:
        x = leaf(clouds)
        a_to_b, b_to_a = torch_peers.chamfer(x[:, first].flatten(0, 1), x[:, second].flatten(0, 1))
        (a_to_b + b_to_a).mean().backward()
        return gradient(x)

    return Race(
        "consistency_loss",
        f"{count} x {views} views x {n}",
        Contender("diffpoint", ours, lambda g: g),
        [Contender("torch cdist", in_torch, lambda g: g)],
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
        share=0.01,
    )
