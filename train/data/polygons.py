"""Polygons as triangles: a fan where it covers the polygon, ear clipping where it would spill over a notch."""

from __future__ import annotations

from collections.abc import Sequence

import mapbox_earcut
import numpy as np

_SPILLED = 1e-6
"""Share of a polygon's area by which a triangle of the fan may lie outside of it: what seven digits round away."""

_AREA = 1e-9
"""A polygon whose area is a smaller share of its triangles' is a line, or crosses itself: it has no inside."""


def triangulate(vertices: np.ndarray, polygons: Sequence[Sequence[int]]) -> list[np.ndarray]:
    """Triangles that cover each polygon, in the direction in which its corners run.

    Args:
        vertices: (V, 3), any frame and unit.
        polygons: the vertices of each one's corners; it may be concave and its corners need not lie in one plane. Of
            one that is degenerate (on a line, crossing itself without area, with vertices that do not exist), the fan
            is returned.

    Returns:
        For each polygon (T, 3) int: positions of corners in it, up to its number of corners less 2; none for fewer
        than three corners.

    Example:
        >>> arrow = np.array([[0.0, 0, 0], [1, 1, 0], [0, 3, 0], [-1, 1, 0]])
        >>> triangulate(arrow, [[0, 1, 2, 3]])[0].tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    sizes = [len(polygon) for polygon in polygons]
    corners = [corner for polygon in polygons for corner in polygon]
    clipped = clip_concave(vertices, np.array(corners, int), np.array(sizes, int))
    fans = {size: _fan(size) for size in set(sizes)}
    return [clipped.get(number, fans[size]) for number, size in enumerate(sizes)]


def _fan(size: int) -> np.ndarray:
    second = np.arange(1, max(size - 1, 1))
    return np.stack((np.zeros_like(second), second, second + 1), axis=1)


def clip_concave(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> dict[int, np.ndarray]:
    """As `triangulate`, but only those polygons, by their number, that a fan from their first corner does not cover.

    The fan of a convex polygon covers it, so that of most files there is nothing to clip.

    Args:
        vertices: (V, 3).
        corners: (C,) int, the vertices of all polygons' corners, one polygon after the other.
        sizes: (P,) int, how many of the corners each polygon has.
    """
    clipped: dict[int, np.ndarray] = {}
    vertices, starts = np.asarray(vertices, float), np.cumsum(sizes) - sizes
    for size in np.unique(sizes[sizes > 3]):
        numbers = np.flatnonzero(sizes == size)
        indices = corners[starts[numbers][:, None] + np.arange(size)]
        exists = ((indices >= 0) & (indices < len(vertices))).all(1)
        numbers, outlines = numbers[exists], vertices[indices[exists]]
        with np.errstate(all="ignore"):  # not a number compares as false: such a polygon stays a fan
            sides = outlines[:, 1:] - outlines[:, :1]
            areas = np.cross(sides[:, :-1], sides[:, 1:])
            normal = areas.sum(1)  # Newell's: of the plane that fits best
            length = np.linalg.norm(normal, axis=1)
            has_inside = length > _AREA * np.linalg.norm(areas, axis=2).sum(1)
            inwards = np.einsum("nkc,nc->nk", areas, normal).min(1) / length**2
            spills = has_inside & (inwards < -_SPILLED)
        for number, outline, axis in zip(numbers[spills], outlines[spills], normal[spills], strict=True):
            triangles = _clip_ears(outline - outline[0], axis)
            if len(triangles):
                clipped[int(number)] = triangles
    return clipped


def _clip_ears(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles (T, 3) of a polygon's corners (K, 3) as seen along its normal; none if there is no ear."""
    first = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    second = np.cross(normal, first)
    flat = corners @ np.stack((first / np.linalg.norm(first), second / np.linalg.norm(second)), axis=1)
    found = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32))
    triangles = found.astype(int).reshape(-1, 3)
    sides = flat[triangles[:, 1:]] - flat[triangles[:, :1]]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    return triangles if area.sum() >= 0 else triangles[:, ::-1]
