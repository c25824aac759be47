"""Cameras: conventions stated as arithmetic."""

import pickle

import pytest
import torch
import torch.utils.data

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


def test_an_index_reaches_the_leading_dimensions_only():
    camera = dp.PinholeCamera.look_at(torch.randn(2, 3, 3) + 3, focal_px=10.0, height=4, width=4)
    single = camera[0, 0]
    assert single[None].batch_shape == single[..., None].batch_shape == (1,)
    assert len(single[None]) == 1
    assert single[None, None].batch_shape == (1, 1)
    assert camera[..., 1].batch_shape == (2,)
    assert torch.equal(camera[..., 1].cam_from_world, camera.cam_from_world[:, 1])
    assert camera[..., None].batch_shape == (2, 3, 1)
    assert camera[[1, 0], :, None].batch_shape == (2, 3, 1)
    for wrong in ((0, 0, 0), (..., 5), 2):
        with pytest.raises(
            IndexError, match=r"PinholeCamera: cameras of batch shape \(2, 3\) have no such index: "
        ):
            camera[wrong]
    assert single.expand((5, 2)).batch_shape == (5, 2)
    assert camera.expand((4, -1, -1)).batch_shape == camera.expand(4, -1, -1).batch_shape == (4, 2, 3)


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


def random_cameras(*batch: int, height: int = 40, width: int = 56) -> dp.PinholeCamera:
    generator = torch.Generator().manual_seed(0)
    eyes = torch.randn(*batch, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0, -4])
    camera = dp.PinholeCamera.look_at(eyes, focal_px=70.0, height=height, width=width)
    K = camera.K + torch.tensor([[3.0, 0, 2], [0, -4, 1], [0, 0, 0]])
    return dp.PinholeCamera(K, camera.cam_from_world, height, width)


