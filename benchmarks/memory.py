"""Peak extra memory of the ops: bytes beyond inputs and outputs, read from Linux's high-water mark.

Measured in a process of its own (`python -m benchmarks.memory` is what `python -m benchmarks` starts), whose allocator
gives every large block back: a peak is then what the op itself needed. Elsewhere than on Linux nothing is measured.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from torch import Tensor

import diffpoint as dp
from benchmarks.inputs import circle_of_cameras, leaf, pairs, surfaces

_STATUS = Path("/proc/self/status")
_GROWTH = 4
"""The larger set has so many times the points of the smaller one."""


def measure(what: str) -> Iterator[dict[str, Any]]:
    """Rows from a process of its own; none where memory cannot be measured.

    Args:
        what: "growth": megabytes at two sizes of every op; "races WORD": of ours in every race whose op holds the word.
    """
    if not _STATUS.exists():
        print("  memory is measured on Linux only")
        return
    environment = os.environ | {
        "MALLOC_MMAP_THRESHOLD_": "65536",  # larger blocks are returned when they are freed
        "MALLOC_ARENA_MAX": "1",
        "BENCHMARKS_WITHOUT_PEERS": "1",
    }
    command = [sys.executable, "-m", "benchmarks.memory", *what.split(" ", 1)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("{"):
                yield json.loads(line)
    if process.returncode:
        print(f"  memory: the measuring process ended with {process.returncode}")


def of_races(word: str) -> dict[str, float]:
    """Extra megabytes of ours, by op, size and direction."""
    return {row["race"]: row["extra_mb"] for row in measure(f"races {word}")}


def main(what: str, word: str = "") -> None:
    if what == "growth":
        for op, elements, prepare in _cases():
            row: dict[str, Any] = {"op": op}
            for size, factor in (("small", 1), ("large", _GROWTH)):
                row[f"{size}_elements"] = elements(factor)
                row[f"{size}_mb"] = extra_bytes(prepare(factor)) / 1e6
            print(json.dumps(row), flush=True)
        return
    from benchmarks.races import races

    for race in races():
        if word in race.op:
            name = f"{race.op} {race.size} {race.direction}"
            print(json.dumps({"race": name, "extra_mb": extra_bytes(race.ours.run) / 1e6}), flush=True)


def extra_bytes(call: Callable[[], Any]) -> int:
    """What the process holds at the peak of a call beyond what it holds before and what the call returns."""
    call()  # compiles
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    before = _read("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark falls to the present
    result = call()
    return max(0, _read("VmHWM") - before - _size(result))


def _read(name: str) -> int:
    found = re.search(rf"^{name}:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    return 1024 * int(found[1]) if found else 0


def _size(result: Any) -> int:
    if isinstance(result, Tensor):
        return result.untyped_storage().nbytes()
    return sum(map(_size, result)) if isinstance(result, (tuple, list)) else 0


Case = tuple[str, Callable[[int], int], Callable[[int], Callable[[], Any]]]


def _cases() -> Iterator[Case]:
    """Name, N + M + H W by factor, and the call by factor. Batches are small: extra memory per thread shows."""

    def two_sets(op: str, base: int, call: Callable[[Tensor, Tensor], Any]) -> Case:
        def prepare(factor: int) -> Callable[[], Any]:
            a, b = pairs(2, factor * base, factor * base)
            return lambda: call(a, b)

        return f"{op}, 2 x N x N", lambda factor: 2 * 2 * factor * base, prepare

    def one_set(op: str, base: int, call: Callable[[Tensor], Any]) -> Case:
        def prepare(factor: int) -> Callable[[], Any]:
            points = surfaces(2, factor * base)
            return lambda: call(points)

        return f"{op}, 2 x N", lambda factor: 2 * factor * base, prepare

    def rendered(op: str, call: Callable[[Tensor, dp.PinholeCamera], Any]) -> Case:
        def prepare(factor: int) -> Callable[[], Any]:
            points, camera = surfaces(2, factor * 65536), circle_of_cameras(2, round(256 * factor**0.5))
            return lambda: call(points, camera)

        return f"{op}, 2 x N, sqrt(N) x sqrt(N)", lambda factor: 2 * 2 * factor * 65536, prepare

    def with_gradient(loss: Callable[..., Tensor]) -> Callable[..., Any]:
        def run(*inputs: Any) -> list[Tensor | None]:
            leaves = [leaf(x) if isinstance(x, Tensor) else x for x in inputs]
            loss(*leaves).sum().backward()
            # The leaves, copies of the inputs, are no more the op's than its gradients, which are results.
            tensors = [x for x in leaves if isinstance(x, Tensor)]
            return [*tensors, *(x.grad for x in tensors)]

        return run

    def chamfer(a: Tensor, b: Tensor) -> Tensor:
        both = dp.chamfer_distance(a, b, squared=False)
        return both.a_to_b + both.b_to_a

    yield two_sets("nearest", 65536, dp.nearest)
    yield two_sets("chamfer_distance", 65536, lambda a, b: dp.chamfer_distance(a, b, squared=False))
    yield two_sets("chamfer_distance forward + backward", 65536, with_gradient(chamfer))
    yield two_sets("earth_mover_distance", 2048, dp.earth_mover_distance)
    yield two_sets("approxmatch", 2048, dp.approxmatch)
    yield one_set("farthest_point_sample of 64", 262144, lambda x: dp.farthest_point_sample(x, 64))
    yield rendered("splat_depth", dp.splat_depth)
    yield rendered("splat_depth, radius 1", lambda x, camera: dp.splat_depth(x, camera, radius=1.0))
    yield rendered(
        "splat_depth forward + backward",
        with_gradient(lambda x, camera: dp.splat_depth(x, camera).depth.clamp(max=9)),
    )
    yield rendered("sample_view", lambda x, camera: dp.sample_view(x, dp.splat_depth(x, camera)))
    yield rendered(
        "visible_points, horizon", lambda x, camera: dp.visible_points(x, camera, method="horizon")
    )
    yield rendered("project", dp.project)
    yield rendered(
        "front_constraint",
        lambda x, camera: dp.front_constraint(x, camera, dp.splat_depth(x, camera).depth),
    )
    yield rendered(
        "splat, then unproject", lambda x, camera: dp.unproject(dp.splat_depth(x, camera).depth, camera)
    )
    yield rendered(
        "splat, then reproject",
        lambda x, camera: dp.reproject(dp.splat_depth(x, camera).depth, camera, camera),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
