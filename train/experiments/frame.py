"""What an experiment is: trainings that it needs, and what is made of them: numbers, a page, figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from train.config import FitConfig
from train.experiments import store
from train.experiments.study import Study, file_stem
from train.files import require_writable, write_text
from train.show import figures


class Outcome(NamedTuple):
    """What an experiment found."""

    result: dict[str, Any]
    """For NAME.json; "claims", if there are any, are those of `statistics.claim`."""
    page: str
    """For NAME.md."""
    figures: Mapping[str, Figure]
    """Ending of the file's name ("" or "-something") -> for NAME.png or NAME-something.png."""


class Experiment(NamedTuple):
    """An experiment."""

    make: Callable[[Study], Outcome]
    """Trains and measures what is missing."""
    trainings: Callable[[Study], list[FitConfig]] = lambda study: []
    """All configurations that it needs."""
    other_inputs: Callable[[Study], Iterable[str | Path]] = lambda study: []
    """What else decides the outcome: words, and files that are read."""
    own_trainings: Callable[[Study], dict[Path, FitConfig]] = lambda study: {}
    """Of its trainings those that are not runs of `fit`, by the file that each leaves."""


def markdown_page(*blocks: str | Sequence[str]) -> str:
    """Paragraphs, and the lines of tables and lists, with a blank line between them.

    Example:
        >>> markdown_page("Errors:", ["- a: 1", "- b: 2"])
        'Errors:\\n\\n- a: 1\\n- b: 2\\n'
    """
    return "\n\n".join(block if isinstance(block, str) else "\n".join(block) for block in blocks) + "\n"


def make_experiment(name: str, experiment: Experiment, study: Study) -> dict[str, Any]:
    """Makes an experiment and writes STEM.json, STEM.md and its figures into `study.out`, see `file_stem`; returns what
    STEM.json holds."""
    stem = file_stem(name, study.recipe)
    require_writable(study.out / f"{stem}.json")
    outcome = experiment.make(study)
    result = outcome.result | {"made_from": made_from(experiment, study)}
    for ending, figure in outcome.figures.items():
        figures.save(figure, study.out / f"{stem}{ending}.png")
    write_text(study.out / f"{stem}.md", outcome.page)
    write_text(study.out / f"{stem}.json", json.dumps(result, indent=2) + "\n")
    return result


def is_done(name: str, experiment: Experiment, study: Study) -> bool:
    """Is an experiment's result there, of just these trainings, data, seeds and limits?"""
    paths = [study.out / f"{file_stem(name, study.recipe)}.{kind}" for kind in ("json", "md", "png")]
    if not all(path.exists() for path in paths):
        return False
    return json.loads(paths[0].read_text()).get("made_from") == made_from(experiment, study)


def made_from(experiment: Experiment, study: Study) -> dict[str, Any]:
    """All that an outcome depends on; `study.category` shows in the trainings."""
    trees = study.on_trees()
    inputs: list[object] = [str(root) for root in study.data if root not in trees.data]
    for item in experiment.other_inputs(study):
        inputs.append(hashlib.sha256(item.read_bytes()).hexdigest() if isinstance(item, Path) else item)
    if trees.data:  # some experiments need none
        inputs += trees.fingerprints()
        configs = [*experiment.trainings(trees), *experiment.own_trainings(trees).values()]
        inputs += sorted({trees.run_of(config).name for config in configs})
    settings = {name: getattr(study, name) for name in ("profile", "seeds", "limit", "steps")}
    return {"inputs": store.digest(inputs), **settings}
