"""Errors of every op name the argument, what is expected and what was passed."""

import fractions
from collections.abc import Callable

import numpy as np
import pytest
import torch

import diffpoint as dp
from diffpoint import io

CAMERA = dp.PinholeCamera.look_at(torch.tensor([[0.0, 0, -2], [2, 0, 0]]), focal_px=20.0, height=8, width=8)
DEPTH = torch.full((2, 2, 8, 8), 2.0)
POINTS = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0)) - 0.5
Ops = dict[str, Callable]

# Each op with one cloud-like argument left open.
CLOUDS: Ops = {
    "splat_depth": lambda x: dp.splat_depth(x, CAMERA),
    "project": lambda x: dp.project(x, CAMERA),
    "front_constraint": lambda x: dp.front_constraint(x, CAMERA, DEPTH),
    "projection_loss": lambda x: dp.projection_loss(x, CAMERA, DEPTH),
    "soft_splat": lambda x: dp.soft_splat(x, CAMERA),
    "soft_projection_loss": lambda x: dp.soft_projection_loss(x, CAMERA, DEPTH),
}
SETS: Ops = {
    "nearest a": lambda x: dp.nearest(x, torch.rand(2, 5, 3)),
    "nearest b": lambda x: dp.nearest(torch.rand(2, 5, 3), x),
    "knn a": lambda x: dp.knn(x, torch.rand(2, 5, 3), 2),
    "knn b": lambda x: dp.knn(torch.rand(2, 5, 3), x, 2),
    "f_score a": lambda x: dp.f_score(x, torch.rand(2, 5, 3), 0.1),
    "f_score b": lambda x: dp.f_score(torch.rand(2, 5, 3), x, 0.1),
    "chamfer_distance a": lambda x: dp.chamfer_distance(x, torch.rand(2, 5, 3), squared=True),
    "chamfer_distance b": lambda x: dp.chamfer_distance(torch.rand(2, 5, 3), x, squared=True),
    "hausdorff_distance a": lambda x: dp.hausdorff_distance(x, torch.rand(2, 5, 3)),
    "hausdorff_distance b": lambda x: dp.hausdorff_distance(torch.rand(2, 5, 3), x),
    "earth_mover_distance a": lambda x: dp.earth_mover_distance(x, torch.rand(2, 5, 3)),
    "earth_mover_distance b": lambda x: dp.earth_mover_distance(torch.rand(2, 5, 3), x),
    "approxmatch a": lambda x: dp.approxmatch(x, torch.rand(2, 5, 3)),
    "approxmatch b": lambda x: dp.approxmatch(torch.rand(2, 5, 3), x),
    "farthest_point_sample points": lambda x: dp.farthest_point_sample(x, 2),
}
STACKS: Ops = {
    "diversity_loss clouds": lambda x: dp.diversity_loss(
        torch.rand(2, 2, 4), x[None].expand(2, *x.shape), alpha=1.0
    ),
    "consistency_loss clouds": lambda x: dp.consistency_loss(x[:, None].expand(-1, 2, *x.shape[1:])),
    "total_mutual_difference clouds": lambda x: dp.total_mutual_difference(
        x[:, None].expand(-1, 2, *x.shape[1:]), squared=True
    ),
    "minimal_matching_distance samples": lambda x: dp.minimal_matching_distance(
        x, torch.rand(4, 5, 3), squared=True
    ),
    "minimal_matching_distance references": lambda x: dp.minimal_matching_distance(
        torch.rand(4, 5, 3), x, squared=True
    ),
    "unidirectional_hausdorff_distance partial": lambda x: dp.unidirectional_hausdorff_distance(
        x, torch.rand(2, 4, 5, 3)
    ),
    "unidirectional_hausdorff_distance completions": lambda x: dp.unidirectional_hausdorff_distance(
        torch.rand(5, 3), x
    ),
}
MAPS: Ops = {
    "unproject": lambda d: dp.unproject(d, CAMERA),
    "reproject": lambda d: dp.reproject(d, CAMERA, CAMERA),
    "front_constraint": lambda d: dp.front_constraint(torch.rand(2, 9, 3), CAMERA, d),
    "projection_loss": lambda d: dp.projection_loss(torch.rand(2, 9, 3), CAMERA, d),
    "soft_projection_loss": lambda d: dp.soft_projection_loss(torch.rand(2, 9, 3), CAMERA, d),
}
EVERY = CLOUDS | SETS | STACKS


