"""Do the rules of ambiguity hold? The accepted objects of each family, measured again on other terms."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from train.data import store
from train.data.families import AMBIGUOUS, FAMILIES
from train.data.procedural import Ambiguity, ambiguity, variants_of
from train.data.tree import ShapeTree
from train.data.work import run_all
from train.errors import UserError

# Not the acceptance's own terms: finer pictures, views between its views, other samples.
_TERMS = {"size": 160, "fronts": 5, "sampling": 1}

_NAME = re.compile(r"(?P<category>[a-z]+)_s(?P<seed>\d+)_(?P<index>\d+)_h\d")


@dataclasses.dataclass(frozen=True)
class RulesReport:
    """The figures of every object, by family."""

    figures: dict[str, dict[str, Ambiguity]]
    failures: dict[str, str]

    @property
    def broken(self) -> list[str]:
        """The objects that break a rule, and those that could not be made."""
        worse = [
            f"{name}: front {each.front:.2%}, back {each.back:.0%}, separation {each.separation:.2f}"
            for figures in self.figures.values()
            for name, each in figures.items()
            if not each.holds
        ]
        return worse + list(self.failures.values())

    def summary(self) -> str:
        """A table for the terminal: medians and the worst case of each family."""
        lines = [
            "pixels that differ between the backs of one object, chamfer over the noise of sampling: median (worst)",
            f"{'family':<12}{'objects':>8}{'front < 1 %':>20}{'back > 10 %':>18}{'separation > 2':>18}",
        ]
        for category, figures in self.figures.items():
            front, back, separation = (
                np.array([getattr(each, name) for each in figures.values()])
                for name in ("front", "back", "separation")
            )
            lines.append(
                f"{category:<12}{len(figures):>8}{f'{np.median(front):.2%} ({front.max():.2%})':>20}"
                f"{f'{np.median(back):.0%} ({back.min():.0%})':>18}"
                f"{f'{np.median(separation):.2f} ({separation.min():.2f})':>18}"
            )
        if self.broken:
            lines += [f"{len(self.broken)} objects break a rule:", *(f"  {line}" for line in self.broken)]
        else:
            lines.append("all rules hold")
        return "\n".join(lines)


def measure(
    categories: Sequence[str] | None = None, *, objects: int = 20, seed: int = 0, processes: int | None = None
) -> RulesReport:
    """Measure rules 3 and 4 on accepted objects that no dataset holds.

    Args:
        categories: families with designed ambiguity; None for all of them.
        objects: how many of each family.
        seed: of the first object; the others follow.
        processes: None for one per core.

    Raises:
        UserError: a family that is unknown or hides nothing by design, or no objects.
    """
    names = AMBIGUOUS if categories is None else tuple(dict.fromkeys(categories))
    strange = [name for name in names if name not in AMBIGUOUS]
    if strange:
        raise UserError(
            f"no family with designed ambiguity is called {', '.join(strange)}; there are: {', '.join(AMBIGUOUS)}"
        )
    if objects < 1 or seed < 0:
        raise UserError(f"objects must be at least 1 and seed not negative; got {objects} and {seed}")
    jobs = [
        _Object(name, f"{name} {number}", number) for name in names for number in range(seed, seed + objects)
    ]
    return _measure(jobs, processes)


def measure_tree(data: Path, *, processes: int | None = None) -> RulesReport:
    """Measure rules 3 and 4 on every object of a procedural dataset whose family hides something by design.

    Raises:
        UserError: no data, or not a single such object.
    """
    found = {}
    for split in store.SPLITS:
        for shape in ShapeTree(data, split).ids:
            hider = hider_of(shape)
            if hider:
                name = shape.split("/")[1].rsplit("_h", 1)[0]
                found[name] = _Object(hider.category, name, hider.seed)
    if not found:
        raise UserError(f"{data} holds no procedural object of {', '.join(AMBIGUOUS)}")
    return _measure([found[name] for name in sorted(found)], processes)


class Hider(NamedTuple):
    """An object of a family with designed ambiguity, as `variants_of` takes it."""

    category: str
    seed: tuple[int, int]


def hider_of(shape: str) -> Hider | None:
    """The object behind a shape "synset/model" of `data procedural`; None for other shapes and other families.

    Example:
        >>> hider_of("03001627/chair_s0_000012_h1")
        Hider(category='chair', seed=(0, 12))
    """
    match = _NAME.fullmatch(shape.split("/")[-1])
    if match is None or match["category"] not in AMBIGUOUS:
        return None
    return Hider(match["category"], (int(match["seed"]), int(match["index"])))


class _Object(NamedTuple):
    category: str
    name: str
    seed: int | tuple[int, int]


def _measure(jobs: Sequence[_Object], processes: int | None) -> RulesReport:
    figures: dict[str, dict[str, Ambiguity]] = {job.category: {} for job in jobs}
    failures = {}
    for job, result in run_all(_figure, jobs, processes=processes, desc="measuring", unit="object"):
        if isinstance(result, Exception):
            failures[job.name] = f"{job.name}: {result}"
        else:
            figures[job.category][job.name] = result
    return RulesReport({name: figures[name] for name in AMBIGUOUS if name in figures}, failures)


def _figure(job: _Object) -> Ambiguity | Exception:
    cone = FAMILIES[job.category].cone
    assert cone is not None
    try:
        return ambiguity(variants_of(job.category, job.seed), cone, **_TERMS)
    except (RuntimeError, OSError) as error:
        return error
