"""Calls from torch into the Taichi kernels, and the registration of ops with torch. Nothing else does either."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffpoint import _checks, _transforms
from diffpoint._runtime import RUNTIME

_REALS = {torch.float32: "f32", torch.float64: "f64"}
_LARGEST = 2**31 - 1
_NUMBER = torch.zeros(())  # on the CPU


def launch(module: str, kernel: str, real: torch.dtype, *arguments: Tensor | int | float) -> None:
    """Run `diffpoint.kernels.<module>.build(real).<kernel>(*arguments, spread)`.

    Tensors must be contiguous, inputs and outputs alike: a copy made here of an output would take the result, and the
    caller's tensor would stay as it was. `register` makes the arguments of an op contiguous.

    Raises:
        ValueError: a tensor that is not contiguous, or one of 2^31 elements or more, beyond the
            kernels' 32-bit offsets.
    """
    for position, a in enumerate(arguments):
        if not isinstance(a, Tensor):
            continue
        if a.numel() > _LARGEST:
            raise ValueError(
                f"diffpoint: a tensor of shape {tuple(a.shape)} is too large for the kernels, whose offsets are 32-bit "
                "integers (at most 2^31 - 1 elements). Split the batch."
            )
        if not a.is_contiguous():
            name = RUNTIME.argument_name(module, kernel, position)
            raise ValueError(
                f"diffpoint: '{name}' of the kernel {module}.{kernel} must be contiguous; got shape {tuple(a.shape)} "
                f"with strides {a.stride()}. Pass .contiguous() of an input; allocate an output contiguous."
            )
    with RUNTIME.lock:
        spread = RUNTIME.ensure_started()
        RUNTIME.call(module, kernel, _REALS[real])(RUNTIME.current_program(), (*arguments, spread))


def register(
    name: str,
    *,
    fake: Callable,
    backward: Callable | None = None,
    setup: Callable | None = None,
    strided: bool = False,
) -> Callable:
    """Decorator: register a function of tensors as the torch operator `diffpoint::<name>`.

    `fake` gives the outputs' shapes without computing, `backward` and `setup` are the autograd formula. Differentiating
    an op without a formula raises an error with its name. The function receives contiguous CPU tensors: arguments on
    other devices or with other strides are copied first, and the results are moved to the device of the arguments.
    With `strided` it also receives tensors that are not contiguous, for instance one number expanded.

    The batch is the first dimension of every tensor, argument or result: `torch.vmap` enlarges it (see `_transforms`).
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        schema = torch.library.infer_schema(function, mutates_args=())
        op = torch.library.custom_op(
            f"diffpoint::{name}", _on_cpu_tensors(function, strided), mutates_args=(), schema=schema
        )
        op.register_fake(fake)
        if backward is not None:
            op.register_autograd(backward, setup_context=setup)
        _transforms.support(op, name, backward, setup)
        return op

    return decorate


def _on_cpu_tensors(function: Callable, strided: bool) -> Callable:
    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        elsewhere = [a.device for a in arguments if isinstance(a, Tensor) and not a.is_cpu]
        here = [a.cpu() if isinstance(a, Tensor) else a for a in arguments]
        if not strided:
            here = [a.contiguous() if isinstance(a, Tensor) else a for a in here]
        with _checks.full_precision(_NUMBER):
            results = function(*here)
        if not elsewhere:
            return results
        if isinstance(results, Tensor):
            return results.to(elsewhere[0])
        return tuple(r.to(elsewhere[0]) for r in results)

    return run


def or_zeros(gradient: Tensor | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The gradient of an output, or one zero expanded to `shape` if there is none.

    For ops that call `ctx.set_materialize_grads(False)`: otherwise torch fills a tensor with zeros for every output
    without a gradient, indices and flags included.
    """
    return like.new_zeros(()).expand(shape) if gradient is None else gradient


def full_lengths(lengths: Tensor | None, batch: int, size: int, like: Tensor | None = None) -> Tensor:
    """`lengths` as (batch,) int64; full sets, on the device of `like`, where it is None."""
    if lengths is None:
        device = None if like is None else like.device
        return torch.full((batch,), size, dtype=torch.int64, device=device)
    return lengths.reshape(batch)
