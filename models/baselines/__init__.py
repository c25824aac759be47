"""Networks of the methods that the paper compares with; others of them train the conditional generator differently."""

from __future__ import annotations

from models.baselines.base import Baseline, BaselineConfig
from models.baselines.lin import (
    LIN_PROFILES,
    LinConfig,
    Structure,
    StructureGenerator,
    build_lin,
    fixed_cameras,
    pixel_centres,
)
from models.baselines.psgn import build_psgn
from models.baselines.ptn import PTN_PROFILES, PTNConfig, SilhouetteReconstruction, build_ptn, silhouettes
from models.baselines.r2n2 import R2N2_PROFILES, R2N2Config, RecurrentReconstruction, build_r2n2
from models.baselines.voxels import cell_centres, surface_points

__all__ = [
    "LIN_PROFILES",
    "PTN_PROFILES",
    "R2N2_PROFILES",
    "Baseline",
    "BaselineConfig",
    "LinConfig",
    "PTNConfig",
    "R2N2Config",
    "RecurrentReconstruction",
    "SilhouetteReconstruction",
    "Structure",
    "StructureGenerator",
    "build_lin",
    "build_psgn",
    "build_ptn",
    "build_r2n2",
    "cell_centres",
    "fixed_cameras",
    "pixel_centres",
    "silhouettes",
    "surface_points",
]
