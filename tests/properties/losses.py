"""The paper's losses against the reference implementations."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch

import diffpoint as dp
from diffpoint import reference
from properties import strategies
from properties.compare import (
    AGREED,
    REFUSED,
    UNDECIDED,
    assert_finite_gradients,
    assert_within,
    eps,
    magnitude,
    refuse_or_run,
)
from properties.rendering import Maps, camera_matrices, decided_pixels, image_bounds


def same_picture(cloud: strategies.Cloud, camera: dp.PinholeCamera) -> bool:
    """Whether op and reference certainly see the same points, so that losses based on them can be compared."""
    matrices = camera_matrices(camera, len(cloud.points))
    at = image_bounds(cloud.clean, *matrices)
    if not bool(decided_pixels(at, camera, 0.0, cloud.counts).all()):
        return False
    splat = dp.splat_depth(cloud.points.detach(), camera)
    return torch.equal(
        splat.index, reference.splat_depth(cloud.clean, *matrices, camera.height, camera.width)[1]
    )


def view_loss(case: Maps, name: str, function: Callable, **options) -> str:
    cloud, camera, depth, poisoned = case.make()
    loss_of = getattr(dp, name)
    nothing = len(depth) == 0 or case.views == 0
    no_points = name == "front_constraint" and cloud.points.shape[1] == 0 and len(depth) > 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="front_constraint: in ", category=RuntimeWarning)
        refuse_or_run(
            lambda: loss_of(cloud.points, camera, depth, **options),
            cloud.poisoned or poisoned or nothing or no_points,
            *(name, "splat_depth", "unproject"),
        )
        loss = refuse_or_run(
            lambda: loss_of(cloud.points, camera, depth, reduction="none", **options),
            cloud.poisoned or poisoned or no_points,
            *(name, "splat_depth", "unproject"),
        )
    if loss is None:
        return REFUSED
    assert loss.shape == depth.shape[:2]
    assert torch.isfinite(loss).all()
    assert_finite_gradients(loss, cloud.points, depth)
    larger = options.get("upsample", 1)
    if not same_picture(cloud, camera.resize(camera.height * larger, camera.width * larger)):
        return UNDECIDED
    matrices = [m.expand(*depth.shape[:2], *m.shape[-2:]) for m in camera_matrices(camera, len(depth))]
    if loss.numel():
        expected = function(cloud.clean, *matrices, depth.detach(), **options)
        foreground = depth.detach()[torch.isfinite(depth)]
        size = magnitude(cloud.clean, foreground) + 10
        slack = 500 * eps(loss.dtype) * size
        # The reference assignment is exact; that of the op is within its tolerance.
        above = 0.021 * expected if options.get("distance") == "emd" else 0.0
        assert bool(((loss >= expected - slack) & (loss <= expected + above + slack)).all())
    return AGREED


def check_front_constraint(case: Maps, distance: str) -> str:
    return view_loss(case, "front_constraint", reference.front_constraint, distance=distance)


def check_diversity_loss(
    recipe: strategies.Recipe, dimension: int, alpha: float, poison: float | None
) -> str:
    cloud = recipe.make()
    codes = torch.randn(*recipe.batch, dimension, generator=torch.Generator().manual_seed(recipe.seed))
    codes = codes.to(recipe.dtype)
    code_poisoned = poison is not None and codes.numel() > 0
    if code_poisoned:
        codes.view(-1)[recipe.seed % codes.numel()] = poison
    codes.requires_grad_()
    size, shapes = recipe.batch
    refuse = cloud.poisoned or code_poisoned or size < 2 or shapes == 0 or cloud.points.shape[-2] == 0
    loss = refuse_or_run(
        lambda: dp.diversity_loss(codes, cloud.points, alpha=alpha),
        refuse,
        "diversity_loss",
        "earth_mover_distance",
    )
    if loss is None:
        return REFUSED
    assert_finite_gradients(loss, codes, cloud.points)
    expected = reference.diversity_loss(codes.detach(), cloud.clean, alpha=alpha).mean()
    slack = 1e3 * eps(recipe.dtype) * (alpha * magnitude(cloud.clean) + 10)
    below = 0.06 * alpha * 2 * magnitude(cloud.clean)  # the assignment of the op is within its tolerance
    assert expected - below - slack <= loss <= expected + slack
    return AGREED


def check_consistency_loss(recipe: strategies.Recipe) -> str:
    cloud = recipe.make()
    refuse = cloud.poisoned or recipe.batch[-1] < 2 or recipe.count == 0 or 0 in recipe.batch
    loss = refuse_or_run(
        lambda: dp.consistency_loss(cloud.points), refuse, "consistency_loss", "chamfer_distance"
    )
    if loss is None:
        return REFUSED
    expected = reference.consistency_loss(cloud.clean).mean()
    assert_within(loss, expected, 100 * eps(recipe.dtype) * expected)
    assert_finite_gradients(loss, cloud.points)
    return AGREED


def check_minimal_matching_distance(recipe: strategies.Recipe, squared: bool) -> str:
    return completions_agree(
        "minimal_matching_distance", recipe, lambda shapes: (shapes, 0.9 * shapes.flip(-3)), squared=squared
    )


def check_total_mutual_difference(recipe: strategies.Recipe, squared: bool) -> str:
    return completions_agree(
        "total_mutual_difference", recipe, lambda shapes: (shapes,), fewest=2, squared=squared
    )


def check_unidirectional_hausdorff_distance(recipe: strategies.Recipe) -> str:
    return completions_agree(
        "unidirectional_hausdorff_distance", recipe, lambda shapes: (0.9 * shapes.flatten(-3, -2), shapes)
    )


def completions_agree(
    name: str, recipe: strategies.Recipe, arguments: Callable, *, fewest: int = 1, **options
) -> str:
    """Of a metric of several shapes for each input; `arguments` makes its tensors of these."""
    cloud = recipe.make()
    refuse = cloud.poisoned or recipe.batch[-1] < fewest or recipe.count == 0 or 0 in recipe.batch
    result = refuse_or_run(
        lambda: getattr(dp, name)(*arguments(cloud.points), **options), refuse, name, "chamfer_distance"
    )
    if result is None:
        return REFUSED
    expected = getattr(reference, name)(*arguments(cloud.clean), **options).mean()
    assert_within(result, expected, 100 * eps(recipe.dtype) * expected)
    assert_finite_gradients(result, cloud.points)
    return AGREED
