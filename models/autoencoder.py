"""The auto-encoder of point clouds: the critic compares predicted with real shapes in its latent space.

The encoder is a PointNet: the same layers for every point, then a maximum over the points for each latent dimension.
A code therefore does not depend on the order of the points, and their number may vary.
"""

from __future__ import annotations

import dataclasses
import itertools

import torch
from torch import Tensor, nn

LATENT_DIM = 128
_HIDDEN = 256
_CACHED_POINTS, _GPU_POINTS = 2048, 2**18
"""Points that are encoded at a time without a graph: on a CPU, and on a GPU, which needs more of them to be busy."""


@dataclasses.dataclass(frozen=True)
class AutoencoderConfig:
    """Everything that fixes the network's shape.

    Attributes:
        profile: name of the size, for the record.
        points: points per decoded cloud; that of the profile's generator.
        width: factor on the encoder's hidden channels; 1 is the paper's.
    """

    profile: str = "cpu"
    points: int = 512
    width: float = 0.5


AUTOENCODER_PROFILES = {
    "full": AutoencoderConfig("full", 2048, 1.0),
    "cpu": AutoencoderConfig("cpu", 512, 0.5),
    "smoke": AutoencoderConfig("smoke", 128, 0.25),
}


def build_autoencoder(profile: str = "cpu", *, config: AutoencoderConfig | None = None) -> Autoencoder:
    """Builds an auto-encoder with freshly drawn weights (seed torch for reproducible ones).

    Args:
        profile: "full" (2048 points), "cpu" (512) or "smoke" (128).
        config: sizes of your own; `profile` is then ignored.

    Example:
        >>> model = build_autoencoder("smoke")
        >>> model(torch.rand(2, 300, 3)).shape
        torch.Size([2, 128, 3])
    """
    if config is None:
        if profile not in AUTOENCODER_PROFILES:
            raise ValueError(
                f"build_autoencoder: 'profile' must be one of {', '.join(AUTOENCODER_PROFILES)}; got {profile!r}"
            )
        config = AUTOENCODER_PROFILES[profile]
    return Autoencoder(config)


class Autoencoder(nn.Module):
    """(B, P, 3) points -> (B, LATENT_DIM) codes -> (B, N, 3) points, all in the world frame."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        hidden = (max(4, round(channels * config.width)) for channels in (64, 128, 256, 256))
        self.each_point = _each_point(3, *hidden, LATENT_DIM)
        self.decode = ShapeDecoder(config.points)
        for module in self.each_point:
            if isinstance(module, nn.Linear):
                _xavier(module)

    def forward(self, points: Tensor) -> Tensor:
        """Encodes and decodes: (B, P, 3) -> (B, N, 3)."""
        return self.decode(self.encode(points))

    def encode(self, points: Tensor) -> Tensor:
        """(B, P, 3) points, any P >= 1 -> (B, LATENT_DIM)."""
        return self._features(points).amax(1)

    def freeze(self) -> Autoencoder:
        """Switches to eval mode (running statistics in batch norms) and turns gradients of its weights off."""
        return self.eval().requires_grad_(False)

    def encode_frozen(self, points: Tensor) -> Tensor:
        """`encode` of a frozen network, with gradients to the points, in half the time and a fraction of the memory.

        First the point with the maximum of each latent dimension is found without a graph, a few clouds at a time so
        that their features stay in the cache; then these points alone are encoded with a graph. Batch norms are folded
        into the layers before them. Requires eval mode: batch statistics would depend on all points.
        """
        if self.training:
            raise RuntimeError(
                "Autoencoder: encode_frozen is for a network in eval mode; call freeze() first"
            )
        layers = self._folded()
        at_once = max(1, (_CACHED_POINTS if points.is_cpu else _GPU_POINTS) // points.shape[1])
        with torch.no_grad():
            # (B, LATENT_DIM) each: the maximum over points, and the point that has it.
            maxima = [_point_features(layers, some).max(1) for some in points.split(at_once)]
            deciding = torch.cat([found.indices for found in maxima])
        if not points.requires_grad:
            return torch.cat([found.values for found in maxima])
        chosen = torch.take_along_dim(points, deciding[..., None], 1)
        return _point_features(layers, chosen).diagonal(dim1=1, dim2=2)

    def _folded(self) -> list[tuple[Tensor, Tensor]]:
        """Weight (in, out) and bias of every layer, with the following batch norm folded in."""
        folded = []
        modules = list(self.each_point)
        for linear, norm in zip(modules[::3], modules[1::3], strict=True):
            assert isinstance(linear, nn.Linear)
            assert isinstance(norm, nn.BatchNorm1d)
            assert norm.running_var is not None
            assert norm.running_mean is not None
            scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
            bias = (linear.bias - norm.running_mean) * scale + norm.bias
            folded.append(((linear.weight * scale[:, None]).t(), bias))
        return folded

    def _features(self, points: Tensor) -> Tensor:
        """(B, P, 3) -> (B, P, LATENT_DIM): features of each point, of which the code is the maximum."""
        return self.each_point(points.reshape(-1, 3)).unflatten(0, points.shape[:2])


def _point_features(layers: list[tuple[Tensor, Tensor]], points: Tensor) -> Tensor:
    """(B, P, 3) -> (B, P, LATENT_DIM)."""
    features = points.reshape(-1, 3)
    for weight, bias in layers:
        features = torch.addmm(bias, features, weight).relu_()
    return features.unflatten(0, points.shape[:2])


class ShapeDecoder(nn.Sequential):
    """(B, LATENT_DIM) codes -> (B, N, 3) points: three fully connected layers."""

    def __init__(self, points: int) -> None:
        super().__init__(
            nn.Linear(LATENT_DIM, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Linear(_HIDDEN, 3 * points),
            nn.Unflatten(1, (points, 3)),
        )
        for module in self:
            if isinstance(module, nn.Linear):
                _xavier(module)


def _each_point(*widths: int) -> nn.Sequential:
    """Linear + batch norm + ReLU, the same for every point: a convolution of kernel size 1."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def _xavier(layer: nn.Linear) -> None:
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
