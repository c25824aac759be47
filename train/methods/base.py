"""What a method is: a network, the recipe of its training, a loss for each phase, and its oracle.

One file of this folder holds one method (or a family of them); `train/methods/__init__.py` lists them. The trainer
(train/training/trainer.py) takes the same step with all of them: draw a batch, ask the method for its loss, descend.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffpoint import check_pending
from models import Autoencoder, Critic, Predictor
from train.config import FitConfig, InferenceConfig, Recipe, StageConfig
from train.data.batches import Targets
from train.device import CPU, SINGLE, World
from train.errors import UserError
from train.methods.optimisers import adam
from train.timer import Timer


class Noise(NamedTuple):
    """The random numbers of one step.

    Attributes:
        codes: (R, B*V, code_dim) from N(0, 1): the latent codes z, which the paper calls r.
        mix: (n, R, B*V) from U(0, 1): for each of n critic steps, where between a predicted and a real latent the
            gradient penalty is measured. Empty without a critic.
    """

    codes: Tensor
    mix: Tensor


@dataclasses.dataclass
class TrainState:
    """Everything that a step changes: networks and their optimisers."""

    network: Predictor
    """The network that predicts shapes."""
    optimiser: torch.optim.Optimizer
    """Of the network that the current phase trains: `network`, or the auto-encoder."""
    autoencoder: Autoencoder | None = None
    """Frozen while `network` is trained; None for methods that have none."""
    critic: Critic | None = None
    critic_optimiser: torch.optim.Optimizer | None = None


_MOST_OPEN_CHECKS = 100


class Checks:
    """Conditions of a training, each a tensor. On a CPU they are checked at once; on a GPU, where a program would wait
    for its whole queue, some steps later: by `settle`, which must be called before anything is kept."""

    def __init__(self) -> None:
        self._open: list[tuple[Tensor, str]] = []

    def add(self, holds: Tensor, complaint: str) -> None:
        """A condition (a scalar, bool), and what is said if it does not hold."""
        self._open.append((holds, complaint))
        if holds.is_cpu or len(self._open) >= _MOST_OPEN_CHECKS:
            self.settle()

    def settle(self) -> None:
        """Waits until all conditions are known, and the layer's of the values that it was given.

        Raises:
            UserError: one does not hold; the first.
            ValueError: one of the layer's.
        """
        waiting, self._open = self._open, []
        if waiting:
            held = torch.stack([holds for holds, _ in waiting]).cpu().tolist()  # one copy from the GPU
            for (_, complaint), it_held in zip(waiting, held, strict=True):
                if not it_held:
                    raise UserError(complaint)
        check_pending()


@dataclasses.dataclass(frozen=True)
class Step:
    """Which step is taken, and the tools of the trainer that a loss may need."""

    phase: Any
    """The phase's settings: `StageConfig`, or `PretrainConfig` for the auto-encoder."""
    number: int
    """Number of this step within the phase, for schedules."""
    timer: Timer = dataclasses.field(default_factory=Timer)
    world: World = SINGLE
    checks: Checks = dataclasses.field(default_factory=Checks)


Loss = Callable[[TrainState, Any, Noise, Step], dict[str, Tensor]]
"""(state, batch, noise, step) -> scalars for the log, of which "loss" is minimised.

The batch is a `train.data.batches.Batch`; for an auto-encoder it is a tensor of clouds (B, N, 3).
"""


