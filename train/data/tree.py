"""Reading the dataset on disk: `Shape` and `ShapeTree`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import scipy.io
import torch
from torch import Tensor
from tqdm import tqdm

from diffpoint.camera import PinholeCamera
from diffpoint.io import read_depth, read_points
from train.data import store
from train.data.categories import CATEGORY_OF, SYNSET_OF, category_of, synset_of
from train.errors import UserError
from train.images import on_white


class ShapeError(UserError):
    """A shape that cannot be read; the message names the shape, the file and the reason."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """One object: its views, their cameras and its surface.

    Attributes:
        images: (V, 3, H, W) float32 in [0, 1], on white.
        depth: (V, H, W) float32, z in the camera frame; +inf where nothing is seen.
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


class ShapeTree:
    """The shapes of one split; `tree[i]` reads shape i from disk.

    A broken shape raises `ShapeError` from `tree[i]`; `iter_valid` and `load_all` leave it out, and `skipped`
    names it with the reason. Shapes without files are found at once and are not counted in `len(tree)`.

    Args:
        path: a folder made by `python -m train data`, or the paper's release.
        split: "train", "val" or "test".
        categories: names or synsets to keep; all by default.

    Raises:
        UserError: no data at `path`, or no such split or category.
    """

    def __init__(
        self, path: str | Path, split: str = "train", categories: Sequence[str] | None = None
    ) -> None:
        self.path = Path(path)
        self.split = split
        self.skipped: dict[str, str] = {}
        if split not in store.SPLITS:
            raise UserError(f"ShapeTree: split must be one of {', '.join(store.SPLITS)}; got {split!r}")
        synsets = self._synsets(categories)
        self.ids: list[str] = []
        for synset in synsets:
            lines = (self.path / store.LISTS / split / f"{synset}.list").read_text().split("\n")
            for shape in filter(None, map(str.strip, lines)):
                reason = self._missing(shape)
                if reason:
                    self.skipped[shape] = reason
                else:
                    self.ids.append(shape)

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Shape:
        return read_shape(self.path, self.ids[index])

    def iter_valid(self) -> Iterator[Shape]:
        """The shapes that can be read, in order; the others go to `skipped`."""
        for shape in self.ids:
            try:
                yield read_shape(self.path, shape)
            except ShapeError as error:
                self.skipped[shape] = str(error)

    def load_all(self, *, progress: bool = True) -> list[Shape]:
        """Read every shape into memory; the broken ones are named on the progress line and in `skipped`.

        Raises:
            UserError: not a single shape can be read.
        """
        bar = tqdm(
            self.iter_valid(),
            total=len(self),
            desc=f"reading {self.split}",
            unit="shape",
            disable=not progress,
        )
        shapes = list(bar)
        if progress:
            for reason in self.skipped.values():
                bar.write(f"skipped: {reason}")
        if not shapes:
            first = next(iter(self.skipped.values()), "the lists are empty")
            raise UserError(f"{self.path} has no readable shape in the {self.split} split ({first})")
        return shapes

    def _synsets(self, categories: Sequence[str] | None) -> list[str]:
        lists = self.path / store.LISTS
        if not (self.path / store.RENDERS).is_dir():
            raise UserError(
                f"no data at {self.path}; make some with: "
                f"python -m train data procedural --out {self.path} --shapes 400"
            )
        if not lists.is_dir():
            raise UserError(
                f"the data at {self.path} are not finished; run the command that makes them again"
            )
        present = sorted(path.stem for path in (lists / self.split).glob("*.list"))
        if categories is None:
            return present
        wanted = [name if name in CATEGORY_OF else synset_of(name) for name in categories]
        for name, synset in zip(categories, wanted, strict=True):
            if synset not in present:
                known = ", ".join(category_of(each) for each in present) or "none"
                spelling = "" if name in SYNSET_OF or name in CATEGORY_OF else " (is it spelt right?)"
                raise UserError(f"{self.path} has no category {name!r}{spelling}; it has: {known}")
        return wanted

    def _missing(self, shape: str) -> str | None:
        if not store.render_folder(self.path, shape).is_dir():
            return f"{shape}: no folder {store.render_folder(self.path, shape)}"
        if not store.cloud_file(self.path, shape).is_file():
            return f"{shape}: no file {store.cloud_file(self.path, shape)}"
        return None


def read_shape(root: Path, shape: str) -> Shape:
    """Read the shape "synset/model".

    Raises:
        ShapeError: a file is missing or broken, or the files do not fit together.
    """
    folder = store.render_folder(root, shape)
    count = len(list(folder.glob("render_*.png")))
    if count == 0:
        raise ShapeError(f"{shape}: no render_*.png in {folder}")
    images = [_read(shape, folder / f"render_{i}.png", _read_image) for i in range(count)]
    depth = [_read(shape, folder / f"depth_{i}.png", read_depth) for i in range(count)]
    size = images[0].shape[1:]
    for i in range(count):
        if images[i].shape[1:] != size or depth[i].shape != size:
            raise ShapeError(
                f"{shape}: {folder}: the pictures of view {i} are {tuple(images[i].shape[1:])} and "
                f"{tuple(depth[i].shape)} pixels, view 0 is {tuple(size)}"
            )
    cameras = [_read(shape, _camera_file(folder, i), _read_camera) for i in range(count)]
    return Shape(
        images=torch.stack(images),
        depth=torch.stack(depth),
        camera=PinholeCamera(
            torch.stack([K for K, _ in cameras]), torch.stack([pose for _, pose in cameras]), size[0], size[1]
        ),
        points=_read(shape, store.cloud_file(root, shape), read_points),
        id=shape,
        category=category_of(shape.split("/")[0]),
    )


def _read(shape: str, path: Path, reader):
    try:
        return reader(path)
    except FileNotFoundError as error:
        raise ShapeError(f"{shape}: {path} is missing") from error
    except Exception as error:  # every decoder has its own way to say that a file is broken
        raise ShapeError(f"{shape}: {path} cannot be read ({type(error).__name__}: {error})") from error


def _read_image(path: Path) -> Tensor:
    """(3, H, W) in [0, 1]; transparency shows white."""
    return on_white(np.atleast_3d(imageio.imread(path)))


def _camera_file(folder: Path, view: int) -> Path:
    matlab = folder / f"camera_{view}.mat"
    return matlab if matlab.is_file() else folder / f"camera_{view}.json"


def _read_camera(path: Path) -> tuple[Tensor, Tensor]:
    """K (3, 3) and cam_from_world (4, 4), from our JSON or from the release's .mat (K, extrinsic)."""
    if path.suffix == ".mat":
        record = scipy.io.loadmat(path)
        extrinsic = np.asarray(record["extrinsic"], np.float32)
        pose = np.concatenate((extrinsic[:3], np.array([[0, 0, 0, 1]], np.float32)))
    else:
        record = json.loads(path.read_text())
        pose = np.array(record["cam_from_world"], np.float32)
    K = np.array(record["K"], np.float32)
    PinholeCamera(torch.from_numpy(K), torch.from_numpy(pose), 1, 1)  # refuses what is no camera
    return torch.from_numpy(K), torch.from_numpy(pose)
