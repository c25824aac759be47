"""Cameras: conventions stated as arithmetic."""

import pytest
import torch

import diffpoint as dp


def test_look_at_puts_the_target_in_the_middle_and_up_above():
    camera = dp.PinholeCamera.look_at((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), focal_px=50.0, height=20, width=30)
    points = torch.tensor([[[0.1, 0.2, 0.3], [0.1, 0.3, 0.3], [1.0, 2.0, 3.0]]])
    pixels, depth = dp.project(points, camera)
    assert pixels[0, 0, 0].tolist() == pytest.approx([15.0, 10.0], abs=1e-4)
    assert pixels[0, 0, 1, 1] < 10.0  # higher in the world is a smaller row
    assert depth[0, 0, 0].item() == pytest.approx((0.9**2 + 1.8**2 + 2.7**2) ** 0.5, rel=1e-5)
    assert camera.position.tolist() == pytest.approx([1.0, 2.0, 3.0], rel=1e-5)
    rotation = camera.cam_from_world[:3, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-6)
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0, rel=1e-5)


def test_depth_is_z_not_ray_length():
    camera = dp.PinholeCamera(torch.eye(3), torch.eye(4), 4, 4)
    assert dp.project(torch.tensor([[[3.0, 4.0, 2.0]]]), camera).depth.item() == 2.0


def test_resizing_scales_image_positions():
    camera = dp.PinholeCamera.look_at((0.3, 0.5, -2.0), focal_px=420.0, height=224, width=200)
    points = torch.rand(1, 10, 3) - 0.5
    large, small = dp.project(points, camera).pixels, dp.project(points, camera.resize(56, 100)).pixels
    assert torch.allclose(small, large * torch.tensor([0.5, 0.25]), atol=1e-4)
    assert (camera.resize(56, 100).height, camera.resize(56, 100).width) == (56, 100)


def test_conversions_from_opengl_and_pytorch3d_agree():
    """The same pose, written in three conventions, sees a point at the same place."""
    camera = dp.PinholeCamera.look_at((0.4, 0.9, 1.7), focal_px=33.0, height=16, width=16)
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    opengl = dp.PinholeCamera.from_opengl(camera.K, flip @ camera.cam_from_world, 16, 16)
    mirror = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    R = (mirror @ camera.cam_from_world[:3, :3]).T
    T = mirror @ camera.cam_from_world[:3, 3]
    pytorch3d = dp.PinholeCamera.from_pytorch3d(R, T, camera.K, 16, 16)
    for other in (opengl, pytorch3d):
        assert torch.allclose(other.cam_from_world, camera.cam_from_world, atol=1e-6)


def test_back_projection_inverts_projection():
    camera = dp.PinholeCamera.look_at((0.4, 0.9, 1.7), focal_px=33.0, height=16, width=16).to(torch.float64)
    point = torch.tensor([0.1, -0.2, 0.3, 1.0], dtype=torch.float64)
    u_d, v_d, d = camera.projection @ point
    again = d * (camera.back_projection[:, :3] @ torch.stack((u_d / d, v_d / d, torch.ones_like(d))))
    assert torch.allclose(again + camera.back_projection[:, 3], point[:3])


def test_indexing_and_expanding_keep_views():
    camera = dp.PinholeCamera.look_at(torch.randn(2, 3, 3) + 3, focal_px=10.0, height=4, width=4)
    assert camera.batch_shape == (2, 3)
    assert camera[1].batch_shape == (3,)
    assert torch.equal(camera[1, 2].cam_from_world, camera.cam_from_world[1, 2])
    assert camera[0, 0].expand(5, 2).batch_shape == (5, 2)
    with pytest.raises(IndexError, match="no leading dimension"):
        camera[0, 0][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": torch.eye(4)}, "'K' must have shape"),
        ({"cam_from_world": torch.eye(3)}, "'cam_from_world' must have shape"),
        ({"K": torch.eye(3).double()}, "must have the dtype"),
        ({"K": torch.full((3, 3), torch.nan)}, "'K' must be finite"),
        ({"cam_from_world": torch.eye(4) * 2}, "end in the row"),
        ({"height": 0}, "'height' must be a positive integer"),
        ({"width": 4.0}, "'width' must be a positive integer"),
        (
            {"K": torch.eye(3).expand(2, 3, 3), "cam_from_world": torch.eye(4).expand(3, 4, 4)},
            "leading dimensions",
        ),
    ],
)
def test_what_is_no_camera_is_refused_by_name(change, message):
    arguments = {"K": torch.eye(3), "cam_from_world": torch.eye(4), "height": 4, "width": 4} | change
    with pytest.raises((TypeError, ValueError), match=f"PinholeCamera: .*{message}"):
        dp.PinholeCamera(**arguments)


