"""What operators compute around their kernels, the same on CPU and on CUDA tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def least_fade(maps: Tensor, radius: float) -> float:
    """How large 1 - r^2 / radius^2 may be at the edge of a footprint by rounding, on maps (B, V, H, W).

    Such a footprint must not count: in the soft minimum a point in front of the others outweighs it by any factor.
    """
    return 32 * torch.finfo(maps.dtype).eps * (1 + max(maps.shape[2:]) / radius)


def share_within(squared_distance: Tensor, lengths: Tensor, threshold: float) -> Tensor:
    """(B,): of squared distances (B, N), the share of the first `lengths` whose root is at most `threshold`."""
    counts = torch.arange(squared_distance.shape[1], device=squared_distance.device) < lengths[:, None]
    within = (squared_distance.sqrt() <= threshold) & counts
    return within.sum(-1).to(squared_distance.dtype) / lengths
