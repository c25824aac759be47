"""Weights on disk: the way there and back, and everything that is no run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from models import build_generator
from train.errors import UserError
from train.evaluation.runs import load_generator
from train.files import replacing
from train.methods.weights import save_weights
from train.training.checkpoint import load_networks, load_state, save_checkpoint


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
    for expected, name in zip(models, (None, "best-stage1", "best-stage2"), strict=True):
        if name:
            save_weights(expected, tmp_path / "checkpoints" / f"{name}.safetensors")
        found = load_generator(tmp_path).state_dict()
        assert all(torch.equal(value, found[key]) for key, value in expected.state_dict().items())


def test_the_newest_two_checkpoints_are_kept(tmp_path: Path) -> None:
    model = build_generator("smoke")
    for step in (1, 2, 3, 3):
        save_checkpoint(tmp_path, step, {"weights": model}, {"step": step})
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["step-00000002", "step-00000003"]
    assert load_state(tmp_path / "checkpoints" / "step-00000003") == {"step": 3}


def test_what_is_no_run_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "noise.safetensors").write_bytes(b"\x00" * 100)
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    (tmp_path / "empty").mkdir()
    for name, complaint in (
        ("missing", "does not exist"),
        ("empty", "is not a run"),
        ("noise.safetensors", "holds no generator's weights"),
        ("other.safetensors", "no diffpoint.generator header"),
    ):
        with pytest.raises(UserError, match=complaint) as caught:
            load_generator(tmp_path / name)
        assert name in str(caught.value)


def test_weights_of_another_version_are_called_so(tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    save_weights(build_generator("smoke"), path)
    with safe_open(path, framework="pt") as file:
        headers, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    name = sorted(tensors)[0]
    save_file(tensors | {name: torch.zeros(7)}, path, headers)
    with pytest.raises(
        UserError, match=rf"old\.safetensors was written by another .*\(1 of them, {name} first\)"
    ):
        load_generator(path)
    # Nor is such a checkpoint said to be damaged: deleting it would mend nothing.
    networks = {"old": build_generator("smoke")}
    with pytest.raises(UserError, match=r"old\.safetensors was written by another") as caught:
        load_networks(tmp_path, networks)
    assert "delete" not in str(caught.value)


def test_an_unreadable_state_is_named(tmp_path: Path) -> None:
    model = build_generator("smoke")
    save_checkpoint(tmp_path, 5, {"weights": model}, {})
    directory = tmp_path / "checkpoints" / "step-00000005"
    (directory / "state.pt").write_bytes(b"half a fi")
    with pytest.raises(UserError, match=r"state\.pt cannot be read"):
        load_state(directory)
    (directory / "weights.safetensors").unlink()
    with pytest.raises(UserError, match=r"weights\.safetensors cannot be read .*delete .*step-00000005"):
        load_networks(directory, {"weights": model})


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
