"""The kernels for CUDA tensors: on a GPU where there is one, else in Triton's interpreter; and compiled without one."""

import importlib
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
import test_operators
import torch
from test_operators import operator_arguments

import diffpoint as dp
from benchmarks import gpu
from diffpoint._runtime import RUNTIME
from diffpoint.testing import tie_free_clouds

pytest.importorskip("triton", reason="triton has no wheel here")
from cuda_launches import (
    DEVICE,
    ON_GPU,
    WARNINGS,
    assert_same,
    compile_launches,
    on_cpu,
    on_device,
    recorded_launches,
)

from diffpoint.cuda import _MODULE_OF as kernels_of_operators
from diffpoint.cuda import errors

pytestmark = pytest.mark.filterwarnings(*WARNINGS)
DTYPES = (torch.float32, torch.float64)
LAUNCHES: dict[str, dict] = {}
OPERATORS = operator_arguments()
ROOT = Path(__file__).parents[1]
ELSEWHERE = {"earth_mover_distance", "knn"}
"""Tested in another file; copied to the CPU and back."""


@pytest.fixture(autouse=True)
def cuda_kernels() -> Iterator[None]:
    with recorded_launches(LAUNCHES):
        yield


def uneven_sets(dtype: torch.dtype, a_lengths: list[int], b_lengths: list[int]) -> list[torch.Tensor]:
    """Sets (B, 150, 3) and (B, 70, 3) and their lengths: NaN in the padding, and candidates that tie."""
    generator = torch.Generator().manual_seed(0)
    lengths = torch.tensor(a_lengths), torch.tensor(b_lengths)
    a, b = (
        torch.rand(len(n), s, 3, dtype=dtype, generator=generator)
        for n, s in zip(lengths, (150, 70), strict=True)
    )
    a[:, 20:40] = a[:, :20].clone()
    b[:, 35:] = b[:, :35].clone()
    for cloud, counts in ((a, lengths[0]), (b, lengths[1])):
        cloud[torch.arange(cloud.shape[1]) >= counts[:, None]] = torch.nan
    return [a, b, *lengths]


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest(dtype):
    def outputs(a, b, *lengths):
        a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
        found = dp.nearest(a, b, a_lengths=lengths[0], b_lengths=lengths[1])
        finite = torch.where(torch.isfinite(found.squared_distance), found.squared_distance, 0.0)
        return [*found, *torch.autograd.grad((finite * ramp(finite)).sum(), (a, b))]

    assert_same(outputs, *uneven_sets(dtype, [150, 37, 0, 150], [0, 5, 70, 70]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("squared", [True, False])
def test_chamfer(dtype, squared):
    def outputs(a, b, *lengths):
        a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
        lengths = {"a_lengths": lengths[0], "b_lengths": lengths[1]}
        found = dp.chamfer_distance(a, b, squared=squared, reduction="none", **lengths)
        total = sum((x * ramp(x)).sum() for x in found)
        return [*found, *dp.f_score(a, b, 0.1, **lengths), *torch.autograd.grad(total, (a, b))]

    assert_same(outputs, *uneven_sets(dtype, [150, 37, 1, 150], [70, 5, 70, 1]))


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
    points[~visible.any(1)] = torch.nan  # seen by no view

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

    largest = 66 if dtype == torch.float32 else 600  # squares of such distances overflow or vanish
    for scale in (2.0**largest, 2.0**-largest):
        scaled = points * torch.tensor([[[scale]], [[1.0]]], dtype=dtype)
        assert_same(outputs, scaled, lengths, torch.tensor([40, 170]), torch.tensor([3, 169]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("radius", "softness"), [(0.8, 0.3), (2.5, 0.01)])
def test_soft_splat(dtype, radius, softness):
    points = torch.rand(2, 150, 3, dtype=dtype) * 1.4 - 0.7
    points[0, 7] = points[0, 3]
    points[1, 90:] = torch.nan
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
    points[1, 250:] = torch.nan
    camera = dp.PinholeCamera.look_at(
        torch.tensor([[0.0, 0, -2], [2, 0.3, 0]]), focal_px=50.0, height=64, width=64
    )

    def outputs(points, lengths):
        return [dp.visible_points(points, camera.to(points), method="horizon", lengths=lengths)]

    (here,), (there,) = on_device(outputs, points, lengths), on_cpu(outputs, points, lengths)
    assert 0.2 < there.double().mean() < 0.6
    assert (here != there).double().mean() < 0.002  # logarithms are rounded differently


def other_points(points: torch.Tensor) -> torch.Tensor:
    """(B, 4, 3), of the dtype and on the device of the points."""
    numbers = torch.arange(12 * len(points), dtype=points.dtype, device=points.device)
    return torch.sin(7 * numbers).view(-1, 4, 3) / 2


def maps(points: torch.Tensor) -> torch.Tensor:
    """(B, 2, 16, 14) depth that depends on the points; empty where there are none, and in the upper rows."""
    depth = 2.0 + points.new_zeros(len(points), 2, 16, 14) + points.sum((1, 2))[:, None, None, None] / 20
    rows = torch.arange(16, device=points.device)[:, None]
    return depth.masked_fill((rows < 6) | (points.shape[1] == 0), torch.inf)


# Each op of clouds (B, N, 3) and their lengths.
ON_CLOUDS: dict[str, Callable[[torch.Tensor, torch.Tensor], Iterable[torch.Tensor]]] = {
    "nearest": lambda x, n: [
        *dp.nearest(x, other_points(x), a_lengths=n),
        *dp.nearest(other_points(x), x, b_lengths=n),
    ],
    "splat_depth": lambda x, n: dp.splat_depth(x, CAMERA.to(x), lengths=n),
    "splat_depth, discs": lambda x, n: dp.splat_depth(x, CAMERA.to(x), radius=1.5, lengths=n),
    "sample_view": lambda x, n: dp.sample_view(
        x, (torch.arange(x.shape[1], device=x.device) < n[:, None])[:, None].expand(-1, 2, -1)
    ),
    "project": lambda x, _: dp.project(x.nan_to_num(), CAMERA.to(x)),
    "unproject": lambda x, _: dp.unproject(maps(x.nan_to_num()), CAMERA.to(x)),
    "reproject": lambda x, _: dp.reproject(maps(x.nan_to_num()), CAMERA.to(x), CAMERA.to(x)[[1, 0]]),
    "soft_splat": lambda x, n: dp.soft_splat(x, CAMERA.to(x), lengths=n),
    "visible_points": lambda x, n: [dp.visible_points(x, CAMERA.to(x), method="horizon", lengths=n)],
    "farthest_point_sample": lambda x, n: [dp.farthest_point_sample(x, 3, lengths=n, allow_fewer=True)],
}
# And those that refuse empty clouds.
ON_FULL_CLOUDS = ON_CLOUDS | {
    "chamfer_distance": lambda x, n: dp.chamfer_distance(x, other_points(x), squared=False, a_lengths=n),
    "f_score": lambda x, n: dp.f_score(x, other_points(x), 0.3, a_lengths=n),
    "earth_mover_distance": lambda x, n: dp.earth_mover_distance(x, other_points(x), a_lengths=n),
    "approxmatch": lambda x, n: [dp.approxmatch(x, other_points(x), a_lengths=n)],
}
WITHOUT_GRADIENT = {"f_score", "visible_points", "farthest_point_sample"}


@pytest.mark.parametrize("name", ON_FULL_CLOUDS)
@pytest.mark.parametrize(
    "size", [(0, 5), (2, 0), (2, 6)], ids=["no clouds", "no points", "a cloud without points"]
)
def test_nothing(name, size):
    if name not in ON_CLOUDS and size[0]:
        return  # an error, below
    points = torch.rand(*size, 3, generator=torch.Generator().manual_seed(4)) - 0.5
    lengths = torch.tensor([0, size[1]])[: size[0]]
    points[:1] = torch.nan  # padding alone

    def outputs(points, lengths):
        points = points.clone().requires_grad_()
        found = list(ON_FULL_CLOUDS[name](points, lengths))
        total = sum(torch.where(torch.isfinite(x), x, 0.0).sum() for x in found if x.requires_grad)
        return [*found, *(torch.autograd.grad(total, points) if torch.is_tensor(total) else ())]

    assert_same(outputs, points, lengths)


def other_strides(x: torch.Tensor) -> torch.Tensor:
    return x.mT.contiguous().mT if x.dim() > 1 else x


@pytest.mark.parametrize("name", ON_FULL_CLOUDS)
def test_strides(name):
    """Neither those of the points nor those of the gradients change a bit; the gradient of a sum has strides of 0."""
    dense = torch.rand(2, 6, 3, generator=torch.Generator().manual_seed(4)).to(DEVICE) - 0.5
    lengths = torch.tensor([6, 4], device=DEVICE)

    def outputs(points, arrange):
        points = points.detach().requires_grad_()
        found = list(ON_FULL_CLOUDS[name](points, lengths))
        differentiable = [x for x in found if x.requires_grad]
        if not differentiable:
            return found
        return [
            *found,
            *torch.autograd.grad(differentiable, points, [arrange(x.detach()) for x in differentiable]),
        ]

    assert not other_strides(dense).is_contiguous()
    for points, arrange, wanted in (
        (other_strides(dense), ramp, ramp),
        (dense, lambda x: other_strides(ramp(x)), ramp),
        (dense, lambda x: x.new_ones(()).expand(x.shape), torch.ones_like),
    ):
        for here, there in zip(outputs(points, arrange), outputs(dense, wanted), strict=True):
            assert torch.equal(here, there)


@pytest.mark.parametrize("name", sorted(set(ON_FULL_CLOUDS) - WITHOUT_GRADIENT - {"approxmatch"}))
def test_gradients_are_those_of_differences(name):
    """Not of `approxmatch`, whose gradient holds the match fixed."""
    points = tie_free_clouds(2, 6, CAMERA, seed=2).to(DEVICE).requires_grad_()
    lengths = torch.tensor([6, 4], device=DEVICE)

    def outputs(points):
        found = [x for x in ON_FULL_CLOUDS[name](points, lengths) if x.requires_grad]
        return [torch.where(torch.isfinite(x), x, 0.0) for x in found]

    assert torch.autograd.gradcheck(outputs, points, fast_mode=True)


@pytest.mark.skipif(ON_GPU, reason="its camera is on the CPU")
def test_the_layer_compiles_into_one_graph():
    test_operators.test_the_layer_compiles_into_one_graph_and_exports()


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
        (lambda: dp.approxmatch(POINTS * 1e20, POINTS), "approxmatch: 'a' must span less than 1e18"),
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


@pytest.mark.skipif(ON_GPU, reason="on a GPU errors arrive later")
def test_checks_are_chosen(monkeypatch):
    monkeypatch.setattr(RUNTIME, "checks", RUNTIME.checks)
    dp.configure(checks="off")
    dp.nearest(BAD, POINTS)
    for checks in ("deferred", "immediate"):
        dp.configure(checks=checks)
        dp.nearest(POINTS, POINTS)  # what went unnoticed stays so
        with pytest.raises(ValueError, match="nearest: 'a' must be finite"):
            dp.nearest(BAD, POINTS)
    with pytest.raises(ValueError, match=r"configure: 'checks' must be one of .*; got 'never'"):
        dp.configure(checks="never")  # pyright: ignore[reportArgumentType]
    assert RUNTIME.checks == "immediate"


def test_what_is_pending_is_raised_on_request():
    """Flags on a device are counted there, as `soft_splat` and the cameras do with theirs."""
    flags = torch.tensor([True, False, True], device=DEVICE)
    assert errors.defer(flags, "soft_splat", "points", "finite")
    with pytest.raises(ValueError, match=r"soft_splat: 'points' must be finite; got 2 that are not"):
        dp.check_pending()
    dp.check_pending()


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


def test_the_cpu_never_needs_triton():
    """Every op and its gradient where triton cannot be imported. (torch itself looks for it when it traces.)"""
    code = """
import sys
sys.modules["triton"] = None
import torch
import diffpoint as dp
from test_operators import CAMERA, every_op
points = (torch.rand(2, 60, 3) - 0.5).requires_grad_()
found = every_op(points, torch.rand(2, 50, 3) - 0.5, CAMERA)
sum(torch.where(torch.isfinite(x), x, 0.0).sum() for x in found if x.requires_grad).backward()
dp.check_pending()
assert points.grad.any()
assert not [name for name in sys.modules if name.startswith("diffpoint.cuda")]
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


@pytest.mark.skipif(ON_GPU, reason="`python -m benchmarks gpu` does it")
def test_the_benchmark_of_a_gpu_knows_its_calls(tmp_path, capsys):
    """On CPU tensors, so that a mistake in the script does not first show on a borrowed GPU."""

    def ops(stop: float) -> Iterator[dict]:
        yield from gpu._ops(math.inf, "cpu", clouds=2, points=64)

    def without_a_package(stop: float) -> Iterator[dict]:
        importlib.import_module("a_package_that_is_missing")
        yield {}

    def that_fails(stop: float) -> Iterator[dict]:
        yield gpu._run("a program", [sys.executable, "-c", "raise SystemExit('no such thing')"], stop)

    parts = {"ops": ops, "steps": without_a_package, "tests": that_fails}
    machine = {"gpu": "none", "torch": torch.__version__, "triton": None}
    path = tmp_path / "results" / "gpu.json"
    assert on_cpu(lambda: gpu._measure(parts, machine, path, minutes=8)) == 1
    found = json.loads(path.read_text())
    assert len(found["ops"]) >= 7
    for row in found["ops"]:
        assert isinstance(row["diffpoint"], float), row
        assert row["differs"].startswith("0.0e+00"), row
    missing = "a package is missing: No module named 'a_package_that_is_missing'"
    assert found["steps"] == [{"left out": missing}]
    assert f"  {missing}\n" in capsys.readouterr().out
    (row,) = found["tests"]
    assert (row["status"], row["failed"]) == (1, "no such thing\n")
    page = path.with_suffix(".md").read_text()
    assert missing in page
    assert "earth mover's distance" in page
    assert gpu._measure({"tests": that_fails}, machine, path, minutes=0) == 0
    assert json.loads(path.read_text())["tests"] == [{"left out": "no time left"}]


@pytest.mark.skipif(ON_GPU, reason="there is one")
def test_without_a_gpu_its_benchmark_is_skipped_with_a_word(tmp_path):
    command = [sys.executable, "-m", "benchmarks", "gpu", "--out", str(tmp_path)]
    done = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.startswith("gpu: skipped: torch ")
    assert not list(tmp_path.iterdir())


# The last test: it compiles what the others have launched.
@pytest.mark.skipif(ON_GPU, reason="they have been compiled to run")
def test_kernels_compile_without_a_gpu(tmp_path):
    compile_launches(LAUNCHES, tmp_path)