@pytest.mark.parametrize("op", EVERY)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_coordinates_that_are_not_finite(op, bad):
    points = torch.rand(2, 7, 3)
    points[1, 3, 2] = bad
    with pytest.raises(ValueError, match=r"must be finite; got -?(nan|inf) at index \(.*3, 2\)"):
        EVERY[op](points)


@pytest.mark.parametrize("op", CLOUDS | SETS)
def test_wrong_last_dimension(op):
    with pytest.raises(ValueError, match=r"must have shape .*; got \(2, 7, 4\)"):
        (CLOUDS | SETS)[op](torch.rand(2, 7, 4))


@pytest.mark.parametrize("op", CLOUDS)
def test_a_forgotten_batch_dimension_gets_a_hint(op):
    with pytest.raises(ValueError, match="Did you forget to batch"):
        CLOUDS[op](torch.rand(7, 3))


@pytest.mark.parametrize("op", EVERY)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_other_dtypes(op, dtype):
    with pytest.raises(TypeError, match="must be float32 or float64; got torch"):
        EVERY[op](torch.ones(2, 7, 3, dtype=dtype))


@pytest.mark.parametrize("op", CLOUDS)
def test_mixed_dtypes(op):
    with pytest.raises(TypeError, match="must have the dtype of"):
        CLOUDS[op](torch.rand(2, 7, 3, dtype=torch.float64))


