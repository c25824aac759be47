"""What the other methods' networks have in common: how they are called, and how they are scored."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import ClassVar, TypeVar

import torch
from torch import Tensor, nn

from models.parts import prepare_images


@dataclasses.dataclass(frozen=True)
class BaselineConfig:
    """What every one of them has: its input size, and how many points stand for its shape.

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

    deterministic: ClassVar[bool] = True
    """They take no random codes."""


class Baseline(nn.Module, ABC):
    """Images in, clouds in the world frame out.

    It is called like a generator: `network(images, codes)`, with codes of no numbers at all. Predictions are made as
    after training, whatever the mode: no graph, running statistics in batch norms. What a loss needs on the way to the
    clouds is each network's own.
    """

    code_dim = 0
    reads_views_together: ClassVar[bool] = False
    """Does it make one cloud of several images? Otherwise each of them gives its own."""

    config: BaselineConfig

    @property
    def points(self) -> int:
        """To how many points its clouds are thinned for comparisons."""
        return self.config.points

    @property
    def profile(self) -> str:
        """Name of the size this network was built to."""
        return self.config.profile

    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        """(B, 3, H, W) images in [0, 1] on white and (R, B, 0) codes -> (R, B, N, 3), the same R times."""
        if codes.ndim != 3 or codes.shape[1:] != (len(images), self.code_dim):
            raise ValueError(
                f"{type(self).__name__}: 'codes' must be (R, {len(images)}, {self.code_dim}) to match the images; "
                f"got {tuple(codes.shape)}"
            )
        clouds = self.answers(images[:, None])[:, 0]
        return clouds.expand(len(codes), *clouds.shape)

    @torch.no_grad()
    def answers(self, images: Tensor) -> Tensor:
        """What it says to V images of each of B objects, as clouds that are to be judged one by one.

        Args:
            images: (B, V, 3, H, W) in [0, 1] on white, any H and W.

        Returns:
            (B, A, N, 3) points in the world frame; A is V, or 1 for a network that reads views together.
        """
        if images.ndim != 5 or images.shape[2] != 3 or 0 in images.shape:
            raise ValueError(
                f"{type(self).__name__}: 'images' must be (B, V, 3, H, W) in [0, 1]; got {tuple(images.shape)}"
            )
        training = self.training
        self.eval()
        clouds = self._answers(images)
        self.train(training)
        return clouds

    @abstractmethod
    def _answers(self, images: Tensor) -> Tensor:
        """`answers`, in eval mode and without a graph."""

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
            # A value of the output meets as many inputs as strided taps reach it.
            taps = 1.0
            for side, stride in zip(module.kernel_size, module.stride, strict=True):
                taps *= side / stride
            nn.init.normal_(module.weight, std=(2 / (taps * module.in_channels)) ** 0.5)
        else:
            continue
        if module.bias is not None:
            nn.init.zeros_(module.bias)
