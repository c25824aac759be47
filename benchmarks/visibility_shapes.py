"""Shapes with known visibility: clouds on meshes, and by ray casting what each camera really sees of them."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffpoint as dp
from train.data.categories import category_of
from train.data.embree import load_embree
from train.data.meshes import MeshError, load_surface
from train.data.procedural import variants_of
from train.data.render import draw_camera
from train.data.solids import sample_union, surface_of
from train.data.sources import find_meshes, keep_labelled, read_labels
from train.data.surface import Surface, sample_triangles

FURNITURE = Path("/usr/share/sweethome3d/furniture")
LABELS = Path(__file__).parents[1] / "train/data/furniture_labels.csv"
MEASURED = ("BlendSwap-CC-0.sh3f", "BlendSwap-CC-BY.sh3f")
"""The libraries that methods are compared on; other libraries, by other authors, fit the filters."""
FITTED = ("KatorLegaz.sh3f", "Scopia.sh3f")
CATEGORIES = ("chair", "table", "sofa", "cabinet", "lamp")
EPSILON = 0.002  # what hides a point lies at least so far before it; the shapes' diagonal is 1
_DIRECTIONS = 48  # from which a point must be seen at least once, or it is inside the shape
VIEWS = 8


@dataclasses.dataclass(frozen=True)
class Scene:
    """One shape: clouds by their number of points, its cameras (V,), and what is hidden (V, N) in each."""

    name: str
    category: str
    camera: dp.PinholeCamera
    clouds: dict[int, Tensor]
    hidden: dict[int, Tensor]


def mesh_scenes(sources: Sequence[Path], counts: Sequence[int], *, per_category: int) -> Iterator[Scene]:
    """Up to `per_category` shapes of each category in archives or folders of meshes; unreadable ones are skipped."""
    with tempfile.TemporaryDirectory(prefix="visibility-") as scratch:
        meshes, _ = find_meshes(sources, Path(scratch))
        if all(source.parent == FURNITURE for source in sources):
            meshes, _ = keep_labelled(meshes, read_labels(LABELS), LABELS)
            wanted = CATEGORIES
        else:
            wanted = sorted({category_of(mesh.synset) for mesh in meshes})
        for category in wanted:
            found = [mesh for mesh in meshes if category_of(mesh.synset) == category]
            for mesh in found[:: max(1, len(found) // per_category)][:per_category]:
                try:
                    surface = load_surface(mesh.path, mesh.rotation)
                except MeshError:
                    continue
                yield _scene(mesh.inside, category, surface, counts)


def procedural_scenes(seeds: Sequence[int], counts: Sequence[int]) -> Iterator[Scene]:
    for seed in seeds:
        for category in ("chair", "display"):
            variants = variants_of(category, seed)
            solids = variants[seed % len(variants)]
            yield _scene(f"seed {seed}", f"procedural {category}", surface_of(solids), counts, solids)


def _scene(
    name: str, category: str, surface: Surface, counts: Sequence[int], solids: list | None = None
) -> Scene:
    rng = np.random.default_rng(len(surface.faces))
    rays = Rays(surface)
    camera = draw_camera(rng, VIEWS, 224)
    clouds, hidden = {}, {}
    for count in counts:
        points = sample_union(solids, count, rng) if solids else _sample_outside(surface, rays, count, rng)
        eyes = camera.position.double().numpy()
        clouds[count] = torch.from_numpy(points).float()
        hidden[count] = torch.from_numpy(np.stack([rays.blocked(eye, points) for eye in eyes]))
    return Scene(name, category, camera.to(dtype=torch.float32), clouds, hidden)


def _sample_outside(surface: Surface, rays: Rays, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points, uniform by area on what can be seen from some direction: meshes have unseen insides."""
    step = np.arange(_DIRECTIONS) + 0.5
    y = 1 - 2 * step / _DIRECTIONS
    turn = np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - y * y)
    eyes = 2 * np.stack((ring * np.cos(turn), y, ring * np.sin(turn)), axis=-1)
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        points, _ = sample_triangles(surface.vertices[surface.faces], 4 * count, rng)
        unseen = np.ones(len(points), bool)
        for eye in eyes:
            unseen[unseen] = rays.blocked(eye, points[unseen])
        kept.append(points[~unseen])
    return np.concatenate(kept)[:count]


class Rays:
    """Ray casting against one surface."""

    def __init__(self, surface: Surface) -> None:
        rtcore_scene, mesh_construction = load_embree()
        self._scene: Any = rtcore_scene.EmbreeScene()
        mesh_construction.TriangleMesh(
            scene=self._scene,
            vertices=np.ascontiguousarray(surface.vertices, np.float32),
            indices=np.ascontiguousarray(surface.faces, np.int32),
        )

    def blocked(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(N,): the segment from the eye to the point meets the surface more than EPSILON before its end."""
        way = points - eye
        length = np.linalg.norm(way, axis=1)
        directions = (way / np.maximum(length, 1e-9)[:, None]).astype(np.float32)
        origins = np.broadcast_to(eye.astype(np.float32), directions.shape).copy()
        hits = self._scene.run(origins, directions, output=True)
        return (hits["primID"] >= 0) & (hits["tfar"] < length - EPSILON)
