"""Photographs of real objects: what our system makes of one picture, and of all of them together. No truth is known.

What can be measured is how far the pictures' predictions disagree, before and after search and descent.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from train.config import FitConfig
from train.data.cutout import cut_out
from train.data.images import is_cut_out, read_rgba
from train.data.photos import Photo, find_photos
from train.data.render import orbit_camera
from train.errors import UserError
from train.evaluation.inference import reconstruct
from train.evaluation.per_shape import ShapeMetrics
from train.evaluation.reconstruct import MOST_IMAGES, read_pictures
from train.experiments.table import table_lines, trainings
from train.experiments.workbench import Workbench, as_it_is
from train.show import figures

OBJECTS = 8
CODES = 3
_SHOWN_PICTURES = 3
_STEPS = ("random", "searched", "agreed")
_USE = (
    "--pictures names a folder with a folder of pictures for each object, each alone on plain or white ground; to look "
    "at how they are cut out: python -m train data photos PHOTOS --out DIR"
)


class _Object(NamedTuple):
    """An object's name and its pictures (V, 3, H, W) in [0, 1] on white."""

    name: str
    pictures: Tensor


def configs(bench: Workbench) -> list[FitConfig]:
    """Every training that the figure needs."""
    return bench.configs(as_it_is)


def files(pictures: Path | None) -> list[Path]:
    """All files of a folder of photographs."""
    return sorted(path for path in pictures.rglob("*") if path.is_file()) if pictures else []


def photos(bench: Workbench, pictures: Path | None) -> dict[str, Any]:
    """Reconstructs the objects of a folder of photographs; writes photos.json, .md and .png.

    Args:
        bench: the networks.
        pictures: a folder as `data photos` takes or writes it: a folder of pictures for each object, or one object's.

    Returns:
        What photos.json holds: for each object the consistency loss x100 (mean pair chamfer distance of its pictures'
        predictions) with random codes, with the best of the searched groups, and after descent; None for an object with
        a single picture, where there is nothing to agree on.

    Raises:
        UserError: no folder, or not a single picture in it that can be used.
    """
    objects, left_out = read_objects(pictures)  # before hours of training
    bench.train_all(configs(bench))
    by_seed = [[_answers(bench, config, each) for each in objects] for config in configs(bench)]
    result = bench.about(configs(bench)[0]) | {
        "pictures": str(pictures),
        "objects": {
            each.name: {"pictures": len(each.pictures), **_losses([found[number] for found in by_seed])}
            for number, each in enumerate(objects)
        },
        "left_out": left_out,
    }
    bench.publish("photos", result, _markdown(result), _figure(result, objects, by_seed[0]))
    return result


def read_objects(folder: Path | None) -> tuple[list[_Object], dict[str, str]]:
    """The first objects of a folder of photographs, and what was left out, with the reason.

    A cut-out is taken as it is; another picture is cut out by its mask, if it has one, or from its plain background.

    Raises:
        UserError: no folder, or not a single picture that can be used.
    """
    if folder is None or not folder.is_dir():
        raise UserError(f"{'no pictures' if folder is None else f'{folder} is no folder'}; {_USE}")
    found, left_out = find_photos(folder)
    objects: list[_Object] = []
    for name, shots in found.items():
        if len(objects) == OBJECTS:
            left_out["further objects"] = f"{OBJECTS} are shown"
            break
        pictures = []
        for photo in shots[:MOST_IMAGES]:
            try:
                pictures.append(_read(photo))
            except UserError as error:
                left_out[photo.title] = str(error)
        if len(shots) > MOST_IMAGES:
            left_out[f"{name}, further pictures"] = f"{MOST_IMAGES} are used"
        if pictures:
            objects.append(_Object(name, torch.cat(pictures)))
    if not objects:
        reasons = [f"{title}: {reason}" for title, reason in left_out.items()][:1]
        raise UserError("; ".join([f"no picture in {folder} can be used", *reasons, _USE]))
    return objects, left_out


def _read(photo: Photo) -> Tensor:
    """(1, 3, H, W) in [0, 1]."""
    if photo.mask is None or is_cut_out(rgba := read_rgba(photo.path)):
        return read_pictures([photo.path])
    made = cut_out(rgba, given=read_rgba(photo.mask))
    return torch.from_numpy(made.picture).permute(2, 0, 1)[None] / 255


