"""Views of a surface by ray casting: exact depth at pixel centres, shaded colour, no OpenGL.

Rays leave the eye with z = 1 in the camera frame and are not normalised: embree's hit distance is the depth.
"""

from __future__ import annotations

import dataclasses
from importlib import import_module
from typing import Any

import numpy as np
import torch

from diffpoint.camera import PinholeCamera
from train.data.surface import Surface
from train.errors import UserError

DISTANCE = 2.0
FOCAL_PER_PIXEL = 420 / 224
ELEVATION_DEG = (-20.0, 40.0)
MAX_RADIUS = 0.51
"""A shape inside this radius is never cut by the frame: its half angle asin(r / 2) fits the field of view."""

_AMBIENT, _DIFFUSE = 0.35, 0.6  # sum below 1: a white surface stays darker than the white background
_DARKEST = 0.06  # a black surface still shows its shape
_LIGHT_IN_CAM = np.array([-0.45, -0.7, -0.9]) / np.linalg.norm(
    [-0.45, -0.7, -0.9]
)  # over the viewer's left shoulder
_COLOUR_OFFSETS = np.array([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)])


@dataclasses.dataclass(frozen=True)
class Views:
    """Rendered views: images (V, H, W, 3) uint8 on white, depth (V, H, W) float32 (+inf: empty), camera (V,)."""

    images: np.ndarray
    depth: np.ndarray
    camera: PinholeCamera


def orbit_camera(azimuth_deg: np.ndarray, elevation_deg: np.ndarray, size: int) -> PinholeCamera:
    """Cameras (V,) at distance 2 that look at the origin; azimuth 0 stands in front, at +z, and 90 at +x."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    eye = DISTANCE * np.stack(
        (np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)), axis=-1
    )
    return PinholeCamera.look_at(
        torch.from_numpy(eye), (0.0, 0.0, 0.0), focal_px=FOCAL_PER_PIXEL * size, height=size, width=size
    )


def draw_camera(rng: np.random.Generator, views: int, size: int) -> PinholeCamera:
    """The paper's views: equispaced on the circle from a random start, elevations uniform in [-20, 40] degrees."""
    azimuth_deg = rng.uniform(0, 360) + np.arange(views) * 360 / views
    return orbit_camera(azimuth_deg, rng.uniform(*ELEVATION_DEG, views), size)


