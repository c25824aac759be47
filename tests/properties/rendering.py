"""Splatting, view sampling and projections against the reference implementations.

Where rounding decides which pixel a point falls into, two correct renderers may disagree: `image_bounds` bounds the
error of positions, and only pixels that no such error changes are compared.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

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


class ImageBounds(NamedTuple):
    """Positions in float64, and how far a correct renderer in the cloud's own dtype may be from them."""

    u: Tensor
    v: Tensor
    depth: Tensor
    u_error: Tensor
    v_error: Tensor
    depth_error: Tensor


def image_bounds(
    points: Tensor, K: Tensor, cam_from_world: Tensor, error: Tensor | float = 0.0
) -> ImageBounds:
    """All (B, V, N); `error` is that of the points themselves."""
    homogeneous = torch.cat((points, torch.ones_like(points[..., :1])), -1).double()[:, None]
    K, extrinsics = K.double(), cam_from_world.double()[..., :3, :]
    x, y, depth = (homogeneous @ (K @ extrinsics).mT).unbind(-1)
    size = K.abs() @ extrinsics.abs()
    slack = 16 * eps(points.dtype) * (homogeneous.abs() @ size.mT)
    slack = slack + (error * size[..., :3].sum(-1)[..., None, :] if isinstance(error, float) else error)
    dx, dy, depth_error = slack.unbind(-1)
    safe = depth > depth_error
    divisor = torch.where(safe, depth, 1.0)
    rest = torch.where(safe, depth - depth_error, 1.0)
    u, v = x / divisor, y / divisor
    errors = (
        (d + w.abs() * depth_error) / rest + 8 * eps(points.dtype) * w.abs() for d, w in ((dx, u), (dy, v))
    )
    u_error, v_error = (torch.where(safe, e, 1e30) for e in errors)
    return ImageBounds(u, v, depth, u_error, v_error, depth_error)


def decided_pixels(at: ImageBounds, camera: dp.PinholeCamera, radius: float, counts: Tensor) -> Tensor:
    """(B, V, H, W): every point certainly covers the pixel, or certainly does not."""
    u, v, depth, du, dv, dd = (t[..., None, None] for t in at)
    column = torch.arange(camera.width, dtype=torch.float64)[None, :]
    row = torch.arange(camera.height, dtype=torch.float64)[:, None]
    may = (column + 1 > u - du) & (column <= u + du) & (row + 1 > v - dv) & (row <= v + dv)
    must = (column <= u - du) & (column + 1 > u + du) & (row <= v - dv) & (row + 1 > v + dv)
    if radius:
        across, down = (column + 0.5 - u).abs(), (row + 0.5 - v).abs()
        squared = across.square() + down.square()
        error = 2 * (across * du + down * dv) + du.square() + dv.square() + 1e-5 * (squared + radius**2)
        may |= squared <= radius**2 + error
        must |= squared + error <= radius**2
    may &= depth > -dd
    must &= depth > dd
    inside = torch.arange(u.shape[2]) < counts[:, None]
    return ~(may & ~must & inside[:, None, :, None, None]).any(2)


class Rendering(NamedTuple):
    recipe: strategies.Recipe
    camera: strategies.CameraRecipe
    radius: float = 0.0


def camera_matrices(camera: dp.PinholeCamera, batch: int) -> tuple[Tensor, Tensor]:
    """K and cam_from_world (B, V, ...)."""
    views = camera.batch_shape[-1] if camera.batch_shape else 1
    whole = camera.expand(batch, views)
    return whole.K, whole.cam_from_world


