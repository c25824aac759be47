"""Questions answered by measurement. Each leaves NAME.json, NAME.md and NAME.png, and goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from train.config import FitConfig
from train.errors import UserError
from train.experiments import coverage, photos, reconstructions
from train.experiments.agreement import agreement
from train.experiments.collapse import health, own_trainings
from train.experiments.correlation import correlation
from train.experiments.critic import critic
from train.experiments.front_vs_projection import networks, study
from train.experiments.ledger import Experiment, answer, answer_all, list_lines, overview
from train.experiments.one_armed import measure
from train.experiments.page import write_page
from train.experiments.paper import TABLES
from train.experiments.predictions import predictions
from train.experiments.registry import QUESTIONS
from train.experiments.runtime import runtime
from train.experiments.table import Table, make
from train.experiments.workbench import Workbench, as_it_is

__all__ = ["EXPERIMENTS", "Workbench", "run_all", "run_experiment", "show_all", "write_page"]


def _ours(bench: Workbench) -> list[FitConfig]:
    return bench.configs(as_it_is)


def _agreement(bench: Workbench, *, run: Path | None = None, views: int = 8) -> dict[str, Any]:
    if run is None:
        run = bench.train(_ours(bench)[0])
    return agreement(bench, run, views=views)


def _tables(tables: dict[str, Table]) -> dict[str, Experiment]:
    return {
        name: Experiment(lambda bench, table=table: make(table, bench), table.configs)
        for name, table in tables.items()
    }


EXPERIMENTS: dict[str, Experiment] = {
    **_tables(TABLES),
    "critic": Experiment(critic, TABLES["critic"].configs),
    "correlation": Experiment(correlation, _ours),
    "predictions": Experiment(predictions, _ours),
    "coverage": Experiment(coverage.coverage, coverage.configs),
    "runtime": Experiment(runtime, lambda bench: []),
    "reconstructions": Experiment(reconstructions.reconstructions, reconstructions.configs),
    "one-armed": Experiment(measure.one_armed, measure.configs),
    "agreement": Experiment(_agreement, lambda bench: _ours(bench)[:1]),
    "health": Experiment(health, lambda bench: [], own_trainings=own_trainings),
    "front-vs-projection": Experiment(study.front_vs_projection, networks.configs),
    "photos": Experiment(
        lambda bench: photos.photos(bench, bench.pictures),
        photos.configs,
        lambda bench: photos.files(bench.pictures),
    ),
}
"""All experiments, by the names of `train.questions.QUESTIONS`."""


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
    if name == "agreement" and (run is not None or views != 8):
        result = _agreement(bench, run=run, views=views)  # another question than the one that `all` answers
    elif run is not None:
        raise UserError(f"the experiment {name} trains what it needs; leave --run out")
    else:
        result = answer(name, EXPERIMENTS[name], bench)
    if bench.progress:
        print((bench.out / f"{name}.md").read_text())
    return result


def show_all(bench: Workbench) -> None:
    """Prints what there is, what of it is done, and how long the rest will take."""
    lines = list(overview(_wanted(bench), bench))
    print("\n".join(list_lines(lines, QUESTIONS, processes=bench.processes)))


def run_all(bench: Workbench) -> None:
    """Makes every experiment that is not done yet; see `answer_all`."""
    made = answer_all(_wanted(bench), bench)
    print(f"made: {', '.join(made)}" if made else "nothing to do: all experiments are done")


def _wanted(bench: Workbench) -> dict[str, Experiment]:
    """All experiments, in the order of their questions; that on photographs if there are any."""
    return {name: EXPERIMENTS[name] for name in QUESTIONS if name != "photos" or bench.pictures}
