"""Pictures of data: contact sheets of a tree's categories, and the procedural families with their hidden variants."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from diffpoint import PinholeCamera, project
from train.data import tree_files
from train.data.categories import category_of, synset_of
from train.data.families import FAMILIES
from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.solids import Solid, surface_of
from train.data.tree import Shape, ShapeError, ShapeTree, read_shape
from train.errors import UserError
from train.files import replacing
from train.processes import progress_bar
from train.show.figures import TRUE, close_up, from_behind

_CELL = 144
_VIEWS = 4
_COLUMNS = _VIEWS + 3
_TITLE = 18  # pixels of the line above a strip
_RULE = 16  # pixels between strips that stand side by side
_TALLEST = 16  # strips in a column before there are two columns
_FINER = 3  # clouds are drawn this many times larger, then reduced
_RADIUS = 1.2  # pixels
_INK = (90, 100, 112)
_FAMILY_CELL = 130
_FAMILY_RULE = 3  # pixels between one variant's views and the next's
# (azimuth, elevation) in degrees of the views of a variant, and of a shape of a family without variants.
_VARIANT_VIEWS = ((55, 20), (140, 20), (205, 25))
_SHAPE_VIEWS = ((0, 12), (40, 25), (90, 5), (150, 25), (215, -12))


def show(
    data: str | Path,
    out: str | Path | None = None,
    *,
    categories: Sequence[str] | None = None,
    shapes: int = 8,
) -> dict[str, Path]:
    """Writes a contact sheet for each category: views, depth, the cloud from that view and from behind.

    Every strip is titled with its shape's name and split.

    Args:
        data: root of a data tree.
        out: folder of the sheets; `contact/` in the data tree if not given.
        categories: names or synsets; None for all.
        shapes: strips of a sheet, evenly spread over the category's shapes.

    Returns:
        The sheets by category.

    Raises:
        UserError: no data, an unknown category, or nothing that can be read.
    """
    if shapes < 1:
        raise UserError(f"shapes must be at least 1; got {shapes}")
    out = Path(data) / "contact" if out is None else Path(out)
    ids: dict[str, list[str]] = defaultdict(list)
    split_of: dict[str, str] = {}
    for split in tree_files.SPLITS:
        for shape in ShapeTree(data, split).ids:
            ids[shape.split("/")[0]].append(shape)
            split_of[shape] = split
    wanted = sorted(ids) if categories is None else [synset_of(name) for name in categories]
    absent = [category_of(synset) for synset in wanted if synset not in ids]
    if absent:
        known = ", ".join(category_of(synset) for synset in sorted(ids)) or "none"
        raise UserError(f"{data} has no shape of {', '.join(absent)}; it has: {known}")
    sheets = {}
    for synset in wanted:
        found = sorted(ids[synset])
        strips = []
        chosen = np.linspace(0, len(found) - 1, min(shapes, len(found))).astype(int)
        for number in progress_bar(chosen, title=f"drawing {category_of(synset)}", unit="shape", leave=False):
            try:
                strips.append(strip_of(read_shape(data, found[number]), split=split_of[found[number]]))
            except ShapeError:
                continue  # `data check` names what is broken
        if not strips:
            raise UserError(
                f"{data}: no shape of {category_of(synset)} can be read; see: python -m train data check"
            )
        path = out / f"{category_of(synset)}.png"
        with replacing(path) as temporary:
            Image.fromarray(_arranged(strips)).save(temporary, format="PNG", optimize=True)
        sheets[category_of(synset)] = path
    return sheets


def strip_of(shape: Shape, *, split: str) -> np.ndarray:
    """One shape as (title + cell, columns, 3) uint8: views; depth and cloud of the first; the cloud from behind."""
    channels = torch.cat((shape.images, shape.depth[:, None]), dim=1)
    channels, cameras = close_up(channels, shape.camera, shape.points)
    chosen = np.linspace(0, len(channels), _VIEWS, endpoint=False).astype(int).tolist()
    cells = [
        _resized((channels[view, :3].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8))
        for view in chosen
    ]
    cells.append(_resized(_depth_picture(channels[chosen[0], 3].numpy())))
    camera = cameras[chosen[0]]
    cells += [_cloud_picture(shape.points, each) for each in (camera, from_behind(camera))]
    title = f"{shape.id.split('/')[-1]}  ({split}, {len(shape.images)} views, {len(shape.points)} points)"
    return np.concatenate((_title(title), np.concatenate(cells, axis=1)))


def _title(text: str) -> np.ndarray:
    line = Image.new("RGB", (_COLUMNS * _CELL, _TITLE), "white")
    draw = ImageDraw.Draw(line)
    draw.line((0, 0, line.width, 0), fill=(222, 226, 230))
    draw.text((4, 3), text, fill=_INK, font=ImageFont.load_default())
    return np.asarray(line)


def _arranged(strips: Sequence[np.ndarray]) -> np.ndarray:
    """Strips below each other, in as many columns as keep the sheet about as wide as high."""
    columns = math.ceil(math.sqrt(len(strips) / _TALLEST))
    height = -(-len(strips) // columns)
    blank = np.full_like(strips[0], 255)
    padded = [*strips, *[blank] * (columns * height - len(strips))]
    rule = np.full((height * len(blank), _RULE, 3), 255, np.uint8)
    parts = [
        part for k in range(columns) for part in (rule, np.concatenate(padded[k * height : (k + 1) * height]))
    ]
    return np.concatenate(parts[1:], axis=1)


def _resized(picture: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).resize((_CELL, _CELL), Image.Resampling.LANCZOS))


def _depth_picture(depth: np.ndarray) -> np.ndarray:
    """Near is bright; empty pixels are white."""
    seen = np.isfinite(depth)
    picture = np.full((*depth.shape, 3), 255, np.uint8)
    if seen.any():
        near, far = depth[seen].min(), depth[seen].max()
        tone = 1 - 0.9 * (depth[seen] - near) / max(far - near, 1e-6)
        picture[seen] = (colormaps["magma"](tone)[:, :3] * 255).astype(np.uint8)
    return picture


def _cloud_picture(points: Tensor, camera: PinholeCamera) -> np.ndarray:
    """Points (N, 3) as discs, far ones first; near ones are dark."""
    projected = project(points[None], camera)
    pixels = projected.pixels[0, 0].numpy() * (_FINER * _CELL / camera.width)
    depth = projected.depth[0, 0].numpy()
    picture = Image.new("RGB", (_FINER * _CELL, _FINER * _CELL), "white")
    draw = ImageDraw.Draw(picture)
    tones = (np.asarray(TRUE((depth - depth.min()) / max(np.ptp(depth), 1e-6)))[:, :3] * 255).astype(int)
    radius = _FINER * _RADIUS
    for point in np.argsort(-depth):
        (x, y), colour = pixels[point], tuple(tones[point].tolist())
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
    return _resized(np.asarray(picture))


def draw_families(
    out: str | Path, categories: Sequence[str], *, objects: int = 4, seed: int = 0
) -> list[Path]:
    """Writes one picture for each family, `<category>.png`, with a row for each object.

    A family with designed ambiguity shows the front once, and then each variant from the side, from behind at an angle
    and from behind. The others show two objects in a row, from five sides each.
    """
    paths = []
    for category in categories:
        rows = [_row(category, seed + number) for number in range(objects)]
        path = Path(out) / f"{category}.png"
        picture = Image.fromarray(np.concatenate(rows)).quantize(192, dither=Image.Dither.NONE)
        with replacing(path) as temporary:
            picture.save(temporary, format="PNG", optimize=True)
        paths.append(path)
    return paths


def _row(category: str, seed: int) -> np.ndarray:
    cone = FAMILIES[category].cone
    if cone is None:
        shapes = [variants_of(category, 2 * seed + k)[0] for k in range(2)]
        pictures = [_seen_from(solids, _SHAPE_VIEWS) for solids in shapes]
    else:
        variants = variants_of(category, seed)
        front = _seen_from(variants[0], ((cone.azimuth_deg, cone.elevation_deg),))
        pictures = [front, *(_seen_from(solids, _VARIANT_VIEWS) for solids in variants)]
    rule = np.full((_FAMILY_CELL, _FAMILY_RULE, 3), 205, np.uint8)
    return np.concatenate([part for picture in pictures for part in (rule, picture)][1:], axis=1)


def _seen_from(solids: list[Solid], angles: Sequence[tuple[float, float]]) -> np.ndarray:
    azimuth_deg, elevation_deg = np.array(angles, float).T
    images = (
        Renderer(surface_of(solids)).render(orbit_camera(azimuth_deg, elevation_deg, _FAMILY_CELL)).images
    )
    return np.concatenate(list(images), axis=1)
