"""The explorer: an HTML page that stands alone, with the clouds of a plane of codes, to drag through.

The clouds of a grid of codes nearly lie in a linear space of few dimensions. The page holds their mean in 16 bits, a
basis of their differences in 8 bits, and the weights of each grid code, which it blends between the four nearest.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from torch import Tensor

from train.files import write_text

_TEMPLATE = Path(__file__).with_name("explorer.html")
_PLACE = '"planes go here"'
_TOLERANCE = 0.002
"""World units, rms over points and grid codes: what the basis may leave out."""
_WHITE = 248
_MARGIN = 6  # pixels around the object


class CodePlane(NamedTuple):
    """One image's predictions on a square grid of codes in a plane; point n corresponds in all of them.

    Attributes:
        image: (3, H, W) in [0, 1].
        clouds: (G * G, N, 3), y up; rows from the bottom of the plane to its top, each from left to right.
        spread: (N,) rms distance of each point from its mean over random codes, in world units.
        start: (2,) where the page starts, right and up, each in [-1, 1]; with several images, the code on which they
            agree.
        reach: half the side of the plane, in standard deviations of a random code's coordinates.
    """

    image: Tensor
    clouds: Tensor
    spread: Tensor
    start: Tensor
    reach: float


def write_explorer(path: str | Path, planes: Sequence[CodePlane]) -> None:
    """Writes the page; several images of one object get a tab each, and one for what they agree on.

    Args:
        path: the .html file.
        planes: one for each image.
    """
    packed = json.dumps([_packed(each) for each in planes])
    write_text(path, _TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, packed))


def _packed(plane: CodePlane) -> dict[str, Any]:
    """What the page needs, in JSON; arrays are little-endian bytes in base64, `*_scale` the value of their unit."""
    clouds = plane.clouds.flatten(1).double().numpy()
    mean, mean_scale = _quantised(clouds.mean(0, keepdims=True), 16)
    changes = clouds - mean * mean_scale[:, None]
    basis, basis_scale = _quantised(_basis(changes, points=plane.clouds.shape[1]), 8)
    # Fitted to the rounded basis, so that its errors partly cancel.
    weights = np.linalg.lstsq((basis * basis_scale[:, None]).T, changes.T, rcond=None)[0].T
    spread = plane.spread.numpy()
    spread_scale = max(spread.max() / 255, 1e-9)
    return {
        "image": _jpeg(plane.image),
        "mean": _base64(mean),
        "mean_scale": mean_scale.item(),
        "basis": _base64(basis),
        "weights": _base64((weights * basis_scale).astype("<f4")),
        "spread": _base64((spread / spread_scale).round().astype(np.uint8)),
        "spread_scale": float(spread_scale),
        "start": plane.start.tolist(),
        "reach": plane.reach,
    }


def _basis(changes: np.ndarray, *, points: int) -> np.ndarray:
    """(K, 3 N) orthonormal rows, as few as describe (G * G, 3 N) changes to the tolerance; at least one."""
    _, strength, rows = np.linalg.svd(changes, full_matrices=False)
    left_out = np.append(np.cumsum(strength[::-1] ** 2)[::-1], 0.0) / (len(changes) * points)
    return rows[: max(1, int(np.argmax(left_out <= _TOLERANCE**2)))]


def _quantised(rows: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Signed integers of so many bits, and each row's scale: rows is about integers * scale[:, None]."""
    most = 2 ** (bits - 1) - 1
    scale = np.maximum(np.abs(rows).max(1), 1e-9) / most
    return (rows / scale[:, None]).round().astype(f"<i{bits // 8}"), scale


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode()


def _jpeg(image: Tensor) -> str:
    """An image (3, H, W) as the source of an <img>, cropped to what is not white."""
    pixels = (image.permute(1, 2, 0).clamp(0, 1) * 255).round().byte().cpu().numpy()
    rows, columns = np.nonzero(pixels.min(2) < _WHITE)
    if len(rows):
        pixels = pixels[_around(rows), _around(columns)]
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


def _around(places: np.ndarray) -> slice:
    return slice(max(0, places.min() - _MARGIN), places.max() + 1 + _MARGIN)
