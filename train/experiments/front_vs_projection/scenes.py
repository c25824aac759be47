"""Scenes for free clouds: procedural shapes and meshes seen from any camera, shapes of a data tree from its own.

The frame of a scene is that of its first camera, in which the x and y of a gradient are that camera's to the last bit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from diffpoint import PinholeCamera
from train.data import ShapeTree, tree_files
from train.data.categories import category_of
from train.data.mesh_sources import find_meshes, read_labels, shape_ids
from train.data.meshes import MeshError, load_surface
from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.shrink import decimate_depth
from train.data.solids import sample_union, surface_of
from train.data.surface import Surface, sample_triangles
from train.errors import UserError

EMBEDDED = ("chair", "car", "airplane")
SIZE = 56
"""Pixels of a side of the depth maps, as in the paper."""
POINTS = 1024
_LABELS = Path(__file__).parents[2] / "data" / "furniture_labels.csv"
_SURFACE = 4096
_ELEVATION_DEG = 15.0
_GOLDEN_DEG = 180 * (3 - 5**0.5)


class Cameras(NamedTuple):
    """The cameras of a scene."""

    count: int
    sphere: bool = False
    """Spread over the whole sphere; otherwise equispaced on a circle, 15 degrees above the horizon."""

    @property
    def name(self) -> str:
        where = "sphere" if self.sphere else "horizontal"
        return f"{self.count} {where} view{'s' if self.count > 1 else ''}"

    def around(self, turn_deg: float) -> PinholeCamera:
        """(V,) cameras at distance 2 that look at the origin, turned about the vertical."""
        number = np.arange(self.count)
        if self.sphere:  # Fibonacci's lattice: no camera on the poles, where "up" has no meaning
            elevation = np.degrees(np.arcsin(1 - (2 * number + 1) / self.count))
            return orbit_camera(turn_deg + number * _GOLDEN_DEG, elevation, SIZE)
        elevation = np.full(self.count, _ELEVATION_DEG)
        return orbit_camera(turn_deg + number * 360 / self.count, elevation, SIZE)


class Scene(NamedTuple):
    """The input of a fit, and the ground truth for its errors; all in the frame of the first camera."""

    camera: PinholeCamera
    """V views."""
    depth: Tensor
    """(1, V, H, W) true depth maps, +inf where empty."""
    surface: Tensor
    """(1, 4096, 3) points of the whole shape, seen or not."""
    start: Tensor
    """(1, N, 3) the cloud that every fit starts from: uniform in a cube of side 1 around the shape."""


class StudyShape(NamedTuple):
    """A shape that can be seen from several `Cameras`. Names are unique in a study, and safe as a file's name."""

    name: str
    source: str
    """Where it comes from, for the reader of a table."""
    see: Callable[[Cameras, float], tuple[PinholeCamera, Tensor] | None]
    """Cameras and a turn in degrees to (camera (V,), depth (V, H, W)), world frame; None if it has no such views."""
    surface: Tensor
    """(4096, 3) points, world frame."""

    def scene(self, cameras: Cameras, *, seed: int, points: int = POINTS) -> Scene | None:
        """The views, turned at random, and a random cloud to start from; None if the shape has no such views."""
        random = np.random.default_rng(seed)
        seen = self.see(cameras, float(random.uniform(0, 360)))
        if seen is None:
            return None
        camera, depth = seen
        first_from_world = camera.cam_from_world[0].double()
        cam_from_first = (camera.cam_from_world.double() @ torch.linalg.inv(first_from_world)).float()
        cam_from_first[0] = torch.eye(4)
        start = torch.from_numpy(random.uniform(-0.5, 0.5, (points, 3))).float()
        surface, start = (
            (cloud.double() @ first_from_world[:3, :3].T + first_from_world[:3, 3]).float()[None]
            for cloud in (self.surface, start)
        )
        frame = PinholeCamera(camera.K.float(), cam_from_first, camera.height, camera.width)
        return Scene(frame, depth[None].float(), surface, start)


