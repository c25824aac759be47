"""The axis conventions of a tree's clouds and cameras: found by trying all of them, converted when shapes are read.

Trees from elsewhere mix conventions: ShapeNet's OBJ files and the clouds sampled from them have y up, Blender's world
has z up, Blender's and OpenGL's cameras look along -z. Of all ways to name and turn the axes, the right one puts the
cloud into the silhouettes and its visible points at the depth of the maps.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import torch

from train.data.consistency import ShapeViews
from train.data.shape import Shape

SAMPLE = 6
"""Number of shapes that are tried; one chair may look the same when turned, six shapes seldom do."""

_INSIDE, _RESIDUAL = 0.96, 0.03
"""Limits by which a shape fits a convention; lower than those of `data check`, for trees with inexact cameras."""
_OPENGL = np.diag([1.0, -1.0, -1.0])
_AXES = "xyz"


def _turns() -> list[np.ndarray]:
    """The 48 ways to name the axes anew: what is likely first, the mirrored ones last."""
    likely = [
        np.eye(3),
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ]
    every = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    rest = [turn for turn in every if not any(np.array_equal(turn, known) for known in likely)]
    return likely + sorted(rest, key=lambda turn: -np.linalg.det(turn))


TURNS = _turns()


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
    return Frame(turn_cloud, to_world, flip, _verdict(turn, flip, turn_cloud, to_world, cloud_up, camera_up))


def _camera_up(shapes: Sequence[Shape], flip: np.ndarray) -> np.ndarray:
    """The signed axis of the cameras' world that is nearest to what points up in the pictures."""
    poses = np.concatenate([shape.camera.cam_from_world.double().numpy() for shape in shapes])
    up = -np.einsum("ij,vjk->vik", flip, poses[:, :3, :3])[:, 1].mean(0)
    axis = int(np.argmax(np.abs(up)))
    return np.sign(up[axis]) * np.eye(3)[axis]


def _verdict(
    turn: np.ndarray,
    flip: np.ndarray,
    turn_cloud: np.ndarray,
    to_world: np.ndarray,
    cloud_up: np.ndarray,
    camera_up: np.ndarray,
) -> str:
    found = []
    if np.linalg.det(turn) < 0:
        found.append("clouds are mirrored")
    if np.array_equal(turn, np.eye(3)):
        found.append(f"clouds and cameras are in one frame, {_name(cloud_up)} up")
    else:
        found.append(f"clouds are {_name(cloud_up)}-up, cameras expect {_name(camera_up)}-up")
        if np.array_equal(cloud_up, camera_up):
            found[-1] += f", turned to each other: cloud {describe(turn)}"
    if not np.array_equal(flip, np.eye(3)):
        found.append("cameras look along -z (OpenGL, Blender)")
    changes = []
    if not np.array_equal(turn_cloud, np.eye(3)):
        changes.append(f"clouds are turned, (x, y, z) -> {describe(turn_cloud)}")
    if not np.array_equal(to_world, np.eye(3)):
        changes.append(f"cameras are turned, their world (x, y, z) -> {describe(to_world)}")
    if not np.array_equal(flip, np.eye(3)):
        changes.append("cameras get OpenCV's axes")
    line = "; ".join(found)
    return f"{line}: {' and '.join(changes)} when they are read" if changes else line


def describe(turn: np.ndarray) -> str:
    """A turn (3, 3) by the axes that it puts in place of x, y and z.

    Example:
        >>> describe(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
        '(x, -z, y)'
    """
    names = [("-" if row.min() < 0 else "") + _AXES[int(np.argmax(np.abs(row)))] for row in turn]
    return f"({', '.join(names)})"


def _name(axis: np.ndarray) -> str:
    return ("-" if axis.min() < 0 else "") + _AXES[int(np.argmax(np.abs(axis)))]
