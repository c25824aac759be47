"""Values and gradients of every differentiable op: against the reference implementations and finite differences.

The inputs have no ties, so that both must agree on every choice. What the ops do with any other input is tested with
`test_properties.py`, and their limits and special cases in the files of the ops.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

import diffpoint as dp
from diffpoint import reference, reference_projection
from diffpoint.testing import assert_close, check_gradients, tie_free_clouds

HEIGHT, WIDTH = 9, 11
LENGTHS = torch.tensor([16, 7])
Leaves = tuple[Tensor, ...]


class Case(NamedTuple):
    """An op and its reference implementation as functions of the same tensors.

    Attributes:
        leaves: makes the tensors, all of which get gradients.
        scale: multiple of `diffpoint.testing.TOLERANCE` that the results may differ by.
        finite_differences: whether the gradient is that of the values (not if a part of the op is held fixed).
    """

    leaves: Callable[[torch.dtype], Leaves]
    ours: Callable[..., Any]
    theirs: Callable[..., Any]
    scale: float = 5.0
    finite_differences: bool = True


def cameras(dtype: torch.dtype) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    eyes = eyes + 0.1 * torch.arange(2, dtype=dtype)[:, None, None]
    return dp.PinholeCamera.look_at(eyes, focal_px=14.0, height=HEIGHT, width=WIDTH)


def clouds(dtype: torch.dtype, count: int = 16, seed: int = 1) -> Tensor:
    return tie_free_clouds(2, count, cameras(torch.float64), seed=seed, dtype=dtype, margin=3e-4)


def depth_maps(dtype: torch.dtype) -> Tensor:
    """Maps with holes; one of them is empty."""
    depth = dp.splat_depth(0.9 * clouds(dtype, 40, seed=2), cameras(dtype)).depth
    depth[1, 1] = torch.inf
    return depth


def rows(dtype: torch.dtype) -> Leaves:
    """The rows of the camera matrices that may change."""
    camera = cameras(dtype)
    return camera.K[..., :2, :], camera.cam_from_world[..., :3, :]


def of_rows(K_rows: Tensor, extrinsic_rows: Tensor) -> dp.PinholeCamera:
    last = cameras(K_rows.dtype)
    K = torch.cat((K_rows, last.K[..., 2:, :]), -2)
    return dp.PinholeCamera(
        K, torch.cat((extrinsic_rows, last.cam_from_world[..., 3:, :]), -2), HEIGHT, WIDTH
    )


def matrices(*camera_rows: Tensor) -> tuple[Tensor, Tensor]:
    camera = of_rows(*camera_rows)
    return camera.K, camera.cam_from_world


def sets(dtype: torch.dtype) -> Leaves:
    return clouds(dtype, 16), clouds(dtype, 21, seed=3)


def two_sets(name: str, *, part: int | slice = slice(None), ours: dict | None = None, **options: Any) -> Case:
    lengths = {"a_lengths": LENGTHS, "b_lengths": torch.tensor([13, 21])}
    return Case(
        sets,
        lambda a, b: getattr(dp, name)(a, b, **lengths, **options, **(ours or {})),
        lambda a, b: getattr(reference, name)(a, b, **lengths, **options),
        finite_differences=name != "approxmatch",
    )


def splat(radius: float) -> Case:
    options = {"radius": radius, "lengths": LENGTHS}
    return Case(
        lambda dtype: (clouds(dtype), *rows(dtype)),
        lambda points, *camera: dp.splat_depth(points, of_rows(*camera), **options),
        lambda points, *camera: reference.splat_depth(points, *matrices(*camera), HEIGHT, WIDTH, **options),
    )


def soft_splat(radius: float, softness: float) -> Case:
    options = {"radius": radius, "softness": softness, "lengths": LENGTHS}

    def weighted(maps: tuple[Tensor, ...]) -> Leaves:
        """Where the coverage goes to 0, the gradient of the depth has no bound, but that of the product has."""
        depth, coverage = maps[:2]
        return torch.where(torch.isfinite(depth), depth, 0.0) * coverage, coverage

    return Case(
        lambda dtype: (clouds(dtype), *rows(dtype)),
        lambda points, *camera: weighted(dp.soft_splat(points, of_rows(*camera), **options)),
        lambda points, *camera: weighted(
            reference_projection.soft_splat(points, *matrices(*camera), (HEIGHT, WIDTH), **options)
        ),
        scale=20 / softness,
    )


def sampled(op: Callable, points: Tensor) -> Leaves:
    return op(points, dp.splat_depth(points.detach(), cameras(points.dtype), lengths=LENGTHS).visible)


def reprojected(depth: Tensor, *camera_rows: Tensor) -> Leaves:
    seen = dp.reproject(depth, of_rows(*camera_rows[:2]), of_rows(*camera_rows[2:]))
    return seen.points, seen.pixels, seen.depth, seen.valid


def one_behind(dtype: torch.dtype) -> Tensor:
    """A point of the first cloud is behind its first camera."""
    points = clouds(dtype)
    points[0, 0] = torch.tensor([0.0, 0.0, -5.0])
    return points


def out_of_sight(dtype: torch.dtype) -> Tensor:
    """The first cloud is seen, the second is not."""
    return clouds(dtype) + torch.tensor([[[0.0, 0, 0]], [[3, 0, -3]]], dtype=dtype)


def front(distance: str) -> Case:
    def reference_of(points: Tensor) -> Tensor:
        camera = cameras(points.dtype)
        maps = depth_maps(points.dtype)
        return reference.front_constraint(points, camera.K, camera.cam_from_world, maps, distance=distance)

    return Case(
        lambda dtype: (out_of_sight(dtype),),
        lambda points: (
            dp.front_terms(
                points, cameras(points.dtype), depth_maps(points.dtype), distance=distance, tolerance=1e-7
            ).loss
        ),
        reference_of,
    )


def projection(name: str, *, with_logits: bool = False, **options: Any) -> Case:
    def leaves(dtype: torch.dtype) -> Leaves:
        logits = torch.randn(2, 16, generator=torch.Generator().manual_seed(0), dtype=dtype)
        return (clouds(dtype), logits) if with_logits else (clouds(dtype),)

    def ours(points: Tensor, *logits: Tensor) -> Tensor:
        given = {"logits": logits[0]} if logits else {}
        maps = depth_maps(points.dtype)
        return getattr(dp, name)(points, cameras(points.dtype), maps, reduction="none", **given, **options)

    def theirs(points: Tensor, *logits: Tensor) -> Tensor:
        given = {"logits": logits[0]} if logits else {}
        camera, maps = cameras(points.dtype), depth_maps(points.dtype)
        function = getattr(reference_projection, name)
        return function(points, camera.K, camera.cam_from_world, maps, **given, **options)

    # The soft loss measures distances to the silhouette in float32, for any dtype.
    return Case(leaves, ours, theirs, scale=500 if name == "soft_projection_loss" else 5)


def stacks(dtype: torch.dtype) -> Leaves:
    random = torch.Generator().manual_seed(0)
    codes = torch.randn(3, 2, 5, generator=random, dtype=dtype)
    return codes, torch.stack([clouds(dtype, 8, seed=seed) for seed in (4, 5, 6)])


def matching(*, squared: bool) -> Case:
    """Three samples against the four clouds of another stack, of another size."""
    return Case(
        lambda dtype: (
            torch.stack([clouds(dtype, 8, seed=seed) for seed in (4, 5, 6)], 1),
            torch.stack([clouds(dtype, 11, seed=seed) for seed in (7, 8, 9, 10)], 1),
        ),
        lambda a, b: dp.minimal_matching_distance(a, b, squared=squared, reduction="none"),
        lambda a, b: reference.minimal_matching_distance(a, b, squared=squared),
    )


CASES = {
    "nearest": two_sets("nearest"),
    "knn": two_sets("knn", k=5),
    "knn, more than there are": two_sets("knn", k=30, radius=0.6),
    "knn, exclude_self": Case(
        lambda dtype: sets(dtype)[1:],
        lambda a: dp.knn(a, a, 4, exclude_self=True),
        lambda a: reference.knn(a, a, 4, exclude_self=True),
    ),
    "chamfer_distance": two_sets("chamfer_distance", squared=False),
    "chamfer_distance, squared": two_sets("chamfer_distance", squared=True),
    "chamfer_distance, sum": two_sets("chamfer_distance", squared=False, reduction="sum"),
    "chamfer_distance, max": two_sets("chamfer_distance", squared=True, reduction="max"),
    "chamfer_distance, none": two_sets("chamfer_distance", squared=False, reduction="none"),
    "hausdorff_distance": two_sets("hausdorff_distance"),
    "earth_mover_distance": Case(
        sets,
        lambda a, b: dp.earth_mover_distance(a, b, a_lengths=LENGTHS, tolerance=1e-7)[:2],
        lambda a, b: reference.earth_mover_distance(a, b, a_lengths=LENGTHS),
    ),
    "earth_mover_distance, squared": Case(
        sets,
        lambda a, b: dp.earth_mover_distance(a, b, squared=True, a_lengths=LENGTHS, tolerance=1e-7)[:2],
        lambda a, b: reference.earth_mover_distance(a, b, squared=True, a_lengths=LENGTHS),
    ),
    "approxmatch": two_sets("approxmatch"),
    "splat_depth": splat(0.0),
    "splat_depth, radius 0.8": splat(0.8),
    "splat_depth, radius 1.7": splat(1.7),
    "sample_view": Case(
        lambda dtype: (clouds(dtype),),
        lambda points: sampled(dp.sample_view, points),
        lambda points: sampled(reference.sample_view, points),
    ),
    "soft_splat, sharp": soft_splat(2.3, 0.05),
    "soft_splat, wide": soft_splat(20.0, 0.5),
    "project": Case(
        lambda dtype: (one_behind(dtype), *rows(dtype)),
        lambda points, *camera: dp.project(points, of_rows(*camera)),
        lambda points, *camera: reference.project(points, *matrices(*camera)),
    ),
    "unproject": Case(
        lambda dtype: (depth_maps(dtype), *rows(dtype)),
        lambda depth, *camera: dp.unproject(depth, of_rows(*camera)),
        lambda depth, *camera: reference.unproject(depth, *matrices(*camera)),
    ),
    "reproject": Case(
        lambda dtype: (depth_maps(dtype), *rows(dtype), *(r.flip(1) for r in rows(dtype))),
        reprojected,
        lambda depth, *camera: reference.reproject(
            depth, matrices(*camera[:2]), matrices(*camera[2:]), (HEIGHT, WIDTH)
        ),
    ),
    "front_terms, chamfer": front("chamfer"),
    "front_terms, emd": front("emd"),
    "projection_loss": projection("projection_loss", mask_weight=0.3),
    "projection_loss, logits": projection("projection_loss", with_logits=True, mask_weight=0.3, upsample=3),
    "soft_projection_loss": projection("soft_projection_loss", radius=2.3, softness=0.1, mask_weight=0.2),
    "diversity_loss": Case(
        stacks,
        lambda codes, shapes: dp.diversity_loss(codes, shapes, alpha=3.0, tolerance=1e-6, reduction="none"),
        lambda codes, shapes: reference.diversity_loss(codes, shapes, alpha=3.0),
    ),
    "minimal_matching_distance": matching(squared=True),
    "minimal_matching_distance, not squared": matching(squared=False),
    "unidirectional_hausdorff_distance": Case(
        lambda dtype: (clouds(dtype, seed=7), stacks(dtype)[1].transpose(0, 1)),
        lambda partial, shapes: dp.unidirectional_hausdorff_distance(
            partial, shapes, partial_lengths=LENGTHS, reduction="none"
        ),
        lambda partial, shapes: reference.unidirectional_hausdorff_distance(
            partial, shapes, partial_lengths=LENGTHS
        ),
    ),
    "total_mutual_difference": Case(
        lambda dtype: stacks(dtype)[1:],
        lambda shapes: dp.total_mutual_difference(shapes.transpose(0, 1), squared=True, reduction="none"),
        lambda shapes: reference.total_mutual_difference(shapes.transpose(0, 1), squared=True),
    ),
    "consistency_loss": Case(
        lambda dtype: stacks(dtype)[1:],
        lambda shapes: dp.consistency_loss(shapes.transpose(0, 1), reduction="none"),
        lambda shapes: reference.consistency_loss(shapes.transpose(0, 1)),
    ),
}


def finite(outputs: Any) -> Leaves:
    """Those with a gradient, 0 where they are infinite."""
    outputs = (outputs,) if isinstance(outputs, Tensor) else outputs
    return tuple(torch.where(torch.isfinite(o), o, 0.0) for o in outputs if o.requires_grad)


def strided(leaf: Tensor) -> Tensor:
    """The same values, not contiguous."""
    return leaf.movedim(0, -1).contiguous().movedim(-1, 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients_equal_the_reference_implementation(name, dtype):
    case = CASES[name]
    leaves = [strided(leaf).requires_grad_() for leaf in case.leaves(dtype)]
    ours, theirs = case.ours(*leaves), case.theirs(*leaves)
    both = [(o,) if isinstance(o, Tensor) else tuple(o) for o in (ours, theirs)]
    for x, y in zip(*both, strict=True):
        assert x.shape == y.shape
        if x.is_floating_point():
            assert_close(x, y, scale=case.scale)
        else:
            assert torch.equal(x, y)
    gradients = []
    for outputs in (finite(ours), finite(theirs)):
        random = torch.Generator().manual_seed(1)
        weights = [torch.rand(o.shape, generator=random, dtype=dtype) + 0.5 for o in outputs]
        total = torch.stack([(o * w).sum() for o, w in zip(outputs, weights, strict=True)]).sum()
        gradients.append(torch.autograd.grad(total, leaves, materialize_grads=True))
    assert all(g.isfinite().all() for g in gradients[0])
    assert any(g.any() for g in gradients[0])
    for x, y in zip(*gradients, strict=True):
        assert_close(x, y, scale=case.scale)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.finite_differences])
def test_gradients_are_those_of_finite_differences(name):
    case = CASES[name]
    leaves = case.leaves(torch.float64)
    keep = [torch.isfinite(leaf) for leaf in leaves]

    def of_finite_values(*values: Tensor) -> Leaves:
        whole = (leaf.masked_scatter(k, v) for leaf, k, v in zip(leaves, keep, values, strict=True))
        return finite(case.ours(*whole))

    check_gradients(of_finite_values, *(leaf[k] for leaf, k in zip(leaves, keep, strict=True)))


@pytest.mark.parametrize("name", ["chamfer_distance", "soft_splat, sharp", "project", "reproject"])
def test_the_gradient_of_a_sum_of_one_output(name):
    """Its gradient is one number expanded, and the other outputs have none."""
    leaves = [leaf.detach().clone().requires_grad_() for leaf in CASES[name].leaves(torch.float64)]
    outputs = finite(CASES[name].ours(*leaves))
    for chosen in range(len(outputs)):
        weights = [torch.full_like(o, float(i == chosen)) for i, o in enumerate(outputs)]
        dense = torch.autograd.grad(outputs, leaves, weights, retain_graph=True, materialize_grads=True)
        alone = outputs[chosen].sum()
        single = torch.autograd.grad(alone, leaves, retain_graph=True, materialize_grads=True)
        for x, y in zip(single, dense, strict=True):
            assert_close(x, y, scale=max(1.0, float(y.abs().max())))
