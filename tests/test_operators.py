"""The ops as torch operators: registered, traceable, on any device, and refusing a second derivative by name."""

from typing import Any

import pytest
import torch
from torch._library.custom_ops import OPDEFS

import diffpoint as dp
from diffpoint.testing import boundary_points

B, V, N, M, H, W = 2, 2, 9, 7, 6, 5


def operator_arguments() -> dict[str, tuple]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(B, N, 3, generator=generator).requires_grad_()
    b = torch.rand(B, M, 3, generator=generator).requires_grad_()
    lengths = torch.tensor([N, 4]), torch.tensor([3, M])
    camera = dp.PinholeCamera.look_at(
        torch.tensor([[0.0, 0, -2], [2, 0, 0]]), focal_px=5.0, height=H, width=W
    )
    camera = camera.expand(B, V)
    projection = camera.projection.clone().requires_grad_()
    depth = dp.splat_depth(a.detach(), camera).depth.requires_grad_()
    soft = tuple(x.requires_grad_() for x in dp.project(a.detach(), camera))
    return {
        "nearest": (a, b, *lengths),
        "nearest_both": (a, b, *lengths),
        "knn": (a, b, *lengths, 3, 0.8, False),
        "shares_within": (a.detach(), b.detach(), *lengths, 0.4),
        "splat": (a, lengths[0], projection, H, W, 0.0),
        "soft_splat": (*soft, lengths[0], H, W, 2.0, 0.05),
        "project": (a, projection),
        "unproject": (depth, camera.back_projection.clone().requires_grad_()),
        "reproject": (depth, camera.back_projection.clone().requires_grad_(), projection, H, W),
        "earth_mover_distance": (
            a,
            b,
            *lengths,
            torch.zeros(B, N),
            -torch.ones(B),
            torch.ones(B),
            0.02,
            True,
        ),
        "approxmatch": (a, b, *lengths, True),
        "farthest_point_sample": (
            a.detach(),
            lengths[0],
            torch.tensor([3, 2]),
            torch.tensor([0, 1]),
            -1,
            False,
        ),
        "sample_view": (a, dp.splat_depth(a, camera).visible),
        "visible": (a.detach(), lengths[0], projection.detach(), H, W, "horizon", 3.0, 0.4),
    }


@pytest.mark.parametrize("name", operator_arguments())
def test_operators_pass_opcheck(name):
    operator = getattr(torch.ops.diffpoint, name).default
    torch.library.opcheck(operator, operator_arguments()[name])


def test_every_operator_is_checked():
    registered = {name.removeprefix("diffpoint::") for name in OPDEFS if name.startswith("diffpoint::")}
    assert {name for name in registered if not name.endswith("_backward")} == set(operator_arguments())


@pytest.mark.parametrize(
    "function",
    [
        lambda a, b: dp.nearest(a, b).squared_distance.sum(),
        lambda a, b: dp.knn(a, b, 2).squared_distance.sum(),
        lambda a, b: sum(dp.chamfer_distance(a, b, squared=True)).sum(),
        lambda a, b: dp.earth_mover_distance(a, b).cost.sum(),
        lambda a, b: dp.earth_mover_distance(a, b, squared=True).cost.sum(),
    ],
)
def test_a_second_derivative_is_refused(function):
    a, b = torch.rand(1, 5, 3, requires_grad=True), torch.rand(1, 5, 3)
    (gradient,) = torch.autograd.grad(function(a, b), a, create_graph=True)
    with pytest.raises(RuntimeError, match=r"diffpoint\.\w+_backward.* no autograd formula"):
        gradient.square().sum().backward()


CAMERA = dp.PinholeCamera.look_at(
    torch.tensor([[0.0, 0, -2], [2, 0.3, 0]]), focal_px=30.0, height=16, width=14
)


