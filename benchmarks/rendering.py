"""Races of splatting, view sampling, visibility and projections."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import numba_peers, torch_peers
from benchmarks.harness import Contender, Race
from benchmarks.inputs import circle_of_cameras, depth_maps, gradient, leaf, leaf_camera, surfaces
from benchmarks.peers import each, optional
from diffpoint import reference
from diffpoint._horizon import FILTERS
from diffpoint.visibility import _DEFAULTS, METHODS, Method, _limit

Leaves = tuple[Any, ...]
"""Points or depths, then the cameras that see them, whose gradients a run leaves behind."""

_BORDER = 0.01
"""Share of the pixels about which two renderers may differ: a point on the border falls into either."""


def races() -> Iterator[Race]:
    for count, n, size, radius in (
        (80, 2048, 56, 0),
        (80, 2048, 56, 1),
        (80, 2048, 224, 0),
        (80, 2048, 224, 1),
        (1, 2048, 56, 0),
        (1, 10_000, 56, 0),
    ):
        yield _splat(count, n, size, radius)
    yield _splat_backward(80, 2048, 56)
    yield _splat_backward(80, 2048, 224)
    yield _sample(80, 2048, 56)
    yield _sample_backward(80, 2048, 56)
    for method in METHODS:
        yield _visible(80 if method != "hpr" else 8, 2048, 56, method)
    yield _project(80, 2048)
    yield _project_backward(80, 2048)
    yield _unproject(80, 56)
    yield _unproject_backward(80, 56)
    yield _reproject(80, 56)
    yield _reproject_backward(80, 56)


def _inverse(depth: Tensor) -> Tensor:
    """Empty pixels, at infinity, become 0."""
    return 1 / depth.flatten(1)


def _splat_name(radius: int) -> str:
    return "splat_depth" if radius == 0 else f"splat_depth, radius {radius}"


def _splat(count: int, n: int, size: int, radius: int) -> Race:
    points, camera = surfaces(count, n), circle_of_cameras(count, size)
    projection = camera.projection[:, 0]
    peers = [
        Contender(
            "torch scatter_reduce",
            lambda: torch_peers.splat(points, projection, size, radius=radius),
            lambda r: _inverse(r[0]),
        )
    ]
    if numba := optional("numba"):
        run = lambda: numba_peers.splat(numba, points, projection, size, radius)  # noqa: E731
        peers.append(Contender("numba", run, _inverse))
    if radius == 0:
        peers += [*_open3d_splat(points, camera), *_pytorch3d_splat(points, projection, size)]
    ours = lambda: dp.splat_depth(points, camera, radius=float(radius))  # noqa: E731
    return Race(
        _splat_name(radius),
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", ours, lambda r: _inverse(r.depth)),
        peers,
        units=count,
        share=_BORDER,
    )


def _open3d_splat(points: Tensor, camera: dp.PinholeCamera) -> Iterator[Contender]:
    open3d = optional("open3d")
    if open3d is None:
        return
    from_numpy = open3d.core.Tensor.from_numpy
    clouds = [open3d.t.geometry.PointCloud(from_numpy(cloud.numpy())) for cloud in points]
    K = [from_numpy(m.double().numpy()) for m in camera.K[:, 0].contiguous()]
    E = [from_numpy(m.double().numpy()) for m in camera.cam_from_world[:, 0].contiguous()]

    def run() -> list:
        size = camera.width, camera.height
        return each(
            len(clouds),
            lambda i: clouds[i].project_to_depth_image(*size, K[i], E[i], depth_scale=1.0, depth_max=10.0),
        )

    def value(images: list) -> Tensor:
        depth = torch.from_numpy(np.stack([image.as_tensor().numpy()[..., 0] for image in images]))
        return torch.where(depth > 0, _inverse(depth).view(depth.shape), 0.0).flatten(1)

    yield Contender("open3d", run, value, "depth only; rounds positions")


def _pytorch3d_splat(points: Tensor, projection: Tensor, size: int) -> Iterator[Contender]:
    renderer, structures = optional("pytorch3d.renderer.points"), optional("pytorch3d.structures")
    if renderer is None or structures is None:
        return

    def run() -> Tensor:
        u, v, depth = torch_peers.project(points, projection).unbind(-1)
        ndc = torch.stack((1 - 2 * u / depth / size, 1 - 2 * v / depth / size, depth), -1)
        cloud = structures.Pointclouds(list(ndc))
        return renderer.rasterize_points(cloud, size, radius=1 / size, points_per_pixel=1)[1][..., 0]

    def value(depth: Tensor) -> Tensor:
        return torch.where(depth > 0, 1 / depth, 0.0).flatten(1)

    yield Contender("pytorch3d", run, value, "discs of half a pixel")


def _splat_backward(count: int, n: int, size: int) -> Race:
    points, camera = surfaces(count, n), circle_of_cameras(count, size)
    weight = torch.rand(count, size, size, generator=torch.Generator().manual_seed(0))

    def descend(depth_of) -> Tensor:
        x, y = leaf(points), leaf_camera(camera)
        depth = depth_of(x, y)
        (weight * torch.where(torch.isfinite(depth), depth, 0.0)).sum().backward()
        return gradient(x)

    def in_torch(x: Tensor, y: dp.PinholeCamera) -> Tensor:
        return torch_peers.splat(x, y.projection[:, 0], size)[0]

    return Race(
        _splat_name(0),
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", lambda: descend(lambda x, y: dp.splat_depth(x, y).depth[:, 0]), lambda g: g),
        [Contender("torch scatter_reduce", lambda: descend(in_torch), lambda g: g)],
        direction="forward + backward",
        units=count,
        share=_BORDER,
    )


def _sample(count: int, n: int, size: int) -> Race:
    points = surfaces(count, n)
    splat = dp.splat_depth(points, circle_of_cameras(count, size))
    visible = splat.visible[:, 0].contiguous()
    return Race(
        "sample_view",
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", lambda: dp.sample_view(points, splat), lambda r: r.points[:, 0]),
        [Contender("torch argsort", lambda: torch_peers.sample(points, visible), lambda r: r[0])],
        units=count,
    )


def _sample_backward(count: int, n: int, size: int) -> Race:
    points = surfaces(count, n)
    splat = dp.splat_depth(points, circle_of_cameras(count, size))
    visible = splat.visible[:, 0].contiguous()

    def descend(sample) -> Tensor:
        x = leaf(points)
        sample(x).square().sum().backward()
        return gradient(x)

    return Race(
        "sample_view",
        f"{count} x {n}, {size} x {size}",
        Contender("diffpoint", lambda: descend(lambda x: dp.sample_view(x, splat).points), lambda g: g),
        [
            Contender(
                "torch argsort", lambda: descend(lambda x: torch_peers.sample(x, visible)[0]), lambda g: g
            )
        ],
        direction="forward + backward",
        units=count,
    )


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
            *one, filters=torch.tensor(FILTERS), radius=radius, limit=_limit(tolerance)
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


def _open3d_hidden(points: Tensor, camera: dp.PinholeCamera) -> Iterator[Contender]:
    open3d = optional("open3d")
    if open3d is None:
        return
    eyes = camera.position[:, 0].double().numpy()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(c.double().numpy())) for c in points]

    def run() -> list:
        sphere = 2 * 10**1.5
        return each(len(clouds), lambda i: clouds[i].hidden_point_removal(eyes[i], sphere)[1])

    yield Contender("open3d", run, remark="the same test, another sphere")


def _project(count: int, n: int) -> Race:
    points, camera = surfaces(count, n), circle_of_cameras(count, 56)

    def in_torch() -> tuple[Tensor, Tensor]:
        q = torch_peers.project(points, camera.projection[:, 0])
        return q[..., :2] / q[..., 2:], q[..., 2]

    return Race(
        "project",
        f"{count} x {n}",
        Contender("diffpoint", lambda: dp.project(points, camera), lambda r: r.pixels[:, 0]),
        [Contender("torch", in_torch, lambda r: r[0])],
        units=count,
    )


def _project_backward(count: int, n: int) -> Race:
    points, camera = surfaces(count, n), circle_of_cameras(count, 56)

    def ours() -> Leaves:
        x, y = leaf(points), leaf_camera(camera)
        pixels, depth = dp.project(x, y)
        (pixels.sum() + depth.sum()).backward()
        return x, y

    def in_torch() -> Leaves:
        x, y = leaf(points), leaf_camera(camera)
        q = torch_peers.project(x, y.projection[:, 0])
        ((q[..., :2] / q[..., 2:]).sum() + q[..., 2].sum()).backward()
        return x, y

    return Race(
        "project",
        f"{count} x {n}",
        Contender("diffpoint", ours, _gradients),
        [Contender("torch", in_torch, _gradients)],
        direction="forward + backward",
        units=count,
    )


def _gradients(descended: Leaves) -> Tensor:
    """Of points or depths, and of the cameras' matrices, in one (B, ...) tensor, each relative to its own size."""
    x, *cameras = descended
    leaves = [x, *(m for y in cameras for m in (y.K, y.cam_from_world))]
    flat = [gradient(one).flatten(1) for one in leaves if one.grad is not None]
    return torch.cat([g / g.abs().max() for g in flat], 1)


