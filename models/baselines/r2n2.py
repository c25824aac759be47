"""3D-R2N2: a recurrent network reads images one by one into a grid of hidden states; an occupancy grid is decoded.

This is the deeper of the published networks, with residual blocks and a gated recurrent unit ("Res3D-GRU-3").

Source: Choy, Xu, Gwak, Chen, Savarese, "3D-R2N2: A unified approach for single and multi-view 3D object reconstruction"
(ECCV 2016).
"""

from __future__ import annotations

import dataclasses
import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.baselines.base import Baseline, BaselineConfig, choose_config, initialise_rectified
from models.baselines.voxels import surface_points

_MEMORY_SIDE = 4
_SLOPE = 0.01
_THRESHOLD = 0.4
_EMPTY_LOGIT = 1.5
"""Logits of a cell before training, empty and (negated) occupied: an occupancy of 5 %."""


@dataclasses.dataclass(frozen=True)
class R2N2Config(BaselineConfig):
    """Everything that fixes the network's shape.

    Attributes:
        encoder: channels of the blocks, each of which halves the image.
        skips: which of the blocks have a residual connection.
        features: length of an image's feature vector.
        memory: channels of the 4^3 hidden states.
        decoder: channels of the blocks that double the grid, then of the last block, which does not.
    """

    encoder: tuple[int, ...] = (16, 32, 64, 64)
    skips: tuple[bool, ...] = (False, True, True, True)
    features: int = 256
    memory: int = 64
    decoder: tuple[int, ...] = (64, 32, 8, 8)


R2N2_PROFILES = {
    "full": R2N2Config(
        *("full", 127, 127, 2048),
        encoder=(96, 128, 256, 256, 256, 256),
        skips=(False, True, True, False, True, True),
        features=1024,
        memory=128,
        decoder=(128, 128, 64, 32),
    ),
    "cpu": R2N2Config(),
    "smoke": R2N2Config("smoke", 32, 32, 128, (8, 16), (False, True), 64, 8, (8, 8, 4)),
}


def build_r2n2(profile: str = "cpu", *, config: R2N2Config | None = None) -> RecurrentReconstruction:
    """Builds 3D-R2N2 with freshly drawn weights.

    Args:
        profile: "full" (127 x 127 images, 32^3 cells, 35.93 million parameters), "cpu" (64 x 64 images, 32^3 cells) or
            "smoke" (32 x 32 images, 16^3 cells).
        config: sizes of your own; `profile` is then ignored.

    Example:
        >>> model = build_r2n2("smoke")
        >>> model.predict_views(torch.rand(2, 3, 3, 56, 56)).shape  # three images of each of two objects
        torch.Size([2, 1, 128, 3])
    """
    return RecurrentReconstruction(choose_config("build_r2n2", R2N2_PROFILES, profile, config))


class RecurrentReconstruction(Baseline):
    """Images of one object, any number of them -> the logits of an occupancy grid."""

    reads_views_together = True
    config: R2N2Config

    def __init__(self, config: R2N2Config) -> None:
        super().__init__()
        self.config = config
        blocks: list[nn.Module] = []
        side = max(config.image_height, config.image_width)
        if config.image_height != config.image_width:
            raise ValueError("R2N2Config: image_height and image_width must be equal")
        for number, (inputs, outputs) in enumerate(itertools.pairwise((3, *config.encoder))):
            kernel = 3 if number else 7
            blocks.append(_ImageBlock(inputs, outputs, kernel, skip=config.skips[number]))
            side = side // 2 + 1
        self.encoder = nn.Sequential(
            *blocks,
            nn.Flatten(),
            nn.Linear(config.encoder[-1] * side**2, config.features),
            nn.LeakyReLU(_SLOPE),
        )
        self.memory = _GatedMemory(config.features, config.memory)
        *doubling, last = config.decoder
        sizes = itertools.pairwise((config.memory, *doubling))
        larger = (_GridBlock(inputs, outputs, doubles=True) for inputs, outputs in sizes)
        self.decoder = nn.Sequential(*larger, _GridBlock(doubling[-1], last, doubles=False))
        self.logits_of_cells = nn.Conv3d(last, 2, 3, padding=1)
        initialise_rectified(self)
        for module in self.modules():
            if isinstance(module, (_ImageBlock, _GridBlock, _GatedMemory)):
                module.initialise()
        # Most cells are empty; without this bias, training spends its first steps on learning that.
        self.logits_of_cells.bias = nn.Parameter(torch.tensor([_EMPTY_LOGIT, -_EMPTY_LOGIT]))
        # Saves a fifth of a training step's time on a CPU.
        for module in self.modules():
            if isinstance(module, (nn.Conv3d, nn.ConvTranspose3d)):
                module.to(memory_format=torch.channels_last_3d)  # pyright: ignore[reportCallIssue]

    @property
    def grid_size(self) -> int:
        """Cells along a side of the occupancy grid."""
        return _MEMORY_SIDE * 2 ** (len(self.config.decoder) - 1)

    def logits(self, images: Tensor) -> Tensor:
        """(B, V, 3, H, W) in [0, 1], read in order -> (B, 2, G, G, G): logits of each cell, empty and occupied."""
        features = self.encoder(self._prepare(images.flatten(0, 1))).unflatten(0, images.shape[:2])
        memory = features.new_zeros(len(images), self.config.memory, *(_MEMORY_SIDE,) * 3)
        for view in features.unbind(1):
            memory = self.memory(view, memory)
        return self.logits_of_cells(self.decoder(memory))

    def _predict(self, images: Tensor) -> Tensor:
        occupancy = self.logits(images).softmax(1)[:, 1]
        return surface_points(occupancy, self.points, threshold=_THRESHOLD)[:, None]