class Renderer:
    """Casts rays at one surface; building it builds embree's tree once for all views."""

    def __init__(self, surface: Surface) -> None:
        rtcore_scene, mesh_construction = load_embree()
        self.surface = surface
        self._scene = rtcore_scene.EmbreeScene()
        mesh_construction.TriangleMesh(
            scene=self._scene,
            vertices=np.ascontiguousarray(surface.vertices, np.float32),
            indices=np.ascontiguousarray(surface.faces, np.int32),
        )
        low, high = surface.vertices.min(0), surface.vertices.max(0)
        self._box_corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)

    def render(self, camera: PinholeCamera) -> Views:
        """Views from cameras (V,). Depth and mask at pixel centres; colour is the mean of 2 x 2 rays."""
        images = np.full((*camera.batch_shape, camera.height, camera.width, 3), 255, np.uint8)
        depth = np.full(images.shape[:-1], np.inf, np.float32)
        K = camera.K.double().numpy()
        cam_from_world = camera.cam_from_world.double().numpy()
        for view in range(len(images)):
            rows, columns = self._window(K[view], cam_from_world[view], camera.height, camera.width)
            if rows.size and columns.size:
                box = np.s_[view, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
                images[box], depth[box] = self._render_window(K[view], cam_from_world[view], rows, columns)
        return Views(images, depth, camera)

    def _window(
        self, K: np.ndarray, cam_from_world: np.ndarray, height: int, width: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels that the surface's bounding box can cover."""
        corners = self._box_corners @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        if corners[:, 2].min() <= 1e-3:  # the box reaches the camera's plane: no bound
            return np.arange(height), np.arange(width)
        pixels = (corners / corners[:, 2:]) @ K[:2].T
        low, high = np.floor(pixels.min(0)).astype(int) - 1, np.ceil(pixels.max(0)).astype(int) + 1
        return np.arange(max(low[1], 0), min(high[1], height)), np.arange(max(low[0], 0), min(high[0], width))

    def _render_window(
        self, K: np.ndarray, cam_from_world: np.ndarray, rows: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        # One ray through each pixel's centre for the depth, then the rays of the colour: (1 + 4, rows, columns, 3).
        offsets = np.concatenate((np.zeros((1, 2)), _COLOUR_OFFSETS)) + 0.5
        u = offsets[:, 0, None, None, None] + columns[:, None]
        v = offsets[:, 1, None, None, None] + rows[:, None, None]
        rotation = cam_from_world[:3, :3]
        per_u, per_v, constant = (rotation.T @ np.linalg.inv(K)).T
        directions = (u * per_u + v * per_v + constant).astype(np.float32).reshape(-1, 3)
        eye = -rotation.T @ cam_from_world[:3, 3]
        hits = self._scene.run(
            np.broadcast_to(eye.astype(np.float32), directions.shape).copy(), directions, output=True
        )
        window = (len(rows), len(columns))
        count = len(rows) * len(columns)
        depth = np.where(hits["primID"][:count] >= 0, hits["tfar"][:count], np.float32(np.inf))
        colour_rays = {key: value[count:] for key, value in hits.items()}
        colours = self._shade(colour_rays, directions[count:], _LIGHT_IN_CAM @ rotation)
        image = colours.reshape(len(_COLOUR_OFFSETS), *window, 3).mean(0)
        return (image * 255 + 0.5).astype(np.uint8), depth.reshape(window)

    def _shade(self, hits: dict, directions: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Lambert light on the side that is seen, whichever way a triangle is wound."""
        surface = self.surface
        colours = np.ones((len(directions), 3), np.float32)
        hit = np.flatnonzero(hits["primID"] >= 0)
        face = hits["primID"][hit]
        u, v = hits["u"][hit], hits["v"][hit]
        weights = np.stack((1 - u - v, u, v), axis=-1)
        albedo = np.einsum("nk,nkc->nc", weights, surface.corner_colours[face])
        texture = surface.face_texture[face]
        for number in np.unique(texture[texture >= 0]):
            chosen = texture == number
            uv = np.einsum("nk,nkc->nc", weights[chosen], surface.corner_uv[face[chosen]])
            albedo[chosen] = _sample_texture(surface.textures[number], uv)
        normals = hits["Ng"][hit]
        facing = np.einsum("nc,nc->n", normals, directions[hit])
        lengths = np.maximum(np.linalg.norm(normals, axis=-1), 1e-20)
        lambert = np.where(facing < 0, 1, -1) * (normals @ light.astype(np.float32)) / lengths
        albedo = _DARKEST + (1 - _DARKEST) * albedo
        colours[hit] = albedo * (_AMBIENT + _DIFFUSE * np.maximum(lambert, 0))[:, None]
        return colours


def _sample_texture(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Nearest texel, repeating; v points up. RGB float32 in [0, 1]."""
    height, width = texture.shape[:2]
    uv = uv - np.floor(uv)
    column = np.minimum((uv[:, 0] * width).astype(int), width - 1)
    row = np.minimum(((1 - uv[:, 1]) * height).astype(int), height - 1)
    return texture[row, column].astype(np.float32) / 255


def load_embree() -> tuple[Any, Any]:
    """embree's scene and mesh modules.

    Raises:
        UserError: embreex is not installed or does not run here.
    """
    try:
        return import_module("embreex.rtcore_scene"), import_module("embreex.mesh_construction")
    except ImportError as error:
        raise UserError(
            f"rendering needs embreex, which fails to import ({error}); install it: pip install embreex"
        ) from error
