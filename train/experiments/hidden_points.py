"""Which points of a cloud are hidden, by ray casting against its mesh; and how accurate `visible_points` is."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffpoint import PinholeCamera, visible_points
from diffpoint.visibility import Method
from train.data.procedural import variants_of
from train.data.rays import EmbreeCaster
from train.data.render import draw_camera
from train.data.solids import sample_union, surface_of
from train.data.surface import Surface

EPSILON = 0.002
"""World units: a point is hidden if the surface that its ray meets first is nearer by at least this."""
VIEWS = 8
_FRAME = 224  # pixels of a side; cameras are resized to each map


@dataclasses.dataclass(frozen=True)
class Scene:
    """One shape, sampled, and how far its samples are hidden.

    Attributes:
        name: of the shape.
        category: of the shape.
        camera: (V,) float32.
        clouds: number of points N -> (N, 3) float32.
        behind: number of points N -> (V, N) float64: distance of each point behind what its ray meets first.
        epsilon: from which distance a point counts as hidden.
    """

    name: str
    category: str
    camera: PinholeCamera
    clouds: dict[int, Tensor]
    behind: dict[int, Tensor]
    epsilon: float = EPSILON

    @property
    def hidden(self) -> dict[int, Tensor]:
        """Number of points N -> (V, N) bool: the points that each camera does not see."""
        return {count: behind > self.epsilon for count, behind in self.behind.items()}


def make_scene(
    name: str,
    category: str,
    surface: Surface,
    counts: Sequence[int],
    sample: Callable[[int, np.random.Generator], np.ndarray],
) -> Scene:
    """A surface from 8 of the paper's views, with clouds of several sizes.

    Faces inside the surface may stay: a ray from outside never meets them first. Points (N, 3) come from
    `sample(N, rng)`, which draws them on the outside.

    Raises:
        UserError: embree does not run here.
    """
    rng = np.random.default_rng(len(surface.faces))
    rays = Rays(surface)
    camera = draw_camera(rng, VIEWS, _FRAME)
    eyes = camera.position.double().numpy()
    clouds, behind = {}, {}
    for count in counts:
        points = sample(count, rng)
        clouds[count] = torch.from_numpy(points).float()
        behind[count] = torch.from_numpy(np.stack([rays.behind(eye, points) for eye in eyes]))
    return Scene(name, category, camera.to(dtype=torch.float32), clouds, behind)


def embedded_scene(category: str, seed: int, counts: Sequence[int]) -> Scene:
    """The scene of an embedded shape, sampled on the outside of the union of its solids."""
    variants = variants_of(category, seed)
    solids = variants[seed % len(variants)]
    sample = functools.partial(sample_union, solids)
    return make_scene(f"seed {seed}", f"procedural {category}", surface_of(solids), counts, sample)


class Rays(EmbreeCaster):
    """Ray casting from an eye to points, against one surface."""

    def behind(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(N,) distance of each point (N, 3) behind what the ray to it meets first; 0 if that is the point itself."""
        way = points - eye
        length = np.linalg.norm(way, axis=1)
        directions = (way / np.maximum(length, 1e-9)[:, None]).astype(np.float32)
        origins = np.broadcast_to(eye.astype(np.float32), directions.shape).copy()
        hits = self._scene.run(origins, directions, output=True)
        return np.where(hits["primID"] >= 0, np.maximum(length - hits["tfar"], 0.0), 0.0)


def quality(
    scenes: Sequence[Scene], count: int, size: int, method: Method, **options: Any
) -> dict[str, float]:
    """The share of hidden points that `visible_points` keeps, and the share of visible points that it finds.

    Args:
        scenes: with the epsilon of each.
        count: points of the clouds.
        size: pixels of a side of the map.
        method: see `visible_points`.
        options: others of `visible_points`: radius, tolerance.

    Returns:
        Means over all views of all scenes: "hidden", the share of hidden points among those kept (1 - precision), and
        "recall", the share of the visible points that are kept.
    """
    shares = []
    for scene in scenes:
        camera, cloud = scene.camera.resize(size, size), scene.clouds[count][None]
        kept = visible_points(cloud, camera, method=method, **options)[0]
        hidden = scene.hidden[count]
        of_kept = (kept & hidden).sum(1) / kept.sum(1).clamp(min=1)
        shares.append(torch.stack((of_kept, (kept & ~hidden).sum(1) / (~hidden).sum(1).clamp(min=1))))
    means = torch.cat(shares, 1).mean(1).tolist()
    return dict(zip(("hidden", "recall"), means, strict=True))
