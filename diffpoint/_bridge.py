"""Calls from torch into the kernels, and the registration of ops with torch. Nothing else does either."""

from __future__ import annotations

import contextlib
import functools
import sys
import warnings
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
    an op without a formula raises an error with its name. The function receives contiguous CPU tensors: arguments with
    other strides are copied first. With `strided` it also receives tensors that are not contiguous, for instance one
    number expanded. CUDA tensors go to the kernel of the same name in `diffpoint.cuda`; if there is none, and from all
    other devices, they are copied to the CPU, and the results back.

    The batch is the first dimension of every tensor, argument or result: `torch.vmap` enlarges it (see `_transforms`).
    """

    def decorate(function: Callable) -> Callable[..., Any]:
        schema = torch.library.infer_schema(function, mutates_args=())
        op = torch.library.custom_op(
            f"diffpoint::{name}", _on_any_device(name, function, strided), mutates_args=(), schema=schema
        )
        op.register_fake(fake)
        if backward is not None:
            op.register_autograd(backward, setup_context=setup)
        _transforms.support(op, name, backward, setup)
        return op

    return decorate


def _on_any_device(name: str, function: Callable, strided: bool) -> Callable:
    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        if not strided:
            arguments = tuple(a.contiguous() if isinstance(a, Tensor) else a for a in arguments)
        elsewhere = [a.device for a in arguments if isinstance(a, Tensor) and not a.is_cpu]
        if interpreted or (elsewhere and elsewhere[0].type == "cuda"):
            kernel = _cuda_kernel(name)
            if kernel is not None:
                with _device(elsewhere):
                    results = kernel(*arguments)
                if results is not NotImplemented:
                    return _owned(results)
        here = [a.cpu() if isinstance(a, Tensor) else a for a in arguments] if elsewhere else arguments
        with _checks.full_precision(_NUMBER):
            results = function(*here)
        if not elsewhere:
            return _owned(results)
        if isinstance(results, Tensor):
            return results.to(elsewhere[0])
        return tuple(r.to(elsewhere[0]) for r in results)

    return run


def _owned(results: Tensor | tuple[Tensor, ...]) -> Any:
    """The same memory, but no views: torch forbids to change those in place that an autograd function returns."""
    if not isinstance(results, Tensor):
        return tuple(map(_owned, results))
    if not results._is_view():
        return results
    return results.new_empty(0).set_(results)  # pyright: ignore[reportArgumentType]


interpreted = False
"""Send CPU tensors to the kernels for CUDA, which Triton's interpreter runs; see `testing.cuda_kernels_interpreted`."""


@functools.cache
def _cuda_kernel(name: str) -> Callable | None:
    from diffpoint import cuda  # not before a CUDA tensor is met

    try:
        return cuda.kernel_of(name)
    except ImportError as error:
        _warn_without_triton(str(error))
        return None


def check_pending() -> None:
    """Wait for the CUDA devices, and raise the first error that their kernels have found in the values of a tensor.

    Ops on CUDA tensors do not wait for the answers to their checks (see `configure`): call this before you save what
    came of them. Without CUDA tensors it does nothing: on the CPU every op raises its own errors at once.

    Raises:
        ValueError: an earlier op met NaN, an infinity or a length out of range.

    Example:
        >>> check_pending()
    """
    errors = sys.modules.get("diffpoint.cuda.errors")
    if errors is not None:
        errors.check_pending()


@functools.cache  # once in a process
def _warn_without_triton(reason: str) -> None:
    warnings.warn(
        f"diffpoint: CUDA tensors are copied to the CPU and back, because triton is missing ({reason}). torch's CUDA "
        "builds for Linux bring it; elsewhere: pip install triton, or triton-windows.",
        stacklevel=2,
    )


def _device(devices: list[torch.device]) -> contextlib.AbstractContextManager:
    """Makes the tensors' GPU the current one, on which Triton launches."""
    if not devices or devices[0].index in (None, torch.cuda.current_device()):
        return contextlib.nullcontext()
    return torch.cuda.device(devices[0])


def or_zeros(gradient: Tensor | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The gradient of an output, or one zero expanded to `shape` if there is none.

    For ops that call `ctx.set_materialize_grads(False)`: otherwise torch fills a tensor with zeros for every output
    without a gradient, indices and flags included.
    """
    return like.new_zeros(()).expand(shape) if gradient is None else gradient


def count_of(batch: tuple[int, ...]) -> int:
    """How many sets leading dimensions hold. `torch.Size.numel()` would fix their sizes while torch traces."""
    count = 1
    for size in batch:
        count *= size
    return count


def full_lengths(lengths: Tensor | None, batch: int, size: int, like: Tensor | None = None) -> Tensor:
    """`lengths` as (batch,) int64; full sets, on the device of `like`, where it is None."""
    if lengths is None:
        device = None if like is None else like.device
        return torch.full((batch,), size, dtype=torch.int64, device=device)
    return lengths.reshape(batch)
