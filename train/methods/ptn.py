"""PTN: voxels trained on silhouettes alone.

Source: Yan, Yang, Yumer, Guo, Lee, "Perspective transformer nets: learning single-view 3D object reconstruction without
3D supervision" (NeurIPS 2016).
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from models import Predictor
from models.baselines import PTN_PROFILES, SilhouetteReconstruction, build_ptn, silhouettes, surface_points
from train.config import FitConfig
from train.data.batches import Batch, Targets
from train.methods.base import Method, Noise, Step, TrainState, plain_recipe, plain_stage
from train.methods.losses import for_each_image, target_cameras, targets_of
from train.methods.voxel_targets import hull_cells


def silhouette_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """Half the squared error of the silhouettes, summed over pixels, in all cameras of the data."""
    network, depth = state.network, targets_of(batch).depth
    assert isinstance(network, SilhouetteReconstruction)
    occupancy = network.occupancy(batch.images.flatten(0, 1))
    predicted = silhouettes(occupancy, target_cameras(batch, torch.arange(depth.shape[1])))
    target = for_each_image(depth, batch).isfinite().float()
    return {"loss": 0.5 * (predicted - target).square().sum((2, 3)).mean(), "filled_share": occupancy.mean()}


class PTN(Method):
    """The silhouette network."""

    losses: ClassVar = {"stage1": silhouette_loss}
    sizes = PTN_PROFILES
    network_class = SilhouetteReconstruction
    weights_key = "ptn"

    def recipe(self, profile: str) -> FitConfig:
        # Full: the length is assumed.
        stage = {
            "full": plain_stage(steps=100_000, shapes=6, weight_decay=1e-3, rate=1e-4),
            "cpu": plain_stage(steps=4_000, shapes=6, warmup=100, rate=(5e-4, 5e-5)),
            "smoke": plain_stage(steps=12, shapes=3, rate=5e-4),
        }[profile]
        return plain_recipe(self.name, profile, stage, min_image_sensitivity=0.0)

    def build(self, config: FitConfig) -> Predictor:
        return build_ptn(config.profile)

    def oracle(self, network: Predictor, targets: Targets) -> Tensor:
        """The faces of the visual hull of the silhouettes."""
        assert isinstance(network, SilhouetteReconstruction)
        cells = network.inside * hull_cells(targets, network.grid_size)
        return surface_points(cells, network.points, threshold=0.5)
