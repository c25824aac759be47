"""Questions answered by measurement. Each leaves NAME.json, NAME.md and NAME.png, and goes on where it was stopped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from train.errors import UserError
from train.experiments.agreement import agreement
from train.experiments.correlation import correlation
from train.experiments.coverage import coverage
from train.experiments.critic import critic
from train.experiments.front_vs_projection import front_vs_projection
from train.experiments.health import health
from train.experiments.paper import TABLES
from train.experiments.predictions import predictions
from train.experiments.table import make
from train.experiments.workbench import Workbench

__all__ = ["EXPERIMENTS", "Workbench", "run_experiment"]


def _about_a_run(bench: Workbench, run: Path | None, views: int) -> dict[str, Any]:
    if run is None:
        run = bench.train(bench.config(lambda config: config, seed=0))
    return agreement(
        run, bench.data[0], bench.out, seeds=range(bench.seeds), views=views, limit=bench.limit,
        progress=bench.progress,
    )  # fmt: skip


_TRAINING: dict[str, Callable[[Workbench], dict[str, Any]]] = {"health": health}
_TRAINING |= {name: lambda bench, table=table: make(table, bench) for name, table in TABLES.items()}
_TRAINING["critic"] = critic
_TRAINING |= {"correlation": correlation, "predictions": predictions, "coverage": coverage}
_TRAINING["front-vs-projection"] = front_vs_projection

EXPERIMENTS = ("agreement", *_TRAINING)
"""Names of all experiments."""


def run_experiment(name: str, bench: Workbench, *, run: Path | None = None, views: int = 8) -> dict[str, Any]:
    """Runs one experiment and writes what it found.

    Args:
        name: one of `EXPERIMENTS`.
        bench: data, profile and seeds, and where to write.
        run: for "agreement", the trained run it is about, as `train.runs.open_run` takes it; trained here if not given.
        views: for "agreement", per shape.

    Returns:
        What NAME.json holds.

    Raises:
        UserError: an unknown run, no usable data, or numbers out of range.
    """
    if name == "agreement":
        return _about_a_run(bench, run, views)
    if run is not None:
        raise UserError(f"the experiment {name} trains what it needs; leave --run out")
    result = _TRAINING[name](bench)
    if bench.progress:
        print((bench.out / f"{name}.md").read_text())
    return result
