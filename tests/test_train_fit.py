"""Training end to end on the smoke profile: what a run leaves, resuming to the same bits, stopping when
deaf."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from train import fit as fit_module
from train.batches import LoadedSplit, load_split
from train.checkpoint import latest_checkpoint, load_generator
from train.config import PROFILES, FitConfig, StageConfig
from train.errors import UserError
from train.fit import fit, training_step
from train.log import read_metrics
from train.state import Training

_SMOKE = PROFILES["smoke"]


def _last_weights(run: Path) -> dict[str, torch.Tensor]:
    newest = latest_checkpoint(run)
    assert newest is not None
    return load_generator(newest / "weights.safetensors").state_dict()


def _assert_same_run(run: Path, other: Path) -> None:
    weights, others = _last_weights(run), _last_weights(other)
    different = [name for name, value in weights.items() if not torch.equal(value, others[name])]
    assert different == []
    for stage in (1, 2):
        best = f"checkpoints/best-stage{stage}.safetensors"
        assert (run / best).read_bytes() == (other / best).read_bytes()
    timing = {"seconds_per_step", "data_wait_share"}
    assert [{k: v for k, v in r.items() if k not in timing} for r in read_metrics(run)] == [
        {k: v for k, v in r.items() if k not in timing} for r in read_metrics(other)
    ]


def test_a_run_leaves_everything_about_it(smoke_run: Path, tiny_data: Path) -> None:
    records = read_metrics(smoke_run)
    assert [r["step"] for r in records] == list(range(1, 51))
    assert [r["stage"] for r in records] == [1] * 30 + [2] * 20
    healthy = [r for r in records if "image_sensitivity" in r]
    assert [r["step"] for r in healthy] == [10, 20, 30, 40, 50]
    assert all(r["image_sensitivity"] > 0.5 and r["code_sensitivity"] > 0.5 for r in healthy)
    assert all({"val_cd_1", "val_cd", "val_fps_cd"} <= r.keys() for r in healthy)
    assert {"loss", "front", "diversity", "matched_share", "fallback_share", "data_wait_share"} <= records[
        0
    ].keys()
    assert json.loads((smoke_run / "config.json").read_text())["data"] == str(tiny_data)
    assert any((smoke_run / "events").iterdir())
    names = sorted(path.name for path in (smoke_run / "checkpoints").iterdir())
    assert names == ["best-stage1.safetensors", "best-stage2.safetensors", "step-00000040", "step-00000050"]
    assert not load_generator(smoke_run).training


class _Killed(BaseException):
    pass


@pytest.mark.parametrize("killed_at", [17, 31, 44], ids=["stage 1", "first step of stage 2", "stage 2"])
def test_a_killed_run_resumes_to_the_same_bits(
    killed_at: int, tiny_data: Path, smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []

    def dying_step(*args: object, **settings: object) -> object:
        steps.append(1)
        if len(steps) == killed_at:
            raise _Killed
        return training_step(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(fit_module, "training_step", dying_step)
    with pytest.raises(_Killed):
        fit(tiny_data, tmp_path / "run", _SMOKE, progress=False)
    monkeypatch.undo()
    assert fit(tiny_data, tmp_path / "run", _SMOKE, resume=True, progress=False)
    _assert_same_run(tmp_path / "run", smoke_run)


def test_sigterm_saves_at_once_and_leaves(
    tiny_data: Path, smoke_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []

    def interrupted_step(*args: object, **settings: object) -> object:
        steps.append(1)
        if len(steps) == 23:
            os.kill(os.getpid(), signal.SIGTERM)
        return training_step(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(fit_module, "training_step", interrupted_step)
    before = signal.getsignal(signal.SIGTERM)
    assert not fit(tiny_data, tmp_path / "run", _SMOKE, progress=False)
    assert signal.getsignal(signal.SIGTERM) == before
    newest = latest_checkpoint(tmp_path / "run")
    assert newest is not None
    assert newest.name == "step-00000023"
    monkeypatch.undo()
    assert fit(tiny_data, tmp_path / "run", _SMOKE, resume=True, progress=False)
    _assert_same_run(tmp_path / "run", smoke_run)


@pytest.mark.slow
def test_sigkill_loses_nothing_but_time(tiny_data: Path, smoke_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "train", "fit", "--data", str(tiny_data), "--out", str(run)]
    command += ["--profile", "smoke"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while latest_checkpoint(run) is None and process.poll() is None:
        time.sleep(0.02)
    process.kill()
    process.wait()
    subprocess.run([*command, "--resume"], check=True, stderr=subprocess.DEVNULL)
    _assert_same_run(run, smoke_run)


def test_resuming_a_finished_run_changes_nothing(tiny_data: Path, smoke_run: Path) -> None:
    before = (smoke_run / "metrics.jsonl").read_bytes()
    assert fit(tiny_data, smoke_run, _SMOKE, resume=True, progress=False)
    assert (smoke_run / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("resume", "change", "complaint"),
    [
        (False, {}, "already holds a run"),
        (True, {"seed": 1, "map_size": 8}, "other values of map_size, seed"),
    ],
)
def test_runs_are_neither_overwritten_nor_mixed(
    resume: bool, change: dict[str, int], complaint: str, tiny_data: Path, smoke_run: Path
) -> None:
    with pytest.raises(UserError, match=complaint):
        fit(tiny_data, smoke_run, dataclasses.replace(_SMOKE, **change), resume=resume, progress=False)


def test_resuming_with_other_data_is_refused(tiny_data: Path, smoke_run: Path) -> None:
    split = load_split(tiny_data, "test", image_size=(48, 64), map_size=16, progress=False)
    newest = latest_checkpoint(smoke_run)
    assert newest is not None
    state = torch.load(newest / "state.pt", weights_only=True)
    with pytest.raises(UserError, match="other data"):
        Training(_SMOKE, split).restore(state, where=newest)


def test_a_run_that_no_longer_looks_at_its_image_is_stopped(tiny_data: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(_SMOKE, health_every=2, health_patience=4, min_image_sensitivity=1e3)
    with pytest.raises(UserError, match=r"stopped at step 8: .* no longer looks at its image"):
        fit(tiny_data, tmp_path / "run", config, progress=False)


def test_a_training_that_explodes_says_so(tiny_data: Path, tmp_path: Path) -> None:
    stage = dataclasses.replace(_SMOKE.stage1, learning_rate=1e30, warmup=0)
    with pytest.raises(UserError, match="no longer finite; lower the learning rate"):
        fit(tiny_data, tmp_path / "run", dataclasses.replace(_SMOKE, stage1=stage), progress=False)


def _overfit(split: LoadedSplit, stage: StageConfig, steps: int) -> list[float]:
    config: FitConfig = dataclasses.replace(_SMOKE, stage1=stage)
    training = Training(config, split)
    fronts = []
    for step in range(steps):
        batch = split.batch(*training.sampler.draw(stage.shapes, stage.views))
        codes = training.draw_codes(batch)
        report = training_step(training.model, training.optimiser, batch, codes, stage, step=step)
        fronts.append(report.front.item())
    return fronts


def test_one_shape_can_be_learnt_by_heart(tiny_data: Path) -> None:
    """One shape, four joined views, 150 steps: the front loss falls below half of its start."""
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, limit=1, progress=False)
    stage = dataclasses.replace(
        _SMOKE.stage2, steps=150, shapes=1, views=4, codes=2, learning_rate=1e-3, final_learning_rate=2e-4
    )
    fronts = _overfit(split, stage, 150)
    assert sum(fronts[-10:]) / 10 < 0.5 * fronts[0]