CLOUD = torch.rand(1, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5


def same(camera: dp.PinholeCamera, other: dp.PinholeCamera) -> bool:
    matrices = ((camera.K, other.K), (camera.cam_from_world, other.cam_from_world))
    sizes = (camera.height, camera.width) == (other.height, other.width)
    return sizes and all(x.shape == y.shape and torch.allclose(x, y) for x, y in matrices)


def test_conversions_to_and_from_other_programs_are_inverse():
    camera = random_cameras(3)
    assert same(dp.PinholeCamera.from_opengl(*camera.to_opengl(), 40, 56), camera)
    R, T, *_ = camera.to_pytorch3d()
    assert same(dp.PinholeCamera.from_pytorch3d(R, T, camera.K, 40, 56), camera)
    R, t = camera.cam_from_world[..., :3, :3], camera.cam_from_world[..., :3, 3]
    assert same(dp.PinholeCamera.from_opencv(camera.K, R, t, 40, 56, pixel_centres="half"), camera)


@pytest.mark.parametrize("in_ndc", [False, True])
@pytest.mark.parametrize("size", [(40, 56), (56, 40)])
def test_pytorch3ds_projection_finds_our_pixels(in_ndc, size):
    """By the formulas of its documentation: view axes x left and y up, NDC over half the shorter side."""
    height, width = size
    camera = random_cameras(2, 2, height=height, width=width)
    R, T, focal, principal, image_size = camera.to_pytorch3d(in_ndc=in_ndc)
    assert R.shape == (4, 3, 3)
    assert image_size.tolist() == [[height, width]] * 4
    half, middle = min(size) / 2, torch.tensor([width, height]) / 2
    if not in_ndc:
        focal, principal = focal / half, -(principal - middle) / half
    view = CLOUD @ R + T[:, None]
    ndc = focal[:, None] * view[..., :2] / view[..., 2:] + principal[:, None]
    pixels = dp.project(CLOUD.expand(2, -1, -1), camera).pixels.flatten(0, 1)
    torch.testing.assert_close(middle - half * ndc, pixels)


def test_opencvs_pixels_are_half_a_pixel_less():
    camera = random_cameras()
    R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    whole = dp.PinholeCamera.from_opencv(camera.K, R, t, 40, 56)
    in_camera = CLOUD[0] @ R.T + t
    opencvs = (in_camera @ camera.K.T)[:, :2] / in_camera[:, 2:]  # as cv2.projectPoints
    torch.testing.assert_close(dp.project(CLOUD, whole).pixels[0, 0], opencvs + 0.5)
    half = dp.PinholeCamera.from_opencv(camera.K, R, t, 40, 56, pixel_centres="half")
    torch.testing.assert_close(dp.project(CLOUD, half).pixels[0, 0], opencvs)


def test_the_field_of_view_ends_at_the_images_edge():
    upwards = torch.tensor([[[0.0, -(3**0.5), 3.0], [0.0, 3**0.5, 3.0]]])  # 30 degrees up and down
    camera = dp.PinholeCamera.from_fov(torch.eye(4).expand(5, 4, 4), 60.0, 40, 56)
    pixels = dp.project(upwards, camera).pixels
    torch.testing.assert_close(
        pixels, torch.tensor([[28.0, 0], [28, 40]]).expand(1, 5, 2, 2), atol=1e-4, rtol=0
    )
    looking = dp.PinholeCamera.look_at((0, 0, -3.0), fov_y_deg=60.0, height=40, width=56)
    assert torch.equal(looking.K, camera.K[0])


def test_cameras_are_stacked():
    cameras = random_cameras(3)
    for dim, shape in ((0, (2, 3)), (1, (3, 2)), (-1, (3, 2)), (-2, (2, 3))):
        stacked = dp.PinholeCamera.stack([cameras, cameras[[2, 1, 0]]], dim)
        assert stacked.batch_shape == shape
        assert torch.equal(
            stacked.cam_from_world.select(dim if dim >= 0 else dim - 2, 0), cameras.cam_from_world
        )
    one_pose = dp.PinholeCamera(
        cameras.K, torch.eye(4, dtype=torch.float64), 40, 56
    )  # broadcast over the views
    assert dp.PinholeCamera.stack([one_pose, cameras]).batch_shape == (2, 3)
    single = cameras[0]
    for wrong, message in (
        ([], "'cameras' must hold at least one camera"),
        (
            [single, single.resize(20, 28)],
            r"'cameras\[1\]' must have the height of the first, 40; got 20. Resize it",
        ),
        ([single, single.to(torch.float32)], r"'cameras\[1\]' must have the dtype of the first"),
        ([single, cameras], r"'cameras\[1\]' must have the batch_shape of the first, \(\); got \(3,\)"),
        ([single, single.K], r"'cameras\[1\]' must be a PinholeCamera; got Tensor"),
    ):
        with pytest.raises((TypeError, ValueError), match=rf"PinholeCamera.stack: {message}"):
            dp.PinholeCamera.stack(wrong)
    with pytest.raises(ValueError, match=r"'dim' must lie in \[-1, 0\]; got 1"):
        dp.PinholeCamera.stack([single, single], 1)


def test_batches_of_cameras_are_sequences_and_single_ones_are_not():
    cameras = random_cameras(3, 2)
    assert len(cameras) == 3
    assert [c.batch_shape for c in cameras] == [(2,)] * 3
    assert same(dp.PinholeCamera.stack(list(cameras)), cameras)
    assert cameras[:, None].batch_shape == (3, 1, 2)
    assert cameras[0, 0]
    assert cameras[:0]
    for call in (len, list):
        with pytest.raises(TypeError, match=r"a single camera has no length; camera\[None\]"):
            call(cameras[0, 0])


def test_cameras_and_results_are_saved_and_loaded(tmp_path):
    camera = random_cameras(2)
    points = CLOUD.expand(2, -1, -1)
    results = {
        "camera": camera,
        "nearest": dp.nearest(points, points),
        "splat": dp.splat_depth(points, camera[:, None]),
        "emd": dp.earth_mover_distance(points, points),
    }
    torch.save(results, tmp_path / "results.pt")
    loaded = torch.load(tmp_path / "results.pt", weights_only=True)
    assert same(loaded["camera"], camera)
    for name in ("nearest", "splat", "emd"):
        assert type(loaded[name]) is type(results[name])
        assert all(torch.equal(x, y) for x, y in zip(loaded[name], results[name], strict=True))


def test_data_loaders_collate_cameras():
    cameras = random_cameras(5)
    samples = [{"camera": cameras[[i, i + 1]], "index": i} for i in range(4)]
    first, second = (batch["camera"] for batch in torch.utils.data.DataLoader(samples, batch_size=2))
    assert first.batch_shape == second.batch_shape == (2, 2)
    assert same(second[0], cameras[2:4])
    assert same(second[1], cameras[3:5])
    assert same(pickle.loads(pickle.dumps(first)), first)  # as a worker process sends it


def test_data_loaders_collate_results():
    results = [dp.nearest(CLOUD[0] + i, CLOUD[0]) for i in range(4)]
    (batch,) = torch.utils.data.DataLoader(results, batch_size=4)
    assert type(batch) is dp.Nearest
    assert torch.equal(batch.index, torch.stack([r.index for r in results]))


EYE3, EYE4, ZERO = torch.eye(3), torch.eye(4), torch.zeros(3)
SKEW = torch.tensor([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.from_pytorch3d(EYE3, torch.zeros(1), EYE3, 4, 4), "from_pytorch3d: 'T' must have shape"),
        (
            lambda c: c.from_pytorch3d(EYE3, ZERO.double(), EYE3, 4, 4),
            "from_pytorch3d: 'T' must have the dtype of 'R'",
        ),
        (lambda c: c.from_pytorch3d(EYE3[:2], ZERO, EYE3, 4, 4), "from_pytorch3d: 'R' must have shape"),
        (
            lambda c: c.from_pytorch3d(EYE3.expand(3, 3, 3), ZERO.expand(2, 3), EYE3, 4, 4),
            r"from_pytorch3d: 'T' must have leading dimensions that fit those of 'R' \(3,\); got \(2,\)",
        ),
        (
            lambda c: c.from_pytorch3d(EYE3, [0.0, 0, 0], EYE3, 4, 4),
            r"from_pytorch3d: 'T' must be a torch\.Tensor",
        ),
        (lambda c: c.from_pytorch3d(EYE3, ZERO, EYE4, 4, 4), "'K' must have shape"),
        (lambda c: c.from_opengl(EYE3, EYE3, 4, 4), "from_opengl: 'cam_from_world' must have shape"),
        (lambda c: c.from_opengl(EYE3, EYE4.double(), 4, 4), "'cam_from_world' must have the dtype of 'K'"),
        (lambda c: c.from_opencv(EYE3, EYE3, torch.zeros(3, 1), 4, 4), "from_opencv: 't' must have shape"),
        (lambda c: c.from_opencv(EYE4, EYE3, ZERO, 4, 4), "from_opencv: 'K' must have shape"),
        (
            lambda c: c.from_opencv(EYE3, EYE3, ZERO, 4, 4, pixel_centres="corner"),
            "'pixel_centres' must be one of",
        ),
        (lambda c: c.from_fov(EYE4, 180.0, 4, 4), "from_fov: 'fov_y_deg' must lie between 0 and 180 degrees"),
        (lambda c: c.from_fov(EYE4, 60.0, 4, 0), "from_fov: 'width' must be a positive integer"),
        (lambda c: c.from_fov(EYE3, 60.0, 4, 4), "from_fov: 'cam_from_world' must have shape"),
        (
            lambda c: c.look_at((0, 0, 1.0), height=4, width=4),
            "look_at: 'focal_px' must be given, or else 'fov_y_deg'",
        ),
        (
            lambda c: c.look_at((0, 0, 1.0), focal_px=1.0, fov_y_deg=9.0, height=4, width=4),
            r"look_at: 'focal_px' must be given, or else 'fov_y_deg'; got 1\.0 and 9\.0\. Pass one of them",
        ),
        (
            lambda c: c.look_at((0, 0, 1.0), focal_px=1.0, height="4", width=4),
            "look_at: 'height' must be a positive",
        ),
        (lambda c: c(EYE3, EYE4, 4, 4).resize(4, 1.5), "resize: 'width' must be a positive integer"),
        (
            lambda c: c(SKEW, EYE4, 4, 4).to_pytorch3d(),
            "to_pytorch3d: 'K' must have no skew",
        ),
    ],
)
def test_constructors_and_converters_check_their_arguments(call, message):
    with pytest.raises((TypeError, ValueError), match=f"PinholeCamera.*{message}"):
        call(dp.PinholeCamera)


