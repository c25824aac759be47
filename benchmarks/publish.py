"""`python -m benchmarks publish`: the last run's tables, put between the comments `<!-- begin NAME -->` and
`<!-- end NAME -->` in README.md and docs/performance.md."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from benchmarks import saved, tables

ROOT = Path(__file__).parent.parent
FIGURE = Path("docs/images/sweep.png")


def publish(folder: Path, root: Path = ROOT) -> int:
    """Returns exit code 1 if this machine has no results yet."""
    here = saved.machine()
    path = saved.path_for(folder, here)
    results = saved.load(folder, here)
    if not results:
        print(f"no results of this machine in {folder}: run `make bench` first")
        return 1
    measured_on = saved.title(results["machine"])
    readme, guide = root / "README.md", root / "docs/performance.md"
    _insert(readme, {"bench": f"{measured_on}:\n\n{tables.short_table(results['races'])}"})
    reasons = _reasons(guide.read_text(encoding="utf-8"))
    blocks = {
        "machine": f"Measured on: {measured_on}.",
        "targets": tables.targets_table(results, reasons),
        "races": tables.race_table(results["races"]),
        "sweep": tables.sweep_table(results["sweep"]),
        "memory": tables.memory_table(results["memory"]),
        "dispatch": tables.dispatch_table(results["dispatch"]),
        "train": tables.training_table(results["train"]),
    }
    _insert(guide, {name: text for name, text in blocks.items() if results.get(name, True)})
    if path.with_suffix(".png").exists():
        shutil.copyfile(path.with_suffix(".png"), root / FIGURE)
    print(f"README.md and docs/performance.md show {path.name}")
    return 0


def _insert(page: Path, blocks: dict[str, str]) -> None:
    """Replaces the text between the comments."""
    text = page.read_text(encoding="utf-8")
    for name, block in blocks.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise SystemExit(f"{page.name} has no {begin} ... {end}")
        before, rest = text.split(begin, 1)
        text = f"{before}{begin}\n\n{block}\n\n{end}{rest.split(end, 1)[1]}"
    saved.write(page, text)


def _reasons(guide: str) -> dict[str, str]:
    """The last column of the table of targets, which is written by hand, by the first column."""
    found = re.search(r"<!-- begin targets -->(.*)<!-- end targets -->", guide, re.DOTALL)
    rows = [line.strip("| ").split(" | ") for line in (found[1] if found else "").splitlines() if "|" in line]
    return {row[0]: row[4].strip() for row in rows if len(row) == 5}
