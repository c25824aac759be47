"""The parts of the generator: the image trunk, the code branch, and the decoders of their joined features."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.autoencoder import LATENT_DIM
from models.sizes import CODE_DIM, GeneratorConfig

# Renders are mostly white background. Without centring, this constant dominates the activations, and the image trunk
# can die while the loss still falls (the codes alone then fit the mean shape of the data).
IMAGE_MEAN, IMAGE_GAIN = 0.9, 3.0


def prepare_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """(B, 3, H, W) in [0, 1] on white -> (B, 3, *size), resized without keeping the aspect, and centred."""
    if tuple(images.shape[-2:]) != size:
        images = F.interpolate(images, size=size, mode="bilinear", align_corners=False, antialias=True)
    return (images - IMAGE_MEAN) * IMAGE_GAIN


@contextmanager
def precision(like: Tensor, dtype: torch.dtype = torch.float32, *, tf32: bool = False) -> Iterator[None]:
    """A context for layers of a network: the number format in which they multiply.

    Args:
        like: a tensor on the network's device.
        dtype: torch.float32, or torch.bfloat16 for autocast.
        tf32: on an NVIDIA GPU, round the factors of float32 products to TF32.
    """
    half = dtype != torch.float32
    products: Any = nullcontext() if like.is_cpu else allow_tf32(tf32)
    with torch.autocast(like.device.type, dtype=dtype if half else None, enabled=half), products:
        yield


@contextmanager
def allow_tf32(allowed: bool) -> Iterator[None]:
    """Inside, products of float32 matrices and convolutions on an NVIDIA GPU round their factors to TF32, or do not.

    TF32 has 10 bits of mantissa and several times the speed. The switch is the whole process's: a backward pass rounds
    as the switch is when it runs.
    """
    switches: tuple[Any, Any] = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [switch.allow_tf32 for switch in switches]
    try:
        for switch in switches:
            switch.allow_tf32 = allowed
        yield
    finally:
        for switch, was in zip(switches, before, strict=True):
            switch.allow_tf32 = was


def _widen(channels: int, factor: float) -> int:
    return max(4, round(channels * factor))


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel, stride, padding=(kernel - 1) // 2)


def _conv_relu(config: GeneratorConfig, inputs: int, *layers: tuple[int, int, int]) -> nn.Sequential:
    """A chain of convolution, group norm if the network has it, and ReLU; each layer is (channels, kernel, stride)."""
    modules: list[nn.Module] = []
    for outputs, kernel, stride in layers:
        norm = [nn.GroupNorm(math.gcd(outputs, max(1, outputs // 8)), outputs)] if config.group_norm else []
        modules += [_conv(inputs, outputs, kernel, stride), *norm, nn.ReLU()]
        inputs = outputs
    return nn.Sequential(*modules)


def image_trunk(config: GeneratorConfig) -> nn.Sequential:
    """(B, 3, H, W) -> (B, C, H/8, W/8)."""
    c16, c32, c64, c128 = (_widen(c, config.trunk_width) for c in (16, 32, 64, 128))
    return _conv_relu(
        config,
        3,
        *((c16, 3, 1), (c16, 3, 1), (c32, 3, 2)),
        *((c32, 3, 1), (c32, 3, 1), (c64, 3, 2)),
        *((c64, 3, 1), (c64, 3, 1), (c128, 3, 2)),
        *((c128, 3, 1), (c128, 3, 1)),
    )


class CodeBranch(nn.Module):
    """Maps a code to features on the grid: two fully connected layers, then two convolutions."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__()
        rows, columns = config.grid
        self.spread = nn.Sequential(
            nn.Linear(CODE_DIM, 256), nn.ReLU(), nn.Linear(256, 3 * rows * columns), nn.ReLU()
        )
        self.grid = config.grid
        outputs = _widen(128, config.trunk_width)
        self.convs = _conv_relu(config, 3, (_widen(32, config.trunk_width), 3, 1), (outputs, 3, 1))

    def forward(self, codes: Tensor) -> Tensor:
        return self.convs(self.spread(codes).unflatten(1, (3, *self.grid)))


class _Contraction(nn.Module):
    """Joined features -> two coarser maps, a bottleneck and a vector: the first layers of both decoders."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__()
        c256, c512 = (_widen(c, config.decoder_width) for c in (256, 512))
        self.down4 = _conv_relu(config, _joined_channels(config), (c256, 3, 2), (c256, 3, 1), (c256, 3, 1))
        self.down5 = _conv_relu(config, c256, (c512, 3, 2), (c512, 3, 1), (c512, 3, 1), (c512, 3, 1))
        self.bottleneck = _conv_relu(config, c512, (c512, 5, 2))

        rows, columns = (math.ceil(side / 8) for side in config.grid)
        hidden = _widen(2048, config.decoder_width), _widen(1024, config.decoder_width)
        self.fc_hidden = nn.Sequential(
            nn.Linear(c512 * rows * columns, hidden[0]), nn.ReLU(), nn.Linear(hidden[0], hidden[1]), nn.ReLU()
        )
        self.fc_width = hidden[1]

    def contract(self, joined: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(B, C, h, w) -> maps of h/2 and h/4, the bottleneck of h/8, a vector of fc_width."""
        x4 = self.down4(joined)
        x5 = self.down5(x4)
        bottleneck = self.bottleneck(x5)
        return x4, x5, bottleneck, self.fc_hidden(bottleneck.flatten(1))


