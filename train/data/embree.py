"""Ray casting with embree, through embreex.

Rays leave the eye with z = 1 in the camera frame and are not normalised: embree's hit distance is the depth.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from train.data.surface import Hits, Surface
from train.errors import UserError


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
