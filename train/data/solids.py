"""Closed coloured solids, functions that make them, and uniform samples of the outer surface of their union.

Most shapes are lofts: closed rings of corners, joined one to the next. `box`, `bar`, `revolved`, `ellipsoid`, `tube`,
`body` and `wing` are lofts through rings of a kind. Units are the world's, y is up.

Example:
    >>> import numpy as np
    >>> ball = ellipsoid((0.2, 0.1, 0.1), (0, 0, 0), np.ones(3))
    >>> ball.vertices.max(0).round(3).tolist()
    [0.2, 0.1, 0.1]
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from train.data.surface import Surface, sample_triangles

_STRICTLY_INSIDE = 1e-6
"""World units; a point on a face shared by two flush solids is not inside either."""

_SIDES = 16

Point = Sequence[float] | np.ndarray


@dataclasses.dataclass(frozen=True)
class Solid:
    """A closed solid of one colour.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3), wound outward.
        colour: (3,) RGB in [0, 1].
        pieces: indices of vertices; the solid is the union of the convex hulls of its pieces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    pieces: tuple[np.ndarray, ...]

    def scaled(self, factor: float) -> Solid:
        """The solid scaled about the origin."""
        return dataclasses.replace(self, vertices=self.vertices * factor)

    def moved(self, offset: Point) -> Solid:
        """The solid moved by `offset`."""
        return dataclasses.replace(self, vertices=self.vertices + np.asarray(offset, float))

    def turned(self, axis: str, angle_deg: float, about: Point = (0.0, 0.0, 0.0)) -> Solid:
        """The solid turned about a line through `about` along "x", "y" or "z", by the right-hand rule."""
        first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        rotation, angle = np.eye(3), np.radians(angle_deg)
        rotation[first, first] = rotation[second, second] = np.cos(angle)
        rotation[first, second], rotation[second, first] = -np.sin(angle), np.sin(angle)
        return dataclasses.replace(self, vertices=(self.vertices - about) @ rotation.T + about)

    def mirrored(self) -> Solid:
        """The solid on the other side of x = 0."""
        return dataclasses.replace(self, vertices=self.vertices * (-1, 1, 1), faces=self.faces[:, ::-1])

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) are strictly inside."""
        inside = np.zeros(len(points), bool)
        for low, high, normals, offsets in self._halfspaces:
            near = np.flatnonzero(((points > low) & (points < high)).all(1) & ~inside)
            inside[near] = (points[near] @ normals.T < offsets - _STRICTLY_INSIDE).all(1)
        return inside

    @functools.cached_property
    def _halfspaces(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Of each piece: its bounding box, and unit normals and offsets with normal . x < offset inside."""
        found = []
        for piece in self.pieces:
            corners = self.vertices[piece]
            planes = ConvexHull(corners).equations
            found.append((corners.min(0), corners.max(0), planes[:, :3], -planes[:, 3]))
        return found


def loft(rings: Sequence[np.ndarray], colour: np.ndarray) -> Solid:
    """The solid through rings of corners (n, 3), closed by the first and the last.

    Each ring, and what lies between two neighbours, must be convex; the whole need not be.
    """
    count = len(rings[0])
    corner = np.arange(count)
    after = np.roll(corner, -1)
    fan = np.stack((np.zeros(count - 2, int), corner[1:-1], corner[2:]), axis=1)
    faces = [fan[:, ::-1], fan + count * (len(rings) - 1)]
    for level in range(len(rings) - 1):
        low, high = level * count, (level + 1) * count
        faces.append(np.stack((low + corner, low + after, high + after), axis=1))
        faces.append(np.stack((low + corner, high + after, high + corner), axis=1))
    vertices = np.concatenate(rings).astype(float)
    pieces = tuple(np.arange(k * count, (k + 2) * count) for k in range(len(rings) - 1))
    return Solid(vertices, _outward(vertices, np.concatenate(faces)), np.asarray(colour, float), pieces)


def box(size: Point, centre: Point, colour: np.ndarray) -> Solid:
    """An axis-aligned box."""
    ends = (centre[2] + side * size[2] / 2 for side in (-1, 1))
    return loft([rectangle(size[0], size[1], centre[0], centre[1], z) for z in ends], colour)


def rectangle(width: float, height: float, x: float, y: float, z: float) -> np.ndarray:
    """The corners (4, 3) of a rectangle across the z axis, centred at (x, y, z)."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    return np.column_stack((corners * (width, height) + (x, y), np.full(4, z)))


def oval(
    width: float, height: float, centre: Point, *, squareness: float = 2.0, sides: int = _SIDES
) -> np.ndarray:
    """The corners (sides, 3) of a superellipse across the z axis: squareness 2 is an ellipse, 10 nearly a rectangle."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    x, y = (np.sign(f) * np.abs(f) ** (2 / squareness) / 2 for f in (np.cos(angle), np.sin(angle)))
    return np.stack((x * width, y * height, np.zeros(sides)), axis=1) + np.asarray(centre, float)


def body(stations: Sequence[Sequence[float]], colour: np.ndarray, *, squareness: float = 2.0) -> Solid:
    """A long rounded body, such as a hull: stations (z, width, low, high) along z, symmetric about x = 0."""
    return loft(
        [
            oval(width, high - low, (0, (low + high) / 2, z), squareness=squareness)
            for z, width, low, high in stations
        ],
        colour,
    )


def slab(outline: np.ndarray, low: float, high: float, colour: np.ndarray) -> Solid:
    """A plate: the convex outline (n, 2) in x and z, between the heights `low` and `high`."""
    return loft([np.insert(outline, 1, y, axis=1) for y in (low, high)], colour)


