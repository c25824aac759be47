"""Ground truth without the inside: samples of the surface that are visible in a view, or from outside."""

from __future__ import annotations

import numpy as np

from diffpoint.camera import PinholeCamera
from train.data.mesh_files import MeshError
from train.data.render import Orbit, Renderer, orbit_camera
from train.data.surface import sample_triangles

_CAMERAS, _SIZE = 64, 320
_DRAWN_AT_ONCE = 4  # candidates for each requested point
_ROUNDS = 8
_SAME, _NEAR = 1e-4, 0.02
"""Shares of the depth. A face hides a point if its plane is nearer by more than the first on the ray to the point; the
plane counts only if the depth at the pixel's centre differs from the point's by less than the second."""


def sample_visible(
    renderer: Renderer, camera: PinholeCamera, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Points (count, 3), uniform by area on the visible part of the surface.

    The bottoms of drawers, and parts inside of others, are left out: no picture shows them. A point is visible if one
    of the views' cameras (V,) sees it, or one of 64 cameras all around.

    Raises:
        MeshError: nearly nothing of the surface is visible.

    Example:
        >>> from train.data.solids import box, surface_of
        >>> outer, inner = (box((size,) * 3, (0, 0, 0), np.ones(3)) for size in (0.5, 0.4))
        >>> renderer, rng = Renderer(surface_of([outer, inner])), np.random.default_rng(0)
        >>> points = sample_visible(renderer, orbit_camera(np.zeros(1), np.zeros(1), 64), 500, rng)
        >>> bool(np.isclose(np.abs(points).max(1), 0.25).all())
        True
    """
    surface = renderer.surface
    triangles = surface.vertices[surface.faces]
    around = _cameras_around(float(np.linalg.norm(surface.vertices, axis=1).max()))
    kept: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        points, face = sample_triangles(triangles, _DRAWN_AT_ONCE * count, rng)
        seen = np.zeros(len(points), bool)
        for cameras in (camera, around):
            for number in range(len(cameras.K)):
                left = np.flatnonzero(~seen)
                seen[left] = _sees(renderer, cameras, number, points[left], face[left])
        kept.append(points[seen])
        if sum(map(len, kept)) >= count:
            return np.concatenate(kept)[:count]
    raise MeshError("nearly nothing of its surface is visible from outside")


def _sees(
    renderer: Renderer, camera: PinholeCamera, view: int, points: np.ndarray, face: np.ndarray
) -> np.ndarray:
    """(N,) bool: which points (N, 3), each on its face (N,), one of the cameras sees."""
    hits = renderer.hits(camera, view)
    K, cam_from_world = camera.K[view].double().numpy(), camera.cam_from_world[view].double().numpy()
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    in_cam = points @ rotation.T + translation
    depth = in_cam[:, 2]
    column, row = np.floor(in_cam @ K[:2].T / depth[:, None]).T
    framed = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    at = row[framed].astype(int), column[framed].astype(int)
    first, first_depth = hits.face[at], hits.depth[at]
    eye = -rotation.T @ translation
    normals = renderer.normals[first]
    towards = points[framed] - eye
    with np.errstate(divide="ignore", invalid="ignore"):  # a plane that the ray runs along hides nothing
        reach = (renderer.offsets[first] - normals @ eye) / np.einsum("nc,nc->n", normals, towards)
    clear = (reach >= 1 - _SAME) & (first_depth > (1 - _NEAR) * depth[framed])
    seen = np.zeros(len(points), bool)
    seen[framed] = clear | (first == face[framed]) | (first < 0)
    return seen


def _cameras_around(radius: float) -> PinholeCamera:
    """Cameras evenly over a sphere (a Fibonacci lattice) around all of the shape, which fills their frames."""
    number = np.arange(_CAMERAS)
    elevation_deg = np.degrees(np.arcsin(1 - (2 * number + 1) / _CAMERAS))
    azimuth_deg = np.degrees(number * np.pi * (3 - np.sqrt(5)))
    return orbit_camera(azimuth_deg, elevation_deg, _SIZE, Orbit(distance=4 * radius))
