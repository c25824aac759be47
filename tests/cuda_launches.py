"""What the tests of the kernels for CUDA tensors share: launches are run in the interpreter, recorded and compiled."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from diffpoint import _bridge
from diffpoint.cuda import launch
from diffpoint.testing import assert_close, cuda_kernels_interpreted

ON_GPU = torch.cuda.is_available()
DEVICE = "cuda" if ON_GPU else "cpu"
WARNINGS = ("ignore::RuntimeWarning", "error:divide by zero encountered in (fmod|floor):RuntimeWarning")
"""The interpreter computes with numpy, which warns of infinities; an integer divided by zero is a mistake."""


@contextlib.contextmanager
def recorded_launches(launches: dict[str, dict]) -> Iterator[None]:
    """Inside, the kernels run in the interpreter where there is no GPU; what was launched is added to `launches`."""
    if ON_GPU:
        yield
        return
    launch.recorded = []
    with cuda_kernels_interpreted():
        yield
    for kernel, arguments, options in launch.recorded:
        constants = _constants(kernel)
        described = {
            "module": kernel.fn.__module__,
            "kernel": kernel.fn.__name__,
            "arguments": [
                value if constant or _is_one(value) else launch.type_name(value)
                for value, constant in zip(arguments, constants, strict=True)
            ],
            "options": options,
        }
        launches[json.dumps(described)] = described
    launch.recorded = None


def _is_one(value: Any) -> bool:
    """Triton compiles a kernel anew for an integer that is 1, which becomes a constant."""
    return not isinstance(value, torch.Tensor) and value == 1


def _constants(kernel: Any) -> list[bool]:
    names = kernel.fn.__code__.co_varnames[: kernel.fn.__code__.co_argcount]
    return ["constexpr" in str(kernel.fn.__annotations__.get(n, "")) for n in names]


def compile_launches(launches: dict[str, dict], folder: Path) -> None:
    """Compiles recorded launches to machine code, in a process where the interpreter is off."""
    assert launches
    file = folder / "launches.json"
    file.write_text(json.dumps(list(launches.values())))
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment |= {"TRITON_CACHE_DIR": str(folder / "cache"), "TRITON_DEFAULT_FP_FUSION": "0"}
    root = Path(__file__).parents[1]
    command = [sys.executable, str(root / "tests" / "compile_cuda_kernels.py"), str(file)]
    environment["PYTHONPATH"] = str(root)
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-4000:]
    assert len(done.stdout.splitlines()) == 2 * len(launches)


def on_device(function: Callable, *arguments: Any) -> list[torch.Tensor]:
    """A function's results with arguments on the GPU, or with the interpreter, moved to the CPU."""
    return [result.cpu() for result in function(*(a.to(DEVICE) for a in arguments))]


def on_cpu(function: Callable, *arguments: Any) -> Any:
    """The result of the CPU kernels, which have tests of their own."""
    before, _bridge.interpreted = _bridge.interpreted, False
    try:
        return function(*(a.cpu() for a in arguments))
    finally:
        _bridge.interpreted = before


def assert_same(function: Callable, *arguments: Any) -> None:
    """The kernels for CUDA give what those for the CPU give, sums up to rounding of their largest terms; and the same
    bits again."""
    results = on_device(function, *arguments)
    if ON_GPU:
        for here, again in zip(results, on_device(function, *arguments), strict=True):
            assert torch.equal(here, again)
    for here, there in zip(results, on_cpu(function, *arguments), strict=True):
        finite = there.detach()[torch.isfinite(there)].double().abs()
        assert_close(here, there, scale=max(1.0, float(finite.max())) if finite.numel() else 1.0)
