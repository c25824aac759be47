"""The one crossing between torch and Taichi, and the one way an op is registered with torch."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffpoint._runtime import RUNTIME

_REALS = {torch.float32: "f32", torch.float64: "f64"}
_LARGEST = 2**31 - 1


def launch(module: str, kernel: str, real: torch.dtype, *arguments: Tensor | int | float) -> None:
    """Run `diffpoint.kernels.<module>.build(real).<kernel>(*arguments, spread)`.

    Outputs are the caller's freshly allocated (hence contiguous) tensors; inputs are made contiguous here.

    Raises:
        ValueError: a tensor of 2^31 elements or more, which the kernels' 32-bit offsets cannot reach.
    """
    crossing = []
    for a in arguments:
        if isinstance(a, Tensor):
            if a.numel() > _LARGEST:
                raise ValueError(
                    f"diffpoint: a tensor of shape {tuple(a.shape)} is too large for the kernels, which count to 2^31 "
                    "elements. Split the batch."
                )
            a = a.contiguous()
        crossing.append(a)
    with RUNTIME.lock:
        spread = RUNTIME.ensure_started()
        RUNTIME.call(module, kernel, _REALS[real])(RUNTIME.current_program(), (*crossing, spread))


def register(
    name: str, *, fake: Callable, backward: Callable | None = None, setup: Callable | None = None
) -> Callable:
    """Decorator: register a function of tensors as the torch operator `diffpoint::<name>`.

    `fake` gives the outputs' shapes without computing, `backward` and `setup` are the autograd formula. An op
    without a formula refuses to be differentiated, by its name. The function itself sees CPU tensors only: others
    are moved before it and its results after it, so that the gradient's op moves its own.
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        schema = torch.library.infer_schema(function, mutates_args=())
        op = torch.library.custom_op(
            f"diffpoint::{name}", _on_the_cpu(function), mutates_args=(), schema=schema
        )
        op.register_fake(fake)
        if backward is not None:
            op.register_autograd(backward, setup_context=setup)
        return op

    return decorate


def _on_the_cpu(function: Callable) -> Callable:
    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        elsewhere = [a.device for a in arguments if isinstance(a, Tensor) and not a.is_cpu]
        if not elsewhere:
            return function(*arguments)
        results = function(*(a.cpu() if isinstance(a, Tensor) else a for a in arguments))
        if isinstance(results, Tensor):
            return results.to(elsewhere[0])
        return tuple(r.to(elsewhere[0]) for r in results)

    return run


def or_zeros(gradient: Tensor | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """What flows back to an output: one zero, expanded, where nothing does.

    For ops that call `ctx.set_materialize_grads(False)`: torch would otherwise fill a tensor with zeros for every
    output without a gradient, indices and flags included.
    """
    return like.new_zeros(()).expand(shape) if gradient is None else gradient


def full_lengths(lengths: Tensor | None, batch: int, size: int, like: Tensor | None = None) -> Tensor:
    """`lengths` as (batch,) int64; full sets, on the device of `like`, where it is None."""
    if lengths is None:
        device = None if like is None else like.device
        return torch.full((batch,), size, dtype=torch.int64, device=device)
    return lengths.reshape(batch)
