"""Coloured triangles, which the renderer draws and from which ground-truth clouds are sampled."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Surface:
    """Triangles with colour. World frame, y up.

    Attributes:
        vertices: (V, 3) float.
        faces: (F, 3) int.
        corner_colours: (F, 3, 3) float32 in [0, 1]: RGB at the corners of each face; a texture is multiplied by them.
        face_texture: (F,) int, index into `textures`, or -1 for none.
        corner_uv: (F, 3, 2) float32, v up; read where `face_texture` >= 0.
        textures: images (h, w, 3) uint8.
        missing_files: names of files that the mesh's file names and that were not found or cannot be read.
    """

    vertices: np.ndarray
    faces: np.ndarray
    corner_colours: np.ndarray
    face_texture: np.ndarray
    corner_uv: np.ndarray
    textures: tuple[np.ndarray, ...] = ()
    missing_files: tuple[str, ...] = ()

    @staticmethod
    def plain(vertices: np.ndarray, faces: np.ndarray, face_colours: np.ndarray) -> Surface:
        """A surface with one colour (F, 3) per face."""
        count = len(faces)
        return Surface(
            vertices,
            faces,
            np.repeat(face_colours[:, None], 3, axis=1).astype(np.float32),
            np.full(count, -1),
            np.zeros((count, 3, 2), np.float32),
        )


def sample_triangles(
    triangles: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3), uniform by area on triangles (F, 3, 3), and the triangle (count,) of each."""
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    weights = rng.random((count, 2))
    over = weights.sum(1) > 1
    weights[over] = 1 - weights[over]
    return triangles[face, 0] + np.einsum("nk,nkc->nc", weights, edges[face]), face
