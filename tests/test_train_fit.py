"""Training end to end on the smoke profile: what a run leaves, resuming to the same bits, stopping when
deaf."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from train.methods.step import training_step
from train.training.state import Training

from train.__main__ import main
from train.config import PROFILES, Precision, fit_config_from_json
from train.data.batches import load_split
from train.errors import UserError
from train.evaluation.runs import best_weights, latest_checkpoint, load_generator, read_metrics
from train.training import state as state_module
from train.training.trainer import fit

_SMOKE = PROFILES["smoke"]


def _last_weights(run: Path) -> dict[str, torch.Tensor]:
    newest = latest_checkpoint(run)
    assert newest is not None
    return load_generator(newest / "weights.safetensors").state_dict()


def _assert_same_run(run: Path, other: Path) -> None:
    weights, others = _last_weights(run), _last_weights(other)
    different = [name for name, value in weights.items() if not torch.equal(value, others[name])]
    assert different == []
    for phase in ("autoencoder", "stage1", "stage2"):
        best = f"checkpoints/best-{phase}.safetensors"
        assert (run / best).read_bytes() == (other / best).read_bytes()
    assert _without_times(read_metrics(run)) == _without_times(read_metrics(other))


def _without_times(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    def measured(name: str) -> bool:
        return name.endswith("_seconds") or name in ("seconds_per_step", "data_wait_share")

    return [{k: v for k, v in record.items() if not measured(k)} for record in records]


def test_a_run_leaves_everything_about_it(smoke_run: Path, tiny_data: Path) -> None:
    records = read_metrics(smoke_run)
    assert [r["step"] for r in records] == list(range(1, 71))
    assert [r["stage"] for r in records] == [0] * 20 + [1] * 30 + [2] * 20
    assert [r["step"] for r in records if "val_autoencoder_cd" in r] == [10, 20]
    healthy = [r for r in records if "image_sensitivity" in r]
    assert [r["step"] for r in healthy] == [30, 40, 50, 60, 70]
    assert all(r["image_sensitivity"] > 0.5 and r["code_sensitivity"] > 0.5 for r in healthy)
    assert all({"val_cd_1", "val_cd", "val_fps_cd", "matched_share"} <= r.keys() for r in healthy)
    terms = {"loss", "front", "diversity", "critic_loss", "penalty", "real_score", "fake_score"}
    times = {"network_seconds", "distances_seconds", "critic_seconds", "data_seconds", "data_wait_share"}
    assert terms | times | {"fallback_share"} <= records[20].keys()
    assert json.loads((smoke_run / "config.json").read_text())["data"] == str(tiny_data)
    assert any((smoke_run / "events").iterdir())
    names = sorted(path.name for path in (smoke_run / "checkpoints").iterdir())
    assert [name.removesuffix(".safetensors") for name in names] == [
        "best-autoencoder", "best-stage1", "best-stage2", "step-00000060", "step-00000070",
    ]  # fmt: skip
    pictures = sorted(path.name for path in (smoke_run / "figures").iterdir())
    assert pictures == [f"predictions-{step:08d}.png" for step in (45, 50, 70)]
    assert not load_generator(smoke_run).training


class _Killed(BaseException):
    pass


@pytest.mark.parametrize(
    ("what", "killed_at"),
    [("autoencoder_step", 13), ("training_step", 1), ("training_step", 31), ("training_step", 44)],
    ids=["auto-encoder", "first step of stage 1", "first step of stage 2", "stage 2"],
)
def test_a_killed_run_resumes_to_the_same_bits(
    what: str,
    killed_at: int,
    tiny_data: Path,
    smoke_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps, undisturbed = [], getattr(state_module, what)

    def dying_step(*args: object, **settings: object) -> object:
        steps.append(1)
        if len(steps) == killed_at:
            raise _Killed
        return undisturbed(*args, **settings)

    monkeypatch.setattr(state_module, what, dying_step)
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

    monkeypatch.setattr(state_module, "training_step", interrupted_step)
    before = signal.getsignal(signal.SIGTERM)
    assert not fit(tiny_data, tmp_path / "run", _SMOKE, progress=False)
    assert signal.getsignal(signal.SIGTERM) == before
    newest = latest_checkpoint(tmp_path / "run")
    assert newest is not None
    assert newest.name == "step-00000043"
    monkeypatch.undo()
    assert fit(tiny_data, tmp_path / "run", _SMOKE, resume=True, progress=False)
    _assert_same_run(tmp_path / "run", smoke_run)


_CLI = (
    "import resource, sys; limit = int(sys.argv.pop(1)); "
    "limit and resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)); "
    "from train.__main__ import main; sys.exit(main(sys.argv[1:]))"
)


def _fit_command(data: Path, run: Path, *options: str, largest_file: int = 0) -> list[str]:
    fit = ["fit", "--data", str(data), "--out", str(run), "--profile", "smoke", *options]
    return [sys.executable, "-c", _CLI, str(largest_file), *fit]


def test_a_full_disk_leaves_the_last_good_checkpoint(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    shutil.rmtree(run / "checkpoints" / "step-00000070")
    before = {p: p.read_bytes() for p in (run / "checkpoints").rglob("*") if p.is_file() and "step" in str(p)}
    command = _fit_command(
        tiny_data, run, "--resume", largest_file=4_000_000
    )  # the optimiser's state is larger
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 2
    complaint = done.stderr.splitlines()[-1]
    assert "step-00000070 cannot be written ([Errno 27] File too large)" in complaint
    assert "continue with --resume" in complaint
    after = {p: p.read_bytes() for p in (run / "checkpoints").rglob("*") if p.is_file() and "step" in str(p)}
    assert after == before
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    _assert_same_run(run, smoke_run)


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_serves(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    newest = run / "checkpoints" / "step-00000070"
    (newest / "critic.safetensors").write_bytes(b"half")
    with pytest.raises(
        UserError, match=r"critic\.safetensors cannot be read .*; delete .*step-00000070 to resume"
    ):
        fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    shutil.rmtree(newest)
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    _assert_same_run(run, smoke_run)


@pytest.mark.slow
@pytest.mark.parametrize("moments", [(20, 50, 70), "random", "random"], ids=["borders", "random", "again"])
def test_sigkill_loses_nothing_but_time(
    moments: tuple[int, ...] | str, tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    """Killed three times, each as soon as so many steps are on record; at 20 and 50 a phase has just ended."""
    if isinstance(moments, str):
        moments = tuple(sorted(random.sample(range(1, 71), 3)))
    print("killed at", moments)  # pytest shows it if the test fails
    run = tmp_path / "run"
    for moment in moments:
        resume = ["--resume"] if (run / "config.json").exists() else []
        process = subprocess.Popen(_fit_command(tiny_data, run, *resume), stderr=subprocess.DEVNULL)
        while process.poll() is None and len(read_metrics(run)) < moment:
            time.sleep(0.005)
        process.kill()
        process.wait()
    subprocess.run(_fit_command(tiny_data, run, "--resume"), check=True, stderr=subprocess.DEVNULL)
    _assert_same_run(run, smoke_run)


def test_the_highly_diverse_model_from_the_command_line(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    fit_it = ["fit", "--data", str(tiny_data), "--out", str(run), "--profile", "smoke", "--steps", "3"]
    assert main([*fit_it, "--variant", "highly-diverse", "--autoencoder", str(smoke_run)]) == 0
    config = fit_config_from_json((run / "config.json").read_text(), where="config.json")
    assert (config.variant, config.stage2.joined_diversity, config.stage2.steps) == (
        "highly-diverse",
        True,
        3,
    )
    assert [r["stage"] for r in read_metrics(run)] == [1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("select", ["fps_cd", "last"])
def test_the_best_weights_are_kept_or_the_last(select: Any, tiny_data: Path, tmp_path: Path) -> None:
    stage1 = dataclasses.replace(_SMOKE.stage1, select=select, gamma=0.0)
    stage2 = dataclasses.replace(_SMOKE.stage2, gamma=0.0)
    config = dataclasses.replace(_SMOKE, stage1=stage1, stage2=stage2)
    train, val = (
        load_split(tiny_data, split, image_size=(48, 64), map_size=16, progress=False)
        for split in ("train", "val")
    )
    training = Training(config, train)
    training.begin_phase("stage1", tmp_path)
    generator = training.learner.generator
    good = training.validate_and_keep_best(val, tmp_path)["val_fps_cd"]
    with torch.no_grad():
        for parameter in generator.parameters():
            parameter.mul_(2.0)  # clouds far larger than any object
    assert training.validate_and_keep_best(val, tmp_path)["val_fps_cd"] > 2 * good
    kept = load_generator(best_weights(tmp_path, 1)).parameters()
    same = all(torch.equal(a, b) for a, b in zip(generator.parameters(), kept, strict=True))
    assert same == (select == "last")


def test_a_training_starts_with_the_weights_of_another(
    tiny_data: Path, smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = dataclasses.replace(
        _SMOKE,
        start=str(best_weights(smoke_run, 1)),
        stage1=dataclasses.replace(_SMOKE.stage1, steps=0),
        stage2=dataclasses.replace(_SMOKE.stage2, steps=2, gamma=0.0),
    )
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    fresh = list(Training(dataclasses.replace(config, start=None), split).learner.generator.parameters())
    training = Training(config, split)
    training.begin_phase("stage2", tmp_path)
    saved = load_generator(best_weights(smoke_run, 1)).parameters()
    assert all(torch.equal(a, b) for a, b in zip(training.learner.generator.parameters(), saved, strict=True))
    assert not all(
        torch.equal(a, b) for a, b in zip(training.learner.generator.parameters(), fresh, strict=True)
    )
    # From the command line; and another network's weights are refused by name.
    fit_it = [
        "fit",
        "--data",
        str(tiny_data),
        "--profile",
        "smoke",
        "--steps",
        "2",
        "--start",
        str(smoke_run),
    ]
    assert main([*fit_it, "--out", str(tmp_path / "same")]) == 0
    assert main([*fit_it, "--out", str(tmp_path / "other"), "--deterministic"]) == 2
    assert "holds the weights of another network" in capsys.readouterr().err
    # Before anything is trained, and nothing is left behind.
    nowhere = [*fit_it[:-1], str(tmp_path / "nowhere"), "--out", str(tmp_path / "none")]
    assert main(nowhere) == 2
    assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
    assert not (tmp_path / "none").exists()
    # A run that has begun does not need them any more.
    start = shutil.copy(best_weights(smoke_run, 1), tmp_path / "start.safetensors")
    assert main([*fit_it[:-1], str(start), "--out", str(tmp_path / "gone")]) == 0
    start.unlink()
    shutil.rmtree(latest_checkpoint(tmp_path / "gone"))
    assert main(["fit", "--resume", "--data", str(tiny_data), "--out", str(tmp_path / "gone")]) == 0


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
    with pytest.raises(UserError, match="other data"):
        Training(_SMOKE, split).resume(smoke_run, newest)


def test_a_run_that_no_longer_looks_at_its_image_is_stopped(tiny_data: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(
        _SMOKE, collapse_check_every=2, collapse_patience=4, min_image_sensitivity=1e3
    )
    with pytest.raises(UserError, match=r"stopped at step 28: .* no longer looks at its image"):
        fit(tiny_data, tmp_path / "run", config, progress=False)


def test_a_training_that_explodes_says_so(tiny_data: Path, tmp_path: Path) -> None:
    stage = dataclasses.replace(_SMOKE.stage1, learning_rate=1e30, warmup=0)
    with pytest.raises(UserError, match="no longer finite; lower the learning rate"):
        fit(tiny_data, tmp_path / "run", dataclasses.replace(_SMOKE, stage1=stage), progress=False)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_one_shape_can_be_learnt_by_heart(precision: Precision, tiny_data: Path) -> None:
    """One shape, four joined views, 300 steps, without a critic: the front loss falls below 40 % of its start."""
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, limit=1, progress=False)
    stage = dataclasses.replace(
        _SMOKE.stage2, steps=300, shapes=1, views=4, codes=2, gamma=0.0, learning_rate=1e-3
    )
    config = dataclasses.replace(_SMOKE, stage1=stage, stage2=stage, precision=precision)
    training = Training(config, split)
    fronts = [training.advance()["front"].item() for _ in range(stage.steps)]
    assert sum(fronts[-10:]) / 10 < 0.4 * fronts[0]
