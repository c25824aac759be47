"""Parts of a lone large cloud or map, for kernels whose threads otherwise take a whole one each.

How many there are depends on sizes alone, never on the number of threads, and the sums of the parts are added in their
order: the bits of a result are the same on any number of threads.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

_SUMMED = 16_384  # least number of points in a part with sums of its own
_GATHERED = 2_048  # the same where every result is a point's own
_ENOUGH = 64  # parts of a batch, for any number of threads


def summed_parts(count: int) -> int:
    """The number of parts of `count` points or pixels that each have sums of their own, the same in any batch.

    The bits of the sums depend on it.
    """
    return max(1, count // _SUMMED)


def gathered_parts(batch: int, count: int) -> int:
    """The number of parts of each of `batch` clouds whose points each have a result of their own."""
    return max(1, count // max(_GATHERED, batch * count // _ENOUGH))


def sum_of_parts(sums: Tensor, dim: int) -> Tensor:
    """The sum over a dimension, from first to last; `Tensor.sum` may take another order on other threads."""
    return functools.reduce(torch.add, sums.unbind(dim))
