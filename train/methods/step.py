"""One training step of each kind. Start reading at `training_step`: the paper's loss is its last sum."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor, nn

from diffpoint import chamfer_distance
from models import Autoencoder, Critic, Generator, critic_loss, generator_loss, gradient_penalty
from train.config import StageConfig
from train.data.batches import Batch
from train.distributed import ALONE, World
from train.errors import UserError
from train.methods.losses import arrange_scenes, spread_loss, supervise
from train.timer import Laps


@dataclasses.dataclass
class Learner:
    """The networks, and what descends on them."""

    generator: Generator
    """Or another method's network, which takes steps of its own (train/systems.py)."""
    critic: Critic
    autoencoder: Autoencoder
    """Frozen while the generator learns."""
    optimiser: torch.optim.Optimizer
    """Of the generator; of the auto-encoder while that one learns."""
    critic_optimiser: torch.optim.Optimizer


class Chance(NamedTuple):
    """The random numbers of a step: codes (R, B*V, code_dim) from N(0, 1), and for each of n critic steps
    the places (n, R, B*V) from U(0, 1) between predicted and real codes at which its slope is measured."""

    codes: Tensor
    mix: Tensor


def training_step(
    learner: Learner,
    batch: Batch,
    chance: Chance,
    stage: StageConfig,
    *,
    step: int,
    laps: Laps | None = None,
    world: World = ALONE,
) -> dict[str, Tensor]:
    """One step of either stage: predict, compare with what the cameras saw, push codes apart, ask the critic.

    Args:
        learner: networks and optimisers.
        batch: B shapes with V views each; in a group of processes, this one's share of them.
        chance: random numbers for them.
        stage: the stage's settings.
        step: number of this step within the stage, for the schedules.
        laps: books where the time goes.
        world: the group of processes that share the batch.

    Returns:
        Scalars without gradient, for the log.
    """
    laps = laps or Laps()
    set_rate(learner.optimiser, stage.learning_rate_at(step))

    predicted = learner.generator.predict(batch.images.flatten(0, 1), chance.codes)
    clouds = laps.on_the_way_back(predicted.points, "distances")  # (R, B*V, N, 3)
    _check_finite(clouds, step)
    laps.stop("network")

    # Every cloud before its own image's camera, or a shape's clouds joined and before each of its cameras.
    scene = arrange_scenes(
        clouds, batch.camera, batch.depth, joined_views=stage.joined_views, logits=predicted.logits
    )
    front = supervise(scene, stage, step=step)

    # Clouds of one image must differ as much as their codes do.
    beta, diversity = stage.diversity_weight(step), torch.zeros(())
    if beta > 0:
        diversity = spread_loss(chance.codes, clouds, stage, views=batch.depth.shape[1], step=step)
    laps.stop("distances")

    # The critic learns to tell predicted from real shapes, by their codes; then it says what it thinks.
    critic, judgement = torch.zeros(()), {}
    if stage.gamma > 0:
        judged = laps.on_the_way_back(clouds, "critic")
        fake = predicted.latents if predicted.latents is not None else _latents(learner, judged)
        judgement = critic_steps(learner, fake.detach(), batch, chance.mix, stage, world=world)
        critic = generator_loss(learner.critic(fake))
        laps.stop("critic")

    # The paper's sum.
    loss = front.loss + beta * diversity + stage.gamma * critic

    learner.optimiser.zero_grad(set_to_none=True)
    loss.backward()
    world.average_gradients(learner.generator)
    learner.optimiser.step()
    laps.stop("network")
    values = {"loss": loss, "front": front.loss, "diversity": diversity, **judgement, **front.shares}
    return {name: value.detach() for name, value in values.items()}


def critic_steps(
    learner: Learner, fake: Tensor, batch: Batch, mix: Tensor, stage: StageConfig, *, world: World = ALONE
) -> dict[str, Tensor]:
    """The critic's steps on one batch: lower E[D(fake)] - E[D(real)] + 10 E[(|grad D| - 1)^2].

    Args:
        learner: networks and optimisers.
        fake: (R, B*V, LATENT_DIM) codes of the predictions, without gradient.
        batch: its `real` clouds are the truth.
        mix: (n, R, B*V) in [0, 1].
        stage: the stage's settings.
        world: the group of processes that share the batch.
    """
    assert batch.real is not None
    real = _latents(learner, batch.real)
    # The penalty is measured between a prediction and its own shape; with a pool, other slots meet other shapes.
    slots = torch.arange(len(fake)) % len(real)
    partners = real[slots].repeat_interleave(batch.depth.shape[1], dim=1)
    set_rate(learner.critic_optimiser, stage.critic_learning_rate)
    scores: dict[str, Tensor] = {}
    for places in mix:
        real_scores, fake_scores = learner.critic(real), learner.critic(fake)
        penalty = gradient_penalty(learner.critic, partners, fake, mix=places)
        loss = critic_loss(real_scores, fake_scores) + stage.penalty * penalty
        learner.critic_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        world.average_gradients(learner.critic)
        learner.critic_optimiser.step()
        scores = {
            "critic_loss": loss.detach(),
            "penalty": penalty.detach(),
            "real_score": real_scores.detach().mean(),
            "fake_score": fake_scores.detach().mean(),
        }
    return scores


def autoencoder_step(
    autoencoder: Autoencoder,
    optimiser: torch.optim.Optimizer,
    clouds: Tensor,
    *,
    rate: float,
    laps: Laps | None = None,
) -> dict[str, Tensor]:
    """One step of the auto-encoder: clouds (B, P, 3) are written down and read again; mean chamfer distance."""
    laps = laps or Laps()
    set_rate(optimiser, rate)
    rebuilt = laps.on_the_way_back(autoencoder(clouds), "distances")
    laps.stop("network")
    distance = chamfer_distance(rebuilt, clouds, squared=False)
    loss = (distance.a_to_b + distance.b_to_a).mean()
    laps.stop("distances")
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    laps.stop("network")
    return {"loss": loss.detach(), "cd": 100 * loss.detach()}


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Sets the step size of all of an optimiser's parameters."""
    for group in optimiser.param_groups:
        group["lr"] = rate


def _latents(learner: Learner, clouds: Tensor) -> Tensor:
    """(R, B, N, 3) -> (R, B, LATENT_DIM), with gradient to the clouds."""
    return learner.autoencoder.encode_frozen(clouds.flatten(0, 1)).unflatten(0, clouds.shape[:2])


def trainable(network: nn.Module) -> list[nn.Parameter]:
    """The parameters that are not frozen."""
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def _check_finite(clouds: Tensor, step: int) -> None:
    if not clouds.detach().isfinite().all():
        raise UserError(
            f"stopped at step {step} of the stage: predictions are no longer finite; lower the learning rate"
        )
