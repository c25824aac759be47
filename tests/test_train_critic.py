"""The critic: its penalty, what it can tell apart, and what its opinion does to the generator."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from diffpoint import PinholeCamera
from models import (
    Critic,
    build_autoencoder,
    build_generator,
    critic_loss,
    generator_loss,
    gradient_penalty,
)
from train.config import PROFILES
from train.data.batches import Batch, load_split
from train.methods.step import Learner, critic_steps
from train.training.state import Training

_SMOKE = PROFILES["smoke"]


@pytest.mark.parametrize(("slope", "expected"), [(1.0, 0.0), (3.0, 4.0), (0.0, 1.0)])
def test_the_penalty_is_zero_on_a_critic_of_slope_one(slope: float, expected: float) -> None:
    torch.manual_seed(0)
    u = torch.nn.functional.normalize(torch.randn(128), dim=0)
    real, fake = torch.randn(4, 6, 128), torch.randn(4, 6, 128)
    penalty = gradient_penalty(lambda z: slope * (z @ u), real, fake, mix=torch.rand(4, 6))
    assert penalty.item() == pytest.approx(expected, abs=1e-5)


def test_the_penalty_looks_between_the_codes() -> None:
    """Slope 1 around `real` and 3 around `fake`: what is measured depends on the place alone."""
    real, fake = torch.zeros(1, 128), torch.ones(1, 128)

    def bent(z: torch.Tensor) -> torch.Tensor:
        return z[..., 0] + 2 * torch.relu(z[..., 0] - 0.5)

    for place, expected in ((0.1, 0.0), (0.9, 4.0)):
        assert gradient_penalty(bent, real, fake, mix=torch.tensor([place])).item() == expected


def test_its_gradient_is_that_of_finite_differences() -> None:
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


def test_losses_pull_in_opposite_directions() -> None:
    real, fake = torch.tensor([2.0, 4.0]), torch.tensor([1.0])
    assert critic_loss(real, fake).item() == -2
    assert generator_loss(fake).item() == -1


def _boxes(count: int) -> torch.Tensor:
    """Surfaces of boxes of different sizes, 64 points each."""
    clouds = torch.rand(count, 64, 3) - 0.5
    on = torch.randint(3, (count, 64, 1))
    return (0.2 + 0.8 * torch.rand(count, 1, 3)) * clouds.scatter(2, on, torch.randint(2, on.shape) - 0.5)


def test_it_tells_real_codes_from_scrambled_ones() -> None:
    """Every number of a scrambled code is some real shape's, but not the same one's."""
    torch.manual_seed(0)
    autoencoder, critic = build_autoencoder("smoke"), Critic()
    with torch.no_grad():
        for _ in range(80):
            autoencoder(_boxes(16))
    autoencoder.freeze()
    optimiser = torch.optim.Adam(critic.parameters())
    learner = Learner(build_generator("smoke"), critic, autoencoder, optimiser, optimiser)
    stage = dataclasses.replace(_SMOKE.stage1, critic_learning_rate=1e-3)
    camera = PinholeCamera.look_at(torch.ones(32, 1, 3), focal_px=1.0, height=1, width=1)

    def scrambled(codes: torch.Tensor) -> torch.Tensor:
        return torch.take_along_dim(codes, torch.rand_like(codes).argsort(0), 0)

    for _ in range(200):
        batch = Batch(torch.empty(0), torch.ones(32, 1, 1, 1), camera, _boxes(32)[None])
        assert batch.real is not None
        fake = scrambled(autoencoder.encode(batch.real[0]))
        report = critic_steps(learner, fake[None], batch, torch.rand(1, 1, 32), stage)
    assert report["penalty"] < 0.2
    with torch.no_grad():
        kept = autoencoder.encode(_boxes(200))
        of_real, of_fake = critic(kept), critic(scrambled(kept))
    threshold = (of_real.mean() + of_fake.mean()) / 2
    assert (of_real > threshold).float().mean() > 0.8
    assert (of_fake < threshold).float().mean() > 0.8


def test_the_critic_moves_the_generator_and_nothing_else(tiny_data: Path, smoke_run: Path) -> None:
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    moved = {}
    for gamma in (0.0, 100.0):
        stage = dataclasses.replace(_SMOKE.stage1, gamma=gamma, warmup=0)
        training = Training(dataclasses.replace(_SMOKE, stage1=stage), split)
        training.begin_phase("stage1", smoke_run)
        before = {name: value.clone() for name, value in training.learner.autoencoder.state_dict().items()}
        report = training.advance()
        assert ("fake_score" in report) == (gamma > 0)
        after = training.learner.autoencoder.state_dict()
        assert all(torch.equal(value, after[name]) for name, value in before.items())
        moved[gamma] = training.learner.generator.trunk[0].weight.detach().clone()  # pyright: ignore
    assert not torch.equal(moved[0.0], moved[100.0])


def test_n_critic_and_the_real_pool_are_heard(tiny_data: Path, smoke_run: Path) -> None:
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    stage = dataclasses.replace(_SMOKE.stage1, n_critic=3, real_pool=2)
    training = Training(dataclasses.replace(_SMOKE, stage1=stage), split)
    training.begin_phase("stage1", smoke_run)
    batch, chance = training._draw(stage)
    assert batch.real is not None
    assert batch.real.shape == (3, stage.shapes, 128, 3)
    assert chance.mix.shape == (3, stage.codes, stage.shapes)
    steps = []
    training.learner.critic_optimiser.register_step_post_hook(lambda *_: steps.append(1))
    training.advance()
    assert len(steps) == 3


def test_scores_of_predictions_rise_when_the_critic_is_heard(tiny_data: Path, smoke_run: Path) -> None:
    """Against a critic that stands still, so that a rise is the generator's doing alone."""
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    rises = {}
    for gamma in (1e-6, 1e4):
        stage = dataclasses.replace(
            _SMOKE.stage1, steps=80, warmup=0, beta=0.0, gamma=gamma, critic_learning_rate=0.0
        )
        training = Training(dataclasses.replace(_SMOKE, stage1=stage), split)
        training.begin_phase("stage1", smoke_run)
        scores = torch.stack([training.advance()["fake_score"] for _ in range(80)])
        rises[gamma] = (scores[-5:].mean() - scores[:5].mean()).item()
    assert rises[1e4] > 0
    assert rises[1e4] > rises[1e-6] + 0.02  # unheeded, it falls by 0.03 to 0.04
