"""Races of `earth_mover_distance`, `approxmatch`, `diversity_loss` and `farthest_point_sample`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Contender, Race
from benchmarks.inputs import gradient, leaf, pairs, surfaces
from benchmarks.peers import each, optional
from diffpoint import reference


def races() -> Iterator[Race]:
    yield _transport(8, 512)
    yield _transport(8, 2048)
    yield _transport_backward(8, 2048)
    yield _transport_batch(160, 2048)
    yield _soft(8, 2048)
    yield _soft_backward(8, 2048)
    yield _diversity(5, 4, 2048)
    yield _farthest(2, 16384, 2048)
    yield _farthest(80, 2048, 512)


def _cost_matrix(a: Tensor, b: Tensor) -> np.ndarray:
    return torch.cdist(a.double(), b.double()).numpy()


def exact_cost(a: Tensor, b: Tensor) -> float:
    """The least mean distance between two clouds (N, 3), by scipy; NaN without it."""
    optimize = optional("scipy.optimize")
    if optimize is None:
        return float("nan")
    matrix = _cost_matrix(a, b)
    return float(matrix[optimize.linear_sum_assignment(matrix)].mean())


def _transport(count: int, n: int) -> Race:
    """Exact solvers take up to a second a pair, on one core: they get the first pair."""
    a, b = pairs(count, n, n)
    weights = np.full(n, 1 / n)
    peers = []
    if optional("scipy.optimize"):
        peers.append(
            Contender(
                "scipy exact", lambda: torch.tensor([exact_cost(a[0], b[0])]), lambda r: r, "one core", 1
            )
        )
    if ot := optional("ot"):
        run = lambda: torch.tensor([float(ot.emd2(weights, weights, _cost_matrix(a[0], b[0])))])  # noqa: E731
        peers.append(Contender("POT emd2", run, lambda r: r, "exact, one core", 1))
    if geomloss := optional("geomloss"):
        sinkhorn = geomloss.SamplesLoss("sinkhorn", p=1, blur=0.005, debias=False, backend="tensorized")
        peers.append(Contender("geomloss", lambda: sinkhorn(a[:1], b[:1]), lambda r: r, "approximates", 1))
    return Race(
        "earth_mover_distance",
        f"{count} x {n}",
        Contender("diffpoint", lambda: dp.earth_mover_distance(a, b), lambda r: r.cost, _excess(count, a, b)),
        peers,
        units=count,
        tolerance=0.02,
    )


def _excess(count: int, a: Tensor, b: Tensor) -> str:
    """By how much our costs exceed the least ones, in words."""
    costs = dp.earth_mover_distance(a, b).cost
    least = torch.tensor([exact_cost(x, y) for x, y in zip(a, b, strict=True)])
    return f"{float((costs / least - 1).mean()):.3%} above exact"


def _descend(cost: Callable[[Tensor, Tensor], Tensor], a: Tensor, b: Tensor) -> Callable[[], Tensor]:
    """A run of a cost, forward and backward; its result is the gradient to `a`."""

    def run() -> Tensor:
        x, y = leaf(a), leaf(b)
        cost(x, y).sum().backward()
        return gradient(x)

    return run


def _transport_backward(count: int, n: int) -> Race:
    a, b = pairs(count, n, n)

    one = a[:1], b[:1]
    peers = []
    if ot := optional("ot"):
        weights = torch.full((n,), 1 / n, dtype=torch.float64)
        cost = lambda x, y: ot.emd2(weights, weights, torch.cdist(x[0].double(), y[0].double()))  # noqa: E731
        remark = "exact, one core; partners that cost the same differ"
        peers.append(Contender("POT emd2", _descend(cost, *one), lambda g: g, remark, 1))
    if geomloss := optional("geomloss"):
        sinkhorn = geomloss.SamplesLoss("sinkhorn", p=1, blur=0.005, debias=False, backend="tensorized")
        peers.append(Contender("geomloss", _descend(sinkhorn, *one), lambda g: g, "approximates", 1))
    return Race(
        "earth_mover_distance",
        f"{count} x {n}",
        Contender("diffpoint", _descend(lambda x, y: dp.earth_mover_distance(x, y).cost, a, b), lambda g: g),
        peers,
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
    )


def _transport_batch(count: int, n: int) -> Race:
    a, b = pairs(count, n, n)
    return Race(
        "earth_mover_distance",
        f"{count} x {n}",
        Contender("diffpoint", lambda: dp.earth_mover_distance(a, b), lambda r: r.cost),
        units=count,
    )


def _soft(count: int, n: int) -> Race:
    a, b = pairs(count, n, n)
    one = slice(0, 1)
    return Race(
        "approxmatch",
        f"{count} x {n}",
        Contender("diffpoint", lambda: dp.approxmatch(a, b), lambda r: r),
        [Contender("torch", lambda: reference.approxmatch(a[one], b[one]), lambda r: r, units=1)],
        units=count,
        tolerance=1e-3,
    )


def _soft_backward(count: int, n: int) -> Race:
    a, b = pairs(count, n, n)

    return Race(
        "approxmatch",
        f"{count} x {n}",
        Contender("diffpoint", _descend(dp.approxmatch, a, b), lambda g: g),
        [Contender("torch", _descend(reference.approxmatch, a[:1], b[:1]), lambda g: g, units=1)],
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
        share=0.01,
    )


def _diversity(codes: int, images: int, n: int) -> Race:
    clouds = surfaces(codes * images, n).view(codes, images, n, 3)
    noise = torch.randn(codes, images, 16, generator=torch.Generator().manual_seed(3))

    def ours() -> Tensor:
        x = leaf(clouds)
        dp.diversity_loss(noise, x, alpha=10.0).backward()
        return gradient(x)

    return Race(
        "diversity_loss",
        f"{codes} codes x {images} images x {n}",
        Contender("diffpoint", ours),
        direction="forward + backward",
        units=images,
    )


def _farthest(count: int, n: int, k: int) -> Race:
    points = surfaces(count, n)
    clouds = points.numpy()
    peers = []
    if n > 4096:
        slow = slice(0, 1)
        peers.append(Contender("torch", lambda: torch_peers.farthest(points[slow], k), lambda r: r, units=1))
    else:
        peers.append(Contender("torch", lambda: torch_peers.farthest(points, k), lambda r: r))
    if fpsample := optional("fpsample"):
        bucket, plain = fpsample.bucket_fps_kdline_sampling, fpsample.fps_sampling
        for height in (3, 5, 7):
            peers.append(
                Contender(
                    f"fpsample bucket h={height}",
                    lambda h=height: each(count, lambda i: bucket(clouds[i], k, h=h, start_idx=0)),
                    remark="starts at a point of its own",
                )
            )
        peers.append(
            Contender(
                "fpsample plain",
                lambda: each(count, lambda i: plain(clouds[i], k, start_idx=0)),
                lambda r: torch.from_numpy(np.stack(r).astype(np.int64)),
            )
        )
    if open3d := optional("open3d"):
        to_vectors = open3d.utility.Vector3dVector
        cloud = open3d.geometry.PointCloud(to_vectors(points[0].double().numpy()))
        peers.append(
            Contender(
                "open3d",
                lambda: cloud.farthest_point_down_sample(k),
                remark="gives points in the cloud's order",
                units=1,
            )
        )
    if ops := optional("pytorch3d.ops"):
        peers.append(Contender("pytorch3d", lambda: ops.sample_farthest_points(points, K=k)[1], lambda r: r))
    return Race(
        "farthest_point_sample",
        f"{count} x {n} -> {k}",
        Contender("diffpoint", lambda: dp.farthest_point_sample(points, k), lambda r: r),
        peers,
        units=count,
        tolerance=0.0,
        share=0.001,  # distances equal to a rounding
    )
