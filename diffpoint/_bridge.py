"""The one crossing between torch and Taichi, and the one way an op is registered with torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffpoint._runtime import RUNTIME

_REALS = {torch.float32: "f32", torch.float64: "f64"}


def launch(module: str, kernel: str, real: torch.dtype, *arguments: Tensor | int | float) -> None:
    """Run `diffpoint.kernels.<module>.build(real).<kernel>(*arguments, spread)`.

    Outputs are the caller's freshly allocated (hence contiguous) tensors; inputs are made contiguous here and
    detached, because Taichi allocates a `.grad` for every tensor that requires one.
    """
    crossing = [a.detach().contiguous() if isinstance(a, Tensor) else a for a in arguments]
    with RUNTIME.lock:
        spread = RUNTIME.ensure_started()
        getattr(RUNTIME.kernel(module, _REALS[real]), kernel)(*crossing, spread)


def register(
    name: str, *, fake: Callable, backward: Callable | None = None, setup: Callable | None = None
) -> Callable:
    """Decorator: register a function of tensors as the torch operator `diffpoint::<name>`.

    `fake` gives the outputs' shapes without computing, `backward` and `setup` are the autograd formula. An op
    without a formula refuses to be differentiated, by its name.
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        op = torch.library.custom_op(f"diffpoint::{name}", function, mutates_args=())
        op.register_fake(fake)
        if backward is not None:
            op.register_autograd(backward, setup_context=setup)
        return op

    return decorate


def full_lengths(lengths: Tensor | None, batch: int, size: int) -> Tensor:
    """`lengths` as (batch,) int64; full sets where it is None."""
    if lengths is None:
        return torch.full((batch,), size, dtype=torch.int64)
    return lengths.reshape(batch)
