"""`python -m benchmarks.transport`: the earth mover's distance against exact assignments, on five kinds of pairs."""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported

import torch
from torch import Tensor

import diffpoint as dp
from benchmarks.inputs import pairs, surfaces
from benchmarks.matching import exact_cost
from benchmarks.saved import machine, save, title
from benchmarks.tables import markdown
from diffpoint import _bridge

# How far each point moves from one step of a descent to the next; neighbours are about 0.02 apart.
STEP = 0.002
HEADER = [
    "pairs",
    "mean cost",
    "error, mean / worst",
    "bound, mean / worst",
    "ms per pair",
    "seconds in all",
    "share of the auction",
    "started: seconds in all",
    "error, mean / worst",
]


def families(count: int, n: int) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Pairs of sets (count, n, 3) as in training, from its beginning to its end."""
    yield "two shapes", surfaces(count, n, seed=5), surfaces(count, n, seed=50)
    samplings = surfaces(count, 2 * n)
    generator = torch.Generator().manual_seed(1)
    far = samplings[:, :n] + 0.3 * torch.randn(count, n, 3, generator=generator)
    yield "another sampling, noise 0.3", far, samplings[:, n:].contiguous()
    yield "another sampling, noise 0.03", *pairs(count, n, n)
    yield "another sampling", samplings[:, :n].contiguous(), samplings[:, n:].contiguous()
    near = surfaces(count, n, seed=7)
    moved = near + 0.005 * torch.randn(count, n, 3, generator=generator)
    yield "the same points, noise 0.005", near, moved[:, torch.randperm(n, generator=generator)].contiguous()


def measure(a: Tensor, b: Tensor, *, exact: int, runs: int) -> dict[str, Any]:
    """Times over the whole batch, errors of its first `exact` pairs; the same after a step of a descent."""
    result = dp.earth_mover_distance(a, b)  # also compiles
    moved = a + STEP * torch.randn(a.shape, generator=torch.Generator().manual_seed(3))
    again = dp.earth_mover_distance(moved, b, start=result)
    cold, share = _timed(lambda: dp.earth_mover_distance(a, b), runs)
    warm, _ = _timed(lambda: dp.earth_mover_distance(moved, b, start=result), runs)
    return {
        "cost": float(result.cost.mean()),
        **_exactness("", result, a[:exact], b[:exact]),
        **_exactness("started_", again, moved[:exact], b[:exact]),
        "seconds": cold,
        "started_seconds": warm,
        "ms_per_pair": 1e3 * cold / len(a),
        "auction_share": share,
        "converged": bool((result.converged & again.converged).all()),
        "exact_pairs": exact,
    }


def _exactness(prefix: str, result: dp.Transport, a: Tensor, b: Tensor) -> dict[str, float]:
    optimal = torch.tensor([exact_cost(x, y) for x, y in zip(a, b, strict=True)])
    error = result.cost[: len(optimal)].double() / optimal - 1
    bound = result.bound / result.cost
    return {
        f"{prefix}{name}_{kind}": float(getattr(values, function)())
        for name, values in (("error", error), ("bound", bound))
        for kind, function in (("mean", "mean"), ("worst", "max"))
    }


def _timed(run: Callable[[], Any], runs: int) -> tuple[float, float]:
    """Median seconds, and the share of them in the kernel."""
    launch, in_kernel = _bridge.launch, 0.0

    def timed(*arguments: Any) -> None:
        nonlocal in_kernel
        start = time.perf_counter()
        launch(*arguments)
        in_kernel += time.perf_counter() - start

    seconds, shares = [], []
    with mock.patch.object(_bridge, "launch", timed):
        for _ in range(runs):
            in_kernel = 0.0
            start = time.perf_counter()
            run()
            seconds.append(time.perf_counter() - start)
            shares.append(in_kernel / seconds[-1])
    return statistics.median(seconds), statistics.median(shares)


def line(name: str, row: dict[str, Any]) -> list[str]:
    return [
        name,
        f"{row['cost']:.4f}",
        f"{row['error_mean']:.2%} / {row['error_worst']:.2%}",
        f"{row['bound_mean']:.2%} / {row['bound_worst']:.2%}",
        f"{row['ms_per_pair']:.2f}",
        f"{row['seconds']:.2f}",
        f"{row['auction_share']:.0%}",
        f"{row['started_seconds']:.2f}",
        f"{row['started_error_mean']:.2%} / {row['started_error_worst']:.2%}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transport", description=__doc__)
    parser.add_argument("--pairs", type=int, default=160, help="pairs in a batch (default: 160)")
    parser.add_argument("--points", type=int, default=2048, help="points in a set (default: 2048)")
    parser.add_argument(
        "--exact", type=int, default=8, help="pairs solved exactly for each family (default: 8)"
    )
    parser.add_argument(
        "--runs", type=int, default=3, help="timed runs, of which the median counts (default: 3)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results", help="where results go"
    )
    arguments = parser.parse_args()

    rows = {}
    for name, a, b in families(arguments.pairs, arguments.points):
        rows[name] = measure(a, b, exact=arguments.exact, runs=arguments.runs)
        print(" | ".join(line(name, rows[name])), flush=True)
    here = machine()
    caption = (
        f"{title(here)}.\n\n{arguments.pairs} pairs of {arguments.points} x {arguments.points} points in one call of "
        f"`earth_mover_distance` with its default tolerance; errors of {arguments.exact} of them against scipy's exact "
        "assignment. Bound: `Transport.bound` relative to the cost. Started: the points of the first set have moved "
        f"by about {STEP}, and the result before that is the `start`.\n\n"
    )
    table = markdown(HEADER, [line(name, row) for name, row in rows.items()])
    path = arguments.out / "transport.json"
    save({"machine": here, "rows": rows}, f"{caption}{table}\n", path)
    print(f"Saved {path}")


if __name__ == "__main__":
    main()
