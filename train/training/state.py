"""What changes while a run goes on: weights, optimisers, random states, and whether the network still
listens."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from models import Critic, Generator, build_autoencoder
from train.config import FitConfig, PretrainConfig, StageConfig
from train.data.batches import Batch, LoadedSplit, Sampler
from train.distributed import ALONE, World
from train.errors import UserError
from train.evaluation.runs import best_weights, load_autoencoder, load_predictor
from train.evaluation.sensitivity import sensitivity
from train.methods.lessons import Given
from train.methods.step import Chance, Learner, autoencoder_step, trainable, training_step
from train.methods.systems import METHODS, build_network, taught_step
from train.methods.weights import save_weights
from train.timer import Laps
from train.training.checkpoint import load_networks, load_state
from train.training.validation import validate, validate_autoencoder

_DEAF_CHECKS = 3


class Training:
    """Everything that changes while a run goes on, and can be kept and put back.

    Args:
        config: the recipe.
        train: the training split.
        world: the group of processes that share each batch. All draw the same random numbers and take their part.
    """

    def __init__(self, config: FitConfig, train: LoadedSplit, world: World = ALONE) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.total_steps = 0
        self.laps = Laps()
        self._train, self._world = train, world
        self._sampler = Sampler(len(train), train.views, seed=config.seed)
        self._random = torch.Generator().manual_seed(config.seed)
        generator = cast(Generator, build_network(config))  # for the step of our own system; see `Learner`
        generator.computes_in = getattr(torch, config.precision)
        autoencoder = build_autoencoder(config.profile)
        critic = Critic()
        self.learner = Learner(generator, critic, autoencoder, _adam(autoencoder), _adam(critic))
        if config.start:
            self._take_weights(Path(config.start))
        self._enter(next(iter(config.phases)))

    @property
    def phase(self) -> PretrainConfig | StageConfig:
        """Settings of the current phase."""
        return self.config.phases[self.phase_name]

    @property
    def done(self) -> bool:
        """Has the current phase made its steps?"""
        return self.step >= self.phase.steps

    def begin_phase(self, name: str, run: Path) -> None:
        """A fresh optimiser, from the best weights of the phases before; the critic goes on as it is."""
        self._world.wait()  # until whoever writes has written them
        self._enter(name)
        if name == "stage1" and self.config.needs_autoencoder:
            self._take_autoencoder(run)
            if self.learner.generator.ends_in_latent:
                self.learner.generator.adopt_decoder(self.learner.autoencoder)
        if name == "stage2" and "stage1" in self.config.phases:
            self._take_weights(best_weights(run, 1))

    def _take_weights(self, run_or_file: Path) -> None:
        found = load_predictor(run_or_file)
        try:
            self.learner.generator.load_state_dict(found.state_dict())
        except RuntimeError:
            raise UserError(
                f"{run_or_file} holds the weights of another network than the one to be trained (--system, --profile, "
                "--ending, --deterministic); start from one of the same kind"
            ) from None

    def _take_autoencoder(self, run: Path) -> None:
        found = load_autoencoder(best_weights(run, "autoencoder"))
        wanted = self.learner.generator.points
        if self.learner.generator.ends_in_latent and found.config.points != wanted:
            raise UserError(
                f"the auto-encoder makes {found.config.points} points, the generator that is to end in it {wanted}; "
                "train one of this profile, or leave --autoencoder out"
            )
        self.learner.autoencoder = found

    def _enter(self, name: str) -> None:
        self.phase_name, self.step = name, 0
        self.best, self._deaf_checks = math.inf, 0
        learner, pretraining = self.learner, isinstance(self.phase, PretrainConfig)
        if pretraining:
            learner.autoencoder.train().requires_grad_(True)
        else:
            learner.autoencoder.freeze()
        if isinstance(self.phase, StageConfig):
            learner.optimiser = _adam(learner.generator.train(), weight_decay=self.phase.weight_decay)
        else:
            learner.optimiser = _adam(learner.autoencoder)

    def advance(self) -> dict[str, Tensor]:
        """Draws a batch and makes one step of the current phase; returns scalars for the log."""
        phase, laps = self.phase, self.laps
        if isinstance(phase, PretrainConfig):
            clouds = self._draw_clouds(phase.shapes)
            laps.stop("data")
            rate = phase.learning_rate_at(self.step)
            report = autoencoder_step(
                self.learner.autoencoder, self.learner.optimiser, clouds, rate=rate, laps=laps
            )
        else:
            batch, chance = self._draw(phase)
            laps.stop("data")
            if batch.targets is None:
                report = training_step(
                    self.learner, batch, chance, phase, step=self.step, laps=laps, world=self._world
                )
            else:
                given = Given(batch, batch.targets, chance.codes, phase, self.step)
                lesson = METHODS[self.config.system].lessons[self.phase_name]
                report = taught_step(self.learner, given, lesson, laps=laps, world=self._world)
        laps.end_step()
        self.step += 1
        self.total_steps += 1
        return report

    def schedule(self) -> dict[str, float]:
        """What the phase's schedules said to the step that was just made."""
        phase, step = self.phase, self.step - 1
        weight = {"diversity_weight": phase.diversity_weight(step)} if isinstance(phase, StageConfig) else {}
        return {"learning_rate": phase.learning_rate_at(step), **weight}

    def _draw_clouds(self, shapes: int) -> Tensor:
        return self._clouds(self._sampler.draw(shapes, 1)[0])

    def _clouds(self, shapes: Tensor) -> Tensor:
        """(B,) shape numbers -> (B, N, 3) of their ground truth, N as the predictions have if there are as many."""
        known = self._train.points.shape[1]
        wanted = min(known, self.learner.autoencoder.config.points)
        return self._train.clouds(shapes, self._sampler.draw_points(len(shapes), wanted, of=known))

    def _draw(self, stage: StageConfig) -> tuple[Batch, Chance]:
        """This process's share of a batch, and the random numbers that belong to it."""
        share = self._world.share
        shapes, views = self._sampler.draw(stage.shapes, stage.views)
        batch = self._train.batch(share(shapes), share(views))
        images = stage.shapes * stage.views
        codes = torch.randn(stage.codes, images, self.learner.generator.code_dim, generator=self._random)
        mix = torch.empty(0)
        if stage.gamma > 0:
            mix = torch.rand(stage.n_critic, stage.codes, images, generator=self._random)
            real = [self._clouds(shapes), *(self._draw_clouds(stage.shapes) for _ in range(stage.real_pool))]
            batch = batch._replace(real=share(torch.stack(real), 1))
        if self.config.system != "ours":
            batch = batch._replace(targets=self._train.targets(share(shapes)))
        return batch, Chance(share(codes, 1), share(mix, -1))

    def networks(self) -> dict[str, nn.Module]:
        """What a checkpoint of the current phase holds, and what it takes from there."""
        if isinstance(self.phase, PretrainConfig):
            return {"autoencoder": self.learner.autoencoder}
        return {"weights": self.learner.generator, "critic": self.learner.critic}

    def state(self) -> dict[str, Any]:
        """Everything but the weights that decides how training continues."""
        return {
            "phase": self.phase_name,
            "step": self.step,
            "total_steps": self.total_steps,
            "best": self.best,
            "deaf_checks": self._deaf_checks,
            "optimiser": self.learner.optimiser.state_dict(),
            "critic_optimiser": self.learner.critic_optimiser.state_dict(),
            "sampler": self._sampler.state(),
            "random": self._random.get_state(),
            "torch": torch.get_rng_state(),
            "fingerprint": self._train.fingerprint,
        }

    def resume(self, run: Path, checkpoint: Path) -> None:
        """Puts back what `networks` and `state` gave when a run's checkpoint was made."""
        state = load_state(checkpoint)
        if state["fingerprint"] != self._train.fingerprint:
            raise UserError(
                f"{checkpoint} was trained on other data (their shapes or points differ); resume with those"
            )
        self._enter(state["phase"])
        if not isinstance(self.phase, PretrainConfig) and self.config.needs_autoencoder:
            self._take_autoencoder(run)
        load_networks(checkpoint, self.networks())
        self.step, self.total_steps = state["step"], state["total_steps"]
        self.best, self._deaf_checks = state["best"], state["deaf_checks"]
        self.learner.optimiser.load_state_dict(state["optimiser"])
        self.learner.critic_optimiser.load_state_dict(state["critic_optimiser"])
        self._sampler.restore(state["sampler"])
        self._random.set_state(state["random"])
        torch.set_rng_state(state["torch"])

    def check_health(self, images: Tensor) -> dict[str, float]:
        """Measures what image and code do; ends a run whose image has stopped to matter."""
        if isinstance(self.phase, PretrainConfig):
            return {}
        found = sensitivity(self.learner.generator, images, seed=self.config.seed)
        warm = self.phase_name != "stage1" or self.step >= self.config.health_patience
        deaf = warm and found.image < self.config.min_image_sensitivity
        self._deaf_checks = self._deaf_checks + 1 if deaf else 0
        if self._deaf_checks >= _DEAF_CHECKS:
            raise UserError(
                f"stopped at step {self.total_steps}: predictions of different images differ by only "
                f"{found.image:.3f} (chamfer x100), so the network no longer looks at its image "
                f"({found.dead_share:.0%} of its trunk is silent); lower the learning rate, lengthen "
                "--stage1.ramp or --stage1.warmup, or try another --seed"
            )
        return {
            "image_sensitivity": found.image,
            "code_sensitivity": found.code,
            "dead_share": found.dead_share,
        }

    def validate_and_keep_best(self, val: LoadedSplit, run: Path) -> dict[str, float]:
        """Validates, and writes the weights if they are the phase's best so far, or the last are asked for."""
        phase, seed = self.phase, self.config.seed
        if isinstance(phase, PretrainConfig):
            network, select = self.learner.autoencoder, "autoencoder_cd"
            figures = validate_autoencoder(network, val, seed=seed)
        else:
            network, select = self.learner.generator, phase.select
            figures = validate(network, val, seed=seed, world=self._world)
        if select == "last" or figures[f"val_{select}"] < self.best:
            self.best = figures.get(f"val_{select}", self.best)
            if self._world.writes:
                save_weights(network, best_weights(run, self.phase_name))
        return figures


def _adam(network: nn.Module, *, weight_decay: float = 0.0) -> torch.optim.Adam:
    """Its step size is set at every step."""
    return torch.optim.Adam(trainable(network), fused=True, weight_decay=weight_decay)
