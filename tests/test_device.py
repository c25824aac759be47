"""Where networks are computed: the choice of a device, and everything on a device that is not the CPU.

No GPU is needed: `second_device.py` is a device of Python's that computes on the CPU and is as strict as a GPU about
which tensors meet. With a GPU, the last test runs the chain on it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from train.__main__ import main
from train.config import renamed_options
from train.device import CPU, SINGLE, connect, moved, prepare, use_device
from train.errors import UserError
from train.evaluation.runs import load_generator
from train.methods import recipe
from train.timer import Timer, _GPUClock
from train.training.trainer import fit

_ROOT = Path(__file__).parents[1]
_CHECKS = (
    "paper_recipe_and_critic", "whole_shapes", "views_that_stay_on_the_cpu", "other_supervision",
    "latent_head_and_horizon", "all_methods", "a_step_waits_for_nothing_but_the_layer",
    "a_loss_that_is_not_finite_ends_the_training_before_anything_is_kept",
    "a_run_begun_on_one_device_goes_on_on_another", "inference", "evaluation", "validation", "tf32",
    "files",
)  # fmt: skip


# --- a device that is not the CPU


@pytest.fixture(scope="module")
def second_device(tiny_data: Path, smoke_run: Path) -> dict[str, str]:
    """Name of a check -> its error, or nothing."""
    if not hasattr(torch.utils.backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch has no devices of Python's")
    command = [sys.executable, str(_ROOT / "tests" / "second_device.py"), str(tiny_data), str(smoke_run)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(_ROOT)}, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert set(found) == set(_CHECKS)
    return found


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", _CHECKS)
def test_on_a_second_device(name: str, second_device: dict[str, str]) -> None:
    assert not second_device[name], second_device[name]


# --- the choice


def _no_gpu(monkeypatch: pytest.MonkeyPatch, *, cuda: str | None, count: int) -> None:
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)


@pytest.mark.parametrize(
    ("cuda", "count", "rank", "complaint"),
    [
        (None, 0, 0, r"is built for the CPU alone: install another .*, or use --device cpu"),
        ("12.8", 0, 0, r"is built for CUDA 12.8, but finds no GPU. `nvidia-smi` must list one"),
        ("12.8", 2, 2, r"process 2 of this machine has no GPU: there are 2. .*--nproc_per_node 2"),
    ],
)
def test_a_missing_gpu_is_explained(
    cuda: str | None, count: int, rank: int, complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _no_gpu(monkeypatch, cuda=cuda, count=count)
    monkeypatch.setenv("LOCAL_RANK", str(rank))
    with pytest.raises(UserError, match=complaint):
        use_device("cuda")
    if count == 0:
        monkeypatch.delenv("DIFFPOINT_DEVICE", raising=False)
        assert use_device("auto") == CPU


def test_the_environment_says_what_auto_means(monkeypatch: pytest.MonkeyPatch) -> None:
    _no_gpu(monkeypatch, cuda="12.8", count=8)
    monkeypatch.setenv("DIFFPOINT_DEVICE", "cpu")
    assert use_device("auto") == CPU
    monkeypatch.setenv("DIFFPOINT_DEVICE", "gpu")
    with pytest.raises(UserError, match="DIFFPOINT_DEVICE must be one of auto, cpu, cuda; got 'gpu'"):
        use_device("auto")


@pytest.mark.skipif(torch.version.cuda is not None, reason="this torch is built for GPUs")
@pytest.mark.parametrize(
    "command",
    [
        ["fit", "--data", "DATA", "--out", "OUT"],
        ["evaluate", "RUN", "--data", "DATA"],
        ["reconstruct", "RUN", "a.png", "--out", "OUT"],
        ["explore", "RUN", "a.png", "--out", "OUT"],
        ["experiment", "views", "--data", "DATA", "--out", "OUT"],
        ["demo", "--out", "OUT"],
    ],
    ids=lambda command: command[0],
)
def test_every_command_refuses_a_gpu_that_is_not_there(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--device", "cuda"]) == 2
    assert "--device cuda needs a torch that is built for GPUs" in capsys.readouterr().err


def test_the_cpu_changes_nothing(tiny_data: Path) -> None:
    assert connect(CPU) is SINGLE
    values = torch.rand(3)
    assert moved(values, CPU) is values
    assert load_generator("pretrained", device="cpu").device == CPU
    before = torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.allow_tf32
    prepare(CPU)
    assert (torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.allow_tf32) == before


# --- number formats


def test_tf32_needs_a_gpu(tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["fit", "--data", str(tiny_data), "--out", str(tmp_path / "run"), "--profile", "smoke"]
    assert main([*command, "--device", "cpu", "--precision", "tf32"]) == 2
    assert "--precision tf32 is a format of NVIDIA GPUs" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("short", "long"), [("32", "float32"), ("bf16", "bfloat16"), ("tf32", "tf32")])
def test_short_names_of_number_formats(short: str, long: str) -> None:
    assert renamed_options(["fit", "--precision", short]) == ["fit", "--precision", long]
    assert renamed_options(["fit", f"--precision={short}", "--steps", "32"])[1:] == [
        f"--precision={long}", "--steps", "32",
    ]  # fmt: skip


# --- times


def test_times_of_a_gpu_are_added_up_when_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of marks is that of the program; their times come later, from the queue."""
    timer = Timer()
    moments = iter(range(100))
    clock = _GPUClock(CPU)
    waits = []
    monkeypatch.setattr(clock, "now", lambda: next(moments))
    monkeypatch.setattr(clock, "seconds", lambda start, end: waits.append(end) or float(end - start))
    timer._clock = clock
    timer.reset()
    for _ in range(2):
        timer.mark("data")
        timer.mark("network")
        timer.skip()
        timer.end_step()
    assert not waits
    assert timer.read() == {
        "seconds_per_step": 2.0, "data_wait_share": 0.5, "data_seconds": 1.0, "network_seconds": 1.0
    }  # fmt: skip
    assert timer.read()["seconds_per_step"] < 1e-8


# --- a GPU


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.filterwarnings("default")  # operations without a deterministic implementation are named
def test_on_a_gpu(tiny_data: Path, tmp_path: Path) -> None:
    """A training, its evaluation, and the same bits again."""
    device = use_device("cuda")
    runs = [tmp_path / "a", tmp_path / "b"]
    for run in runs:
        assert fit(tiny_data, run, recipe("ours", "smoke"), progress=False, device=device)
    first, again = (load_generator(run).state_dict() for run in runs)
    assert all(torch.equal(value, again[name]) for name, value in first.items())
    assert main(["evaluate", str(runs[0]), "--data", str(tiny_data), "--seeds", "0", "--device", "cuda"]) == 0
