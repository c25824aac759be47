"""The kernels for CUDA tensors: on a GPU where there is one, else in Triton's interpreter; and compiled without one."""

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from test_operators import operator_arguments

import diffpoint as dp
from benchmarks import gpu

pytest.importorskip("triton", reason="triton has no wheel here")
from cuda_launches import DEVICE, ON_GPU, assert_same, compile_launches, on_cpu, on_device, recorded_launches

from diffpoint.cuda import _MODULE_OF as kernels_of_operators
from diffpoint.cuda import errors

# The interpreter computes with numpy, which warns of infinities.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
DTYPES = (torch.float32, torch.float64)
LAUNCHES: dict[str, dict] = {}
OPERATORS = operator_arguments()
ELSEWHERE = {"earth_mover_distance", "knn"}
"""Tested in another file; copied to the CPU and back."""


@pytest.fixture(autouse=True)
def cuda_kernels() -> Iterator[None]:
    with recorded_launches(LAUNCHES):
        yield


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest(dtype):
    a, b = torch.rand(3, 150, 3, dtype=dtype), torch.rand(3, 70, 3, dtype=dtype)
    lengths = torch.tensor([150, 37, 0]), torch.tensor([0, 5, 70])

    def outputs(a, b, *lengths):
        a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
        found = dp.nearest(a, b, a_lengths=lengths[0], b_lengths=lengths[1])
        finite = torch.where(torch.isfinite(found.squared_distance), found.squared_distance, 0.0)
        return [*found, *torch.autograd.grad(finite.sum(), (a, b))]

    assert_same(outputs, a, b, *lengths)


@pytest.mark.parametrize("dtype", DTYPES)
def test_approxmatch(dtype):
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(3, size, 3, dtype=dtype, generator=generator) - 0.5 for size in (70, 40))
    lengths = torch.tensor([70, 9, 1]), torch.tensor([30, 40, 1])
    b[0, 4] = a[0, 7]  # no direction between coinciding points
    for cloud, counts in zip((a, b), lengths, strict=True):
        cloud[torch.arange(cloud.shape[1]) >= counts[:, None]] = torch.nan

    def outputs(a, b, *lengths):
        a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
        cost = dp.approxmatch(a, b, a_lengths=lengths[0], b_lengths=lengths[1])
        with torch.no_grad():
            alone = dp.approxmatch(a, b, a_lengths=lengths[0], b_lengths=lengths[1])
        return [cost, alone, *torch.autograd.grad(cost @ torch.tensor([1.0, 2, 3]).to(cost), (a, b))]

    assert_same(outputs, a, b, *lengths)


CAMERA = dp.PinholeCamera.look_at(
    torch.tensor([[0.0, 0, -2], [2, 0.3, 0]]), focal_px=30.0, height=16, width=14
)


def ramp(values: torch.Tensor) -> torch.Tensor:
    """A weight for each value, all different."""
    return torch.linspace(-1, 1, values.numel(), dtype=values.dtype, device=values.device).view_as(values)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("radius", [0.0, 0.3, 1.0, 2.6])
def test_splat(dtype, radius):
    points = torch.rand(2, 200, 3, dtype=dtype, generator=torch.Generator().manual_seed(1)) * 1.4 - 0.7
    points[0, 7] = points[0, 3]  # of equal depths the lower index wins
    points[1, 150:] = torch.nan
    lengths = torch.tensor([200, 150])

    def outputs(points, lengths):
        points = points.clone().requires_grad_()
        camera = CAMERA.to(points)
        matrices = camera.cam_from_world.clone().requires_grad_()
        camera = dp.PinholeCamera(camera.K, matrices, 16, 14)
        maps = dp.splat_depth(points, camera, radius=radius, lengths=lengths)
        weights = ramp(maps.depth)
        total = (torch.where(maps.index >= 0, maps.depth, 0.0) * weights).sum()
        return [*maps, *torch.autograd.grad(total, (points, matrices))]

    assert_same(outputs, points, lengths)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sample_view(dtype):
    points = torch.rand(2, 300, 3, dtype=dtype) - 0.5
    visible = torch.rand(2, 3, 300) < 0.3
    visible[1, 2] = False

    def outputs(points, visible):
        points = points.clone().requires_grad_()
        sample = dp.sample_view(points, visible)
        weights = ramp(sample.points)
        return [*sample, *torch.autograd.grad((sample.points * weights).sum(), points)]

    assert_same(outputs, points, visible)


