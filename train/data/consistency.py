"""Do clouds, cameras and depth maps agree, and in which axis conventions are they?

A cloud is projected into every view of its shape: nearly all of it must fall into the silhouette, and its visible
points must lie at the depth of the map.

Trees from elsewhere mix conventions: ShapeNet's OBJ files and the clouds sampled from them have y up, Blender's world
has z up, Blender's and OpenGL's cameras look along -z. All ways to name and turn the axes are tried on a few shapes;
that in which clouds and views agree is the right one, by which shapes are converted when they are read.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import torch
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
        off = (
            view
            for view, (share, each) in enumerate(zip(inside, residuals, strict=True))
            if share < _VIEW_INSIDE or (each.size and np.median(each) > _VIEW_RESIDUAL)
        )
        errors = np.concatenate(residuals)
        residual = float(np.median(errors)) if errors.size else np.inf
        if np.isnan(self.depth).any():
            residual = np.nan
        return Consistency(
            self.id, float(np.mean(inside)), residual, float(np.mean(covered)), next(off, None)
        )


def measure_consistency(shape: Shape) -> Consistency:
    """How well the cloud fits masks and depth maps, as the cameras have it."""
    return ShapeViews(shape).consistency()


def _cell_share(silhouette: np.ndarray) -> np.ndarray:
    """The share of each of the 28 x 28 cells, row by row, that the silhouette (H, W) fills."""
    height, width = silhouette.shape
    cell = (np.arange(height) * _CELLS // height)[:, None] * _CELLS + np.arange(width) * _CELLS // width
    filled = np.bincount(cell.ravel(), silhouette.ravel(), _CELLS * _CELLS)
    return filled / np.maximum(np.bincount(cell.ravel(), minlength=_CELLS * _CELLS), 1)


# Axis conventions.

SAMPLE = 6
"""Number of shapes that are tried; one chair may look the same when turned, six shapes seldom do."""

_INSIDE, _RESIDUAL = 0.96, 0.03
"""Limits by which a shape fits a convention; lower than those of `data check`, for trees with inexact cameras."""
_OPENGL = np.diag([1.0, -1.0, -1.0])
_Y_TO_Z_UP = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # what Blender does to an OBJ file

TURNS = sorted(
    (
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ),
    key=lambda turn: (
        -np.linalg.det(turn).round(),
        not np.array_equal(turn, np.eye(3)),
        not np.array_equal(turn, _Y_TO_Z_UP),
        not np.array_equal(turn.T, _Y_TO_Z_UP),
    ),
)
"""The 48 ways to name the axes anew: what is likely first, the mirrored ones last."""


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """How a tree's shapes are converted when they are read: to one world with y up and OpenCV's camera axes.

    Attributes:
        turn_cloud: (3, 3), world from the files of clouds.
        turn_world: (3, 3), world from the world in which the cameras were written down.
        turn_camera: (3, 3), OpenCV's camera axes from those of the files.
        verdict: what was found, in one line.
        settled: False if no convention makes clouds and views agree; nothing is turned then.
    """

    turn_cloud: np.ndarray
    turn_world: np.ndarray
    turn_camera: np.ndarray
    verdict: str
    settled: bool = True

    @property
    def changes(self) -> bool:
        """True if anything has to be turned."""
        return any(
            not np.array_equal(m, np.eye(3)) for m in (self.turn_cloud, self.turn_world, self.turn_camera)
        )

    def applied(self, shape: Shape) -> Shape:
        """The shape, converted."""
        if not self.changes:
            return shape
        camera_turn, world_turn = np.eye(4), np.eye(4)
        camera_turn[:3, :3], world_turn[:3, :3] = self.turn_camera, self.turn_world.T
        pose = torch.from_numpy(camera_turn).float() @ shape.camera.cam_from_world
        camera = dataclasses.replace(shape.camera, cam_from_world=pose @ torch.from_numpy(world_turn).float())
        points = shape.points @ torch.from_numpy(self.turn_cloud).float().T
        return dataclasses.replace(shape, camera=camera, points=points)


AS_IT_IS = Frame(np.eye(3), np.eye(3), np.eye(3), "clouds and cameras are in one frame, y up")


def find_frame(shapes: Sequence[Shape]) -> Frame:
    """The frame in which clouds and views of most of these shapes agree.

    Args:
        shapes: a few, as their files have them; the more they differ the better.
    """
    if not shapes:
        return dataclasses.replace(
            AS_IT_IS, verdict="no readable shape to find the frames from", settled=False
        )
    seen = [ShapeViews(shape) for shape in shapes]
    best: tuple[int, np.ndarray, np.ndarray] = (0, np.eye(3), np.eye(3))
    for turns in (TURNS[:1], TURNS[:24], TURNS[24:]):
        for flip, turn in itertools.product((np.eye(3), _OPENGL), turns):
            votes = sum(each.consistency(turn, flip).within(_INSIDE, _RESIDUAL) for each in seen)
            if votes > best[0]:
                best = (votes, turn, flip)
        if 2 * best[0] > len(shapes):
            return _frame(best[1], best[2], shapes)
    mean = np.mean([each.consistency().inside for each in seen])
    verdict = (
        f"no axis convention makes clouds and views agree ({mean:.0%} of the points in the silhouettes as the files "
        "are); clouds of other models, another scale, or wrong cameras"
    )
    return dataclasses.replace(AS_IT_IS, verdict=verdict, settled=False)


def _frame(turn: np.ndarray, flip: np.ndarray, shapes: Sequence[Shape]) -> Frame:
    """`turn` takes clouds to the cameras' world. Both go to a world with y up; what has y up already is not turned."""
    camera_up = _camera_up(shapes, flip)
    cloud_up = np.round(turn.T @ camera_up)
    y_up, proper = np.array([0.0, 1.0, 0.0]), np.linalg.det(turn) > 0
    if proper and np.array_equal(cloud_up, y_up):
        to_world = turn.T  # the clouds have y up already
    elif np.array_equal(camera_up, y_up):
        to_world = np.eye(3)
    else:
        to_world = next(each for each in TURNS[:24] if np.array_equal(np.round(each @ camera_up), y_up))
    turn_cloud = to_world @ turn
    found = [] if proper else ["clouds are mirrored"]
    if np.array_equal(turn, np.eye(3)):
        found.append(f"clouds and cameras are in one frame, {_name(cloud_up)} up")
    else:
        found.append(f"clouds are {_name(cloud_up)}-up, cameras expect {_name(camera_up)}-up")
        if np.array_equal(cloud_up, camera_up):
            found[-1] += f", turned to each other: cloud {describe(turn)}"
    changes = []
    if not np.array_equal(turn_cloud, np.eye(3)):
        changes.append(f"clouds are turned, (x, y, z) -> {describe(turn_cloud)}")
    if not np.array_equal(to_world, np.eye(3)):
        changes.append(f"cameras are turned, their world (x, y, z) -> {describe(to_world)}")
    if not np.array_equal(flip, np.eye(3)):
        found.append("cameras look along -z (OpenGL, Blender)")
        changes.append("cameras get OpenCV's axes")
    verdict = "; ".join(found)
    if changes:
        verdict += f": {' and '.join(changes)} when they are read"
    return Frame(turn_cloud, to_world, flip, verdict)


def _camera_up(shapes: Sequence[Shape], flip: np.ndarray) -> np.ndarray:
    """The signed axis of the cameras' world that is nearest to what points up in the pictures."""
    poses = np.concatenate([shape.camera.cam_from_world.double().numpy() for shape in shapes])
    up = -np.einsum("ij,vjk->vik", flip, poses[:, :3, :3])[:, 1].mean(0)
    axis = int(np.argmax(np.abs(up)))
    return np.sign(up[axis]) * np.eye(3)[axis]


def describe(turn: np.ndarray) -> str:
    """A turn (3, 3) by the axes that it puts in place of x, y and z.

    Example:
        >>> describe(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
        '(x, -z, y)'
    """
    return f"({', '.join(map(_name, turn))})"


def _name(axis: np.ndarray) -> str:
    return ("-" if axis.min() < 0 else "") + "xyz"[int(np.argmax(np.abs(axis)))]
