"""The projection losses and the soft splat against the reference implementations."""

from __future__ import annotations

import torch
from torch import Tensor

import diffpoint as dp
from diffpoint import reference_projection
from properties import strategies
from properties.compare import (
    AGREED,
    REFUSED,
    UNDECIDED,
    assert_finite_gradients,
    eps,
    magnitude,
    refuse_or_run,
)
from properties.losses import view_loss
from properties.rendering import Maps, Rendering, camera_matrices, image_bounds


def check_projection_loss(case: Maps, upsample: int, mask_weight: float) -> str:
    return view_loss(
        case,
        "projection_loss",
        reference_projection.projection_loss,
        upsample=upsample,
        mask_weight=mask_weight,
    )


def _footprints(
    cloud: strategies.Cloud, camera: dp.PinholeCamera, radius: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Footprint, its possible error, depth and its possible error (B, V, N, H, W), in float64."""
    at = image_bounds(cloud.clean, *camera_matrices(camera, len(cloud.points)))
    least = (
        32 * eps(cloud.points.dtype) * (1 + max(camera.height, camera.width) / radius)
    )  # smaller fades do not count
    u, v, depth, du, dv, dd = (t[..., None, None] for t in at)
    across = torch.arange(camera.width, dtype=torch.float64)[None, :] + 0.5 - u
    down = torch.arange(camera.height, dtype=torch.float64)[:, None] + 0.5 - v
    inside = (torch.arange(u.shape[2]) < cloud.counts[:, None])[:, None, :, None, None]

    def footprint(across: Tensor, down: Tensor, counts: Tensor) -> Tensor:
        fade = 1 - (across / radius).square() - (down / radius).square()
        return torch.where(counts & inside & (fade > least), fade.square(), 0.0)

    nearest = footprint((across.abs() - du).clamp(min=0), (down.abs() - dv).clamp(min=0), depth > -dd)
    farthest = footprint(across.abs() + du, down.abs() + dv, depth > dd)
    exact = footprint(across, down, depth > 0)
    return exact, nearest - farthest + 8 * eps(cloud.points.dtype) * nearest, depth, dd


def check_soft_splat(case: Rendering, softness: float) -> str:
    cloud, camera = case.recipe.make(), case.camera.make(case.recipe.dtype)
    radius = case.radius or 1.5
    soft = refuse_or_run(
        lambda: dp.soft_splat(cloud.points, camera, radius=radius, softness=softness, lengths=cloud.lengths),
        cloud.poisoned,
        "soft_splat",
    )
    if soft is None:
        return REFUSED
    assert not soft.depth.isnan().any()
    assert torch.equal(torch.isfinite(soft.depth), soft.coverage > 0)
    assert_finite_gradients(soft.coverage, cloud.points)
    # As the loss does: where the coverage goes to 0 the depth's gradient has no bound.
    assert_finite_gradients(torch.where(soft.coverage > 0, soft.depth, 0.0) * soft.coverage, cloud.points)

    footprint, error, z, dz = _footprints(cloud, camera, radius)
    rounding = 4 * eps(soft.depth.dtype) * case.recipe.count
    coverage = footprint.sum(2)
    assert bool(((soft.coverage - coverage).abs() <= error.sum(2) + rounding * (coverage + 1e-30)).all())
    if case.recipe.count == 0:
        return AGREED
    order = ((torch.where(footprint > 0, z, torch.inf).amin(2, keepdim=True) - z) / softness).exp()
    maybe = torch.where(error > 0, order, 0.0)  # of the points whose footprint may only be rounding
    order = torch.where(footprint > 0, order, 0.0)
    weight = (footprint * order).sum(2)
    depth = (footprint * order * torch.where(footprint > 0, z, 0.0)).sum(2) / weight
    # What each point may add to the sum of weights, relative to it: by its footprint, and by its place in the order.
    per_point = order * (error + 2 * footprint * (dz.expand_as(footprint) / softness + rounding))
    loose = torch.where(footprint > 0, per_point, error * maybe).sum(2) / weight
    certain = torch.isfinite(loose) & (loose < 0.01) & (weight > 0)
    reach = torch.where(footprint + error > 0, (z - depth[:, :, None]).abs(), 0.0).amax(2)
    widest = torch.where(footprint + error > 0, dz.expand_as(footprint), 0.0).amax(2)
    slack = 4 * loose * reach + 4 * widest + rounding * (depth.abs() + softness)
    assert bool(((soft.depth - depth).abs() <= slack)[certain].all())
    return AGREED if bool((certain | (weight == 0)).all()) else UNDECIDED


def check_soft_projection_loss(case: Maps, mask_weight: float) -> str:
    cloud, camera, depth, poisoned = case.make()
    nothing = len(depth) == 0 or case.views == 0
    options = {"radius": 1.7, "softness": 0.05, "mask_weight": mask_weight}
    for reduction, refuse in (("mean", nothing), ("none", False)):
        loss = refuse_or_run(
            lambda reduction=reduction: dp.soft_projection_loss(
                cloud.points, camera, depth, reduction=reduction, **options
            ),
            cloud.poisoned or poisoned or refuse,
            *("soft_projection_loss", "soft_splat"),
        )
    if loss is None:
        return REFUSED
    assert loss.shape == depth.shape[:2]
    assert torch.isfinite(loss).all()
    assert_finite_gradients(loss, cloud.points, depth)
    at = image_bounds(cloud.clean, *camera_matrices(camera, len(depth)))
    worst = magnitude(at.u_error, at.v_error, at.depth_error / 0.05)
    if worst > 1e-6:
        return UNDECIDED
    matrices = [
        m.expand(*depth.shape[:2], *m.shape[-2:]).double() for m in camera_matrices(camera, len(depth))
    ]
    if loss.numel():
        expected = reference_projection.soft_projection_loss(
            cloud.clean.double(), *matrices, depth.detach().double(), **options
        )
        foreground = depth.detach()[torch.isfinite(depth)]
        size = magnitude(cloud.clean, foreground) + 10
        slack = 500 * (worst + eps(loss.dtype)) * size * (case.recipe.count + 1)
        assert bool(((loss - expected).abs() <= slack).all())
    return AGREED