def check_splat_depth(case: Rendering) -> str:
    cloud, camera = case.recipe.make(), case.camera.make(case.recipe.dtype)
    splat = refuse_or_run(
        lambda: dp.splat_depth(cloud.points, camera, radius=case.radius, lengths=cloud.lengths),
        cloud.poisoned,
        "splat_depth",
    )
    if splat is None:
        return REFUSED
    size = camera.height, camera.width
    matrices = camera_matrices(camera, len(cloud.points))
    assert_finite_gradients(splat.depth, cloud.points)
    depth, index, _ = reference.splat_depth(
        cloud.clean, *matrices, *size, radius=case.radius, lengths=cloud.lengths
    )
    assert torch.equal(splat.index >= 0, torch.isfinite(splat.depth))
    owners = torch.zeros_like(splat.visible)
    b, v, *_ = (splat.index >= 0).nonzero(as_tuple=True)
    owners[b, v, splat.index[splat.index >= 0]] = True
    assert torch.equal(splat.visible, owners)

    at = image_bounds(cloud.clean, *matrices)
    decided = decided_pixels(at, camera, case.radius, cloud.counts)
    assert torch.equal((splat.index >= 0)[decided], (index >= 0)[decided])
    hit = decided & (index >= 0)
    if not bool(hit.any()):
        return AGREED if bool(decided.all()) else UNDECIDED

    def of_winner(values: Tensor, winner: Tensor) -> Tensor:
        return torch.take_along_dim(values, winner.clamp(min=0).flatten(2), 2).view(winner.shape)[hit]

    error = torch.maximum(of_winner(at.depth_error, index), of_winner(at.depth_error, splat.index))
    assert_within(splat.depth[hit], depth[hit], 2 * error)
    assert_within(of_winner(at.depth, splat.index), of_winner(at.depth, index), 2 * error)
    axes = cloud.clean[:, None].expand(-1, len(matrices[0][0]), -1, -1).unbind(-1)
    duplicate = torch.stack([of_winner(x, splat.index) == of_winner(x, index) for x in axes]).all(0)
    assert torch.equal(splat.index[hit][duplicate], index[hit][duplicate]), "the lowest of equals"
    return AGREED if bool(decided.all()) else UNDECIDED


def check_sample_view(case: Rendering) -> str:
    """The splat is of finite points; invalid values are in the points that are sampled."""
    cloud, camera = case.recipe.make(), case.camera.make(case.recipe.dtype)
    sound = torch.nan_to_num(cloud.points.detach(), nan=0.0, posinf=0.0, neginf=0.0)
    splat = dp.splat_depth(sound, camera, radius=case.radius, lengths=cloud.lengths)
    seen = splat.visible.any(1)[..., None] & ~torch.isfinite(cloud.points.detach())
    sample = refuse_or_run(lambda: dp.sample_view(cloud.points, splat), bool(seen.any()), "sample_view")
    if sample is None:
        return REFUSED
    expected = reference.sample_view(cloud.points.detach(), splat.visible)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(sample, expected, strict=True))
    (gradient,) = assert_finite_gradients(sample.points, cloud.points)
    assert torch.equal(gradient[..., 0], splat.visible.sum(1).to(gradient.dtype))
    return AGREED


def check_project(case: Rendering) -> str:
    cloud, camera = case.recipe.make(), case.camera.make(case.recipe.dtype)
    result = refuse_or_run(lambda: dp.project(cloud.points, camera), cloud.poisoned, "project")
    if result is None:
        return REFUSED
    matrices = camera_matrices(camera, len(cloud.points))
    _assert_projected(result, reference.project(cloud.clean, *matrices), image_bounds(cloud.clean, *matrices))
    assert_finite_gradients(result.pixels, cloud.points)
    assert_finite_gradients(result.depth, cloud.points)
    return AGREED


def _assert_projected(ours: tuple[Tensor, Tensor], theirs: tuple[Tensor, Tensor], at: ImageBounds) -> None:
    """Pixels (B, V, N, 2) and depth (B, V, N), compared where the point is certainly before or behind the camera."""
    assert_within(ours[1], theirs[1], 2 * at.depth_error)
    assert not ours[0].isnan().any()
    certain = at.depth.abs() > at.depth_error
    for axis, error in ((0, at.u_error), (1, at.v_error)):
        assert_within(ours[0][..., axis][certain], theirs[0][..., axis][certain], 2 * error[certain])


