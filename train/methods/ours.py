"""The paper's system: a conditional generator, trained in two stages after an auto-encoder of shapes.

Start reading at `generator_loss`: its last sum is the paper's loss.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffpoint import chamfer_distance
from models import PROFILES as SIZES
from models import (
    Critic,
    Generator,
    GeneratorConfig,
    Predictor,
    build_autoencoder,
    build_generator,
    critic_loss,
    gradient_penalty,
)
from models import (
    generator_loss as critic_term,
)
from train.config import EXACT_MEAN_EMD_FROM_PAPER, FitConfig, InferenceConfig, PretrainConfig, StageConfig
from train.data.batches import Batch
from train.device import CPU
from train.errors import UserError
from train.methods.base import (
    RUN_SETTINGS,
    Method,
    Noise,
    Step,
    TrainState,
    check_finite,
)
from train.methods.losses import (
    diversity_term,
    for_each_image,
    nearest_prediction_loss,
    targets_of,
    view_loss,
)
from train.methods.optimisers import Muon, adam, set_learning_rate


def generator_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """The loss of either stage: predict, compare with the depth maps, push codes apart, ask the critic.

    Args:
        state: the generator and, where the stage has a critic, the critic with its optimiser and the auto-encoder.
        batch: B shapes with V views each; in a group of processes, this one's share of them.
        noise: R codes for each image, and the places of the gradient penalty.
        step: the stage's settings, and the step's number for their schedules.

    Source: CVPR 2019 paper, section 3.
    """
    generator, stage, timer = state.network, step.phase, step.timer
    assert isinstance(generator, Generator)

    predicted = generator.predict(batch.images.flatten(0, 1), noise.codes)
    clouds = timer.mark_in_backward(predicted.points, "distances")  # (R, B*V, N, 3)
    check_finite(clouds, "predictions are", step)
    timer.mark("network")

    # The front constraint: every cloud against its own image's depth map, or a shape's clouds joined, against all.
    front = view_loss(clouds, batch, stage, step=step.number, logits=predicted.logits)

    # Clouds of one image must differ as much as their codes do.
    beta, diversity = stage.diversity_weight(step.number), clouds.new_zeros(())
    if beta > 0:
        views = batch.depth.shape[1]
        diversity = diversity_term(noise.codes, clouds, stage, views=views, step=step.number)

    # Of the predictions of an image, the nearest to the whole shape: each code may choose another shape.
    shape, shape_statistics = clouds.new_zeros(()), {}
    if stage.shape_weight > 0:
        targets = for_each_image(targets_of(batch).points, batch)
        shape, shape_statistics = nearest_prediction_loss(clouds, targets, stage, step=step.number)
    timer.mark("distances")

    # The critic learns to tell the latents of predictions from those of real shapes; then it judges the predictions.
    critic, critic_statistics = clouds.new_zeros(()), {}
    if stage.gamma > 0:
        assert state.critic is not None
        judged = timer.mark_in_backward(clouds, "critic")
        fake = predicted.latents if predicted.latents is not None else _latents(state, judged)
        critic_statistics = critic_steps(state, fake.detach(), batch, noise.mix, step)
        critic = critic_term(state.critic(fake))
        timer.mark("critic")

    # The paper's sum, and the whole shape's term.
    loss = front.loss + beta * diversity + stage.gamma * critic + stage.shape_weight * shape
    return {
        "loss": loss, "front": front.loss, "diversity": diversity,
        **critic_statistics, **front.statistics, **shape_statistics,
    }  # fmt: skip


def critic_steps(state: TrainState, fake: Tensor, batch: Batch, mix: Tensor, step: Step) -> dict[str, Tensor]:
    """The critic's own steps on one batch: minimise E[D(fake)] - E[D(real)] + penalty * E[(|grad D| - 1)^2].

    Args:
        state: the critic, its optimiser and the frozen auto-encoder.
        fake: (R, B*V, LATENT_DIM) latents of the predictions, without gradient.
        batch: its `real` clouds are the real shapes.
        mix: (n, R, B*V) in [0, 1].
        step: the stage's settings.

    Returns:
        Scalars for the log.
    """
    critic, optimiser, stage = state.critic, state.critic_optimiser, step.phase
    assert batch.real is not None and critic is not None and optimiser is not None
    real = _latents(state, batch.real)
    # The penalty is measured between a prediction and its own shape; with a pool, other code slots meet other shapes.
    slots = torch.arange(len(fake), device=fake.device) % len(real)
    partners = real[slots].repeat_interleave(batch.depth.shape[1], dim=1)
    set_learning_rate(optimiser, stage.critic_learning_rate)
    statistics: dict[str, Tensor] = {}
    for places in mix:
        real_scores, fake_scores = critic(real), critic(fake)
        penalty = gradient_penalty(critic, partners, fake, mix=places)
        loss = critic_loss(real_scores, fake_scores) + stage.penalty * penalty
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        step.world.average_gradients(critic)
        optimiser.step()
        statistics = {
            "critic_loss": loss.detach(),
            "penalty": penalty.detach(),
            "real_score": real_scores.detach().mean(),
            "fake_score": fake_scores.detach().mean(),
        }
    return statistics


def autoencoder_loss(state: TrainState, clouds: Tensor, noise: Noise, step: Step) -> dict[str, Tensor]:
    """The auto-encoder's loss: mean chamfer distance between clouds (B, P, 3) and their reconstructions."""
    assert state.autoencoder is not None
    rebuilt = step.timer.mark_in_backward(state.autoencoder(clouds), "distances")
    step.timer.mark("network")
    distance = chamfer_distance(rebuilt, clouds, squared=False)
    loss = distance.total.mean()
    step.timer.mark("distances")
    return {"loss": loss, "cd": 100 * loss}


