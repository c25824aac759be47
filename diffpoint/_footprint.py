"""The edge of the footprints of soft splatting, for the kernels of both devices."""

from __future__ import annotations

import torch
from torch import Tensor


def least_fade(maps: Tensor, radius: float) -> float:
    """How large 1 - r^2 / radius^2 may be at the edge of a footprint by rounding, on maps (B, V, H, W).

    Such a footprint must not count: in the soft minimum a point in front of the others outweighs it by any factor.
    """
    return 32 * torch.finfo(maps.dtype).eps * (1 + max(maps.shape[2:]) / radius)
