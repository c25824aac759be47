"""Targets of methods that predict voxels, from the depth maps and surface points of a shape."""

from __future__ import annotations

import torch
from torch import Tensor

from diffpoint import project
from models.baselines import cell_centres
from train.data.batches import Targets


def solid_cells(targets: Targets, size: int) -> Tensor:
    """Which cells of the cube [-0.5, 0.5]^3 a shape fills: (B, G, G, G) bool, along x, y and z.

    A cell is empty when in some view its centre lies in front of the surface or of an empty pixel, or when its centre
    lies outside the bounding box of the surface points. All other cells are filled, including those that no view sees,
    and so is every cell that contains a surface point: the centres of cells miss thin parts.

    Args:
        targets: the shapes.
        size: G.

    Example:
        >>> eyes = torch.tensor([[[0.0, 0, -2], [0, 0, 2], [2, 0, 0], [-2, 0, 0]]])
        >>> camera = PinholeCamera.look_at(eyes, focal_px=40.0, height=32, width=32)
        >>> cube = torch.cartesian_prod(*[torch.linspace(-0.24, 0.24, 40)] * 3)[None]
        >>> cells = solid_cells(Targets(cube, splat_depth(cube, camera).depth, camera), 8)
        >>> cells[0, :, 4, 4].int().tolist()
        [0, 0, 1, 1, 1, 1, 0, 0]
    """
    centres = cell_centres(size).to(targets.points)
    inside, depth, surface = _look_up(centres, targets)
    lowest, highest = targets.points.amin(1, keepdim=True), targets.points.amax(1, keepdim=True)
    in_box = ((centres >= lowest) & (centres <= highest)).all(-1)
    filled = in_box & ~(inside & (depth < surface)).any(1)
    cell = ((targets.points + 0.5) * size).floor().long()
    held = ((cell >= 0) & (cell < size)).all(-1)
    x, y, z = cell.unbind(-1)
    number = torch.where(held, (x * size + y) * size + z, size**3)  # beyond the grid: a cell that is cut off
    holds_point = number.new_zeros(len(number), size**3 + 1, dtype=torch.bool).scatter_(1, number, True)[
        :, :-1
    ]
    return (filled | holds_point).unflatten(1, (size, size, size))


def hull_cells(targets: Targets, size: int) -> Tensor:
    """Which cells of the cube [-0.5, 0.5]^3 no silhouette rules out: (B, G, G, G) bool, along x, y and z.

    A cell is empty when its centre projects to an empty pixel of some view. This is the visual hull, the most that
    silhouettes determine: hollows that no silhouette shows are filled.

    Args:
        targets: the shapes.
        size: G.

    Example:
        >>> camera = PinholeCamera.look_at(torch.tensor([[[0.0, 0, -9]]]), focal_px=288.0, height=32, width=32)
        >>> depth = torch.full((1, 1, 32, 32), torch.inf)
        >>> depth[..., 8:24] = 9.0  # a wall of unknown thickness
        >>> hull_cells(Targets(torch.zeros(1, 1, 3), depth, camera), 8)[0, :, 4].int().tolist()[1:3]
        [[0, 0, 0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 1]]
    """
    inside, _, surface = _look_up(cell_centres(size).to(targets.points), targets)
    return (surface.isfinite() | ~inside).all(1).unflatten(1, (size, size, size))


def _look_up(centres: Tensor, targets: Targets) -> tuple[Tensor, Tensor, Tensor]:
    """(C, 3) world points -> (B, V, C) for each view: is the point inside the image, its depth, and the depth of the
    surface that the view sees in its pixel."""
    _, _, height, width = targets.depth.shape
    pixels, depth = project(centres.expand(len(targets.points), -1, -1), targets.camera)
    x, y = pixels.floor().long().unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depth > 0)
    surface = targets.depth.flatten(2).gather(2, torch.where(inside, y * width + x, 0))
    return inside, depth, surface
