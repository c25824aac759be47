"""Two processes on one batch: the same losses and gradients as one, the same files as one, and resuming."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.one_step_each import one_step_each
from train.distributed import ALONE, gather
from train.evaluation.runs import latest_checkpoint, load_generator, read_metrics

_ROOT = Path(__file__).parents[1]


def _torchrun(*arguments: object) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(_ROOT)}
    done = subprocess.run(
        [*command, *map(str, arguments)],
        env=environment,
        cwd=_ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_two_processes_descend_as_one(tiny_data: Path, smoke_run: Path, tmp_path: Path) -> None:
    """Both stages, both networks, second derivatives of the penalty included: equal to 1e-4 of their size.

    Sums in another order round otherwise: on some processors a sum of many terms that cancel is 3e-5 apart.
    """
    _torchrun(_ROOT / "tests" / "one_step_each.py", tiny_data, smoke_run, tmp_path / "two.pt")
    two = torch.load(tmp_path / "two.pt", weights_only=True)
    one = one_step_each(tiny_data, smoke_run, ALONE)
    assert two.keys() == one.keys()
    assert one["stage1 penalty"] > 0
    assert one["stage1 diversity"] > 0
    apart = {
        name: ((two[name] - value).norm() / value.norm().clamp(min=1e-12)).item()
        for name, value in one.items()
    }
    assert {name: value for name, value in apart.items() if value > 1e-4} == {}


@pytest.mark.slow
def test_two_processes_train_write_once_and_resume(tiny_data: Path, tmp_path: Path) -> None:
    """A run of two processes that stops and goes on ends in the bits of one that does not."""
    fit = ["-m", "train", "fit", "--data", tiny_data, "--profile", "smoke", "--stage1.shapes", "4"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    _torchrun(*fit, "--out", whole)
    _torchrun(*fit, "--out", parts)
    newest = latest_checkpoint(parts)
    assert newest is not None
    for file in newest.iterdir():
        file.unlink()
    newest.rmdir()
    _torchrun("-m", "train", "fit", "--data", tiny_data, "--out", parts, "--resume")
    assert [r["step"] for r in read_metrics(parts)] == list(range(1, 71))
    for phase in ("autoencoder", "stage1", "stage2"):
        name = f"checkpoints/best-{phase}.safetensors"
        assert (whole / name).read_bytes() == (parts / name).read_bytes()
    one, two = (load_generator(run).state_dict() for run in (whole, parts))
    assert all(torch.equal(value, two[name]) for name, value in one.items())


def test_a_lone_process_needs_nobody() -> None:
    assert gather() is ALONE
    assert "lightning_fabric" not in sys.modules
    values = torch.arange(6.0)
    assert torch.equal(ALONE.share(values), values)
    assert torch.equal(ALONE.mean(values), values)
