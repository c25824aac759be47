"""Lin et al.: one image -> depth maps and masks of the shape in eight fixed views, fused into one cloud.

The cameras are at the corners of a cube around the object and look at its centre; they are orthographic, and each map
is one world unit wide.

Source: Lin, Kong, Lucey, "Learning efficient point cloud generation for dense 3D object reconstruction" (AAAI 2018).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from diffpoint import PinholeCamera
from models.baselines.base import Baseline, BaselineConfig, choose_config, initialise_rectified

_VIEWS = 8
_BN_EPS = 1e-5
_FIRST_GRID = 4


@dataclasses.dataclass(frozen=True)
class LinConfig(BaselineConfig):
    """Everything that fixes the network's shape.

    Attributes:
        width: factor on all hidden channels; 1 is the paper's.
        map_size: side of the eight maps, 4 times a power of two.
        batch_momentum: momentum of the batch norms' running statistics; smaller in longer trainings.
        upsample: size of the pseudo-renderer's depth maps in training, as a multiple of the true ones.
    """

    width: float = 0.25
    map_size: int = 32
    batch_momentum: float = 0.02
    upsample: int = 3


LIN_PROFILES = {
    "full": LinConfig("full", 64, 64, 2048, 1.0, 128, 0.001, upsample=5),
    "cpu": LinConfig(),
    "smoke": LinConfig("smoke", 32, 32, 128, 0.125, 16, 0.1),
}


def build_lin(profile: str = "cpu", *, config: LinConfig | None = None) -> StructureGenerator:
    """Builds the structure generator with freshly drawn weights.

    Args:
        profile: "full" (64 x 64 images, eight maps of 128 x 128, 24.18 million parameters, of which 0.52 million are
            the last layer's biases, one for every pixel), "cpu" (maps of 32 x 32) or "smoke" (16 x 16).
        config: sizes of your own; `profile` is then ignored.

    Example:
        >>> model = build_lin("smoke")
        >>> model(torch.rand(2, 3, 56, 56), torch.zeros(1, 2, 0)).shape
        torch.Size([1, 2, 512, 3])
    """
    return StructureGenerator(choose_config("build_lin", LIN_PROFILES, profile, config))


class Structure(NamedTuple):
    """The maps of the eight fixed cameras.

    Attributes:
        pixels: (B, 8, 2, S, S) position of each pixel's point, x and y in pixels of the map.
        depth: (B, 8, S, S) the point's depth; every camera is one unit from the origin.
        logits: (B, 8, S, S) mask logits: above 0 where the pixel shows the object.
    """

    pixels: Tensor
    depth: Tensor
    logits: Tensor


class StructureGenerator(Baseline):
    """Image -> structure -> cloud."""

    config: LinConfig
    world_from_cams: Tensor

    def __init__(self, config: LinConfig) -> None:
        super().__init__()
        self.config = config
        upsamplings = round(math.log2(config.map_size / _FIRST_GRID))
        if _FIRST_GRID * 2**upsamplings != config.map_size or not 1 <= upsamplings <= 5:
            raise ValueError(f"LinConfig: map_size must be 8, 16, 32, 64 or 128; got {config.map_size}")

        def widen(*channels: int) -> list[int]:
            return [max(4, round(c * config.width)) for c in channels]

        def rectified(layer: nn.Module, norm: nn.Module) -> list[nn.Module]:
            return [layer, norm, nn.ReLU()]

        def dense(inputs: int, outputs: int) -> list[nn.Module]:
            norm = nn.BatchNorm1d(outputs, _BN_EPS, config.batch_momentum, affine=False)
            return rectified(nn.Linear(inputs, outputs, bias=False), norm)

        def conv(inputs: int, outputs: int, stride: int) -> list[nn.Module]:
            norm = nn.BatchNorm2d(outputs, _BN_EPS, config.batch_momentum, affine=False)
            return rectified(nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), norm)

        convs = widen(96, 128, 192, 256)
        seen = convs[-1] * math.ceil(config.image_height / 16) * math.ceil(config.image_width / 16)
        wide, middle, code, first = widen(2048, 1024, 512, 256)
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise((3, *convs)):
            layers += conv(inputs, outputs, stride=2)
        layers += [nn.Flatten(), *dense(seen, wide), *dense(wide, middle), nn.Linear(middle, code)]
        self.encoder = nn.Sequential(*layers)

        grid = first * _FIRST_GRID**2
        layers = [nn.ReLU(), *dense(code, middle), *dense(middle, wide), *dense(wide, grid)]
        layers += [nn.Unflatten(1, (first, _FIRST_GRID, _FIRST_GRID))]
        for inputs, outputs in itertools.pairwise((first, *widen(192, 128, 96, 64, 48)[:upsamplings])):
            layers += [nn.Upsample(scale_factor=2), *conv(inputs, outputs, stride=1)]
            first = outputs
        self.decoder = nn.Sequential(*layers)
        self.maps = nn.Conv2d(first, 4 * _VIEWS, 1, bias=False)
        self.map_bias = nn.Parameter(_flat_maps(config.map_size))
        initialise_rectified(self)
        nn.init.normal_(self.maps.weight, std=0.01)
        self.register_buffer("world_from_cams", _fixed_poses().inverse(), persistent=False)

    def structure(self, images: Tensor) -> Structure:
        """(B, 3, H, W) in [0, 1] -> the eight cameras' maps; with gradient, in the network's current mode."""
        maps = self.maps(self.decoder(self.encoder(self._prepare(images))))
        size = self.config.map_size
        x, y, depth, logits = (maps.unflatten(1, (4, _VIEWS)) + self.map_bias).unbind(1)
        assert x.shape[1:] == (_VIEWS, size, size)
        return Structure(torch.stack([x, y], 2), depth, logits)

    def fuse(self, structure: Structure) -> Tensor:
        """The points of all eight maps, masked or not: (B, 8*S*S, 3) in the world frame, camera by camera."""
        across = structure.pixels / self.config.map_size - 0.5
        in_cams = torch.cat([across, structure.depth[:, :, None]], 2).flatten(3)
        turned = self.world_from_cams[:, :3, :3] @ in_cams + self.world_from_cams[:, :3, 3:]
        return turned.transpose(2, 3).flatten(1, 2)

    def cloud_of(self, structure: Structure) -> Tensor:
        """The points inside the masks, subsampled or repeated to a fixed number: (B, 2*S*S, 3) in the world frame."""
        clouds, kept = self.fuse(structure), structure.logits.flatten(1) > 0
        count = kept.shape[1] // 4  # about as many pixels as an object covers
        picked = [_resample(cloud[_some(mask)], count) for cloud, mask in zip(clouds, kept, strict=True)]
        return torch.stack(picked)

    def _predict(self, images: Tensor) -> Tensor:
        return self.cloud_of(self.structure(images.flatten(0, 1))).unflatten(0, images.shape[:2])


def fixed_cameras(points: Tensor) -> Tensor:
    """Clouds in the frames of the eight cameras: (B, N, 3) -> (B, 8, N, 3), x right, y down, z the depth.

    Example:
        >>> fixed_cameras(torch.zeros(1, 1, 3))[0, :, 0, 2].tolist()
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """
    poses = _fixed_poses().to(points)
    return points[:, None] @ poses[:, :3, :3].mT + poses[:, None, :3, 3]


def pixel_centres(size: int) -> Tensor:
    """(2, S, S): centres of a map's pixels, x and y in pixels.

    Example:
        >>> pixel_centres(4)[:, 0, 3].tolist()
        [3.5, 0.5]
    """
    centres = torch.arange(size) + 0.5
    return torch.stack(torch.meshgrid(centres, centres, indexing="xy"))


def _fixed_poses() -> Tensor:
    """(8, 4, 4) cam_from_world of cameras at a cube's corners, one unit from the origin."""
    corners = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3))) / math.sqrt(3)
    poses = [PinholeCamera.look_at(eye, focal_px=1.0, height=1, width=1).cam_from_world for eye in corners]
    return torch.stack(poses).reshape(_VIEWS, 4, 4)


def _flat_maps(size: int) -> Tensor:
    """(4, 8, S, S): every pixel's point at the pixel's centre and at the origin's depth, with a mask logit of 0."""
    maps = torch.cat([pixel_centres(size), torch.ones(1, size, size), torch.zeros(1, size, size)])
    return maps[:, None].repeat(1, _VIEWS, 1, 1)


def _some(mask: Tensor) -> Tensor:
    """The mask, or an all-true one if it is empty: a prediction must have points."""
    return mask if bool(mask.any()) else torch.ones_like(mask)


def _resample(cloud: Tensor, count: int) -> Tensor:
    """(n, 3) -> (count, 3): indices spaced evenly over the list, with omissions or repeats."""
    return cloud[torch.arange(count, device=cloud.device) * len(cloud) // count]
