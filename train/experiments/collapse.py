"""Which design choices prevent a network's predictions from ignoring the image? Short trainings, each with one undone.

Every variant trains stage 1 for some steps and is measured as a run is: how far predictions move with the image and
with the code, how much of the image encoder is silent, the validation error. The choices are undone here; `fit` has no
switch for them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from models import Generator
from models.parts import IMAGE_GAIN, IMAGE_MEAN
from train.config import FitConfig
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.runs import read_split
from train.evaluation.sensitivity import sensitivity
from train.experiments.frame import Experiment, Outcome
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


@dataclasses.dataclass(frozen=True)
class Variant:
    """Choices that are undone: values of the stage, and changes to the network with its fresh weights."""

    stage: Mapping[str, Any] = dataclasses.field(default_factory=dict)
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
    curves: dict[str, dict[str, list[Curve]]] = {}
    missing = [each for each in _trainings(study) if not _kept_at(study, *each).exists()]
    study.side_by_side(_curve, missing, title="trainings")
    for root, name, seed in progress_bar(
        _trainings(study), title="trainings", unit="training", progress=study.progress
    ):
        curves.setdefault(root.name, {}).setdefault(name, []).append(_curve(study, root, name, seed))
    result = {
        "profile": study.profile,
        "data": [str(root) for root in study.data],
        "seeds": study.seeds,
        "steps": _steps(study),
        "trees": {
            tree: {name: _at_the_end(runs) for name, runs in rows.items()} for tree, rows in curves.items()
        },
        "curves": curves,
    }
    return Outcome(result, markdown(result), {"": _figure(result)})


def _own_trainings(study: Study) -> dict[Path, FitConfig]:
    return {_kept_at(study, *each): stage1_of(_config(study, *each[1:])) for each in _trainings(study)}


collapse = Experiment(make, own_trainings=_own_trainings)


def _trainings(study: Study) -> list[tuple[Path, str, int]]:
    """Data tree, variant and seed of every training."""
    return [(root, name, seed) for root in study.data for name in VARIANTS for seed in range(study.seeds)]


def _steps(study: Study) -> int:
    return study.steps or STEPS


def _config(study: Study, name: str, seed: int) -> FitConfig:
    """A variant's recipe; its stage 2 is not trained."""
    base = study.config(without_critic, seed=seed)
    stage = dataclasses.replace(base.stage1.lasting(_steps(study)), **VARIANTS[name].stage)
    return dataclasses.replace(base, stage1=stage)


def _kept_at(study: Study, root: Path, name: str, seed: int) -> Path:
    """The file's name is for people; its measurements belong to the configuration and the tree, which are inside."""
    return study.out / "collapse" / f"{root.name}-{name.replace(' ', '-')}-{_steps(study)}-seed{seed}.json"


def _curve(study: Study, root: Path, name: str, seed: int) -> Curve:
    """The measurements of one training, made now or kept."""
    config = _config(study, name, seed)
    key = [name, dataclasses.replace(study, data=(root,)).run_of(config).name]
    size = get_method(config.system).image_size(config)
    read = functools.partial(read_split, config, root, image_size=size, progress=False)
    return kept(
        _kept_at(study, root, name, seed),
        key,
        lambda: _train(config, VARIANTS[name], read("train"), read("val", limit=config.validation_shapes)),
    )


def _train(config: FitConfig, variant: Variant, train: LoadedSplit, val: LoadedSplit) -> Curve:
    """Trains stage 1 step by step, from the variant's network."""
    trainer = Trainer(config, train)
    generator = trainer.state.network
    assert isinstance(generator, Generator)
    for change in variant.network:
        change(generator)
    shapes = torch.arange(min(_IMAGES, len(val)))
    images = val.float_images(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))[:, 0]
    found: Curve = []
    every = max(1, trainer.phase.steps // _MEASUREMENTS)
    while not trainer.done:
        try:
            report = trainer.train_step()
        except UserError:  # the loss is no longer finite: that is a result too
            found.append({"step": trainer.step, "image": math.nan, "code": math.nan, "dead_share": math.nan})
            break
        if trainer.step % every == 0 or trainer.done:
            now = sensitivity(generator, images, seed=config.seed)
            moved = {
                "step": trainer.step,
                "image": now.image,
                "code": now.code,
                "dead_share": now.dead_share,
            }
            found.append(moved | {name: report[name].item() for name in ("front", "matched_share")})
    found[-1] |= validate(generator, val, seed=config.seed)
    return found


def _at_the_end(runs: list[Curve]) -> dict[str, Any]:
    """The last measurements of each seed's training."""
    return {name: [run[-1].get(name, math.nan) for run in runs] for name in (*_COLUMNS, "front")}


def markdown(result: Mapping[str, Any]) -> str:
    """A table for every data tree."""
    lines = [
        f"Stage 1 of the profile `{result['profile']}`, {result['steps']} steps, {result['seeds']} seeds; the values "
        "at the end of each training. Image, code: mean chamfer distance x100 between predictions for different "
        "images with one code, and for different codes with one image. Silent: share of the encoder's channels that "
        "are zero everywhere. Matched: share of the observed points that are assigned to a predicted point. CD, "
        "FPS-CD: on the validation split, all views, random codes."
    ]
    for tree, rows in result["trees"].items():
        cells = [
            [name, *(" / ".join(f"{value:.2f}" for value in row[column]) for column in _COLUMNS)]
            for name, row in rows.items()
        ]
        lines += ["", *markdown_lines([tree, *_COLUMNS.values()], cells)]
    return "\n".join([*lines, ""])


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
