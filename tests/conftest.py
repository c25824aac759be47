"""Data and a trained run that several test files share; each is made once per session."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: its idle threads would slow the kernels
# Tests compare commands with functions; those of a GPU name it.
os.environ.setdefault("DIFFPOINT_DEVICE", "cpu")
# Before triton: tests/test_cuda_kernels.py runs its kernels in the interpreter where there is no GPU.
if not Path("/dev/nvidia0").exists():
    os.environ.setdefault("TRITON_INTERPRET", "1")

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from train.data.batches import LoadedSplit


# Run by tests in processes of their own, or in need of triton; doctest would import them here.
collect_ignore = ["second_device.py", "compile_cuda_kernels.py", "cuda_launches.py"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--cuda-kernels",
        action="store_true",
        help="run the layer's tests with the kernels for CUDA, in Triton's interpreter (slow)",
    )


@pytest.fixture(autouse=True)
def _chosen_kernels(request: pytest.FixtureRequest) -> Iterator[None]:
    """The kernels for CUDA if the command line asks for them."""
    if not request.config.getoption("--cuda-kernels"):
        yield
        return
    from diffpoint.testing import cuda_kernels_interpreted

    with cuda_kernels_interpreted(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=RuntimeWarning, module="triton")  # numpy's, of infinities
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Prints how many cases the property tests tried."""
    passed = terminalreporter.stats.get("passed", [])
    cases = sum(value for report in passed for name, value in report.user_properties if name == "cases")
    if cases:
        terminalreporter.write_line(f"{cases} property cases passed")


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of 12 chairs and displays, 4 views of 64 x 64 pixels each."""
    from train.data.procedural import generate

    root = tmp_path_factory.mktemp("data") / "tiny"
    generate(root, shapes=12, categories=["chair", "display"], seed=0, size=64, views=4, processes=1)
    return root


@pytest.fixture(scope="session")
def train_split(tiny_data: Path) -> LoadedSplit:
    """The tiny tree's train split, at the sizes of our method's smoke profile."""
    from train.data.batches import load_split

    return load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)


@pytest.fixture(scope="session")
def smoke_run(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the smoke profile on the tiny tree: 20 steps of the auto-encoder, 30 of stage 1, 20 of stage 2."""
    from train.methods import recipe
    from train.training.trainer import fit

    run = tmp_path_factory.mktemp("runs") / "smoke"
    assert fit(tiny_data, run, recipe("ours", "smoke"), progress=False)
    return run
