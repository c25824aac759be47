"""Are the cloud, the cameras and the depth maps of one shape consistent?

The cloud is projected into every view: nearly all of it must fall into the silhouette, and its visible points must lie
at the depth of the map.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import binary_dilation

from train.data.shape import Shape

MIN_INSIDE = 0.98
MAX_RESIDUAL = 0.015
MIN_COVERED = 0.9
"""Limits for a single shape. A tree is better on average, 99 % and 0.01, but thin cords fall between the pixels of
small maps, and points inside of furniture are visible through its gaps."""
_VIEW_INSIDE, _VIEW_RESIDUAL = 0.9, 0.05
"""Limits for a single view."""
_CELLS = 28
"""Cells along a side of the map: about two of 2048 surface points fall into one, so few see through to the back."""


@dataclasses.dataclass(frozen=True)
class Consistency:
    """How well one shape's cloud, cameras and depth maps fit together.

    Attributes:
        id: "synset/model".
        inside: share of the cloud's points, over all views, that project into the silhouette widened by one pixel.
        residual: median |z - depth map| of the cloud's visible points, world units; NaN without depth maps.
        covered: share of the silhouettes' cells, a 28th of the picture wide, that hold a point of the cloud; a cloud
            that is too small leaves cells empty.
        bad_view: number of the first view that is far off by itself, None if there is none; the other figures are
            over all views and do not show it.
    """

    id: str
    inside: float
    residual: float
    covered: float = 1.0
    bad_view: int | None = None

    @property
    def holds(self) -> bool:
        """True if the files are within the limits of exact ones."""
        return self.bad_view is None and self.within(MIN_INSIDE, MAX_RESIDUAL)

    def within(self, inside: float, residual: float) -> bool:
        """True if at least the share `inside` is inside, and the residual is below `residual`."""
        if self.inside < inside:
            return False
        return self.covered >= MIN_COVERED if np.isnan(self.residual) else self.residual < residual

    def __str__(self) -> str:
        found = f"{self.inside:.1%} of the points in the silhouette"
        if self.bad_view is not None and self.within(MIN_INSIDE, MAX_RESIDUAL):
            return f"view {self.bad_view} is off; over all views {found}"
        if np.isnan(self.residual):
            return f"{found}, {self.covered:.1%} of the silhouette covered by them"
        return f"{found}, visible ones {self.residual:.3f} from the depth map"


class ShapeViews:
    """The views of a shape, prepared for comparing clouds and cameras in several frames with them."""

    def __init__(self, shape: Shape) -> None:
        self.id = shape.id
        self.depth = shape.depth.numpy().astype(np.float64)
        self.silhouettes = ~np.isposinf(self.depth)
        self._wide = np.stack([binary_dilation(each, np.ones((3, 3))) for each in self.silhouettes])
        self._cells = np.stack([_cell_share(each) for each in self.silhouettes]) > 0.5
        self._K = shape.camera.K.double().numpy()
        self._cam_from_world = shape.camera.cam_from_world.double().numpy()
        self._points = shape.points.double().numpy()

    def consistency(self, turn: np.ndarray | None = None, flip: np.ndarray | None = None) -> Consistency:
        """The consistency with the cloud turned by `turn` (3, 3) and the camera axes turned by `flip` (3, 3)."""
        points = self._points if turn is None else self._points @ turn.T
        height, width = self.depth.shape[1:]
        inside, residuals, covered = [], [], []
        for view, depth_map in enumerate(self.depth):
            rotation, shift = self._cam_from_world[view, :3, :3], self._cam_from_world[view, :3, 3]
            seen_from = points @ rotation.T + shift
            if flip is not None:
                seen_from = seen_from @ flip.T
            depth = seen_from[:, 2]
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = self._K[view, :2] @ (seen_from.T / depth)
                framed = (depth > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
            column, row, depth = u[framed].astype(int), v[framed].astype(int), depth[framed]
            inside.append(self._wide[view, row, column].sum() / len(points))

            # Visible points are found from the cloud alone, not from the map they are compared with: the nearest of
            # those that fall into one cell.
            cell = (row * _CELLS // height) * _CELLS + column * _CELLS // width
            by_depth = np.argsort(depth, kind="stable")
            cells, first = np.unique(cell[by_depth], return_index=True)
            nearest = by_depth[first]
            seen = depth_map[row[nearest], column[nearest]]
            residuals.append(np.abs(depth[nearest] - seen)[np.isfinite(seen)])
            full = np.flatnonzero(self._cells[view])
            covered.append(np.isin(full, cells).mean() if full.size else 1.0)
        errors = np.concatenate(residuals)
        medians = [np.median(each) if each.size else 0.0 for each in residuals]
        off = [
            share < _VIEW_INSIDE or median > _VIEW_RESIDUAL
            for share, median in zip(inside, medians, strict=True)
        ]
        if np.isnan(self.depth).any():
            residual = float("nan")
        else:
            residual = float(np.median(errors)) if errors.size else float("inf")
        return Consistency(
            self.id,
            float(np.mean(inside)),
            residual,
            float(np.mean(covered)),
            off.index(True) if any(off) else None,
        )


def measure_consistency(shape: Shape) -> Consistency:
    """Projects the cloud into every view and compares it with mask and depth."""
    return ShapeViews(shape).consistency()


def _cell_share(silhouette: np.ndarray) -> np.ndarray:
    """The share of each of the 28 x 28 cells, row by row, that the silhouette (H, W) fills."""
    height, width = silhouette.shape
    cell = (np.arange(height) * _CELLS // height)[:, None] * _CELLS + np.arange(width) * _CELLS // width
    filled = np.bincount(cell.ravel(), silhouette.ravel(), _CELLS * _CELLS)
    return filled / np.maximum(np.bincount(cell.ravel(), minlength=_CELLS * _CELLS), 1)
