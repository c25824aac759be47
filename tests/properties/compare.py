"""Comparisons: an error exactly when there must be one, else equal up to rounding, and never NaN."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

AGREED, REFUSED, UNDECIDED = (
    "agreed with the reference",
    "refused",
    "finite; too near a pixel's border to compare",
)


def refuse_or_run(call: Callable, refuse: bool, *names: str):
    """The call's result, or None if it raised an error, which it must exactly if `refuse`."""
    if not refuse:
        return call()
    with pytest.raises((ValueError, TypeError), match=rf"^({'|'.join(names)}): '\w+' must"):
        call()
    return None


def assert_finite_gradients(output: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    """Of the output's finite part."""
    total = torch.where(torch.isfinite(output), output, 0.0).sum()
    gradients = torch.autograd.grad(total, inputs, retain_graph=True, materialize_grads=True)
    assert all(torch.isfinite(g).all() for g in gradients)
    return gradients


def assert_within(ours: Tensor, theirs: Tensor, tolerance: Tensor | float) -> None:
    """|ours - theirs| <= tolerance; infinities in the same places, NaN nowhere."""
    same = ours == theirs
    assert bool((same | ((ours - theirs).abs() <= tolerance)).all()), (ours - theirs).abs().max()


def eps(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).eps


def magnitude(*tensors: Tensor) -> float:
    return max((float(t.detach().abs().max()) for t in tensors if t.numel()), default=0.0)