def embedded_shape(category: str, seed: int = 0) -> StudyShape:
    """A shape of an embedded family.

    Example:
        >>> scene = embedded_shape("chair").scene(Cameras(2), seed=0, points=100)
        >>> scene.depth.shape, scene.start.shape
        (torch.Size([1, 2, 56, 56]), torch.Size([1, 100, 3]))
    """
    solids = variants_of(category, seed)[0]
    points = sample_union(solids, _SURFACE, np.random.default_rng(seed))
    return _rendered(f"embedded_{category}", "embedded", surface_of(solids), points)


def shapes_of(data: Sequence[Path], *, limit: int) -> list[StudyShape]:
    """Shapes from data trees and from sources of meshes, at most `limit` of each tree and of all meshes together.

    Args:
        data: data trees, whose test shapes are seen from their own views only, and what the `data meshes` command
            takes: folders, archives and files of meshes, seen from everywhere.
        limit: how many; different categories first.

    Raises:
        UserError: a path that is neither, or nothing usable in it.
    """
    trees = [path for path in data if (path / tree_files.RENDERS).is_dir()]
    sources = [path for path in data if path not in trees]
    shapes = []
    for tree in trees:
        split = ShapeTree(tree, "test")
        order = _varied(shape.split("/")[0] for shape in split.ids)
        shapes += [_own_views(split, number, tree.name) for number in order[:limit]]
    return shapes + (_of_meshes(sources, limit) if sources else [])


def _of_meshes(sources: Sequence[Path], limit: int) -> list[StudyShape]:
    labels = {(label.library, label.model): label.synset for label in read_labels(_LABELS)}
    shapes = []
    with tempfile.TemporaryDirectory(prefix="meshes-") as scratch:
        meshes, _ = find_meshes(sources, scratch)
        # The labelled ones of an archive of furniture first: the rest of it is plants, lights and window frames.
        known = [mesh for mesh in meshes if (mesh.library, mesh.inside) in labels] or meshes
        kinds = [category_of(labels.get((mesh.library, mesh.inside), mesh.synset)) for mesh in known]
        names = [shape.split("/")[-1] for shape in shape_ids(known)]
        for number in _varied(kinds):
            mesh = known[number]
            try:
                surface = load_surface(mesh.path, mesh.rotation)
            except MeshError:
                continue
            corners = surface.vertices[surface.faces]
            points, _ = sample_triangles(corners, _SURFACE, np.random.default_rng(0))
            shapes.append(_rendered(f"{kinds[number]}_{names[number]}", mesh.library, surface, points))
            if len(shapes) == limit:
                break
    if not shapes:
        raise UserError(f"no usable mesh in {', '.join(map(str, sources))}")
    return shapes


def _rendered(name: str, source: str, surface: Surface, points: np.ndarray) -> StudyShape:
    renderer = Renderer(surface)

    def see(cameras: Cameras, turn_deg: float) -> tuple[PinholeCamera, Tensor]:
        views = renderer.render(cameras.around(turn_deg))
        return views.camera, torch.from_numpy(views.depth)

    return StudyShape(name, source, see, torch.from_numpy(points).float())


def _own_views(split: ShapeTree, number: int, source: str) -> StudyShape:
    shape = split[number]

    def see(cameras: Cameras, turn_deg: float) -> tuple[PinholeCamera, Tensor] | None:
        views = len(shape.depth)
        if cameras.sphere or views % cameras.count or shape.depth.shape[-1] % SIZE:
            return None
        first = int(turn_deg / 360 * views)
        chosen = (first + torch.arange(cameras.count) * views // cameras.count) % views
        depth, camera = decimate_depth(shape.depth, shape.camera, size=SIZE)
        return camera[chosen], depth[chosen]

    return StudyShape(f"{shape.category}_{shape.id.split('/')[-1]}", source, see, shape.points)


def _varied(kinds: Iterable[str]) -> list[int]:
    """Positions of the first of every kind, then of the second of every kind, and so on; the largest kinds first.

    Example:
        >>> _varied(["car", "lamp", "lamp"])
        [1, 0, 2]
    """
    kind = pd.Series(list(kinds), dtype=str)
    group = kind.groupby(kind)
    order = pd.DataFrame({"rank": group.cumcount(), "less": -group.transform("size"), "kind": kind})
    return order.sort_values(["rank", "less", "kind"]).index.tolist()
