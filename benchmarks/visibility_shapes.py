"""Shapes with known visibility: clouds on meshes, and by ray casting what each camera really sees of them."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from train.data.categories import category_of
from train.data.mesh_sources import find_meshes, keep_labelled, read_labels
from train.data.meshes import MeshError, load_surface
from train.data.surface import Surface, sample_triangles
from train.experiments.hidden_points import EPSILON, Rays, Scene, embedded_scene, make_scene

FURNITURE = Path("/usr/share/sweethome3d/furniture")
LABELS = Path(__file__).parents[1] / "train/data/furniture_labels.csv"
MEASURED = ("BlendSwap-CC-0.sh3f", "BlendSwap-CC-BY.sh3f")
"""The libraries that methods are compared on; other libraries, by other authors, fit the filters."""
FITTED = ("KatorLegaz.sh3f", "Scopia.sh3f")
CATEGORIES = ("chair", "table", "sofa", "cabinet", "lamp")
_DIRECTIONS = 48  # from which a point must be seen at least once, or it is inside the shape


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
                sample = functools.partial(_sample_outside, surface, Rays(surface))
                yield make_scene(mesh.inside, category, surface, counts, sample)


def procedural_scenes(seeds: Sequence[int], counts: Sequence[int]) -> Iterator[Scene]:
    for seed in seeds:
        for category in ("chair", "display"):
            yield embedded_scene(category, seed, counts)


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
            unseen[unseen] = rays.behind(eye, points[unseen]) > EPSILON
        kept.append(points[~unseen])
    return np.concatenate(kept)[:count]
