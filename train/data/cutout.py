"""An object cut out of a photograph: alone on white, in a square, as large as objects are in training."""

from __future__ import annotations

import dataclasses

import numpy as np
from PIL import Image

from train.data.foreground import WORKING_SIDE, Foreground, NotPlain, find_foreground
from train.errors import UserError

FILL = 0.88
"""Diagonal of the object's bounding box as a share of the frame's side. Of the measures of size this one varies least
over training views: 0.93 on average for models whose box has a diagonal of 1, 0.71 for the embedded shapes."""
LONGEST = 0.94
"""No side of the object takes more of the frame."""

_LARGEST_SIDE = 2048
_SMALL_IN_FRAME, _MARGIN = 0.5, 0.35
_FEWEST_PIXELS = 16
_HINT = "put the object on plain paper, make the rest transparent, or give a mask (NAME_mask.png)"


@dataclasses.dataclass(frozen=True, eq=False)
class CutOut:
    """An object cut out of a photograph.

    Attributes:
        picture: (S, S, 3) uint8, on white.
        mask: (H, W) bool, as large as the photograph.
        way: how the object was found: "mask", "alpha" or "plain background".
        found: a description of what was found.
    """

    picture: np.ndarray
    mask: np.ndarray
    way: str
    found: str


def cut_out(rgba: np.ndarray, *, size: int = 224, given: np.ndarray | None = None) -> CutOut:
    """Cuts the object out of a photograph.

    Args:
        rgba: (H, W, 4) in [0, 1].
        size: side of the picture that is made.
        given: (H, W, 4) in [0, 1], a mask: its alpha channel if that is transparent anywhere, else its brightness.
            Without one, the photograph's own alpha is used, and if that is opaque the background has to be plain.

    Raises:
        UserError: a mask of another size, an empty mask, or a background that is not plain.
    """
    height, width = rgba.shape[:2]
    colours = rgba[..., :3]
    if given is not None:
        alpha, way, found = _mask_values(given, height, width), "mask", "mask"
    elif (rgba[..., 3] < 0.5).any():
        alpha, way, found = rgba[..., 3], "alpha", "alpha"
    else:
        image = Image.fromarray((colours * 255 + 0.5).astype(np.uint8))
        image.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE), Image.Resampling.BOX)
        alpha, ground = _segment(image)
        colours, way, found = np.asarray(image, np.float32) / 255, "plain background", _words(ground)
    mask = alpha >= 0.5
    if mask.sum() < _FEWEST_PIXELS:
        raise UserError(f"shows nothing: its {way} is empty")
    picture = _framed(colours * alpha[..., None] + (1 - alpha[..., None]), mask, size)
    if mask.shape != (height, width):
        full = Image.fromarray((alpha * 255).astype(np.uint8)).resize(
            (width, height), Image.Resampling.BILINEAR
        )
        mask = np.asarray(full) >= 128
    return CutOut(picture, mask, way, f"{found}; the object takes {mask.mean():.0%} of the photograph")


def _mask_values(given: np.ndarray, height: int, width: int) -> np.ndarray:
    if given.shape[:2] != (height, width):
        raise UserError(
            f"its mask is {given.shape[1]} x {given.shape[0]} pixels, the photograph {width} x {height}; "
            "make them the same size"
        )
    return given[..., 3] if (given[..., 3] < 0.5).any() else given[..., :3].mean(2)


def _segment(image: Image.Image) -> tuple[np.ndarray, Foreground]:
    """Alpha (H, W) of the object on a plain background; a small object is looked at a second time, enlarged."""
    try:
        alpha, found = _segment_box(image, (0, 0, *image.size))
    except NotPlain as error:
        raise UserError(f"the background is not plain: {error}; {_HINT}") from None
    rows, columns = np.flatnonzero((alpha >= 0.5).any(1)), np.flatnonzero((alpha >= 0.5).any(0))
    if not rows.size:
        return alpha, found
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    if max(image.size) > WORKING_SIDE and extent < _SMALL_IN_FRAME * max(image.size):
        margin = round(_MARGIN * extent)
        left, top = max(columns[0] - margin, 0), max(rows[0] - margin, 0)
        right, bottom = min(columns[-1] + margin, image.width), min(rows[-1] + margin, image.height)
        try:
            closer, _ = _segment_box(image, (int(left), int(top), int(right), int(bottom)))
        except NotPlain:
            return alpha, found  # its shadow takes too much of the narrower border
        both = (closer >= 0.5) & (alpha >= 0.5)
        if both.sum() > 0.8 * (closer >= 0.5).sum():
            alpha = closer
    return alpha, found


def _segment_box(image: Image.Image, box: tuple[int, int, int, int]) -> tuple[np.ndarray, Foreground]:
    """Alpha of the whole image, from looking at a part of it."""
    part = image.crop(box)
    factor = min(WORKING_SIDE / max(part.size), 1.0)
    small = (max(round(part.width * factor), 1), max(round(part.height * factor), 1))
    found = find_foreground(np.asarray(part.resize(small, Image.Resampling.BOX), np.float32) / 255)
    alpha = Image.new("L", image.size)
    edges = Image.fromarray(found.mask.astype(np.uint8) * 255).resize(part.size, Image.Resampling.BILINEAR)
    alpha.paste(edges, box[:2])
    return np.asarray(alpha, np.float32) / 255, found


def _words(found: Foreground) -> str:
    red, green, blue = (round(float(value) * 255) for value in found.colour)
    words = f"plain background of colour ({red}, {green}, {blue})"
    if found.uneven >= 0.05:
        words += f", {found.uneven:.0%} darker in places"
    if found.shadow >= 0.01:
        words += f", shadow on {found.shadow:.0%}"
    return f"{words}; cut off at the {' and the '.join(found.cut)}" if found.cut else words


def _framed(on_white: np.ndarray, mask: np.ndarray, size: int) -> np.ndarray:
    """(S, S, 3) uint8: the object's box in the middle of a white square, at the scale of training."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    tall, wide = bottom - top, right - left
    side = max(np.hypot(tall, wide) / FILL, max(tall, wide) / LONGEST)
    border = int(np.ceil(side))
    padded = np.pad(on_white, ((border, border), (border, border), (0, 0)), constant_values=1.0)
    x, y = border + (left + right - side) / 2, border + (top + bottom - side) / 2
    image = Image.fromarray((padded.clip(0, 1) * 255 + 0.5).astype(np.uint8))
    return np.array(image.resize((size, size), Image.Resampling.LANCZOS, box=(x, y, x + side, y + side)))
