"""The projection losses and the soft splat: directions of their gradients, limits and special cases."""

import pytest
import torch

import diffpoint as dp
from diffpoint import reference_projection
from diffpoint.testing import assert_close, tie_free_clouds


def camera(dtype: torch.dtype = torch.float64) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=14, width=16)


def scene(dtype: torch.dtype = torch.float64, count: int = 80) -> tuple[torch.Tensor, ...]:
    """Predicted clouds, occupancy logits of their points, and depth maps of other clouds."""
    target = tie_free_clouds(2, 120, camera(), seed=1, dtype=dtype) * 0.8
    points = tie_free_clouds(2, count, camera(), seed=2, dtype=dtype, margin=3e-4)
    logits = torch.randn(2, count, generator=torch.Generator().manual_seed(0), dtype=dtype)
    return points.requires_grad_(), logits.requires_grad_(), dp.splat_depth(target, camera(dtype)).depth


def test_only_the_soft_loss_moves_points_sideways():
    """In the camera's frame: x and y of the gradient of Lin's loss are zero to the last bit, whatever its options."""
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 8], [0, 30.0, 7], [0, 0, 1]]), torch.eye(4), 14, 16)
    random = torch.Generator().manual_seed(3)
    target = torch.rand(1, 500, 3, generator=random) * 0.4 + torch.tensor([-0.2, -0.2, 1.5])
    points = (
        torch.rand(1, 500, 3, generator=random) * 0.8 + torch.tensor([-0.4, -0.4, 1.5])
    ).requires_grad_()
    logits = torch.randn(1, 500, generator=random).requires_grad_()
    depth = dp.splat_depth(target, view).depth
    for options in ({}, {"upsample": 5}, {"logits": logits, "mask_weight": 1.0, "upsample": 2}):
        (gradient,) = torch.autograd.grad(dp.projection_loss(points, view, depth, **options), points)
        assert (gradient[..., :2] == 0).all()
        assert (gradient[..., 2] != 0).any()
    (soft,) = torch.autograd.grad(dp.soft_projection_loss(points, view, depth), points)
    assert soft[..., :2].norm() / soft.norm() > 0.2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_lone_cloud_in_parts_has_the_soft_gradients_of_one_among_many(dtype):
    """A lone cloud is divided among the threads; of eighty each thread takes whole ones."""
    cloud = torch.rand(1, 4500, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) - 0.5
    lengths = torch.tensor([4300])

    def gradient(copies: int) -> torch.Tensor:
        points = cloud.repeat(copies, 1, 1).requires_grad_()
        soft = dp.soft_splat(points, camera(dtype)[0], lengths=lengths.expand(copies))
        (found,) = torch.autograd.grad((soft.mask * soft.depth.clamp(max=9)).sum(), points)
        return found

    alone = gradient(1)
    assert (alone[0, :4300].abs().sum(-1) > 0).float().mean() > 0.9
    assert (alone[0, 4300:] == 0).all()
    assert torch.equal(gradient(80), alone.expand(80, -1, -1))


@pytest.mark.parametrize("at", [(-0.48, -0.1), (0.49, 0.3), (0.0, -0.49), (-0.55, 0.0), (0.52, -0.52)])
def test_the_soft_loss_moves_points_towards_the_silhouette(at):
    """In the middle of the background, at the frame's edge, and just beyond it."""
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 15], [0, 30.0, 15], [0, 0, 1]]), torch.eye(4), 30, 30)
    depth = torch.full((1, 1, 30, 30), torch.inf)
    depth[..., 13:17, 13:17] = 1.0
    point = torch.tensor([[[*at, 1.0]]], requires_grad=True)
    for radius in (2.0, 6.0):
        (gradient,) = torch.autograd.grad(dp.soft_projection_loss(point, view, depth, radius=radius), point)
        away = point.detach()[0, 0, :2]
        assert (gradient[0, 0, :2] * away).sum() > 0.3 * gradient[0, 0, :2].norm() * away.norm(), radius


