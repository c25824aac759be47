"""Views of a surface: exact depth at pixel centres, shaded colour, no OpenGL.

Which face each pixel sees is found by embree, or by the z-buffer of `rays` where embree is not installed; the rest
is the same for both.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from diffpoint.camera import PinholeCamera
from train.data.rays import EmbreeCaster, Hits, Rasteriser, has_embree
from train.data.surface import Surface
from train.errors import UserError

DISTANCE = 2.0
FOCAL_PER_PIXEL = 420 / 224
ELEVATION_DEG = (-20.0, 40.0)
MAX_RADIUS = 0.51
"""A shape inside this radius is never cut by the frame: its half angle asin(r / 2) fits the field of view."""

_FARTHEST = 9.0  # the depth files end at 10
_AMBIENT, _DIFFUSE = 0.35, 0.6  # sum below 1: a white surface stays darker than the white background
_DARKEST = 0.06  # a black surface still shows its shape
_LIGHT_IN_CAM = np.array([-0.45, -0.7, -0.9])  # over the viewer's left shoulder
_LIGHT_IN_CAM /= np.linalg.norm(_LIGHT_IN_CAM)
_FINER = 2  # a pixel's colour is the mean of so many samples in each direction


@dataclasses.dataclass(frozen=True)
class Views:
    """Rendered views: images (V, H, W, 3) uint8 on white, depth (V, H, W) float32 (+inf: empty), camera (V,)."""

    images: np.ndarray
    depth: np.ndarray
    camera: PinholeCamera


@dataclasses.dataclass(frozen=True)
class Orbit:
    """Positions of a shape's cameras; the defaults are the paper's.

    Attributes:
        elevation_deg: lowest and highest.
        distance: of the cameras from the middle of the shape, in world units.
        focal: focal length over the side of the picture: 420 pixels at 224, a 60 mm lens on a 32 mm sensor.
    """

    elevation_deg: tuple[float, float] = ELEVATION_DEG
    distance: float = DISTANCE
    focal: float = FOCAL_PER_PIXEL

    @property
    def max_radius(self) -> float:
        """A shape inside this radius is never cut by the frame."""
        return self.distance * float(np.sin(np.arctan(0.5 / self.focal)))

    def check(self) -> None:
        """Refuses cameras whose frame would cut a shape of diagonal 1.

        Raises:
            UserError: an elevation, distance or focal length that is out of range, or a frame that is too narrow.
        """
        low, high = self.elevation_deg
        if not -89 <= low <= high <= 89:
            raise UserError(
                f"elevation must be two angles between -89 and 89, the lower one first; got {low:g} {high:g}"
            )
        if not 0.6 <= self.distance <= _FARTHEST:
            raise UserError(
                f"distance must be between 0.6 and {_FARTHEST:g} (shapes have the diagonal 1, depth files end at 10); "
                f"got {self.distance:g}"
            )
        if not 0.1 <= self.focal <= 100:
            raise UserError(f"focal must be between 0.1 and 100 sides of the picture; got {self.focal:g}")
        if self.max_radius < 0.5:
            widest = (
                self.distance * 0.5 / np.sqrt(self.distance**2 - 0.25)
            )  # half a frame that holds the shape
            raise UserError(
                f"at distance {self.distance:g} and focal {self.focal:g} the frame cuts shapes of diagonal 1; "
                f"lower focal to {np.floor(50 * self.distance / widest) / 100:g}, or raise distance"
            )


def orbit_camera(
    azimuth_deg: np.ndarray, elevation_deg: np.ndarray, size: int, orbit: Orbit | None = None
) -> PinholeCamera:
    """Cameras (V,) that look at the origin; azimuth 0 is in front, at +z, and 90 at +x."""
    orbit = orbit or Orbit()
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    eye = orbit.distance * np.stack(
        (np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)), axis=-1
    )
    return PinholeCamera.look_at(
        torch.from_numpy(eye), (0.0, 0.0, 0.0), focal_px=orbit.focal * size, height=size, width=size
    )


def draw_camera(rng: np.random.Generator, views: int, size: int, orbit: Orbit | None = None) -> PinholeCamera:
    """The paper's views: equispaced on the circle from a random start, elevations uniform between two angles."""
    orbit = orbit or Orbit()
    azimuth_deg = rng.uniform(0, 360) + np.arange(views) * 360 / views
    return orbit_camera(azimuth_deg, rng.uniform(*orbit.elevation_deg, views), size, orbit)


