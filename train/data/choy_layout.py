"""Reading the renderings of Choy et al. (3D-R2N2, 2016): 24 views of 137 x 137 pixels for each model.

    ShapeNetRendering/<synset>/<model>/rendering/{00.png ... 23.png, renderings.txt, rendering_metadata.txt}
    pcdata_2048/<synset>/<model>.ply            inside or beside it: the ground truth, not part of their archive
    data_list/{train,val,test}/<synset>.list    inside or beside it, if you have lists

There are no depth maps: such a tree can be reconstructed from and evaluated on, not trained on.

A line of the metadata is azimuth, elevation and in-plane angle in degrees, a distance ratio and a field of view. Their
renderer (lib/blender_renderer.py of the 3D-R2N2 repository) puts the camera at 1.75 times the ratio from the origin and
never applies the field of view: the lens is Blender's own, 35 mm before a sensor of 32 mm. Models are ShapeNet v1's OBJ
files, which Blender turns from y up to z up when it loads them. In the frame of the OBJ files, y up, azimuth 0 is on
+x and azimuth 90 on +z.
"""

from __future__ import annotations

from pathlib import Path, PurePath

import numpy as np
import torch
from torch import Tensor

from train.data import tree_files
from train.data.images import decode, on_white
from train.data.release_layout import CLOUD_FOLDERS, listed
from train.data.shape import Shape, ShapeError, assembled, make_camera, read_file
from train.errors import UserError

NAME = "ShapeNetRendering"
MAX_DISTANCE = 1.75
FOCAL_PER_PIXEL = 35 / 32
_METADATA, _NAMES = "rendering_metadata.txt", "renderings.txt"
_SYNSET = "[0-9]" * 8


def cam_from_world(
    azimuth_deg: float, elevation_deg: float, in_plane_deg: float, distance: float
) -> np.ndarray:
    """The pose (4, 4) of a camera that looks at the origin, in the frame of the OBJ files, y up.

    Args:
        azimuth_deg: 0 on +x, 90 on +z.
        elevation_deg: above the ground.
        in_plane_deg: turns the camera about its axis; the picture turns counter-clockwise.
        distance: from the origin, in the unit of the models, whose bounding boxes have a diagonal of 1.

    Example:
        >>> eye_in_cam = cam_from_world(90, 0, 0, 1.5) @ [0, 0, 1.5, 1]  # on +z
        >>> np.allclose(eye_in_cam[:3], 0)
        True
    """
    azimuth, elevation, roll = np.radians([azimuth_deg, elevation_deg, in_plane_deg])
    forward = -np.array(
        [np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)]
    )
    right = np.array([np.sin(azimuth), 0.0, -np.cos(azimuth)])  # also where the camera looks straight down
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[0, :3] = np.cos(roll) * right + np.sin(roll) * down
    pose[1, :3] = np.cos(roll) * down - np.sin(roll) * right
    pose[2, :3] = forward
    pose[2, 3] = distance
    return pose


