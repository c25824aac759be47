"""What the other methods are taught with, made from surface points and depth maps: cells, and fixed views."""

from __future__ import annotations

import torch
from torch import Tensor

from diffpoint import PinholeCamera, project, splat_depth
from models.baselines import cell_centres, fixed_cameras
from train.data.batches import Targets

# World units: the gaps between the 2048 points of a surface are closed, and outlines grow by no more than this.
_POINT_RADIUS = 0.01


def solid_cells(truth: Targets, size: int) -> Tensor:
    """Which cells of the cube [-0.5, 0.5]^3 a shape fills: (B, G, G, G) bool, along x, y and z.

    A cell is empty when some view sees its centre lying before the surface or before nothing, or when its centre lies
    beside the box around the surface's points. The rest is filled, also what no view looks into; and so is every cell
    that holds a point of the surface: thin parts miss the centres.

    Args:
        truth: the shapes.
        size: G.

    Example:
        >>> eyes = torch.tensor([[[0.0, 0, -2], [0, 0, 2], [2, 0, 0], [-2, 0, 0]]])
        >>> camera = PinholeCamera.look_at(eyes, focal_px=40.0, height=32, width=32)
        >>> cube = torch.cartesian_prod(*[torch.linspace(-0.24, 0.24, 40)] * 3)[None]
        >>> cells = solid_cells(Targets(cube, splat_depth(cube, camera).depth, camera), 8)
        >>> cells[0, :, 4, 4].int().tolist()
        [0, 0, 1, 1, 1, 1, 0, 0]
    """
    centres = cell_centres(size).to(truth.points)
    inside, depth, surface = _seen_at(centres, truth)
    lowest, highest = truth.points.amin(1, keepdim=True), truth.points.amax(1, keepdim=True)
    in_box = ((centres >= lowest) & (centres <= highest)).all(-1)
    filled = in_box & ~(inside & (depth < surface)).any(1)
    cell = ((truth.points + 0.5) * size).floor().long()
    held = ((cell >= 0) & (cell < size)).all(-1)
    x, y, z = cell.unbind(-1)
    number = torch.where(held, (x * size + y) * size + z, size**3)  # beyond the grid: a cell that is cut off
    holds_point = torch.zeros(len(number), size**3 + 1, dtype=torch.bool).scatter_(1, number, True)[:, :-1]
    return (filled | holds_point).unflatten(1, (size, size, size))


def hull_cells(truth: Targets, size: int) -> Tensor:
    """Which cells of the cube [-0.5, 0.5]^3 no silhouette rules out: (B, G, G, G) bool, along x, y and z.

    A cell is left out when some view has an empty pixel where its centre is. This is the most that silhouettes say:
    hollows that no outline shows are filled.

    Args:
        truth: the shapes.
        size: G.

    Example:
        >>> camera = PinholeCamera.look_at(torch.tensor([[[0.0, 0, -9]]]), focal_px=288.0, height=32, width=32)
        >>> depth = torch.full((1, 1, 32, 32), torch.inf)
        >>> depth[..., 8:24] = 9.0  # a wall: nothing is known of how thick it is
        >>> hull_cells(Targets(torch.zeros(1, 1, 3), depth, camera), 8)[0, :, 4].int().tolist()[1:3]
        [[0, 0, 0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1, 1]]
    """
    inside, _, surface = _seen_at(cell_centres(size).to(truth.points), truth)
    return (surface.isfinite() | ~inside).all(1).unflatten(1, (size, size, size))


def _seen_at(centres: Tensor, truth: Targets) -> tuple[Tensor, Tensor, Tensor]:
    """(C, 3) places in the world -> (B, V, C) of each view: is a place in its picture, how deep is it, and the depth
    of what the picture shows there."""
    _, _, height, width = truth.depth.shape
    pixels, depth = project(centres.expand(len(truth.points), -1, -1), truth.camera)
    x, y = pixels.floor().long().unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depth > 0)
    surface = truth.depth.flatten(2).gather(2, torch.where(inside, y * width + x, 0))
    return inside, depth, surface


def fixed_depth(points: Tensor, size: int) -> Tensor:
    """Depth maps of surfaces before the eight fixed orthographic cameras of Lin et al.

    Args:
        points: (B, P, 3) on the surface, world frame.
        size: side of the maps, which cover one unit of the world.

    Returns:
        (B, 8, size, size), +inf where empty.

    Example:
        >>> fixed_depth(torch.zeros(1, 1, 3), 4)[0, 0].isfinite().sum().item()
        1
    """
    seen = fixed_cameras(points).flatten(0, 1)
    # A pinhole camera divides by the depth: multiplied by it before, points keep their place across.
    stretched = torch.cat([seen[..., :2] * seen[..., 2:], seen[..., 2:]], -1)
    K = torch.tensor([[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]])
    camera = PinholeCamera(K.to(points), torch.eye(4).to(points), size, size)
    depth = splat_depth(stretched.contiguous(), camera, radius=_POINT_RADIUS * size).depth
    return depth.reshape(len(points), -1, size, size)
