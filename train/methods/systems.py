"""What `fit --system` chooses between: for each method its network, and its loss in each phase.

The conditional generator's own steps are in train/step.py. The others take one step that is the same for all of them
(`taught_step`), with a lesson of train/lessons.py.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from models import PROFILES as SIZES
from models import GeneratorConfig, Predictor, build_generator
from models.baselines import (
    LIN_PROFILES,
    PTN_PROFILES,
    R2N2_PROFILES,
    Baseline,
    BaselineConfig,
    RecurrentReconstruction,
    SilhouetteReconstruction,
    StructureGenerator,
    build_lin,
    build_psgn,
    build_ptn,
    build_r2n2,
)
from train.config import FitConfig, System
from train.distributed import ALONE, World
from train.errors import UserError
from train.methods import lessons
from train.methods import oracles as ideals
from train.methods.step import Learner, set_rate
from train.timer import Laps


@dataclasses.dataclass(frozen=True)
class Method:
    """A network, and how it is taught.

    Attributes:
        build: the network of a profile.
        sizes: profile -> the network's configuration.
        lessons: phase -> loss.
        kind: the network's own class, if no other method has it.
        ideal: its answer if it had learnt without an error, where that can be said.
    """

    build: Callable[[str], Predictor]
    sizes: Mapping[str, GeneratorConfig | BaselineConfig]
    lessons: Mapping[str, lessons.Lesson]
    kind: type[Baseline] | None = None
    ideal: ideals.Ideal | None = None


METHODS: dict[System, Method] = {
    "psgn": Method(build_psgn, SIZES, {"stage1": lessons.whole_clouds}, ideal=ideals.sampled_surface),
    "psgn-mon": Method(build_generator, SIZES, {"stage1": lessons.best_whole_cloud}),
    "front-mon": Method(build_generator, SIZES, {"stage1": lessons.best_front}),
    "lin": Method(
        build_lin,
        LIN_PROFILES,
        {"stage1": lessons.fixed_views, "stage2": lessons.projections},
        StructureGenerator,
        ideals.fused_maps,
    ),
    "r2n2": Method(
        build_r2n2,
        R2N2_PROFILES,
        {"stage1": lessons.filled_cells, "stage2": lessons.filled_cells},
        RecurrentReconstruction,
        ideals.true_cells,
    ),
    "ptn": Method(
        build_ptn, PTN_PROFILES, {"stage1": lessons.outlines}, SilhouetteReconstruction, ideals.hull
    ),
}


def size_of(config: FitConfig) -> GeneratorConfig:
    """The generator that a configuration of our own system trains."""
    return dataclasses.replace(
        SIZES[config.profile],
        deterministic=config.deterministic,
        output_head=config.ending,
        occupancy_logits=config.existence,
    )


def build_network(config: FitConfig) -> Predictor:
    """The network that a configuration trains, with freshly drawn weights.

    Raises:
        UserError: settings of our own system for another one.
    """
    _check(config)
    if config.system == "ours":
        return build_generator(config=size_of(config))
    return METHODS[config.system].build(config.profile)


def _check(config: FitConfig) -> None:
    if config.system == "ours":
        if config.existence and config.ending == "latent":
            raise UserError("supervision lin needs points that may be deleted; leave --ending at points")
        return
    if any((stage.supervision, stage.visibility) != ("front", "zbuffer") for stage in config.stages):
        raise UserError(
            f"--system {config.system} has a loss of its own; leave supervision and visibility alone"
        )
    if config.needs_autoencoder or config.deterministic or config.variant != "standard":
        raise UserError(
            f"--system {config.system} knows no critic, latent ending, deterministic counterpart or variant; "
            "leave --ending, --deterministic, --variant and the stages' gamma as they are"
        )
    if config.precision != "float32":
        raise UserError(f"--system {config.system} computes in float32; leave --precision as it is")
    if missing := set(config.phases) - set(METHODS[config.system].lessons):
        raise UserError(f"--system {config.system} has no {', '.join(sorted(missing))}; leave its steps at 0")


def image_size(config: FitConfig) -> tuple[int, int]:
    """Height and width at which a configuration's network looks at images.

    Raises:
        UserError: as `build_network`.
    """
    size = _network_size(config)
    return size.image_height, size.image_width


def cloud_size(config: FitConfig) -> int:
    """Points of one prediction of a configuration's network, or to how many its clouds are thinned.

    Raises:
        UserError: as `build_network`.
    """
    return _network_size(config).points


def _network_size(config: FitConfig) -> GeneratorConfig | BaselineConfig:
    _check(config)
    return size_of(config) if config.system == "ours" else METHODS[config.system].sizes[config.profile]


def system_of(network: Predictor) -> System:
    """The method to which a lone network belongs; one of the generator's shape counts as ours."""
    for name, method in METHODS.items():
        if method.kind is not None and isinstance(network, method.kind):
            return name
    return "ours"


def taught_step(
    learner: Learner,
    given: lessons.Given,
    lesson: lessons.Lesson,
    *,
    laps: Laps | None = None,
    world: World = ALONE,
) -> dict[str, Tensor]:
    """One step of another method: its loss, and a step down.

    Args:
        learner: its `generator` is the method's network.
        given: what the lesson is about.
        lesson: the loss.
        laps: books where the time goes.
        world: the group of processes that share the batch.

    Returns:
        Scalars without gradient, for the log; "loss" is what is lowered.
    """
    laps = laps or Laps()
    set_rate(learner.optimiser, given.stage.learning_rate_at(given.step))
    report = lesson(learner.generator, given)
    if not torch.isfinite(report["loss"]):
        raise UserError(
            f"stopped at step {given.step} of the stage: the loss is no longer finite; lower the learning rate"
        )
    laps.stop("lesson")
    learner.optimiser.zero_grad(set_to_none=True)
    report["loss"].backward()
    world.average_gradients(learner.generator)
    learner.optimiser.step()
    laps.stop("way back")
    return {name: value.detach() for name, value in report.items()}