def _latents(state: TrainState, clouds: Tensor) -> Tensor:
    """(R, B, N, 3) -> (R, B, LATENT_DIM), with gradient to the clouds."""
    assert state.autoencoder is not None
    return state.autoencoder.encode_frozen(clouds.flatten(0, 1)).unflatten(0, clouds.shape[:2])


class Ours(Method):
    """The conditional generator, its deterministic counterpart, and its variants."""

    losses: ClassVar = {"autoencoder": autoencoder_loss, "stage1": generator_loss, "stage2": generator_loss}
    sizes = SIZES
    network_class = Generator
    weights_key = "generator"
    recipes = ("whole-shapes", "paper")

    def recipe(self, profile: str) -> FitConfig:
        return PROFILES[profile]

    def with_recipe(self, config: FitConfig, name: str) -> FitConfig:
        return whole_shapes(config) if name == "whole-shapes" else config

    def needs_targets(self, phase: StageConfig) -> bool:
        return phase.shape_weight > 0

    def variant(self, config: FitConfig, name: str) -> FitConfig:
        return highly_diverse(config) if name == "highly-diverse" else config

    def network_config(self, config: FitConfig) -> GeneratorConfig:
        size = SIZES[config.profile]
        return dataclasses.replace(
            size,
            decoder_width=size.decoder_width * config.decoder_width,
            deterministic=config.deterministic,
            output_head=config.output_head,
            occupancy_logits=config.occupancy_logits,
            points_per_cell=config.points_per_cell,
            group_norm=config.group_norm,
        )

    def build(self, config: FitConfig) -> Generator:
        generator = build_generator(config=self.network_config(config))
        generator.computes_in = torch.bfloat16 if config.precision == "bfloat16" else torch.float32
        generator.tf32 = config.precision == "tf32"
        return generator

    def check(self, config: FitConfig) -> None:
        for name in ("decoder_width", "points_per_cell"):
            if getattr(config, name) < 1:
                raise UserError(f"--{name.replace('_', '-')} must be at least 1; got {getattr(config, name)}")
        if config.occupancy_logits and config.output_head == "latent":
            raise UserError("supervision lin needs points that may be deleted; leave --output-head at points")
        for name, stage in zip(("stage1", "stage2"), config.stages, strict=True):
            if stage.beta > 0 and stage.codes < 2:
                raise UserError(
                    f"the diversity loss compares two or more codes of an image; got --{name}.codes {stage.codes}: "
                    f"raise it, or set --{name}.beta 0 or --deterministic"
                )

    def new_state(self, config: FitConfig, device: torch.device = CPU) -> TrainState:
        generator = self.build(config).to(device)
        autoencoder, critic = build_autoencoder(config.profile).to(device), Critic().to(device)
        return TrainState(generator, adam(generator), autoencoder, critic, adam(critic))

    def optimiser(self, network: Predictor, phase: StageConfig) -> torch.optim.Optimizer:
        if phase.optimiser == "muon":
            assert isinstance(network, Generator)
            return Muon(network, output_layers=network.output_layers, weight_decay=phase.weight_decay)
        return super().optimiser(network, phase)

    def begin_phase(self, state: TrainState, phase: str) -> None:
        """Before stage 1, gives a generator with the latent output head the decoder of the auto-encoder."""
        generator = state.network
        assert isinstance(generator, Generator)
        if phase == "stage1" and generator.shape_decoder is not None:
            assert state.autoencoder is not None
            generator.adopt_decoder(state.autoencoder)

    def recipe_of(self, network: Predictor) -> FitConfig:
        return dataclasses.replace(self.recipe(network.profile), deterministic=not network.takes_codes)


