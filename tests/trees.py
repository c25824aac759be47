"""What the tests of data share: trees and files that are compared, damaged or turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import trimesh

from diffpoint.io import read_points, write_points
from train.data import Shape, ShapeTree, tree_files
from train.data.surface import Surface

Y_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""What Blender does to an OBJ file."""


def all_ids(root: Path) -> list[str]:
    return [shape for split in tree_files.SPLITS for shape in ShapeTree(root, split).ids]


def all_shapes(root: Path) -> list[Shape]:
    return [shape for split in tree_files.SPLITS for shape in ShapeTree(root, split).iter_valid()]


def files_of(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def turn_clouds(root: Path, turn: np.ndarray) -> None:
    """Multiplies every point of the tree's clouds by `turn` (3, 3)."""
    for path in (root / tree_files.CLOUDS).glob("*/*.ply"):
        write_points(path, read_points(path) @ torch.from_numpy(turn).float().T)


def plain_surface(mesh: trimesh.Trimesh, colour: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Surface:
    faces = np.asarray(mesh.faces)
    return Surface.plain(np.asarray(mesh.vertices), faces, np.tile(colour, (len(faces), 1)))


def four_boxes(rng: np.random.Generator) -> trimesh.Trimesh:
    """Boxes of different sizes, anywhere: it looks different from every side."""
    boxes = [trimesh.creation.box(rng.uniform(0.05, 0.4, 3)) for _ in range(4)]
    return trimesh.util.concatenate([box.apply_translation(rng.uniform(-0.3, 0.3, 3)) for box in boxes])
