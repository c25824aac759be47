"""Splatting as a plain loop compiled by numba."""

from __future__ import annotations

import functools
import math
from types import ModuleType

import numpy as np
import torch
from torch import Tensor


@functools.cache
def _kernel(numba: ModuleType):
    @numba.njit(parallel=True, fastmath=True)
    def splat(p, cameras, depth, index, visible, radius):
        for b in numba.prange(p.shape[0]):
            depth[b] = np.inf
            index[b] = -1
            visible[b] = 0
            c = cameras[b]
            for i in range(p.shape[1]):
                x, y, z = p[b, i, 0], p[b, i, 1], p[b, i, 2]
                d = c[2, 0] * x + c[2, 1] * y + c[2, 2] * z + c[2, 3]
                u = (c[0, 0] * x + c[0, 1] * y + c[0, 2] * z + c[0, 3]) / d
                v = (c[1, 0] * x + c[1, 1] * y + c[1, 2] * z + c[1, 3]) / d
                if d <= 0:
                    continue
                if radius == 0:  # no loop over pixels
                    if u >= 0 and u < depth.shape[2] and v >= 0 and v < depth.shape[1]:
                        r, k = int(v), int(u)
                        if index[b, r, k] < 0 or d < depth[b, r, k]:
                            depth[b, r, k] = d
                            index[b, r, k] = i
                    continue
                column, row = math.floor(u), math.floor(v)
                for r in range(max(row - radius, 0), min(row + radius + 1, depth.shape[1])):
                    for k in range(max(column - radius, 0), min(column + radius + 1, depth.shape[2])):
                        own = r == row and k == column
                        covered = own or (k + 0.5 - u) ** 2 + (r + 0.5 - v) ** 2 <= radius * radius
                        if covered and (index[b, r, k] < 0 or d < depth[b, r, k]):
                            depth[b, r, k] = d
                            index[b, r, k] = i
            for r in range(depth.shape[1]):
                for k in range(depth.shape[2]):
                    if index[b, r, k] >= 0:
                        visible[b, index[b, r, k]] = 1

    return splat


def splat(numba: ModuleType, points: Tensor, projection: Tensor, size: int, radius: int) -> Tensor:
    """Depth (B, size, size); index and visibility are computed as well."""
    count, n, _ = points.shape
    depth = np.empty((count, size, size), np.float32)
    index = np.empty((count, size, size), np.int64)
    visible = np.empty((count, n), np.uint8)
    arguments = points.numpy(), projection.contiguous().numpy(), depth, index, visible
    _kernel(numba)(*arguments, radius)
    return torch.from_numpy(depth)
