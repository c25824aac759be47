"""What each method would answer had it learnt its lesson without an error: how good answers of its kind can be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from models import Predictor
from models.baselines import (
    RecurrentReconstruction,
    SilhouetteReconstruction,
    Structure,
    StructureGenerator,
    pixel_centres,
    surface_points,
)
from train.data.batches import Targets
from train.methods.targets import fixed_depth, hull_cells, solid_cells

Ideal = Callable[[Any, Targets], Tensor]
"""(network, truth of B shapes) -> (B, N, 3) clouds in the world frame, as the network itself would state them."""


def sampled_surface(network: Predictor, truth: Targets) -> Tensor:
    """PSGN: as many points of the surface as it has."""
    return truth.points[:, : network.points].contiguous()


def fused_maps(network: StructureGenerator, truth: Targets) -> Tensor:
    """Lin et al.: the maps of the eight fixed cameras, put together."""
    size = network.config.map_size
    depth = fixed_depth(truth.points, size)
    pixels = pixel_centres(size).expand(*depth.shape[:2], -1, -1, -1)
    return network.answer_of(Structure(pixels, depth, logits=depth.isfinite().to(depth) - 0.5))


def true_cells(network: RecurrentReconstruction, truth: Targets) -> Tensor:
    """3D-R2N2: the faces of the cells that a shape fills."""
    return surface_points(solid_cells(truth, network.grid_size).float(), network.points, threshold=0.5)


def hull(network: SilhouetteReconstruction, truth: Targets) -> Tensor:
    """PTN: the faces of all that the silhouettes leave."""
    cells = network.inside * hull_cells(truth, network.grid_size)
    return surface_points(cells, network.points, threshold=0.5)
