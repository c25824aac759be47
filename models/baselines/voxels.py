"""From an occupancy grid to points on its surface.

A grid (G, G, G) divides the cube [-0.5, 0.5]^3 of the world, along x, y and z in this order.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

# Cells that count as occupied where none reaches the threshold: a prediction must have points.
_FEWEST_CELLS = 8

# The steps of the plane's most even sequence of points (Roberts' generalisation of the golden ratio).
_EVEN_STEPS = (0.7548776662466927, 0.5698402909980532)


def cell_centres(size: int) -> Tensor:
    """(size^3, 3) world coordinates of the centres of a grid's cells, z fastest.

    Example:
        >>> cell_centres(2)[1].tolist()
        [-0.25, -0.25, 0.25]
    """
    axis = (torch.arange(size) + 0.5) / size - 0.5
    return torch.cartesian_prod(axis, axis, axis)


def surface_points(occupancy: Tensor, count: int, *, threshold: float) -> Tensor:
    """Points spread evenly over the faces that separate occupied from empty cells.

    The faces are equal squares; the numbers of their points differ by one at most, and their places follow a
    low-discrepancy sequence. Deterministic.

    Args:
        occupancy: (B, G, G, G) in [0, 1].
        count: points per cloud.
        threshold: least occupancy of an occupied cell; in a grid without one, the eight most occupied cells count.

    Returns:
        (B, count, 3) in the world frame.

    Example:
        >>> grid = torch.zeros(1, 4, 4, 4)
        >>> grid[0, 1:3, 1:3, 1:3] = 1.0
        >>> points = surface_points(grid, 96, threshold=0.5)  # a cube from -0.25 to 0.25 along every axis
        >>> points.abs().amax(-1).unique().tolist()
        [0.25]
    """
    likeliest = occupancy.flatten(1).topk(min(_FEWEST_CELLS, occupancy[0].numel())).values
    least = torch.where(likeliest[:, 0] < threshold, likeliest[:, -1], threshold)
    occupied = occupancy >= least[:, None, None, None]
    return torch.stack([_on_faces(grid, count) for grid in occupied])


def _on_faces(occupied: Tensor, count: int) -> Tensor:
    """(G, G, G) bool -> (count, 3)."""
    size = len(occupied)
    padded = F.pad(occupied, (1,) * 6)
    inside = (slice(1, -1),) * 3
    exposed = torch.stack(
        [occupied & ~padded.roll(-step, axis)[inside] for axis in range(3) for step in (-1, 1)]
    )
    faces = exposed.nonzero()  # (Q, 4): direction, cell
    device = occupied.device
    number = torch.arange(count, device=device)
    face = faces[number * len(faces) // count]
    axis, outward = face[:, 0] // 2, face[:, 0] % 2
    places = (number[:, None] * torch.tensor(_EVEN_STEPS, dtype=torch.float64, device=device)) % 1
    # Within the cell the coordinate along the face's normal is 0 or 1, the other two are places.
    offset = torch.empty(count, 3, device=device)
    across = torch.tensor([[1, 2], [0, 2], [0, 1]], device=device)[axis]
    offset.scatter_(1, across, places.float())
    offset.scatter_(1, axis[:, None], outward[:, None].float())
    return (face[:, 1:] + offset) / size - 0.5
