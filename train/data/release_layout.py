"""Reading the tree of the paper's release, which is also the one that this program writes (`train.data.tree_files`).

The release differs in details: cameras are MATLAB files (K, extrinsic), renders have an alpha channel, there is no list
for validation, and clouds may keep the folder name under which they are distributed.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import scipy.io
from torch import Tensor

from diffpoint.io import read_depth
from train.data import tree_files
from train.data.images import decode, on_white
from train.data.shape import Shape, ShapeError, assembled, make_camera, read_file
from train.errors import UserError

CLOUD_FOLDERS = (tree_files.CLOUDS, "shape_net_core_uniform_samples_2048")
"""Names of the folder with the clouds; the second is that of the archive in which ShapeNet's are distributed."""
_VALIDATION_SHARE = 0.1
_NUMBERED = re.compile(r"(?:render|depth|camera)_(\d+)\.(?:png|json|mat)")


def listed(root: str | Path, split: str) -> dict[str, list[str]]:
    """Synset -> "synset/model" of every line of the split's lists, not checked; see `is_shape_id`.

    A tree with lists for training and testing only keeps a tenth of the training shapes for validation, chosen by
    their names.
    """
    lists = Path(root) / tree_files.LISTS
    if (lists / split).is_dir() or (split == "train" and not (lists / "test").is_dir()):
        shapes = _read_lists(lists / split)
        lacks_validation = split == "train" and not (lists / "val").is_dir()
        return _part(shapes, validation=False) if lacks_validation else shapes
    return _part(_read_lists(lists / "train"), validation=True) if split == "val" else {}


def _read_lists(folder: Path) -> dict[str, list[str]]:
    found = {}
    for path in sorted(folder.glob("*.list")):
        lines = filter(None, map(str.strip, path.read_text().split("\n")))
        found[path.stem] = [line if "/" in line else f"{path.stem}/{line}" for line in lines]
    return found


def _part(shapes: dict[str, list[str]], *, validation: bool) -> dict[str, list[str]]:
    return {
        synset: [shape for shape in members if (_fraction(shape) < _VALIDATION_SHARE) == validation]
        for synset, members in shapes.items()
    }


def _fraction(shape: str) -> float:
    return int.from_bytes(hashlib.sha256(f"validation {shape}".encode()).digest()[:8], "big") / 2**64


class ReleaseLayout:
    """A tree with `rendered-shapenet`, clouds and lists."""

    has_depth = True

    def __init__(self, root: Path) -> None:
        if not (root / tree_files.LISTS).is_dir():
            raise UserError(
                f"the data at {root} are incomplete: no {tree_files.LISTS}; run the command that makes them again"
            )
        self.root = root
        clouds = [root / name for name in CLOUD_FOLDERS if (root / name).is_dir()]
        self._clouds = clouds[0] if clouds else root / tree_files.CLOUDS

    def listed(self, split: str) -> dict[str, list[str]]:
        """Synset -> the shapes that the split's lists name."""
        return listed(self.root, split)

    def folder(self, shape: str) -> Path:
        """The folder with the views of a shape."""
        return tree_files.render_folder(self.root, shape)

    def cloud_file(self, shape: str) -> Path:
        """The file with the ground-truth cloud of a shape."""
        return self._clouds / f"{shape}.ply"

    def on_disk(self) -> list[str]:
        """Every shape that has a folder, listed or not."""
        folders = sorted((self.root / tree_files.RENDERS).glob("*/[!.]*"))
        return [f"{folder.parent.name}/{folder.name}" for folder in folders]

    def read(self, shape: str) -> Shape:
        """Reads a shape, as its files have it.

        Raises:
            ShapeError: a file is missing or broken, or the pictures have different sizes.
        """
        folder = self.folder(shape)
        numbers = {int(match[1]) for path in folder.iterdir() if (match := _NUMBERED.fullmatch(path.name))}
        if not numbers:
            raise ShapeError(f"{shape}: no render_*.png in {folder}")
        count = max(numbers) + 1
        images = [read_file(shape, folder / f"render_{i}.png", _read_image) for i in range(count)]
        depth = [read_file(shape, folder / f"depth_{i}.png", read_depth) for i in range(count)]
        cameras = [read_file(shape, _camera_file(folder, i), _read_camera) for i in range(count)]
        return assembled(shape, folder, images, depth, cameras, self.cloud_file(shape))


def _read_image(path: Path) -> Tensor:
    """(3, H, W) in [0, 1]; transparency shows white."""
    return on_white(decode(path))


def _camera_file(folder: Path, view: int) -> Path:
    matlab = folder / f"camera_{view}.mat"
    return matlab if matlab.is_file() else folder / f"camera_{view}.json"


def _read_camera(path: Path) -> tuple[Tensor, Tensor]:
    """K (3, 3) and cam_from_world (4, 4), from our JSON or from the release's .mat (K, extrinsic)."""
    if path.suffix == ".mat":
        record = scipy.io.loadmat(path)
        pose = np.eye(4)
        pose[:3] = np.asarray(record["extrinsic"], float)[:3]
        return make_camera(record["K"], pose)
    record = json.loads(path.read_text())
    return make_camera(record["K"], record["cam_from_world"])