def test_looking_along_up_is_refused():
    with pytest.raises(ValueError, match="Choose another 'up'"):
        dp.PinholeCamera.look_at((0, 2, 0), focal_px=10.0, height=4, width=4)


def test_singular_matrices_are_named_where_they_are_inverted():
    flat = torch.diag(torch.tensor([0.0, 1.0, 1.0]))
    for K in (flat, torch.stack((torch.eye(3), flat))):
        camera = dp.PinholeCamera(K, torch.eye(4), 2, 2)
        with pytest.raises(ValueError, match=r"PinholeCamera: 'K' must be invertible; got \[\[0.0"):
            dp.unproject(torch.ones(1, len(K) if K.dim() > 2 else 1, 2, 2), camera)
    nowhere = dp.PinholeCamera(torch.eye(3), torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0])), 2, 2)
    with pytest.raises(ValueError, match="'cam_from_world' must be invertible"):
        _ = nowhere.position


def test_n_cameras_for_n_clouds():
    """In PyTorch3D these are pairs; here each cloud is seen from all N views, unless the cameras are (N, 1)."""
    cameras = dp.PinholeCamera.look_at(
        torch.tensor([[0.0, 0, -2], [2, 0, 0], [0.1, 2, 0]]), focal_px=9.0, height=8, width=8
    )
    clouds = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    assert dp.project(clouds, cameras).depth.shape == (3, 3, 5)
    pairs = dp.project(clouds, cameras[:, None])
    for b in range(3):
        alone = dp.project(clouds[b : b + 1], cameras[b])
        torch.testing.assert_close(pairs.pixels[b : b + 1], alone.pixels)
    depth = dp.splat_depth(clouds, cameras[:, None]).depth
    with pytest.raises(
        ValueError, match=r"'camera' must have 1 views .*; got 3\. .* pass camera\[:, None\]\.$"
    ):
        dp.unproject(depth, cameras)
    assert dp.unproject(depth, cameras[:, None]).lengths.shape == (3, 1)
    with pytest.raises(ValueError, match=r"'camera' must have 1 views to match 'depth'; got 2\.$"):
        dp.unproject(depth, cameras[:2])


def test_intrinsics_of_opencv_are_shifted_by_half_a_pixel():
    """OpenCV's pixels have their centres at whole numbers; see docs/conventions.md."""
    opencv = torch.tensor([[30.0, 0, 5.25], [0, 28, 3.5], [0, 0, 1]])
    points = (
        torch.rand(1, 40, 3, generator=torch.Generator().manual_seed(0)) - 0.5 + torch.tensor([0, 0, 3.0])
    )
    projected = points @ opencv.T
    position = projected[..., :2] / projected[..., 2:]  # of cv2.projectPoints
    K = opencv.clone()
    K[..., :2, 2] += 0.5
    camera = dp.PinholeCamera(K, torch.eye(4), 8, 12)
    torch.testing.assert_close(dp.project(points, camera).pixels[0], position + 0.5)
    index = dp.splat_depth(points, camera).index[0, 0]
    row, column = (index >= 0).nonzero().unbind(1)
    nearest_centre = position[0, index[row, column]].round().long()  # the pixel that OpenCV means
    assert torch.equal(nearest_centre, torch.stack((column, row), 1))
    assert len(row) > 5
