"""A split of the data, ready for the network, and the sampler that draws batches from it.

Images are kept as bytes at the network's input size; depth maps at the size at which the front constraint
compares, with cameras that fit the smaller maps exactly, so that prediction and observation share one camera. Both are
compressed (train/data/packed.py) and mapped from files (train/data/cache.py): a batch reads its own views only.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from diffpoint import PinholeCamera
from train.data.augment import FramedViews, StoredViews
from train.data.cache import prepare
from train.data.packed import PackedShape, PackedViews
from train.data.shrink import Pool, Sizes
from train.data.tree import ShapeTree
from train.device import CPU, moved, room_for_views
from train.errors import UserError
from train.files import as_paths


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedSplit:
    """M shapes with V views each, on one device. Shape and view numbers are given on the CPU, where they are drawn.

    Attributes:
        images: M of (V, 3, h, w) uint8, packed or a tensor, at the network's input size.
        depth: M of (V, S, S) float32, packed or a tensor: metric depth, +inf where empty.
        K: (M, V, 3, 3) intrinsics for maps of S x S pixels.
        cam_from_world: (M, V, 4, 4).
        points: (M, P, 3) ground truth in the world frame.
        ids: "synset/model" of every shape.
        categories: category name of every shape.
    """

    images: Sequence[StoredViews] | Tensor
    depth: Sequence[PackedViews] | Tensor
    K: Tensor
    cam_from_world: Tensor
    points: Tensor
    ids: list[str]
    categories: list[str]

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def views(self) -> int:
        """Views per shape."""
        return self.images[0].shape[0]

    @property
    def device(self) -> torch.device:
        """On which batches are made."""
        return self.points.device

    def to(self, device: torch.device, *, room: float | None = None) -> LoadedSplit:
        """The split on another device. All its views are decompressed and kept there, if there is room for them.

        If there is not, they stay packed on the CPU, and those of a batch are decompressed and copied when it is made.

        Args:
            device: where batches shall be.
            room: bytes that views may take on a GPU; by default 40 % of its free memory.
        """
        if device == self.device:
            return self
        moving = {name: getattr(self, name).to(device) for name in ("K", "cam_from_world", "points")}
        packed = [name for name in ("images", "depth") if not isinstance(getattr(self, name), Tensor)]
        room = room_for_views(device) if room is None else room
        if device != CPU and sum(_unpacked_bytes(getattr(self, name)) for name in packed) <= room:
            moving |= {name: _unpacked(getattr(self, name), device) for name in packed}
        for name in {"images", "depth"} - set(packed):
            moving[name] = getattr(self, name).to(device)
        return dataclasses.replace(self, **moving)

    def framed(self) -> LoadedSplit:
        """The same with pictures framed as photographs are: the object in the middle, as large as the frame allows."""
        return dataclasses.replace(self, images=[FramedViews(views) for views in self.images])

    @property
    def fingerprint(self) -> str:
        """Changes when shapes, views or ground truth change."""
        digest = hashlib.sha256("\n".join(self.ids).encode())
        digest.update(np.ascontiguousarray(self.points[:, :8].cpu().numpy()).tobytes())
        digest.update(str((len(self), *self.images[0].shape)).encode())
        return digest.hexdigest()[:16]

    def float_images(self, shapes: Tensor, views: Tensor) -> Tensor:
        """(B,) shape and (B, V) view numbers -> (B, V, 3, h, w) images in [0, 1]."""
        return self._picked(self.images, shapes, views).float() / 255

    def batch(self, shapes: Tensor, views: Tensor) -> Batch:
        """(B,) shape and (B, V) view numbers -> a batch."""
        depth, camera = self._depth_maps(shapes, views)
        return Batch(self.float_images(shapes, views), depth, camera)

    def targets(self, shapes: Tensor) -> Targets:
        """(B,) shape numbers -> their whole surfaces and all of their views."""
        depth, camera = self._depth_maps(shapes, torch.arange(self.views).expand(len(shapes), -1))
        return Targets(self.points[moved(shapes, self.device)], depth, camera)

    def _depth_maps(self, shapes: Tensor, views: Tensor) -> tuple[Tensor, PinholeCamera]:
        picked = moved(shapes[:, None], self.device), moved(views, self.device)
        size = self.depth[0].shape[-1]
        camera = PinholeCamera(self.K[picked], self.cam_from_world[picked], size, size)
        return self._picked(self.depth, shapes, views), camera

    def clouds(self, shapes: Tensor, points: Tensor) -> Tensor:
        """(B,) shape and (B, N) point numbers -> (B, N, 3) of the ground truth."""
        return self.points[moved(shapes[:, None], self.device), moved(points, self.device)]

    def _picked(self, values: Sequence[StoredViews] | Tensor, shapes: Tensor, views: Tensor) -> Tensor:
        """M of (V, ...), (B,) shape and (B, V') view numbers -> (B, V', ...)."""
        if isinstance(values, Tensor):
            return values[moved(shapes[:, None], self.device), moved(views, self.device)]
        picked = [values[shape][chosen] for shape, chosen in zip(shapes.tolist(), views, strict=True)]
        return moved(torch.stack(picked), self.device)


def _unpacked_bytes(values: Sequence[StoredViews]) -> int:
    return len(values) * math.prod(values[0].shape) * values[0].dtype.itemsize


def _unpacked(values: Sequence[StoredViews], device: torch.device) -> Tensor:
    """(M, V, ...)."""
    found = torch.empty((len(values), *values[0].shape), dtype=values[0].dtype, device=device)
    for into, packed in zip(found, values, strict=True):
        into.copy_(packed[:])
    return found


class Targets(NamedTuple):
    """The ground truth of B shapes: points on the whole surface, and all V views that the data have.

    Attributes:
        points: (B, P, 3) on the surface, world frame.
        depth: (B, V, S, S) metric depth, +inf where empty.
        camera: (B, V), of the depth maps.
    """

    points: Tensor
    depth: Tensor
    camera: PinholeCamera


class Batch(NamedTuple):
    """B shapes with V views each.

    Attributes:
        images: (B, V, 3, h, w) in [0, 1].
        depth: (B, V, S, S) metric depth, +inf where empty.
        camera: (B, V), of the depth maps.
        real: (K, B, N, 3) ground truth clouds for the critic, first those of the B shapes, then of others; None
            without a critic.
        targets: the same shapes, for methods that learn from more than the images' own depth maps; else None.
    """

    images: Tensor
    depth: Tensor
    camera: PinholeCamera
    real: Tensor | None = None
    targets: Targets | None = None


def load_split(
    data: str | Path | Sequence[str | Path],
    split: Literal["train", "val", "test"],
    *,
    image_size: tuple[int, int],
    map_size: int,
    gt_pool: Pool = "decimate",
    categories: Sequence[str] = (),
    limit: int | None = None,
    progress: bool = True,
) -> LoadedSplit:
    """Opens a split of one or more data trees; broken shapes are named on stderr and left out.

    The first time, its pictures are decoded, and what is made of them is kept; see train/data/cache.py.

    Args:
        data: root of the tree, or of each.
        split: which list to read.
        image_size: height and width of the network's input.
        map_size: side of the depth maps for the front constraint.
        gt_pool: how the depth maps shrink.
        categories: names to keep; none means all.
        limit: read at most that many shapes, spread evenly over the lists.
        progress: show bars.

    Raises:
        UserError: no such tree, no usable shape, or renders whose side is not a multiple of `map_size`.
    """
    roots = as_paths(data)
    trees = [ShapeTree(root, split, list(categories) or None) for root in roots]
    total = sum(map(len, trees))
    if limit is not None and total > limit:
        kept, start = {number * total // limit for number in range(limit)}, 0
        for tree in trees:
            start, tree.ids = start + len(tree), [name for i, name in enumerate(tree.ids, start) if i in kept]
    sizes = Sizes(image_size, map_size, gt_pool)
    shapes: list[PackedShape] = []
    for tree in trees:
        prepared = prepare(tree.path, tree.ids, sizes, name=split, progress=progress)
        for name in tree.ids:
            small = prepared[name]
            if isinstance(small, PackedShape):
                shapes.append(small)
            else:
                tree.skipped[name] = str(small)
    skipped = {shape: reason for tree in trees for shape, reason in tree.skipped.items()}
    sizes_of = [(len(shape.images), len(shape.points)) for shape in shapes]
    usual = Counter(sizes_of).most_common(1)[0][0] if shapes else None
    for shape, size in zip(shapes, sizes_of, strict=True):
        if size != usual:
            skipped[shape.id] = f"{shape.id}: (views, points) are {size}, elsewhere {usual}"
    shapes = [shape for shape, size in zip(shapes, sizes_of, strict=True) if size == usual]
    for reason in skipped.values():
        tqdm.write(f"left out: {reason}", file=sys.stderr)
    if not shapes:
        where = ", ".join(map(str, roots))
        raise UserError(f"{where}: no usable shape in the {split} split; try `python -m train data check`")
    return LoadedSplit(
        images=[shape.images for shape in shapes],
        depth=[shape.depth for shape in shapes],
        K=torch.stack([shape.camera.K for shape in shapes]),
        cam_from_world=torch.stack([shape.camera.cam_from_world for shape in shapes]),
        points=torch.stack([shape.points for shape in shapes]),
        ids=[shape.id for shape in shapes],
        categories=[shape.category for shape in shapes],
    )


class Sampler:
    """Draws shapes (without repetition inside a batch) and views; its state can be kept and put back."""

    def __init__(self, shapes: int, views: int, *, seed: int) -> None:
        self._shapes, self._views = shapes, views
        self._random = np.random.default_rng(seed)

    def draw(self, shapes: int, views: int) -> tuple[Tensor, Tensor]:
        """(B,) shape numbers and (B, V) view numbers; a split smaller than the batch repeats its shapes."""
        picked = self._random.choice(self._shapes, size=shapes, replace=shapes > self._shapes)
        angles = np.stack([self._random.permutation(self._views)[:views] for _ in range(shapes)])
        return torch.from_numpy(picked), torch.from_numpy(angles)

    def draw_points(self, shapes: int, count: int, *, of: int) -> Tensor:
        """(B, N) point numbers: for each shape a random `count` of its `of` points, or all of them in any order."""
        orders = [self._random.permutation(of)[:count] for _ in range(shapes)]
        return torch.from_numpy(np.stack(orders))

    def state(self) -> dict[str, Any]:
        """Everything that decides the next draws."""
        return dict(self._random.bit_generator.state)

    def restore(self, state: dict[str, Any]) -> None:
        """Continues where `state` was taken."""
        self._random.bit_generator.state = state
