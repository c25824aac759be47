"""3D-R2N2: a recurrent network that reads several images of a shape and predicts its voxels.

Source: Choy, Xu, Gwak, Chen, Savarese, "3D-R2N2: A unified approach for single and multi-view 3D object reconstruction"
(ECCV 2016).
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from models import Predictor
from models.baselines import R2N2_PROFILES, RecurrentReconstruction, build_r2n2, surface_points
from train.config import FitConfig, InferenceConfig
from train.data.batches import Batch, Targets
from train.methods.base import Method, Noise, Step, TrainState, plain_recipe, plain_stage
from train.methods.losses import targets_of
from train.methods.voxel_targets import solid_cells


def voxel_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """Cross entropy of each voxel after one to V images; how many is drawn at each step for the whole batch."""
    network, images = state.network, batch.images
    assert isinstance(network, RecurrentReconstruction)
    random = torch.Generator().manual_seed(step.number)
    count = 1 + int(torch.randint(images.shape[1], (), generator=random))
    logits = network.logits(images[:, :count])
    cells = solid_cells(targets_of(batch), network.grid_size)
    filled = logits[:, 1] > logits[:, 0]
    shared = (filled & cells).sum((1, 2, 3))
    either = (filled | cells).sum((1, 2, 3))
    return {"loss": F.cross_entropy(logits, cells.long()), "overlap": (shared / either.clamp(min=1)).mean()}


class R2N2(Method):
    """Two phases with one loss: the second continues with a tenth of the step size."""

    losses: ClassVar = {"stage1": voxel_loss, "stage2": voxel_loss}
    sizes = R2N2_PROFILES
    network_class = RecurrentReconstruction
    weights_key = "r2n2"

    def recipe(self, profile: str) -> FitConfig:
        # Full: a tenth of the step size after a third of the steps, as published.
        stages = {
            "full": (
                plain_stage(steps=20_000, shapes=24, views=5, weight_decay=5e-5, rate=1e-4),
                plain_stage(steps=40_000, shapes=24, views=5, weight_decay=5e-5, rate=1e-5),
            ),
            "cpu": (
                plain_stage(steps=3_000, shapes=4, views=3, warmup=100, rate=1e-3),
                plain_stage(steps=1_000, shapes=4, views=3, rate=(2e-4, 2e-5)),
            ),
            "smoke": (
                plain_stage(steps=12, shapes=3, views=2, rate=1e-3),
                plain_stage(steps=6, shapes=3, views=2, rate=1e-4),
            ),
        }[profile]
        # It reads the views together, and gives one prediction of all.
        inference = InferenceConfig(groups=1, steps=0, scored="joined")
        return plain_recipe(self.name, profile, *stages, inference=inference, min_image_sensitivity=0.0)

    def build(self, config: FitConfig) -> Predictor:
        return build_r2n2(config.profile)

    def oracle(self, network: Predictor, targets: Targets) -> Tensor:
        """The faces of the voxels that a shape fills."""
        assert isinstance(network, RecurrentReconstruction)
        cells = solid_cells(targets, network.grid_size).float()
        return surface_points(cells, network.points, threshold=0.5)
