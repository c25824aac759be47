"""Races of `earth_mover_distance`, `approxmatch`, `diversity_loss` and `farthest_point_sample`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Contender, Race, Way, both_directions
from benchmarks.inputs import pairs, surfaces
from benchmarks.peers import each, optional
from diffpoint import reference


def races() -> Iterator[Race]:
    yield from _transport(8, 512, directions=("forward",))
    yield from _transport(8, 2048)
    yield from _transport(160, 2048, directions=("forward",), alone=True)
    yield from _transport(1, 8192, directions=("forward",), alone=True)  # threads share out the pair
    yield from _soft(8, 2048)
    yield from _diversity(5, 4, 2048)
    yield _farthest(2, 16384, 2048)
    yield _farthest(80, 2048, 512)


def exact_cost(a: Tensor, b: Tensor) -> float:
    """The optimal mean distance between two clouds (N, 3), by scipy in float64; NaN without scipy."""
    optimize = optional("scipy.optimize")
    if optimize is None:
        return float("nan")
    matrix = torch.cdist(a.double(), b.double()).numpy()
    return float(matrix[optimize.linear_sum_assignment(matrix)].mean())


def _transport(count: int, n: int, *, directions: tuple = (), alone: bool = False) -> Iterator[Race]:
    """Exact solvers take up to a second a pair, on one core: they get the first pair."""
    a, b = pairs(count, n, n)
    peers = []
    if not alone:
        if optional("scipy.optimize"):
            exact = lambda x, y: torch.tensor([exact_cost(x[0], y[0])])  # noqa: E731
            peers.append(Way("scipy exact", exact, lambda r: r, remark="one core", units=1))
        if ot := optional("ot"):
            weights = torch.full((n,), 1 / n, dtype=torch.float64)
            cost = lambda x, y: ot.emd2(weights, weights, torch.cdist(x[0].double(), y[0].double()))  # noqa: E731
            remark = "exact, one core; assignments of equal cost differ"
            peers.append(Way("POT emd2", cost, lambda r: r.view(1), lambda r: r, remark, 1))
        if geomloss := optional("geomloss"):
            sinkhorn = geomloss.SamplesLoss("sinkhorn", p=1, blur=0.005, debias=False, backend="tensorized")
            peers.append(Way("geomloss", sinkhorn, lambda r: r, torch.sum, "approximates", 1))
    yield from both_directions(
        "earth_mover_distance",
        f"{count} x {n}",
        (a, b),
        Way(
            "diffpoint",
            dp.earth_mover_distance,
            lambda r: r.cost,
            lambda r: r.cost.sum(),
            "" if alone else _excess(a, b),
        ),
        peers,
        units=count,
        tolerance=0.02,
        **({"directions": directions} if directions else {}),
    )


def _excess(a: Tensor, b: Tensor) -> str:
    """How far our costs are above the optimum, as a remark."""
    costs = dp.earth_mover_distance(a, b).cost
    optimal = torch.tensor([exact_cost(x, y) for x, y in zip(a, b, strict=True)])
    return f"{float((costs / optimal - 1).mean()):.3%} above exact"


def _soft(count: int, n: int) -> Iterator[Race]:
    ours = Way("diffpoint", dp.approxmatch, lambda r: r, torch.sum)
    peer = Way("torch", reference.approxmatch, lambda r: r, torch.sum, units=1)
    yield from both_directions(
        "approxmatch", f"{count} x {n}", pairs(count, n, n), ours, [peer],
        units=count, tolerance=1e-3, share=0.01,
    )  # fmt: skip


def _diversity(codes: int, images: int, n: int) -> Iterator[Race]:
    clouds = surfaces(codes * images, n).view(codes, images, n, 3)
    noise = torch.randn(codes, images, 16, generator=torch.Generator().manual_seed(3))
    ours = Way("diffpoint", lambda x: dp.diversity_loss(noise, x, alpha=10.0), lambda r: r, lambda r: r)
    size = f"{codes} codes x {images} images x {n}"
    yield from both_directions(
        "diversity_loss", size, (clouds,), ours, [], directions=("forward + backward",), units=images
    )


def _farthest(count: int, n: int, k: int) -> Race:
    points = surfaces(count, n)
    clouds = points.numpy()
    units = 1 if n > 4096 else count
    slow = points[:units]
    peers = [Contender("torch", lambda: torch_peers.farthest(slow, k), lambda r: r, units=units)]
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
        vectors = open3d.utility.Vector3dVector(points[0].double().numpy())
        cloud = open3d.geometry.PointCloud(vectors)
        remark = "gives points in the cloud's order"
        peers.append(Contender("open3d", lambda: cloud.farthest_point_down_sample(k), remark=remark, units=1))
    if ops := optional("pytorch3d.ops"):
        peers.append(Contender("pytorch3d", lambda: ops.sample_farthest_points(points, K=k)[1], lambda r: r))
    return Race(
        "farthest_point_sample",
        f"{count} x {n} -> {k}",
        Contender("diffpoint", lambda: dp.farthest_point_sample(points, k), lambda r: r),
        peers,
        units=count,
        tolerance=0.0,
        share=0.001,  # distances that are equal up to rounding
    )
