"""The project: direction of imports, documentation of the public names."""

import doctest
import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import diffpoint

ROOT = Path(__file__).parent.parent


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    """Checks the contracts of the pyproject.toml in a folder against the packages beside it."""
    return subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        capture_output=True,
        text=True,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )


def test_imports_point_down():
    """The contracts are in pyproject.toml."""
    done = lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_an_upward_import_is_found(tmp_path):
    """The contracts can fail: a copy of the tree whose lowest layer imports the highest one."""
    for folder in ("diffpoint", "models", "train"):
        shutil.copytree(
            ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__", "pretrained")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with (tmp_path / "train" / "data" / "cache.py").open("a") as file:
        file.write("\nfrom train.methods.base import Method\n")
    done = lint_imports(tmp_path)
    assert done.returncode == 1
    assert "train.data.cache -> train.methods.base" in done.stdout


def test_importing_the_layer_imports_neither_taichi_nor_the_learning_system():
    others = ("taichi", "quadrants", "models", "train", "trimesh")
    code = f"import sys, diffpoint; print([m for m in {others} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stderr


def test_public_functions_are_documented_with_an_example_and_few_parameters():
    for name in diffpoint.__all__:
        item = getattr(diffpoint, name)
        assert inspect.getdoc(item), f"{name} has no docstring"
        if inspect.isfunction(item):
            assert len(inspect.signature(item).parameters) <= 8, f"{name} has too many parameters"
            assert doctest.DocTestParser().get_examples(item.__doc__), f"{name} has no example"
