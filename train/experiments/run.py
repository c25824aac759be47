"""What the command `experiment` does: makes one or all, and prints their status."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from train.errors import UserError
from train.experiments.frame import Experiment, is_done, make_experiment
from train.experiments.page import write_page
from train.experiments.registry import EXPERIMENTS, load
from train.experiments.status import duration, need_trees, status, status_lines
from train.experiments.study import Study, file_stem

__all__ = ["Study", "make_all", "print_status", "run_all", "run_experiment", "write_page"]


def run_experiment(name: str, study: Study) -> dict[str, Any]:
    """Makes one experiment of the registry, prints its page, and returns what its JSON file holds.

    Raises:
        UserError: no usable data, an unknown run, or numbers out of range.
    """
    if study.run is not None and name not in ("agreement", "coverage", "photos"):
        raise UserError(f"the experiment {name} trains its own networks; leave --run out")
    result = make_experiment(name, load(name), study)
    if study.progress:
        print((study.out / f"{file_stem(name, study.recipe)}.md").read_text())
    return result


def print_status(study: Study) -> None:
    """Prints which experiments are done, and how long the missing trainings will take."""
    found = list(status(_wanted(study), study))
    print("\n".join(status_lines(found, EXPERIMENTS, processes=study.processes)))


def run_all(study: Study) -> None:
    """Makes every experiment that is not done yet; see `make_all`."""
    made = make_all(_wanted(study), study)
    print(f"made: {', '.join(made)}" if made else "nothing to do: all experiments are done")


def make_all(experiments: Mapping[str, Experiment], study: Study) -> list[str]:
    """Makes every experiment that is not done yet, returns their names. If one cannot be made, the others still are.

    Raises:
        UserError: some could not be made; raised at the end, with all reasons.
    """
    need_trees(study)
    made, failed = [], []
    for name, experiment in experiments.items():
        if is_done(name, experiment, study):
            continue
        if study.progress:
            print(f"-- {name}", file=sys.stderr)
        begin = time.monotonic()
        try:
            make_experiment(name, experiment, study)
            made.append(name)
            if study.progress:
                print(f"-- {name}: made in {duration(time.monotonic() - begin, 1)}", file=sys.stderr)
        except UserError as error:
            failed.append(f"{name}: {error}")
    if failed:
        raise UserError(f"{len(made)} made; these could not be: {'; '.join(failed)}")
    return made


def _wanted(study: Study) -> dict[str, Experiment]:
    """All experiments; the one on photographs only if there are any."""
    return {name: load(name) for name in EXPERIMENTS if name != "photos" or study.pictures}
