"""All experiments together: which are done, what the rest will cost, and doing it."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from train.config import FitConfig, fit_config_from_json
from train.errors import UserError
from train.experiments.workbench import Workbench, parts_of
from train.files import write_text

# Of the cpu profile, processor time on one core of an Intel Xeon of 2024; taken until a run of the same kind has been
# timed.
_SECONDS_PER_STEP = {
    "ours": 0.3, "deterministic": 0.16, "psgn": 0.15, "psgn-mon": 0.6, "front-mon": 0.31,
    "lin": 0.07, "r2n2": 0.47, "ptn": 0.17,
}  # fmt: skip


class Experiment(NamedTuple):
    """What answers a question.

    Attributes:
        make: trains and measures what is missing, and writes the answer into `bench.out`.
        configs: every training that it needs.
        files: what it reads beside data trees; with other bytes in them, the answer is another one.
        own_trainings: of its trainings those that are no runs, by the file that each leaves.
    """

    make: Callable[[Workbench], dict[str, Any]]
    configs: Callable[[Workbench], list[FitConfig]]
    files: Callable[[Workbench], list[Path]] = lambda bench: []
    own_trainings: Callable[[Workbench], dict[Path, FitConfig]] = lambda bench: {}


class Line(NamedTuple):
    """Where an experiment stands.

    Attributes:
        name: the experiment's.
        done: its answer is there, of just this bench.
        trained: how many of its trainings there are.
        runs: how many it needs, some of which it may share with others.
        seconds: what the missing ones will take on one core; None if nothing like them was timed yet.
        whole: what all of them take, those that are there as they were timed; None as before.
    """

    name: str
    done: bool
    trained: int
    runs: int
    seconds: float | None
    whole: float | None


def overview(experiments: Mapping[str, Experiment], bench: Workbench) -> Iterator[Line]:
    """Says of every experiment where it stands; what a run takes that several need counts for the first."""
    trees = _with_data(bench)
    timed, counted = _timed(bench), set[Path]()
    speeds = _speeds(timed)
    for name, experiment in experiments.items():
        parts = {
            trees.run_of(part): (part, number > 0)
            for config in experiment.configs(trees)
            for number, part in enumerate(parts_of(config))
        }
        costs = {
            run: timed[run] if run in timed else _seconds(*each, speeds)
            for run, each in parts.items()
            if run not in counted
        }
        missing = {run for run, (part, _) in parts.items() if not trees.is_trained(part)}
        counted |= set(parts)
        own = experiment.own_trainings(trees)
        costs |= {path: _seconds(config, False, speeds) for path, config in own.items()}
        missing |= {path for path in own if not path.exists()}
        runs = len(parts) + len(own)
        yield Line(
            name,
            is_done(name, experiment, bench),
            trained=runs - len(missing),
            runs=runs,
            seconds=_sum(costs[path] for path in missing & costs.keys()),
            whole=_sum(costs.values()),
        )


def _sum(costs: Iterable[float | None]) -> float | None:
    total = 0.0
    for cost in costs:
        if cost is None:
            return None
        total += cost
    return total


def _with_data(bench: Workbench) -> Workbench:
    trees = bench.on_trees()
    bench.need_data()
    if not trees.data:
        raise UserError(
            f"no data tree among --data {' '.join(map(str, bench.data))}; make one with: "
            "python -m train data procedural --out DIR"
        )
    return trees


def is_done(name: str, experiment: Experiment, bench: Workbench) -> bool:
    """Is an experiment's answer there, and of just these trainings, data, seeds and limits?"""
    note = bench.out / "done" / f"{name}.json"
    written = all((bench.out / f"{name}.{kind}").exists() for kind in ("json", "md", "png"))
    return written and note.exists() and json.loads(note.read_text()) == _key(experiment, bench)


def answer(name: str, experiment: Experiment, bench: Workbench) -> dict[str, Any]:
    """Makes an experiment, and notes that it is done."""
    result = experiment.make(bench)
    write_text(bench.out / "done" / f"{name}.json", json.dumps(_key(experiment, bench)) + "\n")
    return result


