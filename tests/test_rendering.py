"""Splatting, view sampling, projection and reprojection: conventions, special cases and invariances."""

import pytest
import torch
from torch import Tensor

import diffpoint as dp
from diffpoint import reference
from diffpoint.testing import assert_close, boundary_points, tie_free_clouds

DTYPES = (torch.float32, torch.float64)
HEIGHT, WIDTH = 14, 18


def cameras(dtype: torch.dtype, batch: int = 2, views: int = 3) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2], [-1.2, 0.5, 1.5]], dtype=dtype)
    eyes = eyes[:views] + 0.1 * torch.arange(batch, dtype=dtype)[:, None, None]
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=HEIGHT, width=WIDTH)


def clouds(dtype: torch.dtype, count: int = 60, seed: int = 0) -> Tensor:
    return tie_free_clouds(2, count, cameras(torch.float64), seed=seed, dtype=dtype)


def test_nearest_depth_then_lowest_index_wins():
    camera = dp.PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
    behind_then_equal = torch.tensor(
        [[[0.1, -0.1, 0.5], [0.1, -0.1, 0.2], [0.1, -0.1, 0.2], [0.1, -0.1, 0.9]]]
    )
    splat = dp.splat_depth(behind_then_equal, camera)
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
def test_points_on_borders_and_centres_of_pixels_cover_the_same_as_in_the_reference(dtype, radius):
    """And a few rounding errors beside them, in the map and outside; all at one depth, so that the index decides."""
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


def depth_maps(dtype: torch.dtype) -> Tensor:
    """Maps with holes, of different foreground counts, one of them empty."""
    camera = cameras(dtype)
    depth = dp.splat_depth(clouds(dtype, count=300, seed=8), camera, radius=0.8).depth
    depth[1, 2] = torch.inf
    return depth


def test_reprojecting_into_the_same_camera_returns_the_pixel_centres():
    camera = cameras(torch.float64)
    depth = depth_maps(torch.float64)
    result = dp.reproject(depth, camera, camera)
    foreground = torch.isfinite(depth)
    assert torch.equal(result.valid, foreground)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    centres = torch.stack((columns, rows), -1) + 0.5
    assert_close(result.pixels[foreground], centres.expand(2, 3, -1, -1, -1)[foreground].double(), scale=10)
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


def test_boundary_points_are_those_that_two_renderers_may_place_differently():
    camera = cameras(torch.float32)
    points = torch.rand(2, 4000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    ours = dp.project(points, camera).pixels.floor()
    theirs = reference.project(points.double(), camera.K.double(), camera.cam_from_world.double())[0].floor()
    moved = (ours != theirs).any(-1)
    assert not (moved & ~boundary_points(points, camera, margin=1e-4)).any()


@pytest.mark.parametrize("radius", [0.0, 1.0, 1.2])
def test_a_large_cloud_in_parts_gives_the_maps_of_the_whole(radius):
    """A single large cloud is divided among the threads; nine of them are not. Copies of points make equal depths."""
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
def test_gradients_of_a_large_cloud_in_parts_are_those_of_its_pieces(dtype):
    """The points' to the bit; the camera's but for the order of the sum, which the number of parts decides."""
    points = torch.rand(2, 50_003, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) - 0.5
    weight = torch.rand(2, 3, 50_003, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)

    def gradients(start: int, stop: int) -> tuple[Tensor, ...]:
        leaf = points[:, start:stop].clone().requires_grad_()
        extrinsics = cameras(dtype).cam_from_world.clone().requires_grad_()
        camera = dp.PinholeCamera(cameras(dtype).K, extrinsics, HEIGHT, WIDTH)
        pixels, depth = dp.project(leaf, camera)
        outputs = torch.cat((pixels, depth[..., None]), -1)
        return torch.autograd.grad((outputs * weight[:, :, start:stop]).sum(), (leaf, extrinsics))

    whole, pieces = (
        gradients(0, 50_003),
        [gradients(s, min(s + 8000, 50_003)) for s in range(0, 50_003, 8000)],
    )
    assert torch.equal(whole[0], torch.cat([piece[0] for piece in pieces], 1))
    assert_close(whole[1], torch.stack([piece[1] for piece in pieces]).sum(0), scale=10)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("height", [3, 211])
def test_gradients_of_a_large_map_in_parts_are_those_of_its_rows(dtype, height):
    """Also where there are fewer rows than parts."""
    width = 50_001 // height
    size = height, width
    source, target = (
        dp.PinholeCamera.look_at(torch.tensor(eye, dtype=dtype), focal_px=200.0, height=height, width=width)
        for eye in ((0.1, 0.3, -2.0), (0.4, 0.1, -2.0))
    )
    random = torch.Generator().manual_seed(0)
    depth = torch.rand(1, 1, *size, generator=random, dtype=dtype) + 1.5
    depth[torch.rand(depth.shape, generator=random) < 0.3] = torch.inf
    weight = torch.rand(1, 1, *size, 6, generator=random, dtype=dtype)

    def gradients(rows: slice) -> tuple[Tensor, ...]:
        """With the other rows empty."""
        leaf = torch.full_like(depth, torch.inf)
        leaf[..., rows, :] = depth[..., rows, :]
        matrices = [m.clone().requires_grad_() for c in (source, target) for m in (c.K, c.cam_from_world)]
        there, back = (dp.PinholeCamera(matrices[i], matrices[i + 1], height, width) for i in (0, 2))
        seen = dp.reproject(leaf.requires_grad_(), there, back)
        outputs = torch.cat((seen.points, seen.pixels, seen.depth[..., None]), -1)
        total = torch.where(torch.isfinite(outputs), outputs * weight, 0.0).sum()
        return torch.autograd.grad(total, (leaf, *matrices))

    whole, step = gradients(slice(None)), -(-height // 3)
    pieces = [gradients(slice(i, i + step)) for i in range(0, height, step)]
    for i, gradient in enumerate(whole):
        assert_close(gradient, torch.stack([p[i] for p in pieces]).sum(0), scale=10)


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
