"""What registration with torch costs: each op as a torch operator, and as a bare `autograd.Function`.

The bare ops are the same source once more, loaded with another `register`: what differs is the way from Python to the
launch, and nothing else.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch

import diffpoint as dp
from benchmarks.inputs import circle_of_cameras, leaf
from diffpoint import _bridge

_ROUNDS, _CALLS = 15, 20


def measure() -> list[dict[str, Any]]:
    """Microseconds per call on tiny inputs, in turns, medians of the means over some calls."""
    ops = {name: _bare(name) for name in ("distances", "splat", "reproject", "sampling", "transport")}
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(1, 16, 3, generator=generator) - 0.5 for _ in range(2))
    camera = circle_of_cameras(1, 8)

    def nearest(module: Any):
        return lambda: module.nearest(a, b)

    def nearest_and_back(module: Any):
        x = leaf(a)
        return lambda: module.nearest(x, b).squared_distance.sum().backward()

    def splat(module: Any):
        return lambda: module.splat_depth(a, camera)

    def splat_and_back(module: Any):
        x = leaf(a)
        return lambda: module.splat_depth(x, camera).depth.clamp(max=9).sum().backward()

    def project_and_back(module: Any):
        x = leaf(a)
        return lambda: module.project(x, camera).depth.sum().backward()

    def transport(module: Any):
        return lambda: module.earth_mover_distance(a, b)

    def farthest(module: Any):
        return lambda: module.farthest_point_sample(a, 4)

    return [
        _compare("nearest", nearest(dp), nearest(ops["distances"])),
        _compare("nearest, forward + backward", nearest_and_back(dp), nearest_and_back(ops["distances"])),
        _compare("splat_depth", splat(dp), splat(ops["splat"])),
        _compare("splat_depth, forward + backward", splat_and_back(dp), splat_and_back(ops["splat"])),
        _compare("project, forward + backward", project_and_back(dp), project_and_back(ops["reproject"])),
        _compare("earth_mover_distance", transport(dp), transport(ops["transport"])),
        _compare("farthest_point_sample (no gradient)", farthest(dp), farthest(ops["sampling"])),
    ]


def _compare(op: str, registered: Callable[[], Any], bare: Callable[[], Any]) -> dict[str, Any]:
    registered()  # compiles
    bare()
    micros: dict[str, list[float]] = {"registered_us": [], "bare_us": []}
    for _ in range(_ROUNDS):
        for name, call in (("registered_us", registered), ("bare_us", bare)):
            start = time.perf_counter()
            for _ in range(_CALLS):
                call()
            micros[name].append(1e6 * (time.perf_counter() - start) / _CALLS)
    return {"op": op, **{name: median(values) for name, values in micros.items()}}


def _bare(module: str) -> ModuleType:
    """`diffpoint.<module>` once more, with ops that are plain `autograd.Function`s."""
    source = Path(dp.__file__).parent / f"{module}.py"
    name = f"benchmarks._bare_{module}"
    spec = importlib.util.spec_from_file_location(name, source)
    assert spec is not None and spec.loader is not None
    copy = importlib.util.module_from_spec(spec)
    sys.modules[name] = copy
    with mock.patch.object(_bridge, "register", _register_bare):
        spec.loader.exec_module(copy)
    return copy


def _register_bare(
    name: str,
    *,
    fake: Callable,
    backward: Callable | None = None,
    setup: Callable | None = None,
    strided: bool = False,
) -> Callable[[Callable], Callable]:
    """Replaces `_bridge.register`: an `autograd.Function` instead of a torch operator."""

    def decorate(function: Callable) -> Callable:
        function = _bridge._on_cpu_tensors(function, strided)
        if backward is None or setup is None:
            return function
        members = SimpleNamespace(
            forward=staticmethod(function),
            setup_context=staticmethod(setup),
            backward=staticmethod(backward),
        )
        return type(name, (torch.autograd.Function,), vars(members)).apply

    return decorate
