"""Lin et al.: depth maps and masks of eight fixed cameras, fused to a cloud.

Source: Lin, Kong, Lucey, "Learning efficient point cloud generation for dense 3D object reconstruction" (AAAI 2018).
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import PinholeCamera, projection_loss, splat_depth
from models import Predictor
from models.baselines import (
    LIN_PROFILES,
    Structure,
    StructureGenerator,
    build_lin,
    fixed_cameras,
    pixel_centres,
)
from train.config import FitConfig
from train.data.batches import Batch, Targets
from train.methods.base import Method, Noise, Step, TrainState, plain_recipe, plain_stage
from train.methods.losses import for_each_image, target_cameras, targets_of

_PROJECTIONS = 5

# World units: closes the gaps between the 2048 points of a surface; silhouettes grow by no more than this.
_POINT_RADIUS = 0.01


def fixed_views_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """First phase: depth and mask in the eight fixed cameras; sums over the pixels of an image.

    Depth is compared where the target has a surface: empty pixels have no depth.
    """
    network = state.network
    assert isinstance(network, StructureGenerator)
    structure = network.structure(batch.images.flatten(0, 1))
    target = for_each_image(fixed_depth(targets_of(batch).points, network.config.map_size), batch)
    filled = target.isfinite()
    place = (structure.pixels - pixel_centres(network.config.map_size).to(structure.pixels)).abs().sum()
    depth = (structure.depth - target.where(filled, structure.depth.detach())).abs().sum()
    mask = F.binary_cross_entropy_with_logits(structure.logits, filled.float(), reduction="sum")
    terms = {"place": place, "depth": depth, "mask": mask}
    terms = {name: value / len(target) for name, value in terms.items()}
    return {"loss": sum(terms.values(), depth.new_zeros(())), **terms}


def fused_projection_loss(state: TrainState, batch: Batch, noise: Noise, step: Step) -> dict[str, Tensor]:
    """Second phase: the fused cloud's depth maps and masks in five of the data's cameras, others at each step."""
    network = state.network
    assert isinstance(network, StructureGenerator)
    structure = network.structure(batch.images.flatten(0, 1))
    points, logits = network.fuse(structure), structure.logits.flatten(1)
    depth = targets_of(batch).depth
    random = torch.Generator().manual_seed(step.number)
    views = torch.randperm(depth.shape[1], generator=random)[:_PROJECTIONS]
    depth = for_each_image(depth[:, views], batch)
    # Both terms count per pixel of the foreground, as their sums do in the publication.
    foreground = depth.isfinite().float().mean().item()
    mask_weight = 1 / max(foreground, 1 / depth.numel())  # thin shapes may leave every small map empty
    loss = projection_loss(
        points, target_cameras(batch, views), depth,
        logits=logits, mask_weight=mask_weight, upsample=network.config.upsample,
    )  # fmt: skip
    return {"loss": loss, "kept_share": (logits > 0).float().mean()}


class Lin(Method):
    """The structure generator and its two phases."""

    losses: ClassVar = {"stage1": fixed_views_loss, "stage2": fused_projection_loss}
    sizes = LIN_PROFILES
    network_class = StructureGenerator
    weights_key = "lin"
    needs_whole_batch = "its batch normalisation needs the whole batch"

    def recipe(self, profile: str) -> FitConfig:
        # Full: as published.
        stages = {
            "full": (
                plain_stage(steps=500_000, shapes=20, rate=1e-2),
                plain_stage(steps=100_000, shapes=20, rate=1e-5),
            ),
            "cpu": (
                plain_stage(steps=8_000, shapes=16, rate=(2e-3, 1e-4)),
                # It begins as published. With ten times as much the maps of thin parts are emptied faster than they
                # are filled: on two data sets the validation CD rises above what the first phase had.
                plain_stage(steps=2_000, shapes=16, rate=(1e-5, 1e-6)),
            ),
            "smoke": (
                plain_stage(steps=12, shapes=3, rate=1e-3),
                plain_stage(steps=6, shapes=3, rate=1e-4),
            ),
        }[profile]
        return plain_recipe(self.name, profile, *stages, min_image_sensitivity=0.0)

    def build(self, config: FitConfig) -> Predictor:
        return build_lin(config.profile)

    def oracle(self, network: Predictor, targets: Targets) -> Tensor:
        """The true depth maps of the eight fixed cameras, fused."""
        assert isinstance(network, StructureGenerator)
        size = network.config.map_size
        depth = fixed_depth(targets.points, size)
        pixels = pixel_centres(size).to(depth).expand(*depth.shape[:2], -1, -1, -1)
        return network.cloud_of(Structure(pixels, depth, logits=depth.isfinite().to(depth) - 0.5))


def fixed_depth(points: Tensor, size: int) -> Tensor:
    """Depth maps of surfaces in the eight fixed orthographic cameras of Lin et al.

    Args:
        points: (B, P, 3) on the surface, world frame.
        size: side of the maps, which cover one unit of the world.

    Returns:
        (B, 8, size, size), +inf where empty.

    Example:
        >>> fixed_depth(torch.zeros(1, 1, 3), 4)[0, 0].isfinite().sum().item()
        1
    """
    in_cameras = fixed_cameras(points).flatten(0, 1)
    # A pinhole camera divides by the depth: multiplied by it first, points keep their orthographic position.
    stretched = torch.cat([in_cameras[..., :2] * in_cameras[..., 2:], in_cameras[..., 2:]], -1)
    K = torch.tensor([[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]])
    camera = PinholeCamera(K.to(points), torch.eye(4).to(points), size, size)
    depth = splat_depth(stretched.contiguous(), camera, radius=_POINT_RADIUS * size).depth
    return depth.reshape(len(points), -1, size, size)
