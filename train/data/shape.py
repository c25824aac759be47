"""`Shape`, one object in memory, and the error of one that cannot be read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor

from diffpoint.camera import PinholeCamera
from train.errors import UserError

Content = TypeVar("Content")


class ShapeError(UserError):
    """A shape that cannot be read; the message names the shape, the file and the reason."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """One object: its views, their cameras and its surface.

    Attributes:
        images: (V, 3, H, W) float32 in [0, 1], on white.
        depth: (V, H, W) float32, z in the camera frame; +inf where nothing is seen, NaN where something is seen
            and nobody measured how far it is (renderings without depth maps).
        camera: PinholeCamera (V,), float32.
        points: (N, 3) float32, world frame, y up.
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
        """False for renderings that came without depth maps: they can be reconstructed from, not trained on."""
        return not bool(self.depth.isnan().any())


class ViewsRead(NamedTuple):
    """The views of one shape, as its files have them."""

    images: Tensor
    """(V, 3, H, W) in [0, 1], on white."""
    depth: Tensor
    """(V, H, W), as in `Shape`."""
    camera: PinholeCamera
    """(V,)."""


def read_file(shape: str, path: Path, reader: Callable[[Path], Content]) -> Content:
    """`reader(path)`; whatever goes wrong becomes a `ShapeError` that names the shape and the file."""
    try:
        return reader(path)
    except FileNotFoundError as error:
        raise ShapeError(f"{shape}: {path} is missing") from error
    except Exception as error:  # every decoder has its own way to say that a file is broken
        reason = " ".join(str(error).split())
        raise ShapeError(f"{shape}: {path} cannot be read ({type(error).__name__}: {reason})") from error


def read_pixels(path: Path) -> np.ndarray:
    """(H, W, channels) as decoded."""
    return np.atleast_3d(imageio.imread(path))


def make_camera(K: np.ndarray, cam_from_world: np.ndarray) -> tuple[Tensor, Tensor]:
    """K (3, 3) and cam_from_world (4, 4) as float32, if they are those of a camera.

    Raises:
        ValueError: not finite, wrong shapes or last rows, not invertible, or a pose that is no rigid motion.
    """
    K_, pose = (
        torch.from_numpy(np.array(K, np.float32)),
        torch.from_numpy(np.array(cam_from_world, np.float32)),
    )
    camera = PinholeCamera(K_, pose, 1, 1)
    rotation = pose[:3, :3].double()
    if float(K_[:2, :2].double().det().abs()) < 1e-6:
        raise ValueError(f"K cannot be inverted: {K_.tolist()}")
    if float(rotation.det().abs()) < 1e-6:
        raise ValueError(f"cam_from_world cannot be inverted: {rotation.tolist()}")
    if float((rotation @ rotation.T - torch.eye(3).double()).abs().max()) > 1e-2 or float(rotation.det()) < 0:
        raise ValueError(f"cam_from_world is no rotation: {rotation.tolist()}")
    return camera.K, camera.cam_from_world
