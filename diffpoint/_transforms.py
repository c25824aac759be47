"""Makes registered operators work under the transforms of `torch.func`: grad, vjp, jacrev and vmap.

`torch.library.register_autograd` does not: under `torch.func.grad` its operators raise an error about `setup_context`,
and forward-mode derivatives through them are silently zero. The kernel registered here for the autograd key of a device
comes before the one of `register_autograd`, and handles one level of transforms; torch calls it again for the next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd import forward_ad
from torch.autograd.forward_ad import _set_fwd_grad_enabled

_LIBRARY = torch.library.Library("diffpoint", "FRAGMENT")
_DEVICES = ("CPU", "CUDA", "Lazy", "Meta", "MPS", "PrivateUse1", "XLA", "XPU")


def support(op: Any, name: str, backward: Callable | None, setup: Callable | None) -> None:
    """Register the derivatives and the batching rule of `op`, which torch knows as `diffpoint::<name>`.

    Every argument that is a tensor, and every result, has the batch as its first dimension.
    """
    kernel = _differentiable(op._opoverload, name, backward, setup)
    for device in _DEVICES:
        _LIBRARY.impl(name, kernel, f"Autograd{device}", with_keyset=True)
    op.register_vmap(_batched(op))


def _differentiable(op: Any, name: str, backward: Callable | None, setup: Callable | None) -> Callable:
    def below(keyset: Any, arguments: Sequence) -> Any:
        with torch._C._AutoDispatchBelowAutograd():
            return op.redispatch(keyset & torch._C._after_autograd_keyset, *arguments)

    def forward(ctx: Any, *arguments_and_keyset: Any) -> Any:
        *arguments, keyset = arguments_and_keyset
        if torch._C._are_functorch_transforms_active():
            # torch has disabled derivatives for the inside of this function, but the next level takes some too.
            with torch.enable_grad(), _set_fwd_grad_enabled(True):
                result = below(keyset, arguments)
        else:
            result = below(keyset, arguments)
        outputs = (result,) if isinstance(result, Tensor) else result
        ctx.differentiable = [r.is_floating_point() for r in outputs]
        if setup is not None:
            setup(ctx, tuple(arguments), result)
        return result

    def pull(ctx: Any, *gradients: Tensor | None) -> Any:
        if backward is None:
            order = ": it is a first derivative, and there are no second ones" if "_backward" in name else ""
            raise RuntimeError(f"diffpoint: the operator diffpoint.{name} has no autograd formula{order}.")
        result = backward(ctx, *gradients)
        return *(result if isinstance(result, tuple) else (result,)), None

    def push(ctx: Any, *tangents: Tensor | None) -> Any:
        if any(ctx.differentiable):
            raise NotImplementedError(
                f"diffpoint: the operator diffpoint.{name} has no forward-mode derivative (torch.func.jvp, jacfwd, "
                "hessian, torch.autograd.forward_ad). Use reverse mode: .backward(), torch.func.grad, vjp or jacrev."
            )
        return tuple(None for _ in ctx.differentiable)

    methods = {"forward": forward, "backward": pull, "jvp": push}
    function: Any = type(
        f"diffpoint_{name}", (torch.autograd.Function,), {k: staticmethod(m) for k, m in methods.items()}
    )

    # That of `Function` itself stands for all levels at once, and would not be called within one.
    apply = super(torch.autograd.Function, function).apply  # pyright: ignore[reportAttributeAccessIssue]

    def kernel(keyset: Any, *arguments: Any) -> Any:
        if torch._C._are_functorch_transforms_active():
            with enable_single_level_autograd_function():
                return apply(*arguments, keyset)
        if forward_ad._current_level < 0 and not (
            torch.is_grad_enabled() and any(isinstance(a, Tensor) and a.requires_grad for a in arguments)
        ):
            return below(keyset, arguments)  # saves 10 us
        return apply(*arguments, keyset)

    return kernel


def _batched(op: Callable) -> Callable:
    """The rule of `torch.vmap`: the dimension that it maps over is merged with the batch."""

    def rule(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        size = info.batch_size
        rows = [
            value.expand(size, *value.shape) if dim is None else value.movedim(dim, 0)
            for value, dim in zip(arguments, in_dims, strict=True)
            if isinstance(value, Tensor)
        ]
        batch = rows[0].shape[1]
        merged = iter([value.reshape(size * batch, *value.shape[2:]) for value in rows])
        result = op(*(next(merged) if isinstance(value, Tensor) else value for value in arguments))
        if isinstance(result, Tensor):
            return result.reshape(size, batch, *result.shape[1:]), 0
        return tuple(r.reshape(size, batch, *r.shape[1:]) for r in result), (0,) * len(result)

    return rule