def _unproject(count: int, size: int) -> Race:
    depth, camera = depth_maps(count, size)
    one_each = depth[:, 0]
    return Race(
        "unproject",
        f"{count} x {size} x {size}",
        Contender("diffpoint", lambda: dp.unproject(depth, camera), lambda r: r.points[:, 0]),
        [Contender("torch argsort", lambda: torch_peers.unproject(one_each, camera), lambda r: r[0])],
        units=count,
    )


def _unproject_backward(count: int, size: int) -> Race:
    depth, camera = depth_maps(count, size)

    def ours() -> Leaves:
        x, y = leaf(depth), leaf_camera(camera)
        dp.unproject(x, y).points.square().sum().backward()
        return x, y

    def in_torch() -> Leaves:
        x, y = leaf(depth), leaf_camera(camera)
        torch_peers.unproject(x[:, 0], y)[0].square().sum().backward()
        return x, y

    return Race(
        "unproject",
        f"{count} x {size} x {size}",
        Contender("diffpoint", ours, _gradients),
        [Contender("torch argsort", in_torch, _gradients)],
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
    )


def _reproject(count: int, size: int) -> Race:
    depth, camera = depth_maps(count, size)
    target = circle_of_cameras(count, size)[torch.arange(count).roll(1)]
    one_each = depth[:, 0]
    return Race(
        "reproject",
        f"{count} x {size} x {size}",
        Contender(
            "diffpoint",
            lambda: dp.reproject(depth, camera, target),
            lambda r: _inverse(r.depth[:, 0]),
        ),
        [
            Contender(
                "torch",
                lambda: torch_peers.reproject(one_each, camera, target),
                lambda r: _inverse(r[2]),
            )
        ],
        units=count,
    )