def test_pytorch3ds_matrices_are_broadcast():
    two = torch.tensor([[0.0, 0, 2], [0, 0, 3]])
    camera = dp.PinholeCamera.from_pytorch3d(EYE3[None], two, EYE3, 4, 4)
    assert camera.position.tolist() == [[0.0, 0, -2], [0, 0, -3]]


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1.0, 1e10, 1e20])
def test_look_at_in_any_unit(scale: float) -> None:
    eye, up = (scale, 2 * scale, scale), (0.0, 1 / scale, 0.0)
    camera, same = (
        dp.PinholeCamera.look_at(at, focal_px=4.0, height=4, width=4, up=towards)
        for at, towards in ((eye, up), ((1.0, 2.0, 1.0), (0.0, 1.0, 0.0)))
    )
    torch.testing.assert_close(camera.cam_from_world[:3, :3], same.cam_from_world[:3, :3])


def test_look_at_says_what_does_not_fit() -> None:
    along = torch.tensor([0.3, 0.5, 0.7])
    sizes = {"focal_px": 4.0, "height": 4, "width": 4}
    with pytest.raises(ValueError, match="'up' must differ in direction"):  # parallel but for rounding
        dp.PinholeCamera.look_at(3.3 * along, up=1.7 * along, **sizes)
    with pytest.raises(
        ValueError, match=r"'eye' must fit 'target' and 'up' in shape; got \(5, 3\), \(4, 3\)"
    ):
        dp.PinholeCamera.look_at(torch.rand(5, 3), torch.zeros(4, 3), **sizes)
    with pytest.raises(TypeError, match="'target' must be three numbers or a tensor"):
        dp.PinholeCamera.look_at((0, 0, 1), "origin", **sizes)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="'eye' must be finite"):
        dp.PinholeCamera.look_at((0, float("nan"), 1), **sizes)


def test_look_at_of_numbers_has_torchs_default_dtype() -> None:
    sizes = {"focal_px": 4.0, "height": 4, "width": 4}
    try:
        for default, expected in (
            (torch.float64, torch.float64),
            (torch.bfloat16, torch.float32),
            (torch.float32, torch.float32),
        ):
            torch.set_default_dtype(default)
            assert dp.PinholeCamera.look_at((0.3, 0.0, -2.0), **sizes).dtype == expected
    finally:
        torch.set_default_dtype(torch.float32)
    distance = torch.tensor(0.3, dtype=torch.float64)
    camera = dp.PinholeCamera.look_at((0, 0, distance), **sizes)  # pyright: ignore[reportArgumentType]
    assert camera.position[2].item() == 0.3


def test_look_at_passes_gradients_to_tensors_in_a_tuple() -> None:
    distance = torch.tensor(2.0, requires_grad=True)
    camera = dp.PinholeCamera.look_at((0, 0, distance), focal_px=4.0, height=4, width=4)  # pyright: ignore[reportArgumentType]
    camera.position.sum().backward()
    assert distance.grad == pytest.approx(1)
