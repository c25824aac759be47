"""Peak extra memory of the ops: bytes beyond inputs and outputs, read from Linux's high-water mark.

Measured in a process of its own (`python -m benchmarks.memory` is what `python -m benchmarks` starts), whose allocator
returns every large block when it is freed, so that the peak is due to the op. On other systems nothing is measured.
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
"""Number of points of the larger input, relative to the smaller one."""


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
    """Peak memory of the process in a call, minus the memory before it and that of the result."""
    call()  # compiles
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    before = _read("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
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

    def case(op: str, size: str, elements: int, inputs: Callable[[int], tuple], call: Callable) -> Case:
        def prepare(factor: int) -> Callable[[], Any]:
            own = inputs(factor)
            return lambda: call(*own)

        return f"{op}, 2 x {size}", lambda factor: 2 * factor * elements, prepare

    def two_sets(op: str, base: int, call: Callable[[Tensor, Tensor], Any]) -> Case:
        return case(op, "N x N", 2 * base, lambda factor: pairs(2, factor * base, factor * base), call)

    def rendered(op: str, call: Callable[[Tensor, dp.PinholeCamera], Any]) -> Case:
        def inputs(factor: int) -> tuple[Tensor, dp.PinholeCamera]:
            return surfaces(2, factor * 65536), circle_of_cameras(2, round(256 * factor**0.5))

        return case(op, "N, sqrt(N) x sqrt(N)", 2 * 65536, inputs, call)

    def with_gradient(loss: Callable[..., Tensor]) -> Callable[..., Any]:
        def run(*inputs: Any) -> list[Tensor | None]:
            leaves = [leaf(x) if isinstance(x, Tensor) else x for x in inputs]
            loss(*leaves).sum().backward()
            # Neither the leaves, copies of the inputs, nor their gradients count as extra memory of the op.
            tensors = [x for x in leaves if isinstance(x, Tensor)]
            return [*tensors, *(x.grad for x in tensors)]

        return run

    def chamfer(a: Tensor, b: Tensor) -> Tensor:
        both = dp.chamfer_distance(a, b, squared=False)
        return both.total

    yield two_sets("nearest", 65536, dp.nearest)
    yield two_sets("knn of 8", 65536, lambda a, b: dp.knn(a, b, 8))
    yield two_sets("chamfer_distance", 65536, lambda a, b: dp.chamfer_distance(a, b, squared=False))
    yield two_sets("chamfer_distance forward + backward", 65536, with_gradient(chamfer))
    yield two_sets("earth_mover_distance", 2048, dp.earth_mover_distance)
    yield two_sets("approxmatch", 2048, dp.approxmatch)
    yield case(
        "farthest_point_sample of 64",
        "N",
        262144,
        lambda factor: (surfaces(2, factor * 262144),),
        lambda x: dp.farthest_point_sample(x, 64),
    )
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
