"""What the rays through pixels hit first: with embree, or with a z-buffer in plain numpy where embree has no wheel.

Rays leave the eye with z = 1 in the camera frame and are not normalised: embree's hit distance is the depth.

In the z-buffer, for a ray (x, y, 1) in homogeneous pixels and a triangle with corners q0, q1, q2 there (q = K p in the
camera frame), the edge functions e_i = (q_j x q_k) . (x, y, 1) are the hit point's barycentric weights up to scale, and
its depth is det(q0, q1, q2) / (e_0 + e_1 + e_2). Nothing is divided by a corner's depth, so triangles that reach behind
the camera need no clipping (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997).
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from train.data.surface import Surface
from train.errors import UserError

_FACES_AT_ONCE = 1 << 16
_ITEMS_AT_ONCE = 1 << 18
"""Spans or pixels; together with the faces at once this bounds the memory to about 100 MB for any mesh."""

_SLIVER = 1e-6
"""About square pixels. Triangles seen edge-on are left out: their depth would be rounding noise, and they cover no
pixel centre."""


class Hits(NamedTuple):
    """What rays through pixels hit first: the face (h, w) int, -1 for none, and its depth float32, +inf for none."""

    face: np.ndarray
    depth: np.ndarray


class EmbreeCaster:
    """Finds what the rays through pixel centres hit first; building it builds embree's tree once for all views."""

    def __init__(self, surface: Surface) -> None:
        rtcore_scene, mesh_construction = load_embree()
        self._scene = rtcore_scene.EmbreeScene()
        mesh_construction.TriangleMesh(
            scene=self._scene,
            vertices=np.ascontiguousarray(surface.vertices, np.float32),
            indices=np.ascontiguousarray(surface.faces, np.int32),
        )

    def cast(self, K: np.ndarray, cam_from_world: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Hits:
        """What is seen at the centres of the pixels rows x columns."""
        rotation = cam_from_world[:3, :3]
        per_u, per_v, constant = (rotation.T @ np.linalg.inv(K)).T
        across = (columns[:, None] + 0.5) * per_u + constant
        down = (rows[:, None, None] + 0.5) * per_v
        directions = (across + down).astype(np.float32).reshape(-1, 3)
        eye = (-rotation.T @ cam_from_world[:3, 3]).astype(np.float32)
        hits = self._scene.run(np.tile(eye, (len(directions), 1)), directions, output=True)
        depth = np.where(hits["primID"] >= 0, hits["tfar"], np.float32(np.inf))
        window = (len(rows), len(columns))
        return Hits(hits["primID"].reshape(window), depth.reshape(window))


def load_embree() -> tuple[Any, Any]:
    """embree's scene and mesh modules.

    Raises:
        UserError: embreex is not installed or does not run here.
    """
    try:
        return import_module("embreex.rtcore_scene"), import_module("embreex.mesh_construction")
    except ImportError as error:
        raise UserError(f"embreex fails to import ({error}); install it: pip install embreex") from error


def has_embree() -> bool:
    """True if embreex can be imported."""
    try:
        load_embree()
    except UserError:
        return False
    return True


class Rasteriser:
    """Finds what the rays through pixel centres hit first, triangle by triangle.

    Example:
        >>> square = np.array([(-1, -1, 3), (1, -1, 3), (1, 1, 3), (-1, 1, 3)], float)
        >>> surface = Surface.plain(square, np.array([(0, 1, 2), (0, 2, 3)]), np.ones((2, 3)))
        >>> K = np.array([(3.0, 0, 2), (0, 3, 2), (0, 0, 1)])
        >>> Rasteriser(surface).cast(K, np.eye(4), np.arange(4), np.arange(4)).depth[1].tolist()
        [inf, 3.0, 3.0, inf]
    """

    def __init__(self, surface: Surface) -> None:
        self._vertices = np.asarray(surface.vertices, np.float64)
        self._faces = surface.faces

    def cast(self, K: np.ndarray, cam_from_world: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Hits:
        """What is seen at the centres of the pixels rows x columns, each a run of consecutive numbers."""
        height, width = len(rows), len(columns)
        window = np.array([(1, 0, -columns[0] - 0.5), (0, 1, -rows[0] - 0.5), (0, 0, 1)])
        to_pixels = window @ K @ cam_from_world[:3]
        corners = self._vertices @ to_pixels[:, :3].T + to_pixels[:, 3]
        face = np.full(height * width, -1)
        depth = np.full(height * width, np.inf)
        for start in range(0, len(self._faces), _FACES_AT_ONCE):
            triangles = corners[self._faces[start : start + _FACES_AT_ONCE].T]
            for spans in _spans(triangles, height, width):
                _draw(spans, start, face, depth)
        return Hits(face.reshape(height, width), depth.reshape(height, width).astype(np.float32))


class _Spans(NamedTuple):
    """Runs of pixels (S,) that a triangle covers in a row: 1 / depth = slope * column + base."""

    triangle: np.ndarray
    pixel: np.ndarray
    column: np.ndarray
    count: np.ndarray
    slope: np.ndarray
    base: np.ndarray


def _spans(triangles: np.ndarray, height: int, width: int) -> Iterator[_Spans]:
    """The spans of triangles (3 corners, T, 3), whose coordinates are homogeneous pixels of the window."""
    before = np.greater(triangles[..., 2], 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = triangles[..., :2] / triangles[..., 2:]
    # A triangle that reaches behind the camera may cover any pixel.
    wholly = np.all(before, axis=0, keepdims=True).T
    low, high = np.where(wholly, flat.min(0), -np.inf), np.where(wholly, flat.max(0), np.inf)
    first = np.ceil(np.clip(low, 0, (width, height))).astype(int)
    last = np.floor(np.clip(high, -1, (width - 1, height - 1))).astype(int)
    drawn = np.flatnonzero((first[:, 0] <= last[:, 0]) & (first[:, 1] <= last[:, 1]) & np.any(before, axis=0))
    triangles, top = triangles[:, drawn], first[drawn, 1]
    edges = np.cross(triangles[[1, 2, 0]], triangles[[2, 0, 1]])
    volume = np.einsum("tc,tc->t", triangles[0], edges[0])
    edges *= np.sign(volume)[:, None]
    rows = np.where(np.abs(volume) < _SLIVER, 0, last[drawn, 1] - top + 1)
    inverse_depth = edges.sum(0) / np.maximum(np.abs(volume), _SLIVER)[:, None]
    for each, within in _expanded(rows):
        row = top[each] + within
        left, right = np.zeros(len(row)), np.full(len(row), width - 1.0)
        for edge in edges:  # the triangle is where a * column + c >= 0 for each of them
            a, b, c = edge.T
            a, c = a[each], b[each] * row + c[each]
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = -c / a
            np.maximum(left, crossing, out=left, where=a > 0)
            np.minimum(right, crossing, out=right, where=a < 0)
            right[(a == 0) & (c < 0)] = -1
        start = np.ceil(np.minimum(left, width)).astype(int)
        count = np.floor(np.maximum(right, -1)).astype(int) - start + 1
        some = np.flatnonzero(count > 0)
        each, row, start = each[some], row[some], start[some]
        slope, per_row, constant = inverse_depth[each].T
        yield _Spans(drawn[each], row * width + start, start, count[some], slope, per_row * row + constant)


def _draw(spans: _Spans, first_face: int, face: np.ndarray, depth: np.ndarray) -> None:
    """Put spans into the z-buffer; of equal depths the lower face stays."""
    for each, within in _expanded(spans.count):
        pixel = spans.pixel[each] + within
        new = 1 / (spans.slope[each] * (spans.column[each] + within) + spans.base[each])
        nearer = np.flatnonzero(new < depth[pixel])
        each, pixel, new = each[nearer], pixel[nearer], new[nearer]
        np.minimum.at(depth, pixel, new)
        # Backwards, for where a pixel comes twice the last one written stays.
        won = np.flatnonzero(new == depth[pixel])[::-1]
        face[pixel[won]] = first_face + spans.triangle[each[won]]


def _expanded(counts: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Blocks of (item, number within it), `counts` of each item; a block holds few items' worth of memory."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        done = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, done + _ITEMS_AT_ONCE, side="right")), start + 1)
        chosen = counts[start:stop]
        item = np.repeat(np.arange(start, stop), chosen)
        yield item, np.arange(len(item)) - np.repeat(ends[start:stop] - chosen - done, chosen)
        start = stop
