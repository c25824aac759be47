"""Random changes of training images, so that a network that has seen only clean renders can read photographs.

Photographs reach the network cut out on white (train/data/photos.py). What differs from a render still: the frame,
which is drawn around the object, not around where it could be; light and colour, a blurred or compressed picture, an
object not quite in the middle, a background not quite white. The object in the picture stays the same one, so its depth
map and its whole shape remain the right answers.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn import functional as F

from train.data.cutout import FILL, LONGEST
from train.data.packed import PackedViews
from train.device import moved

# At strength 1; each is drawn uniformly up to these values in both directions, where a direction makes sense.
_SHIFT = 0.03  # of the image's side
_SCALE = 0.05
_TURN = math.radians(3)
_GAIN, _GAMMA, _TINT, _COLOUR_MIX = 0.25, 0.4, 0.1, 0.25
_LIGHT_FALL = 0.3  # change of brightness across the picture
_BACKGROUND = 0.12  # how much darker than white
_BLUR = 1.2  # standard deviation in pixels
_NOISE = 0.03
_QUANTISATION = 0.12  # step of the highest frequencies
# How often a picture is changed in each of the ways that spoil it.
_SPOILT_SHARE = 0.5
_WHITE = 0.98


def augment(images: Tensor, strength: float, seeds: Tensor, *, framing: float = 0.0) -> Tensor:
    """Changes light, colour, sharpness, size and place of each image at random.

    Args:
        images: (B, 3, H, W) in [0, 1] on white.
        strength: 0 changes nothing; 1 is as much as photographs need.
        seeds: (B,) int64 on the CPU, one for each image: what happens to an image does not depend on those beside it,
            nor on the device, but for rounding.
        framing: share of the images whose object is framed as `cutout` frames a photograph, in the middle and about as
            large in every one: a render shows a distant or an end-on object small.

    Returns:
        (B, 3, H, W) in [0, 1].
    """

    numbers, noise = _random_numbers(images, seeds)
    unused = iter(numbers.unbind(1))

    def draw(most: float, *shape: int, signed: bool = True) -> Tensor:
        drawn = torch.stack([next(unused) for _ in range(math.prod(shape))], 1).view(-1, *shape)
        return strength * most * (2 * drawn - 1 if signed else drawn)

    def sometimes(values: Tensor) -> Tensor:
        return torch.where(next(unused) < _SPOILT_SHARE, values, 0)

    frames = _frames(images, numbers[:, -1] < framing) if framing > 0 else _whole(images)
    images = _cut(images, *frames, shift=draw(_SHIFT, 2), scale=1 + draw(_SCALE), turn=draw(_TURN))
    empty = (images.amin(1, keepdim=True) >= _WHITE).to(images.dtype)
    mix = torch.eye(3, device=images.device) + draw(_COLOUR_MIX, 3, 3)
    coloured = torch.einsum("bij,bjhw->bihw", mix / mix.sum(-1, keepdim=True), images)
    gain = (1 + draw(_GAIN, 1)) * (1 + draw(_TINT, 3))
    light = coloured.clamp(1e-4, 1) ** torch.exp(draw(_GAMMA, 1, 1, 1)) * gain[..., None, None]
    light = light * _gradient(draw(_LIGHT_FALL, 2), images)
    background = 1 - sometimes(draw(_BACKGROUND, signed=False))[:, None, None, None] * (
        _gradient(draw(1.0, 2), images) / 2
    )
    images = empty * background + (1 - empty) * light
    images = _blur(images, sometimes(draw(_BLUR, signed=False)))
    images = images + sometimes(draw(_NOISE, signed=False))[:, None, None, None] * noise
    return _compress(images, sometimes(draw(_QUANTISATION, signed=False))).clamp(0, 1)


def _random_numbers(images: Tensor, seeds: Tensor) -> tuple[Tensor, Tensor]:
    """Uniform in [0, 1) (B, 64), more than are used, and normal of the images' shape: an image's from its own seed."""
    uniform, normal = [], []
    for seed in seeds.tolist():
        generator = torch.Generator().manual_seed(seed)
        uniform.append(torch.rand(64, generator=generator))
        normal.append(torch.randn(images.shape[1:], generator=generator))
    return moved(torch.stack(uniform), images.device), moved(torch.stack(normal), images.device)


@dataclasses.dataclass(frozen=True)
class FramedViews:
    """The views (V, 3, h, w) uint8 of a shape, each framed as `cutout` frames a photograph when it is read."""

    views: StoredViews | Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.views.shape)

    @property
    def dtype(self) -> torch.dtype:
        return self.views.dtype

    def __getitem__(self, chosen: Tensor | slice) -> Tensor:
        images = self.views[chosen].float() / 255
        no_shift, as_large = _whole(images)
        every = torch.ones_like(as_large, dtype=torch.bool)
        frames = _frames(images, every)
        framed = _cut(images, *frames, shift=no_shift, scale=as_large, turn=torch.zeros_like(as_large))
        return (framed * 255).round().to(torch.uint8)


StoredViews = PackedViews | FramedViews


def _whole(images: Tensor) -> tuple[Tensor, Tensor]:
    """The frames of whole pictures, see `_frames`."""
    return images.new_zeros(len(images), 2), images.new_ones(len(images))


def _frames(images: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """The frame of a photograph around each object: its middle (B, 2), in [-1, 1], and its side (B,), 1 for the whole
    picture. That is the frame of images that are not chosen (B,), or show nothing."""
    covered = images.amin(1) < _WHITE
    across, down = _ends(covered.any(1)), _ends(covered.any(2))
    first, last = torch.stack((across[0], down[0]), 1), torch.stack((across[1], down[1]), 1)
    extent = last - first
    side = torch.maximum(extent.norm(dim=1) / FILL, extent.amax(1) / LONGEST)
    whole = ~(chosen & covered.flatten(1).any(1))
    return (first + last - 1).masked_fill(whole[:, None], 0), side.masked_fill(whole, 1)


def _ends(covered: Tensor) -> tuple[Tensor, Tensor]:
    """Where the covered places (B, N) along an axis begin and end, as shares of it."""
    size = covered.shape[1]
    place = torch.arange(size, device=covered.device).expand_as(covered)
    return torch.where(covered, place, size).amin(1) / size, torch.where(covered, place + 1, 0).amax(1) / size


def _cut(
    images: Tensor, middle: Tensor, side: Tensor, *, shift: Tensor, scale: Tensor, turn: Tensor
) -> Tensor:
    """Cuts out frames (see `_frames`) and shifts (in sides of the frame), scales and turns them; white comes in from
    outside."""
    height, width = images.shape[-2:]
    cosine, sine = side * torch.cos(turn) / scale, side * torch.sin(turn) / scale
    ratio = height / width
    offset = middle + 2 * side[:, None] * shift
    rows = [
        torch.stack([cosine, -sine * ratio, offset[:, 0]], -1),
        torch.stack([sine / ratio, cosine, offset[:, 1]], -1),
    ]
    places = F.affine_grid(torch.stack(rows, 1), list(images.shape), align_corners=False)
    return 1 - F.grid_sample(1 - images, places, align_corners=False)


def _gradient(slopes: Tensor, images: Tensor) -> Tensor:
    """(B, 2) slopes -> (B, 1, H, W): 1 in the middle, changing linearly by `slopes` over half of a side."""
    height, width = images.shape[-2:]
    y = torch.linspace(-1, 1, height, device=images.device)[:, None]
    x = torch.linspace(-1, 1, width, device=images.device)
    return 1 + slopes[:, 0, None, None, None] * y + slopes[:, 1, None, None, None] * x


def _blur(images: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian blur with a standard deviation (B,) in pixels for each image."""
    reach = math.ceil(2 * _BLUR)
    offsets = torch.arange(-reach, reach + 1, device=images.device)
    kernel = torch.exp(-0.5 * (offsets / sigma.clamp(min=1e-3)[:, None]) ** 2)
    kernel = (kernel / kernel.sum(-1, keepdim=True)).repeat_interleave(3, 0)[:, None]  # (3 * B, 1, K)
    stacked = F.pad(images.flatten(0, 1)[None], (reach,) * 4, mode="replicate")
    for shaped in (kernel[..., None, :], kernel[..., :, None]):
        stacked = F.conv2d(stacked, shaped, groups=len(kernel))
    return stacked[0].unflatten(0, images.shape[:2])


def _compress(images: Tensor, steps: Tensor) -> Tensor:
    """Rounds the cosine transform of blocks of 8 x 8 pixels as JPEG does; `steps` (B,) is that of high frequencies."""
    k = torch.arange(8.0, device=images.device)
    cosines = torch.cos(math.pi / 8 * (k + 0.5) * k[:, None]) * torch.where(k > 0, 0.5, 8**-0.5)[:, None]
    height, width = (side - side % 8 for side in images.shape[-2:])
    blocks = images[..., :height, :width].unflatten(-1, (-1, 8)).unflatten(-3, (-1, 8))
    waves = torch.einsum("ky,bcmynx,lx->bcmknl", cosines, blocks, cosines)
    frequency = (k[:, None, None] + k) / 14
    step = (steps[:, None, None, None, None, None] * (0.1 + 0.9 * frequency)).clamp(min=1e-6)
    rounded = (waves / step).round() * step
    found = torch.einsum("ky,bcmknl,lx->bcmynx", cosines, rounded, cosines)
    result = images.clone()
    result[..., :height, :width] = found.flatten(-2).flatten(-3, -2)
    return result