# --- recipes

_FULL_STAGE1 = StageConfig(
    steps=40_000, shapes=2, views=8, codes=5, joined_views=False, front="emd", alpha=0.2, beta=10.0,
    diversity_images=16, diversity_stride=1, ramp=(1_000, 4_000), select="cd",
    warmup=500, gamma=0.1,
)  # fmt: skip
_FULL_STAGE2 = StageConfig(
    steps=100_000, shapes=2, views=8, codes=5, joined_views=True, front="chamfer", alpha=0.1, beta=1.0,
    diversity_images=16, diversity_stride=1, ramp=(0, 1), select="fps_cd",
    warmup=500, gamma=0.1,
)  # fmt: skip
# 500 epochs of the 5400 training chairs.
_FULL_PRETRAIN = PretrainConfig(steps=54_000, shapes=50, learning_rate=5e-4, final_learning_rate=5e-4)
# Without a critic, and so without an auto-encoder: on the embedded chairs and displays (400 + 200 steps, mean of two
# seeds) gamma 0 / 0.1 end at CD 6.5 / 6.7 and FPS-CD 7.4 / 7.6, gamma 1 (one seed) at 6.6 and 7.7, and a step with the
# critic takes 0.19 s of a core instead of 0.13 s. Longer trainings may judge otherwise: --stage1.gamma, --stage2.gamma.
_CPU_STAGE1 = StageConfig(
    steps=4_000, shapes=16, views=1, codes=3, joined_views=False, front="emd", alpha=0.2, beta=10.0,
    diversity_images=8, diversity_stride=2, ramp=(400, 1_200), select="cd",
    learning_rate=5e-4, final_learning_rate=5e-5, warmup=200,
)  # fmt: skip
# The paper's alpha, 0.1, asks 512 points for more change than these shapes have to hide: the front begins to vary too.
# On the embedded shapes (one seed, 800 steps from the same stage 1) 0.2 lowers CD at 8 views from 4.6 to 4.3 and
# FPS-CD from 5.5 to 5.2.
_CPU_STAGE2 = StageConfig(
    steps=2_000, shapes=4, views=4, codes=3, joined_views=True, front="chamfer", alpha=0.2, beta=1.0,
    diversity_images=8, diversity_stride=2, ramp=(0, 400), select="fps_cd",
    learning_rate=4e-4, final_learning_rate=1e-5, warmup=200,
)  # fmt: skip
_CPU_PRETRAIN = PretrainConfig(steps=1_500, shapes=32, learning_rate=5e-4, final_learning_rate=5e-5)
_SMOKE_STAGE1 = dataclasses.replace(
    _CPU_STAGE1, steps=30, shapes=3, views=1, codes=2, diversity_images=2, ramp=(5, 20), warmup=5, gamma=0.1
)
_SMOKE_STAGE2 = dataclasses.replace(
    _CPU_STAGE2, steps=20, shapes=2, views=2, codes=2, diversity_images=2, warmup=5, gamma=0.1
)
_SMOKE_PRETRAIN = dataclasses.replace(_CPU_PRETRAIN, steps=20, shapes=6)

