"""What the pages promise runs as it stands: the README and the docs."""

from __future__ import annotations

import doctest
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import diffpoint

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def readme_example() -> str:
    (example,) = python_blocks(ROOT / "README.md")
    return example


def test_the_readmes_example_runs():
    results: dict[str, object] = {}
    exec(compile(readme_example(), "README.md", "exec"), results)
    assert results["points"].grad.abs().sum() > 0
    assert 0 < results["cost"].item() < 1


@pytest.mark.parametrize(
    "page", [p for p in PAGES if ">>>" in p.read_text(encoding="utf-8")], ids=lambda p: p.stem
)
def test_a_pages_examples_print_what_they_say(page):
    failed, tried = doctest.testfile(
        str(page), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    )
    assert tried > 0
    assert failed == 0


def lines_here(page: str) -> list[str]:
    """The calls in the column "here" of the page's tables."""
    rows = re.findall(r"^\| .* \|$", page, re.MULTILINE)
    cells = [re.split(r"(?<!`)\|(?!`)", row)[2].strip() for row in rows]
    return [cell.strip("`") for cell in cells if cell.startswith("`")]


def test_the_calls_for_users_of_other_libraries_run():
    page = ROOT / "docs" / "coming-from.md"
    lines = lines_here(page.read_text(encoding="utf-8"))
    assert len(lines) > 30
    assert all("dp." in line or "_each" in line or "camera" in line for line in lines)
    names: dict[str, object] = {}
    exec(compile(python_blocks(page)[0], page.name, "exec"), names)
    for line in lines:
        exec(compile(line, line, "exec"), names)
    assert names["loss"].ndim == 0
    assert names["f"].shape == names["precision"].shape == (2,)
    assert names["dist1"].shape == (2, 300)
    assert names["index"].dtype == torch.int64


def test_every_public_name_has_its_place_in_the_reference():
    reference = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs/reference").glob("*.md"))
    placed = set(re.findall(r"^\.\. auto(?:function|class):: (\w+)$", reference, re.MULTILINE))
    assert placed == set(diffpoint.__all__)


def test_the_baseline_of_contributing_is_trained_and_evaluated(tiny_data, tmp_path, monkeypatch):
    """The page's file and its line in the registry are all that a new method needs."""
    import train.methods as methods
    from train.evaluation.evaluate import evaluate
    from train.evaluation.runs import load_predictor, read_metrics
    from train.methods.weights import method_of
    from train.training.trainer import fit

    module, entry = python_blocks(ROOT / "CONTRIBUTING.md")
    (tmp_path / "linear.py").write_text(module)
    monkeypatch.setattr(methods, "__path__", [*methods.__path__, str(tmp_path)])
    name, value = eval("{" + entry + "}", {"Entry": methods.Entry}).popitem()
    monkeypatch.setitem(methods.METHODS, name, value)
    run = tmp_path / "run"
    assert fit(tiny_data, run, methods.recipe(name, "smoke"), progress=False)
    assert fit(tiny_data, run, methods.recipe(name, "smoke"), resume=True, progress=False)
    losses = [record["loss"] for record in read_metrics(run)]
    assert losses[-1] < 0.8 * losses[0]
    network = load_predictor(run)
    assert type(network).__name__ == "LinearNetwork"
    assert method_of(network).name == name
    result = evaluate(run, tiny_data, seeds=[0], views=[1, 3], progress=False)
    assert 0 < result["views"]["3"]["cd"] < 100


@pytest.mark.slow
def test_the_docs_build_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="the extra [docs] is not installed")
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "each a mean over its own set" in (tmp_path / "reference/distances.html").read_text(
        encoding="utf-8"
    )
