"""Unions of convex solids: their coloured surface, and uniform samples of its outside."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from train.data.surface import Surface, sample_triangles

_STRICTLY_INSIDE = 1e-6
"""World units; a point on a face shared by two flush solids is not inside either."""


@dataclasses.dataclass(frozen=True)
class Solid:
    """A closed convex solid of one colour: vertices (V, 3), faces (F, 3) wound outward, RGB in [0, 1]."""

    vertices: np.ndarray
    faces: np.ndarray
    colour: np.ndarray

    def scaled(self, factor: float) -> Solid:
        """The solid scaled about the origin."""
        return dataclasses.replace(self, vertices=self.vertices * factor)


def loft(rings: Sequence[np.ndarray], colour: np.ndarray) -> Solid:
    """The solid through rings of corners (n, 3), closed by the first and the last; it must be convex."""
    count = len(rings[0])
    corner = np.arange(count)
    after = np.roll(corner, -1)
    fan = np.stack((np.zeros(count - 2, int), corner[1:-1], corner[2:]), axis=1)
    faces = [fan, fan + count * (len(rings) - 1)]
    for level in range(len(rings) - 1):
        low, high = level * count, (level + 1) * count
        faces.append(np.stack((low + corner, low + after, high + after), axis=1))
        faces.append(np.stack((low + corner, high + after, high + corner), axis=1))
    vertices = np.concatenate(rings)
    return Solid(vertices, _wound_outward(vertices, np.concatenate(faces)), np.asarray(colour, float))


def box(size: Sequence[float], centre: Sequence[float], colour: np.ndarray) -> Solid:
    """An axis-aligned box."""
    return loft(
        [rectangle(size[0], size[1], centre[0], centre[1], centre[2] + s * size[2] / 2) for s in (-1, 1)],
        colour,
    )


def rectangle(width: float, height: float, x: float, y: float, z: float) -> np.ndarray:
    """The corners (4, 3) of a rectangle across the z axis, centred at (x, y, z)."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    return np.column_stack((corners * (width, height) + (x, y), np.full(4, z)))


def bar(
    start: Sequence[float], end: Sequence[float], radius: float, colour: np.ndarray, *, sides: int = 10
) -> Solid:
    """A round bar from `start` to `end`."""
    low, high = np.asarray(start, float), np.asarray(end, float)
    axis = (high - low) / np.linalg.norm(high - low)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    angle = np.arange(sides)[:, None] * (2 * np.pi / sides)
    ring = radius * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    return loft([low + ring, high + ring], colour)


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
    planes = [_planes(solid) for solid in solids]
    kept: list[np.ndarray] = []
    missing = count
    while missing > 0:
        points, face = sample_triangles(triangles, int(missing * 1.5) + 16, rng)
        outside = np.ones(len(points), bool)
        for number, (normals, offsets) in enumerate(planes):
            candidates = np.flatnonzero(outside & (owner[face] != number))
            inside = (points[candidates] @ normals.T < offsets - _STRICTLY_INSIDE).all(1)
            outside[candidates[inside]] = False
        kept.append(points[outside][:missing])
        missing -= len(kept[-1])
    return np.concatenate(kept)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _wound_outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    outward = vertices[faces].mean(1) - vertices.mean(0)
    inward = np.einsum("fc,fc->f", _normals(vertices, faces), outward) < 0
    return np.where(inward[:, None], faces[:, ::-1], faces)


def _planes(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Outward unit normals (F, 3) and offsets (F,): inside is normal . x < offset on every face."""
    normals = _normals(solid.vertices, solid.faces)
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals, np.einsum("fc,fc->f", normals, solid.vertices[solid.faces[:, 0]])