@pytest.mark.parametrize("logit", [2.0, -2.0])
def test_the_mask_term_raises_logits_inside_the_silhouette_and_lowers_those_outside(logit):
    """Whether the points are rendered or not: it removes them and adds them again."""
    view = dp.PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
    depth = torch.full((1, 1, 8, 8), torch.inf)
    depth[..., :, :4] = 2.0
    left, right = view.position + torch.tensor([[0.5, 0, 2.0], [-0.5, 0, 2.0]])  # the camera's right is -x
    points = torch.stack((left, right))[None]
    logits = torch.full((1, 2), logit, requires_grad=True)
    loss = dp.projection_loss(points, view, depth, logits=logits, mask_weight=1.0)
    (gradient,) = torch.autograd.grad(loss, logits)
    assert gradient[0, 0] < 0 < gradient[0, 1]


def test_points_with_a_negative_logit_are_not_rendered():
    points, logits, depth = scene(torch.float32)
    view = camera(torch.float32)
    few = logits.clone().detach()
    few[:, 20:] = -1.0
    few[:, :20] = 1.0
    assert_close(
        dp.projection_loss(points, view, depth, logits=few), dp.projection_loss(points[:, :20], view, depth)
    )
    none = torch.full_like(few, -1.0).requires_grad_()
    loss = dp.projection_loss(points, view, depth, logits=none, mask_weight=1.0)
    gradients = torch.autograd.grad(loss, (points, none), materialize_grads=True)
    assert (gradients[0] == 0).all()
    assert (gradients[1] != 0).any()


def test_a_larger_map_shows_points_that_share_a_pixel():
    """Two points of one pixel, in different cells of it: the hidden one gets a gradient once it is the nearest."""
    view = dp.PinholeCamera(torch.tensor([[10.0, 0, 4], [0, 10.0, 4], [0, 0, 1]]), torch.eye(4), 8, 8)
    points = torch.tensor([[[0.02, 0.02, 1.0], [0.16, 0.16, 2.0], [0.06, 0.06, 1.1]]])
    assert (dp.project(points, view).pixels.long() == 4).all()
    depth = torch.full((1, 1, 8, 8), 3.0)
    once, larger = (dp.projection_loss(points, view, depth, upsample=u) for u in (1, 4))
    assert once == larger == 2.0  # the nearest of the block is the nearest of the pixel


def test_an_empty_map_and_an_empty_cloud_are_defined():
    points, logits, depth = scene(torch.float32)
    view = camera(torch.float32)
    nothing = torch.full_like(depth, torch.inf)
    assert dp.projection_loss(points, view, nothing) == 0
    for soft in (
        dp.soft_projection_loss(points, view, nothing),
        dp.soft_projection_loss(points[:, :0], view, depth),
        dp.projection_loss(points[:, :0], view, depth, logits=logits[:, :0], mask_weight=1.0),
    ):
        assert torch.isfinite(soft)
        assert soft > 0
        (gradient,) = torch.autograd.grad(soft, points, materialize_grads=True)
        assert torch.isfinite(gradient).all()
    assert dp.projection_loss(points[:, :0], view, depth) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"upsample": 0}, "'upsample' must be a whole number of at least 1; got 0"),
        ({"upsample": 1.5}, "'upsample' must be a whole number of at least 1; got 1.5"),
        ({"mask_weight": -1.0}, "'mask_weight' must be a finite number of at least 0; got -1.0"),
        ({"logits": torch.zeros(2, 3)}, r"'logits' must have shape \(2, 80\); got \(2, 3\)"),
        ({"logits": torch.full((2, 80), torch.nan)}, "'logits' must be finite"),
        ({"reduction": "sum"}, "'reduction' must be one of"),
    ],
)
def test_wrong_options_are_refused(options, message):
    points, _, depth = scene(torch.float32)
    with pytest.raises(ValueError, match=message):
        dp.projection_loss(points, camera(torch.float32), depth, **options)


def soft_camera(dtype: torch.dtype = torch.float64) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=14, width=17)


def cloud(count: int, dtype: torch.dtype = torch.float64, batch: int = 2) -> torch.Tensor:
    random = torch.Generator().manual_seed(count)
    return (torch.rand(batch, count, 3, generator=random, dtype=dtype) - 0.5).requires_grad_()


