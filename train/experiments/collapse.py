"""Which choices keep the network listening to its image? Short trainings, each with one choice undone.

Every variant trains stage 1 for some steps and is measured as a run is: how far predictions move with the image and
with the code, how much of the image trunk is silent, the validation error. What is undone is undone here: the product
has no switch for it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from tqdm import tqdm

from models import Generator
from models.parts import IMAGE_GAIN, IMAGE_MEAN
from train.config import PROFILES, FitConfig, StageConfig
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.runs import read_split
from train.evaluation.sensitivity import sensitivity
from train.experiments.paper import without_critic
from train.experiments.side_by_side import run_side_by_side
from train.experiments.workbench import Workbench, stage1_of
from train.files import kept, write_text
from train.methods.systems import image_size
from train.show import figures
from train.training.state import Training
from train.training.validation import validate

STEPS = 500
_MEASUREMENTS = 10
_IMAGES = 12


class _Uncentred(nn.Module):
    """Gives a trunk the images as they are, in [0, 1] and mostly white."""

    def forward(self, centred: Tensor) -> Tensor:
        return centred / IMAGE_GAIN + IMAGE_MEAN


def _uncentre(generator: Generator) -> None:
    generator.trunk.insert(0, _Uncentred())


def _initialise_as_torch_does(generator: Generator) -> None:
    for module in generator.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            module.reset_parameters()


def _no_warmup(stage: StageConfig) -> StageConfig:
    return dataclasses.replace(stage, warmup=0)


def _no_ramp(stage: StageConfig) -> StageConfig:
    return dataclasses.replace(stage, ramp=(0, 1))


@dataclasses.dataclass(frozen=True)
class Variant:
    """One choice undone, or several: in the schedule, and in the network that was just drawn."""

    stage: tuple[Callable[[StageConfig], StageConfig], ...] = ()
    network: tuple[Callable[[Generator], None], ...] = ()


VARIANTS: dict[str, Variant] = {
    "as it is": Variant(),
    "images not centred": Variant(network=(_uncentre,)),
    "torch's initialisation": Variant(network=(_initialise_as_torch_does,)),
    "no warm-up": Variant(stage=(_no_warmup,)),
    "diversity from step one": Variant(stage=(_no_ramp,)),
    "all four undone": Variant((_no_warmup, _no_ramp), (_uncentre, _initialise_as_torch_does)),
}


def own_trainings(bench: Workbench) -> dict[Path, FitConfig]:
    """Every training, by the file that its measurements leave; no other experiment has a use for them."""
    return {
        _kept_at(bench, root, name, seed): stage1_of(_config(bench, name, seed))
        for root, name, seed in _trainings(bench)
    }


def health(bench: Workbench) -> dict[str, Any]:
    """Trains every variant on every data tree with every seed; writes health.json, .md and .png.

    Each tree is trained on alone. A training that is there already is not repeated.

    Returns:
        What health.json holds.
    """
    bench.need_data()
    curves: dict[str, dict[str, list[list[dict[str, float]]]]] = {}
    trainings = _trainings(bench)
    missing = [training for training in trainings if not _kept_at(bench, *training).exists()]
    if bench.processes > 1 and len(missing) > 1:
        calls = [(bench.in_a_process(), *training) for training in missing]
        run_side_by_side(_curve, calls, processes=bench.processes, title="trainings", progress=bench.progress)
    for training in tqdm(trainings, desc="trainings", unit="training", disable=not bench.progress):
        root, name, _ = training
        curves.setdefault(root.name, {}).setdefault(name, []).append(_curve(bench, *training))
    result = {
        "profile": bench.profile, "data": [str(root) for root in bench.data], "seeds": bench.seeds,
        "steps": _steps(bench),
        "trees": {tree: {name: _summary(runs) for name, runs in rows.items()} for tree, rows in curves.items()},
        "curves": curves,
    }  # fmt: skip
    write_text(bench.out / "health.json", json.dumps(result, indent=2) + "\n")
    write_text(bench.out / "health.md", _markdown(result))
    figures.save(_figure(result), bench.out / "health.png")
    return result


def _trainings(bench: Workbench) -> list[tuple[Path, str, int]]:
    """Data tree, variant and seed of every training."""
    return [(root, name, seed) for root in bench.data for name in VARIANTS for seed in range(bench.seeds)]


def _steps(bench: Workbench) -> int:
    return bench.steps or STEPS


def _config(bench: Workbench, name: str, seed: int) -> FitConfig:
    """A variant's recipe; stage 2 is in it and is not trained."""
    base = bench.config(without_critic, seed=seed)
    stage = base.stage1.lasting(_steps(bench))
    for change in VARIANTS[name].stage:
        stage = change(stage)
    return dataclasses.replace(base, stage1=stage)


