"""`fit`: what a run writes, resuming to the same bits, checkpoints, the collapse check, and several processes."""

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

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from models import build_generator
from tests.one_step_each import one_step_each
from train.__main__ import main
from train.config import FitConfig, with_steps
from train.data import tree_files
from train.data.batches import LoadedSplit, load_split
from train.data.render import Renderer, draw_camera
from train.data.solids import bar, sample_union, surface_of
from train.device import SINGLE, connect
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.runs import best_weights, latest_checkpoint, load_generator, read_metrics
from train.files import replacing
from train.methods import recipe
from train.methods.losses import view_loss
from train.methods.weights import save_weights
from train.training.checkpoint import load_networks, load_state, save_checkpoint
from train.training.trainer import Trainer, fit

_ROOT = Path(__file__).parents[1]
_SMOKE = recipe("ours", "smoke")


def _without_critic(config: FitConfig = _SMOKE, *, steps: tuple[int, int] = (2, 2)) -> FitConfig:
    """So that no auto-encoder is trained either."""
    stage1, stage2 = (
        dataclasses.replace(stage, steps=count, gamma=0.0)
        for stage, count in zip((config.stage1, config.stage2), steps, strict=True)
    )
    return dataclasses.replace(config, stage1=stage1, stage2=stage2)


def test_a_run_leaves_records_weights_and_pictures(smoke_run: Path, tiny_data: Path) -> None:
    records = read_metrics(smoke_run)
    assert [r["step"] for r in records] == list(range(1, 71))
    assert [r["stage"] for r in records] == [0] * 20 + [1] * 30 + [2] * 20
    assert [r["step"] for r in records if "val_autoencoder_cd" in r] == [10, 20]
    checked = [r for r in records if "image_sensitivity" in r]
    assert [r["step"] for r in checked] == [30, 40, 50, 60, 70]
    assert all(r["image_sensitivity"] > 0.5 and r["code_sensitivity"] > 0.5 for r in checked)
    assert all({"val_cd_1", "val_cd", "val_fps_cd", "matched_share"} <= r.keys() for r in checked)
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


# --- interrupted runs end in the bits of an undisturbed one


def _newest(run: Path) -> Path:
    newest = latest_checkpoint(run)
    assert newest is not None
    return newest


def _assert_same_run(run: Path, other: Path) -> None:
    pairs = [(file, _newest(other) / file.name) for file in _newest(run).glob("*.safetensors")]
    pairs += [(file, other / "checkpoints" / file.name) for file in run.glob("checkpoints/best-*")]
    assert len(pairs) >= 3
    assert [a.name for a, b in pairs if a.read_bytes() != b.read_bytes()] == []
    assert _without_times(read_metrics(run)) == _without_times(read_metrics(other))


