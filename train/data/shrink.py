"""One shape at the sizes of training: images for the network's input, depth maps for the front constraint."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import PinholeCamera
from train.data.shape import Shape, ShapeError
from train.errors import UserError

Pool = Literal["decimate", "min"]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What a shape is shrunk to.

    Attributes:
        image_size: height and width of the network's input.
        map_size: side of the depth maps.
        pool: how depth maps shrink: `decimate_depth` or `min_pool_depth`.
    """

    image_size: tuple[int, int]
    map_size: int
    pool: Pool = "decimate"


class SmallDepth(NamedTuple):
    """Depth maps (V, S, S) at the size of the front constraint, and their cameras (V,)."""

    depth: Tensor
    camera: PinholeCamera


def shrink(shape: Shape, sizes: Sizes) -> Shape:
    """Brings images and depth maps to the sizes of training; the cameras follow the depth maps.

    Returns:
        The shape with images (V, 3, h, w) uint8, depth (V, S, S) and cameras for maps of S x S pixels.

    Raises:
        ShapeError: a view shows nothing.
        UserError: renders whose side is not a multiple of the map size.
    """
    if shape.depth.isinf().flatten(1).all(1).any():
        raise ShapeError(f"{shape.id}: one of its views shows nothing")
    depth, camera = _small_depth(shape, sizes)
    resized = F.interpolate(
        shape.images, size=sizes.image_size, mode="bilinear", align_corners=False, antialias=True
    )
    images = (resized.clamp(0, 1) * 255).round().to(torch.uint8)
    return dataclasses.replace(shape, images=images, depth=depth.contiguous(), camera=camera)


def _small_depth(shape: Shape, sizes: Sizes) -> SmallDepth:
    side, wanted = shape.depth.shape[-1], sizes.map_size
    if not shape.has_depth:  # renderings to evaluate on: only their pictures and their ground truth are used
        unknown = torch.full((len(shape.depth), wanted, wanted), torch.nan)
        return SmallDepth(unknown, shape.camera.resize(wanted, wanted))
    if side % wanted:
        raise UserError(
            f"{shape.id}: renders are {side} pixels wide, not a multiple of the map size {wanted}; "
            "render at another size or set --map-size"
        )
    pool = decimate_depth if sizes.pool == "decimate" else min_pool_depth
    return pool(shape.depth, shape.camera, size=wanted)


def decimate_depth(depth: Tensor, camera: PinholeCamera, *, size: int) -> SmallDepth:
    """Keeps one pixel of every f x f block, the one at index f*i + f//2, and its exact position.

    Its centre, f*i + f//2 + 0.5, is the centre i + 0.5 of small pixel i of a camera whose principal point is
    shifted by half a large pixel (f even; none for f odd) before both are divided by f. Nothing is rounded.

    Args:
        depth: (V, H, H) metric depth, +inf where empty.
        camera: batch shape (V,), of H x H pixels.
        size: side of the small maps; divides H.
    """
    factor = _factor(depth, size)
    start = factor // 2
    shift = start + 0.5 - factor / 2
    return SmallDepth(depth[:, start::factor, start::factor], _shrink_camera(camera, factor, shift, size))


def min_pool_depth(depth: Tensor, camera: PinholeCamera, *, size: int) -> SmallDepth:
    """Keeps the nearest depth of every f x f block, at the block's centre: what the paper does.

    Args and result as in `decimate_depth`. The nearest surface of a block is seldom at its centre, so the
    observed points are off by up to half a small pixel.
    """
    factor = _factor(depth, size)
    nearest = -F.max_pool2d(-depth[:, None], factor)[:, 0]
    return SmallDepth(nearest, _shrink_camera(camera, factor, 0.0, size))


def _factor(depth: Tensor, size: int) -> int:
    side = depth.shape[-1]
    if depth.shape[-2] != side or side % size:
        got = tuple(depth.shape[-2:])
        raise ValueError(f"depth maps must be square with a side divisible by {size}; got {got}")
    return side // size


def _shrink_camera(camera: PinholeCamera, factor: int, shift: float, size: int) -> PinholeCamera:
    K = camera.K.clone()
    K[..., :2, 2] -= shift
    K[..., :2, :] /= factor
    return PinholeCamera(K, camera.cam_from_world, size, size)
