"""Soft splatting: against its plain twin, its limits, and gradients across pixels that the hard splat has not."""

import pytest
import torch

import diffpoint as dp
from diffpoint import reference_projection as twins
from diffpoint.testing import assert_close, check_gradients

DTYPES = (torch.float32, torch.float64)


def camera(dtype: torch.dtype = torch.float64) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=14, width=17)


def cloud(count: int, dtype: torch.dtype = torch.float64, batch: int = 2) -> torch.Tensor:
    random = torch.Generator().manual_seed(count)
    return (torch.rand(batch, count, 3, generator=random, dtype=dtype) - 0.5).requires_grad_()


def matrices(view: dp.PinholeCamera, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    return view.K.expand(batch, *view.K.shape), view.cam_from_world.expand(batch, *view.cam_from_world.shape)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("radius", "softness"), [(0.8, 0.5), (2.3, 0.05), (40.0, 0.01)])
def test_it_equals_its_twin(dtype, radius, softness):
    points, view = cloud(90, dtype), camera(dtype)
    lengths = torch.tensor([90, 33])
    ours = dp.soft_splat(points, view, radius=radius, softness=softness, lengths=lengths)
    theirs = twins.soft_splat(
        points, *matrices(view), (14, 17), radius=radius, softness=softness, lengths=lengths
    )
    scale = 20 / softness  # of the rounding errors in exp(-z / softness)
    assert_close(ours.depth, theirs[0], scale=scale)
    assert_close(ours.coverage, theirs[1], scale=20)
    assert_close(ours.mask, 1 - torch.exp(-theirs[1]), scale=20)
    random = torch.Generator().manual_seed(0)
    weights = torch.rand(2, *ours.depth.shape, generator=random, dtype=dtype)
    gradients = []
    for depth, coverage in (ours, theirs):
        # Weighed with the coverage, as the loss does: where that is 0 the depth has no bounded gradient.
        depth = torch.where(torch.isfinite(depth), depth, 0.0) * coverage
        gradients += torch.autograd.grad((weights[0] * depth + weights[1] * coverage).sum(), points)
    assert_close(*gradients, scale=50 * scale)
    assert (gradients[0][1, 33:] == 0).all()


def test_gradients_are_those_of_finite_differences_to_points_and_camera():
    view = camera()
    points = cloud(12, batch=1)

    def maps(points, K, extrinsics):
        moved = dp.PinholeCamera(K, extrinsics, 14, 17)
        depth, coverage = dp.soft_splat(points, moved, radius=3.0, softness=0.1)
        return torch.where(torch.isfinite(depth), depth, 0.0) * coverage, coverage

    fixed = view.K[:1, 2:], view.cam_from_world[:1, 3:]

    def of_free_rows(points, K_rows, extrinsic_rows):
        return maps(points, torch.cat((K_rows, fixed[0]), 1), torch.cat((extrinsic_rows, fixed[1]), 1))

    check_gradients(of_free_rows, points, view.K[:1, :2], view.cam_from_world[:1, :3])


def test_a_step_to_the_side_is_felt_where_the_hard_splat_feels_nothing():
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 8], [0, 30.0, 7], [0, 0, 1]]), torch.eye(4), 14, 16)
    points = torch.tensor([[[0.02, 0.01, 1.5], [0.05, 0.02, 1.7]]], requires_grad=True)
    for depth, sideways in ((dp.splat_depth(points, view).depth, 0), (dp.soft_splat(points, view).depth, 1)):
        seen = depth[torch.isfinite(depth)].square().sum()
        (gradient,) = torch.autograd.grad(seen, points)
        assert bool((gradient[..., :2] != 0).any()) == sideways
        assert (gradient[..., 2] != 0).any()


def test_a_small_softness_and_radius_give_the_hard_splat():
    view, points = camera(), cloud(300)
    hard = dp.splat_depth(points, view, radius=1.2).depth
    soft = dp.soft_splat(points, view, radius=1.2, softness=1e-9)
    inside = soft.coverage > 0
    assert torch.equal(torch.isfinite(soft.depth), inside)
    assert inside.any()
    assert (
        torch.isfinite(hard) | ~inside
    ).all()  # the hard disc includes the point's own pixel, and its edge
    nearest = (hard - soft.depth)[inside & (hard == dp.splat_depth(points, view, radius=1.19).depth)]
    assert len(nearest) > 100
    assert_close(nearest, torch.zeros_like(nearest))


def test_the_depth_lies_between_those_of_the_points_and_the_mask_below_one():
    view, points = camera(), cloud(200)
    soft = dp.soft_splat(points, view, radius=4.0, softness=0.1)
    z = dp.project(points, view).depth
    hit = torch.isfinite(soft.depth)
    for extreme, sign in ((z.amin(2), 1), (z.amax(2), -1)):
        assert (sign * (soft.depth - extreme[..., None, None])[hit] >= -1e-12).all()
    assert ((soft.mask >= 0) & (soft.mask <= 1)).all()
    assert torch.equal(soft.mask > 0, hit)


def test_order_does_not_matter_but_for_rounding():
    view, points = camera(), cloud(200)
    one, other = (dp.soft_splat(p, view, softness=0.05) for p in (points, points.flip(1)))
    assert_close(one.depth, other.depth, scale=100)
    assert_close(one.coverage, other.coverage)


def test_empty_clouds_and_points_behind_the_camera_leave_empty_maps():
    view = camera(torch.float32)
    behind = torch.tensor([[[0.0, 0.0, -9.0]]]).expand(
        2, 5, 3
    )  # behind the first camera, beside the second's frame
    for points, lengths in (
        (torch.zeros(2, 0, 3), None),
        (torch.zeros(2, 5, 3), torch.tensor([0, 0])),
        (behind, None),
        (torch.full((2, 5, 3), torch.nan), torch.tensor([0, 0])),
    ):
        points = points.clone().requires_grad_()
        soft = dp.soft_splat(points, view, lengths=lengths)
        assert soft.depth.shape == (2, 2, 14, 17)
        assert torch.isinf(soft.depth).all()
        assert (soft.coverage == 0).all()
        (gradient,) = torch.autograd.grad(soft.coverage.sum(), points)
        assert (gradient == 0).all()
    assert dp.soft_splat(torch.zeros(0, 5, 3), view).depth.shape == (0, 2, 14, 17)


def test_each_cloud_is_alone_in_its_batch():
    points, view = cloud(50, torch.float32, batch=4), camera(torch.float32)
    whole = dp.soft_splat(points, view)
    for b in range(4):
        alone = dp.soft_splat(points[b : b + 1], view)
        assert torch.equal(alone.depth[0], whole.depth[b])
        assert torch.equal(alone.coverage[0], whole.coverage[b])


@pytest.mark.parametrize("name", ["radius", "softness"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_sizes_that_are_none_are_refused(name, value):
    with pytest.raises(ValueError, match=f"soft_splat: '{name}' must be positive and finite; got"):
        dp.soft_splat(torch.zeros(1, 3, 3), camera(torch.float32), **{name: value})
