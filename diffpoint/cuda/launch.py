"""How Triton's kernels are launched."""

from __future__ import annotations

import struct
from typing import Any

import torch
import triton
import triton.language as tl

recorded: list[tuple[Any, tuple, dict[str, Any]]] | None = None
"""If a list, it receives every launch: kernel, arguments, options. For the test that compiles them without a GPU."""


def launch(kernel: Any, programs: int, *arguments: Any, warps: int = 4, registers: int | None = None) -> None:
    """Runs `programs` programs of a kernel on the current stream, each with `warps` times 32 threads.

    A thread gets at most `registers` registers: the fewer, the more programs share a multiprocessor.

    Products and sums are not fused: an edge between two pixels, or a tie, then falls as on the CPU.
    """
    options: dict[str, Any] = {"num_warps": warps, "enable_fp_fusion": False}
    if registers is not None:
        options["maxnreg"] = registers
    if recorded is not None:
        recorded.append((kernel, arguments, options))
    kernel[(programs,)](*arguments, **options)


def bits_of(value: float) -> int:
    """A number for a kernel, which takes it with `real`: Triton would round a float argument to 32 bits."""
    return struct.unpack("q", struct.pack("d", value))[0]


@triton.jit
def real(bits, like: tl.constexpr):
    """The number of `bits_of`, in the dtype `like`."""
    return bits.to(tl.int64).to(tl.float64, bitcast=True).to(like)


def type_name(argument: Any) -> str:
    """How Triton's signatures name the type of an argument that is not a constant."""
    names = {torch.float32: "fp32", torch.float64: "fp64", torch.int32: "i32", torch.int64: "i64"}
    names |= {torch.uint8: "u8", torch.bool: "i1"}
    if isinstance(argument, torch.Tensor):
        return "*" + names[argument.dtype]
    return "i32" if -(2**31) <= argument < 2**31 else "i64"