def through_the_layer(points: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Splat, sample (a size that depends on the data) and compare."""
    splat = dp.splat_depth(points, CAMERA)
    seen = dp.sample_view(points, splat).points
    chamfer = dp.chamfer_distance(seen.flatten(1, 2), target, squared=False)
    return chamfer.a_to_b.mean() + chamfer.b_to_a.mean() + splat.depth.clamp(max=5).mean()


def test_the_layer_compiles_into_one_graph_and_exports():
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(2, 60, 3, generator=generator) - 0.5).requires_grad_()
    target = torch.rand(2, 50, 3, generator=generator) - 0.5
    plain = through_the_layer(points, target)
    compiled = torch.compile(through_the_layer, fullgraph=True, backend="aot_eager")(points, target)
    assert torch.allclose(plain, compiled)
    for x, y in zip(torch.autograd.grad(plain, points), torch.autograd.grad(compiled, points), strict=True):
        assert torch.allclose(x, y, atol=1e-6)

    class Layer(torch.nn.Module):
        def forward(self, points, target):
            return through_the_layer(points, target)

    exported = torch.export.export(Layer(), (points.detach(), target)).module()
    assert torch.allclose(exported(points.detach(), target), plain)


BATCHED = {
    "nearest": lambda a, b: dp.nearest(a, b).squared_distance,
    "knn": lambda a, b: dp.knn(a, b, 3).squared_distance,
    "chamfer_distance": lambda a, b: dp.chamfer_distance(a, b, squared=False).total,
    "earth_mover_distance": lambda a, b: dp.earth_mover_distance(a, b).cost,
    "approxmatch": dp.approxmatch,
    "farthest_point_sample": lambda a, _: dp.farthest_point_sample(a, 3),
    "splat_depth": lambda a, _: dp.splat_depth(a, CAMERA).depth,
}


@pytest.mark.parametrize("name", BATCHED)
def test_exported_for_batches_of_any_size(name):
    class Op(torch.nn.Module):
        def forward(self, a, b):
            return BATCHED[name](a, b)

    batch, n, m = (torch.export.Dim(size, min=4, max=99) for size in ("batch", "n", "m"))
    sizes = {0: batch, 1: n}, {0: batch, 1: m}
    exported = torch.export.export(Op(), (torch.rand(4, 9, 3), torch.rand(4, 8, 3)), dynamic_shapes=sizes)
    a, b = torch.rand(5, 11, 3), torch.rand(5, 6, 3)
    torch.testing.assert_close(exported.module()(a, b), BATCHED[name](a, b))


def test_compiled_with_sizes_that_are_not_fixed():
    """`size in (1, views)` is False for equal sizes while torch traces."""

    def reordered(depth):
        return dp.reproject(depth, CAMERA, CAMERA[[1, 0]]).depth

    depth = torch.full((3, 2, 16, 14), 2.0)
    compiled = torch.compile(reordered, backend="aot_eager", fullgraph=True, dynamic=True)
    torch.testing.assert_close(compiled(depth), reordered(depth))


LOSSES = {
    "front_constraint": dp.front_constraint,
    "front_constraint, emd": lambda *a, **k: dp.front_constraint(*a, distance="emd", tolerance=0.001, **k),
    "front_terms": lambda *a, **_: dp.front_terms(*a).loss,
    "projection_loss": dp.projection_loss,
    "projection_loss, upsampled": lambda *a, **k: dp.projection_loss(*a, upsample=2, mask_weight=0.1, **k),
    "soft_projection_loss": dp.soft_projection_loss,
}


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.filterwarnings("ignore:front_constraint:RuntimeWarning")
def test_losses_of_views_compile_into_one_graph(name):
    """Of three views one has an empty depth map, and one sees no predicted point."""
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(2, 60, 3, generator=generator) - 0.5).requires_grad_()
    eyes = torch.tensor([[0.0, 0, -2], [2, 0.3, 0], [0, 0, -9]])
    camera = dp.PinholeCamera.look_at(
        eyes, torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, -20]]), focal_px=30.0, height=16, width=14
    )
    depth = torch.where(torch.rand(2, 3, 16, 14, generator=generator) < 0.5, 2.0, torch.inf)
    depth[:, 1] = torch.inf
    plain = LOSSES[name](points, camera, depth, reduction="none")
    compiled = torch.compile(LOSSES[name], backend="aot_eager", fullgraph=True)(
        points, camera, depth, reduction="none"
    )
    torch.testing.assert_close(compiled, plain)
    assert plain[:, 0].all()
    ours, theirs = (torch.autograd.grad(loss.sum(), points)[0] for loss in (compiled, plain))
    torch.testing.assert_close(ours, theirs)


@pytest.fixture(scope="module")
def elsewhere() -> str:
    """A device whose tensors are not in the CPU's memory: torch's lazy device, which needs no accelerator."""
    backend = pytest.importorskip("torch._lazy.ts_backend")
    backend.init()
    return "lazy"


def every_op(points: torch.Tensor, target: torch.Tensor, camera: dp.PinholeCamera) -> list[torch.Tensor]:
    splat = dp.splat_depth(points, camera)
    sample = dp.sample_view(points, splat)
    unprojected = dp.unproject(splat.depth, camera)
    chosen = dp.farthest_point_sample(target, 7, lengths=torch.full((2,), 40, device=target.device))
    horizon = dp.visible_points(points, camera, method="horizon")
    outputs = [*splat, *sample, *dp.project(points, camera), *unprojected, chosen, horizon]
    outputs += dp.reproject(splat.depth, camera, camera[[1, 0]])
    outputs += dp.soft_splat(points, camera, lengths=torch.full((2,), 50, device=target.device))
    outputs += [*dp.nearest(points, target), *dp.chamfer_distance(points, target, squared=False)]
    outputs += dp.earth_mover_distance(points, target)
    outputs += dp.f_score(points, target, 0.1, b_lengths=torch.full((2,), 40, device=target.device))
    outputs += dp.knn(points, target, 4, a_lengths=torch.full((2,), 50, device=target.device))
    # The lazy device lacks a view that torch takes in the backward pass of masked_scatter: no gradient of this one.
    constraint = dp.front_constraint(points, camera, splat.depth.detach() + 0.1).detach()
    return [*outputs, dp.approxmatch(points, target), constraint]


def test_tensors_of_another_device_come_back_on_it_with_their_gradient(elsewhere):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, 60, 3, generator=generator) - 0.5
    target = torch.rand(2, 50, 3, generator=generator) - 0.5
    results, gradients = {}, {}
    for device in ("cpu", elsewhere):
        moved = points.to(device).requires_grad_()
        outputs = every_op(moved, target.to(device), CAMERA.to(device))
        assert {o.device.type for o in outputs} == {device}
        total = sum(torch.where(torch.isfinite(o), o, 0.0).sum() for o in outputs if o.requires_grad)
        (gradient,) = torch.autograd.grad(total, moved)
        assert gradient.device.type == device
        results[device], gradients[device] = [o.detach().cpu() for o in outputs], gradient.cpu()
    for here, there in zip(results["cpu"], results[elsewhere], strict=True):
        assert torch.allclose(here, there, atol=1e-5)
    assert torch.allclose(gradients["cpu"], gradients[elsewhere], atol=1e-4)


def test_devices_are_not_mixed(elsewhere):
    points = torch.rand(2, 60, 3)
    lengths = torch.tensor([3, 4])
    depth = torch.full((2, 2, 16, 14), 2.0)
    for call, name in (
        (lambda: dp.splat_depth(points.to(elsewhere), CAMERA), "camera"),
        (lambda: dp.splat_depth(points, CAMERA, lengths=lengths.to(elsewhere)), "lengths"),
        (lambda: dp.visible_points(points, CAMERA, lengths=lengths.to(elsewhere)), "lengths"),
        (lambda: dp.sample_view(points, torch.ones(2, 2, 60, dtype=torch.bool, device=elsewhere)), "splat"),
        (lambda: dp.project(points, CAMERA.to(elsewhere)), "camera"),
        (lambda: dp.reproject(depth, CAMERA, CAMERA.to(elsewhere)), "target"),
        (lambda: dp.nearest(points, points.to(elsewhere)), "b"),
        (lambda: dp.knn(points, points, 1, a_lengths=lengths.to(elsewhere)), "a_lengths"),
        (lambda: dp.nearest(points, points, b_lengths=lengths.to(elsewhere)), "b_lengths"),
        (lambda: dp.farthest_point_sample(points, 2, lengths=lengths.to(elsewhere)), "lengths"),
        (lambda: dp.projection_loss(points, CAMERA, depth.to(elsewhere)), "depth"),
        (lambda: dp.PinholeCamera(CAMERA.K.to(elsewhere), CAMERA.cam_from_world, 16, 14), "cam_from_world"),
    ):
        with pytest.raises(ValueError, match=f"'{name}' must be on the device of the other arguments"):
            call()


def every_camera() -> list[torch.Tensor]:
    camera = dp.PinholeCamera.look_at((0.3, 0.4, -2.1), (0.1, 0.2, 0.3), focal_px=30.3, height=16, width=14)
    R, T = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    cameras = [
        camera,
        dp.PinholeCamera.from_opengl(camera.K, camera.cam_from_world, 16, 14),
        dp.PinholeCamera.from_pytorch3d(R, T, camera.K, 16, 14),
        camera.resize(8, 7),
    ]
    return [m for c in cameras for m in (c.K, c.cam_from_world, c.position, c.projection, c.back_projection)]


def test_autocast_changes_no_bit():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, 60, 3, generator=generator) - 0.5
    target = torch.rand(2, 50, 3, generator=generator) - 0.5

    def everything() -> list[torch.Tensor]:
        moved = points.clone().requires_grad_()
        outputs = every_op(moved, target, CAMERA)
        depth = outputs[0].detach()
        outputs += [
            dp.projection_loss(moved, CAMERA, depth + 0.1, mask_weight=0.1, logits=moved[..., 0]),
            dp.soft_projection_loss(moved, CAMERA, depth + 0.1),
            dp.diversity_loss(points[:, None, 0], moved[:, None], alpha=0.1),
            dp.consistency_loss(moved),
            dp.visible_points(points, CAMERA, method="hpr"),
            boundary_points(points, CAMERA),
        ]
        total = sum(torch.where(torch.isfinite(o), o, 0.0).sum() for o in outputs if o.requires_grad)
        return [*outputs, *every_camera(), torch.autograd.grad(total, moved)[0]]

    plain = everything()
    with torch.autocast("cpu", torch.bfloat16):
        cast = everything()
        compiled = torch.compile(lambda x: dp.project(x, CAMERA).pixels, backend="aot_eager", fullgraph=True)
        assert torch.equal(compiled(points), dp.project(points, CAMERA).pixels)
    for x, y in zip(plain, cast, strict=True):
        assert x.dtype == y.dtype
        assert torch.equal(x, y)


def _results(device: str) -> dict[str, Any]:
    """Results of all ops whose sizes do not depend on values."""
    generator = torch.Generator().manual_seed(0)
    a, b = ((torch.rand(2, 30, 3, generator=generator) - 0.5).to(device).requires_grad_() for _ in range(2))
    camera = dp.PinholeCamera.look_at((0, 0, -2), focal_px=16.0, height=12, width=10).to(device)
    depth = torch.full((2, 1, 12, 10), 2.0, device=device)
    return {
        "splat": dp.splat_depth(a, camera),
        "soft_splat": dp.soft_splat(a, camera),
        "project": dp.project(a, camera),
        "unproject": dp.unproject(depth, camera),
        "reproject": dp.reproject(depth, camera, camera),
        "visible": (dp.visible_points(a, camera, method="horizon"),),
        "nearest": dp.nearest(a, b),
        "chamfer": dp.chamfer_distance(a, b, squared=True),
        "knn": dp.knn(a, b, 3),
        "emd": dp.earth_mover_distance(a, b),
        "approxmatch": (dp.approxmatch(a, b),),
        "f_score": dp.f_score(a, b, 0.1),
        "farthest": (dp.farthest_point_sample(a, 4),),
    }


def test_results_can_be_changed_in_place() -> None:
    """As in `depth[depth.isinf()] = 0`, which torch forbids on views that an operator returns."""
    for name, results in _results("cpu").items():
        for result in results:
            result.zero_()
            assert not result.any(), name
    points = torch.tensor([[[0.0, 0, 0], [0.1, 0.1, 0.5]]], requires_grad=True)
    camera = dp.PinholeCamera.look_at((0, 0, -2), focal_px=16.0, height=12, width=10)
    depth = dp.splat_depth(points, camera).depth
    depth[depth.isinf()] = 0
    depth.sum().backward()
    assert points.grad is not None
    assert points.grad[..., 2].tolist() == [[1, 1]]
    (expected,) = torch.autograd.grad(dp.soft_splat(points, camera).depth.nan_to_num(posinf=0).sum(), points)
    soft = dp.soft_splat(points, camera).depth
    soft[soft.isinf()] = 0
    assert torch.equal(torch.autograd.grad(soft.sum(), points)[0], expected)


@pytest.mark.parametrize("name", sorted(LOSSES))
@pytest.mark.filterwarnings("ignore:front_constraint:RuntimeWarning")
def test_the_default_device_is_not_that_of_the_arguments(name) -> None:
    points, depth = torch.rand(2, 9, 3) - 0.5, torch.full((2, 2, 16, 14), 2.0)
    expected = LOSSES[name](points, CAMERA, depth)
    with torch.device("meta"):
        assert torch.equal(LOSSES[name](points, CAMERA, depth), expected)


def test_tensors_without_values() -> None:
    for name, results in _results("cpu").items():
        for real, meta in zip(results, _results("meta")[name], strict=True):
            assert (meta.device.type, meta.shape, meta.dtype) == ("meta", real.shape, real.dtype), name


@pytest.mark.parametrize("size", [40, 5000])
@pytest.mark.parametrize("scale", [2.0**-80, 2.0**66])
def test_farthest_points_where_squares_leave_the_range(size: int, scale: float) -> None:
    """Of a batch of such clouds, and of one beside an ordinary cloud."""
    points = torch.rand(2, size, 3, generator=torch.Generator().manual_seed(0)) + 1
    lengths = torch.tensor([size, 20])
    expected = dp.farthest_point_sample(points, 9, lengths=lengths)
    for scales in (scale, torch.tensor([[[scale]], [[1.0]]])):
        assert torch.equal(dp.farthest_point_sample(points * scales, 9, lengths=lengths), expected)
    fine = points.double()
    wide = fine * 2.0 ** (600 if scale > 1 else -600)
    both = (dp.farthest_point_sample(x, 9, lengths=lengths) for x in (fine, wide))
    assert torch.equal(*both)
    if scale > 1:
        with pytest.raises(ValueError, match="approxmatch: 'a' must span less than 1e18"):
            dp.approxmatch(points[:, :9] * scale, points[:, :9].flip(1) * scale)
