"""Checks of the values of CUDA tensors, which count what is wrong instead of waiting for the answer."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch

_BLOCK = 1024


@triton.jit
def count_not_finite(x, y, z, counter):
    """Adds to a counter the number of points that are NaN or infinite."""
    bad = tl.sum(((x - x != 0.0) | (y - y != 0.0) | (z - z != 0.0)).to(tl.int32), axis=0)
    if bad > 0:
        tl.atomic_add(counter, bad)


@triton.jit
def _count_bad(points, lengths, not_finite, not_in_range, size, smallest, BLOCK: tl.constexpr):
    blocks = tl.maximum(tl.cdiv(size * 3, BLOCK), 1)
    row = (tl.program_id(0) // blocks).to(tl.int64)
    block = tl.program_id(0) % blocks
    length = tl.load(lengths + row)
    if block == 0 and (length < smallest or length > size):
        tl.atomic_add(not_in_range, 1)
    i = block * BLOCK + tl.arange(0, BLOCK)
    x = tl.load(points + row * size * 3 + i, mask=(i < size * 3) & (i < length * 3), other=0.0)
    bad = tl.sum((x - x != 0.0).to(tl.int32), axis=0)
    if bad > 0:
        tl.atomic_add(not_finite, bad)


def count_bad_points(function: str, name: str, points: Tensor, lengths: Tensor, *, smallest: int = 0) -> None:
    """Counts coordinates of clouds (B, N, 3) that are not finite, and lengths below `smallest` or above N."""
    rows, size = points.shape[:2]
    if not rows:
        return
    not_finite = errors.counter(points, function, name, "finite")
    not_in_range = errors.counter(
        points, function, "lengths" if name == "points" else f"{name}_lengths", "length"
    )
    blocks = max(1, triton.cdiv(size * 3, _BLOCK))
    launch(_count_bad, rows * blocks, points, lengths, not_finite, not_in_range, size, smallest, _BLOCK)


def count_bad_sets(
    function: str, a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, *, smallest: int
) -> None:
    """As `count_bad_points`, of two batches of sets (B, N, 3) and (B, M, 3).

    Raises:
        ValueError: the sets are padded to fewer than `smallest` points.
    """
    for name, cloud, lengths in (("a", a, a_lengths), ("b", b, b_lengths)):
        if cloud.shape[0] and cloud.shape[1] < smallest:
            raise _checks.fail(function, name, "hold at least one point", str(tuple(cloud.shape)))
        count_bad_points(function, name, cloud, lengths, smallest=smallest)