class ChoyLayout:
    """A tree of these renderings, with clouds that the user has put inside or beside it."""

    has_depth = False

    def __init__(self, root: Path, renderings: Path) -> None:
        self.root = root
        self._renderings = renderings
        beside = (root, renderings, renderings.parent)
        clouds = [base / name for base in beside for name in CLOUD_FOLDERS if (base / name).is_dir()]
        if not clouds:
            raise UserError(
                f"{root} holds pictures but no ground truth: put or link the clouds, <synset>/<model>.ply, at "
                f"{root / tree_files.CLOUDS}; pictures alone can be reconstructed from: "
                f"python -m train reconstruct pretrained {renderings}/SYNSET/MODEL --out DIR"
            )
        self._clouds = clouds[0]
        lists = [base for base in beside if (base / tree_files.LISTS).is_dir()]
        self._lists = lists[0] if lists else None

    def listed(self, split: str) -> dict[str, list[str]]:
        """Synset -> the shapes of the split: from the lists, or without lists by the shapes' names."""
        if self._lists is not None:
            return listed(self._lists, split)
        members: dict[str, list[str]] = {}
        for shape in self.on_disk():
            members.setdefault(shape.split("/")[0], []).append(shape)
        split_of = {synset: tree_files.split_shapes(shapes, seed=0) for synset, shapes in members.items()}
        return {
            synset: [shape for shape in shapes if split_of[synset][shape] == split]
            for synset, shapes in members.items()
        }

    def folder(self, shape: str) -> Path:
        """The folder with the views of a shape."""
        return self._renderings / shape / "rendering"

    def cloud_file(self, shape: str) -> Path:
        """The file with the ground-truth cloud of a shape."""
        return self._clouds / f"{shape}.ply"

    def on_disk(self) -> list[str]:
        """Every shape that has a folder of renderings."""
        folders = sorted(self._renderings.glob(f"{_SYNSET}/*/rendering"))
        return [f"{folder.parent.parent.name}/{folder.parent.name}" for folder in folders]

    def read(self, shape: str) -> Shape:
        """Reads a shape, in the frame of the OBJ files; depth is NaN inside the silhouettes.

        Raises:
            ShapeError: a file is missing or broken, or the files do not fit together.
        """
        folder = self.folder(shape)
        rows = read_file(shape, folder / _METADATA, _read_metadata)
        names = [f"{number:02d}.png" for number in range(len(rows))]
        if (folder / _NAMES).is_file():
            names = read_file(shape, folder / _NAMES, _read_names)
        if len(names) != len(rows):
            raise ShapeError(f"{shape}: {folder}: {len(names)} pictures and {len(rows)} lines of {_METADATA}")
        pictures = [read_file(shape, folder / name, _read_picture) for name in names]
        images, depth = [image for image, _ in pictures], [depth for _, depth in pictures]
        height, width = depth[0].shape
        focal = FOCAL_PER_PIXEL * width
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras = [
            make_camera(K, cam_from_world(azimuth, elevation, in_plane, MAX_DISTANCE * ratio))
            for azimuth, elevation, in_plane, ratio, *_ in rows
        ]
        return assembled(shape, folder, images, depth, cameras, self.cloud_file(shape))


def find_renderings(root: str | Path) -> Path | None:
    """The folder of synsets below `root`, if this is a tree of Choy's renderings."""
    for base in (Path(root), Path(root) / NAME):
        if next(base.glob(f"{_SYNSET}/*/rendering"), None) is not None:
            return base
    return None


def pictures_of(folder: str | Path) -> list[Path]:
    """The pictures of one model, given its folder or the `rendering` in it; empty if it is neither."""
    for base in (Path(folder), Path(folder) / "rendering"):
        if (base / _METADATA).is_file():
            return sorted(base.glob("[0-9]*.png"))
    return []


def _read_metadata(path: Path) -> list[list[float]]:
    rows = [[float(word) for word in line.split()] for line in path.read_text().splitlines() if line.strip()]
    if not rows:
        raise ValueError("no lines")
    for number, row in enumerate(rows, start=1):
        if len(row) < 4 or not np.isfinite(row).all() or row[3] <= 0:
            raise ValueError(
                f"line {number} is not azimuth, elevation, in-plane angle, distance, field of view"
            )
    return rows


def _read_names(path: Path) -> list[str]:
    names = [line.strip() for line in path.read_text().splitlines() if line.strip()]
    for number, name in enumerate(names, start=1):
        if PurePath(name).name != name:
            raise ValueError(f"line {number} is no file name: {name!r}")
    return names


def _read_picture(path: Path) -> tuple[Tensor, Tensor]:
    """(3, H, W) on white, and (H, W): NaN where the alpha channel says that something is seen, +inf elsewhere."""
    pixels = decode(path)
    if pixels.shape[2] not in (2, 4):
        raise ValueError("has no alpha channel to say where the object is")
    top = np.iinfo(pixels.dtype).max
    return on_white(pixels), torch.from_numpy(np.where(pixels[..., -1] > top // 2, np.nan, np.inf)).float()
