"""Clouds in spatial order with bounding boxes of their parts, so that exact searches can skip most of a large cloud."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge

BLOCK = 32  # as in kernels/blocks.py
GROUP = 32
LANES = 16
_MOST_BITS = 6


class Blocks(NamedTuple):
    """A batch of clouds sorted along a Morton curve."""

    points: Tensor
    """(B, N', 3) in the curve's order, N' the next multiple of 1024; infinite in the padding."""
    order: Tensor
    """(B, N') int32: index of each point before sorting; 2^31 - 1 in the padding."""
    boxes: Tensor
    """(B, 6, N' / 32) minimum and maximum corner of every 32 points."""
    groups: Tensor
    """(B, 6, G) the same of every 32 boxes, G the next multiple of 16; infinite for boxes without points."""
    size: int
    """N, the number of points before padding."""

    @property
    def box_lanes(self) -> Tensor:
        """`boxes` in rows of 16, for kernels that load whole vectors."""
        return self.boxes.view(*self.boxes.shape[:2], -1, LANES)

    @property
    def group_lanes(self) -> Tensor:
        """`groups`, likewise."""
        return self.groups.view(*self.groups.shape[:2], -1, LANES)


def sort_into_blocks(points: Tensor, lengths: Tensor) -> Blocks:
    """Sort clouds (B, N, 3) of the given lengths (B,); O(N) time and memory."""
    batch, size, _ = points.shape
    # About as many cells as points: finer keys cost memory, with coarser ones the boxes get larger.
    bits = 2
    while bits < _MOST_BITS and 8 ** (bits + 1) <= 2 * size:
        bits += 1
    boxes = -(-size // (BLOCK * GROUP)) * GROUP  # whole groups
    result = Blocks(
        points.new_empty((batch, boxes * BLOCK, 3)),
        torch.full((batch, boxes * BLOCK), 2**31 - 1, dtype=torch.int32),
        points.new_empty((batch, 6, boxes)),
        points.new_empty((batch, 6, -(-boxes // (GROUP * LANES)) * LANES)),
        size,
    )
    key = torch.empty((batch, size), dtype=torch.int32)
    histogram = torch.empty((batch, max(8**bits, boxes)), dtype=torch.int32)
    scratch = result.points, result.order, key, histogram, result.boxes, result.groups
    _bridge.launch("blocks", "sort", points.dtype, points, lengths, *scratch, bits)
    return result