PROFILES = {
    "full": FitConfig(_FULL_STAGE1, _FULL_STAGE2, _FULL_PRETRAIN, **RUN_SETTINGS["full"]),
    "cpu": FitConfig(_CPU_STAGE1, _CPU_STAGE2, _CPU_PRETRAIN, **RUN_SETTINGS["cpu"]),
    "smoke": FitConfig(_SMOKE_STAGE1, _SMOKE_STAGE2, _SMOKE_PRETRAIN, **RUN_SETTINGS["smoke"]),
}


# Codes that choose between shapes are worth a search. On 48 validation shapes (one seed), CD with 2 and 8 views and
# FPS-CD with 8: random codes 4.57, 3.89, 6.22; 5 groups and 10 steps of 0.1 4.25, 3.61, 5.13; 20 groups and 10 steps of
# 0.3 4.27, 3.53, 4.89.
_INFERENCE_WHOLE_SHAPES = InferenceConfig(groups=20, medoid=True, steps=20, step_size=0.3, keep_best=True)


def whole_shapes(config: FitConfig) -> FitConfig:
    """The paper's recipe changed to learn from whole shapes, where the data hold them.

    Every code's prediction must still satisfy the front constraint; of an image's predictions the nearest to the shape
    is trained on the whole of it (conditional implicit maximum likelihood estimation). No prediction is pushed to be
    different for its own sake: the diversity loss and the critic are off.

    Sources: Li et al., "Multimodal image synthesis with conditional implicit maximum likelihood estimation" (IJCV
    2020); relaxed as by Rupprecht et al., "Learning in an uncertain world" (ICCV 2017).
    """
    changes: dict[str, Any] = {
        "codes": 5, "front": "chamfer", "beta": 0.0, "gamma": 0.0, "shape_weight": 2.0, "shape_relaxation": 0.1,
        "optimiser": "muon",
    }  # fmt: skip
    return dataclasses.replace(
        config,
        recipe="whole-shapes",
        points_per_cell=4,
        group_norm=True,
        augmentation=1.0,
        inference=_INFERENCE_WHOLE_SHAPES,
        stage1=dataclasses.replace(config.stage1, **changes),
        stage2=dataclasses.replace(config.stage2, **changes),
    )


def highly_diverse(config: FitConfig) -> FitConfig:
    """A recipe changed to train the model of the paper's table on consistency.

    In stage 2 the diversity loss compares the joined clouds of all views, and stage 2 is two fifths as long. Its last
    weights are kept: validation uses random codes, with which this model is not meant to be used, and would select the
    least diverse weights.

    The paper has weight 0.5 and alpha 15, which can only be meant for the mean distance: for the sum any two clouds
    would satisfy it. That asks for a whole object of change, without end. In the profile "cpu" (seed 0)
    either the front constraint wins (weights 0.5 and 2: codes move a prediction by 2.7, in the main model by 3.6; CD
    x100) or points fly out of all images (6 and 20: CD above 50). All profiles but "full" therefore ask for a fifth of
    an object, with weight 1.
    """
    stage2 = config.stage2.lasting(max(1, round(0.4 * config.stage2.steps)))
    alpha, beta = (15.0, 0.5) if config.profile == "full" else (80.0, 1.0)
    stage2 = dataclasses.replace(
        stage2, joined_diversity=True, alpha=alpha / EXACT_MEAN_EMD_FROM_PAPER, beta=beta, select="last"
    )
    return dataclasses.replace(config, variant="highly-diverse", stage2=stage2)
