"""One page of all results: verdicts first, then every experiment's tables and figures, from the files that it wrote."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from train.config import Recipe
from train.errors import UserError
from train.experiments import store
from train.experiments.registry import EXPERIMENTS
from train.experiments.statistics import CLAIM_ALIGNMENT, CLAIM_COLUMNS, LEVEL, claim_cells, counted
from train.experiments.study import file_stem
from train.files import write_text
from train.show.tables import markdown_lines


def write_page(out: Path) -> Path:
    """Puts the results in a directory of experiments, and in the folders in it, on one page beside it.

    Numbers come from NAME.json and NAME.md, as the experiments wrote them. Comments written by hand are added: those in
    NAME.reading.md to the experiment, those in README.md to the top. Metrics are packed into one file per directory;
    no experiment may be running there meanwhile.

    Args:
        out: a directory that experiments wrote into, or one with a folder for each data set; the page is OUT.md.

    Raises:
        UserError: there are no results in it.
    """
    folders = [out, *sorted(path for path in out.glob("*") if path.is_dir())]
    groups = {folder: found for folder in folders if (found := _results(folder))}
    if not groups:
        raise UserError(
            f"{out} holds no results; make some with: python -m train experiment views --out {out} ..."
        )
    page = out.with_name(f"{out.name}.md")
    lines = [_text(out / "README.md") or "# Results", "", "## Claims and verdicts", ""]
    lines += _summary(groups)
    for folder, found in groups.items():
        store.pack(folder)
        if folder != out:
            lines += ["", f"## Data: {folder.name}", "", _text(folder / "README.md")]
        for (name, recipe), result in found.items():
            title = name if recipe == "paper" else f"{name}, recipe {recipe}"
            lines += ["", f"{'##' if folder == out else '###'} {title}", "", f"*{EXPERIMENTS[name]}*", ""]
            lines += [_section(folder, name, recipe, result, page.parent)]
    write_text(page, "\n".join([*lines, ""]))
    return page


_Results = Mapping[tuple[str, Recipe], dict[str, Any]]
"""Name and recipe of an experiment -> what its JSON file holds."""


def _results(folder: Path) -> _Results:
    """The results in a folder, in the order of the registry."""
    found = {}
    for name, recipe in itertools.product(EXPERIMENTS, get_args(Recipe)[::-1]):
        stem = file_stem(name, recipe)
        if (folder / f"{stem}.json").exists() and (folder / f"{stem}.md").exists():
            found[name, recipe] = json.loads((folder / f"{stem}.json").read_text())
    return found


def _summary(groups: Mapping[Path, _Results]) -> list[str]:
    """All claims of all experiments with their verdicts; those of single categories are in the tables alone."""
    claims = [
        (folder.name, file_stem(*which), claim)
        for folder, found in groups.items()
        for which, result in found.items()
        for claim in result.get("claims", ())
    ]
    several = len(groups) > 1
    rows = [[*([data] if several else []), name, *claim_cells(claim)] for data, name, claim in claims]
    head = [*(["data"] if several else []), "experiment", *CLAIM_COLUMNS]
    by_chance = (1 - LEVEL) * len(claims)
    words = (
        f"{counted(claim for *_, claim in claims)} A claim holds if the {LEVEL:.0%} interval of its gain lies above 0, "
        "and does not hold if it lies below. Intervals are percentiles of a paired bootstrap over shapes and "
        "trainings; with three trainings they are approximate, and rather too short. They are not corrected for the "
        f"number of claims: if all gains were zero, about {by_chance:.0f} of {len(claims)} would still be decided "
        "one way or the other. A gain without an interval is of an experiment whose metrics per shape are not kept "
        "here."
    )
    return [words, "", *markdown_lines(head, rows, "l" * (len(head) - len(CLAIM_COLUMNS)) + CLAIM_ALIGNMENT)]


def _section(folder: Path, name: str, recipe: Recipe, result: Mapping[str, Any], beside: Path) -> str:
    """An experiment's page, the comments on it, its figures, and the command that makes it again."""
    stem = file_stem(name, recipe)
    parts = [(folder / f"{stem}.md").read_text().strip(), _text(folder / f"{stem}.reading.md")]
    for picture in sorted(folder.glob(f"{stem}.png")) + sorted(folder.glob(f"{stem}-*.png")):
        parts.append(f"![{picture.stem}]({picture.relative_to(beside).as_posix()})")
    if "profile" in result:
        data = " ".join(Path(root).name for root in result.get("data", ()))
        pictures = f" --pictures {Path(result['pictures']).name}" if "pictures" in result else ""
        options = "" if recipe == "paper" else f"--recipe {recipe} "
        parts.append(
            f"`python -m train experiment {name} --data {data} --out OUT --profile {result['profile']} {options}"
            f"--seeds {result['seeds']}{pictures}`"
        )
    return "\n\n".join(part for part in parts if part)


def _text(path: Path) -> str:
    return path.read_text().strip() if path.exists() else ""
