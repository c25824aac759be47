"""How times grow with the number of points: medians over N and batch, and the exponent from 16k on."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffpoint as dp
from benchmarks.inputs import circle_of_cameras, pairs, surfaces

SIZES = tuple(2**k for k in (10, 12, 14, 16, 18, 20))  # 1k to 1M
BATCHES = (1, 16, 80)
FITTED_FROM = 2**14
_LARGEST = {"farthest_point_sample, N / 8": 2**16}
_RUNS = 3
_POINTS = 80 * 2**18  # in a batch, because of memory

Prepare = Callable[[int, int], Callable[[], Any]]


def _splat(batch: int, n: int) -> Callable[[], Any]:
    points, camera = surfaces(batch, n), circle_of_cameras(batch, 56)
    return lambda: dp.splat_depth(points, camera)


def _nearest(batch: int, n: int) -> Callable[[], Any]:
    a, b = pairs(batch, n, n)
    return lambda: (dp.nearest(a, b), dp.nearest(b, a))


def _farthest(batch: int, n: int) -> Callable[[], Any]:
    points = surfaces(batch, n)
    return lambda: dp.farthest_point_sample(points, n // 8)


OPS: dict[str, Prepare] = {
    "splat_depth, 56 x 56": _splat,
    "nearest, both ways, N x N": _nearest,
    "farthest_point_sample, N / 8": _farthest,
}


def measure(*, longest: float, sizes: tuple[int, ...] = SIZES) -> Iterator[dict[str, Any]]:
    """Rows of milliseconds per batch; sizes whose run would exceed `longest` seconds are skipped, with a line.

    Args:
        longest: seconds that one run may take, extrapolated from the size before.
        sizes: numbers of points.
    """
    for op, prepare in OPS.items():
        for batch in BATCHES:
            before: tuple[int, float] | None = None
            for n in (n for n in sizes if n <= _LARGEST.get(op, n)):
                # Between linear and quadratic.
                expected = before[1] * (n / before[0]) ** 1.3 if before else 0.0
                if expected > longest or batch * n > _POINTS:
                    why = f"{expected:.0f} s a run" if expected > longest else "memory"
                    print(f"  {op}: {batch} x {n} and larger skipped ({why})", flush=True)
                    break
                call = prepare(batch, n)
                call()  # compiles
                seconds = []
                for _ in range(_RUNS):
                    start = time.perf_counter()
                    call()
                    seconds.append(time.perf_counter() - start)
                before = n, statistics.median(seconds)
                yield {"op": op, "batch": batch, "points": n, "ms": 1e3 * before[1]}


def exponent(rows: list[dict[str, Any]], op: str, batch: int) -> float | None:
    """Slope of log time over log N by least squares, from 16k points on; None with fewer than two sizes there."""
    chosen = [r for r in rows if r["op"] == op and r["batch"] == batch and r["points"] >= FITTED_FROM]
    if len(chosen) < 2:
        return None
    x, y = ([math.log(r[name]) for r in chosen] for name in ("points", "ms"))
    return statistics.linear_regression(x, y).slope


def figure(rows: list[dict[str, Any]], title: str, path: Path) -> None:
    """One panel per op, one line per batch, both axes logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    ops = list(dict.fromkeys(r["op"] for r in rows))
    plot, panels = plt.subplots(1, len(ops), figsize=(4 * len(ops), 3.6), sharey=True, squeeze=False)
    for op, panel in zip(ops, panels[0], strict=True):
        for batch in dict.fromkeys(r["batch"] for r in rows if r["op"] == op):
            line = [r for r in rows if r["op"] == op and r["batch"] == batch]
            slope = exponent(rows, op, batch)
            label = f"B = {batch}" + (f", N^{slope:.2f} from 16k" if slope is not None else "")
            panel.plot([r["points"] for r in line], [r["ms"] / batch for r in line], "o-", ms=3, label=label)
        panel.set(xscale="log", yscale="log", xlabel="points N of a cloud", title=op)
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    panels[0][0].set_ylabel("ms per cloud or pair")
    plot.suptitle(title, fontsize=9)
    plot.tight_layout()
    plot.savefig(path, dpi=110)
    plt.close(plot)
