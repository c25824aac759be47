"""One page of all answers: verdicts first, then every experiment's tables and figures, from the files they left."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from train.errors import UserError
from train.experiments.registry import QUESTIONS
from train.experiments.table import claim_cells, table_row
from train.files import write_text


def write_page(out: Path) -> Path:
    """Puts what a directory of experiments holds, and the folders in it, on one page beside it.

    Numbers come from NAME.json and NAME.md, as the experiments wrote them. What somebody read from them by hand stands
    beside them in NAME.reading.md, and before everything in README.md; both are taken over as they are.

    Args:
        out: a directory that experiments wrote into, or one with a folder for each data set.

    Returns:
        The page: OUT.md.

    Raises:
        UserError: there is no answer in it.
    """
    groups = {folder: _answers(folder) for folder in [out, *sorted(p for p in out.glob("*") if p.is_dir())]}
    groups = {folder: found for folder, found in groups.items() if found}
    if not groups:
        raise UserError(
            f"{out} holds no answers; make one with: python -m train experiment views --out {out} ..."
        )
    page = out.with_name(f"{out.name}.md")
    lines = [_taken_over(out / "README.md") or "# Results", "", "## What is claimed, and what holds here", ""]
    lines += _summary(groups, several=len(groups) > 1)
    for folder, found in groups.items():
        if folder != out:
            lines += ["", f"## On {folder.name}", "", *_in_text(folder / "README.md")]
        for name, result in found.items():
            lines += ["", f"{'##' if folder == out else '###'} {name}", "", f"*{QUESTIONS[name]}*", ""]
            lines += [_section(folder, name, result, page.parent)]
    write_text(page, "\n".join([*lines, ""]))
    return page


def _answers(folder: Path) -> dict[str, dict[str, Any]]:
    """Name -> what NAME.json holds, in the order of the questions."""
    return {
        name: json.loads((folder / f"{name}.json").read_text())
        for name in QUESTIONS
        if (folder / f"{name}.json").exists() and (folder / f"{name}.md").exists()
    }


def _summary(groups: Mapping[Path, Mapping[str, Mapping[str, Any]]], *, several: bool) -> Iterator[str]:
    """All claims of all experiments with their verdicts."""
    head = ["experiment", "claim", "gain", "paper's", "confidence", "verdict"]
    yield table_row([*(["data"] if several else []), *head])
    yield table_row([*(["---"] if several else []), "---", "---", "---:", "---:", "---:", "---"])
    for folder, found in groups.items():
        for name, result in found.items():
            for claim in result.get("claims", ()):
                yield table_row([*([folder.name] if several else []), name, *claim_cells(claim)])


def _section(folder: Path, name: str, result: Mapping[str, Any], beside: Path) -> str:
    """An experiment's own page, what was read from it, its pictures, and how to make them again."""
    parts = [(folder / f"{name}.md").read_text().strip(), *_in_text(folder / f"{name}.reading.md")]
    for picture in sorted(folder.glob(f"{name}.png")) + sorted(folder.glob(f"{name}-*.png")):
        parts.append(f"![{picture.stem}]({picture.relative_to(beside).as_posix()})")
    if "profile" in result:
        data = " ".join(Path(root).name for root in result.get("data", ()))
        pictures = f" --pictures {Path(result['pictures']).name}" if "pictures" in result else ""
        parts.append(
            f"`python -m train experiment {name} --data {data} --out OUT --profile {result['profile']} "
            f"--seeds {result['seeds']}{pictures}`"
        )
    return "\n\n".join(parts)


def _in_text(path: Path) -> list[str]:
    text = _taken_over(path)
    return [text] if text else []


def _taken_over(path: Path) -> str:
    return path.read_text().strip() if path.exists() else ""
