"""Photographs of real objects: our method's reconstruction from one picture, and from all of them together.

There is no ground truth. Measured is how far the predictions for the pictures disagree, before and after search and
descent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from train.config import FitConfig, changed_settings
from train.data.photos import find_photos
from train.errors import UserError
from train.evaluation.inference import predict, reconstruct
from train.evaluation.reconstruct import MOST_IMAGES, read_pictures
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.statistics import spread, stacked, trainings
from train.experiments.store import Metrics
from train.experiments.study import Network, Study, unchanged
from train.show import figures
from train.show.tables import markdown_lines

OBJECTS = 8
CODES = 3
_STEPS = ("random", "searched", "agreed")
_USE = (
    "--pictures names a folder with a folder of pictures for each object, each alone on plain or white ground; to look "
    "at how they are cut out: python -m train data photos PHOTOS --out DIR"
)


class PhotographedObject(NamedTuple):
    """An object's name and its pictures (V, 3, H, W) in [0, 1] on white."""

    name: str
    pictures: Tensor


def make(study: Study) -> Outcome:
    """For each object of `study.pictures` the consistency loss x100 (mean chamfer distance of the pairs of its
    pictures' predictions) after each of `_STEPS`; None for an object with a single picture, which has no pairs.

    With `study.run`, of that run's network, for as many draws of codes as there are seeds.

    Raises:
        UserError: no picture that can be used, or no such run.
    """
    objects, left_out = read_objects(study.pictures)  # before hours of training
    study.train_all(_configs(study))
    networks = study.networks(unchanged)
    found = [[_reconstruct(study, network, each) for network in networks] for each in objects]
    losses = [stacked(by_seed)["losses"] for by_seed in found]  # of each object (S, 3)
    by_object: dict[str, dict[str, Any]] = {each.name: {"pictures": len(each.pictures)} for each in objects}
    for of_object, loss in zip(by_object.values(), losses, strict=True):
        for step, values in zip(_STEPS, loss.T, strict=True):
            of_object[step] = None if np.isnan(values).any() else spread(values)
    config = networks[0].config
    result = study.about(config) | {
        "profile": config.profile,  # of the run, if there is one
        "run": str(study.run) if study.run else None,
        "pictures": str(study.pictures),
        "objects": by_object,
        "left_out": left_out,
    }
    first = [by_seed[0] for by_seed in found]
    return Outcome(result, markdown(result), {"": _figure(result, objects, first)})


def _configs(study: Study) -> list[FitConfig]:
    return [] if study.run else study.configs(unchanged)


def _other_inputs(study: Study) -> list[Any]:
    pictures = sorted(filter(Path.is_file, study.pictures.rglob("*"))) if study.pictures else []
    return [*pictures, *([str(study.run)] if study.run else [])]


photos = Experiment(make, _configs, _other_inputs)


def read_objects(folder: Path | None) -> tuple[list[PhotographedObject], dict[str, str]]:
    """The first objects of a folder of photographs, and what was left out, with the reason.

    The folder is one that `data photos` takes or writes, with a folder of pictures for each object, or one object's. A
    cut-out is taken as it is; another picture is cut out by its mask, if it has one, or from its plain background.

    Raises:
        UserError: no folder, or not a single picture that can be used.
    """
    if folder is None or not folder.is_dir():
        raise UserError(f"{'no pictures' if folder is None else f'{folder} is no folder'}; {_USE}")
    found, left_out = find_photos(folder)
    objects: list[PhotographedObject] = []
    for name, shots in found.items():
        if len(objects) == OBJECTS:
            left_out["further objects"] = f"{OBJECTS} are shown"
            break
        pictures = []
        for photo in shots[:MOST_IMAGES]:
            try:
                pictures.append(read_pictures([photo.path]))
            except UserError as error:
                left_out[photo.title] = str(error)
        if len(shots) > MOST_IMAGES:
            left_out[f"{name}, further pictures"] = f"{MOST_IMAGES} are used"
        if pictures:
            objects.append(PhotographedObject(name, torch.cat(pictures)))
    if not objects:
        reasons = [f"{title}: {reason}" for title, reason in left_out.items()][:1]
        raise UserError("; ".join([f"no picture in {folder} can be used", *reasons, _USE]))
    return objects, left_out


def _reconstruct(study: Study, network: Network, found: PhotographedObject) -> Metrics:
    """A network's reconstructions of an object.

    Returns:
        "one" (K, N, 3) from the first picture with K codes, "agreed" (V * N, 3) from all; and "losses" (3,), the
        consistency loss x100 after each of `_STEPS`, NaN for a single picture.
    """
    settings, seed = network.config.inference, network.seed

    def measure() -> Metrics:
        model = network.load()
        one = predict(model, found.pictures[0], CODES, seed=seed)
        agreed = reconstruct(model, found.pictures, seed=seed, settings=settings)
        losses = torch.full((len(_STEPS),), torch.nan)
        if len(found.pictures) > 1:
            random = reconstruct(model, found.pictures, seed=seed, groups=1, steps=0)
            kept = int(agreed.kept[0])
            losses = torch.stack([random.history[0, 0], agreed.history[0, 0], agreed.history[kept, 0]])
        return {"one": one, "agreed": agreed.points[0].contiguous(), "losses": losses}

    pictures = hashlib.sha256(found.pictures.numpy().tobytes()).hexdigest()
    return study.kept(["photos", *network.key, changed_settings(settings), CODES, pictures], measure)


def markdown(result: Mapping[str, Any]) -> str:
    """A line for every object, and what was left out."""
    made = trainings(result["seeds"], run=result.get("run"))
    head = (
        f"{len(result['objects'])} objects of {result['pictures']}, profile `{result['profile']}`, "
        f"{made}. There is no ground truth; the values are the disagreement of the predictions "
        "for an object's pictures (consistency loss, mean chamfer distance of their pairs, x100): with random codes, "
        "with the most consistent of the searched groups of codes, and after the descent."
    )
    rows = [
        [name, str(each["pictures"]), *(f"{each[step]['mean']:.2f}" if each[step] else "" for step in _STEPS)]
        for name, each in result["objects"].items()
    ]
    blocks = [head, markdown_lines(["", "pictures", *_STEPS], rows)]
    if result["left_out"]:
        blocks += ["Left out:", [f"- {title}: {why}" for title, why in result["left_out"].items()]]
    return markdown_page(*blocks)


def _figure(
    result: Mapping[str, Any], objects: Sequence[PhotographedObject], found: Sequence[Metrics]
) -> Figure:
    rows = []
    for each, made in zip(objects, found, strict=True):
        count = len(each.pictures)
        before, _, after = made["losses"].tolist()
        rows.append(
            figures.Photographed(
                f"{each.name}, {count} picture{'s' if count > 1 else ''}",
                each.pictures,
                made["one"],
                made["agreed"],
                f"disagreement {before:.2f} to {after:.2f}" if count > 1 else "",
            )
        )
    figure = figures.photographs_figure(rows)
    title = f"Photographs, {result.get('run') or 'profile ' + result['profile']}, seed 0"
    words = "; disagreement of the pictures' predictions (chamfer x100) with random and with agreed codes"
    figures.headline(figure, title + words if any(row.remark for row in rows) else title)
    return figure