def test_only_the_soft_splat_has_a_gradient_to_x_and_y():
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 8], [0, 30.0, 7], [0, 0, 1]]), torch.eye(4), 14, 16)
    points = torch.tensor([[[0.02, 0.01, 1.5], [0.05, 0.02, 1.7]]], requires_grad=True)
    for depth, sideways in ((dp.splat_depth(points, view).depth, 0), (dp.soft_splat(points, view).depth, 1)):
        seen = depth[torch.isfinite(depth)].square().sum()
        (gradient,) = torch.autograd.grad(seen, points)
        assert bool((gradient[..., :2] != 0).any()) == sideways
        assert (gradient[..., 2] != 0).any()


def test_a_small_softness_and_radius_give_the_hard_splat():
    view, points = soft_camera(), cloud(300)
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
    view, points = soft_camera(), cloud(200)
    soft = dp.soft_splat(points, view, radius=4.0, softness=0.1)
    z = dp.project(points, view).depth
    hit = torch.isfinite(soft.depth)
    for extreme, sign in ((z.amin(2), 1), (z.amax(2), -1)):
        assert (sign * (soft.depth - extreme[..., None, None])[hit] >= -1e-12).all()
    assert ((soft.mask >= 0) & (soft.mask <= 1)).all()
    assert torch.equal(soft.mask > 0, hit)


def test_the_order_of_the_points_changes_only_rounding():
    view, points = soft_camera(), cloud(200)
    one, other = (dp.soft_splat(p, view, softness=0.05) for p in (points, points.flip(1)))
    assert_close(one.depth, other.depth, scale=100)
    assert_close(one.coverage, other.coverage)


def test_empty_clouds_and_points_behind_the_camera_leave_empty_maps():
    view = soft_camera(torch.float32)
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


def test_the_clouds_of_a_batch_do_not_affect_each_other():
    points, view = cloud(50, torch.float32, batch=4), soft_camera(torch.float32)
    whole = dp.soft_splat(points, view)
    for b in range(4):
        alone = dp.soft_splat(points[b : b + 1], view)
        assert torch.equal(alone.depth[0], whole.depth[b])
        assert torch.equal(alone.coverage[0], whole.coverage[b])


@pytest.mark.parametrize("name", ["radius", "softness"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_radius_and_softness_must_be_positive(name, value):
    with pytest.raises(ValueError, match=f"soft_splat: '{name}' must be positive and finite; got"):
        dp.soft_splat(torch.zeros(1, 3, 3), soft_camera(torch.float32), **{name: value})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_footprint_that_is_only_rounding_does_not_decide_a_depth(dtype):
    """Two points: one on the middle of a pixel, and one far in front of it whose footprint ends there.

    Rounding gives some of the latter a footprint of 1e-14 on that pixel; in the soft minimum it outweighed the other.
    """
    K = torch.tensor([[3.0, 0, 1.5], [0, 3, 0.5], [0, 0, 1]], dtype=dtype)
    camera = dp.PinholeCamera(K, torch.eye(4, dtype=dtype), 1, 3)
    front = torch.linspace(1, 2, 2000, dtype=dtype)
    zero = torch.zeros_like(front)
    ends = torch.stack(
        (front / 3, zero, front), -1
    )  # at u = 2.5, one pixel from the centre of the middle one
    behind = torch.stack((zero, zero, front + 2), -1)
    points = torch.stack((behind, ends), 1).requires_grad_()
    soft = dp.soft_splat(points, camera, radius=1.0, softness=0.01)
    assert torch.equal(soft.depth[:, 0, 0, 1], behind[:, 2])
    assert torch.equal(soft.coverage[:, 0, 0, 1], torch.ones_like(front))
    twin, coverage = reference_projection.soft_splat(
        points.detach(), K[None, None], camera.cam_from_world[None, None], (1, 3), radius=1.0, softness=0.01
    )
    assert torch.equal(coverage[:, 0, 0, 1], torch.ones_like(front))
    assert torch.equal(twin[:, 0, 0, 1], behind[:, 2])
    (gradient,) = torch.autograd.grad(soft.depth[..., 1].sum() + soft.coverage[..., 1].sum(), points)
    assert not gradient[:, 1].any()
    # and a footprint that is more than rounding counts
    nearer = ends * torch.tensor([1 - 1e-2, 1, 1], dtype=dtype)
    points = torch.stack((behind, nearer), 1)
    assert (dp.soft_splat(points, camera, radius=1.0, softness=0.01).depth[:, 0, 0, 1] < front + 0.1).all()
