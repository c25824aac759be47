"""Which design choices prevent a network's predictions from ignoring the image? Short trainings, each with one undone.

Every variant trains stage 1 for some steps and is measured as a run is: how far predictions move with the image and
with the code, how much of the image encoder is silent, the validation error. The choices are undone here; `fit` has no
switch for them.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from models import Generator
from models.parts import IMAGE_GAIN, IMAGE_MEAN
from train.config import FitConfig
from train.data.batches import LoadedSplit
from train.device import SINGLE, World
from train.errors import UserError
from train.evaluation.runs import read_split
from train.evaluation.sensitivity import sensitivity
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.paper import without_critic
from train.experiments.study import Study, stage1_of
from train.files import kept
from train.methods import get_method, recipe
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines
from train.training.trainer import Trainer
from train.training.validation import validate

STEPS = 500
_MEASUREMENTS = 10
_IMAGES = 12
_COLUMNS = {
    "image": "image", "code": "code", "dead_share": "silent", "matched_share": "matched", "val_cd": "CD",
    "val_fps_cd": "FPS-CD",
}  # fmt: skip
_COLOURS = ("#1f6f8b", "#c8553d", "#8a6d9e", "#dd9f63", "#5a9367", "#6b7785")


class _Uncentred(nn.Module):
    """Gives an encoder the images as they are, in [0, 1] and mostly white."""

    def forward(self, centred: Tensor) -> Tensor:
        return centred / IMAGE_GAIN + IMAGE_MEAN


def _uncentre(generator: Generator) -> None:
    generator.trunk.insert(0, _Uncentred())


def _initialise_as_torch_does(generator: Generator) -> None:
    for module in generator.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            module.reset_parameters()


class Variant(NamedTuple):
    """Choices that are undone: values of the stage, and changes to the network with its fresh weights."""

    stage: Mapping[str, Any] = {}
    network: tuple[Callable[[Generator], None], ...] = ()


VARIANTS: dict[str, Variant] = {
    "as it is": Variant(),
    "images not centred": Variant(network=(_uncentre,)),
    "torch's initialisation": Variant(network=(_initialise_as_torch_does,)),
    "no warm-up": Variant({"warmup": 0}),
    "diversity from step one": Variant({"ramp": (0, 1)}),
    "all four undone": Variant({"warmup": 0, "ramp": (0, 1)}, (_uncentre, _initialise_as_torch_does)),
}

Curve = list[dict[str, float]]
"""The measurements of one training, in the order of its steps."""


def make(study: Study) -> Outcome:
    """Trains every variant on every data tree by itself, with every seed."""
    study.need_data()
    trainings = _trainings(study)
    missing = [each for each in trainings if not each.path.exists()]
    study.side_by_side(_curve, missing, title="trainings")
    curves: dict[str, dict[str, list[Curve]]] = {}
    for each in progress_bar(trainings, title="trainings", unit="training", progress=study.progress):
        curves.setdefault(each.root.name, {}).setdefault(each.variant, []).append(_curve(study, *each))
    result = {
        "profile": study.profile,
        "data": [str(root) for root in study.data],
        "seeds": study.seeds,
        "steps": study.steps or STEPS,
        "trees": {
            tree: {
                variant: {
                    name: [run[-1].get(name, math.nan) for run in runs] for name in (*_COLUMNS, "front")
                }
                for variant, runs in rows.items()
            }
            for tree, rows in curves.items()
        },
        "curves": curves,
    }
    return Outcome(result, markdown(result), {"": _figure(result)})


collapse = Experiment(
    make,
    own_trainings=lambda study: {each.path: stage1_of(each.config) for each in _trainings(study)},
)


class _Training(NamedTuple):
    """A training of a variant on a data tree."""

    path: Path
    """Of its measurements. The name is for people; they belong to the configuration and the tree, which are inside."""
    root: Path
    variant: str
    config: FitConfig
    """Its stage 2 is not trained."""


def _trainings(study: Study) -> list[_Training]:
    found, steps = [], study.steps or STEPS
    for root, name, seed in itertools.product(study.data, VARIANTS, range(study.seeds)):
        base = study.config(without_critic, seed=seed)
        stage1 = dataclasses.replace(base.stage1.lasting(steps), **VARIANTS[name].stage)
        path = study.out / "collapse" / f"{root.name}-{name.replace(' ', '-')}-{steps}-seed{seed}.json"
        found.append(_Training(path, root, name, dataclasses.replace(base, stage1=stage1)))
    return found


def _curve(study: Study, path: Path, root: Path, variant: str, config: FitConfig) -> Curve:
    """The measurements of one training, made now or kept."""
    size, shapes = get_method(config.system).image_size(config), config.validation_shapes
    read = functools.partial(read_split, config, root, image_size=size, progress=False)
    key = [variant, dataclasses.replace(study, data=(root,)).run_of(config).name]

    def train() -> Curve:
        data, val = (found.to(study.device) for found in (read("train"), read("val", limit=shapes)))
        return _train(config, VARIANTS[variant], data, val, World(study.device))

    return kept(path, key, train)


def _train(
    config: FitConfig, variant: Variant, train: LoadedSplit, val: LoadedSplit, world: World = SINGLE
) -> Curve:
    """Trains stage 1 step by step, from the variant's network."""
    trainer = Trainer(config, train, world)
    generator = trainer.state.network
    assert isinstance(generator, Generator)
    generator.cpu()  # random weights are drawn there
    for change in variant.network:
        change(generator)
    generator.to(trainer.device)
    trainer.enter_phase(trainer.phase_name)  # with an optimiser of these weights
    shapes = torch.arange(min(_IMAGES, len(val)))
    images = val.float_images(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))[:, 0]
    found: Curve = []
    every = max(1, trainer.phase.steps // _MEASUREMENTS)
    while not trainer.done:
        try:
            report = trainer.train_step()
            trainer.checks.settle()
        except UserError:  # the loss is no longer finite: that is a result too
            found.append({"step": trainer.step, "image": math.nan, "code": math.nan, "dead_share": math.nan})
            break
        if trainer.step % every == 0 or trainer.done:
            now = sensitivity(generator, images, seed=config.seed)
            found.append(
                {"step": trainer.step, "image": now.image, "code": now.code, "dead_share": now.dead_share}
            )
            found[-1] |= {name: report[name].item() for name in ("front", "matched_share")}
    found[-1] |= validate(generator, val, seed=config.seed)
    return found


def markdown(result: Mapping[str, Any]) -> str:
    """A table for every data tree."""
    head = (
        f"Stage 1 of the profile `{result['profile']}`, {result['steps']} steps, {result['seeds']} seeds; the values "
        "at the end of each training. Image, code: mean chamfer distance x100 between predictions for different "
        "images with one code, and for different codes with one image. Silent: share of the encoder's channels that "
        "are zero everywhere. Matched: share of the observed points that are assigned to a predicted point. CD, "
        "FPS-CD: on the validation split, all views, random codes."
    )
    tables = []
    for tree, rows in result["trees"].items():
        cells = [
            [name, *(" / ".join(f"{value:.2f}" for value in row[column]) for column in _COLUMNS)]
            for name, row in rows.items()
        ]
        tables.append(markdown_lines([tree, *_COLUMNS.values()], cells))
    return markdown_page(head, *tables)


def _figure(result: Mapping[str, Any]) -> Figure:
    """How far predictions move with the image, over the steps: a panel for each tree, a line for each training."""
    trees = result["curves"]
    figure = Figure(figsize=(6.5 * len(trees) + 2, 4.4), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(trees), squeeze=False)[0]
    stopped = recipe("ours", result["profile"]).min_image_sensitivity
    for axes, (tree, rows) in zip(panels, trees.items(), strict=True):
        for (name, runs), colour in zip(rows.items(), _COLOURS, strict=False):
            for number, run in enumerate(runs):
                steps, image = [r["step"] for r in run], [r["image"] for r in run]
                axes.plot(steps, image, ".-", color=colour, lw=1.1, label=None if number else name)
        axes.axhline(stopped, color=figures.MUTED, ls=":", label="`fit` ends a run below this")
        axes.set(
            title=f"{tree}: effect of the image", xlabel="step of stage 1",
            ylabel="distance of predictions for different images (CD x100)",
        )  # fmt: skip
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(-0.01, None)
        figures.plain(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=9, frameon=False)
    figure.suptitle(f"{result['seeds']} seeds of each, profile {result['profile']}", fontsize=11)
    return figure
