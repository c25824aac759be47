"""Visibility without a mesh: the kernel against the reference implementation, and scenes with known answers."""

import math

import pytest
import torch
from torch import Tensor

import diffpoint as dp
from diffpoint import reference
from diffpoint._horizon import BIAS, FILTERS, REACH
from diffpoint.visibility import METHODS

HEIGHT, WIDTH = 40, 48


def cameras(dtype: torch.dtype) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.3, 0.8, -2.0], [2.0, 0.3, 0.4]], dtype=dtype)
    eyes = eyes + 0.1 * torch.arange(2, dtype=dtype)[:, None, None]
    camera = dp.PinholeCamera.look_at(eyes, focal_px=60.0, height=HEIGHT, width=WIDTH)
    K = camera.K.clone()
    K[..., 1, 1] *= 0.8  # pixels that are no squares
    return dp.PinholeCamera(K, camera.cam_from_world, HEIGHT, WIDTH)


def spheres(count: int, dtype: torch.dtype, seed: int = 0) -> Tensor:
    """Two clouds (2, count, 3), uniform on a sphere of radius 0.45 around the origin."""
    generator = torch.Generator().manual_seed(seed)
    way = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    return (0.45 * way / way.norm(dim=-1, keepdim=True)).to(dtype)


def front_of_spheres(points: Tensor, camera: dp.PinholeCamera) -> Tensor:
    """(B, V, N): a point of a sphere around the origin is visible if its normal, itself, looks at the eye."""
    eyes = camera.position[:, :, None]
    return ((eyes - points[:, None]) * points[:, None]).sum(-1) > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lengths", [None, (300, 41), (0, 300)])
def test_the_horizon_equals_the_reference_implementation(dtype, lengths):
    camera, points = cameras(dtype), spheres(300, dtype)
    points[0, :9] += torch.tensor([0.0, 0.0, 9.0], dtype=dtype)  # out of a frame or behind a camera
    lengths = None if lengths is None else torch.tensor(lengths)
    visible = dp.visible_points(
        points, camera, method="horizon", radius=REACH, tolerance=0.4, lengths=lengths
    )
    expected = reference.visible_points(
        points,
        camera.K,
        camera.cam_from_world,
        (HEIGHT, WIDTH),
        filters=torch.tensor(FILTERS, dtype=dtype),
        radius=REACH,
        limit=math.log(0.4 / 0.6) - BIAS,
        lengths=lengths,
    )
    # Rounding moves a point over the border of a cell or a sector now and then, in single precision.
    differing = (visible != expected).sum()
    assert differing == 0 if dtype == torch.float64 else differing <= 6
    assert visible.any()
    assert not visible.all()


@pytest.mark.parametrize("count", [512, 2048, 6000])
@pytest.mark.parametrize("size", [28, 224])
def test_the_defaults_of_the_horizon_hold_for_any_number_of_points_and_pixels(count, size):
    camera = cameras(torch.float32).resize(size, size)
    points = spheres(count, torch.float32)
    expected = front_of_spheres(points, camera)
    visible = dp.visible_points(points, camera, method="horizon")
    assert (visible & ~expected).sum() < 0.03 * visible.sum()
    assert (visible & expected).sum() > 0.65 * expected.sum()  # the limb of a sphere is hard


@pytest.mark.parametrize("method", ["horizon", "hpr"])
def test_the_far_side_of_a_sphere_is_hidden_where_the_zbuffer_shows_it(method):
    camera, points = cameras(torch.float32).resize(112, 112), spheres(1500, torch.float32)
    expected = front_of_spheres(points, camera)
    naive = dp.visible_points(points, camera)
    assert (naive & ~expected).sum() > 0.3 * naive.sum()
    visible = dp.visible_points(points, camera, method=method)
    assert (visible & ~expected).sum() < 0.1 * visible.sum()
    assert (visible & expected).sum() > 0.3 * expected.sum()


@pytest.mark.parametrize("method", METHODS)
def test_a_slanted_plane_hides_little_of_itself(method):
    """Nothing stands before a plane: what follows its slope shows it whole, the others their share."""
    generator = torch.Generator().manual_seed(3)
    plane = torch.rand(1, 900, 3, generator=generator) - 0.5
    plane[..., 2] = 0.8 * plane[..., 0]
    camera = dp.PinholeCamera.look_at((0, 0.2, -2), focal_px=60.0, height=HEIGHT, width=WIDTH)
    share = dp.visible_points(plane, camera, method=method).float().mean()
    least = {"horizon": 0.9, "hpr": 0.97}.get(method, 0.05)
    assert share > least


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_points_and_points_behind_the_camera(method, count):
    camera = cameras(torch.float32)
    points = spheres(5, torch.float32)[:, :count] * 0.5
    visible = dp.visible_points(points, camera, method=method)
    assert visible.shape == (2, 2, count)
    if count == 1:
        assert visible.all()
    away = dp.visible_points(points + 50.0, camera, method=method)
    assert not away.any()


