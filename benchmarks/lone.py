"""Lone large clouds on one thread and on all: what an evaluation of one scan gains from more cores.

The number of threads is fixed at the first op of a process, so each is measured in a process of its own
(`python -m benchmarks.lone THREADS SECONDS` is what `python -m benchmarks` starts).
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

import diffpoint as dp
from benchmarks.inputs import circle_of_cameras, depth_maps, leaf, leaf_camera, pairs, surfaces

POINTS = 100_000
_CHOSEN = 4_096
_MATCHED = 8_192
_PIXELS = 316  # by 316, about as many as points


def measure(*, seconds: float) -> Iterator[dict[str, Any]]:
    """Rows of milliseconds on one thread and on all, of an op or of its backward pass alone.

    Args:
        seconds: for each op and number of threads.
    """
    threads = dp.runtime_info().threads
    one, every = (_in_a_process(number, seconds) for number in (1, threads))
    for op, ms in one.items():
        yield {"op": op, "threads": threads, "one_ms": ms, "all_ms": every[op]}


def _in_a_process(threads: int, seconds: float) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.lone", str(threads), str(seconds)]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)


def main(threads: int, seconds: float) -> None:
    dp.configure(threads=threads)
    torch.set_num_threads(threads)
    print(json.dumps({op: _milliseconds(prepare(), seconds) for op, prepare in OPS.items()}))


def _milliseconds(run: Callable[[], Any], seconds: float) -> float:
    """The median; the first run, which compiles, does not count."""
    run()
    durations: list[float] = []
    end = time.perf_counter() + seconds
    while len(durations) < 3 or time.perf_counter() < end:
        start = time.perf_counter()
        run()
        durations.append(time.perf_counter() - start)
    return 1e3 * statistics.median(durations)


def _backward(function: Callable[..., tuple[torch.Tensor, ...]], *inputs: Any) -> Callable[[], Any]:
    """The gradients of finite outputs to all inputs, computed again and again from one forward pass."""
    leaves = [leaf(x) if isinstance(x, torch.Tensor) else leaf_camera(x) for x in inputs]
    outputs = function(*leaves)
    weights = [torch.where(torch.isfinite(x), 1.0, 0.0) for x in outputs]
    tensors = [t for x in leaves for t in ((x,) if isinstance(x, torch.Tensor) else (x.K, x.cam_from_world))]
    return lambda: torch.autograd.grad(outputs, tensors, weights, retain_graph=True)


def _of_cloud(function: Callable[..., tuple[torch.Tensor, ...]]) -> Callable[[], Any]:
    return _backward(function, surfaces(1, POINTS), circle_of_cameras(1, _PIXELS))


def _on(call: Callable[..., Any], *inputs: torch.Tensor) -> Callable[[], Any]:
    return lambda: call(*inputs)


OPS: dict[str, Callable[[], Callable[[], Any]]] = {
    f"farthest_point_sample of {_CHOSEN}": lambda: _on(
        lambda x: dp.farthest_point_sample(x, _CHOSEN), surfaces(1, POINTS)
    ),
    f"earth_mover_distance of {_MATCHED}": lambda: _on(
        dp.earth_mover_distance, *pairs(1, _MATCHED, _MATCHED)
    ),
    "chamfer_distance": lambda: _on(
        lambda a, b: dp.chamfer_distance(a, b, squared=True), *pairs(1, POINTS, POINTS)
    ),
    "chamfer_distance, backward": lambda: _backward(
        lambda a, b: dp.chamfer_distance(a, b, squared=True), *pairs(1, POINTS, POINTS)
    ),
    "knn of 8, backward": lambda: _backward(lambda a, b: dp.knn(a, b, 8)[:1], *pairs(1, POINTS, POINTS)),
    "splat_depth, backward": lambda: _of_cloud(lambda x, camera: dp.splat_depth(x, camera)[:1]),
    "project, backward": lambda: _of_cloud(dp.project),
    "reproject, backward": lambda: _backward(
        lambda depth, camera: dp.reproject(depth, camera, camera)[:3], *depth_maps(1, _PIXELS)
    ),
    "soft_splat, backward": lambda: _of_cloud(dp.soft_splat),
}


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
