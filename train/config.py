"""The configuration of a training run, in frozen dataclasses. The values of each profile: train/methods.

The resolved configuration is written beside every result. Units: distances in world units (an object is about
one unit across); `front="emd"` is the paper's sum over matched points, `front="chamfer"` the mean chamfer
distance x100.
"""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from train.errors import UserError

if TYPE_CHECKING:
    from typing_extensions import Self

Profile = Literal["full", "cpu", "smoke"]
Recipe = Literal["whole-shapes", "paper"]
Variant = Literal["standard", "highly-diverse"]
OutputHead = Literal["points", "latent"]
Precision = Literal["float32", "tf32", "bfloat16"]
Supervision = Literal["front", "projection", "lin", "soft"]
# The methods of `diffpoint.visible_points`, whose import would load torch; a test compares them.
Visibility = Literal["zbuffer", "horizon", "hpr"]

# The paper's alpha multiplies the released code's approximate EMD: a sum over 2048 points, about 1.3 times
# the exact optimum. Ours is exact and a mean, so that it means the same at any number of points.
EXACT_MEAN_EMD_FROM_PAPER = 2048 * 1.3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long a phase lasts, and the optimiser's step size in it."""

    steps: int
    """Optimiser steps."""
    learning_rate: float = 1e-4
    """The optimiser's step size after the warm-up."""
    final_learning_rate: float = 1e-4
    """Step size at the phase's end, reached along a cosine."""
    warmup: int = 0
    """Steps over which the learning rate rises from zero."""

    def learning_rate_at(self, step: int) -> float:
        """Linear warm-up, times a cosine from the first learning rate to the final one."""
        warm = min(1.0, (step + 1) / (self.warmup + 1))
        share_left = 0.5 + 0.5 * math.cos(math.pi * min(1.0, step / max(1, self.steps)))
        first, final = self.learning_rate, self.final_learning_rate
        return warm * (final + (first - final) * share_left)

    def lasting(self, steps: int) -> Self:
        """The same phase with another number of steps, its schedules stretched in proportion.

        A phase of 0 steps keeps 0.
        """
        if self.steps == 0:
            return self
        return dataclasses.replace(self, steps=steps, warmup=round(self.warmup * steps / self.steps))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PretrainConfig(Schedule):
    """The auto-encoder's training, before the stages, on the ground truth clouds alone."""

    shapes: int
    """Clouds in a batch; each step sees another random choice of their points."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageConfig(Schedule):
    """One stage of training. The stages differ in these values and in nothing else."""

    shapes: int
    """Different shapes in a batch."""
    views: int
    """Images per shape in a batch."""
    codes: int
    """Random codes per image (the paper's R)."""
    joined_views: bool
    """False: each image's cloud is compared with the depth map of that image. True: the clouds of a shape's views are
    concatenated first, and the whole is compared with the depth map of each view."""
    front: Literal["emd", "chamfer"]
    """Distance of the front constraint: earth mover's (sum over matched points) or chamfer (mean x100). A method that
    is trained on whole clouds uses it to compare them (mean x100)."""
    alpha: float
    """The paper's alpha: how much a change of code must change the shape (in the unit of the released
    code)."""
    beta: float
    """Weight of the diversity loss (the paper's beta)."""
    diversity_images: int
    """Images of the batch that take part in the diversity loss; fewer make a step cheaper."""
    diversity_stride: int
    """Every how many-th point of a cloud takes part in the diversity loss, in turns."""
    ramp: tuple[int, int]
    """Steps between which the diversity weight rises from 0 to beta: the network first learns to use the image."""
    select: Literal["cd", "fps_cd", "cd_1", "last"]
    """Validation figure by which the stage's best checkpoint is chosen: of all views joined, of these thinned to the
    size of one prediction, or of one view. "last": none; the weights at the end are kept."""
    supervision: Supervision = "front"
    """How predictions are compared with the depth maps of their images. "front" is the paper's front constraint. The
    others replace it, in its unit: "projection", the depth of rendered pixels; "lin", that and a mask term on occupancy
    logits of the points, as in Lin et al.; "soft", depth and mask of a soft rendering."""
    visibility: Visibility = "zbuffer"
    """How the front constraint selects the predicted points that a camera sees; see `diffpoint.visible_points`."""
    joined_diversity: bool = False
    """False: the diversity loss compares single-view clouds. True: the concatenated clouds of all views, as in
    the paper's "highly diverse" model."""
    gamma: float = 0.0
    """Weight of the critic term in the generator's loss (the paper's gamma); 0 trains without a critic."""
    n_critic: int = 1
    """Critic steps before each generator step."""
    critic_learning_rate: float = 1e-4
    """Adam's step size for the critic."""
    penalty: float = 10.0
    """Weight of the gradient penalty in the critic's loss."""
    real_pool: int = 0
    """Ground truth clouds of other shapes that the critic sees, for each shape of the batch, beside its own."""
    shape_weight: float = 0.0
    """Weight of the whole-shape loss: of the predictions of an image, the nearest to the whole target cloud is trained.
    0: the network learns from depth maps alone, as in the paper."""
    shape_distance: Literal["emd", "chamfer", "both"] = "emd"
    """Distance of the whole-shape loss (x100): the earth mover's compares how many points are where, chamfer does not;
    "both" is their sum."""
    shape_relaxation: float = 0.0
    """Share of the whole-shape loss that goes to all predictions instead of the nearest: a code whose prediction is far
    from every shape, and so never the nearest, is pulled towards them."""
    weight_decay: float = 0.0
    """Weight of |weights|^2 / 2 added to the loss; not used by the paper's own training."""
    optimiser: Literal["adam", "muon"] = "adam"
    """"adam", as in the paper; "muon": orthogonal steps for the matrices of the network, Adam for the rest."""

    @property
    def exact_alpha(self) -> float:
        """Alpha for the exact mean earth mover's distance."""
        return self.alpha * EXACT_MEAN_EMD_FROM_PAPER

    def lasting(self, steps: int) -> Self:
        """As `Schedule.lasting`; the ramp keeps its place in the stage."""
        if self.steps == 0:
            return self
        start, end = (round(at * steps / self.steps) for at in self.ramp)
        return dataclasses.replace(super().lasting(steps), ramp=(start, max(1, end)))

    def diversity_weight(self, step: int) -> float:
        """Beta at a step of this stage, ramp included."""
        start, end = self.ramp
        return self.beta * min(1.0, max(0.0, (step - start) / max(1, end - start)))


@dataclasses.dataclass(frozen=True)
class InferenceConfig:
    """Algorithm 1: search over groups of codes, then plain gradient descent on them."""

    groups: int = 5
    """Groups of codes drawn per shape; the most consistent one is kept."""
    medoid: bool = False
    """With a single image, which has no other to agree with: return the prediction with the smallest mean chamfer
    distance to those of the other groups, instead of the first group's."""
    steps: int = 30
    """Gradient steps on the kept codes."""
    step_size: float = 0.5
    """Length factor of a gradient step; the loss is each shape's own mean pair distance x100."""
    patience: int = 0
    """A shape's descent stops after so many steps in a row that did not lower its loss; 0: never early."""
    min_drop: float = 0.0
    """A loss counts as lower when it falls by more than this (x100)."""
    keep_best: bool = False
    """Return each shape's codes with the lowest loss on the way instead of the last ones."""
    prior: float = 0.0
    """Weight of |code|^2 / 2 added to the loss: pulls codes back to the N(0, 1) they were drawn from."""
    keep_norm: bool = False
    """Rescale every code to its first length after each step, so that it stays as likely under N(0, 1)."""
    scored: Literal["joined", "each"] = "joined"
    """How predictions from several views are compared with the ground truth: concatenated to one cloud, or each by
    itself, with the mean of the distances."""


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """A whole training run."""

    stage1: StageConfig
    """Single views."""
    stage2: StageConfig
    """Concatenated views, starting from stage 1's best checkpoint by validation."""
    pretrain: PretrainConfig = PretrainConfig(
        steps=1_500, shapes=32, learning_rate=5e-4, final_learning_rate=5e-5
    )
    """The auto-encoder, in whose latent space the critic works."""
    profile: Profile = "cpu"
    """Size of the network: full 192 x 256 images and 2048 points, cpu 96 x 128 and 512, smoke 48 x 64 and
    128."""
    recipe: Recipe = "paper"
    """How the network is trained. "whole-shapes": by the data's target clouds too, of which every code may choose one
    that fits the image. "paper": by the depth maps of the images alone."""
    variant: Variant = "standard"
    """The paper's main model, or its "highly diverse" one, whose predictions disagree more before search."""
    system: str = "ours"
    """The method: the paper's conditional generator, or one that it is compared with. See the list above."""
    output_head: OutputHead = "points"
    """What the generator predicts: points (the released network), or a latent of the auto-encoder, whose frozen
    decoder makes the points (the network of the paper's text)."""
    decoder_width: int = 1
    """Multiple of the profile's number of channels, where the network reads image and code together."""
    points_per_cell: int = 2
    """Points that the generator predicts in each cell of its feature grid; the paper's network has 2. The numbers of
    points above belong to 2, and grow in proportion."""
    group_norm: bool = False
    """Group normalisation in the generator; the paper's network has none."""
    augmentation: float = 0.0
    """Strength of random changes of light, colour, sharpness, noise, size and place of the training images; 0: none, 1:
    as much as photographs need."""
    framing: float = 0.0
    """Share of the training images whose object is framed as in a photograph, in the middle and about as large in every
    one; for networks that shall read photographs."""
    precision: Precision = "float32"
    """Number format of the generator during training, all layers but the last. bfloat16 is about twice as fast on GPUs
    and on processors that can multiply such numbers (avx512_bf16, amx; see lscpu), slower elsewhere, and on a CPU
    slower with group norms. tf32, on NVIDIA GPUs alone, rounds the factors of products to 10 bits of mantissa."""
    autoencoder: str | None = None
    """A run, or a .safetensors file of one, whose auto-encoder is used instead of training one."""
    start: str | None = None
    """A run, or a .safetensors file of one, whose weights the network starts from."""
    categories: tuple[str, ...] = ()
    """Categories to train on; none means all."""
    deterministic: bool = False
    """Train the counterpart without random codes (one code per image, no diversity loss)."""
    map_size: int = 28
    """Side of the depth maps that the front constraint compares; the renders' side must be a multiple."""
    gt_pool: Literal["decimate", "min"] = "decimate"
    """How the renders' depth maps shrink: exact sub-sampling, or the paper's minimum over blocks."""
    inference: InferenceConfig = InferenceConfig()
    """Search and descent at test time."""
    seed: int = 0
    """Seeds weights, batches and codes."""
    validate_every: int = 250
    """Steps between validations (model selection)."""
    validation_shapes: int = 32
    """Shapes of the validation split that a validation uses, at most."""
    checkpoint_every: int = 250
    """Steps between checkpoints; a killed run loses at most these."""
    collapse_check_every: int = 50
    """Steps between collapse checks: how much predictions change with the image and with the code."""
    min_image_sensitivity: float = 0.15
    """A run whose predictions of different images differ by less (chamfer x100) after `collapse_patience` steps
    is stopped: its image encoder has collapsed, even if the loss still falls."""
    collapse_patience: int = 600
    """Steps of stage 1 before the collapse check can stop a run."""
    keep_checkpoints: int = 2
    """How many of the newest checkpoints are kept for --resume, beside the best weights of every phase."""
    log_every: int = 10
    """Steps between lines in metrics.jsonl."""
    picture_every: int = 1_000
    """Steps between pictures of predictions in figures/; 0 draws none."""

    @property
    def stages(self) -> tuple[StageConfig, StageConfig]:
        """Both stages, as they are run: the deterministic counterpart has one code and no diversity loss."""
        if not self.deterministic:
            return self.stage1, self.stage2
        plain = [dataclasses.replace(s, codes=1, beta=0.0) for s in (self.stage1, self.stage2)]
        return plain[0], plain[1]

    @property
    def needs_autoencoder(self) -> bool:
        """Does the training use an auto-encoder: for a critic, or for the latent output head?"""
        return self.output_head == "latent" or any(stage.gamma > 0 for stage in self.stages)

    @property
    def occupancy_logits(self) -> bool:
        """Does a loss need occupancy logits of the points?"""
        return any(stage.supervision == "lin" for stage in self.stages)

    @property
    def phases(self) -> dict[str, PretrainConfig | StageConfig]:
        """The phases that are run, in order, by name. A phase of 0 steps is left out, and so is the auto-encoder's if
        none is needed or a trained one is given."""
        stage1, stage2 = self.stages
        found = {"autoencoder": self.pretrain, "stage1": stage1, "stage2": stage2}
        if not self.needs_autoencoder or self.autoencoder:
            del found["autoencoder"]
        return {name: phase for name, phase in found.items() if phase.steps}


def with_steps(config: FitConfig, steps: int) -> FitConfig:
    """The same recipe with another number of steps in every phase, ramps and warm-ups in proportion."""
    return dataclasses.replace(
        config,
        pretrain=config.pretrain.lasting(steps),
        stage1=config.stage1.lasting(steps),
        stage2=config.stage2.lasting(steps),
    )


def scaled(config: FitConfig, share: float) -> FitConfig:
    """The same recipe with every duration (steps, ramps, warm-up, patience) multiplied by `share`."""

    def times(steps: int) -> int:
        return max(1, round(steps * share))

    return dataclasses.replace(
        config,
        pretrain=config.pretrain.lasting(times(config.pretrain.steps)),
        stage1=config.stage1.lasting(times(config.stage1.steps)),
        stage2=config.stage2.lasting(times(config.stage2.steps)),
        collapse_patience=times(config.collapse_patience),
    )


# Names of fields in the files of earlier versions, and of their options on the command line.
_OLD_NAMES = {
    "ending": "output_head",
    "health_every": "collapse_check_every",
    "health_patience": "collapse_patience",
}


_PRECISIONS = {"32": "float32", "bf16": "bfloat16"}
"""Other words for values of `--precision`."""


def renamed_options(arguments: Sequence[str]) -> list[str]:
    """Command line arguments with the options of earlier versions, and short forms of values, replaced by today's."""
    options = {f"--{old.replace('_', '-')}": f"--{new.replace('_', '-')}" for old, new in _OLD_NAMES.items()}

    def rename(argument: str) -> str:
        name, equals, value = argument.partition("=")
        value = _PRECISIONS.get(value, value) if name == "--precision" else value
        return options.get(name, name) + equals + value

    renamed = [rename(argument) for argument in arguments]
    for at, argument in enumerate(renamed[:-1], 1):
        if argument == "--precision":
            renamed[at] = _PRECISIONS.get(renamed[at], renamed[at])
    return renamed


def to_json(config: FitConfig, *, data: str | Path | Sequence[str | Path]) -> str:
    """A run's config.json: the data it was trained on, and every field of its configuration."""
    trees = str(data) if isinstance(data, (str, Path)) else [str(root) for root in data]
    return json.dumps({"data": trees, **dataclasses.asdict(config)}, indent=2) + "\n"


def changed_settings(config: Any) -> dict[str, Any]:
    """A configuration as plain JSON values, without the fields that are at their defaults.

    It is what experiments know their trainings and measurements by: a new field, at its default, changes nothing. Who
    changes a default raises `TRAINING_VERSION`.

    Args:
        config: an instance of any dataclass; so may be its fields.
    """
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            nested = dataclasses.is_dataclass(value)
            changed[field.name] = changed_settings(value) if nested else _plain(value)
    return changed


def _plain(value: Any) -> Any:
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def fit_config_from_json(text: str, *, where: str) -> FitConfig:
    """Reads a run's config.json: the fields of FitConfig, and beside them "data".

    Args:
        text: the JSON.
        where: name of the file, for the error.
    """
    try:
        values = json.loads(text)
        values.pop("data", None)
        for old, new in _OLD_NAMES.items():
            if old in values:
                values[new] = values.pop(old)
        return _build(FitConfig, values)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(
            f"{where} is not the configuration of a run ({error}); was it written by `fit`?"
        ) from None


def _build(kind: type, values: Mapping[str, Any]) -> Any:
    types = typing.get_type_hints(kind)
    unknown = set(values) - set(types)
    if unknown:
        raise ValueError(f"unknown entries {sorted(unknown)}")

    def convert(name: str, value: Any) -> Any:
        if dataclasses.is_dataclass(types[name]):
            return _build(types[name], value)
        return tuple(value) if isinstance(value, list) else value

    return kind(**{name: convert(name, value) for name, value in values.items()})
