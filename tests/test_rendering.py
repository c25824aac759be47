"""Splatting, view sampling, projection and reprojection: against the plain torch twins, and against arithmetic."""

import pytest
import torch
from torch import Tensor

import diffpoint as dp
from diffpoint import reference
from diffpoint.testing import assert_close, boundary_points, check_gradients, tie_free_clouds

DTYPES = (torch.float32, torch.float64)
HEIGHT, WIDTH = 14, 18


def cameras(dtype: torch.dtype, batch: int = 2, views: int = 3) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2], [-1.2, 0.5, 1.5]], dtype=dtype)
    eyes = eyes[:views] + 0.1 * torch.arange(batch, dtype=dtype)[:, None, None]
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=HEIGHT, width=WIDTH)


def clouds(dtype: torch.dtype, count: int = 60, seed: int = 0) -> Tensor:
    return tie_free_clouds(2, count, cameras(torch.float64), seed=seed, dtype=dtype)


def leaves(*tensors: Tensor) -> list[Tensor]:
    return [t.detach().clone().requires_grad_() for t in tensors]


def gradients(outputs: Tensor | tuple[Tensor, ...], inputs: list[Tensor], seed: int = 1) -> list[Tensor]:
    """Gradients of a fixed random weighting of the finite part of the outputs."""
    generator = torch.Generator().manual_seed(seed)
    outputs = (outputs,) if isinstance(outputs, Tensor) else outputs
    total = torch.zeros((), dtype=outputs[0].dtype)
    for output in outputs:
        weights = torch.rand(output.shape, generator=generator, dtype=output.dtype) + 0.5
        total = total + (torch.where(torch.isfinite(output), output, 0.0) * weights).sum()
    return list(torch.autograd.grad(total, inputs))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 1.7])
@pytest.mark.parametrize("lengths", [None, (60, 23), (0, 60)])
def test_splat_equals_its_twin(dtype, radius, lengths):
    camera = cameras(dtype)
    lengths = None if lengths is None else torch.tensor(lengths)
    points, K, cam_from_world = leaves(clouds(dtype), camera.K, camera.cam_from_world)
    moving = dp.PinholeCamera(K, cam_from_world, HEIGHT, WIDTH)
    splat = dp.splat_depth(points, moving, radius=radius, lengths=lengths)
    depth, index, visible = reference.splat_depth(
        points, K, cam_from_world, HEIGHT, WIDTH, radius=radius, lengths=lengths
    )
    assert torch.equal(splat.index, index)
    assert torch.equal(splat.visible, visible)
    assert_close(splat.depth, depth)
    inputs = [points, cam_from_world]
    for ours, theirs in zip(gradients(splat.depth, inputs), gradients(depth, inputs), strict=True):
        assert_close(ours[..., :3, :], theirs[..., :3, :], scale=50)


@pytest.mark.parametrize("radius", [0.0, 1.2])
def test_splat_passes_gradcheck_for_points_and_extrinsics(radius):
    camera = cameras(torch.float64, batch=1, views=2)
    points = tie_free_clouds(1, 20, camera, seed=3)

    def rendered(points, extrinsics):
        moving = dp.PinholeCamera(camera.K, with_last_row(extrinsics, camera.cam_from_world), HEIGHT, WIDTH)
        depth = dp.splat_depth(points, moving, radius=radius).depth
        return torch.where(torch.isfinite(depth), depth, 0.0)

    check_gradients(rendered, points, camera.cam_from_world[..., :3, :])


def with_last_row(rows: Tensor, matrix: Tensor) -> Tensor:
    """A camera matrix whose last row stays fixed, as finite differences of the others need it."""
    return torch.cat((rows, matrix[..., -1:, :]), dim=-2)


def test_nearest_depth_then_lowest_index_wins():
    camera = dp.PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
    behind_then_twins = torch.tensor(
        [[[0.1, -0.1, 0.5], [0.1, -0.1, 0.2], [0.1, -0.1, 0.2], [0.1, -0.1, 0.9]]]
    )
    splat = dp.splat_depth(behind_then_twins, camera)
    assert splat.visible.tolist() == [[[False, True, False, False]]]
    assert splat.index[0, 0, 2, 1] == 1
    assert splat.depth[0, 0, 2, 1] == pytest.approx(2.2)
    assert (splat.index >= 0).sum() == 1