class Method(ABC):
    """The interface of a method.

    Attributes:
        name: the value of `fit --system` that selects it.
        losses: phase name -> loss. Phases are "autoencoder", "stage1" and "stage2", in this order.
        sizes: profile -> configuration of the network.
        network_class: class of the network; built from one of `sizes`.
        weights_key: name of that class in the header of weights files.
        recipes: names of its recipes; the first one is the default of `fit`.
        needs_whole_batch: why several processes cannot share a batch; empty if they can.
    """

    losses: ClassVar[Mapping[str, Loss]]
    sizes: ClassVar[Mapping[str, Any]]
    network_class: ClassVar[type[Predictor]]
    weights_key: ClassVar[str]
    recipes: ClassVar[tuple[Recipe, ...]] = ("paper",)
    needs_whole_batch: ClassVar[str] = ""

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def recipe(self, profile: str) -> FitConfig:
        """The configuration of a training with the profile "full", "cpu" or "smoke", as its paper has it."""

    @abstractmethod
    def build(self, config: FitConfig) -> Predictor:
        """The network of a configuration, with freshly drawn weights."""

    def needs_targets(self, phase: StageConfig) -> bool:
        """Do the losses of a phase need more than the views of the batch, that is, `Batch.targets`?"""
        del phase
        return True

    def oracle(self, network: Predictor, targets: Targets) -> Tensor | None:
        """What the network would predict if it had learnt its targets without error: the best of its representation.

        Returns:
            (B, N, 3) points in the world frame, or None where a method has no such upper limit.
        """
        return None

    def network_config(self, config: FitConfig) -> Any:
        """The configuration of the network that a training configuration builds."""
        return self.sizes[config.profile]

    def image_size(self, config: FitConfig) -> tuple[int, int]:
        """Height and width in pixels of the network's input."""
        size = self.network_config(config)
        return size.image_height, size.image_width

    def cloud_size(self, config: FitConfig) -> int:
        """Points of one prediction, or to how many predictions are thinned for comparisons."""
        return self.network_config(config).points

    def recipe_of(self, network: Predictor) -> FitConfig:
        """The recipe to assume for a network that comes without the configuration of its training."""
        return self.recipe(network.profile)

    def with_recipe(self, config: FitConfig, name: str) -> FitConfig:
        """The paper's recipe changed to another one of `recipes`."""
        return config

    def variant(self, config: FitConfig, name: str) -> FitConfig:
        """A recipe changed to one of the method's variants; `check` refuses the names that a method does not have."""
        return config

    def check(self, config: FitConfig) -> None:
        """Refuses settings that the method does not have.

        Raises:
            UserError: names the settings and says how to mend them.
        """
        name = f"--system {self.name}"
        if config.recipe not in self.recipes:
            raise UserError(f"{name} has no recipe {config.recipe}; leave --recipe at {self.recipes[0]}")
        if any((stage.supervision, stage.visibility) != ("front", "zbuffer") for stage in config.stages):
            raise UserError(
                f"{name} has a loss of its own; do not set --stage*.supervision or --stage*.visibility"
            )
        if config.needs_autoencoder or config.deterministic or config.variant != "standard":
            raise UserError(
                f"{name} does not support a critic, the latent output head, the deterministic counterpart or variants; "
                "do not set --output-head, --deterministic, --variant or --stage*.gamma"
            )
        if any(stage.optimiser != "adam" for stage in config.stages):
            raise UserError(f"{name} is trained by Adam; do not set --stage*.optimiser")
        other_network = config.decoder_width != 1 or config.points_per_cell != 2 or config.group_norm
        if other_network or any(stage.shape_weight for stage in config.stages):
            raise UserError(
                f"{name} has a network and a loss of its own; do not set --decoder-width, --points-per-cell, "
                "--group-norm or --stage*.shape-weight"
            )
        if config.precision != "float32":
            raise UserError(f"{name} computes in float32; do not set --precision")
        if missing := set(config.phases) - set(self.losses):
            raise UserError(f"{name} has no {', '.join(sorted(missing))}; leave its steps at 0")

    def new_state(self, config: FitConfig, device: torch.device = CPU) -> TrainState:
        """Networks with freshly drawn weights, the same on every device, and their optimisers."""
        network = self.build(config).to(device)
        return TrainState(network, adam(network))

    def optimiser(self, network: Predictor, phase: StageConfig) -> torch.optim.Optimizer:
        """A new optimiser of the network, for a phase."""
        return adam(network, weight_decay=phase.weight_decay)

    def begin_phase(self, state: TrainState, phase: str) -> None:
        """Prepares the networks for a phase, once the weights that it starts from are loaded."""
        return


def check_finite(values: Tensor, what: str, step: Step) -> None:
    """Ends a training whose numbers are no longer finite; see `Checks` for when.

    Raises:
        UserError: some value is NaN or infinite.
    """
    step.checks.add(
        values.detach().isfinite().all(),
        f"stopped at step {step.number} of the stage: {what} no longer finite; lower the learning rate",
    )


# What the recipes of all methods share. By the paper's 30 inference steps of 0.5 the views of a network as small as cpu
# agree at the expense of coverage: CD +0.29, FPS-CD -0.05 against random codes at 8 views; 10 steps of 0.1: +0.02 and
# -0.11, on other shapes +0.08 and -0.05 (docs/results.md). With two images the gradient of a pair is four times as long
# as with eight, and one shape in 264 got worse in the end: the codes with the lowest loss on the way are kept.
RUN_SETTINGS: dict[str, dict[str, Any]] = {
    "full": {
        "profile": "full", "map_size": 56, "validate_every": 2_000, "validation_shapes": 200, "checkpoint_every": 1_000,
        "collapse_check_every": 500, "collapse_patience": 8_000, "picture_every": 5_000,
    },
    "cpu": {
        "profile": "cpu", "inference": InferenceConfig(steps=10, step_size=0.1, keep_best=True),
    },
    "smoke": {
        "profile": "smoke", "map_size": 16, "inference": InferenceConfig(groups=2, steps=3), "validate_every": 10,
        "validation_shapes": 4, "checkpoint_every": 10, "collapse_check_every": 10, "collapse_patience": 10_000,
        "log_every": 1, "picture_every": 25,
    },
}  # fmt: skip


def plain_stage(**settings: Any) -> StageConfig:
    """A stage as most methods need it: one image of each shape, one code, no diversity loss, no critic.

    Args:
        settings: fields of `StageConfig` that differ; "rate" sets a constant learning rate, a pair of numbers the first
            and the last of a cosine.
    """
    rate = settings.pop("rate")
    first, final = rate if isinstance(rate, tuple) else (rate, rate)
    defaults: dict[str, Any] = {
        "views": 1, "codes": 1, "joined_views": False, "front": "chamfer", "alpha": 0.0, "beta": 0.0,
        "diversity_images": 1, "diversity_stride": 1, "ramp": (0, 1), "select": "cd",
        "learning_rate": first, "final_learning_rate": final,
    }  # fmt: skip
    return StageConfig(**(defaults | settings))


def plain_recipe(
    name: str, profile: str, stage1: StageConfig, stage2: StageConfig | None = None, **settings: Any
) -> FitConfig:
    """A recipe of `plain_stage`s; a method with one phase has a stage 2 of no steps.

    Predictions are made without search and descent on codes, and each view is evaluated by itself, if `settings` do not
    change it.
    """
    stage2 = stage2 or dataclasses.replace(stage1, steps=0)
    without_codes = {"inference": InferenceConfig(groups=1, steps=0, scored="each")}
    settings = {**RUN_SETTINGS[profile], "system": name, **without_codes, **settings}
    return FitConfig(stage1, stage2, **settings)
