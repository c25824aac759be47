"""Races of `nearest`, `knn`, `chamfer_distance` and `consistency_loss`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Race, Way, both_directions
from benchmarks.inputs import pairs, surfaces
from benchmarks.peers import each, keops, optional


def races() -> Iterator[Race]:
    yield from _nearest(16, 2048, 2048)
    yield from _knn(80, 2048, 2048, 8)
    yield from _knn(2, 16384, 16384, 8)
    yield from _chamfer(80, 2048, 2048)
    yield from _chamfer(8, 16384, 2048)
    yield from _chamfer(2, 16384, 16384, directions=("forward",))
    yield from _consistency(1, 8, 2048)


def _nearest(count: int, n: int, m: int) -> Iterator[Race]:
    ours = Way(
        "diffpoint", lambda a, b: (dp.nearest(a, b), dp.nearest(b, a)), lambda r: r[0].squared_distance
    )
    peer = Way("torch cdist", torch_peers.nearest_both, lambda r: r[0])
    size = f"{count} x {n} x {m}"
    yield from both_directions(
        "nearest, both ways", size, pairs(count, n, m), ours, [peer], directions=("forward",), units=count
    )


def _knn(count: int, n: int, m: int, k: int) -> Iterator[Race]:
    a, b = pairs(count, n, m)  # compared are the mean distances to the first neighbour, the second and so on
    peers = [Way("torch cdist + topk", lambda x, y: torch_peers.knn(x, y, k), lambda r: r.mean(1))]
    for name, search, distance in _single_searches(k):
        found = _in_one_direction(search, a.numpy(), b.numpy())
        peers.append(
            Way(name, found, lambda r, d=distance: torch.stack([torch.from_numpy(d(x)).mean(0) for x in r]))
        )
    if ops := optional("pytorch3d.ops"):
        peers.append(
            Way("pytorch3d", lambda x, y: ops.knn_points(x, y, K=k), lambda r: r.dists.sqrt().mean(1))
        )
    if (module := keops()) and n <= 4096:  # it tries every pair

        def lazy(x: Tensor, y: Tensor) -> Any:
            matrix = (module.LazyTensor(x[:, :, None]) - module.LazyTensor(y[:, None])).square().sum(-1)
            return matrix.Kmin_argKmin(k, dim=2)

        peers.append(Way("pykeops", lazy, lambda r: r[0].sqrt().mean(1)))
    yield from both_directions(
        "knn",
        f"{count} x {n} x {m}, k = {k}",
        (a, b),
        Way("diffpoint", lambda x, y: dp.knn(x, y, k), lambda r: r.squared_distance.sqrt().mean(1)),
        peers,
        directions=("forward",),
        units=count,
        tolerance=1e-3,
    )


def _chamfer(count: int, n: int, m: int, **options: Any) -> Iterator[Race]:
    def way(name: str, function: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Way:
        return Way(name, function, lambda r: r[0], lambda r: r[0].sum() + r[1].sum())

    a, b = pairs(count, n, m)
    peers = [way("torch cdist", torch_peers.chamfer), *_searches(a, b)]
    if ops := optional("pytorch3d.ops"):

        def knn(x: Tensor, y: Tensor) -> Tensor:
            return ops.knn_points(x, y).dists[..., 0].clamp(min=1e-20).sqrt().mean(1)

        peers.append(way("pytorch3d", lambda x, y: (knn(x, y), knn(y, x))))
    yield from both_directions(
        "chamfer_distance",
        f"{count} x {n} x {m}",
        (a, b),
        way("diffpoint", lambda x, y: dp.chamfer_distance(x, y, squared=False)),
        peers,
        units=count,
        tolerance=1e-3,
        share=0.01,  # two candidates that are equally near up to rounding: another unit vector for that point
        **options,
    )


Search = Callable[[np.ndarray, np.ndarray], Any]


def _single_searches(k: int) -> Iterator[tuple[str, Search, Callable[[Any], np.ndarray]]]:
    """Libraries that search one cloud for k neighbours: name, search, and the distances (N, k) of its result."""
    if tree := optional("scipy.spatial"):
        workers = os.cpu_count() or 1

        def query(x: np.ndarray, y: np.ndarray):
            return tree.cKDTree(y).query(x, k=k, workers=workers)

        yield "scipy cKDTree", query, lambda r: r[0].reshape(-1, k)
    if pcu := optional("point_cloud_utils"):
        yield (
            "point-cloud-utils",
            lambda x, y: pcu.k_nearest_neighbors(x, y, k),
            lambda r: r[0].reshape(-1, k),
        )
    if open3d := optional("open3d"):
        core = open3d.core

        def knn(x: np.ndarray, y: np.ndarray):
            index = core.nns.NearestNeighborSearch(core.Tensor.from_numpy(y))
            index.knn_index()
            return index.knn_search(core.Tensor.from_numpy(x), k)

        yield "open3d", knn, lambda r: np.sqrt(r[1].numpy()).reshape(-1, k)


def _in_one_direction(search: Search, a: np.ndarray, b: np.ndarray) -> Callable[..., list[Any]]:
    return lambda *_: each(len(a), lambda i: search(a[i], b[i]))


def _searches(a: Tensor, b: Tensor) -> Iterator[Way]:
    """Libraries that search in both directions and return distances and indices, of which the user takes means."""
    n = a.shape[1]
    for name, search, distance in _single_searches(1):
        there, back = (_in_one_direction(search, x.numpy(), y.numpy()) for x, y in ((a, b), (b, a)))
        yield Way(
            name,
            lambda *_, there=there, back=back: (there(), back()),
            lambda r, d=distance: torch.tensor([float(np.mean(d(x))) for x in r[0]]),
        )
    if (module := keops()) and n <= 4096:  # it tries every pair

        def lazy(x: Tensor, y: Tensor) -> tuple[Any, Any]:
            matrix = (module.LazyTensor(x[:, :, None]) - module.LazyTensor(y[:, None])).square().sum(-1)
            return matrix.min_argmin(dim=2), matrix.min_argmin(dim=1)

        yield Way("pykeops", lazy, lambda r: r[0][0][..., 0].sqrt().mean(1))


def _consistency(count: int, views: int, n: int) -> Iterator[Race]:
    first, second = torch.triu_indices(views, views, 1)

    def in_torch(x: Tensor) -> Tensor:
        a_to_b, b_to_a = torch_peers.chamfer(x[:, first].flatten(0, 1), x[:, second].flatten(0, 1))
        return (a_to_b + b_to_a).mean()

    ways = [
        Way(name, function, lambda r: r, lambda r: r)
        for name, function in (("diffpoint", dp.consistency_loss), ("torch cdist", in_torch))
    ]
    yield from both_directions(
        "consistency_loss",
        f"{count} x {views} views x {n}",
        (surfaces(count * views, n).view(count, views, n, 3),),
        ways[0],
        ways[1:],
        directions=("forward + backward",),
        units=count,
        tolerance=1e-3,
        share=0.01,
    )
