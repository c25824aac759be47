"""`Shape`, one object in memory; how it is put together from its files; the error of one that cannot be read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from diffpoint.camera import PinholeCamera
from diffpoint.io import read_points
from train.data.categories import category_of
from train.errors import UserError

Content = TypeVar("Content")


class ShapeError(UserError):
    """A shape that cannot be read; the message names the shape, the file and the reason."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """One object: its views, their cameras and its surface.

    Attributes:
        images: (V, 3, H, W) float32 in [0, 1], on white; uint8 and of the network's size after `shrink`.
        depth: (V, H, W) float32, z in the camera frame; +inf where nothing is seen, NaN inside the silhouettes of
            renderings that came without depth maps.
        camera: PinholeCamera (V,), float32, of the depth maps.
        points: (N, 3) float32 on the surface, world frame, y up.
        id: "synset/model".
        category: for instance "chair".
    """

    images: Tensor
    depth: Tensor
    camera: PinholeCamera
    points: Tensor
    id: str
    category: str

    @property
    def has_depth(self) -> bool:
        """False for renderings without depth maps, which can be reconstructed from and not trained on."""
        return not bool(self.depth.isnan().any())


def is_shape_id(text: str) -> bool:
    """True for "synset/model": two plain folder names.

    Ids become paths below the data tree and below the cache; others could lead out of them.

    Example:
        >>> [is_shape_id(text) for text in ("03001627/1a6f", "03001627/../../x", "/etc/passwd", "chair")]
        [True, False, False, False]
    """
    parts = text.split("/")
    return len(parts) == 2 and not any(
        part in ("", ".", "..") or any(sign in part for sign in "\\:\0") for part in parts
    )


def assembled(
    shape: str,
    folder: Path,
    images: Sequence[Tensor],
    depth: Sequence[Tensor],
    cameras: Sequence[tuple[Tensor, Tensor]],
    cloud: Path,
) -> Shape:
    """The shape "synset/model" of its views' pictures, depth maps, and cameras (K, cam_from_world), and its cloud file.

    Raises:
        ShapeError: pictures or depth maps of different sizes, or a cloud that is missing or broken.
    """
    size = images[0].shape[1:]
    for view, (image, each) in enumerate(zip(images, depth, strict=True)):
        if image.shape[1:] != size or each.shape != size:
            raise ShapeError(
                f"{shape}: {folder}: the pictures of view {view} are {tuple(image.shape[1:])} and {tuple(each.shape)} "
                f"pixels, view 0 is {tuple(size)}"
            )
    K, cam_from_world = (torch.stack(matrices) for matrices in zip(*cameras, strict=True))
    return Shape(
        images=torch.stack(list(images)),
        depth=torch.stack(list(depth)),
        camera=PinholeCamera(K, cam_from_world, size[0], size[1]),
        points=read_file(shape, cloud, read_points),
        id=shape,
        category=category_of(shape.split("/")[0]),
    )


def read_file(shape: str, path: Path, reader: Callable[[Path], Content]) -> Content:
    """`reader(path)`; whatever goes wrong becomes a `ShapeError` that names the shape and the file."""
    try:
        return reader(path)
    except FileNotFoundError as error:
        raise ShapeError(f"{shape}: {path} is missing") from error
    except Exception as error:  # every decoder has its own exceptions for broken files
        reason = " ".join(str(error).split())
        raise ShapeError(f"{shape}: {path} cannot be read ({type(error).__name__}: {reason})") from error


def make_camera(K: np.ndarray, cam_from_world: np.ndarray) -> tuple[Tensor, Tensor]:
    """K (3, 3) and cam_from_world (4, 4) as float32, if they are those of a camera.

    Raises:
        ValueError: not finite, wrong shapes or last rows, not invertible, or a pose that is no rigid motion.
    """
    K_, pose = (torch.from_numpy(np.array(matrix, np.float32)) for matrix in (K, cam_from_world))
    camera = PinholeCamera(K_, pose, 1, 1)
    rotation = pose[:3, :3].double()
    if float(K_[:2, :2].double().det().abs()) < 1e-6:
        raise ValueError(f"K cannot be inverted: {K_.tolist()}")
    if float(rotation.det().abs()) < 1e-6:
        raise ValueError(f"cam_from_world cannot be inverted: {rotation.tolist()}")
    if float((rotation @ rotation.T - torch.eye(3).double()).abs().max()) > 1e-2 or float(rotation.det()) < 0:
        raise ValueError(f"cam_from_world is no rotation: {rotation.tolist()}")
    return camera.K, camera.cam_from_world