class _ImageBlock(nn.Module):
    """Two convolutions with leaky ReLU, an optional residual connection, and max pooling to half the size plus one."""

    def __init__(self, inputs: int, outputs: int, kernel: int, *, skip: bool) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.skip = None
        if skip:
            self.skip = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def initialise(self) -> None:
        if self.skip is not None:
            _halve_second_moment(self.second, self.skip)

    def forward(self, x: Tensor) -> Tensor:
        made = F.leaky_relu(self.second(F.leaky_relu(self.first(x), _SLOPE)), _SLOPE)
        if self.skip is not None:
            made = made + self.skip(x)
        return F.max_pool2d(made, 2, padding=1)


class _GatedMemory(nn.Module):
    """A convolutional gated recurrent unit: each cell sees its neighbours, and the image through weights of its own."""

    def __init__(self, features: int, channels: int) -> None:
        super().__init__()
        shape = (channels, *(_MEMORY_SIDE,) * 3)
        cells = channels * _MEMORY_SIDE**3

        def from_image() -> nn.Module:
            return nn.Sequential(nn.Linear(features, cells, bias=False), nn.Unflatten(1, shape))

        self.keep_image, self.reset_image, self.new_image = from_image(), from_image(), from_image()
        self.keep_cells, self.reset_cells, self.new_cells = (
            nn.Conv3d(channels, channels, 3, padding=1) for _ in range(3)
        )

    def initialise(self) -> None:
        """Weights for layers without ReLU, and small positive biases, so that the gates are slightly open at first."""
        for module in self.modules():
            if isinstance(module, (nn.Linear, nn.Conv3d)):
                nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
                if module.bias is not None:
                    nn.init.constant_(module.bias, 0.1)

    def forward(self, features: Tensor, memory: Tensor) -> Tensor:
        keep = torch.sigmoid(self.keep_image(features) + self.keep_cells(memory))
        reset = torch.sigmoid(self.reset_image(features) + self.reset_cells(memory))
        candidate = torch.tanh(self.new_image(features) + self.new_cells(reset * memory))
        return keep * memory + (1 - keep) * candidate


class _Unpool(nn.Module):
    """Doubles the size: every value goes to the first of 2^3 cells, the other seven are zero."""

    def forward(self, x: Tensor) -> Tensor:
        larger = x.new_zeros(*x.shape[:2], *(2 * side for side in x.shape[2:]))
        larger[..., ::2, ::2, ::2] = x
        return larger


class _GridBlock(nn.Module):
    """Two convolutions with leaky ReLU and a residual connection, on the unpooled grid if the block doubles it.

    A convolution of an unpooled grid equals a transposed convolution with stride 2, which skips the zeros and takes a
    quarter of the time.
    """

    def __init__(self, inputs: int, outputs: int, *, doubles: bool) -> None:
        super().__init__()
        self.skip: nn.Module
        if doubles:
            self.first = nn.ConvTranspose3d(inputs, outputs, 3, stride=2, padding=1, output_padding=1)
            self.skip = _Unpool()
            if inputs != outputs:
                self.skip = nn.ConvTranspose3d(inputs, outputs, 1, stride=2, output_padding=1)
        else:
            self.first = nn.Conv3d(inputs, outputs, 3, padding=1)
            self.skip = nn.Conv3d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv3d(outputs, outputs, 3, padding=1)

    def initialise(self) -> None:
        _halve_second_moment(self.second, self.skip)

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(self.second(F.leaky_relu(self.first(x), _SLOPE)), _SLOPE) + self.skip(x)


def _halve_second_moment(*paths: nn.Module) -> None:
    """The sum of two paths must not grow from block to block, or it would saturate the gates of the hidden state."""
    with torch.no_grad():
        for path in paths:
            for weight in path.parameters():
                weight *= 0.5**0.5