def check_visible_points(case: Rendering, method: str) -> str:
    """Properties that hold for every method and cloud; test_visibility.py tests how accurate the methods are."""
    cloud, camera = case.recipe.make(), case.camera.make(case.recipe.dtype)

    def visible() -> Tensor:
        return dp.visible_points(cloud.points, camera, method=method, lengths=cloud.lengths)

    names = ("visible_points", "splat_depth")
    seen = refuse_or_run(visible, cloud.poisoned, *names)
    if seen is None:
        return REFUSED
    matrices = camera_matrices(camera, len(cloud.points))
    at = image_bounds(cloud.clean, *matrices)
    inside = torch.arange(case.recipe.count) < cloud.counts[:, None]
    assert seen.shape == at.depth.shape
    assert not (seen & ~inside[:, None]).any()
    outside = (at.u + at.u_error < 0) | (at.u - at.u_error > camera.width) | (at.depth + at.depth_error < 0)
    outside |= (at.v + at.v_error < 0) | (at.v - at.v_error > camera.height)
    assert not (seen & outside).any()
    assert torch.equal(seen, visible())
    if method == "zbuffer":
        assert torch.equal(seen, dp.splat_depth(cloud.points, camera, lengths=cloud.lengths).visible)
    return AGREED


class Maps(NamedTuple):
    recipe: strategies.Recipe
    camera: strategies.CameraRecipe
    target: strategies.CameraRecipe
    depth: strategies.DepthRecipe
    views: int

    def make(self) -> tuple[strategies.Cloud, dp.PinholeCamera, Tensor, bool]:
        cloud, camera = self.recipe.make(), self.camera.make(self.recipe.dtype)
        shape = (*self.recipe.batch, self.views, camera.height, camera.width)
        return cloud, camera, *self.depth.make(shape, self.recipe.dtype)


def _unprojection_error(depth: Tensor, camera: dp.PinholeCamera) -> float:
    """Of a world coordinate; the cameras here are well conditioned."""
    foreground = depth.detach()[torch.isfinite(depth)]
    return 200 * eps(depth.dtype) * (magnitude(foreground) * (1 + 5 / min(camera.height, camera.width)) + 10)


def check_unproject(case: Maps) -> str:
    _, camera, depth, poisoned = case.make()
    result = refuse_or_run(lambda: dp.unproject(depth, camera), poisoned, "unproject")
    if result is None:
        return REFUSED
    points, lengths = reference.unproject(depth.detach(), *camera_matrices(camera, len(depth)))
    assert torch.equal(result.lengths, lengths)
    assert_within(result.points, points, _unprojection_error(depth, camera))
    assert_finite_gradients(result.points, depth)
    return AGREED


def check_reproject(case: Maps) -> str:
    _, source, depth, poisoned = case.make()
    target = case.target.make(depth.dtype)
    result = refuse_or_run(lambda: dp.reproject(depth, source, target), poisoned, "unproject", "reproject")
    if result is None:
        return REFUSED
    batch, views, height, width = depth.shape
    matrices = [m.expand(batch, views, *m.shape[-2:]) for m in camera_matrices(target, batch)]
    sources = [m.expand(batch, views, *m.shape[-2:]) for m in camera_matrices(source, batch)]
    expected = reference.reproject(depth.detach(), sources, matrices, (target.height, target.width))
    error = _unprojection_error(depth, source)
    assert_within(result.points, expected[0], error)
    flat = expected[0].reshape(batch * views, height * width, 3)
    at = image_bounds(flat, *(m.reshape(batch * views, 1, *m.shape[-2:]) for m in matrices), error=2 * error)
    foreground = torch.isfinite(depth.detach()).reshape(batch * views, 1, height * width)
    at = ImageBounds(*(t[foreground] for t in at))
    _assert_projected(
        (
            result.pixels.reshape(*foreground.shape, 2)[foreground],
            result.depth.reshape(foreground.shape)[foreground],
        ),
        (
            expected[1].reshape(*foreground.shape, 2)[foreground],
            expected[2].reshape(foreground.shape)[foreground],
        ),
        at,
    )
    near_border = (at.depth.abs() <= at.depth_error) | (at.u.abs() <= at.u_error) | (at.v.abs() <= at.v_error)
    near_border |= ((at.u - target.width).abs() <= at.u_error) | ((at.v - target.height).abs() <= at.v_error)
    valid, expected_valid = (t.reshape(foreground.shape)[foreground] for t in (result.valid, expected[3]))
    assert torch.equal(valid[~near_border], expected_valid[~near_border])
    assert not result.valid[torch.isinf(depth)].any()
    assert_finite_gradients(result.points, depth)
    assert_finite_gradients(result.depth, depth)
    return AGREED
