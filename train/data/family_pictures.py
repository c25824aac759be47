"""Pictures of the procedural families: each front beside the hidden variants that belong to it."""

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
# (azimuth, elevation) in degrees of the views of a variant, and of a shape of a family without variants.
_VARIANT_VIEWS = ((55, 20), (140, 20), (205, 25))
_SHAPE_VIEWS = ((0, 12), (40, 25), (90, 5), (150, 25), (215, -12))


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
        return _side_by_side([_views(solids, _SHAPE_VIEWS) for solids in shapes])
    variants = variants_of(category, seed)
    front = _views(variants[0], ((cone.azimuth_deg, cone.elevation_deg),))
    return _side_by_side([front, *(_views(solids, _VARIANT_VIEWS) for solids in variants)])


def _views(solids: list[Solid], angles: Sequence[tuple[float, float]]) -> np.ndarray:
    azimuth_deg, elevation_deg = np.array(angles, float).T
    images = Renderer(surface_of(solids)).render(orbit_camera(azimuth_deg, elevation_deg, _SIZE)).images
    return np.concatenate(list(images), axis=1)


def _side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    rule = np.full((_SIZE, _RULE, 3), 205, np.uint8)
    parts = [part for picture in pictures for part in (rule, picture)]
    return np.concatenate(parts[1:], axis=1)