@pytest.mark.parametrize("op", CLOUDS | SETS)
def test_what_is_no_tensor(op):
    with pytest.raises(TypeError, match=r"must be a torch\.Tensor; got list"):
        (CLOUDS | SETS)[op]([[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("op", CLOUDS | SETS)
def test_arrays_and_tensors_of_other_layouts(op):
    call = (CLOUDS | SETS)[op]
    with pytest.raises(
        TypeError, match=r"must be a torch\.Tensor; got ndarray\. Convert it with torch\.from_numpy\."
    ):
        call(np.zeros((2, 7, 3)))
    with pytest.raises(TypeError, match=r"must be a dense tensor; got a torch\.sparse_coo one"):
        call(torch.zeros(2, 7, 3).to_sparse())


def test_cameras_of_arrays():
    K, R, T = np.eye(3), np.eye(3), np.zeros(3)
    tensor = torch.eye(3, dtype=torch.float64)
    for name, call in (
        ("PinholeCamera: 'K'", lambda: dp.PinholeCamera(K, torch.eye(4), 3, 3)),
        (
            "PinholeCamera.from_opengl: 'cam_from_world'",
            lambda: dp.PinholeCamera.from_opengl(K, np.eye(4), 3, 3),
        ),
        ("PinholeCamera.from_pytorch3d: 'R'", lambda: dp.PinholeCamera.from_pytorch3d(R, T, K, 3, 3)),
        ("PinholeCamera.from_pytorch3d: 'T'", lambda: dp.PinholeCamera.from_pytorch3d(tensor, T, K, 3, 3)),
    ):
        with pytest.raises(TypeError, match=rf"^{name} must be a torch\.Tensor; got ndarray\. Convert"):
            call()


@pytest.mark.parametrize("op", MAPS)
def test_depth_maps_of_another_size(op):
    with pytest.raises(ValueError, match="'depth' must have"):
        MAPS[op](torch.full((2, 2, 8, 9), 2.0))


@pytest.mark.parametrize("op", MAPS)
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan")])
def test_depths_that_are_none(op, bad):
    depth = DEPTH.clone()
    depth[1, 0, 2, 3] = bad
    with pytest.raises(ValueError, match=r"'depth' must be positive.* at index \(1, 0, 2, 3\).*masked_fill"):
        MAPS[op](depth)


def test_empty_sets_have_no_distance():
    full, empty = torch.rand(2, 5, 3), torch.rand(2, 0, 3)
    for function in (
        lambda a, b, **k: dp.chamfer_distance(a, b, squared=False, **k),
        lambda a, b, **k: dp.f_score(a, b, 0.1, **k),
        dp.hausdorff_distance,
        dp.earth_mover_distance,
    ):
        for a, b in ((full, empty), (empty, full)):
            with pytest.raises(ValueError, match="must hold at least one point"):
                function(a, b)
        with pytest.raises(ValueError, match=r"'b_lengths' must lie in \[1, 5\]; got 0 at flat index 1"):
            function(full, full, b_lengths=torch.tensor([3, 0]))


@pytest.mark.parametrize(
    ("lengths", "message"),
    [
        (torch.tensor([5, 6]), r"must lie in \[0, 5\]; got 6"),
        (torch.tensor([-1, 2]), r"must lie in \[0, 5\]; got -1"),
        (torch.tensor([1, 2, 3]), r"must have shape \(2,\); got \(3,\)"),
        (torch.tensor([1.0, 2.0]), "must be an integer tensor"),
        ([1, 2], "must be an integer tensor .*; got list"),
    ],
)
def test_lengths_that_are_none(lengths, message):
    points = torch.rand(2, 5, 3)
    for call in (
        lambda: dp.splat_depth(points, CAMERA, lengths=lengths),
        lambda: dp.nearest(points, points, a_lengths=lengths),
        lambda: dp.farthest_point_sample(points, 0, lengths=lengths),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            call()


def test_batches_that_do_not_match():
    with pytest.raises(ValueError, match=r"'b' must have shape \(4, M, 3\) to match 'a'; got \(2, 9, 3\)"):
        dp.chamfer_distance(torch.rand(4, 9, 3), torch.rand(2, 9, 3), squared=False)
    with pytest.raises(ValueError, match=r"'camera' must have batch shape .*\(3, V\); got \(2, 2\)"):
        dp.splat_depth(torch.rand(3, 9, 3), CAMERA.expand(2, 2))
    splat = dp.splat_depth(torch.rand(2, 9, 3), CAMERA)
    with pytest.raises(ValueError, match="Pass the cloud that splat_depth rendered"):
        dp.sample_view(torch.rand(2, 10, 3), splat)
    with pytest.raises(TypeError, match="must be the result of splat_depth"):
        dp.sample_view(torch.rand(2, 9, 3), splat.depth)


@pytest.mark.parametrize("op", [dp.splat_depth, dp.project, dp.visible_points])
def test_what_is_no_camera(op):
    with pytest.raises(TypeError, match=r"'camera' must be a PinholeCamera; got Tensor"):
        op(torch.rand(2, 5, 3), torch.eye(3))


@pytest.mark.parametrize(
    "op", [dp.front_sets, dp.front_constraint, dp.projection_loss, dp.soft_projection_loss]
)
def test_camera_and_depth_in_the_wrong_order(op):
    with pytest.raises(TypeError, match=rf"^{op.__name__}: 'camera' must be a PinholeCamera; got Tensor"):
        op(POINTS, DEPTH, CAMERA)


@pytest.mark.parametrize(("op", "name"), [(dp.unproject, "camera"), (dp.reproject, "source")])
def test_a_depth_map_in_place_of_a_camera(op, name):
    with pytest.raises(TypeError, match=rf"^{op.__name__}: '{name}' must be a PinholeCamera; got Tensor"):
        op(DEPTH, *(DEPTH,) * (1 if name == "camera" else 2))


@pytest.mark.parametrize("op", STACKS)
@pytest.mark.parametrize("bad", ["nan", "empty"])
def test_errors_of_stacks_name_the_callers_argument(op, bad):
    function, argument = op.split()
    points = torch.rand(2, 0, 3) if bad == "empty" else torch.full((2, 7, 3), torch.nan)
    with pytest.raises(
        ValueError, match=rf"^{function}: '{argument}' must (hold at least one point|be finite)"
    ):
        STACKS[op](points)


FLAGS: Ops = {
    "chamfer_distance squared": lambda x: dp.chamfer_distance(POINTS, POINTS, squared=x),
    "earth_mover_distance squared": lambda x: dp.earth_mover_distance(POINTS, POINTS, squared=x),
    "minimal_matching_distance squared": lambda x: dp.minimal_matching_distance(POINTS, POINTS, squared=x),
    "total_mutual_difference squared": lambda x: dp.total_mutual_difference(POINTS, squared=x),
    "knn exclude_self": lambda x: dp.knn(POINTS, POINTS, 2, exclude_self=x),
    "farthest_point_sample allow_fewer": lambda x: dp.farthest_point_sample(POINTS, 3, allow_fewer=x),
    "PinholeCamera.to_pytorch3d in_ndc": lambda x: CAMERA.to_pytorch3d(in_ndc=x),
}


@pytest.mark.parametrize("op", FLAGS)
def test_flags_are_true_or_false(op):
    function, name = op.split()
    for flag in (True, False):
        assert all(map(torch.equal, leaves(FLAGS[op](flag)), leaves(FLAGS[op](np.bool_(flag)))))
    for other in ("no", None, 1, torch.tensor(True)):
        with pytest.raises(TypeError, match=rf"^{function}: '{name}' must be True or False; got "):
            FLAGS[op](other)


def test_hints_say_what_to_do():
    with pytest.raises(
        TypeError, match=r"'generator' must be a torch\.Generator or None; got int\. .*manual_seed"
    ):
        dp.farthest_point_sample(POINTS, 3, start="random", generator=0)  # pyright: ignore[reportArgumentType]
    for call, hint in (
        (lambda: dp.nearest(POINTS, POINTS[:1]), r"b\.expand\(len\(a\), -1, -1\)"),
        (lambda: dp.nearest(POINTS, POINTS[0]), "Did you forget to batch"),
        (lambda: dp.unproject(-DEPTH, CAMERA), r"masked_fill\(~\(depth > 0\), float\('inf'\)\)"),
        (
            lambda: dp.nearest(POINTS, dp.unproject(DEPTH, CAMERA)),
            "got PointSets. Pass one of its tensors: points",
        ),
        (lambda: dp.nearest(POINTS, POINTS, a_lengths=POINTS[..., 0] > 0), r"Of a mask take \.sum\(-1\)"),
        (lambda: dp.nearest(POINTS, POINTS, a_lengths=torch.ones(2)), r"Convert it with \.long\(\)"),
        (
            lambda: dp.front_sets(POINTS, CAMERA, DEPTH, visibility="all"),
            "^front_sets: 'visibility' must be one of",
        ),
    ):
        with pytest.raises((TypeError, ValueError), match=hint):
            call()


def test_options_out_of_range():
    points = torch.rand(2, 5, 3)
    for call, message in (
        (lambda: dp.splat_depth(points, CAMERA, radius=-1.0), "'radius' must be a finite number"),
        (lambda: dp.splat_depth(points, CAMERA, radius=float("nan")), "'radius' must be a finite number"),
        (lambda: dp.f_score(points, points, -0.1), "'threshold' must be a number of at least 0"),
        (
            lambda: dp.chamfer_distance(points, points, squared=True, reduction="max over"),
            "'reduction' must be one of 'mean', 'sum', 'max', 'none'",
        ),
        (lambda: dp.knn(points, points, 0), "'k' must be a positive integer"),
        (lambda: dp.knn(points, points, 1, radius=-1.0), "'radius' must be a number of at least 0"),
        (lambda: dp.knn(points, points, 1, radius=float("nan")), "'radius' must be a number of at least 0"),
        (lambda: dp.farthest_point_sample(points, 6), "'k' must be at most 5"),
        (lambda: dp.farthest_point_sample(points, -1), "'k' must be an integer of at least 0"),
        (lambda: dp.farthest_point_sample(points, 2, start=5), "'start' must be at most 4"),
        (lambda: dp.earth_mover_distance(points, points, tolerance=0.0), "'tolerance' must lie between"),
        (
            lambda: dp.front_constraint(points, CAMERA, DEPTH, distance="l2"),
            "'distance' must be one of 'chamfer', 'emd'",
        ),
        (lambda: dp.projection_loss(points, CAMERA, DEPTH, reduction="sum"), "'reduction' must be one of"),
        (lambda: dp.consistency_loss(points[:, None]), "'clouds' must hold at least two"),
        (
            lambda: dp.diversity_loss(torch.rand(1, 2, 4), points[None], alpha=1.0),
            "'codes' must hold at least two",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("op", CLOUDS)
@pytest.mark.parametrize("shape", [(2, 7, 2), (7, 2), (2, 7, 4), (2,)])
def test_a_wrong_last_size_is_named(op, shape):
    """Also where a dimension is missing, as in a cloud (7, 2) of points in the plane."""
    with pytest.raises(ValueError, match=rf"The last size must be 3, not {shape[-1]}\.$"):
        CLOUDS[op](torch.rand(shape))


@pytest.mark.parametrize("op", SETS)
@pytest.mark.parametrize("shape", [(2, 7, 4), (7, 1)])
def test_sets_are_in_space_or_in_a_plane(op, shape):
    message = rf"The last size must be 3, or 2 for points in a plane, not {shape[-1]}\.$"
    with pytest.raises(ValueError, match=message):
        SETS[op](torch.rand(shape))


NUMBERS: dict[str, tuple[str, Callable]] = {
    "splat_depth": ("radius", lambda x: dp.splat_depth(POINTS, CAMERA, radius=x)),
    "soft_splat": ("radius", lambda x: dp.soft_splat(POINTS, CAMERA, radius=x)),
    "soft_splat softness": ("softness", lambda x: dp.soft_splat(POINTS, CAMERA, softness=x)),
    "soft_projection_loss": (
        "softness",
        lambda x: dp.soft_projection_loss(POINTS, CAMERA, DEPTH, softness=x),
    ),
    "soft_projection_loss radius": (
        "radius",
        lambda x: dp.soft_projection_loss(POINTS, CAMERA, DEPTH, radius=x),
    ),
    "projection_loss": ("mask_weight", lambda x: dp.projection_loss(POINTS, CAMERA, DEPTH, mask_weight=x)),
    "visible_points": ("radius", lambda x: dp.visible_points(POINTS, CAMERA, method="horizon", radius=x)),
    "visible_points tolerance": (
        "tolerance",
        lambda x: dp.visible_points(POINTS, CAMERA, method="horizon", tolerance=x),
    ),
    "earth_mover_distance": ("tolerance", lambda x: dp.earth_mover_distance(POINTS, POINTS, tolerance=x)),
    "diversity_loss": (
        "alpha",
        lambda x: dp.diversity_loss(torch.ones(2, 2, 4), POINTS.expand(2, 2, 5, 3), alpha=x),
    ),
    "PinholeCamera.look_at": (
        "focal_px",
        lambda x: dp.PinholeCamera.look_at((0, 0, -2), focal_px=x, height=8, width=8).K,
    ),
    "encode_depth": ("max_depth", lambda x: io.encode_depth(DEPTH / 8, max_depth=x)),
    "decode_depth": ("max_depth", lambda x: io.decode_depth(np.array([1], np.uint16), max_depth=x)),
}
INTEGERS: dict[str, tuple[str, Callable]] = {
    "farthest_point_sample": ("k", lambda x: dp.farthest_point_sample(POINTS, x)),
    "farthest_point_sample start": ("start", lambda x: dp.farthest_point_sample(POINTS, 2, start=x)),
    "PinholeCamera": ("height", lambda x: dp.PinholeCamera(CAMERA.K, CAMERA.cam_from_world, x, 2).height),
    "PinholeCamera width": (
        "width",
        lambda x: dp.PinholeCamera(CAMERA.K, CAMERA.cam_from_world, 2, x).resize(x, x).width,
    ),
    "projection_loss": ("upsample", lambda x: dp.projection_loss(POINTS, CAMERA, DEPTH, upsample=x)),
}


def leaves(result: object) -> list[torch.Tensor]:
    return [torch.as_tensor(leaf) for leaf in torch.utils._pytree.tree_leaves(result)]


@pytest.mark.parametrize("op", NUMBERS)
def test_numbers_are_those_of_python_and_numpy(op):
    name, call = NUMBERS[op]
    plain = leaves(call(0.5))
    for number in (np.float64(0.5), np.float32(0.5), np.float16(0.5), fractions.Fraction(1, 2)):
        assert all(torch.equal(x, y) for x, y in zip(leaves(call(number)), plain, strict=True))
    function = op.split()[0]
    for tensor in (torch.tensor(0.5), torch.tensor(0.5, requires_grad=True), torch.rand(5)):
        message = (
            rf"^{function}: '{name}' must be a Python or numpy number; got a torch\.Tensor, .* no gradient"
        )
        with pytest.raises(TypeError, match=message):
            call(tensor)
    for other in ("0.5", True, [0.5]):
        with pytest.raises(TypeError, match=rf"^{function}: '{name}' must be a Python or numpy number; got "):
            call(other)


@pytest.mark.parametrize("op", INTEGERS)
def test_integers_are_those_of_python_and_numpy(op):
    name, call = INTEGERS[op]
    plain = leaves(call(2))
    for number in (np.int64(2), np.int32(2), np.uint8(2)):
        assert all(torch.equal(x, y) for x, y in zip(leaves(call(number)), plain, strict=True))
    for other in (True, np.True_, 2.0, np.float64(2), "2", -1, None):
        with pytest.raises(
            ValueError,
            match=rf"^{op.split()[0]}: '{name}' must be an? (positive integer|integer|whole number)",
        ):
            call(other)
    assert type(dp.PinholeCamera(CAMERA.K, CAMERA.cam_from_world, np.int64(2), 2).height) is int


NO_CAMERA = CAMERA.expand(0, 2)


@pytest.mark.parametrize("count", [0, 5])
def test_an_empty_batch_has_an_empty_result(count):
    """Whatever the size of its sets: none of them is empty."""
    points = torch.zeros(0, count, 3, requires_grad=True)
    stack = points[:, None].expand(0, 2, count, 3)
    depth = torch.zeros(0, 2, 8, 8)
    results = [
        *dp.nearest(points, points),
        *dp.knn(points, points, 2, exclude_self=True),
        *(
            x
            for how in ("mean", "sum", "max", "none")
            for x in dp.chamfer_distance(points, points, squared=True, reduction=how)
        ),
        *dp.f_score(points, points, 0.1),
        dp.hausdorff_distance(points, points),
        *dp.earth_mover_distance(points, points),
        dp.approxmatch(points, points),
        dp.farthest_point_sample(points, 3),
        dp.consistency_loss(stack, reduction="none"),
        dp.total_mutual_difference(stack, squared=True, reduction="none"),
        dp.minimal_matching_distance(stack, stack, squared=True, reduction="none"),
        dp.unidirectional_hausdorff_distance(points, stack, reduction="none"),
        dp.diversity_loss(
            torch.ones(2, 0, 4), points[None].expand(2, 0, count, 3), alpha=1.0, reduction="none"
        ),
    ]
    for camera in (CAMERA, NO_CAMERA):
        splat = dp.splat_depth(points, camera)
        results += [*splat, *dp.sample_view(points, splat), *dp.soft_splat(points, camera)]
        results += [dp.visible_points(points, camera, method=m) for m in ("zbuffer", "horizon", "hpr")]
        results += [*dp.project(points, camera), *dp.unproject(depth, camera)]
        results += [*dp.reproject(depth, camera, camera)]
        results += [*dp.front_sets(points, camera, depth), *dp.front_terms(points, camera, depth)]
        for loss in (dp.front_constraint, dp.projection_loss, dp.soft_projection_loss):
            results.append(loss(points, camera, depth, reduction="none"))
    for result in results:
        assert result.shape[0] == 0
        if result.requires_grad:
            (gradient,) = torch.autograd.grad(result.sum(), points, retain_graph=True)
            assert gradient.shape == points.shape
    two_dimensions = torch.zeros(2, 0, count, 3)
    assert dp.chamfer_distance(two_dimensions, two_dimensions, squared=True).a_to_b.shape == (2, 0)
