"""The interface of every network that turns images into point clouds: our generator and the baselines alike.

Evaluation, validation and inference are written against `Predictor` alone; what a network's loss needs on the way to
its clouds is each network's own.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn


class PredictorConfig(Protocol):
    """The part of a network's configuration that all networks have in common."""

    @property
    def profile(self) -> str:
        """Name of the size, for the record."""
        ...

    @property
    def image_height(self) -> int:
        """Height to which every image is resized."""
        ...

    @property
    def image_width(self) -> int:
        """Width to which every image is resized."""
        ...

    @property
    def points(self) -> int:
        """See `Predictor.points`."""
        ...


class Predictor(nn.Module, ABC):
    """Images and random codes in, point clouds in the world frame out. Inputs are in [0, 1] on white, of any size."""

    config: PredictorConfig

    code_dim: ClassVar[int] = 0
    """Length D of a random code; 0 where the network takes none."""
    reads_views_together: ClassVar[bool] = False
    """True: one cloud is made of all views of an object. False: every view gives a cloud of its own."""
    joins_views: ClassVar[bool] = False
    """True: the clouds of an object's views are concatenated into one. False: each is a complete prediction."""

    @property
    def takes_codes(self) -> bool:
        """Whether predictions depend on the random codes."""
        return self.code_dim > 0

    @property
    def points(self) -> int:
        """Number of points N of a prediction; larger predictions are thinned to it before methods are compared."""
        return self.config.points

    @property
    def profile(self) -> str:
        """Name of the size this network was built to."""
        return self.config.profile

    @property
    def device(self) -> torch.device:
        """Where its weights are, and where its inputs must be; the CPU for a network without weights."""
        weights = next(itertools.chain(self.parameters(), self.buffers()), None)
        return torch.device("cpu") if weights is None else weights.device

    @abstractmethod
    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        """(B, 3, H, W) images and (R, B, D) codes from N(0, 1) -> (R, B, N, 3) points: R predictions of each image."""

    @abstractmethod
    def predict_views(self, images: Tensor, codes: Tensor | None = None) -> Tensor:
        """Predictions from V views of each of B objects, without a graph.

        Args:
            images: (B, V, 3, H, W).
            codes: (B, V, D) from N(0, 1); may be left out where the network takes none.

        Returns:
            (B, K, N, 3) points; K is 1 for a network that reads views together, V for others.
        """

    def encode(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> features that do not depend on the codes; a search over codes computes them once."""
        return images

    def decode(self, features: Tensor, codes: Tensor) -> Tensor:
        """Features of B images and (R, B, D) codes -> (R, B, N, 3): `decode(encode(images), codes)` is `forward`."""
        return self(features, codes)

    def dead_share(self, features: Tensor) -> float:
        """Share of the encoder's output channels that are zero at every place of every image; 0 if not defined."""
        del features
        return 0.0

    def check_views(self, images: Tensor) -> None:
        """Raises ValueError unless images are (B, V, 3, H, W), none of these 0."""
        if images.ndim != 5 or images.shape[2] != 3 or 0 in images.shape:
            raise ValueError(
                f"{type(self).__name__}: 'images' must be (B, V, 3, H, W) in [0, 1]; got {tuple(images.shape)}"
            )

    def check_codes(self, codes: Tensor, images: int) -> None:
        """Raises ValueError unless codes are (R, images, code_dim)."""
        if codes.ndim != 3 or codes.shape[1:] != (images, self.code_dim):
            raise ValueError(
                f"{type(self).__name__}: 'codes' must be (R, {images}, {self.code_dim}) to match the images; "
                f"got {tuple(codes.shape)}"
            )
