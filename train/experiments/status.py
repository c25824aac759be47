"""The status of all experiments: which are done, and how long the missing trainings will take."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from train.config import FitConfig, fit_config_from_json
from train.errors import UserError
from train.experiments.frame import Experiment, is_done
from train.experiments.study import Study, after_stage1, parts_of

# Processor time of a step of the cpu profile on one core of an Intel Xeon of 2024; used until a run of the kind was
# timed.
_SECONDS_PER_STEP = {
    "ours": 0.3, "deterministic": 0.16, "psgn": 0.15, "psgn-mon": 0.6, "front-mon": 0.31,
    "lin": 0.07, "r2n2": 0.47, "ptn": 0.17, "ours, whole shapes": 0.43, "deterministic, whole shapes": 0.28,
}  # fmt: skip


class Status(NamedTuple):
    """The status of an experiment."""

    name: str
    done: bool
    """Its result is there, made from just this study."""
    trained: int
    """How many of its trainings are finished."""
    runs: int
    """How many it needs; experiments may share them."""
    seconds: float | None
    """What the missing ones will take on one core; None if no run of their kind was timed yet."""
    all_seconds: float | None
    """What all of them take, finished ones as they were timed; None as before."""


def status(experiments: Mapping[str, Experiment], study: Study) -> Iterator[Status]:
    """The status of each experiment; a training that several need counts for the first."""
    trees = need_trees(study)
    timed, counted = _timed(study), set[Path]()
    speeds = {_kind(config): seconds / _steps(config) for config, seconds in timed.values()}
    for name, experiment in experiments.items():
        needed = {
            trees.run_of(part) / "trained.json": after_stage1(part) if number else part
            for config in experiment.trainings(trees)
            for number, part in enumerate(parts_of(config))
        } | experiment.own_trainings(trees)
        costs = {
            path: timed[path][1] if path in timed else _seconds(part, speeds)
            for path, part in needed.items()
            if path not in counted
        }
        missing = {path for path in needed if not path.exists()}
        counted |= needed.keys()
        yield Status(
            name,
            is_done(name, experiment, study),
            trained=len(needed) - len(missing),
            runs=len(needed),
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


def _kind(config: FitConfig) -> tuple[str, str, str, bool, bool]:
    """Steps of trainings of one kind take the same time."""
    return config.profile, config.system, config.recipe, config.deterministic, "stage1" in config.phases


def _steps(config: FitConfig) -> int:
    return sum(phase.steps for phase in config.phases.values())


def _timed(study: Study) -> dict[Path, tuple[FitConfig, float]]:
    """trained.json of each run that was trained without an interruption -> its configuration and processor seconds, the
    newest last."""
    found = {}
    for note in sorted((study.out / "runs").glob("*/trained.json"), key=lambda path: path.stat().st_mtime):
        took, saved = json.loads(note.read_text()), note.with_name("config.json")
        if not took["continued"]:
            found[note] = fit_config_from_json(saved.read_text(), where=str(saved)), took["seconds"]
    return found


def _seconds(config: FitConfig, speeds: Mapping[Any, float]) -> float | None:
    """Processor seconds that a training will take."""
    speed = speeds.get(_kind(config))
    if speed is None and config.profile == "cpu":
        kind = "deterministic" if config.deterministic else config.system
        kind += ", whole shapes" if config.recipe == "whole-shapes" else ""
        speed = _SECONDS_PER_STEP[kind]
    return None if speed is None else speed * _steps(config)
