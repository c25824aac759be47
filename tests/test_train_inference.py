"""Search and descent on the codes: agreement grows, the network stays as it is, objects do not meet."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import train
from diffpoint import consistency_loss
from models import PROFILES, Generator, build_generator
from train.config import InferenceConfig
from train.evaluation.inference import reconstruct
from train.methods.weights import save_weights


@pytest.fixture(scope="module")
def model() -> Generator:
    torch.manual_seed(0)
    return build_generator("smoke").eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """(2, 3, 3, 48, 64): two objects in three views each."""
    generator = torch.Generator().manual_seed(1)
    images = torch.ones(2, 3, 3, 48, 64)
    images[..., 10:40, 12:50] = torch.rand(2, 3, 3, 30, 38, generator=generator)
    return images


def test_search_and_descent_bring_agreement(model: Generator, images: torch.Tensor) -> None:
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    found = reconstruct(model, images, groups=3, steps=8, step_size=2.0)
    assert found.points.shape == (2, 3 * model.points, 3)
    assert found.history.shape == (9, 2)
    assert (found.history[-1] < found.history[0]).all()
    one_by_one = found.points.unflatten(1, (3, model.points))
    torch.testing.assert_close(found.history[-1], 100 * consistency_loss(one_by_one, reduction="none"))
    torch.testing.assert_close(
        one_by_one.flatten(0, 1), model(images.flatten(0, 1), found.codes.flatten(0, 1)[None])[0].detach()
    )
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())


def test_the_descent_starts_from_the_most_consistent_group(model: Generator, images: torch.Tensor) -> None:
    starts = [reconstruct(model, images, groups=groups, steps=0).history[0] for groups in (1, 2, 5)]
    assert (starts[1] <= starts[0]).all()
    assert (starts[2] <= starts[1]).all()
    assert (starts[2] < starts[0]).any()


def test_the_codes_move_only_by_the_descent(model: Generator, images: torch.Tensor) -> None:
    searched = reconstruct(model, images, groups=2, steps=0).codes
    descended = reconstruct(model, images, groups=2, steps=2).codes
    moved = (descended - searched).norm(dim=-1)
    assert (moved > 0).all()
    assert torch.equal(searched, reconstruct(model, images, groups=2, steps=2, step_size=0.0).codes)


def test_objects_do_not_interact(model: Generator, images: torch.Tensor) -> None:
    together = reconstruct(model, images, groups=2, steps=3)
    other = images.clone()
    other[1] = other[1].flip(-1) * 0.5
    beside_another = reconstruct(model, other, groups=2, steps=3)
    torch.testing.assert_close(together.points[0], beside_another.points[0])
    assert not torch.allclose(together.points[1], beside_another.points[1])


def test_the_seed_decides(model: Generator, images: torch.Tensor) -> None:
    first, again, other = (reconstruct(model, images, groups=2, steps=1, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.codes, other.codes)


def test_one_object_needs_no_batch_dimension(model: Generator, images: torch.Tensor) -> None:
    assert torch.equal(
        reconstruct(model, images[0], groups=2, steps=1).points,
        reconstruct(model, images[:1], groups=2, steps=1).points,
    )


def test_one_view_has_nothing_to_agree_with(model: Generator, images: torch.Tensor) -> None:
    found = reconstruct(model, images[:, :1], groups=2, steps=5)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, model.points, 3)


def test_a_deterministic_network_has_nothing_to_choose(images: torch.Tensor) -> None:
    plain = build_generator("smoke", deterministic=True)
    found = reconstruct(plain, images)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, 3 * plain.points, 3)


def test_the_history_is_that_of_plain_descent(model: Generator, images: torch.Tensor) -> None:
    """The rows of `history` against a loop written out here."""
    found = reconstruct(model, images, groups=1, steps=3, step_size=2.0)
    codes = reconstruct(model, images, groups=1, steps=0).codes
    losses = []
    for _ in range(4):
        codes = codes.detach().requires_grad_()
        clouds = model(images.flatten(0, 1), codes.flatten(0, 1)[None])[0].unflatten(0, (2, 3))
        loss = 100 * consistency_loss(clouds, reduction="none")
        losses.append(loss.detach())
        codes = codes - 2.0 * torch.autograd.grad(loss.sum(), codes)[0]
    torch.testing.assert_close(found.history, torch.stack(losses))
    assert found.kept.tolist() == [3, 3]


def test_the_best_codes_are_kept_when_the_descent_overshoots(model: Generator, images: torch.Tensor) -> None:
    wild = InferenceConfig(groups=1, steps=12, step_size=3_000.0)
    last, best = (
        reconstruct(model, images, settings=dataclasses.replace(wild, keep_best=keep))
        for keep in (False, True)
    )
    torch.testing.assert_close(last.history, best.history)
    assert (last.history[-1] > last.history.amin(0)).any(), "these steps are meant to overshoot"
    assert torch.equal(best.kept, best.history.argmin(0))
    assert last.kept.tolist() == [12, 12]
    for found in (last, best):
        clouds = found.points.unflatten(1, (3, model.points))
        kept = found.history.gather(0, found.kept[None])[0]
        torch.testing.assert_close(100 * consistency_loss(clouds, reduction="none"), kept)


def test_each_object_stops_when_its_own_loss_no_longer_falls(model: Generator, images: torch.Tensor) -> None:
    patient = InferenceConfig(groups=1, steps=20, step_size=1.0)
    whole = reconstruct(model, images, settings=patient).history
    drops = -whole.diff(dim=0)
    # A threshold between the two objects' first drops: one object stops at once, the other goes on.
    order = drops[0].argsort()
    threshold = drops[0].mean().item()
    stopping = dataclasses.replace(patient, patience=1, min_drop=threshold)
    found = reconstruct(model, images, settings=stopping)
    assert found.kept[order[0]] == 1
    assert found.kept[order[1]] > 1
    assert len(found.history) == 1 + found.kept.max()
    for shape, step in enumerate(found.kept.tolist()):
        torch.testing.assert_close(found.history[: step + 1, shape], whole[: step + 1, shape])
        assert (found.history[step:, shape] == found.history[step, shape]).all()


def test_restraints_hold_the_codes_near_where_they_were_drawn(model: Generator, images: torch.Tensor) -> None:
    far = InferenceConfig(groups=1, steps=6, step_size=50.0)
    start = reconstruct(model, images, groups=1, steps=0).codes.norm(dim=-1)
    free = reconstruct(model, images, settings=far).codes.norm(dim=-1)
    held = reconstruct(model, images, settings=dataclasses.replace(far, keep_norm=True)).codes.norm(dim=-1)
    pulled = reconstruct(model, images, settings=dataclasses.replace(far, prior=0.01)).codes.norm(dim=-1)
    assert not torch.allclose(free, start, rtol=1e-3)
    torch.testing.assert_close(held, start)
    assert (pulled < free).all()


def test_parts_of_a_batch_make_the_whole(
    model: Generator, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopping = InferenceConfig(groups=2, steps=5, step_size=1.0, patience=1, min_drop=0.05)
    whole = reconstruct(model, images, settings=stopping)
    monkeypatch.setattr("train.evaluation.inference._POINTS_AT_ONCE", 1)
    in_parts = reconstruct(model, images, settings=stopping)
    assert torch.equal(whole.kept, in_parts.kept)
    assert len(set(whole.kept.tolist())) == 2, "the parts are meant to stop at different steps"
    # The network rounds differently at another batch size, and nearest points may change with it.
    torch.testing.assert_close(whole.history, in_parts.history, rtol=1e-3, atol=0)
    torch.testing.assert_close(whole.points, in_parts.points, rtol=0, atol=5e-3)


def test_two_dozen_views_agree(model: Generator) -> None:
    images = torch.rand(24, 3, 48, 64, generator=torch.Generator().manual_seed(2))
    found = reconstruct(model, images, groups=2, steps=2, step_size=2.0)
    assert found.points.shape == (1, 24 * model.points, 3)
    assert found.history[-1] < found.history[0]


def test_arguments_go_before_settings(model: Generator, images: torch.Tensor) -> None:
    settings = InferenceConfig(groups=1, steps=7, step_size=0.3)
    found = reconstruct(model, images, steps=2, settings=settings)
    assert len(found.history) == 3
    assert torch.equal(found.codes, reconstruct(model, images, groups=1, steps=2, step_size=0.3).codes)
    assert len(reconstruct(model, images[:1, :2]).history) == 31, "30 steps when nothing is said"


def test_wrong_arguments_are_named(model: Generator) -> None:
    with pytest.raises(ValueError, match=r"'images' must be .* got \(3, 48, 64\)"):
        reconstruct(model, torch.ones(3, 48, 64))
    with pytest.raises(ValueError, match="'images' must be"):
        reconstruct(model, torch.ones(0, 3, 48, 64))
    with pytest.raises(ValueError, match="groups >= 1"):
        reconstruct(model, torch.ones(2, 3, 48, 64), groups=0)
    with pytest.raises(ValueError, match=r"patience >= 0; got 5, 30 and -1"):
        reconstruct(model, torch.ones(2, 3, 48, 64), settings=InferenceConfig(patience=-1))


# --- weights


def _header(path: Path) -> dict:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["diffpoint.generator"])


def test_headers_of_earlier_versions_are_read_and_new_names_written(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = build_generator(config=dataclasses.replace(PROFILES["smoke"], occupancy_logits=True))
    save_weights(model, tmp_path / "new.safetensors")
    header = _header(tmp_path / "new.safetensors")
    assert header == dataclasses.asdict(model.config)

    header["ending"], header["existence"] = header.pop("output_head"), header.pop("occupancy_logits")
    tensors = {name: value.contiguous() for name, value in model.state_dict().items()}
    save_file(tensors, tmp_path / "old.safetensors", {"diffpoint.generator": json.dumps(header)})
    old = train.load_generator(tmp_path / "old.safetensors")
    assert old.config == model.config
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in old.state_dict().items())


def test_the_shipped_weights_have_an_old_header_and_load() -> None:
    assert "ending" in _header(Path(train.__file__).parent / "pretrained" / "generator.safetensors")
    model = train.load_generator("pretrained")
    assert model.config.output_head == "points"
    assert not model.training


# --- from Python


def test_a_bare_import_offers_the_python_interface_and_loads_nothing() -> None:
    code = """
import sys, train
assert "torch" not in sys.modules and {"load_generator", "reconstruct", "data"} <= set(dir(train))
import torch
model = train.load_generator("pretrained")
found = train.reconstruct(model, torch.rand(2, 3, 32, 32), groups=2, steps=1, seed=0)
assert isinstance(found, train.Reconstruction) and found.points.shape == (1, 2 * model.points, 3)
assert train.data.ShapeTree.__name__ == "ShapeTree" and not model.training
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with pytest.raises(AttributeError, match="no attribute 'load_critic'"):
        _ = train.load_critic  # pyright: ignore[reportAttributeAccessIssue]


def test_a_run_can_be_named_by_its_directory_or_file_as_str_or_path(smoke_run: Path) -> None:
    best = smoke_run / "checkpoints" / "best-stage2.safetensors"
    weights = [train.load_generator(named).state_dict() for named in (smoke_run, str(smoke_run), str(best))]
    for other in weights[1:]:
        assert all(torch.equal(value, weights[0][name]) for name, value in other.items())
