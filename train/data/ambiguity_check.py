"""Do the procedural families keep the rules of designed ambiguity? Their objects, measured with other settings."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from train.data import tree_files
from train.data.families import AMBIGUOUS, FAMILIES
from train.data.procedural import Ambiguity, ambiguity, variants_of
from train.data.tree import ShapeTree
from train.errors import UserError
from train.processes import map_unordered

# Other settings than those by which objects are accepted: finer pictures, other views from the front, other samples.
_SETTINGS = {"size": 160, "fronts": 5, "sampling": 1}

_NAME = re.compile(r"(?P<category>[a-z]+)_s(?P<seed>\d+)_(?P<index>\d+)_h\d")


@dataclasses.dataclass(frozen=True)
class AmbiguityReport:
    """The measurements of every object, by family and name; and why objects could not be made, by name."""

    measured: dict[str, dict[str, Ambiguity]]
    failures: dict[str, str]

    @property
    def broken(self) -> list[str]:
        """A line for each object that breaks a rule, and for each that could not be made."""
        worse = [
            f"{name}: front {each.front:.2%}, back {each.back:.0%}, separation {each.separation:.2f}"
            for objects in self.measured.values()
            for name, each in objects.items()
            if not each.holds
        ]
        return worse + list(self.failures.values())

    def summary(self) -> str:
        """A table for the terminal: median and worst case of each family."""
        lines = [
            "Variants of one object compared. front, back: share of the pixels that differ. separation: chamfer",
            "distance over that between two samplings of one variant. Median over the objects (worst object).",
            f"{'family':<12}{'objects':>8}{'front < 1 %':>20}{'back > 10 %':>18}{'separation > 2':>18}",
        ]
        for category, objects in self.measured.items():
            front, back, separation = (
                np.array([getattr(each, name) for each in objects.values()])
                for name in ("front", "back", "separation")
            )
            lines.append(
                f"{category:<12}{len(objects):>8}{f'{np.median(front):.2%} ({front.max():.2%})':>20}"
                f"{f'{np.median(back):.0%} ({back.min():.0%})':>18}"
                f"{f'{np.median(separation):.2f} ({separation.min():.2f})':>18}"
            )
        if self.broken:
            lines += [f"{len(self.broken)} objects break a rule:", *(f"  {line}" for line in self.broken)]
        else:
            lines.append("all rules hold")
        return "\n".join(lines)


class AmbiguousObject(NamedTuple):
    """An object of a family with designed ambiguity; `variants_of(*it)` makes its variants."""

    category: str
    seed: tuple[int, int]


def ambiguous_object(shape: str) -> AmbiguousObject | None:
    """The object to which a shape "synset/model" of `data procedural` belongs; None for other shapes and families.

    Example:
        >>> ambiguous_object("03001627/chair_s0_000012_h1")
        AmbiguousObject(category='chair', seed=(0, 12))
    """
    match = _NAME.fullmatch(shape.split("/")[-1])
    if match is None or match["category"] not in AMBIGUOUS:
        return None
    return AmbiguousObject(match["category"], (int(match["seed"]), int(match["index"])))


def measure_families(
    categories: Sequence[str] | None = None, *, objects: int = 20, seed: int = 0, processes: int | None = None
) -> AmbiguityReport:
    """Measures the rules on newly generated objects, as the acceptance lets them through.

    Args:
        categories: families with designed ambiguity; None for all of them.
        objects: how many of each family.
        seed: of the first object; the others follow.
        processes: None for one per core.

    Raises:
        UserError: an unknown family or one without designed ambiguity, or no objects.
    """
    names = AMBIGUOUS if categories is None else tuple(dict.fromkeys(categories))
    unknown = [name for name in names if name not in AMBIGUOUS]
    if unknown:
        raise UserError(
            f"no family with designed ambiguity is called {', '.join(unknown)}; there are: {', '.join(AMBIGUOUS)}"
        )
    if objects < 1 or seed < 0:
        raise UserError(f"objects must be at least 1 and seed not negative; got {objects} and {seed}")
    jobs = [
        _Job(name, f"{name} {number}", number) for name in names for number in range(seed, seed + objects)
    ]
    return _measure(jobs, processes)


def measure_tree(data: str | Path, *, processes: int | None = None) -> AmbiguityReport:
    """Measures the rules on every object of a procedural data tree whose family has designed ambiguity.

    Raises:
        UserError: no data, or not a single such object.
    """
    jobs = {}
    for split in tree_files.SPLITS:
        for shape in ShapeTree(data, split).ids:
            found = ambiguous_object(shape)
            if found:
                name = shape.split("/")[1].rsplit("_h", 1)[0]
                jobs[name] = _Job(found.category, name, found.seed)
    if not jobs:
        raise UserError(f"{data} holds no procedural object of {', '.join(AMBIGUOUS)}")
    return _measure([jobs[name] for name in sorted(jobs)], processes)


class _Job(NamedTuple):
    category: str
    name: str
    seed: int | tuple[int, int]


def _measure(jobs: Sequence[_Job], processes: int | None) -> AmbiguityReport:
    measured: dict[str, dict[str, Ambiguity]] = {job.category: {} for job in jobs}
    failures = {}
    for job, result in map_unordered(
        _measure_one, jobs, processes=processes, title="measuring", unit="object"
    ):
        if isinstance(result, Exception):
            failures[job.name] = f"{job.name}: {result}"
        else:
            measured[job.category][job.name] = result
    return AmbiguityReport({name: measured[name] for name in AMBIGUOUS if name in measured}, failures)


def _measure_one(job: _Job) -> Ambiguity | Exception:
    cone = FAMILIES[job.category].cone
    assert cone is not None
    try:
        return ambiguity(variants_of(job.category, job.seed), cone, **_SETTINGS)
    except (RuntimeError, OSError) as error:
        return error
