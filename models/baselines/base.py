"""What the networks of the baselines have in common: they take no random codes, and predict without a graph."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from typing import TypeVar

import torch
from torch import Tensor, nn

from models.parts import prepare_images
from models.predictor import Predictor


@dataclasses.dataclass(frozen=True)
class BaselineConfig:
    """What every baseline has: its input size, and the number of points of its predictions in comparisons.

    Attributes:
        profile: name of the size, for the record.
        image_height: height to which every image is resized.
        image_width: width to which every image is resized.
        points: size to which clouds are thinned before methods are compared; as many as one prediction of the
            conditional generator of the same profile has.
    """

    profile: str = "cpu"
    image_height: int = 64
    image_width: int = 64
    points: int = 512


class Baseline(Predictor):
    """A predictor without random codes: it accepts codes of length 0.

    Predictions are always made in eval mode (running statistics in batch norms) and without a graph, whatever mode the
    network is in. What its loss needs on the way to the clouds are methods of each network.
    """

    config: BaselineConfig

    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        """(B, 3, H, W) images and (R, B, 0) codes -> (R, B, N, 3), the same prediction R times."""
        self.check_codes(codes, len(images))
        clouds = self.predict_views(images[:, None])[:, 0]
        return clouds.expand(len(codes), *clouds.shape)

    @torch.no_grad()
    def predict_views(self, images: Tensor, codes: Tensor | None = None) -> Tensor:
        """(B, V, 3, H, W) images -> (B, K, N, 3) points, K = 1 where views are read together; codes are ignored."""
        del codes
        self.check_views(images)
        training = self.training
        self.eval()
        clouds = self._predict(images)
        self.train(training)
        return clouds

    @abstractmethod
    def _predict(self, images: Tensor) -> Tensor:
        """`predict_views` in eval mode and without a graph."""

    def _prepare(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, 3, image_height, image_width), centred."""
        return prepare_images(images, (self.config.image_height, self.config.image_width))


_Config = TypeVar("_Config", bound=BaselineConfig)


def choose_config(
    builder: str, profiles: dict[str, _Config], profile: str, config: _Config | None
) -> _Config:
    """The configuration given, or that of a profile.

    Raises:
        ValueError: no such profile.
    """
    if config is not None:
        return config
    if profile not in profiles:
        raise ValueError(f"{builder}: 'profile' must be one of {', '.join(profiles)}; got {profile!r}")
    return profiles[profile]


def initialise_rectified(network: nn.Module) -> None:
    """Draws weights that keep the second moment of activations between rectifiers (He et al., 2015); no biases."""
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.Conv3d, nn.Linear)):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        elif isinstance(module, nn.ConvTranspose3d):
            # Of a strided transposed kernel only a part of the taps contributes to each output value.
            taps = 1.0
            for side, stride in zip(module.kernel_size, module.stride, strict=True):
                taps *= side / stride
            nn.init.normal_(module.weight, std=(2 / (taps * module.in_channels)) ** 0.5)
        else:
            continue
        if module.bias is not None:
            nn.init.zeros_(module.bias)
