"""Reading the files of data trees: that of the paper's release, which this program writes too, and Choy's renderings.

`train.data.tree_files` describes the first. The release differs in details: cameras are MATLAB files (K, extrinsic),
renders have an alpha channel, there is no list for validation, and clouds may keep the folder name under which they are
distributed. The renderings of Choy et al. (3D-R2N2, 2016) are 24 views of 137 x 137 pixels for each model:

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

import json
import re
from collections import ChainMap, defaultdict
from collections.abc import Iterable
from pathlib import Path, PurePath

import numpy as np
import scipy.io
import torch
from torch import Tensor

from diffpoint.io import read_depth
from train.data import tree_files
from train.data.images import decode, on_white
from train.data.shape import Shape, ShapeError, assembled, make_camera, read_file
from train.errors import UserError

MAX_DISTANCE = 1.75
FOCAL_PER_PIXEL = 35 / 32
_CHOY, _METADATA, _NAMES = "ShapeNetRendering", "rendering_metadata.txt", "renderings.txt"
_CLOUD_FOLDERS = (tree_files.CLOUDS, "shape_net_core_uniform_samples_2048")
"""Names of the folder with the clouds; the second is that of the archive in which ShapeNet's are distributed."""
_VALIDATION_SHARE = 0.1
_NUMBERED = re.compile(r"(?:render|depth|camera)_(\d+)\.(?:png|json|mat)")


class Layout:
    """A tree with `rendered-shapenet`, clouds and lists; shapes are named "synset/model"."""

    has_depth = True
    """Whether its shapes can be trained on."""
    _FOLDERS = "*/[!.]*"

    def __init__(self, root: Path) -> None:
        if not (root / tree_files.LISTS).is_dir():
            raise UserError(
                f"the data at {root} are incomplete: no {tree_files.LISTS}; run the command that makes them again"
            )
        self.root, self._renders = root, root / tree_files.RENDERS
        self._lists: Path | None = root / tree_files.LISTS
        self._clouds = _first_folder([root], _CLOUD_FOLDERS) or root / tree_files.CLOUDS

    def listed(self, split: str) -> dict[str, list[str]]:
        """Synset -> the shapes that the split's lists name, whether they exist or not; see `is_shape_id`.

        A tree with lists for training and testing only keeps a tenth of the training shapes for validation, chosen by
        their names. One without lists is split by the names of its shapes.
        """
        if self._lists is None:
            members: dict[str, list[str]] = defaultdict(list)
            for shape in self.on_disk():
                members[shape.split("/")[0]].append(shape)
            split_of = ChainMap(*(tree_files.split_shapes(shapes, seed=0) for shapes in members.values()))
            return {
                synset: [shape for shape in shapes if split_of[shape] == split]
                for synset, shapes in members.items()
            }
        lists = self._lists
        if split != "test" and not (lists / "val").is_dir():
            return {
                synset: [shape for shape in shapes if _is_for_validation(shape) == (split == "val")]
                for synset, shapes in _read_lists(lists / "train").items()
            }
        return _read_lists(lists / split)

    def folder(self, shape: str) -> Path:
        """The folder with the views of a shape."""
        return self._renders / shape

    def cloud_file(self, shape: str) -> Path:
        """The file with the ground-truth cloud of a shape."""
        return self._clouds / f"{shape}.ply"

    def on_disk(self) -> list[str]:
        """Every shape that has a folder, listed or not."""
        folders = sorted(self._renders.glob(self._FOLDERS))
        return ["/".join(folder.relative_to(self._renders).parts[:2]) for folder in folders]

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
        images = [read_file(shape, folder / f"render_{i}.png", _read_picture) for i in range(count)]
        depth = [read_file(shape, folder / f"depth_{i}.png", read_depth) for i in range(count)]
        cameras = [read_file(shape, _camera_file(folder, i), _read_camera) for i in range(count)]
        return assembled(shape, folder, images, depth, cameras, self.cloud_file(shape))


