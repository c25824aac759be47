"""The auto-encoder and the critic on its latent codes: the networks, their losses, their part in training."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from diffpoint import PinholeCamera
from models import PROFILES as SIZES
from models import (
    Autoencoder,
    AutoencoderConfig,
    Critic,
    Generator,
    build_autoencoder,
    build_generator,
    critic_loss,
    generator_loss,
    gradient_penalty,
)
from models.autoencoder import AUTOENCODER_PROFILES
from train.config import StageConfig
from train.data.batches import Batch, LoadedSplit
from train.errors import UserError
from train.evaluation.runs import best_weights, load_autoencoder, load_generator
from train.methods import get_method, recipe
from train.methods.base import Noise, Step, TrainState
from train.methods.optimisers import adam
from train.methods.ours import autoencoder_loss, critic_steps
from train.methods.weights import save_weights
from train.training.trainer import Trainer

_SMOKE = recipe("ours", "smoke")
_NO_NOISE = Noise(torch.empty(0), torch.empty(0))


def _boxes(count: int, points: int = 128) -> Tensor:
    """Surfaces of boxes of different sizes."""
    sides = 0.2 + 0.6 * torch.rand(count, 1, 3)
    clouds = torch.rand(count, points, 3) - 0.5
    on = torch.randint(3, (count, points, 1))
    return sides * clouds.scatter(2, on, torch.randint(2, (count, points, 1)) - 0.5)


@pytest.fixture
def settled() -> Autoencoder:
    """A fresh auto-encoder whose batch norms have seen clouds, frozen."""
    torch.manual_seed(0)
    model = build_autoencoder("smoke")
    with torch.no_grad():
        for _ in range(60):
            model(_boxes(12))
    return model.freeze()


# --- the auto-encoder


@pytest.mark.parametrize("profile", ["full", "cpu", "smoke"])
def test_sizes_fit_the_generators(profile: str) -> None:
    with torch.device("meta"):
        model = build_autoencoder(profile)
    assert model.config.points == SIZES[profile].points == AUTOENCODER_PROFILES[profile].points


def test_the_full_profile_has_the_papers_layers() -> None:
    with torch.device("meta"):
        model = build_autoencoder("full")
    shapes = [tuple(p.shape) for p in model.parameters() if p.ndim == 2]
    encoder, decoder = shapes[:5], shapes[5:]
    assert encoder == [(64, 3), (128, 64), (256, 128), (256, 256), (128, 256)]
    assert decoder == [(256, 128), (256, 256), (6144, 256)]
    assert sum(isinstance(module, torch.nn.BatchNorm1d) for module in model.modules()) == 5


def test_a_code_does_not_depend_on_the_order_or_repetition_of_points(settled: Autoencoder) -> None:
    clouds = _boxes(3)
    shuffled = clouds[:, torch.randperm(128)]
    repeated = torch.cat([shuffled, shuffled[:, :50]], 1)
    torch.testing.assert_close(settled.encode(repeated), settled.encode(clouds))


def test_frozen_encoding_has_the_same_values_and_gradients(settled: Autoencoder) -> None:
    plain = _boxes(1).requires_grad_()
    quick = plain.detach().clone().requires_grad_()
    weights = torch.randn(128)
    for clouds, encode in ((plain, settled.encode), (quick, settled.encode_frozen)):
        (encode(clouds) @ weights).sum().backward()
    torch.testing.assert_close(settled.encode_frozen(quick), settled.encode(plain))
    assert plain.grad is not None
    assert plain.grad.abs().sum() > 0
    torch.testing.assert_close(quick.grad, plain.grad, rtol=1e-4, atol=1e-5)  # processors round differently
    with pytest.raises(RuntimeError, match="freeze"):
        build_autoencoder("smoke").encode_frozen(plain)


def test_a_frozen_auto_encoder_keeps_its_running_statistics(settled: Autoencoder, tmp_path: Path) -> None:
    """The code of a cloud does not depend on the rest of its batch, and is not that of a fresh batch norm."""
    save_weights(settled, tmp_path / "ae.safetensors")
    back = load_autoencoder(tmp_path / "ae.safetensors")
    assert not back.training
    assert not any(p.requires_grad for p in back.parameters())
    clouds = _boxes(4)
    torch.testing.assert_close(back.encode(clouds[:1]), settled.encode(clouds)[:1])
    for module in back.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.reset_running_stats()
    assert (back.encode(clouds) - settled.encode(clouds)).abs().mean() > 0.1


def test_it_learns_boxes() -> None:
    """After 200 steps a reconstruction is nearer to its own cloud than to that of another box."""
    torch.manual_seed(0)
    model = build_autoencoder("smoke")
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    state = TrainState(build_generator("smoke"), optimiser, model)
    errors = []
    for number in range(200):
        terms = autoencoder_loss(state, _boxes(16), _NO_NOISE, Step(_SMOKE.pretrain, number))
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
        errors.append(terms["cd"].item())
    assert errors[-1] < 0.35 * errors[0]
    model.freeze()
    clouds = _boxes(16)
    to_own, to_other = (torch.cdist(model(clouds), c).amin(2).mean() for c in (clouds, clouds.roll(1, 0)))
    assert to_own < 0.8 * to_other


# --- the latent output head; a whole run of it is in test_cli.py


def test_with_the_latent_head_the_frozen_decoder_makes_the_points(tmp_path: Path) -> None:
    torch.manual_seed(0)
    latent = dataclasses.replace(_SMOKE, output_head="latent")
    autoencoder, model = build_autoencoder("smoke"), get_method("ours").build(latent)
    assert isinstance(model, Generator)
    model.adopt_decoder(autoencoder)
    images, codes = torch.rand(2, 3, 48, 64), torch.randn(3, 2, model.code_dim)
    predicted = model.predict(images, codes)
    assert predicted.latents is not None
    assert predicted.latents.shape == (3, 2, 128)
    assert torch.equal(predicted.points.flatten(0, 1), autoencoder.decode(predicted.latents.flatten(0, 1)))
    predicted.points.square().sum().backward()
    without = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    assert without == {f"shape_decoder.{name}" for name, _ in autoencoder.decode.named_parameters()}
    save_weights(model, tmp_path / "latent.safetensors")  # with the decoder
    assert torch.equal(load_generator(tmp_path / "latent.safetensors")(images, codes), predicted.points)
    with pytest.raises(ValueError, match="='latent'"):
        build_generator("smoke").adopt_decoder(autoencoder)
    wrong: Any = "code"
    with pytest.raises(ValueError, match="must be 'points' or 'latent'; got 'code'"):
        get_method("ours").build(dataclasses.replace(latent, output_head=wrong))


def test_a_latent_head_needs_an_auto_encoder_of_its_size(train_split: LoadedSplit, tmp_path: Path) -> None:
    other = build_autoencoder(config=AutoencoderConfig("other", points=100, width=0.25))
    save_weights(other, best_weights(tmp_path, "autoencoder"))
    trainer = Trainer(dataclasses.replace(_SMOKE, output_head="latent"), train_split)
    with pytest.raises(UserError, match="makes 100 points, the generator with output head 'latent' 128"):
        trainer.begin_phase("stage1", tmp_path)
    Trainer(_SMOKE, train_split).begin_phase("stage1", tmp_path)  # a critic scores codes of any size of cloud


# --- the critic


@pytest.mark.parametrize(("slope", "expected"), [(1.0, 0.0), (3.0, 4.0), (0.0, 1.0)])
def test_the_penalty_is_zero_for_a_critic_of_slope_one(slope: float, expected: float) -> None:
    torch.manual_seed(0)
    u = torch.nn.functional.normalize(torch.randn(128), dim=0)
    real, fake = torch.randn(4, 6, 128), torch.randn(4, 6, 128)
    penalty = gradient_penalty(lambda z: slope * (z @ u), real, fake, mix=torch.rand(4, 6))
    assert penalty.item() == pytest.approx(expected, abs=1e-5)


def test_the_penalty_is_measured_between_the_codes() -> None:
    """Slope 1 around `real` and 3 around `fake`: what is measured depends on the place alone."""
    real, fake = torch.zeros(1, 128), torch.ones(1, 128)

    def bent(z: Tensor) -> Tensor:
        return z[..., 0] + 2 * torch.relu(z[..., 0] - 0.5)

    for place, expected in ((0.1, 0.0), (0.9, 4.0)):
        assert gradient_penalty(bent, real, fake, mix=torch.tensor([place])).item() == expected


def test_the_gradient_of_the_penalty_is_that_of_finite_differences() -> None:
    torch.manual_seed(0)
    critic = Critic().double()
    real, fake, mix = (torch.randn(5, 128).double(), torch.randn(5, 128).double(), torch.rand(5).double())
    weight = next(critic.parameters())
    (gradient,) = torch.autograd.grad(gradient_penalty(critic, real, fake, mix=mix), weight)
    direction = torch.randn_like(weight)
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            weight += sign * 1e-6 * direction
        values.append(gradient_penalty(critic, real, fake, mix=mix))
        with torch.no_grad():
            weight -= sign * 1e-6 * direction
    slope = (values[0] - values[1]) / 2e-6
    assert slope.item() == pytest.approx((gradient * direction).sum().item(), rel=1e-4)


def test_losses_of_critic_and_generator_have_opposite_signs() -> None:
    real, fake = torch.tensor([2.0, 4.0]), torch.tensor([1.0])
    assert critic_loss(real, fake).item() == -2
    assert generator_loss(fake).item() == -1


def test_it_separates_real_codes_from_scrambled_ones(settled: Autoencoder) -> None:
    """Every number of a scrambled code is that of some real shape, but not of the same one."""
    torch.manual_seed(0)
    critic, generator = Critic(), build_generator("smoke")
    state = TrainState(generator, adam(generator), settled, critic, adam(critic))
    step = Step(dataclasses.replace(_SMOKE.stage1, critic_learning_rate=1e-3), 0)
    camera = PinholeCamera.look_at(torch.ones(32, 1, 3), focal_px=1.0, height=1, width=1)

    def scrambled(codes: Tensor) -> Tensor:
        return torch.take_along_dim(codes, torch.rand_like(codes).argsort(0), 0)

    for _ in range(200):
        real = _boxes(32, 64)[None]
        batch = Batch(torch.empty(0), torch.ones(32, 1, 1, 1), camera, real)
        fake = scrambled(settled.encode(real[0]))
        report = critic_steps(state, fake[None], batch, torch.rand(1, 1, 32), step)
    assert report["penalty"] < 0.2
    with torch.no_grad():
        kept = settled.encode(_boxes(200, 64))
        of_real, of_fake = critic(kept), critic(scrambled(kept))
    threshold = (of_real.mean() + of_fake.mean()) / 2
    assert (of_real > threshold).float().mean() > 0.8
    assert (of_fake < threshold).float().mean() > 0.8


def _trainer(split: LoadedSplit, run: Path, **settings: Any) -> Trainer:
    """In stage 1 with these settings, and with the run's auto-encoder."""
    stage = dataclasses.replace(_SMOKE.stage1, warmup=0, **settings)
    trainer = Trainer(dataclasses.replace(_SMOKE, stage1=stage), split)
    trainer.begin_phase("stage1", run)
    return trainer


