"""Contact sheets of a dataset: for each category a picture with a row for each shape, to be looked at."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw
from torch import Tensor

from diffpoint import PinholeCamera, project
from train.data import store
from train.data.categories import category_of, synset_of
from train.data.tree import Shape, ShapeError, ShapeTree, read_shape
from train.errors import UserError
from train.figures import TRUE, from_behind
from train.files import replacing

_CELL = 128
_VIEWS = 4
_GAP = 2


def show(
    data: Path, out: Path | None = None, *, categories: Sequence[str] | None = None, shapes: int = 8
) -> dict[str, Path]:
    """Write a contact sheet for each category, named after it: views, depth, the cloud from that view and from behind.

    Args:
        data: root of a data tree.
        out: folder of the sheets; `contact/` in the data tree if not given.
        categories: names or synsets; None for all.
        shapes: rows of a sheet, evenly spread over the category's shapes.

    Returns:
        The sheets by category.

    Raises:
        UserError: no data, an unknown category, or nothing that can be read.
    """
    if shapes < 1:
        raise UserError(f"shapes must be at least 1; got {shapes}")
    ids: dict[str, list[str]] = defaultdict(list)
    for split in store.SPLITS:
        for shape in ShapeTree(data, split).ids:
            ids[shape.split("/")[0]].append(shape)
    wanted = sorted(ids) if categories is None else [synset_of(name) for name in categories]
    absent = [category_of(synset) for synset in wanted if synset not in ids]
    if absent:
        known = ", ".join(category_of(synset) for synset in sorted(ids)) or "none"
        raise UserError(f"{data} has no shape of {', '.join(absent)}; it has: {known}")
    sheets = {}
    for synset in wanted:
        found = sorted(ids[synset])
        rows = []
        for number in np.linspace(0, len(found) - 1, min(shapes, len(found))).astype(int):
            try:
                rows.append(row_of(read_shape(data, found[number])))
            except ShapeError:
                continue  # `data check` names what is broken
        if not rows:
            raise UserError(
                f"{data}: no shape of {category_of(synset)} can be read; see: python -m train data check"
            )
        path = (out or data / "contact") / f"{category_of(synset)}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            Image.fromarray(np.concatenate(rows)).save(temporary, format="PNG", optimize=True)
        sheets[category_of(synset)] = path
    return sheets


def row_of(shape: Shape) -> np.ndarray:
    """One shape as a strip (cell, columns, 3) uint8: some views, then depth and cloud of the first of them."""
    chosen = np.linspace(0, len(shape.images), _VIEWS, endpoint=False).astype(int)
    cells = [
        _resized((shape.images[view].permute(1, 2, 0).numpy() * 255).astype(np.uint8)) for view in chosen
    ]
    camera = shape.camera[int(chosen[0])]
    cells.append(_resized(_depth_picture(shape.depth[chosen[0]].numpy())))
    cells += [_cloud_picture(shape.points, each) for each in (camera, from_behind(camera))]
    gap = np.full((_CELL, _GAP, 3), 255, np.uint8)
    return np.concatenate([part for cell in cells for part in (cell, gap)], axis=1)


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
    pixels = projected.pixels[0, 0].numpy() * (_CELL / camera.width)
    depth = projected.depth[0, 0].numpy()
    picture = Image.new("RGB", (_CELL, _CELL), "white")
    draw = ImageDraw.Draw(picture)
    tones = (np.asarray(TRUE((depth - depth.min()) / max(np.ptp(depth), 1e-6)))[:, :3] * 255).astype(int)
    for point in np.argsort(-depth):
        (x, y), colour = pixels[point], tuple(tones[point].tolist())
        draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=colour)
    return np.asarray(picture)
