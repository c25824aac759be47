"""Kernel calls with less overhead: 10 us of Python for six arrays instead of 80.

Taichi's own call examines every argument's type in Python. Here this is done once per kernel; afterwards the arguments
are passed to the compiled kernel directly. This uses functions of Taichi that are not public. Where they are
missing or differ (another version, its fork), and for arguments of other types, the kernel is called the public way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from diffpoint._backend import default_types, without_warnings

# What a missing attribute or a changed signature raises, before anything has run. An error of the kernel itself is a
# RuntimeError and is not caught: a kernel that adds to its outputs must not run twice.
_INCOMPATIBLE = (AttributeError, IndexError, KeyError, TypeError)


class _Array:
    """An array argument: its dtype, its dimensions, and the size of its vectors (0: scalars)."""

    def __init__(self, tensor: Tensor, vector: int) -> None:
        self.dtype, self.dim, self.vector = tensor.dtype, tensor.dim(), vector

    def fits(self, tensor: Tensor) -> bool:
        return (
            tensor.dtype is self.dtype
            and tensor.dim() == self.dim
            and (not self.vector or tensor.shape[-1] == self.vector)
            and tensor.is_contiguous()
        )


class FastCall:
    """One kernel, called directly in the program it was prepared for.

    Attributes:
        program: the Taichi program that the kernel is prepared for; None before.
        compatible: False once the direct way has failed; from then on the kernel is called the public way.
    """

    def __init__(self, kernel: Callable) -> None:
        self.kernel = kernel
        self.program: Any = None
        self.compatible = True
        self.compiled: Any = None
        self.code: Any = None
        self.parameters: list[_Array | str | None] = []

    def __call__(self, program: Any, arguments: tuple[Tensor | int | float, ...]) -> None:
        """Run on contiguous CPU tensors and numbers."""
        if program is self.program and self._try(self._run, arguments):
            return
        detached = [a.detach() if isinstance(a, Tensor) else a for a in arguments]
        with without_warnings(), default_types():
            self.kernel(*detached)
            self.program = None
            if self.compatible and self._try(self._prepare, program, detached):
                self.program = program

    def _try(self, step: Callable[..., bool], *arguments: Any) -> bool:
        try:
            return step(*arguments)
        except _INCOMPATIBLE:
            self.compatible = False
            return False

    def _run(self, arguments: tuple[Tensor | int | float, ...]) -> bool:
        """Whether the kernel has run: not on arguments of other types than those it was prepared for."""
        context = self.compiled.make_launch_context()
        for i, (parameter, value) in enumerate(zip(self.parameters, arguments, strict=True)):
            if isinstance(value, Tensor):
                if not isinstance(parameter, _Array) or not parameter.fits(value):
                    return False
                shape = value.shape[:-1] if parameter.vector else value.shape
                context.set_arg_external_array_with_shape((i,), value.data_ptr(), value.nbytes, shape, 0)
            elif parameter == "int":
                context.set_arg_int((i,), value)
            else:
                context.set_arg_float((i,), value)
        self.program.launch_kernel(self.code, context)
        return True

    def _prepare(self, program: Any, arguments: list[Any]) -> bool:
        """Whether the direct way exists for arguments like these."""
        primal = self.kernel._primal
        self.compiled = primal.compiled_kernels[primal.ensure_compiled(*arguments)]
        self.code = program.compile_kernel(program.config(), program.get_device_caps(), self.compiled)
        self.parameters = [
            _kind(p.annotation, value) for p, value in zip(primal.arguments, arguments, strict=True)
        ]
        return None not in self.parameters


def _kind(annotation: Any, value: Any) -> _Array | str | None:
    """How an argument is passed; None if only Taichi's own call can."""
    if isinstance(value, Tensor):
        element = annotation.dtype
        if annotation.layout.name != "AOS":
            return None
        if not hasattr(element, "ndim"):
            return _Array(value, 0)
        return _Array(value, int(element.n)) if element.ndim == 1 else None
    name = annotation.to_string()
    return {"i32": "int", "i64": "int", "f32": "float", "f64": "float"}.get(name)