class LatentDecoder(_Contraction):
    """Joined features -> a latent code of the auto-encoder of shapes."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__(config)
        self.latent = nn.Linear(self.fc_width, LATENT_DIM)

    @property
    def output_layers(self) -> list[nn.Module]:
        return [self.latent]

    def forward(self, joined: Tensor) -> Tensor:
        vector = self.contract(joined)[-1]
        with precision(joined):  # bfloat16 would round coordinates to 1/500 of an object's size
            return self.latent(vector.float())


class PointDecoder(_Contraction):
    """Joined features -> points: a fully connected and an up-convolving branch."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__(config)
        c64, c128, c256, c512 = (_widen(c, config.decoder_width) for c in (64, 128, 256, 512))
        joined = _joined_channels(config)
        self.values = config.values_per_point
        self.fc_points = nn.Linear(self.fc_width, self.values * config.fc_points)

        self.up5, self.skip5 = _deconv(c512, c256), _conv(c512, c256)
        self.merge5 = _conv_relu(config, c256, (c256, 3, 1))
        self.up4, self.skip4 = _deconv(c256, c128), _conv(c256, c128)
        self.merge4 = _conv_relu(config, c128, (c128, 3, 1))
        self.up3, self.skip3 = _deconv(c128, c64), _conv(joined, c64)
        self.merge3 = _conv_relu(config, c64, (c64, 3, 1), (c64, 3, 1))
        self.conv_points = _conv(c64, config.points_per_cell * self.values)

    @property
    def output_layers(self) -> list[nn.Module]:
        return [self.fc_points, self.conv_points]

    def forward(self, joined: Tensor) -> Tensor:
        x4, x5, bottleneck, vector = self.contract(joined)

        x = self.merge5(F.relu(_crop(self.up5(bottleneck), x5) + self.skip5(x5)))
        x = self.merge4(F.relu(_crop(self.up4(x), x4) + self.skip4(x4)))
        # Only this sum has a ReLU before it, as in the released network and in PSGN.
        x = self.merge3(F.relu(F.relu(_crop(self.up3(x), joined)) + self.skip3(joined)))
        with precision(joined):
            fc_points = self.fc_points(vector.float()).unflatten(1, (-1, self.values))
            conv_points = (
                self.conv_points(x.float()).permute(0, 2, 3, 1).reshape(len(joined), -1, self.values)
            )
            return torch.cat([fc_points, conv_points], dim=1)


def _joined_channels(config: GeneratorConfig) -> int:
    return _widen(128, config.trunk_width) * (1 if config.deterministic else 2)


def _deconv(inputs: int, outputs: int) -> nn.ConvTranspose2d:
    return nn.ConvTranspose2d(inputs, outputs, 5, stride=2, padding=2, output_padding=1)


def _crop(x: Tensor, like: Tensor) -> Tensor:
    """Drops the last row or column where an odd side was halved (rounding up) and doubled."""
    return x[..., : like.shape[-2], : like.shape[-1]]


def initialise(network: nn.Module) -> None:
    """Draws the initial weights of a network of these parts.

    They keep the second moment of activations constant through the layers, and make the first clouds small, around the
    origin. A layer followed by a ReLU gets variance 2 / fan-in; layers whose outputs are summed before one ReLU get
    half of it. With torch's defaults the image's signal would vanish through the trunk's eleven layers.
    """
    summed, final = set(), set()
    for part in network.modules():
        if isinstance(part, PointDecoder):
            summed |= {part.up5, part.skip5, part.up4, part.skip4, part.skip3}
            final |= {*part.output_layers}
    for module in network.modules():
        if not isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            continue
        gain = 0.01 if module in final else 1.0 if module in summed else 2.0
        with torch.no_grad():
            module.weight.normal_(0.0, math.sqrt(gain / _fan_in(module)))
            if module.bias is not None:
                module.bias.zero_()


def _fan_in(module: nn.Conv2d | nn.ConvTranspose2d | nn.Linear) -> float:
    """Inputs per output value; of a strided transposed kernel only a part of the taps contributes to each."""
    if isinstance(module, nn.Linear):
        return module.in_features
    taps = module.kernel_size[0] * module.kernel_size[1]
    if isinstance(module, nn.ConvTranspose2d):
        taps /= module.stride[0] * module.stride[1]
    return module.in_channels * taps
