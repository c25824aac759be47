"""A split of the data in memory, ready for the network, and the sampler that draws batches from it.

Images are kept as bytes at the network's input size; depth maps at the size at which the front constraint
compares, with cameras that fit the smaller maps exactly, so that prediction and observation are made with one
camera.
"""

from __future__ import annotations

import dataclasses
import hashlib
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from diffpoint import PinholeCamera
from train.data import ShapeTree
from train.errors import UserError


class SmallDepth(NamedTuple):
    """Depth maps at the comparison's size, with the cameras that belong to them."""

    depth: Tensor
    camera: PinholeCamera


def decimate_depth(depth: Tensor, camera: PinholeCamera, *, size: int) -> SmallDepth:
    """Keeps one pixel of every f x f block: the one at index f*i + f//2, at its own exact place.

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
    return SmallDepth(depth[:, start::factor, start::factor], _shrink(camera, factor, shift, size))


def min_pool_depth(depth: Tensor, camera: PinholeCamera, *, size: int) -> SmallDepth:
    """Keeps the nearest depth of every f x f block, at the block's centre: what the paper does.

    Args and result as in `decimate_depth`. The nearest surface of a block is seldom at its centre, so the
    observed points are off by up to half a small pixel.
    """
    factor = _factor(depth, size)
    nearest = -F.max_pool2d(-depth[:, None], factor)[:, 0]
    return SmallDepth(nearest, _shrink(camera, factor, 0.0, size))


def _factor(depth: Tensor, size: int) -> int:
    side = depth.shape[-1]
    if depth.shape[-2] != side or side % size:
        got = tuple(depth.shape[-2:])
        raise ValueError(f"depth maps must be square with a side divisible by {size}; got {got}")
    return side // size


def _shrink(camera: PinholeCamera, factor: int, shift: float, size: int) -> PinholeCamera:
    K = camera.K.clone()
    K[..., :2, 2] -= shift
    K[..., :2, :] /= factor
    return PinholeCamera(K, camera.cam_from_world, size, size)


_POOLS = {"decimate": decimate_depth, "min": min_pool_depth}


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedSplit:
    """M shapes with V views each.

    Attributes:
        images: (M, V, 3, h, w) uint8 at the network's input size.
        depth: (M, V, S, S) float32 metric depth, +inf where empty.
        K: (M, V, 3, 3) intrinsics for maps of S x S pixels.
        cam_from_world: (M, V, 4, 4).
        points: (M, P, 3) ground truth in the world frame.
        ids: "synset/model" of every shape.
        categories: category name of every shape.
    """

    images: Tensor
    depth: Tensor
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
        return self.images.shape[1]

    @property
    def fingerprint(self) -> str:
        """Changes when shapes, views or ground truth change."""
        digest = hashlib.sha256("\n".join(self.ids).encode())
        digest.update(np.ascontiguousarray(self.points[:, :8].numpy()).tobytes())
        digest.update(str(tuple(self.images.shape)).encode())
        return digest.hexdigest()[:16]

    def float_images(self, shapes: Tensor, views: Tensor) -> Tensor:
        """(B,) shape and (B, V) view numbers -> (B, V, 3, h, w) images in [0, 1]."""
        return self.images[shapes[:, None], views].float() / 255

    def batch(self, shapes: Tensor, views: Tensor) -> Batch:
        """(B,) shape and (B, V) view numbers -> what one training step needs."""
        picked = (shapes[:, None], views)
        size = self.depth.shape[-1]
        camera = PinholeCamera(self.K[picked], self.cam_from_world[picked], size, size)
        return Batch(self.float_images(shapes, views), self.depth[picked], camera)

    def clouds(self, shapes: Tensor, points: Tensor) -> Tensor:
        """(B,) shape and (B, N) point numbers -> (B, N, 3) of the ground truth."""
        return self.points[shapes[:, None], points]


class Batch(NamedTuple):
    """B shapes with V views each.

    Attributes:
        images: (B, V, 3, h, w) in [0, 1].
        depth: (B, V, S, S) metric depth, +inf where empty.
        camera: (B, V), of the depth maps.
        real: (K, B, N, 3) ground truth clouds for the critic, first those of the B shapes, then of others; None
            without a critic.
    """

    images: Tensor
    depth: Tensor
    camera: PinholeCamera
    real: Tensor | None = None


def load_split(
    data: Path | Sequence[Path],
    split: Literal["train", "val", "test"],
    *,
    image_size: tuple[int, int],
    map_size: int,
    gt_pool: Literal["decimate", "min"] = "decimate",
    categories: Sequence[str] = (),
    limit: int | None = None,
    progress: bool = True,
) -> LoadedSplit:
    """Reads a split of one or more data trees into memory; broken shapes are named and left out.

    Args:
        data: root of the tree, or of each.
        split: which list to read.
        image_size: height and width of the network's input.
        map_size: side of the depth maps for the front constraint.
        gt_pool: how the depth maps shrink.
        categories: names to keep; none means all.
        limit: read at most that many shapes, spread evenly over the lists.
        progress: show a bar.

    Raises:
        UserError: no such tree, no usable shape, or renders whose side is not a multiple of `map_size`.
    """
    trees = [ShapeTree(root, split, list(categories) or None) for root in _roots(data)]
    if limit is not None:
        _thin_out(trees, limit)
    rows: list[_Row] = []
    with tqdm(
        desc=f"reading {split}", total=sum(map(len, trees)), leave=False, unit="shape", disable=not progress
    ) as bar:
        for tree in trees:
            for shape in tree.iter_valid():
                bar.update()
                if (~shape.depth.isfinite()).flatten(1).all(1).any():
                    tree.skipped[shape.id] = f"{shape.id}: one of its views shows nothing"
                    continue
                if shape.depth.shape[-1] % map_size:
                    raise UserError(
                        f"{tree.path}: renders are {shape.depth.shape[-1]} pixels wide, not a multiple of the map "
                        f"size {map_size}; render at another size or set --map-size"
                    )
                small = _POOLS[gt_pool](shape.depth, shape.camera, size=map_size)
                size = (len(shape.depth), len(shape.points))
                images = _bytes_at(shape.images, image_size)
                rows.append(
                    _Row(shape.id, shape.category, size, images, small.depth, small.camera, shape.points)
                )
    skipped = {shape: reason for tree in trees for shape, reason in tree.skipped.items()}
    rows = _of_the_usual_size(rows, skipped)
    for reason in skipped.values():
        tqdm.write(f"left out: {reason}", file=sys.stderr)
    if not rows:
        where = ", ".join(map(str, _roots(data)))
        raise UserError(f"{where}: no usable shape in the {split} split; try `python -m train data check`")
    return LoadedSplit(
        images=torch.stack([row.images for row in rows]),
        depth=torch.stack([row.depth for row in rows]),
        K=torch.stack([row.camera.K for row in rows]),
        cam_from_world=torch.stack([row.camera.cam_from_world for row in rows]),
        points=torch.stack([row.points for row in rows]),
        ids=[row.id for row in rows],
        categories=[row.category for row in rows],
    )


def _roots(data: Path | Sequence[Path]) -> list[Path]:
    return [data] if isinstance(data, Path) else list(data)


def _thin_out(trees: Sequence[ShapeTree], limit: int) -> None:
    """Leaves at most `limit` shapes, spread evenly over all trees."""
    total = sum(map(len, trees))
    if total <= limit:
        return
    kept = {number * total // limit for number in range(limit)}
    start = 0
    for tree in trees:
        ids, tree.ids = tree.ids, [shape for i, shape in enumerate(tree.ids, start) if i in kept]
        start += len(ids)


class _Row(NamedTuple):
    """What is kept of one shape; `size` is how many views and points it has."""

    id: str
    category: str
    size: tuple[int, int]
    images: Tensor
    depth: Tensor
    camera: PinholeCamera
    points: Tensor


def _bytes_at(images: Tensor, size: tuple[int, int]) -> Tensor:
    resized = F.interpolate(images, size=size, mode="bilinear", align_corners=False, antialias=True)
    return (resized.clamp(0, 1) * 255).round().to(torch.uint8)


def _of_the_usual_size(rows: list[_Row], skipped: dict[str, str]) -> list[_Row]:
    """Keeps the shapes with the most common numbers of views and points; names the others in `skipped`."""

    if not rows:
        return rows
    usual = Counter(row.size for row in rows).most_common(1)[0][0]
    for row in rows:
        if row.size != usual:
            skipped[row.id] = f"{row.id}: (views, points) are {row.size}, elsewhere {usual}"
    return [row for row in rows if row.size == usual]


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
