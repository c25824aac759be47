"""Reading a mesh file into a surface: any format of trimesh, with its textures, materials and colours."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals, TextureVisuals

from train.data.surface import Surface

_TEXTURE_SIZE = 512
"""Larger textures are made smaller: a view has few pixels, and the nearest texel of a large texture is noise."""

_LARGEST_FILE = 256 << 20
"""Bytes: about ten million faces, which take 5 GB of memory to read. A mesh of three million takes 1.7 GB."""

_FLAT = 1e-5  # extent over the diagonal


class MeshError(Exception):
    """Why a mesh cannot become a shape."""


def load_surface(
    path: str | Path,
    rotation: Sequence[float] | None = None,
    *,
    scale: float | None = None,
    root: str | Path | None = None,
) -> Surface:
    """Loads a mesh, turns it, and centres its bounding box on the origin.

    Args:
        path: the file.
        rotation: 9 numbers, row by row; None for none.
        scale: world units per unit of the file; None makes the diagonal of the bounding box 1, as ShapeNet does.
        root: folder below which its materials and textures may be; by default that above the file's, for ShapeNet's
            second version names textures `../images/...`.

    Raises:
        MeshError: no faces, coordinates that are no numbers, no extent in one of the three directions (as one triangle
            has none), a file that cannot be read or is too large.
    """
    path = Path(path)
    if path.stat().st_size > _LARGEST_FILE:
        raise MeshError(f"larger than {_LARGEST_FILE >> 20} MB: reduce its number of faces")
    try:
        files = _Files(path, Path(root) if root else path.parent.parent)
        with path.open("rb") as file:
            scene = trimesh.load(
                file, file_type=path.suffix[1:].lower(), resolver=files, force="scene", process=False
            )
        parts = _parts(scene)  # pyright: ignore[reportArgumentType]
    except MeshError:
        raise
    except Exception as error:  # each format's reader has its own exceptions
        raise MeshError(f"cannot be read ({type(error).__name__}: {error})") from error
    if not parts:
        raise MeshError("no faces")
    surface = _joined(parts)
    corners = surface.vertices[surface.faces]
    if not np.isfinite(corners).all():
        raise MeshError("NaN or infinite vertices")
    if rotation is not None:
        corners = corners @ np.reshape(rotation, (3, 3)).T
    low, high = corners.min((0, 1)), corners.max((0, 1))
    diagonal = float(np.linalg.norm(high - low))
    if diagonal == 0 or not np.isfinite(diagonal):
        raise MeshError("no extent: all its vertices are at one point")
    corners = (corners - (low + high) / 2) / diagonal
    sides = corners[:, 1:] - corners[:, :1]
    if np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() < 1e-9:
        raise MeshError("no area: all its faces are lines or points")
    corners = corners.reshape(-1, 3)
    _, axes = np.linalg.eigh(corners.T @ corners - len(corners) * np.outer(corners.mean(0), corners.mean(0)))
    if np.ptp(corners @ axes[:, 0]) < _FLAT:
        raise MeshError("flat: all its faces lie in one plane, a view along it would show nothing")
    if scale is not None:
        corners *= diagonal * scale
    return dataclasses.replace(surface, vertices=corners, faces=np.arange(len(corners)).reshape(-1, 3))


class _Files(FilePathResolver):
    """Finds the files that a mesh names: beside it or elsewhere below a folder, with slashes of either kind."""

    def __init__(self, path: Path, root: Path) -> None:
        super().__init__(str(path))
        self._root = root.resolve()

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        for candidate in (name, name.lstrip("/"), name.rpartition("/")[2]):
            path = Path(self.parent, candidate).resolve()
            if path.is_relative_to(self._root) and path.is_file():
                return path.read_bytes()
        raise FileNotFoundError(name)


def _parts(scene: trimesh.Scene) -> list[Surface]:
    """The scene's meshes where its graph puts them; lines and points are left out."""
    parts = []
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        if mesh.faces.max() >= len(mesh.vertices) or mesh.faces.min() < 0:
            raise MeshError("faces with indices of vertices that it does not have")
        vertices = np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        parts.append(_coloured(mesh, vertices, np.asarray(mesh.faces)))
    return parts


def _coloured(mesh: trimesh.Trimesh, vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Texture if there is one, else vertex or face colours, else the material's colour."""
    visual = mesh.visual
    colours = np.full((len(faces), 3), 0.7)
    if isinstance(visual, TextureVisuals):
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        uv = visual.uv
        if image is not None and uv is not None and len(uv) == len(vertices) and np.isfinite(uv).all():
            return Surface(
                vertices,
                faces,
                np.ones((len(faces), 3, 3), np.float32),
                np.zeros(len(faces), int),
                np.asarray(uv, np.float32)[faces],
                (_texture(image),),
            )
        colours[:] = np.asarray(material.main_color[:3]) / 255
    elif isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        surface = Surface.plain(vertices, faces, colours)
        corner_colours = np.asarray(visual.vertex_colors)[faces, :3].astype(np.float32) / 255
        return dataclasses.replace(surface, corner_colours=corner_colours)
    elif isinstance(visual, ColorVisuals) and visual.kind == "face":
        colours = np.asarray(visual.face_colors)[:, :3] / 255
    return Surface.plain(vertices, faces, colours)


def _texture(image: Image.Image) -> np.ndarray:
    """RGB (h, w, 3) uint8, transparency on white."""
    image = image.convert("RGBA")
    image.thumbnail((_TEXTURE_SIZE, _TEXTURE_SIZE))
    ground = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(ground, image).convert("RGB"))


def _joined(parts: Sequence[Surface]) -> Surface:
    vertices = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    textures = np.cumsum([0] + [len(part.textures) for part in parts[:-1]])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, vertices, strict=True)]),
        np.concatenate([part.corner_colours for part in parts]),
        np.concatenate(
            [
                np.where(part.face_texture < 0, -1, part.face_texture + start)
                for part, start in zip(parts, textures, strict=True)
            ]
        ),
        np.concatenate([part.corner_uv for part in parts]),
        tuple(texture for part in parts for texture in part.textures),
    )
