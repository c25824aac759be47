"""The projection losses: against their plain twins, and what they tell points in each direction."""

import pytest
import torch

import diffpoint as dp
from diffpoint import reference_projection as twins
from diffpoint.testing import assert_close, check_gradients, tie_free_clouds

DTYPES = (torch.float32, torch.float64)


def camera(dtype: torch.dtype = torch.float64) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=14, width=16)


def scene(dtype: torch.dtype = torch.float64, count: int = 80) -> tuple[torch.Tensor, ...]:
    """Predicted clouds, logits of their points' existence, and depth maps of other clouds."""
    truth = tie_free_clouds(2, 120, camera(), seed=1, dtype=dtype) * 0.8
    points = tie_free_clouds(2, count, camera(), seed=2, dtype=dtype, margin=3e-4)
    logits = torch.randn(2, count, generator=torch.Generator().manual_seed(0), dtype=dtype)
    return points.requires_grad_(), logits.requires_grad_(), dp.splat_depth(truth, camera(dtype)).depth


def matrices(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    view = camera(dtype)
    return view.K.expand(2, 2, 3, 3), view.cam_from_world.expand(2, 2, 4, 4)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("with_logits", [False, True])
@pytest.mark.parametrize("upsample", [1, 3])
def test_lins_loss_equals_its_twin(dtype, with_logits, upsample):
    points, logits, depth = scene(dtype)
    options = {"logits": logits if with_logits else None, "mask_weight": 0.3, "upsample": upsample}
    ours = dp.projection_loss(points, camera(dtype), depth, reduction="none", **options)
    theirs = twins.projection_loss(points, *matrices(dtype), depth, **options)
    assert_close(ours, theirs, scale=10)
    mean = dp.projection_loss(points, camera(dtype), depth, **options)
    assert_close(mean, ours.mean())
    leaves = (points, logits) if with_logits else (points,)
    for x, y in zip(*(torch.autograd.grad(t.sum(), leaves) for t in (ours, theirs)), strict=True):
        assert (y != 0).any()
        assert_close(x, y, scale=20)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_soft_loss_equals_its_twin(dtype):
    points, _, depth = scene(dtype)
    options = {"radius": 2.3, "softness": 0.05, "mask_weight": 0.2}
    ours = dp.soft_projection_loss(points, camera(dtype), depth, reduction="none", **options)
    theirs = twins.soft_projection_loss(points, *matrices(dtype), depth, **options)
    assert_close(ours, theirs, scale=50)
    x, y = (torch.autograd.grad(t.sum(), points)[0] for t in (ours, theirs))
    assert_close(x, y, scale=500)


def test_losses_pass_gradcheck():
    points, logits, depth = scene(count=15)
    for upsample in (1, 2):
        check_gradients(
            lambda p, s, u=upsample: dp.projection_loss(
                p, camera(), depth, logits=s, mask_weight=0.5, upsample=u
            ),
            points,
            logits,
        )
    check_gradients(lambda p: dp.soft_projection_loss(p, camera(), depth, softness=0.1), points)


def test_only_the_soft_loss_moves_points_sideways():
    """In the camera's frame: x and y of the gradient of Lin's loss are zero to the last bit, whatever its options."""
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 8], [0, 30.0, 7], [0, 0, 1]]), torch.eye(4), 14, 16)
    random = torch.Generator().manual_seed(3)
    truth = torch.rand(1, 500, 3, generator=random) * 0.4 + torch.tensor([-0.2, -0.2, 1.5])
    points = (
        torch.rand(1, 500, 3, generator=random) * 0.8 + torch.tensor([-0.4, -0.4, 1.5])
    ).requires_grad_()
    logits = torch.randn(1, 500, generator=random).requires_grad_()
    depth = dp.splat_depth(truth, view).depth
    for options in ({}, {"upsample": 5}, {"logits": logits, "mask_weight": 1.0, "upsample": 2}):
        (gradient,) = torch.autograd.grad(dp.projection_loss(points, view, depth, **options), points)
        assert (gradient[..., :2] == 0).all()
        assert (gradient[..., 2] != 0).any()
    (soft,) = torch.autograd.grad(dp.soft_projection_loss(points, view, depth), points)
    assert soft[..., :2].norm() / soft.norm() > 0.2


@pytest.mark.parametrize("at", [(-0.48, -0.1), (0.49, 0.3), (0.0, -0.49), (-0.55, 0.0), (0.52, -0.52)])
def test_the_soft_loss_pulls_points_from_wherever_they_are_to_the_silhouette(at):
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
    """Whether the points exist or not: it deletes them and brings them back."""
    view = dp.PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
    depth = torch.full((1, 1, 8, 8), torch.inf)
    depth[..., :, :4] = 2.0
    left, right = view.position + torch.tensor([[0.5, 0, 2.0], [-0.5, 0, 2.0]])  # the camera's right is -x
    points = torch.stack((left, right))[None]
    logits = torch.full((1, 2), logit, requires_grad=True)
    loss = dp.projection_loss(points, view, depth, logits=logits, mask_weight=1.0)
    (gradient,) = torch.autograd.grad(loss, logits)
    assert gradient[0, 0] < 0 < gradient[0, 1]


def test_points_that_do_not_exist_are_not_rendered():
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
def test_options_that_are_none_are_refused(options, message):
    points, _, depth = scene(torch.float32)
    with pytest.raises(ValueError, match=message):
        dp.projection_loss(points, camera(torch.float32), depth, **options)
