"""Pictures of the procedural families: each front with the backs that belong to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from train.data.families import FAMILIES
from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.solids import Solid, surface_of
from train.files import replacing

_SIZE = 130
_RULE = 3  # pixels between one variant's views and the next's
# Azimuth and elevation of the views of one variant, of its front, and of a shape without variants.
_OF_VARIANT = ((55, 20), (140, 20), (205, 25))
_OF_SHAPE = ((0, 12), (40, 25), (90, 5), (150, 25), (215, -12))


def draw_families(out: Path, categories: Sequence[str], *, objects: int = 4, seed: int = 0) -> list[Path]:
    """Write one picture for each family, `<category>.png`, with a row for each object.

    A family with designed ambiguity shows the front once, and then each variant from the side, from behind at an angle
    and from behind. The others show two objects in a row, from five sides each.
    """
    paths = []
    for category in categories:
        rows = [_row(category, seed + number) for number in range(objects)]
        path = out / f"{category}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = Image.fromarray(np.concatenate(rows)).quantize(192, dither=Image.Dither.NONE)
        with replacing(path) as temporary:
            picture.save(temporary, format="PNG", optimize=True)
        paths.append(path)
    return paths


def _row(category: str, seed: int) -> np.ndarray:
    cone = FAMILIES[category].cone
    if cone is None:
        shapes = [variants_of(category, 2 * seed + k)[0] for k in range(2)]
        return _joined([_views(solids, _OF_SHAPE) for solids in shapes])
    variants = variants_of(category, seed)
    front = _views(variants[0], ((cone.azimuth_deg, cone.elevation_deg),))
    return _joined([front, *(_views(solids, _OF_VARIANT) for solids in variants)])


def _views(solids: list[Solid], places: Sequence[tuple[float, float]]) -> np.ndarray:
    azimuth_deg, elevation_deg = np.array(places, float).T
    images = Renderer(surface_of(solids)).render(orbit_camera(azimuth_deg, elevation_deg, _SIZE)).images
    return np.concatenate(list(images), axis=1)


def _joined(pictures: Sequence[np.ndarray]) -> np.ndarray:
    rule = np.full((_SIZE, _RULE, 3), 205, np.uint8)
    parts = [part for picture in pictures for part in (rule, picture)]
    return np.concatenate(parts[1:], axis=1)