@pytest.mark.parametrize("dtype", DTYPES)
def test_projections(dtype):
    points = torch.rand(2, 300, 3, dtype=dtype) * 5 - 2.5  # some behind the cameras
    depth = dp.splat_depth(points, CAMERA.to(dtype), radius=1.0).depth

    def outputs(points, depth):
        inputs = [points, depth, CAMERA.to(points).cam_from_world, CAMERA.to(points).K]
        points, depth, matrices, K = inputs = [x.clone().requires_grad_() for x in inputs]
        camera = dp.PinholeCamera(K, matrices, 16, 14)
        found = [*dp.project(points, camera), *dp.unproject(depth, camera)]
        found += dp.reproject(depth, camera, camera[[1, 0]])
        values = [torch.where(torch.isfinite(x), x, 0.0) for x in found if x.is_floating_point()]
        total = sum((x * ramp(x)).sum() for x in values)
        return [*found, *torch.autograd.grad(total, inputs)]

    assert_same(outputs, points, depth)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("registers", [8192, 0])
def test_farthest_points(dtype, registers, monkeypatch):
    from diffpoint.cuda import sampling

    monkeypatch.setattr(sampling, "_REGISTERS", registers)
    monkeypatch.setattr(sampling, "_TILE", 128)
    points = torch.rand(2, 300, 3, dtype=dtype)
    points[0, 100:] = points[0, :200].clone()  # of equal distances the lower index wins
    points[1, 170:] = torch.nan
    lengths = torch.tensor([300, 170])
    assert_same(lambda *x: [dp.farthest_point_sample(x[0], 20, start=5, lengths=x[1])], points, lengths)
    points[0, 20:] = points[0, 0].clone()  # no point is chosen twice

    def outputs(points, lengths, k, start):
        return [dp.farthest_point_sample(points, k, start=start, lengths=lengths, allow_fewer=True)]

    assert_same(outputs, points, lengths, torch.tensor([40, 180]), torch.tensor([3, 169]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("radius", "softness"), [(0.8, 0.3), (2.5, 0.01)])
def test_soft_splat(dtype, radius, softness):
    points = torch.rand(2, 150, 3, dtype=dtype) * 1.4 - 0.7
    lengths = torch.tensor([150, 90])

    def outputs(points, lengths):
        points = points.clone().requires_grad_()
        camera = CAMERA.to(points)
        soft = dp.soft_splat(points, camera, radius=radius, softness=softness, lengths=lengths)
        weights = ramp(soft.depth)
        total = (torch.where(soft.coverage > 0, soft.depth, 0.0) * weights + soft.mask).sum()
        return [*soft, *torch.autograd.grad(total, points)]

    assert_same(outputs, points, lengths)


@pytest.mark.parametrize("dtype", DTYPES)
def test_horizon(dtype):
    generator = torch.Generator().manual_seed(0)
    points = (
        torch.nn.functional.normalize(torch.randn(2, 400, 3, generator=generator, dtype=dtype), dim=-1) / 2
    )
    lengths = torch.tensor([400, 250])
    camera = dp.PinholeCamera.look_at(
        torch.tensor([[0.0, 0, -2], [2, 0.3, 0]]), focal_px=50.0, height=64, width=64
    )

    def outputs(points, lengths):
        return [dp.visible_points(points, camera.to(points), method="horizon", lengths=lengths)]

    (here,), (there,) = on_device(outputs, points, lengths), on_cpu(outputs, points, lengths)
    assert 0.2 < there.double().mean() < 0.6
    assert (here != there).double().mean() < 0.002  # logarithms are rounded differently


@pytest.mark.parametrize("name", sorted(set(OPERATORS) - ELSEWHERE))
def test_operators_pass_opcheck(name):
    assert name in kernels_of_operators
    arguments = on_cpu(operator_arguments)[name]
    moved = [
        x.detach().to(DEVICE).requires_grad_(x.requires_grad) if torch.is_tensor(x) else x for x in arguments
    ]
    torch.library.opcheck(getattr(torch.ops.diffpoint, name).default, tuple(moved))


POINTS = torch.rand(2, 40, 3)
BAD = POINTS.index_fill(1, torch.tensor([3]), torch.nan)
SHORT = torch.tensor([40, 41])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dp.nearest(BAD, POINTS), "nearest: 'a' must be finite; got nan at index"),
        (lambda: dp.nearest(POINTS, POINTS, b_lengths=SHORT), "nearest: 'b_lengths' must lie in"),
        (lambda: dp.chamfer_distance(POINTS, BAD, squared=True), "chamfer_distance: 'b' must be finite"),
        (lambda: dp.chamfer_distance(POINTS, POINTS[:, :0], squared=True), "'b' must hold at least one point"),
        (lambda: dp.chamfer_distance(POINTS, POINTS, squared=True, a_lengths=SHORT * 0), "empty set has no"),
        (lambda: dp.approxmatch(POINTS, BAD), "approxmatch: 'b' must be finite"),
        (lambda: dp.approxmatch(POINTS, POINTS, a_lengths=SHORT * 0), "approxmatch: 'a_lengths' must lie in"),
        (lambda: dp.splat_depth(BAD, CAMERA), "splat_depth: 'points' must be finite"),
        (lambda: dp.splat_depth(POINTS, CAMERA, lengths=SHORT), "splat_depth: 'lengths' must lie in"),
        (lambda: dp.sample_view(BAD, torch.ones(2, 1, 40) > 0), "sample_view: 'points' must be finite"),
        (lambda: dp.project(BAD, CAMERA), "project: 'points' must be finite"),
        (lambda: dp.unproject(torch.zeros(1, 2, 16, 14), CAMERA), "unproject: 'depth' must be positive"),
        (lambda: dp.reproject(torch.zeros(1, 2, 16, 14), CAMERA, CAMERA), "reproject: 'depth' must be positive"),
        (lambda: dp.farthest_point_sample(BAD, 5), "farthest_point_sample: 'points' must be finite"),
        (lambda: dp.farthest_point_sample(POINTS, 41), "'k' must be at most 40"),
        (lambda: dp.soft_splat(POINTS, CAMERA, lengths=SHORT), "soft_splat: 'lengths' must lie in"),
        (lambda: dp.visible_points(BAD, CAMERA, method="horizon"), "visible_points: 'points' must be finite"),
    ],
)  # fmt: skip
@pytest.mark.skipif(ON_GPU, reason="on a GPU errors arrive later")
def test_values_that_are_not_allowed_are_named(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()
    dp.nearest(POINTS, POINTS)  # and only once


def test_errors_arrive_without_a_wait():
    """What `settle` does on a GPU by default; on the CPU a copy arrives at once."""
    state = errors._Counters(torch.device(DEVICE))
    errors._poll(state)
    errors._poll(state)
    slot = errors._names.setdefault(("splat_depth", "points", "finite"), len(errors._names))
    state.values[slot] += 3
    errors._poll(state)  # a look at the copy from before, and a new copy
    if ON_GPU:
        torch.cuda.synchronize()
    with pytest.raises(
        ValueError, match=r"splat_depth: 'points' must be finite; got 3 that are not\. An operator has"
    ):
        errors._poll(state)
    errors._poll(state)
    assert not state.values.any()


def test_the_cpu_never_imports_triton():
    code = (
        "import sys, torch, diffpoint as dp; a = torch.rand(1, 9, 3); "
        "dp.chamfer_distance(a, a, squared=True); dp.check_pending(); "
        "assert not [m for m in sys.modules if m.startswith('diffpoint.cuda')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])


@pytest.mark.skipif(ON_GPU, reason="`python -m benchmarks gpu` does it")
def test_the_benchmark_of_a_gpu_knows_its_calls():
    """On CPU tensors, so that a mistake in the script does not first show on a borrowed GPU."""
    for row in on_cpu(lambda: list(gpu._ops(math.inf, "cpu", clouds=2, points=64))):
        assert isinstance(row["diffpoint"], float) and row["differs"].startswith("0.0e+00"), row


# The last test: it compiles what the others have launched.
@pytest.mark.skipif(ON_GPU, reason="they have been compiled to run")
def test_kernels_compile_without_a_gpu(tmp_path):
    compile_launches(LAUNCHES, tmp_path)