def test_pixels_cover_half_open_squares():
    """Pixel p covers [p, p + 1): the left and upper borders belong to it, the image's right and lower do not."""
    camera = dp.PinholeCamera(torch.eye(3), torch.eye(4), 2, 3)
    on_borders = torch.tensor(
        [[[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [2.9999, 1.0, 1.0], [3.0, 1.0, 1.0], [0.0, 2.0, 1.0]]]
    )
    splat = dp.splat_depth(on_borders, camera)
    assert splat.index[0, 0].tolist() == [[0, -1, -1], [-1, 1, 2]]
    assert splat.visible[0, 0].tolist() == [True, True, True, False, False]


def test_points_behind_the_camera_are_not_drawn():
    camera = dp.PinholeCamera(torch.eye(3), torch.eye(4), 2, 2)
    points = torch.tensor([[[0.5, 0.5, -1.0], [-0.5, -0.5, -1.0], [0.5, 0.5, 0.0]]])
    for radius in (0.0, 2.0):
        splat = dp.splat_depth(points, camera, radius=radius)
        assert torch.isinf(splat.depth).all()
        assert (splat.index == -1).all()
        assert not splat.visible.any()


def test_a_radius_covers_the_pixels_whose_centre_it_reaches():
    camera = dp.PinholeCamera(torch.eye(3), torch.eye(4), 5, 5)
    centre = torch.tensor([[[2.5, 2.5, 1.0]]])
    cross = (dp.splat_depth(centre, camera, radius=1.0).index[0, 0] == 0).int()
    assert cross.tolist() == [
        [0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0],
        [0, 1, 1, 1, 0],
        [0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0],
    ]
    outside = torch.tensor([[[-0.4, 2.5, 1.0]]])
    touched = dp.splat_depth(outside, camera, radius=1.0).index[0, 0] == 0
    assert touched.nonzero().tolist() == [[2, 0]]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("radius", [0.5, 1.0, 2.0])
def test_points_on_borders_and_in_middles_of_pixels_cover_what_their_twins_cover(dtype, radius):
    """And a few roundings beside them, in the map and outside; all at one depth, so that only the index tells."""
    camera = dp.PinholeCamera(torch.eye(3, dtype=dtype), torch.eye(4, dtype=dtype), 3, 5)
    generator = torch.Generator().manual_seed(0)
    halves = torch.randint(-3, 14, (2, 40, 2), generator=generator) / 2
    beside = torch.randint(-2, 3, halves.shape, generator=generator) * torch.finfo(dtype).eps / 4
    points = torch.cat((halves.to(dtype) + beside, torch.ones(2, 40, 1)), dim=-1)
    splat = dp.splat_depth(points, camera, radius=radius)
    K, cam_from_world = camera.expand(2, 1).K, camera.expand(2, 1).cam_from_world
    _, index, visible = reference.splat_depth(points, K, cam_from_world, 3, 5, radius=radius)
    assert torch.equal(splat.index, index)
    assert torch.equal(splat.visible, visible)


@pytest.mark.parametrize("shape", [(), (3,), (1, 3), (2, 3)])
def test_cameras_are_shared_or_per_cloud(shape):
    points = clouds(torch.float32)
    whole = cameras(torch.float32)
    camera = {(): whole[0, 0], (3,): whole[0], (1, 3): whole[:1], (2, 3): whole}[shape]
    splat = dp.splat_depth(points, camera)
    for b in range(2):
        alone = dp.splat_depth(points[b : b + 1], camera if len(shape) < 2 else camera[min(b, shape[0] - 1)])
        assert torch.equal(splat.depth[b], alone.depth[0])


def test_a_rigid_motion_of_world_and_camera_changes_nothing():
    camera = cameras(torch.float64)
    points = clouds(torch.float64)
    angle = torch.tensor(0.7, dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[0, 0] = motion[2, 2] = angle.cos()
    motion[0, 2], motion[2, 0] = angle.sin(), -angle.sin()
    motion[:3, 3] = torch.tensor([0.3, -0.2, 0.1])
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    seen = dp.PinholeCamera(camera.K, camera.cam_from_world @ torch.linalg.inv(motion), HEIGHT, WIDTH)
    before, after = dp.splat_depth(points, camera), dp.splat_depth(moved, seen)
    assert torch.equal(before.index, after.index)
    assert_close(after.depth, before.depth)


def test_permuting_the_points_permutes_the_result():
    camera, points = cameras(torch.float32), clouds(torch.float32)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    before, after = dp.splat_depth(points, camera), dp.splat_depth(points[:, order], camera)
    assert torch.equal(before.depth, after.depth)
    assert torch.equal(before.visible[..., order], after.visible)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sample_view_equals_its_twin(dtype):
    camera = cameras(dtype)
    (points,) = leaves(clouds(dtype, count=200, seed=5))
    splat = dp.splat_depth(points, camera, lengths=torch.tensor([200, 31]))
    sample = dp.sample_view(points, splat)
    sampled, index, lengths = reference.sample_view(points, splat.visible)
    assert torch.equal(sample.index, index)
    assert torch.equal(sample.lengths, lengths)
    assert torch.equal(sample.points, sampled)
    assert lengths.min() < lengths.max() == sample.points.shape[2]
    (ours,), (theirs,) = gradients(sample.points, [points]), gradients(sampled, [points])
    assert_close(ours, theirs)
    hidden = ~splat.visible.any(1)
    assert hidden.any()
    assert (ours[hidden] == 0).all()


def test_sample_view_passes_gradcheck_and_takes_empty_views():
    camera = cameras(torch.float64, batch=1, views=2)
    points = tie_free_clouds(1, 15, camera, seed=2)
    check_gradients(lambda p: dp.sample_view(p, dp.splat_depth(p, camera)).points, points)
    away = dp.sample_view(points + 100.0, dp.splat_depth(points + 100.0, camera))
    assert away.points.shape == (1, 2, 0, 3)
    assert away.lengths.tolist() == [[0, 0]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_project_equals_its_twin(dtype):
    camera = cameras(dtype)
    points, K, cam_from_world = leaves(clouds(dtype), camera.K, camera.cam_from_world)
    with torch.no_grad():
        points[0, 0] = torch.tensor([0.0, 0.0, -5.0])  # behind the first camera
    moving = dp.PinholeCamera(K, cam_from_world, HEIGHT, WIDTH)
    ours, theirs = dp.project(points, moving), reference.project(points, K, cam_from_world)
    assert torch.isinf(ours.pixels[0, 0, 0]).all()
    for x, y in zip(ours, theirs, strict=True):
        assert_close(x, y, scale=20)
    inputs = [points, K, cam_from_world]
    for x, y in zip(gradients(tuple(ours), inputs), gradients(theirs, inputs), strict=True):
        assert_close(x[..., :2, :], y[..., :2, :], scale=500)


def test_project_passes_gradcheck_for_points_and_camera():
    camera = cameras(torch.float64, views=2)

    def projected(points, intrinsics, extrinsics):
        K = with_last_row(intrinsics, camera.K)
        return tuple(
            dp.project(
                points, dp.PinholeCamera(K, with_last_row(extrinsics, camera.cam_from_world), HEIGHT, WIDTH)
            )
        )

    check_gradients(
        projected, clouds(torch.float64, count=8), camera.K[..., :2, :], camera.cam_from_world[..., :3, :]
    )


def depth_maps(dtype: torch.dtype) -> Tensor:
    """Maps with holes, of different foreground counts, one of them empty."""
    camera = cameras(dtype)
    depth = dp.splat_depth(clouds(dtype, count=300, seed=8), camera, radius=0.8).depth
    depth[1, 2] = torch.inf
    return depth


@pytest.mark.parametrize("dtype", DTYPES)
def test_unproject_equals_its_twin(dtype):
    camera = cameras(dtype)
    depth, K, cam_from_world = leaves(depth_maps(dtype), camera.K, camera.cam_from_world)
    ours = dp.unproject(depth, dp.PinholeCamera(K, cam_from_world, HEIGHT, WIDTH))
    theirs = reference.unproject(depth, K, cam_from_world)
    assert torch.equal(ours.lengths, theirs[1])
    assert ours.lengths[1, 2] == 0
    assert_close(ours.points, theirs[0], scale=5)
    inputs = [depth, K, cam_from_world]
    for x, y in zip(gradients(ours.points, inputs), gradients(theirs[0], inputs), strict=True):
        assert_close(x[..., :2, :], y[..., :2, :], scale=2000)


def test_unproject_and_reproject_pass_gradcheck_for_depth_and_cameras():
    camera = cameras(torch.float64, batch=1, views=1)
    other = cameras(torch.float64, batch=1, views=2)[:, 1:]
    depth = depth_maps(torch.float64)[:1, :1]
    foreground = torch.isfinite(depth)
    keep = foreground & (torch.arange(foreground.numel()).view(foreground.shape) % 7 == 0)

    def maps(values):
        return torch.full_like(depth, torch.inf).masked_scatter(keep, values)

    def source(intrinsics, extrinsics):
        K = with_last_row(intrinsics, camera.K)
        return dp.PinholeCamera(K, with_last_row(extrinsics, camera.cam_from_world), HEIGHT, WIDTH)

    def unprojected(values, intrinsics, extrinsics):
        return dp.unproject(maps(values), source(intrinsics, extrinsics)).points

    def reprojected(values, intrinsics, extrinsics, target_extrinsics):
        target = dp.PinholeCamera(
            other.K, with_last_row(target_extrinsics, other.cam_from_world), HEIGHT, WIDTH
        )
        result = dp.reproject(maps(values), source(intrinsics, extrinsics), target)
        seen = torch.isfinite(result.depth)
        return (
            result.points,
            torch.where(seen[..., None], result.pixels, 0.0),
            torch.where(seen, result.depth, 0.0),
        )

    inputs = depth[keep], camera.K[..., :2, :], camera.cam_from_world[..., :3, :]
    check_gradients(unprojected, *inputs)
    check_gradients(reprojected, *inputs, other.cam_from_world[..., :3, :])


@pytest.mark.parametrize("dtype", DTYPES)
def test_reproject_equals_its_twin(dtype):
    source, target = cameras(dtype), cameras(dtype)[:, [1, 2, 0]].resize(11, 9)
    (depth,) = leaves(depth_maps(dtype))
    ours = dp.reproject(depth, source, target)
    theirs = reference.reproject(
        depth, (source.K, source.cam_from_world), (target.K, target.cam_from_world), (11, 9)
    )
    assert torch.equal(ours.valid, theirs[3])
    assert 0 < ours.valid.sum() < torch.isfinite(depth).sum()
    for x, y in zip(ours[:3], theirs[:3], strict=True):
        assert_close(x, y, scale=50)
    (x,), (y,) = gradients(tuple(ours[:3]), [depth]), gradients(theirs[:3], [depth])
    assert_close(x, y, scale=500)


@pytest.mark.parametrize("outputs", [(0,), (1,), (2,), (0, 2)])
def test_reproject_passes_back_the_gradient_of_a_sum_of_some_outputs(outputs):
    """A sum's gradient is one number expanded, and outputs left alone have none."""
    shape, generator = (2, 3, HEIGHT, WIDTH), torch.Generator().manual_seed(3)
    near = 1.7 + 0.6 * torch.rand(shape, generator=generator, dtype=torch.float64)  # before every target
    source, target = cameras(torch.float64), cameras(torch.float64)[:, [1, 2, 0]]
    inputs = leaves(near, source.K, source.cam_from_world, target.K, target.cam_from_world)
    depth, *matrices = inputs
    ours = dp.reproject(
        depth,
        dp.PinholeCamera(matrices[0], matrices[1], HEIGHT, WIDTH),
        dp.PinholeCamera(matrices[2], matrices[3], HEIGHT, WIDTH),
    )
    theirs = reference.reproject(
        depth, (matrices[0], matrices[1]), (matrices[2], matrices[3]), (HEIGHT, WIDTH)
    )
    assert bool(torch.isfinite(ours.pixels).all())

    def descended(results) -> list[Tensor]:
        total = torch.stack([results[i].sum() for i in outputs]).sum()
        return list(torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True))

    for x, y in zip(descended(ours), descended(theirs), strict=True):
        x, y = (g if g.shape == shape else g[..., :-1, :] for g in (x, y))
        assert_close(x, y, scale=max(1.0, 1000 * float(y.abs().max())))


def test_reprojecting_into_the_same_camera_returns_the_pixel_centres():
    camera = cameras(torch.float64)
    depth = depth_maps(torch.float64)
    result = dp.reproject(depth, camera, camera)
    foreground = torch.isfinite(depth)
    assert torch.equal(result.valid, foreground)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    centres = torch.stack((columns, rows), -1) + 0.5
    assert_close(result.pixels[foreground], centres.expand(2, 3, -1, -1, -1)[foreground].double(), scale=100)
    assert_close(result.depth[foreground], depth[foreground], scale=10)


def test_unprojected_points_splat_back_into_their_pixels():
    camera = cameras(torch.float32)
    depth = depth_maps(torch.float32)
    points, lengths = dp.unproject(depth, camera)
    for b in range(2):
        for v in range(3):
            own = points[b : b + 1, v, : lengths[b, v]]
            assert_close(dp.splat_depth(own, camera[b, v]).depth[0, 0], depth[b, v], scale=5)


@pytest.mark.parametrize("count", [0, 1])
def test_clouds_of_no_and_one_point(count):
    camera = cameras(torch.float32)
    points = torch.zeros(2, count, 3, requires_grad=True)
    splat = dp.splat_depth(points, camera)
    sample = dp.sample_view(points, splat)
    assert splat.visible.shape == (2, 3, count)
    assert (splat.index >= 0).sum() == 6 * count
    assert sample.lengths.tolist() == [[count] * 3] * 2
    assert dp.project(points, camera).pixels.shape == (2, 3, count, 2)
    (gradient,) = torch.autograd.grad(sample.points.sum(), points)
    assert (gradient == 3).all()


def test_non_contiguous_clouds_and_expanded_gradients():
    camera = cameras(torch.float32)
    points = clouds(torch.float32)
    strided = points.permute(2, 0, 1).contiguous().permute(1, 2, 0).requires_grad_()
    assert not strided.is_contiguous()
    dense = points.clone().requires_grad_()
    for result, leaf in ((dp.splat_depth(strided, camera), strided), (dp.splat_depth(dense, camera), dense)):
        torch.where(torch.isfinite(result.depth), result.depth, 0.0).sum().backward()
        dp.sample_view(leaf, result).points.sum().backward()
    assert torch.equal(strided.grad, dense.grad)


def test_the_gradient_of_a_sum_is_that_of_its_ones():
    """Behind a sum there is one number for all, which is read without a copy."""
    points, K, cam_from_world = leaves(
        clouds(torch.float64), cameras(torch.float64).K, cameras(torch.float64).cam_from_world
    )
    pixels, depth = dp.project(points, dp.PinholeCamera(K, cam_from_world, HEIGHT, WIDTH))
    inputs = [points, K, cam_from_world]
    for weight in (pixels, depth):
        one = torch.autograd.grad(weight.sum(), inputs, retain_graph=True)
        ones = torch.autograd.grad(weight, inputs, torch.ones_like(weight), retain_graph=True)
        assert all(torch.equal(a, b) for a, b in zip(one, ones, strict=True))


def test_boundary_points_are_those_that_two_renderers_may_place_differently():
    camera = cameras(torch.float32)
    points = torch.rand(2, 4000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    ours = dp.project(points, camera).pixels.floor()
    theirs = reference.project(points.double(), camera.K.double(), camera.cam_from_world.double())[0].floor()
    moved = (ours != theirs).any(-1)
    assert not (moved & ~boundary_points(points, camera, margin=1e-4)).any()


@pytest.mark.parametrize("radius", [0.0, 1.0, 1.2])
def test_a_large_cloud_in_parts_gives_the_maps_of_the_whole(radius):
    """A lone large cloud is shared out among the threads; nine of them are not. Copies of points make equal depths."""
    camera = cameras(torch.float32)[0, 0]
    few = torch.rand(1, 20_000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    points = torch.cat((few, few.flip(1)), dim=1)
    lengths = torch.tensor([39_000])
    alone = dp.splat_depth(points, camera, radius=radius, lengths=lengths)
    many = dp.splat_depth(points.expand(9, -1, -1), camera, radius=radius, lengths=lengths.expand(9))
    for x, y in zip(alone, many, strict=True):
        assert torch.equal(x.expand_as(y), y)
    assert (alone.index < 20_000).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("radius", [30.0, 3e9, 1e30])
def test_a_radius_larger_than_the_map_covers_all_of_it(dtype, radius):
    camera = cameras(dtype)
    splat = dp.splat_depth(clouds(dtype), camera, radius=radius)
    depth = dp.project(clouds(dtype), camera).depth
    assert torch.equal(splat.index, depth.argmin(-1)[..., None, None].expand(splat.index.shape))


@pytest.mark.parametrize("where", [0, 5, 64, 69])
def test_a_coordinate_that_is_not_finite_is_found_wherever_it_is(where):
    points = torch.rand(2, 70, 3) - 0.5
    points[1, where, 1] = torch.nan
    for op in (dp.splat_depth, dp.project):
        with pytest.raises(ValueError, match=rf"'points' must be finite; got nan at index \(1, {where}, 1\)"):
            op(points, cameras(torch.float32))
    padded = dp.splat_depth(points, cameras(torch.float32), lengths=torch.tensor([70, where]))
    assert not padded.visible[1, :, where:].any()


def test_finite_coordinates_may_be_so_large_that_their_depths_are_not():
    camera = cameras(torch.float32)
    points = clouds(torch.float32)
    far = torch.cat((points, torch.full((2, 1, 3), 3e38)), dim=1)
    assert torch.equal(dp.splat_depth(far, camera).index, dp.splat_depth(points, camera).index)