def _curve(bench: Workbench, root: Path, name: str, seed: int) -> list[dict[str, float]]:
    """The measurements of one training, taken now or read."""
    config = _config(bench, name, seed)

    # The name is for people; what the measurements belong to is the configuration and the tree.
    key = [name, dataclasses.replace(bench, data=(root,)).run_of(config).name]
    path = _kept_at(bench, root, name, seed)
    return kept(path, key, lambda: _train(config, VARIANTS[name], *_read(root, config)))


def _kept_at(bench: Workbench, root: Path, name: str, seed: int) -> Path:
    return bench.out / "health" / f"{root.name}-{name.replace(' ', '-')}-{_steps(bench)}-seed{seed}.json"


def _read(root: Path, config: FitConfig) -> tuple[LoadedSplit, LoadedSplit]:
    size = image_size(config)
    val = read_split(config, root, "val", image_size=size, limit=config.validation_shapes, progress=False)
    return read_split(config, root, "train", image_size=size, progress=False), val


def _train(
    config: FitConfig, variant: Variant, train: LoadedSplit, val: LoadedSplit
) -> list[dict[str, float]]:
    training = Training(config, train)
    generator = training.learner.generator
    for change in variant.network:
        change(generator)
    shapes = torch.arange(min(_IMAGES, len(val)))
    images = val.float_images(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))[:, 0]
    found: list[dict[str, float]] = []
    every = max(1, training.phase.steps // _MEASUREMENTS)
    while not training.done:
        try:
            report = training.advance()
        except UserError:  # no longer finite: that is an answer too
            found.append({"step": training.step, "image": math.nan, "code": math.nan, "dead_share": math.nan})
            break
        if training.step % every == 0 or training.done:
            now = sensitivity(generator, images, seed=config.seed)
            record = {
                "step": training.step,
                "image": now.image,
                "code": now.code,
                "dead_share": now.dead_share,
            }
            found.append(record | {name: report[name].item() for name in ("front", "matched_share")})
    found[-1] |= validate(generator, val, seed=config.seed)
    return found


def _summary(runs: list[list[dict[str, float]]]) -> dict[str, Any]:
    """What each seed's training ended with."""
    last = [run[-1] for run in runs]
    names = ("image", "code", "dead_share", "matched_share", "front", "val_cd", "val_fps_cd")
    return {name: [run.get(name, math.nan) for run in last] for name in names}


def _markdown(result: Mapping[str, Any]) -> str:
    head = (
        f"Stage 1 of the profile `{result['profile']}`, {result['steps']} steps, {result['seeds']} seeds; what each "
        "training ended with. Image, code: mean chamfer distance x100 between predictions of different images at one "
        "code, and of different codes at one image. CD, FPS-CD: on the validation split, all views, random codes."
    )
    lines = [head]
    columns = {
        "image": "image", "code": "code", "dead_share": "silent", "matched_share": "matched", "val_cd": "CD",
        "val_fps_cd": "FPS-CD",
    }  # fmt: skip
    for tree, rows in result["trees"].items():
        lines += [
            "",
            f"| {tree} | " + " | ".join(columns.values()) + " |",
            "| --- |" + " ---: |" * len(columns),
        ]
        for name, row in rows.items():
            cells = [" / ".join(f"{value:.2f}" for value in row[column]) for column in columns]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _figure(result: Mapping[str, Any]) -> Figure:
    """How far predictions move with the image, over the steps: a panel for each tree, a line for each training."""
    trees = result["curves"]
    figure = Figure(figsize=(6.5 * len(trees) + 2, 4.4), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(trees), squeeze=False)[0]
    colours = ("#1f6f8b", "#c8553d", "#8a6d9e", "#dd9f63", "#5a9367", "#6b7785")
    for axes, (tree, rows) in zip(panels, trees.items(), strict=True):
        for (name, runs), colour in zip(rows.items(), colours, strict=False):
            for number, run in enumerate(runs):
                label = name if number == 0 else None
                steps, image = [r["step"] for r in run], [r["image"] for r in run]
                axes.plot(steps, image, ".-", color=colour, lw=1.1, label=label)
        axes.axhline(
            PROFILES[result["profile"]].min_image_sensitivity,
            color=figures.MUTED,
            ls=":",
            label="a run is stopped below",
        )
        axes.set(
            title=f"{tree}: does the image matter?", xlabel="step of stage 1",
            ylabel="predictions of different images differ by (CD x100)",
        )  # fmt: skip
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(-0.01, None)
        figures.plain(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=9, frameon=False)
    figure.suptitle(f"{result['seeds']} seeds of each, profile {result['profile']}", fontsize=11)
    return figure