def _answers(bench: Workbench, config: FitConfig, found: _Object) -> ShapeMetrics:
    """What a training makes of an object.

    Returns:
        "one" (K, N, 3) from the first picture with K codes, "agreed" (V * N, 3) from all; and "losses" (3,), the
        consistency loss x100 after each of `_STEPS`, NaN for a single picture.
    """

    def take() -> ShapeMetrics:
        model = bench.network(config)
        codes = torch.randn(CODES, 1, model.code_dim, generator=torch.Generator().manual_seed(config.seed))
        with torch.no_grad():
            one = model(found.pictures[:1], codes)[:, 0].contiguous()
        agreed = reconstruct(model, found.pictures, seed=config.seed, settings=config.inference)
        losses = torch.full((len(_STEPS),), torch.nan, dtype=torch.float64)
        if len(found.pictures) > 1:
            random = reconstruct(model, found.pictures, seed=config.seed, groups=1, steps=0)
            kept = int(agreed.kept[0])
            losses = torch.stack(
                [random.history[0, 0], agreed.history[0, 0], agreed.history[kept, 0]]
            ).double()
        return {"one": one, "agreed": agreed.points[0].contiguous(), "losses": losses}

    digest = hashlib.sha256(found.pictures.numpy().tobytes()).hexdigest()
    settings = dataclasses.asdict(config.inference)
    return bench.kept(["photos", bench.run_of(config).name, settings, config.seed, CODES, digest], take)


def _losses(by_seed: Sequence[ShapeMetrics]) -> dict[str, Any]:
    values = torch.stack([each["losses"] for each in by_seed])
    if values.isnan().any():
        return dict.fromkeys(_STEPS)
    return {
        step: {"mean": column.mean().item(), "by_seed": column.tolist()}
        for step, column in zip(_STEPS, values.T, strict=True)
    }


def _markdown(result: Mapping[str, Any]) -> str:
    head = (
        f"{len(result['objects'])} objects of {result['pictures']}, profile `{result['profile']}`, "
        f"{trainings(result['seeds'])}. There is no truth to compare with; the figures say how far the predictions of "
        "an object's pictures disagree (consistency loss, mean chamfer distance of their pairs, x100): with random "
        "codes, with the most consistent of the searched groups of codes, and after the descent."
    )
    rows = [
        [name, str(each["pictures"]), *(f"{each[step]['mean']:.2f}" if each[step] else "" for step in _STEPS)]
        for name, each in result["objects"].items()
    ]
    lines = [head, "", *table_lines(["", "pictures", *_STEPS], rows), ""]
    if result["left_out"]:
        lines += ["Left out:", "", *(f"- {title}: {why}" for title, why in result["left_out"].items()), ""]
    return "\n".join(lines)


def _figure(result: Mapping[str, Any], objects: Sequence[_Object], answers: Sequence[ShapeMetrics]) -> Figure:
    """A row for each object. Nothing says where its cameras stood: clouds are seen from the network's own front."""
    most = max(len(found.pictures) for found in objects)
    shown = min(most, _SHOWN_PICTURES)
    figure, panels = figures.grid(rows=len(objects), columns=shown + CODES + 2)
    sides = orbit_camera(np.array([30.0, 210.0]), np.array([20.0, 20.0]), 128).to(dtype=torch.float32)
    for line, found, made in zip(panels, objects, answers, strict=True):
        for axes in line[:shown]:
            figures.bare(axes)
        for axes, picture in zip(line, found.pictures[:shown], strict=False):
            figures.draw_image(axes, picture)
        figures.caption(
            line[0], f"{found.name}, {len(found.pictures)} picture{'s' if len(found.pictures) > 1 else ''}"
        )
        everything = torch.cat([made["agreed"], made["one"].flatten(0, 1)])
        close = figures.narrowed(sides, everything)
        for axes, cloud in zip(line[shown:-2], made["one"], strict=True):
            figures.draw_cloud(axes, cloud, close[0])
        for axes, camera in zip(line[-2:], (close[0], close[1]), strict=True):
            figures.draw_cloud(axes, made["agreed"], camera)
        before, _, after = made["losses"].tolist()
        if len(found.pictures) > 1:
            figures.caption(line[-2], f"disagreement {before:.2f} to {after:.2f}")
    codes = [f"from the first, code {number + 1}" for number in range(CODES)]
    figures.titles(panels, ["pictures", *[""] * (shown - 1), *codes, "from all pictures", "from behind"])
    title = f"Photographs, profile {result['profile']}, seed 0"
    if most > 1:
        title += (
            "; how far the pictures' predictions disagree (chamfer x100), with random and with agreed codes"
        )
    figures.headline(figure, title)
    return figure