class Renderer:
    """Renders one surface from any number of cameras.

    Args:
        surface: what is rendered.
        caster: `EmbreeCaster` or `Rasteriser`; None for embree where it runs.

    Attributes:
        surface: the same.
        normals: (F, 3) of the faces' planes.
        offsets: (F,) normal . x = offset on a face.
    """

    def __init__(self, surface: Surface, caster: type[EmbreeCaster] | type[Rasteriser] | None = None) -> None:
        self.surface = surface
        if caster is None:
            caster = EmbreeCaster if has_embree() else Rasteriser
        self._caster = caster(surface)
        low, high = surface.vertices.min(0), surface.vertices.max(0)
        self._box_corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
        first, second, third = (surface.vertices[surface.faces[:, k]] for k in range(3))
        normals = np.cross(second - first, third - first)
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        self.offsets = np.einsum("fc,fc->f", self.normals, first)
        self._one_colour = bool((surface.corner_colours == surface.corner_colours[:, :1]).all())

    def render(self, camera: PinholeCamera) -> Views:
        """Views from cameras (V,). Depth and mask at pixel centres; colour is the mean of 2 x 2 rays."""
        images = np.full((*camera.batch_shape, camera.height, camera.width, 3), 255, np.uint8)
        depth = np.full(images.shape[:-1], np.inf, np.float32)
        for view in range(len(images)):
            K, cam_from_world, rows, columns, box = self._seen_by(camera, view)
            if rows.size and columns.size:
                depth[view][box] = self._caster.cast(K, cam_from_world, rows, columns).depth
                images[view][box] = self._colours(K, cam_from_world, rows, columns)
        return Views(images, depth, camera)

    def hits(self, camera: PinholeCamera, view: int) -> Hits:
        """The face and depth that one of the cameras (V,) sees at each pixel's centre, (height, width)."""
        K, cam_from_world, rows, columns, box = self._seen_by(camera, view)
        size = (camera.height, camera.width)
        hits = Hits(np.full(size, -1), np.full(size, np.inf, np.float32))
        if rows.size and columns.size:
            hits.face[box], hits.depth[box] = self._caster.cast(K, cam_from_world, rows, columns)
        return hits

    def _seen_by(
        self, camera: PinholeCamera, view: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Any]:
        """K, cam_from_world in float64; and the pixels that the surface's box can cover: rows, columns, index."""
        K, cam_from_world = camera.K[view].double().numpy(), camera.cam_from_world[view].double().numpy()
        rows, columns = np.arange(camera.height), np.arange(camera.width)
        corners = self._box_corners @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        if corners[:, 2].min() > 1e-3:  # else the box reaches the camera's plane, and there is no bound
            pixels = (corners / corners[:, 2:]) @ K[:2].T
            low, high = np.floor(pixels.min(0)).astype(int) - 1, np.ceil(pixels.max(0)).astype(int) + 1
            rows = rows[max(low[1], 0) : max(high[1], 0)]
            columns = columns[max(low[0], 0) : max(high[0], 0)]
        return K, cam_from_world, rows, columns, np.ix_(rows, columns)

    def _colours(
        self, K: np.ndarray, cam_from_world: np.ndarray, rows: np.ndarray, columns: np.ndarray
    ) -> np.ndarray:
        """RGB (rows, columns, 3) uint8: a finer picture, each block of it averaged."""
        finer_K = np.diag([_FINER, _FINER, 1.0]) @ K
        finer_rows = np.arange(_FINER * rows[0], _FINER * (rows[-1] + 1))
        finer_columns = np.arange(_FINER * columns[0], _FINER * (columns[-1] + 1))
        hits = self._caster.cast(finer_K, cam_from_world, finer_rows, finer_columns)
        seen = np.flatnonzero(hits.face.ravel() >= 0)
        face = hits.face.ravel()[seen]
        if self._one_colour and not self.surface.textures:
            albedo = self.surface.corner_colours[face, 0]
        else:
            u = finer_columns[seen % len(finer_columns)] + 0.5
            v = finer_rows[seen // len(finer_columns)] + 0.5
            in_cam = np.stack((u, v, np.ones(len(u))), 1) @ np.linalg.inv(finer_K).T
            in_cam *= hits.depth.ravel()[seen, None]
            albedo = self._albedo(face, (in_cam - cam_from_world[:3, 3]) @ cam_from_world[:3, :3])
        albedo = _DARKEST + (1 - _DARKEST) * albedo
        colours = np.ones((hits.face.size, 3), np.float32)
        colours[seen] = albedo * self._light(cam_from_world)[face, None]
        blocks = colours.reshape(len(rows), _FINER, len(columns), _FINER, 3)
        mean = (blocks[:, 0, :, 0] + blocks[:, 0, :, 1] + blocks[:, 1, :, 0] + blocks[:, 1, :, 1]) / 4
        return (mean * 255 + 0.5).astype(np.uint8)

    def _light(self, cam_from_world: np.ndarray) -> np.ndarray:
        """(F,) Lambert light on the side of each face that the camera sees, whichever way the face is wound."""
        rotation = cam_from_world[:3, :3]
        eye = -rotation.T @ cam_from_world[:3, 3]
        facing = np.where(self.normals @ eye > self.offsets, 1, -1)
        lambert = facing * (self.normals @ (_LIGHT_IN_CAM @ rotation))
        return (_AMBIENT + _DIFFUSE * np.maximum(lambert, 0)).astype(np.float32)

    def _albedo(self, face: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(N, 3) colours of points (N, 3) on faces (N,)."""
        surface = self.surface
        weights = _barycentric(surface.vertices[surface.faces[face]], points)
        albedo = np.einsum("nk,nkc->nc", weights, surface.corner_colours[face])
        texture = surface.face_texture[face]
        for number in np.unique(texture[texture >= 0]):
            chosen = np.flatnonzero(texture == number)
            uv = np.einsum("nk,nkc->nc", weights[chosen], surface.corner_uv[face[chosen]])
            albedo[chosen] *= _sample_texture(surface.textures[number], uv)
        return albedo


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights (N, 3) in [0, 1] float32 of points (N, 3) in the triangles (N, 3, 3) that they lie on."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(first, second)
    offset = points - triangles[:, 0]
    area = np.maximum(np.einsum("nc,nc->n", normals, normals), 1e-300)
    v = np.einsum("nc,nc->n", np.cross(offset, second), normals) / area
    w = np.einsum("nc,nc->n", np.cross(first, offset), normals) / area
    weights = np.clip(np.stack((1 - v - w, v, w), 1), 0, 1)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _sample_texture(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Nearest texel, repeating; v points up. RGB float32 in [0, 1]."""
    height, width = texture.shape[:2]
    uv = uv - np.floor(uv)
    column = np.minimum((uv[:, 0] * width).astype(int), width - 1)
    row = np.minimum(((1 - uv[:, 1]) * height).astype(int), height - 1)
    return texture[row, column].astype(np.float32) / 255
