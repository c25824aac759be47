"""The status of all experiments: which are done, and how long the missing trainings will take."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from train.config import FitConfig, fit_config_from_json
from train.errors import UserError
from train.experiments.frame import Experiment, is_done
from train.experiments.study import Study, parts_of

# Processor time of a step of the cpu profile on one core of an Intel Xeon of 2024; used until a run of the kind was
# timed.
_SECONDS_PER_STEP = {
    "ours": 0.3, "deterministic": 0.16, "psgn": 0.15, "psgn-mon": 0.6, "front-mon": 0.31,
    "lin": 0.07, "r2n2": 0.47, "ptn": 0.17,
}  # fmt: skip


class Status(NamedTuple):
    """The status of an experiment.

    Attributes:
        name: the experiment's.
        done: its result is there, made from just this study.
        trained: how many of its runs are finished.
        runs: how many it needs; experiments may share them.
        seconds: what the missing ones will take on one core; None if no run of their kind was timed yet.
        all_seconds: what all of them take, finished ones as they were timed; None as before.
    """

    name: str
    done: bool
    trained: int
    runs: int
    seconds: float | None
    all_seconds: float | None


def status(experiments: Mapping[str, Experiment], study: Study) -> Iterator[Status]:
    """The status of each experiment; a run that several need counts for the first."""
    trees = need_trees(study)
    timed, counted = _timed(study), set[Path]()
    speeds = _speeds(timed)
    for name, experiment in experiments.items():
        parts = {
            trees.run_of(part): (part, number > 0)
            for config in experiment.trainings(trees)
            for number, part in enumerate(parts_of(config))
        }
        costs = {
            run: timed[run] if run in timed else _seconds(*part, speeds)
            for run, part in parts.items()
            if run not in counted
        }
        missing = {run for run, (part, _) in parts.items() if not trees.is_trained(part)}
        counted |= set(parts)
        own = experiment.own_trainings(trees)
        costs |= {path: _seconds(config, False, speeds) for path, config in own.items()}
        missing |= {path for path in own if not path.exists()}
        runs = len(parts) + len(own)
        yield Status(
            name,
            is_done(name, experiment, study),
            trained=runs - len(missing),
            runs=runs,
            seconds=_sum(costs[path] for path in missing & costs.keys()),
            all_seconds=_sum(costs.values()),
        )


def need_trees(study: Study) -> Study:
    """The study on its data trees; raises a UserError if there are none."""
    trees = study.on_trees()
    study.need_data()
    if not trees.data:
        raise UserError(
            f"no data tree among --data {' '.join(map(str, study.data))}; make one with: "
            "python -m train data procedural --out DIR"
        )
    return trees


def status_lines(found: list[Status], descriptions: Mapping[str, str], *, processes: int) -> list[str]:
    """What `list` prints: a line for each experiment, and how long the missing trainings will take."""
    width = max(len(each.name) for each in found)
    lines = []
    for each in found:
        state = "done" if each.done else f"{each.trained}/{each.runs} runs" if each.runs else "not done"
        cost = "" if each.done or not each.runs else duration(each.seconds, processes)
        lines.append(f"{each.name:{width}}  {state:>11}  {cost:>8}  {descriptions[each.name]}")
    missing, whole = (
        duration(sum(cost or 0 for cost in costs), processes)
        + (" and those whose time is not known yet" if None in costs else "")
        for costs in zip(*((each.seconds, each.all_seconds) for each in found), strict=True)
    )
    return [*lines, f"missing trainings: {missing}; all trainings: {whole}; {processes} at once"]


def duration(seconds: float | None, processes: int) -> str:
    """How long a number of processes will take."""
    if seconds is None:
        return "?"
    minutes = seconds / processes / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def _sum(costs: Iterable[float | None]) -> float | None:
    values = list(costs)
    return None if None in values else float(sum(value or 0.0 for value in values))


Kind = tuple[str, str, bool, bool]
"""Steps of runs of one kind take the same time: profile, method, deterministic, stage 2."""


def _kind(config: FitConfig, *, second: bool) -> Kind:
    return config.profile, config.system, config.deterministic, second


def _timed(study: Study) -> dict[Path, float]:
    """Processor seconds of the runs that were trained without an interruption, the newest last."""
    notes = sorted((study.out / "runs").glob("*/trained.json"), key=lambda path: path.stat().st_mtime)
    took = {note.parent: json.loads(note.read_text()) for note in notes}
    return {run: each["seconds"] for run, each in took.items() if not each["continued"]}


def _speeds(timed: Mapping[Path, float]) -> dict[Kind, float]:
    """Processor seconds per step, of the newest run of each kind."""
    found: dict[Kind, float] = {}
    for run, seconds in timed.items():
        config = fit_config_from_json((run / "config.json").read_text(), where=str(run))
        steps = sum(phase.steps for phase in config.phases.values())
        found[_kind(config, second="stage1" not in config.phases)] = seconds / steps
    return found


def _seconds(part: FitConfig, second: bool, speeds: Mapping[Kind, float]) -> float | None:
    """What a run will take: the first of `parts_of`, or the second, which trains stage 2 alone."""
    alone = second or "stage1" not in part.phases
    steps = part.stage2.steps if second else sum(phase.steps for phase in part.phases.values())
    known = speeds.get(_kind(part, second=alone))
    if known is None and part.profile == "cpu":
        known = _SECONDS_PER_STEP["deterministic" if part.deterministic else part.system]
    return None if known is None else known * steps