def test_the_critic_changes_the_generator_and_not_the_auto_encoder(
    train_split: LoadedSplit, smoke_run: Path
) -> None:
    moved = []
    for gamma in (0.0, 100.0):
        trainer = _trainer(train_split, smoke_run, gamma=gamma)
        assert trainer.state.autoencoder is not None
        before = {name: value.clone() for name, value in trainer.state.autoencoder.state_dict().items()}
        report = trainer.train_step()
        assert ("fake_score" in report) == (gamma > 0)
        after = trainer.state.autoencoder.state_dict()
        assert all(torch.equal(value, after[name]) for name, value in before.items())
        moved.append(next(trainer.state.network.parameters()).detach())
    assert not torch.equal(*moved)


def test_n_critic_and_real_pool_are_followed(train_split: LoadedSplit, smoke_run: Path) -> None:
    trainer = _trainer(train_split, smoke_run, n_critic=3, real_pool=2)
    stage = trainer.phase
    assert isinstance(stage, StageConfig)
    batch, noise = trainer.draw_batch()
    assert isinstance(batch, Batch)
    assert batch.real is not None
    assert batch.real.shape == (3, stage.shapes, 128, 3)
    assert noise.mix.shape == (3, stage.codes, stage.shapes)
    steps = []
    assert trainer.state.critic_optimiser is not None
    trainer.state.critic_optimiser.register_step_post_hook(lambda *_: steps.append(1))
    trainer.train_step()
    assert len(steps) == 3


def test_predictions_get_better_scores_when_the_critic_counts(
    train_split: LoadedSplit, smoke_run: Path
) -> None:
    """Against a critic that is not trained, so that a rise is due to the generator alone."""
    rises = []
    for gamma in (1e-6, 1e4):
        trainer = _trainer(train_split, smoke_run, steps=40, beta=0.0, gamma=gamma, critic_learning_rate=0.0)
        scores = torch.stack([trainer.train_step()["fake_score"] for _ in range(40)])
        rises.append((scores[-5:].mean() - scores[:5].mean()).item())
    assert rises[1] > 0
    assert rises[1] > rises[0] + 0.02  # where it does not count, scores fall by 0.03 to 0.04
