"""Is a dataset whole, and do its cameras, depth maps and clouds speak of the same objects?"""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation
from tqdm import tqdm

from train.data import store
from train.data.categories import category_of
from train.data.tree import Shape, ShapeError, ShapeTree, read_shape

MIN_INSIDE = 0.99
MAX_RESIDUAL = 0.01
_CELLS = 28
"""Cells along a side of the map: about two of 2048 surface points fall into one, so few see through to the back."""


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How one shape's files fit together.

    Attributes:
        id: "synset/model".
        inside: share of the cloud's points, over all views, that project into the silhouette widened by one pixel.
        residual: median |z - depth map| of the cloud's visible points, world units.
    """

    id: str
    inside: float
    residual: float

    @property
    def holds(self) -> bool:
        """True if the files agree as well as exact ones do."""
        return self.inside >= MIN_INSIDE and self.residual < MAX_RESIDUAL


@dataclasses.dataclass(frozen=True)
class TreeReport:
    """What `check_tree` found."""

    path: Path
    counts: dict[str, int]
    categories: dict[str, int]
    agreements: tuple[Agreement, ...]
    problems: list[str]

    @property
    def inside(self) -> float:
        """Mean over the shapes that can be read."""
        return float(np.mean([each.inside for each in self.agreements])) if self.agreements else float("nan")

    @property
    def residual(self) -> float:
        """Median over the shapes that can be read."""
        return (
            float(np.median([each.residual for each in self.agreements])) if self.agreements else float("nan")
        )

    def summary(self) -> str:
        """Lines for the terminal."""
        splits = ", ".join(f"{count} {split}" for split, count in self.counts.items())
        kinds = ", ".join(f"{count} {name}" for name, count in self.categories.items())
        agree = sum(each.holds for each in self.agreements)
        lines = [
            f"{self.path}: {len(self.agreements)} shapes can be read ({splits}): {kinds}",
            f"cameras, depth and clouds agree in {agree} of them: {self.inside:.2%} of the points project into the "
            f"silhouette, visible ones are {self.residual:.4f} from the depth map",
        ]
        if self.problems:
            lines += [f"{len(self.problems)} problems:", *(f"  {problem}" for problem in self.problems)]
        else:
            lines.append("no problems")
        return "\n".join(lines)


def check_tree(path: str | Path) -> TreeReport:
    """Read every shape of every split; name what is missing, broken, listed twice or does not agree.

    Raises:
        UserError: no dataset at `path`.
    """
    root = Path(path)
    trees = {split: ShapeTree(root, split) for split in store.SPLITS}
    problems = [reason for tree in trees.values() for reason in tree.skipped.values()]
    listed = Counter(shape for tree in trees.values() for shape in (*tree.ids, *tree.skipped))
    problems += [f"{shape}: listed {count} times" for shape, count in listed.items() if count > 1]
    for folder in sorted((root / store.RENDERS).glob("*/[!.]*")):
        shape = f"{folder.parent.name}/{folder.name}"
        if shape not in listed:
            problems.append(f"{shape}: in no list; run the command that made the data again")
    agreements = []
    shapes = list(dict.fromkeys(shape for tree in trees.values() for shape in tree.ids))
    for shape in tqdm(shapes, desc="checking", unit="shape"):
        try:
            found = agreement(read_shape(root, shape))
        except ShapeError as error:
            problems.append(str(error))
            continue
        agreements.append(found)
        if not found.holds:
            problems.append(
                f"{shape}: cameras, depth and cloud do not agree ({found.inside:.1%} of the points inside the "
                f"silhouette, visible ones {found.residual:.3f} from the depth map)"
            )
    categories = Counter(category_of(each.id.split("/")[0]) for each in agreements)
    readable = {each.id for each in agreements}
    counts = {split: len(readable.intersection(tree.ids)) for split, tree in trees.items()}
    return TreeReport(root, counts, dict(categories), tuple(agreements), problems)


def agreement(shape: Shape) -> Agreement:
    """Project the cloud into every view and compare it with mask and depth.

    Visible points are found from the cloud alone, not from the depth map they are compared with: of the points that
    fall into one cell of a coarse grid, the nearest.
    """
    depth_maps = shape.depth.numpy().astype(np.float64)
    height, width = depth_maps.shape[1:]
    points = np.concatenate((shape.points.numpy(), np.ones((len(shape.points), 1))), axis=1)
    inside, residuals = [], []
    for projection, depth_map in zip(shape.camera.projection.double().numpy(), depth_maps, strict=True):
        u, v, depth = projection @ points.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.stack((u / depth, v / depth))
        framed = (depth > 0) & (pixels >= 0).all(0) & (pixels[0] < width) & (pixels[1] < height)
        column, row = pixels[:, framed].astype(int)
        depth = depth[framed]
        silhouette = np.isfinite(depth_map)
        inside.append(binary_dilation(silhouette, np.ones((3, 3)))[row, column].sum() / len(points))

        cell = (row * _CELLS // height) * _CELLS + column * _CELLS // width
        by_depth = np.argsort(depth, kind="stable")
        nearest = by_depth[np.unique(cell[by_depth], return_index=True)[1]]
        seen = depth_map[row[nearest], column[nearest]]
        residuals.append(np.abs(depth[nearest] - seen)[np.isfinite(seen)])
    errors = np.concatenate(residuals)
    return Agreement(
        shape.id, float(np.mean(inside)), float(np.median(errors)) if errors.size else float("inf")
    )