@pytest.mark.parametrize("method", METHODS)
def test_collapsed_and_collinear_clouds(method):
    camera = cameras(torch.float32)
    same = torch.full((2, 40, 3), 0.1)
    line = torch.linspace(-0.3, 0.3, 40)[:, None] * torch.tensor([1.0, 1.0, 0.2]) * torch.ones(2, 1, 1)
    assert dp.visible_points(same, camera, method=method).any(-1).all()
    if method == "horizon":
        assert dp.visible_points(same, camera, method=method).all()
    assert dp.visible_points(line, camera, method=method).any(-1).all()


@pytest.mark.parametrize("method", METHODS)
def test_the_same_input_gives_the_same_bits_however_it_is_batched(method):
    camera, points = cameras(torch.float32), spheres(700, torch.float32)
    visible = dp.visible_points(points, camera, method=method)
    assert torch.equal(visible, dp.visible_points(points, camera, method=method))
    for b in range(2):
        alone = dp.visible_points(points[b : b + 1], camera[b, 1], method=method)
        assert torch.equal(visible[b, 1], alone[0, 0])


def test_more_tolerance_keeps_more_points():
    camera, points = cameras(torch.float32), spheres(700, torch.float32)
    strict, lenient = (dp.visible_points(points, camera, method="horizon", tolerance=t) for t in (0.05, 0.8))
    assert (strict & ~lenient).sum() == 0
    assert strict.sum() < lenient.sum()


def test_the_horizon_does_not_depend_on_the_unit_of_length():
    camera, points = cameras(torch.float64), spheres(400, torch.float64)
    moved = camera.cam_from_world.clone()
    moved[..., :3, 3] *= 1000
    large = dp.PinholeCamera(camera.K, moved, HEIGHT, WIDTH)
    small_world = dp.visible_points(points, camera, method="horizon")
    assert torch.equal(small_world, dp.visible_points(1000 * points, large, method="horizon"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "cone"}, "'method' must be one of 'zbuffer', 'horizon', 'hpr'; got 'cone'"),
        ({"radius": -1.0}, "'radius' must be a finite number"),
        ({"tolerance": math.nan}, "'tolerance' must be a finite number"),
        ({"lengths": torch.tensor([9, 1])}, r"'lengths' must lie in \[0, 5\]"),
        ({"lengths": torch.tensor([5])}, r"'lengths' must have shape \(2,\)"),
    ],
)
def test_mistakes_are_named(arguments, message):
    arguments = {"method": "horizon", **arguments}
    with pytest.raises(ValueError, match=message):
        dp.visible_points(spheres(5, torch.float32), cameras(torch.float32), **arguments)


def test_sample_view_and_the_front_constraint_take_any_visibility():
    camera = cameras(torch.float32)
    points = spheres(300, torch.float32).requires_grad_()
    visible = dp.visible_points(points, camera, method="horizon")
    sample = dp.sample_view(points, visible)
    assert torch.equal(sample.lengths, visible.sum(-1))
    assert torch.equal(sample.points[1, 0, : sample.lengths[1, 0]], points[1, visible[1, 0]])
    (gradient,) = torch.autograd.grad(sample.points.sum(), points)
    assert torch.equal(gradient[..., 0], visible.sum(1).float())
    from_splat = dp.sample_view(points, dp.splat_depth(points, camera))
    from_flags = dp.sample_view(points, dp.visible_points(points, camera))
    assert torch.equal(from_splat.index, from_flags.index)

    target = dp.splat_depth(0.9 * spheres(4000, torch.float32, seed=1), camera).depth
    sets = dp.front_sets(points, camera, target, visibility="horizon")
    assert torch.equal(sets.predicted_lengths, visible.sum(-1))
    paper, better = (
        dp.front_constraint(points, camera, target, visibility=v).item() for v in ("zbuffer", "horizon")
    )
    assert paper == dp.front_constraint(points, camera, target).item()
    assert better < paper  # the far side, which the z-buffer lets through, is far from the target


def test_sample_view_refuses_flags_that_are_none():
    points = spheres(10, torch.float32)
    with pytest.raises(
        TypeError, match=r"or of visible_points \(a bool tensor\); got a tensor of torch.float32"
    ):
        dp.sample_view(points, torch.ones(2, 1, 10))
    with pytest.raises(ValueError, match=r"'splat' must have shape \(B, V, N\)"):
        dp.sample_view(points, torch.ones(2, 10, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"'points' must have shape \(2, 9, 3\) to match 'splat'"):
        dp.sample_view(points, torch.ones(2, 1, 9, dtype=torch.bool))