def bar(start: Point, end: Point, radius: float, colour: np.ndarray, *, sides: int = 10) -> Solid:
    """A round bar from `start` to `end`."""
    return tube([start, end], [radius, radius], colour, sides=sides)


def frustum(start: Point, end: Point, radii: tuple[float, float], colour: np.ndarray) -> Solid:
    """A cone cut off: round, from one radius to another."""
    return tube([start, end], radii, colour, sides=_SIDES)


def revolved(
    profile: Sequence[tuple[float, float]],
    base: Point,
    colour: np.ndarray,
    *,
    axis: Point = (0, 1, 0),
    sides: int = 20,
) -> Solid:
    """A turned body: profile [(radius, height), ...] around the axis that stands on `base`."""
    direction = np.asarray(axis, float) / np.linalg.norm(axis)
    path = [np.asarray(base, float) + height * direction for _, height in profile]
    across, along = _frame(direction)
    return loft(
        [_circle(at, radius, across, along, sides) for at, (radius, _) in zip(path, profile, strict=True)],
        colour,
    )


def ellipsoid(radii: Point, centre: Point, colour: np.ndarray) -> Solid:
    """An ellipsoid along the axes."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    ball = revolved([(np.cos(a), np.sin(a)) for a in angle], (0, 0, 0), colour, sides=_SIDES)
    return dataclasses.replace(ball, vertices=ball.vertices * radii + np.asarray(centre, float))


def tube(
    path: Sequence[Point] | np.ndarray,
    radii: Sequence[float] | np.ndarray,
    colour: np.ndarray,
    *,
    sides: int = 10,
) -> Solid:
    """A bent round bar along `path`, with a radius at each of its points."""
    points = np.asarray(path, float)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate((steps[:1], steps[:-1] + steps[1:], steps[-1:]))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across, _ = _frame(tangents[0])
    rings = []
    for at, tangent, radius in zip(points, tangents, radii, strict=True):
        across = across - (across @ tangent) * tangent  # carried along, so that the tube does not twist
        across /= np.linalg.norm(across)
        rings.append(_circle(at, radius, across, np.cross(tangent, across), sides))
    return loft(rings, colour)


def wing(
    root: Point, tip: Point, chords: tuple[float, float], thickness: tuple[float, float], colour: np.ndarray
) -> Solid:
    """A wing or fin whose sections run along z: their front thirds are at `root` and `tip`."""
    section = np.array(
        [(0.33, 0), (0.2, 0.38), (-0.1, 0.5), (-0.67, 0.06), (-0.67, -0.06), (-0.1, -0.5), (0.2, -0.38)]
    )
    span = np.asarray(tip, float) - root
    across = np.cross((0, 0, 1), span)
    across /= np.linalg.norm(across)
    rings = [
        np.asarray(at, float) + section[:, :1] * (0, 0, chord) + section[:, 1:] * thick * across
        for at, chord, thick in zip((root, tip), chords, thickness, strict=True)
    ]
    return loft(rings, colour)


def sheet(a: Point, b: Point, c: Point, belly: float, colour: np.ndarray) -> Solid:
    """A sail: a thin triangle whose middle bellies out along x."""
    thin = np.array((np.copysign(0.004, belly), 0, 0))
    corners = np.array((a, b, c), float)
    vertices = np.concatenate((corners - thin, corners + thin, [corners.mean(0) + thin + (belly, 0, 0)]))
    faces = [(0, 2, 1), (3, 4, 6), (4, 5, 6), (5, 3, 6)]
    for i, k in ((0, 1), (1, 2), (2, 0)):
        faces += [(i, k, 3 + k), (i, 3 + k, 3 + i)]
    return Solid(vertices, _outward(vertices, np.array(faces)), np.asarray(colour, float), (np.arange(7),))


def surface_of(solids: Sequence[Solid]) -> Surface:
    """All solids as one surface."""
    offsets = np.cumsum([0] + [len(solid.vertices) for solid in solids[:-1]])
    return Surface.plain(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + offset for solid, offset in zip(solids, offsets, strict=True)]),
        np.concatenate([np.tile(solid.colour, (len(solid.faces), 1)) for solid in solids]),
    )


def sample_union(solids: Sequence[Solid], count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points, uniform by area on the outside of the union; none is inside another solid."""
    triangles = np.concatenate([solid.vertices[solid.faces] for solid in solids])
    owner = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
    kept: list[np.ndarray] = []
    missing = count
    while missing > 0:
        points, face = sample_triangles(triangles, int(missing * 1.5) + 16, rng)
        outside = np.ones(len(points), bool)
        for number, solid in enumerate(solids):
            candidates = np.flatnonzero(outside & (owner[face] != number))
            outside[candidates[solid.contains(points[candidates])]] = False
        kept.append(points[outside][:missing])
        missing -= len(kept[-1])
    return np.concatenate(kept)


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across `direction` and each other."""
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= np.linalg.norm(across)
    return across, np.cross(direction, across)


def _circle(
    centre: np.ndarray, radius: float, across: np.ndarray, along: np.ndarray, sides: int
) -> np.ndarray:
    angle = np.arange(sides)[:, None] * (2 * np.pi / sides)
    return centre + radius * (np.cos(angle) * across + np.sin(angle) * along)


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces that are wound alike, turned so that they enclose a positive volume."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces if np.einsum("fc,fc->", a, np.cross(b, c)) > 0 else faces[:, ::-1]
