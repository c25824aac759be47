"""Questions answered by measurement, one a file. Each leaves NAME.json, NAME.md and NAME.png."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from train.experiments.agreement import agreement

EXPERIMENTS = {"agreement": agreement}


def run_experiment(
    name: str,
    *,
    run: Path,
    data: Path,
    out: Path,
    seeds: Sequence[int] = (0, 1, 2),
    views: int = 8,
    limit: int | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Runs one experiment and writes what it found.

    Args:
        name: which one.
        run: the trained run it is about, as `train.runs.open_run` takes it.
        data: root of a data tree; its test split is used.
        out: directory for NAME.json, NAME.md and NAME.png.
        seeds: of codes and choice of views.
        views: per shape.
        limit: at most that many test shapes.
        progress: show bars, and the table at the end.

    Returns:
        What NAME.json holds.

    Raises:
        UserError: an unknown run, no usable data, or numbers out of range.
    """
    return EXPERIMENTS[name](run, data, out, seeds=seeds, views=views, limit=limit, progress=progress)
