"""What registration with torch costs: each op as a torch operator, and as a bare `autograd.Function`.

The bare ops are the same source files, loaded with another `register`; only the path from Python to the launch differs.
"""

from __future__ import annotations

import functools
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
from benchmarks.inputs import circle_of_cameras
from diffpoint import _bridge

_ROUNDS, _CALLS = 15, 20


def measure() -> list[dict[str, Any]]:
    """Microseconds per call on tiny inputs, in turns, medians of the means over some calls."""
    bare = {name: _bare(name) for name in ("distances", "splat", "reproject", "sampling", "transport")}
    generator = torch.Generator().manual_seed(0)
    a, b, x = (torch.rand(1, 16, 3, generator=generator) - 0.5 for _ in range(3))
    x.requires_grad_()
    camera = circle_of_cameras(1, 8)
    calls: dict[str, tuple[str, Callable[[Any], Any]]] = {
        "nearest": ("distances", lambda m: m.nearest(a, b)),
        "nearest, forward + backward": (
            "distances",
            lambda m: m.nearest(x, b).squared_distance.sum().backward(),
        ),
        "splat_depth": ("splat", lambda m: m.splat_depth(a, camera)),
        "splat_depth, forward + backward": (
            "splat",
            lambda m: m.splat_depth(x, camera).depth.clamp(max=9).sum().backward(),
        ),
        "project, forward + backward": ("reproject", lambda m: m.project(x, camera).depth.sum().backward()),
        "earth_mover_distance": ("transport", lambda m: m.earth_mover_distance(a, b)),
        "farthest_point_sample (no gradient)": ("sampling", lambda m: m.farthest_point_sample(a, 4)),
    }
    return [
        _compare(op, functools.partial(call, dp), functools.partial(call, bare[module]))
        for op, (module, call) in calls.items()
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
    """A copy of `diffpoint.<module>` whose ops are plain `autograd.Function`s."""
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
        function = _bridge._on_any_device(name, function, strided)
        if backward is None or setup is None:
            return function
        members = SimpleNamespace(
            forward=staticmethod(function),
            setup_context=staticmethod(setup),
            backward=staticmethod(backward),
        )
        return type(name, (torch.autograd.Function,), vars(members)).apply

    return decorate
