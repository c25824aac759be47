"""`python tests/same_bits.py THREADS`: a digest of what every op gives, forward and backward, on so many threads.

`test_runtime.py` compares the digests of processes with one thread and with two.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

import diffpoint as dp
from diffpoint.visibility import METHODS

CAMERAS = dp.PinholeCamera.look_at(
    torch.tensor([[0.0, 0, -2], [2, 0.3, 0]]), focal_px=60.0, height=29, width=31
)
OTHERS = dp.PinholeCamera.look_at(
    torch.tensor([[0.3, 0.2, -2], [2, -0.3, 0.4]]), focal_px=55.0, height=29, width=31
)


LARGE = CAMERAS.resize(250, 201)  # lone maps and clouds of such a size are divided among the threads


def clouds(count: int, points: int, seed: int) -> Tensor:
    """(count, points, 3), some of the points twice: ties must not depend on threads either."""
    random = torch.Generator().manual_seed(seed)
    cloud = torch.rand(count, points, 3, generator=random) - 0.5
    cloud[:, points // 2 : points // 2 + points // 8] = cloud[:, : points // 8]
    return cloud


def leaf_cameras(cameras: dp.PinholeCamera) -> dp.PinholeCamera:
    K, extrinsics = (m.clone().requires_grad_() for m in (cameras.K, cameras.cam_from_world))
    return dp.PinholeCamera(K, extrinsics, cameras.height, cameras.width)


def splatted(count: int, size: int, seen_by: dp.PinholeCamera) -> list[Tensor]:
    out = []
    for radius in (0.0, 1.0, 1.7):
        points, cameras = clouds(count, size, 3).requires_grad_(), leaf_cameras(seen_by)
        depth, index, visible = dp.splat_depth(points, cameras, radius=radius)
        out += [index, visible, *with_gradients((points, cameras.K, cameras.cam_from_world), depth)]
    return out


def maps(seen_by: dp.PinholeCamera = CAMERAS, count: int = 3) -> tuple[Tensor, dp.PinholeCamera]:
    depth = dp.splat_depth(clouds(count, 500, 9), seen_by, radius=1.0).depth
    return depth.requires_grad_(), leaf_cameras(seen_by)


def with_gradients(leaves: Iterable[Tensor], *outputs: Tensor) -> list[Tensor]:
    leaves = list(leaves)
    total = torch.stack([torch.where(torch.isfinite(o), o, 0.0).square().sum() for o in outputs]).sum()
    return [*outputs, *torch.autograd.grad(total, leaves)]


def unprojected(*scene: Any) -> list[Tensor]:
    depth, cameras = maps(*scene)
    points, lengths = dp.unproject(depth, cameras)
    return [lengths, *with_gradients((depth, cameras.K, cameras.cam_from_world), points)]


def reprojected(targets: dp.PinholeCamera, *scene: Any) -> list[Tensor]:
    depth, cameras = maps(*scene)
    targets = leaf_cameras(targets)
    seen = dp.reproject(depth, cameras, targets)
    leaves = depth, cameras.K, cameras.cam_from_world, targets.K, targets.cam_from_world
    return [seen.valid, *with_gradients(leaves, seen.points, seen.pixels, seen.depth)]


def projected(count: int, size: int) -> list[Tensor]:
    points, cameras = clouds(count, size, 1).requires_grad_(), leaf_cameras(CAMERAS)
    return with_gradients((points, cameras.K, cameras.cam_from_world), *dp.project(points, cameras))


def both(function: Callable[[Tensor, Tensor], Iterable[Tensor]], count: int, n: int, m: int) -> list[Tensor]:
    a, b = clouds(count, n, 1).requires_grad_(), clouds(count, m, 2).requires_grad_()
    return with_gradients((a, b), *function(a, b))


def alone(function: Callable[[Tensor], Iterable[Tensor]], count: int, n: int) -> list[Tensor]:
    a = clouds(count, n, 3).requires_grad_()
    return with_gradients((a,), *function(a))


def loss(function: Callable[[Tensor, Tensor], Tensor]) -> list[Tensor]:
    points, depth = clouds(3, 600, 4).requires_grad_(), maps()[0]
    return with_gradients((points, depth), function(points, depth))


def diversity() -> list[Tensor]:
    codes = torch.randn(3, 4, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    shapes = clouds(12, 150, 5).view(3, 4, 150, 3).requires_grad_()
    return with_gradients((codes, shapes), dp.diversity_loss(codes, shapes, alpha=1.0, reduction="none"))


# Small batches, batches, and single clouds beyond the sizes from which boxes are passed over.
OPS: dict[str, Callable[[], list[Tensor]]] = {
    "nearest": lambda: [
        t
        for sizes in ((5, 300, 400), (2, 3000, 3100), (1, 40_000, 41_000))
        for t in both(lambda a, b: dp.nearest(a, b)[:1], *sizes)
    ],
    "knn": lambda: [
        t
        for sizes in ((5, 300, 400), (2, 3000, 3100), (1, 40_000, 41_000))
        for t in both(lambda a, b: dp.knn(a, b, 8)[:1], *sizes)
    ],
    "f_score": lambda: [*dp.f_score(clouds(5, 300, 8), clouds(5, 400, 9), 0.05)],
    "chamfer_distance": lambda: [
        t
        for sizes in ((1, 900, 700), (5, 300, 400), (2, 3000, 3100), (1, 40_000, 41_000))
        for t in both(lambda a, b: dp.chamfer_distance(a, b, squared=False), *sizes)
    ],
    "hausdorff_distance": lambda: both(lambda a, b: (dp.hausdorff_distance(a, b),), 5, 300, 400),
    "minimal_matching_distance": lambda: both(
        lambda a, b: (dp.minimal_matching_distance(a, b, squared=True),), 5, 300, 400
    ),
    "total_mutual_difference": lambda: alone(
        lambda x: (dp.total_mutual_difference(x, squared=True),), 5, 300
    ),
    "unidirectional_hausdorff_distance": lambda: alone(
        lambda x: (dp.unidirectional_hausdorff_distance(x[0], x[1:]),), 5, 300
    ),
    # The threads share out the last pair.
    "earth_mover_distance": lambda: [
        t
        for squared, sizes in ((False, (1, 600, 600)), (True, (5, 300, 400)), (False, (1, 1100, 1000)))
        for t in both(lambda a, b, s=squared: (dp.earth_mover_distance(a, b, squared=s).cost,), *sizes)
    ],
    "approxmatch": lambda: both(lambda a, b: (dp.approxmatch(a, b),), 5, 300, 400),
    "farthest_point_sample": lambda: [
        dp.farthest_point_sample(clouds(*size, 6), 60)
        for size in ((5, 300), (1, 3000), (2, 9000), (1, 40_000))
    ],
    # The points of the last, a lone view, are shared out among the threads.
    "splat_depth": lambda: [*splatted(5, 300, CAMERAS), *splatted(1, 40_000, CAMERAS[:1])],
    "sample_view": lambda: [
        t
        for size in ((5, 300), (1, 40_000))
        for t in alone(lambda x: (dp.sample_view(x, dp.splat_depth(x, CAMERAS)).points,), *size)
    ],
    "visible_points": lambda: [
        dp.visible_points(clouds(*size, 7), CAMERAS, method=method)
        for method in METHODS
        for size in ((5, 300), (1, 5000))
    ],
    "project": lambda: [*projected(3, 700), *projected(1, 50_000)],
    "unproject": lambda: [*unprojected(), *unprojected(LARGE[:1], 1)],
    "reproject": lambda: [*reprojected(OTHERS), *reprojected(LARGE[1:], LARGE[:1], 1)],
    "front_constraint": lambda: loss(lambda x, depth: dp.front_constraint(x, CAMERAS, depth)),
    "front_terms": lambda: loss(
        lambda x, depth: dp.front_terms(x, CAMERAS, depth, distance="emd", visibility="horizon").loss
    ),
    "front_sets": lambda: [*dp.front_sets(clouds(3, 600, 4), CAMERAS, maps()[0].detach())],
    "projection_loss": lambda: loss(
        lambda x, depth: dp.projection_loss(x, CAMERAS, depth, logits=x[..., 0], mask_weight=0.1, upsample=2)
    ),
    "soft_splat": lambda: [
        t for size in ((5, 300), (1, 40_000)) for t in alone(lambda x: dp.soft_splat(x, CAMERAS), *size)
    ],
    "soft_projection_loss": lambda: loss(lambda x, depth: dp.soft_projection_loss(x, CAMERAS, depth)),
    "diversity_loss": diversity,
    "consistency_loss": lambda: alone(lambda x: (dp.consistency_loss(x[None]),), 5, 300),
}


def digest(tensors: Iterable[Tensor]) -> str:
    return hashlib.sha256(b"".join(t.detach().contiguous().numpy().tobytes() for t in tensors)).hexdigest()


def main(threads: int) -> None:
    dp.configure(threads=threads)
    digests = {name: digest(op()) for name, op in OPS.items()}
    assert digests == {name: digest(op()) for name, op in OPS.items()}, "a second run gives other bits"
    print(json.dumps(digests))


if __name__ == "__main__":
    main(int(sys.argv[1]))