def _without_times(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    def measured(name: str) -> bool:
        return name.endswith("_seconds") or name in ("seconds_per_step", "data_wait_share")

    return [{k: v for k, v in record.items() if not measured(k)} for record in records]


class _Killed(BaseException):
    pass


@pytest.fixture
def interrupt(monkeypatch: pytest.MonkeyPatch) -> Any:
    """interrupt(steps, sigterm=...): the next run dies, or gets a SIGTERM, in the step after so many."""
    take = Trainer.train_step

    def interrupt(steps: int, *, sigterm: bool = False) -> None:
        def interrupted(trainer: Trainer) -> dict[str, torch.Tensor]:
            if trainer.total_steps == steps and sigterm:
                os.kill(os.getpid(), signal.SIGTERM)
            elif trainer.total_steps == steps:
                take(trainer)
                raise _Killed
            return take(trainer)

        monkeypatch.setattr(Trainer, "train_step", interrupted)

    return interrupt


def test_a_run_killed_in_every_phase_and_at_every_border_ends_in_the_same_bits(
    interrupt: Any, monkeypatch: pytest.MonkeyPatch, tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    """Phases end at 20 and 50, checkpoints are every 10 steps; a SIGTERM saves at once."""
    run, handler = tmp_path / "run", signal.getsignal(signal.SIGTERM)
    for steps in (12, 20, 50, 63):
        interrupt(steps)
        with pytest.raises(_Killed):
            fit(tiny_data, run, _SMOKE, resume=steps > 12, progress=False)
        if steps == 20:
            interrupt(42, sigterm=True)
            assert not fit(tiny_data, run, _SMOKE, resume=True, progress=False)
            assert signal.getsignal(signal.SIGTERM) == handler
            assert _newest(run).name == "step-00000043"
    monkeypatch.undo()
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    _assert_same_run(run, smoke_run)
    # Resuming a complete run changes nothing.
    before = (run / "metrics.jsonl").read_bytes()
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    assert (run / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("config", "kills"),
    [
        pytest.param(recipe("lin", "smoke"), (4, 12, 16), id="batch norms"),  # the first phase has 12 steps
        pytest.param(
            with_steps(recipe("ours", "smoke", "whole-shapes"), 8),
            (4, 11),
            id="whole shapes, augmented images",
        ),
    ],
)
def test_other_state_is_resumed_too(
    config: FitConfig,
    kills: tuple[int, ...],
    interrupt: Any,
    monkeypatch: pytest.MonkeyPatch,
    tiny_data: Path,
    tmp_path: Path,
) -> None:
    config = dataclasses.replace(config, checkpoint_every=3, picture_every=0)
    assert fit(tiny_data, tmp_path / "whole", config, progress=False)
    if config.recipe == "whole-shapes":
        records = read_metrics(tmp_path / "whole")
        assert all(0 < record["nearest_emd"] <= record["mean_emd"] for record in records)
        assert all(record["front"] > 0 and record["diversity"] == 0 for record in records)
    for steps in kills:
        interrupt(steps)
        with pytest.raises(_Killed):
            fit(tiny_data, tmp_path / "run", config, resume=steps > kills[0], progress=False)
    monkeypatch.undo()
    assert fit(tiny_data, tmp_path / "run", config, resume=True, progress=False)
    _assert_same_run(tmp_path / "run", tmp_path / "whole")


_CLI = (
    "import resource, sys; limit = int(sys.argv.pop(1)); "
    "limit and resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)); "
    "from train.__main__ import main; sys.exit(main(sys.argv[1:]))"
)


def _fit_command(data: Path, run: Path, *options: str, largest_file: int = 0) -> list[str]:
    command = ["fit", "--data", str(data), "--out", str(run), "--profile", "smoke", "--recipe", "paper"]
    return [sys.executable, "-c", _CLI, str(largest_file), *command, *options]


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


def _copy_at_60(smoke_run: Path, run: Path) -> Path:
    shutil.copytree(smoke_run, run)
    shutil.rmtree(run / "checkpoints" / "step-00000070")
    return run


def test_a_full_disk_leaves_the_last_good_checkpoint(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    run = _copy_at_60(smoke_run, tmp_path / "run")
    files = [path for path in run.glob("checkpoints/step-*/*") if path.is_file()]
    before = {path: path.read_bytes() for path in files}
    command = _fit_command(
        tiny_data, run, "--resume", largest_file=4_000_000
    )  # the optimiser's state is larger
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 2
    complaint = done.stderr.splitlines()[-1]
    assert "step-00000070 cannot be written ([Errno 27] File too large)" in complaint
    assert "continue with --resume" in complaint
    assert {path: path.read_bytes() for path in run.glob("checkpoints/step-*/*")} == before
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    _assert_same_run(run, smoke_run)


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_can_be_resumed(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(smoke_run, run)
    newest = run / "checkpoints" / "step-00000070"
    (newest / "critic.safetensors").write_bytes(b"half")
    complaint = r"critic\.safetensors cannot be read .*; delete .*step-00000070 to resume"
    with pytest.raises(UserError, match=complaint):
        fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    shutil.rmtree(newest)
    assert fit(tiny_data, run, _SMOKE, resume=True, progress=False)
    _assert_same_run(run, smoke_run)


def test_a_run_of_an_earlier_version_is_evaluated_and_resumed(
    tiny_data: Path, smoke_run: Path, train_split: LoadedSplit, tmp_path: Path
) -> None:
    """With the old names of settings, in config.json and in weights, and of the count of failed collapse checks."""
    run = _copy_at_60(smoke_run, tmp_path / "run")
    config = (run / "config.json").read_text()
    for new, old in (
        ("output_head", "ending"), ("collapse_check_every", "health_every"), ("collapse_patience", "health_patience"),
    ):  # fmt: skip
        assert f'"{new}"' in config
        config = config.replace(f'"{new}"', f'"{old}"')
    (run / "config.json").write_text(config)
    header = {"diffpoint.generator": json.dumps({
        "profile": "smoke", "image_height": 48, "image_width": 64, "trunk_width": 0.5, "decoder_width": 0.125,
        "deterministic": False, "ending": "points", "existence": False,
    })}  # fmt: skip
    for file in (
        *run.glob("checkpoints/best-stage?.safetensors"),
        *run.glob("checkpoints/*/weights.safetensors"),
    ):
        save_file(load_file(file), file, header)
    checkpoint = _newest(run)
    state = load_state(checkpoint)
    state["deaf_checks"] = 2 * (1 + state.pop("failed_collapse_checks"))
    torch.save(state, checkpoint / "state.pt")

    trainer = Trainer(_SMOKE, train_split)
    trainer.resume(run, checkpoint)
    assert trainer.collapse_check.failed == 2
    result = evaluate(run, tiny_data, seeds=(0,), views=(2,), progress=False)
    assert result["views"] == evaluate(smoke_run, tiny_data, seeds=(0,), views=(2,), progress=False)["views"]
    assert main(["fit", "--data", str(tiny_data), "--out", str(run), "--resume"]) == 0
    for stage in (1, 2):  # those that were not written anew have the old header still
        save_weights(load_generator(best_weights(run, stage)), best_weights(run, stage))
    _assert_same_run(run, smoke_run)


def test_resuming_with_other_data_is_refused(tiny_data: Path, smoke_run: Path) -> None:
    split = load_split(tiny_data, "test", image_size=(48, 64), map_size=16, progress=False)
    with pytest.raises(UserError, match="other data"):
        Trainer(_SMOKE, split).resume(smoke_run, _newest(smoke_run))


# --- phases, where they start, what they keep


def test_a_phase_of_no_steps_is_left_out(tiny_data: Path, tmp_path: Path) -> None:
    only_second = _without_critic(steps=(0, 2))
    assert list(only_second.phases) == ["stage2"]
    assert fit(tiny_data, tmp_path / "run", only_second, progress=False)
    assert [record["stage"] for record in read_metrics(tmp_path / "run")] == [2, 2]
    with pytest.raises(UserError, match="every phase has 0 steps"):
        fit(tiny_data, tmp_path / "none", _without_critic(steps=(0, 0)), progress=False)


@pytest.mark.parametrize("select", ["fps_cd", "last"])
def test_the_best_weights_are_kept_or_the_last(
    select: Any, tiny_data: Path, train_split: LoadedSplit, tmp_path: Path
) -> None:
    config = _without_critic()
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, select=select))
    val = load_split(tiny_data, "val", image_size=(48, 64), map_size=16, progress=False)
    trainer = Trainer(config, train_split)
    good = trainer.validate_and_keep_best(val, tmp_path)["val_fps_cd"]
    network = trainer.state.network
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(2.0)  # clouds far larger than any object
    assert trainer.validate_and_keep_best(val, tmp_path)["val_fps_cd"] > 2 * good
    kept = load_generator(best_weights(tmp_path, 1)).parameters()
    same = all(torch.equal(a, b) for a, b in zip(network.parameters(), kept, strict=True))
    assert same == (select == "last")


def test_a_training_starts_with_the_weights_of_another(
    tiny_data: Path,
    smoke_run: Path,
    train_split: LoadedSplit,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    start = best_weights(smoke_run, 1)
    config = dataclasses.replace(_without_critic(steps=(0, 2)), start=str(start))
    trainer, fresh = (Trainer(c, train_split) for c in (config, dataclasses.replace(config, start=None)))
    trainer.begin_phase("stage2", tmp_path)
    taken, saved, drawn = (
        torch.cat([p.flatten() for p in network.parameters()])
        for network in (trainer.state.network, load_generator(start), fresh.state.network)
    )
    assert torch.equal(taken, saved)
    assert not torch.equal(taken, drawn)
    # From the command line; another network's weights, or none, are refused before anything is written.
    fit_it = ["fit", "--recipe", "paper", "--data", str(tiny_data), "--profile", "smoke", "--steps", "2"]
    fit_it += ["--stage1.gamma", "0", "--stage2.gamma", "0", "--start"]
    assert main([*fit_it, str(smoke_run), "--out", str(tmp_path / "other"), "--deterministic"]) == 2
    assert "holds the weights of another network" in capsys.readouterr().err
    assert main([*fit_it, str(tmp_path / "nowhere"), "--out", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err
    pretrained = [
        "fit",
        "--data",
        str(tiny_data),
        "--start",
        "pretrained",
        "--out",
        str(tmp_path / "smaller"),
    ]
    assert (
        main([*pretrained, "--profile", "smoke"]) == 2
    )  # whose layers are fractions of the pretrained one's
    assert "holds the weights of another network" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    # A wider decoder starts with the same predictions.
    wider = Trainer(dataclasses.replace(config, decoder_width=2), train_split).state.network
    images, codes = torch.rand(1, 3, 48, 64), torch.randn(1, 1, wider.code_dim)
    torch.testing.assert_close(
        wider(images, codes), load_generator(start)(images, codes), atol=1e-6, rtol=1e-5
    )
    # A run that has begun does not need them any more.
    copy = Path(shutil.copy(start, tmp_path / "start.safetensors"))
    assert main([*fit_it, str(copy), "--out", str(tmp_path / "run")]) == 0
    copy.unlink()
    shutil.rmtree(_newest(tmp_path / "run"))
    assert main(["fit", "--resume", "--data", str(tiny_data), "--out", str(tmp_path / "run")]) == 0


def test_a_run_that_ignores_its_image_is_stopped(tiny_data: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(
        _without_critic(steps=(30, 0)), collapse_check_every=2, collapse_patience=4, min_image_sensitivity=1e3
    )
    with pytest.raises(UserError, match=r"stopped at step 8: .* so the network ignores its image"):
        fit(tiny_data, tmp_path / "run", config, progress=False)


# --- thin shapes


@pytest.fixture(scope="module")
def pole_data(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny tree with a pole, a pixel wide, in each split: shrunk to 16 x 16, its depth maps are empty."""
    root = tmp_path_factory.mktemp("poles") / "tree"
    shutil.copytree(tiny_data, root)
    pole, rng = [bar((0, -0.45, 0), (0, 0.45, 0), 0.01, np.array([0.2, 0.3, 0.8]))], np.random.default_rng(0)
    views = Renderer(surface_of(pole)).render(draw_camera(rng, 4, 64))
    for split in tree_files.SPLITS:
        tree_files.write_shape(
            root, f"03001627/pole_{split}", views, sample_union(pole, tree_files.POINTS, rng)
        )
        with (root / tree_files.LISTS / split / "03001627.list").open("a") as file:
            file.write(f"03001627/pole_{split}\n")
    return root


def test_shapes_that_vanish_from_small_depth_maps_are_trained_on(pole_data: Path, tmp_path: Path) -> None:
    split = load_split(pole_data, "train", image_size=(48, 64), map_size=16, progress=False)
    empty = [not depth[:].isfinite().any() for depth in split.depth]
    assert [split.ids[i] for i in range(len(split)) if empty[i]] == ["03001627/pole_train"]
    config = _without_critic(steps=(12, 12))  # 12 batches of 3 of the 9 shapes
    config = dataclasses.replace(config, stage2=dataclasses.replace(config.stage2, shapes=9, steps=2))
    run = tmp_path / "run"
    assert fit(pole_data, run, config, progress=False)
    records = read_metrics(run)
    assert all(np.isfinite([r["loss"] for r in records]))
    assert evaluate(run, pole_data, seeds=(0,), views=(2,), progress=False)["views"]["2"]["cd"] < 100

    # The views of other shapes cost what they cost without the pole, and get the same gradient.
    shapes, views = torch.arange(len(split)), torch.arange(2).expand(len(split), -1)
    others = shapes[~torch.tensor(empty)]
    clouds = (0.3 * torch.randn(2, len(split), 2, 128, 3)).requires_grad_()
    for stage in config.stages:
        all_views = view_loss(clouds.flatten(1, 2), split.batch(shapes, views), stage, step=0)
        without = view_loss(
            clouds[:, others].flatten(1, 2), split.batch(others, views[others]), stage, step=0
        )
        each = all_views.each.view(2, len(split), -1)
        assert torch.equal(each[:, others].flatten(), without.each.flatten())
        assert not each[:, empty].any()
        gradients = [torch.autograd.grad(found.each.sum(), clouds)[0] for found in (all_views, without)]
        assert torch.equal(*gradients)


@pytest.mark.parametrize("system", ["ours", "front-mon", "lin", "r2n2", "ptn"])
def test_a_batch_of_nothing_but_empty_depth_maps_trains(system: str, pole_data: Path, tmp_path: Path) -> None:
    config = recipe(system, "smoke")
    config = _without_critic(config, steps=(1, 1 if config.stage2.steps else 0))
    poles = tmp_path / "poles"
    shutil.copytree(pole_data, poles)
    for split in tree_files.SPLITS:
        for file in (poles / tree_files.LISTS / split).glob("*.list"):
            file.write_text(f"03001627/pole_{split}\n" if file.stem == "03001627" else "")
    assert fit(poles, tmp_path / "run", config, progress=False)
    assert all(np.isfinite(record["loss"]) for record in read_metrics(tmp_path / "run"))


# --- files of weights and checkpoints


@pytest.mark.parametrize("deterministic", [False, True])
def test_weights_come_back_with_the_network_they_belong_to(deterministic: bool, tmp_path: Path) -> None:
    model = build_generator("smoke", deterministic)
    save_weights(model, tmp_path / "w.safetensors")
    back = load_generator(tmp_path / "w.safetensors")
    assert back.config == model.config
    assert not back.training
    images, codes = torch.rand(2, 3, 40, 40), torch.randn(3, 2, model.code_dim)
    assert torch.equal(back(images, codes), model(images, codes))


def test_a_run_gives_its_best_weights_and_only_then_the_newest(tmp_path: Path) -> None:
    models = [build_generator("smoke") for _ in range(3)]
    save_checkpoint(tmp_path, 7, {"weights": models[0]}, {})
    for expected, stage in zip(models, (None, 1, 2), strict=True):
        if stage:
            save_weights(expected, best_weights(tmp_path, stage))
        found = load_generator(tmp_path).state_dict()
        assert all(torch.equal(value, found[key]) for key, value in expected.state_dict().items())


def test_the_newest_two_checkpoints_are_kept_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    networks = {"weights": build_generator("smoke")}
    for step in (1, 2, 3, 3):
        save_checkpoint(tmp_path, step, networks, {"step": step})
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["step-00000002", "step-00000003"]
    newest = tmp_path / "checkpoints" / "step-00000003"
    assert load_state(newest) == {"step": 3}
    (newest / "state.pt").write_bytes(b"half a fi")
    with pytest.raises(UserError, match=r"state\.pt cannot be read"):
        load_state(newest)
    (newest / "weights.safetensors").unlink()
    with pytest.raises(UserError, match=r"weights\.safetensors cannot be read .*delete .*step-00000003"):
        load_networks(newest, networks)


def test_weights_of_another_program_or_version_are_called_so(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match=r"other\.safetensors .*no diffpoint.generator header"):
        load_generator(tmp_path / "other.safetensors")
    path = tmp_path / "old.safetensors"
    save_weights(build_generator("smoke"), path)
    with safe_open(path, framework="pt") as file:
        headers = file.metadata()
    tensors = load_file(path)
    name = min(tensors)
    save_file(tensors | {name: torch.zeros(7)}, path, headers)
    complaint = rf"old\.safetensors was written by another .*\(1 of them, {name} first\)"
    with pytest.raises(UserError, match=complaint):
        load_generator(path)
    # Such a checkpoint is not called damaged: to delete it would not help.
    with pytest.raises(UserError, match=complaint) as caught:
        load_networks(tmp_path, {"old": build_generator("smoke")})
    assert "delete" not in str(caught.value)


@pytest.mark.parametrize("kind", ["file", "directory"])
def test_a_failed_write_leaves_no_trace(kind: str, tmp_path: Path) -> None:
    if kind == "file":
        (tmp_path / "target").write_text("old")

    def write() -> None:
        with replacing(tmp_path / "target") as temporary:
            if kind == "file":
                temporary.write_text("half")
            else:
                temporary.mkdir()
                (temporary / "part").write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write()
    assert [p.name for p in tmp_path.iterdir()] == (["target"] if kind == "file" else [])
    assert kind == "directory" or (tmp_path / "target").read_text() == "old"


# --- several processes


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
    one = one_step_each(tiny_data, smoke_run, SINGLE)
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
    fit_it = [
        "-m",
        "train",
        "fit",
        "--data",
        tiny_data,
        "--profile",
        "smoke",
        "--recipe",
        "paper",
        "--stage1.shapes",
        "4",
    ]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    _torchrun(*fit_it, "--out", whole)
    _torchrun(*fit_it, "--out", parts)
    shutil.rmtree(_newest(parts))
    _torchrun("-m", "train", "fit", "--data", tiny_data, "--out", parts, "--resume")
    assert [r["step"] for r in read_metrics(parts)] == list(range(1, 71))
    _assert_same_run(parts, whole)


def test_a_single_process_needs_no_communication() -> None:
    assert connect() is SINGLE
    assert "lightning_fabric" not in sys.modules
    values = torch.arange(6.0)
    assert torch.equal(SINGLE.shard(values), values)
    assert torch.equal(SINGLE.mean(values), values)