class ChoyLayout(Layout):
    """A tree of Choy's renderings, with clouds that the user has put inside or beside it."""

    has_depth = False
    _FOLDERS = "[0-9]" * 8 + "/*/rendering"

    def __init__(self, root: Path, renderings: Path) -> None:
        self.root, self._renders = root, renderings
        beside = (root, renderings, renderings.parent)
        clouds = _first_folder(beside, _CLOUD_FOLDERS)
        if clouds is None:
            raise UserError(
                f"{root} holds pictures but no ground truth: put or link the clouds, <synset>/<model>.ply, at "
                f"{root / tree_files.CLOUDS}; pictures alone can be reconstructed from: "
                f"python -m train reconstruct pretrained {renderings}/SYNSET/MODEL --out DIR"
            )
        self._clouds = clouds
        self._lists = _first_folder(beside, [tree_files.LISTS])

    def folder(self, shape: str) -> Path:
        """The folder with the views of a shape."""
        return self._renders / shape / "rendering"

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
        pictures = [read_file(shape, folder / name, _read_picture_and_mask) for name in names]
        images, depth = [image for image, _ in pictures], [depth for _, depth in pictures]
        height, width = depth[0].shape
        focal = FOCAL_PER_PIXEL * width
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras = [
            make_camera(K, cam_from_world(azimuth, elevation, in_plane, MAX_DISTANCE * ratio))
            for azimuth, elevation, in_plane, ratio, *_ in rows
        ]
        return assembled(shape, folder, images, depth, cameras, self.cloud_file(shape))


def layout_of(root: str | Path) -> Layout:
    """How the tree at `root` is laid out.

    Raises:
        UserError: there is no tree, or it lacks what it needs.
    """
    root = Path(root)
    if (root / tree_files.RENDERS).is_dir():
        return Layout(root)
    for base in (root, root / _CHOY):
        if next(base.glob(ChoyLayout._FOLDERS), None) is not None:
            return ChoyLayout(root, base)
    raise UserError(
        f"no data at {root}; make some with: python -m train data procedural --out {root} --shapes 400"
    )


def require_depth(roots: Iterable[str | Path]) -> None:
    """Refuses trees that cannot be trained on.

    Raises:
        UserError: a tree has no depth maps, or there is no tree.
    """
    for root in roots:
        if not layout_of(root).has_depth:
            raise UserError(
                f"{root} has no depth maps, and training needs them; such renderings serve reconstruct and evaluate. "
                "To train, render the meshes: python -m train data meshes SHAPENET --out DIR"
            )


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


def pictures_of(folder: str | Path) -> list[Path]:
    """The pictures of one model, given its folder or the `rendering` in it; empty if it is neither."""
    for base in (Path(folder), Path(folder) / "rendering"):
        if (base / _METADATA).is_file():
            return sorted(base.glob("[0-9]*.png"))
    return []


def _first_folder(bases: Iterable[Path], names: Iterable[str]) -> Path | None:
    return next((base / name for base in bases for name in names if (base / name).is_dir()), None)


def _read_lists(folder: Path) -> dict[str, list[str]]:
    found = {}
    for path in sorted(folder.glob("*.list")):
        lines = filter(None, map(str.strip, path.read_text().split("\n")))
        found[path.stem] = [line if "/" in line else f"{path.stem}/{line}" for line in lines]
    return found


def _is_for_validation(shape: str) -> bool:
    return tree_files.hash_fraction(f"validation {shape}") < _VALIDATION_SHARE


def _read_picture(path: Path) -> Tensor:
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


def _read_picture_and_mask(path: Path) -> tuple[Tensor, Tensor]:
    """(3, H, W) on white, and (H, W): NaN where the alpha channel says that something is seen, +inf elsewhere."""
    pixels = decode(path)
    if pixels.shape[2] not in (2, 4):
        raise ValueError("has no alpha channel to say where the object is")
    top = np.iinfo(pixels.dtype).max
    return on_white(pixels), torch.from_numpy(np.where(pixels[..., -1] > top // 2, np.nan, np.inf)).float()
