"""Races of splatting, view sampling, visibility and projections."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import numba_peers, torch_peers
from benchmarks.harness import Contender, Race, Way, both_directions
from benchmarks.inputs import circle_of_cameras, depth_maps, surfaces
from benchmarks.peers import each, optional
from diffpoint import PinholeCamera, reference
from diffpoint._horizon import FILTERS, limit_of
from diffpoint.visibility import _DEFAULTS, METHODS, Method

_BORDER = 0.01
"""Share of the pixels that may differ between renderers: rounding moves points on a border into either pixel."""


def races() -> Iterator[Race]:
    for count, n, size, radius in (
        (80, 2048, 56, 0),
        (80, 2048, 56, 1),
        (80, 2048, 224, 0),
        (80, 2048, 224, 1),
        (1, 2048, 56, 0),
        (1, 10_000, 56, 0),
    ):
        yield from _splat(count, n, size, radius)
    yield from _sample(80, 2048, 56)
    for method in METHODS:
        yield _visible(80 if method != "hpr" else 8, 2048, 56, method)
    yield from _project(80, 2048)
    yield from _unproject(80, 56)
    yield from _reproject(80, 56)


def _inverse(depth: Tensor) -> Tensor:
    """1 / depth, which is 0 at empty pixels."""
    return 1 / depth.flatten(1)


def _finite_sum(*values: Tensor) -> Tensor:
    return torch.stack([torch.where(torch.isfinite(v), v, 0.0).sum() for v in values]).sum()


def _splat(count: int, n: int, size: int, radius: int) -> Iterator[Race]:
    points, camera = surfaces(count, n), circle_of_cameras(count, size)
    weight = torch.rand(count, size, size, generator=torch.Generator().manual_seed(0))

    def loss(depth: Tensor) -> Tensor:
        return _finite_sum(weight * depth.view(count, size, size))

    def in_torch(x: Tensor, y: PinholeCamera) -> Tensor:
        return torch_peers.splat(x, y.projection[:, 0], size, radius=radius)[0]

    peers = [Way("torch scatter_reduce", in_torch, _inverse, loss)]
    if numba := optional("numba"):
        projection = camera.projection[:, 0]
        run = lambda x, y: numba_peers.splat(numba, x, projection, size, radius)  # noqa: E731
        peers.append(Way("numba", run, _inverse))
    if radius == 0:
        peers += [*_open3d_splat(points, camera), *_pytorch3d_splat(size)]
    yield from both_directions(
        "splat_depth" if radius == 0 else f"splat_depth, radius {radius}",
        f"{count} x {n}, {size} x {size}",
        (points, camera),
        Way("diffpoint", lambda x, y: dp.splat_depth(x, y, radius=float(radius)).depth, _inverse, loss),
        peers,
        directions=("forward", "forward + backward") if count > 1 and radius == 0 else ("forward",),
        units=count,
        share=_BORDER,
    )


def _open3d_splat(points: Tensor, camera: PinholeCamera) -> Iterator[Way]:
    open3d = optional("open3d")
    if open3d is None:
        return
    from_numpy = open3d.core.Tensor.from_numpy
    clouds = [open3d.t.geometry.PointCloud(from_numpy(cloud.numpy())) for cloud in points]
    K = [from_numpy(m.double().numpy()) for m in camera.K[:, 0].contiguous()]
    E = [from_numpy(m.double().numpy()) for m in camera.cam_from_world[:, 0].contiguous()]

    def run(*_) -> list:
        size = camera.width, camera.height
        return each(
            len(clouds),
            lambda i: clouds[i].project_to_depth_image(*size, K[i], E[i], depth_scale=1.0, depth_max=10.0),
        )

    def value(images: list) -> Tensor:
        depth = torch.from_numpy(np.stack([image.as_tensor().numpy()[..., 0] for image in images]))
        return torch.where(depth > 0, _inverse(depth).view(depth.shape), 0.0).flatten(1)

    yield Way("open3d", run, value, remark="depth only; rounds positions")


def _pytorch3d_splat(size: int) -> Iterator[Way]:
    renderer, structures = optional("pytorch3d.renderer.points"), optional("pytorch3d.structures")
    if renderer is None or structures is None:
        return

    def run(points: Tensor, camera: PinholeCamera) -> Tensor:
        u, v, depth = torch_peers.project(points, camera.projection[:, 0]).unbind(-1)
        ndc = torch.stack((1 - 2 * u / depth / size, 1 - 2 * v / depth / size, depth), -1)
        cloud = structures.Pointclouds(list(ndc))
        return renderer.rasterize_points(cloud, size, radius=1 / size, points_per_pixel=1)[1][..., 0]

    def value(depth: Tensor) -> Tensor:
        return torch.where(depth > 0, 1 / depth, 0.0).flatten(1)

    yield Way("pytorch3d", run, value, remark="discs of half a pixel")


def _sample(count: int, n: int, size: int) -> Iterator[Race]:
    points = surfaces(count, n)
    splat = dp.splat_depth(points, circle_of_cameras(count, size))
    visible = splat.visible[:, 0].contiguous()
    ways = [
        Way(name, function, lambda r: r, lambda r: r.square().sum())
        for name, function in (
            ("diffpoint", lambda x: dp.sample_view(x, splat).points[:, 0]),
            ("torch argsort", lambda x: torch_peers.sample(x, visible)[0]),
        )
    ]
    size_text = f"{count} x {n}, {size} x {size}"
    yield from both_directions("sample_view", size_text, (points,), ways[0], ways[1:], units=count)


def _visible(count: int, n: int, size: int, method: Method) -> Race:
    points, camera = surfaces(count, n), circle_of_cameras(count, size)
    peers = []
    if method == "zbuffer":
        projection = camera.projection[:, 0]
        peers.append(
            Contender(
                "torch scatter_reduce",
                lambda: torch_peers.splat(points, projection, size)[2],
                lambda visible: visible.float()[:, None],
            )
        )
    elif method == "hpr":
        peers += _open3d_hidden(points, camera)
    else:
        radius, tolerance = _DEFAULTS[method]
        one = points[:1], camera.K[:1], camera.cam_from_world[:1], (size, size)
        in_torch = lambda: reference.visible_points(  # noqa: E731
            *one, filters=torch.tensor(FILTERS), radius=radius, limit=limit_of(tolerance)
        )
        peers.append(Contender("torch", in_torch, lambda visible: visible.float(), units=1))
    ours = lambda: dp.visible_points(points, camera, method=method)  # noqa: E731
    return Race(
        f"visible_points, {method}",
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", ours, lambda visible: visible.float()),
        peers,
        units=count,
        share=_BORDER,
    )


def _open3d_hidden(points: Tensor, camera: PinholeCamera) -> Iterator[Contender]:
    open3d = optional("open3d")
    if open3d is None:
        return
    eyes = camera.position[:, 0].double().numpy()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(c.double().numpy())) for c in points]

    def run() -> list:
        sphere = 2 * 10**1.5
        return each(len(clouds), lambda i: clouds[i].hidden_point_removal(eyes[i], sphere)[1])

    yield Contender("open3d", run, remark="the same test, another sphere")


def _project(count: int, n: int) -> Iterator[Race]:
    def in_torch(x: Tensor, y: PinholeCamera) -> tuple[Tensor, Tensor]:
        q = torch_peers.project(x, y.projection[:, 0])
        return q[..., :2] / q[..., 2:], q[..., 2]

    def loss(r: tuple[Tensor, Tensor]) -> Tensor:
        return r[0].sum() + r[1].sum()

    yield from both_directions(
        "project",
        f"{count} x {n}",
        (surfaces(count, n), circle_of_cameras(count, 56)),
        Way("diffpoint", dp.project, lambda r: r.pixels[:, 0], loss),
        [Way("torch", in_torch, lambda r: r[0], loss)],
        units=count,
    )


def _unproject(count: int, size: int) -> Iterator[Race]:
    def loss(r: tuple[Tensor, Tensor]) -> Tensor:
        return r[0].square().sum()

    yield from both_directions(
        "unproject",
        f"{count} x {size} x {size}",
        depth_maps(count, size),
        Way("diffpoint", dp.unproject, lambda r: r.points[:, 0], loss),
        [Way("torch argsort", lambda x, y: torch_peers.unproject(x[:, 0], y), lambda r: r[0], loss)],
        units=count,
        tolerance=1e-3,
    )


def _reproject(count: int, size: int) -> Iterator[Race]:
    depth, camera = depth_maps(count, size)
    target = circle_of_cameras(count, size)[torch.arange(count).roll(1)]
    yield from both_directions(
        "reproject",
        f"{count} x {size} x {size}",
        (depth, camera, target),
        Way(
            "diffpoint",
            lambda x, y, z: dp.reproject(x, y, z)[:3],
            lambda r: _inverse(r[2][:, 0]),
            lambda r: _finite_sum(*r),
        ),
        [
            Way(
                "torch",
                lambda x, y, z: torch_peers.reproject(x[:, 0], y, z),
                lambda r: _inverse(r[2]),
                lambda r: _finite_sum(*r),
            )
        ],
        units=count,
        tolerance=1e-3,
    )
