"""The house itself: which way imports point, what the wheel holds, that the public names are documented."""

import ast
import doctest
import inspect
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import diffpoint

ROOT = Path(__file__).parent.parent
FLOORS = ("diffpoint", "models", "train")  # from the ground up
ABOVE = ("examples", "tests", "benchmarks")
OPS = (
    "losses",
    "splat",
    "soft_splat",
    "views",
    "reproject",
    "distances",
    "transport",
    "softmatch",
    "sampling",
)


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:  # relative: within its own package
                continue
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("floor", FLOORS)
def test_imports_point_down(floor):
    higher = FLOORS[FLOORS.index(floor) + 1 :] + ABOVE
    for path in files(floor):
        upward = {name for name in imported(path) if name.split(".")[0] in higher}
        assert not upward, f"{path.relative_to(ROOT)} imports {sorted(upward)}"


def test_kernels_import_taichi_only_and_the_reference_torch_only():
    for path in files("diffpoint/kernels"):
        allowed = {"taichi", "quadrants", "types"}
        others = {
            n
            for n in imported(path)
            if n.split(".")[0] not in allowed
            and not n.startswith(("diffpoint.kernels", "diffpoint._backend"))
        }
        assert not others, f"{path.relative_to(ROOT)} imports {sorted(others)}"
    for path in files("diffpoint"):
        if path.stem.startswith("reference"):
            others = {
                name
                for name in imported(path)
                if name.split(".")[0] not in ("torch", "itertools", "math", "__future__")
            }
            assert all(name.startswith("diffpoint.reference") for name in others), f"{path.name}: {others}"


def test_inside_the_layer_imports_point_down():
    for path in files("diffpoint"):
        if path.stem in ("camera", "_checks", "_bridge", "_runtime") or path.parent.name == "kernels":
            ops = {f"diffpoint.{op}" for op in OPS}
            assert not imported(path) & ops, f"{path.name} imports an op"
        if path.stem in OPS and path.stem != "losses":
            assert "diffpoint.losses" not in imported(path)


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


def test_the_wheel_holds_the_layer_only(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, ROOT],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names}
    assert top == {"diffpoint", f"diffpoint-{diffpoint.__version__}.dist-info"}
    sources = {str(path.relative_to(ROOT)) for path in files("diffpoint")}
    assert sources <= set(names)
    assert "diffpoint/py.typed" in names
