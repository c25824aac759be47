"""The kernels for CUDA tensors: on a GPU where there is one, else in Triton's interpreter; and compiled without one."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import diffpoint as dp
from diffpoint import _bridge
from diffpoint.testing import assert_close, cuda_kernels_interpreted

pytest.importorskip("triton", reason="triton has no wheel here")
from diffpoint.cuda import launch  # noqa: E402

ON_GPU = torch.cuda.is_available()
DEVICE = "cuda" if ON_GPU else "cpu"
DTYPES = (torch.float32, torch.float64)
LAUNCHES: dict[str, dict] = {}


@pytest.fixture(autouse=True)
def cuda_kernels() -> Iterator[None]:
    """Runs the kernels in the interpreter where there is no GPU, and remembers what was launched."""
    if ON_GPU:
        yield
        return
    launch.recorded = []
    with cuda_kernels_interpreted():
        yield
    for kernel, arguments, warps in launch.recorded:
        constants = [p == "constexpr" for p in annotations(kernel)]
        described = {
            "module": kernel.fn.__module__,
            "kernel": kernel.fn.__name__,
            "arguments": [
                value if constant else launch.type_name(value)
                for value, constant in zip(arguments, constants, strict=True)
            ],
            "warps": warps,
        }
        LAUNCHES[json.dumps(described)] = described
    launch.recorded = None


def annotations(kernel) -> list[str]:
    names = kernel.fn.__code__.co_varnames[: kernel.fn.__code__.co_argcount]
    return ["constexpr" if "constexpr" in str(kernel.fn.__annotations__.get(n, "")) else "" for n in names]


def on_cpu(function, *arguments):
    """The result of the CPU kernels, which have tests of their own."""
    before, _bridge.interpreted = _bridge.interpreted, False
    try:
        return function(*arguments)
    finally:
        _bridge.interpreted = before


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest(dtype):
    a, b = torch.rand(3, 150, 3, dtype=dtype), torch.rand(3, 70, 3, dtype=dtype)
    lengths = torch.tensor([150, 37, 0]), torch.tensor([0, 5, 70])

    def outputs(a, b, *lengths):
        a, b = a.clone().requires_grad_(), b.clone().requires_grad_()
        found = dp.nearest(a, b, a_lengths=lengths[0], b_lengths=lengths[1])
        finite = torch.where(torch.isfinite(found.squared_distance), found.squared_distance, 0.0)
        return [*found, *torch.autograd.grad(finite.sum(), (a, b))]

    for here, there in zip(outputs(a, b, *lengths), on_cpu(outputs, a, b, *lengths), strict=True):
        assert_close(here, there)


# The last test: it compiles what the others have launched.
@pytest.mark.skipif(ON_GPU, reason="they have been compiled to run")
def test_kernels_compile_without_a_gpu(tmp_path):
    assert LAUNCHES
    file = tmp_path / "launches.json"
    file.write_text(json.dumps(list(LAUNCHES.values())))
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment |= {"TRITON_CACHE_DIR": str(tmp_path / "cache"), "TRITON_DEFAULT_FP_FUSION": "0"}
    root = Path(__file__).parents[1]
    command = [sys.executable, str(root / "tests" / "compile_cuda_kernels.py"), str(file)]
    environment["PYTHONPATH"] = str(root)
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-4000:]
    assert len(done.stdout.splitlines()) == 2 * len(LAUNCHES)
