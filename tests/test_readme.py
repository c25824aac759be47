"""What the pages promise runs as it stands: the README and the docs."""

from __future__ import annotations

import doctest
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import diffpoint
from train.__main__ import _parse, renamed_options

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "reference").glob("*.md")),
    ROOT / "train" / "pretrained" / "README.md",
    ROOT / "examples" / "photographs" / "README.md",
]


def blocks(page: Path, *languages: str) -> list[str]:
    """The code blocks of a page in one of the languages; "" is the language of a block that names none."""
    found = re.findall(r"^```(.*)\n((?s:.*?))^```$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [block for language, block in found if language in languages]


def python_blocks(page: Path) -> list[str]:
    return blocks(page, "python")


def pages_with(*languages: str) -> list:
    return [pytest.param(page, id=page.stem) for page in PAGES if blocks(page, *languages)]


def readme_example() -> str:
    (example,) = python_blocks(ROOT / "README.md")
    return example


def test_the_readmes_example_runs():
    results: dict[str, object] = {}
    exec(compile(readme_example(), "README.md", "exec"), results)
    assert results["points"].grad.abs().sum() > 0
    assert 0 < results["cost"].item() < 1


def test_every_block_is_in_a_language_that_is_tested():
    """Nothing is shown as code that no test would look at: Python, shell, or the directives of the pages."""
    tested = {"python", "sh", ""}
    for page in PAGES:
        found = set(re.findall(r"^```(\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE))
        assert found - {"{eval-rst}", "{toctree}"} <= tested, page


@pytest.mark.parametrize("page", pages_with("python"))
def test_the_python_of_a_page_runs_from_top_to_bottom(page, monkeypatch):
    """Examples of an interactive session print what they say; other blocks run, with the names of those before."""
    monkeypatch.chdir(ROOT)
    torch.manual_seed(0)
    sessions = [block for block in python_blocks(page) if block.startswith(">>>")]
    names: dict[str, object] = {}
    for block in python_blocks(page):
        if block not in sessions:
            exec(compile(block, page.name, "exec"), names)
    if sessions:
        failed, tried = doctest.testfile(
            str(page), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
        )
        assert tried > 0
        assert failed == 0


def commands(page: Path) -> list[str]:
    """The commands of a page, one a line: continued lines joined, without prompts, comments and output."""
    lines: list[str] = []
    for block in blocks(page, "sh", ""):
        joined = re.sub(r"\\\n\s*", " ", block).splitlines()
        prompted = [line for line in joined if line.startswith("$ ")]
        lines += [line.removeprefix("$ ") for line in prompted or joined]
    return [re.sub(r"(^|\s)#.*", "", line).strip() for line in lines]


@pytest.mark.parametrize("page", pages_with("sh", ""))
def test_the_commands_of_a_page_exist_and_take_their_options(page):
    """They are not run: many take hours, or need data that are not here. Their command lines are read as if."""
    makefile, project = ((ROOT / name).read_text(encoding="utf-8") for name in ("Makefile", "pyproject.toml"))
    for line in commands(page):
        if "-m train" in line:  # also behind torchrun
            words = shlex.split(line)
            _parse(renamed_options(words[words.index("train") + 1 :]))
        elif line.startswith("python examples/"):
            words = line.split()
            script = (ROOT / words[1]).read_text(encoding="utf-8")
            assert all(f'add("{option}"' in script for option in words if option.startswith("--")), line
        elif line.startswith("make "):
            assert re.search(rf"^{line.split()[1]}:", makefile, re.MULTILINE), line
        elif line.startswith("pip install"):
            for extra in re.findall(r"\[(\w+)\]", line):
                assert re.search(rf"^{extra} = \[", project, re.MULTILINE), line


def test_a_command_that_does_not_exist_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    for line in ("python -m train fit --data a --out b --no-such-option 1", "make nothing"):
        page.write_text(f"```\n{line}\n```\n")
        with pytest.raises((SystemExit, AssertionError)):
            test_the_commands_of_a_page_exist_and_take_their_options(page)


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
    assert "each reduced over its own set" in (tmp_path / "reference/distances.html").read_text(
        encoding="utf-8"
    )
