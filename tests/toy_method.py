"""A method in one file, as a reader might add one: a box for every shape. test_methods.py registers it."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from models import Predictor
from models.baselines.base import Baseline, BaselineConfig
from train.config import FitConfig
from train.data.batches import Batch, Targets
from train.methods.base import Method, Noise, Step, TrainState, plain_recipe, plain_stage
from train.methods.losses import for_each_image, targets_of


class BoxNetwork(Baseline):
    """Predicts a shape's size in x, y and z from its image's mean colour, and fills the box with points."""

    grid: Tensor

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__()
        self.config = config
        self.size = nn.Linear(3, 3)
        self.register_buffer("grid", torch.rand(config.points, 3) - 0.5)

    def boxes(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, N, 3)."""
        return self.grid * self.size(self._prepare(images).mean((2, 3)))[:, None]

    def _answers(self, images: Tensor) -> Tensor:
        return self.boxes(images.flatten(0, 1)).unflatten(0, images.shape[:2])

    _predict = _answers


def size_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """Squared error of the size, as the standard deviation of the points."""
    assert isinstance(state.network, BoxNetwork)
    predicted = state.network.boxes(batch.images.flatten(0, 1))
    target = for_each_image(targets_of(batch).points, batch)
    return {"loss": (predicted.std(1) - target.std(1)).square().mean()}


class Boxes(Method):
    """The toy."""

    losses: ClassVar = {"stage1": size_loss}
    sizes: ClassVar = {"cpu": BaselineConfig(), "smoke": BaselineConfig("smoke", 32, 32, 128)}
    network_class = BoxNetwork
    weights_key = "boxes"

    def recipe(self, profile: str) -> FitConfig:
        return plain_recipe(
            self.name, profile, plain_stage(steps=40, shapes=4, rate=0.05), min_image_sensitivity=0
        )

    def build(self, config: FitConfig) -> Predictor:
        return BoxNetwork(self.network_config(config))

    def oracle(self, network: Predictor, targets: Targets) -> Tensor:
        """A box of each shape's size."""
        assert isinstance(network, BoxNetwork)
        return network.grid * (targets.points.std(1, keepdim=True) / network.grid.std(0))