def _reproject_backward(count: int, size: int) -> Race:
    depth, camera = depth_maps(count, size)
    target = circle_of_cameras(count, size)[torch.arange(count).roll(1)]

    def ours() -> Leaves:
        x, y, z = leaf(depth), leaf_camera(camera), leaf_camera(target)
        seen = dp.reproject(x, y, z)
        foreground = torch.isfinite(seen.depth)
        total = torch.where(foreground[..., None], seen.pixels, 0.0).sum()
        (total + torch.where(foreground, seen.depth, 0.0).sum() + seen.points.sum()).backward()
        return x, y, z

    def in_torch() -> Leaves:
        x, y, z = leaf(depth), leaf_camera(camera), leaf_camera(target)
        world, pixels, seen_depth = torch_peers.reproject(x[:, 0], y, z)
        foreground = torch.isfinite(seen_depth)
        total = torch.where(foreground[:, None], pixels, 0.0).sum()
        (total + torch.where(foreground, seen_depth, 0.0).sum() + world.sum()).backward()
        return x, y, z

    return Race(
        "reproject",
        f"{count} x {size} x {size}",
        Contender("diffpoint", ours, _gradients),
        [Contender("torch", in_torch, _gradients)],
        direction="forward + backward",
        units=count,
        tolerance=1e-3,
    )
