"""What is uploaded for a release: what is in it, what it says of itself, and that it runs where nothing else is."""

from __future__ import annotations

import email
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from test_readme import readme_example

import diffpoint

ROOT = Path(__file__).parents[1]
NAME = f"diffpoint-{diffpoint.__version__}"


def run(*command: object, **options) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    """A source distribution, and the wheel that is built from what it holds."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    return folder


@pytest.fixture
def wheel(dist) -> Path:
    (found,) = dist.glob("*.whl")
    return found


def test_the_wheel_holds_the_layer_only(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"diffpoint", f"{NAME}.dist-info"}
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "diffpoint").rglob("*.py")}
    assert sources <= set(names)
    assert "diffpoint/py.typed" in names
    assert f"{NAME}.dist-info/licenses/LICENSE" in names


def test_the_source_distribution_holds_what_the_wheel_is_built_from(dist):
    (archive,) = dist.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        names = {name.split("/")[1] for name in file.getnames()}
    others = {"LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "PKG-INFO", ".gitignore"}
    assert {"diffpoint", *others} >= names >= {"diffpoint", *others} - {".gitignore"}


def test_the_metadata_say_where_it_runs_and_where_it_lives(wheel):
    metadata = email.message_from_bytes(zipfile.ZipFile(wheel).read(f"{NAME}.dist-info/METADATA"))
    classifiers = metadata.get_all("Classifier")
    versions = [f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)]
    assert {*versions, "Typing :: Typed"} <= set(classifiers)
    assert metadata["Requires-Python"].replace(" ", "") == "<3.14,>=3.10"
    links = dict(link.split(", ") for link in metadata.get_all("Project-URL"))
    assert links.keys() == {"Repository", "Documentation", "Changelog", "Issues"}
    assert all(link.startswith("https://") for link in links.values())
    assert metadata["Description-Content-Type"] == "text/markdown"


def test_the_changelog_has_the_version():
    assert f"\n## {diffpoint.__version__} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_index_will_take_it(dist):
    pytest.importorskip("twine", reason="the extra [dev] is not installed")
    answer = run(sys.executable, "-m", "twine", "check", "--strict", *dist.iterdir())
    assert answer.count("PASSED") == 2


@pytest.mark.slow
def test_the_wheel_runs_the_readmes_example_in_an_empty_environment(wheel, tmp_path):
    """Only the wheel is installed there; torch, taichi and numpy are lent, behind it on the path."""
    empty = tmp_path / "venv"
    venv.create(empty, with_pip=False)
    python = empty / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    site_packages = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    # A plain line in a .pth file is appended to the path, so that nothing lent hides what was installed.
    (site_packages / "lent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    script = tmp_path / "example.py"
    script.write_text(readme_example() + "\nprint(dp.__file__)\nprint(cost.item() > 0)\n")
    imported, positive = run(python, "-E", script, cwd=tmp_path, timeout=240).split()
    assert Path(imported).is_relative_to(site_packages)
    assert positive == "True"
