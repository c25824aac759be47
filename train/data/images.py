"""Decoding pictures, and pictures from anywhere as the network expects them: RGB on white, square, in [0, 1]."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageCms, ImageOps
from torch import Tensor
from torch.nn import functional as F

from train.errors import UserError

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".jfif", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
UNREADABLE_SUFFIXES = (".heic", ".heif", ".avif", ".dng", ".cr2", ".nef")
"""Formats of cameras that have to be converted first."""

_SMALLEST = 16
_LARGEST = 1 << 30  # pixels; they would take 3 GB
_ENOUGH = 50_000_000
"""Pictures with more pixels are read at a reduced size."""
_WHITE = 0.985
_BLANK = 0.97
_BLACK = 1 / 16  # the brightest value of 12 bits in 16


def decode(path: str | Path) -> np.ndarray:
    """The pixels of a picture file, upright: (H, W, 1 to 4), grey or colour with or without alpha.

    Integers of 8 or 16 bits, or floats in [0, 1]; palettes and other colour models become RGBA of 8 bits.

    Raises:
        OSError, ValueError, or another exception of the format's decoder: the file is missing or broken.
    """
    with _open(path) as file:
        image = ImageOps.exif_transpose(file)  # cameras note how they were held instead of turning the pixels
        if image.mode.startswith("I"):  # 16 bits of grey; older versions of Pillow widen them to 32
            return np.asarray(image).clip(0, 65535).astype(np.uint16)[..., None]
        one_clear_colour = "transparency" in image.info
        if one_clear_colour or image.mode not in ("L", "LA", "RGB", "RGBA", "F", "CMYK"):
            image = image.convert("RGBA")
        if image.width * image.height > _ENOUGH:
            image = image.reduce(math.ceil(math.sqrt(image.width * image.height / _ENOUGH)))
        image = _in_srgb(image)
        return np.atleast_3d(np.asarray(image.convert("RGBA") if image.mode == "CMYK" else image))


def _in_srgb(image: Image.Image) -> Image.Image:
    """Converts the colours of a picture with a profile, as telephones and printers' programs write them."""
    profile = image.info.get("icc_profile")
    if not profile or image.mode not in ("L", "RGB", "RGBA", "CMYK"):
        return image
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "sRGB" in ImageCms.getProfileDescription(own):
            return image
        mode = "RGBA" if image.mode == "RGBA" else "RGB"
        converted = ImageCms.profileToProfile(image, own, ImageCms.createProfile("sRGB"), outputMode=mode)
        return converted or image
    except (ImageCms.PyCMSError, OSError):  # a broken profile, or one of another colour model: as browsers do
        return image


def eight_bits(image: Image.Image) -> Image.Image:
    """Grey of 16 bits as 8; Pillow's own conversion takes all that is brighter than 255 for white."""
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).clip(0, 65535) >> 8).astype(np.uint8))


@contextmanager
def _open(path: str | Path) -> Iterator[Image.Image]:
    """Opens a picture without Pillow's limit on its size, and with ours."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with Image.open(path) as file:
            if file.width * file.height > _LARGEST:
                raise ValueError(f"{file.width} x {file.height} pixels are too many: make it smaller")
            yield file
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def on_white(pixels: np.ndarray) -> Tensor:
    """Decoded pixels (H, W, 1 to 4) as RGB (3, H, W) in [0, 1], where transparency shows white."""
    values = _scaled(pixels)
    if values.shape[2] in (2, 4):
        alpha = values[..., -1:]
        values = values[..., :-1] * alpha + (1 - alpha)
    values = np.broadcast_to(values, (*values.shape[:2], 3)) if values.shape[2] == 1 else values
    return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))


def read_images(paths: Sequence[str | Path], *, size: int = 224) -> Tensor:
    """Reads pictures of one object, composites transparency on white and pads each to a centred square.

    Args:
        paths: image files of any size, grey or colour, 8 or 16 bits, with or without alpha.
        size: side to which the squares are resized.

    Returns:
        (V, 3, size, size) float32 in [0, 1].

    Raises:
        UserError: a file is missing, is no image, or shows nothing.
    """
    resized = []
    for path in paths:
        picture = on_white(_decode_object(path))
        if picture.min() > _BLANK:
            raise UserError(f"{path} shows nothing: it is white or transparent everywhere")
        if picture.max() < _BLACK:
            hint = "a file of 16 bits whose values have fewer is to be saved with 8 bits"
            raise UserError(f"{path} shows nothing: it is black everywhere; {hint}")
        height, width = picture.shape[1:]
        side = max(height, width)
        left, top = (side - width) // 2, (side - height) // 2
        square = F.pad(picture, (left, side - width - left, top, side - height - top), value=1.0)
        resized.append(
            F.interpolate(square[None], size=(size, size), mode="bilinear", antialias=True).clamp(0, 1)
        )
    return torch.cat(resized)


def read_rgba(path: str | Path) -> np.ndarray:
    """Reads a picture as (H, W, 4) float32 in [0, 1], upright; alpha is 1 everywhere if the file has none.

    Raises:
        UserError: the file is missing, is no image, or is too small to show an object.
    """
    values = _scaled(_decode_object(path))
    colours = values[..., :3] if values.shape[2] > 2 else values[..., :1]
    alpha = values[..., -1:] if values.shape[2] in (2, 4) else np.ones_like(values[..., :1])
    return np.concatenate((np.broadcast_to(colours, (*values.shape[:2], 3)), alpha), axis=2)


def is_cut_out(rgba: np.ndarray) -> bool:
    """True for a picture (H, W, 4) that shows an object alone: it has transparency, or three of its sides are white.

    The fourth side may be covered by the object. White means the white of a file, not of photographed paper.
    """
    if (rgba[..., 3] < 0.5).any():
        return True
    sides = (rgba[0], rgba[-1], rgba[:, 0], rgba[:, -1])
    return sum(float(np.quantile(side[:, :3].min(1), 0.1)) >= _WHITE for side in sides) >= 3


def _decode_object(path: str | Path) -> np.ndarray:
    """`decode`, with errors for the user."""
    if not Path(path).is_file():
        raise UserError(f"{path} does not exist or is no file; name the images to reconstruct from")
    try:
        pixels = decode(path)
        if not np.isfinite(pixels).all():
            raise ValueError("some pixels are not finite")
        if pixels.dtype.kind == "f" and not -0.01 <= pixels.min() <= pixels.max() <= 1.01:
            found = f"floats from {pixels.min():g} to {pixels.max():g}"
            raise ValueError(f"its pixels are {found} and should be between 0 and 1: save it with 8 bits")
    except Exception as error:  # every decoder has its own exceptions; all mean that this is no image
        reason = str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
        if Path(path).suffix.lower() in UNREADABLE_SUFFIXES:
            reason = f"convert {Path(path).suffix} files to JPEG or PNG first"
        raise UserError(f"{path} is not an image that can be read ({reason})") from None
    height, width = pixels.shape[:2]
    if min(height, width) < _SMALLEST:
        raise UserError(
            f"{path} is {width} x {height} pixels; at least {_SMALLEST} x {_SMALLEST} are needed to show an object"
        )
    return pixels


def _scaled(pixels: np.ndarray) -> np.ndarray:
    """As float32 in [0, 1]."""
    top = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1.0
    return np.asarray(pixels, np.float32) / np.float32(top)