def answer_all(experiments: Mapping[str, Experiment], bench: Workbench) -> list[str]:
    """Makes every experiment that is not done yet. One that cannot be made does not keep the others from it.

    Returns:
        Names of those that were made.

    Raises:
        UserError: some could not be made; raised at the end, with all reasons.
    """
    _with_data(bench)
    made, failed = [], []
    for name, experiment in experiments.items():
        if is_done(name, experiment, bench):
            continue
        if bench.progress:
            print(f"-- {name}", file=sys.stderr)
        begin = time.monotonic()
        try:
            answer(name, experiment, bench)
            made.append(name)
            if bench.progress:
                print(f"-- {name}: made in {_duration(time.monotonic() - begin, 1)}", file=sys.stderr)
        except UserError as error:
            failed.append(f"{name}: {error}")
    if failed:
        raise UserError(f"{len(made)} made; these could not be: {'; '.join(failed)}")
    return made


def _key(experiment: Experiment, bench: Workbench) -> dict[str, Any]:
    """All that an answer depends on; `category` shows in the trainings."""
    trees = bench.on_trees()
    depends = [str(root) for root in bench.data if root not in trees.data]
    depends += [hashlib.sha256(path.read_bytes()).hexdigest() for path in experiment.files(bench)]
    if trees.data:  # some experiments need none
        depends += trees.fingerprints()
        configs = [*experiment.configs(trees), *experiment.own_trainings(trees).values()]
        depends += sorted({trees.run_of(config).name for config in configs})
    digest = hashlib.sha256("\n".join(depends).encode()).hexdigest()[:12]
    settings = {name: getattr(bench, name) for name in ("profile", "seeds", "limit", "steps")}
    return {"depends_on": digest, **settings}


Kind = tuple[str, str, bool, bool]
"""Runs of one kind take the same time for a step: profile, system, deterministic, stage 2."""


def _kind(config: FitConfig, *, second: bool) -> Kind:
    return config.profile, config.system, config.deterministic, second


def _timed(bench: Workbench) -> dict[Path, float]:
    """Processor seconds of the runs that were trained in one go, the newest last."""
    notes = sorted((bench.out / "runs").glob("*/trained.json"), key=lambda path: path.stat().st_mtime)
    took = {note.parent: json.loads(note.read_text()) for note in notes}
    return {run: each["seconds"] for run, each in took.items() if not each["continued"]}


def _speeds(timed: Mapping[Path, float]) -> dict[Kind, float]:
    """Processor seconds per step of runs; the newest of each kind."""
    found: dict[Kind, float] = {}
    for run, seconds in timed.items():
        config = fit_config_from_json((run / "config.json").read_text(), where=str(run))
        steps = sum(phase.steps for phase in config.phases.values())
        found[_kind(config, second="stage1" not in config.phases)] = seconds / steps
    return found


def _seconds(part: FitConfig, second: bool, speeds: Mapping[Kind, float]) -> float | None:
    """What a run will take: of `parts_of` the first, or the second, which trains stage 2 alone."""
    alone = second or "stage1" not in part.phases
    steps = part.stage2.steps if second else sum(phase.steps for phase in part.phases.values())
    known = speeds.get(_kind(part, second=alone))
    if known is None and part.profile == "cpu":
        known = _SECONDS_PER_STEP["deterministic" if part.deterministic else part.system]
    return None if known is None else known * steps


def list_lines(lines: list[Line], questions: Mapping[str, str], *, processes: int) -> list[str]:
    """What `list` prints: one line an experiment, and how long the rest will take."""
    width = max(len(line.name) for line in lines)
    printed = []
    for line in lines:
        state = "done" if line.done else f"{line.trained}/{line.runs} runs" if line.runs else "to do"
        cost = "" if line.done or not line.runs else _duration(line.seconds, processes)
        printed.append(f"{line.name:{width}}  {state:>11}  {cost:>8}  {questions[line.name]}")
    missing, whole = (
        _duration(sum(cost or 0 for cost in costs), processes)
        + (" and what has no time yet" if None in costs else "")
        for costs in zip(*((line.seconds, line.whole) for line in lines), strict=True)
    )
    return [*printed, f"trainings that are missing: {missing}; all of them: {whole}; {processes} at once"]


def _duration(seconds: float | None, processes: int) -> str:
    if seconds is None:
        return "?"
    minutes = seconds / processes / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
