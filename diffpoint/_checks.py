"""Checks of arguments. Their errors read: `function: 'argument' must ...; got ...; how to fix it`."""

from __future__ import annotations

import contextlib
import math
import numbers
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._C import _functorch  # pyright: ignore[reportAttributeAccessIssue]
from torch._subclasses.fake_tensor import FakeTensor

from diffpoint import _auction

FLOATS = (torch.float32, torch.float64)

defer: Callable[[Tensor, str, str, str], bool] | None = None
"""`cuda.errors.defer`, once a kernel for CUDA has run."""


def fail(function: str, argument: str, expected: str, got: str, hint: str = "") -> ValueError:
    """The error that the checks raise, in one format."""
    return ValueError(f"{function}: '{argument}' must {expected}; got {got}." + (f" {hint}" if hint else ""))


def readable(*values: Tensor) -> bool:
    """Whether Python can read values of these.

    Not while torch traces, nor of tensors that have none (on the device meta, or fake), nor where `torch.vmap` maps
    over them.
    """
    if torch.compiler.is_compiling() or any(v.is_meta or isinstance(v, FakeTensor) for v in values):
        return False
    return _functorch.maybe_current_level() is None or not any(_is_mapped(v) for v in values)


def _is_mapped(value: Tensor) -> bool:
    while _functorch.is_functorch_wrapped_tensor(value):
        if _functorch.is_batchedtensor(value):
            return True
        value = _functorch.get_unwrapped(value)
    return False


def differentiated(*values: Tensor) -> bool:
    """Whether a gradient with respect to one of these may be asked for; in doubt, yes."""
    if not torch.is_grad_enabled():
        return False
    transformed = torch.compiler.is_compiling() or _functorch.maybe_current_level() is not None
    return transformed or any(v.requires_grad for v in values)


def full_precision(like: Tensor) -> contextlib.AbstractContextManager:
    """Matrices are multiplied in their own dtype inside, whatever `torch.autocast` says."""
    device = like.device.type
    if torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return contextlib.nullcontext()


def check_tensor(function: str, name: str, value: Any, shape: tuple[int | str, ...]) -> Tensor:
    """Type, dtype and shape of a float tensor. A string in `shape` is a free size; "*" any leading sizes."""
    if not isinstance(value, torch.Tensor):
        raise TypeError(f"{function}: '{name}' must be a torch.Tensor; got {_kind(value)}")
    if value.is_nested or value.layout is not torch.strided:
        kind = "nested" if value.is_nested else f"{value.layout}"
        raise TypeError(
            f"{function}: '{name}' must be a dense tensor; got a {kind} one. Pad it, or use .to_dense()."
        )
    if value.dtype not in FLOATS:
        raise TypeError(
            f"{function}: '{name}' must be float32 or float64; got {value.dtype}. Convert it with .float()."
        )
    check_shape(function, name, value, shape)
    return value


def _kind(value: Any) -> str:
    """What a value that is no tensor is, as the end of a message."""
    kind = type(value).__name__
    hint = " Convert it with torch.from_numpy." if kind == "ndarray" else ""
    if hasattr(value, "_fields"):
        hint = f" Pass one of its tensors: {', '.join(value._fields)}."
    elif isinstance(value, (list, tuple)):
        inside = any(isinstance(each, Tensor) for each in value)
        hint = " Pad and stack it: torch.nn.utils.rnn.pad_sequence(..., batch_first=True), with lengths."
        hint = hint if inside else " Convert it with torch.tensor."
    return f"{kind}.{hint}"


def check_device(function: str, name: str, value: Tensor, like: Tensor) -> None:
    """All tensors of a call are on one device, which may be any: the ops copy to the CPU and back."""
    if value.device != like.device:
        raise ValueError(
            f"{function}: '{name}' must be on the device of the other arguments ({like.device}); "
            f"got {value.device}. Move it with .to({str(like.device)!r})."
        )


def check_shape(
    function: str, name: str, value: Tensor, shape: tuple[int | str, ...], hint: str = ""
) -> None:
    free = shape[1:] if shape and shape[0] == "*" else shape
    leading_ok = value.dim() >= len(free) if len(free) != len(shape) else value.dim() == len(free)
    sizes = value.shape[value.dim() - len(free) :] if leading_ok else ()
    if not leading_ok or any(isinstance(s, int) and s != n for s, n in zip(free, sizes, strict=True)):
        wanted = "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        if not hint and value.dim() and isinstance(free[-1], int) and value.shape[-1] != free[-1]:
            hint = f"The last size must be {free[-1]}, not {value.shape[-1]}."
        elif not hint and value.dim() == len(free) - 1:
            hint = "Did you forget to batch? Add the leading dimension with [None]."
        raise fail(function, name, f"have shape {wanted}", str(tuple(value.shape)), hint)


def check_same_dtype(function: str, **tensors: Tensor) -> torch.dtype:
    """All tensors have one dtype and are on one device."""
    (first_name, first), *rest = tensors.items()
    for name, value in rest:
        if value.dtype != first.dtype:
            raise TypeError(
                f"{function}: '{name}' must have the dtype of '{first_name}' ({first.dtype}); got {value.dtype}."
            )
        check_device(function, name, value, first)
    return first.dtype


def check_lengths(
    function: str, name: str, lengths: Any, shape: tuple[int, ...], largest: int, like: Tensor | None = None
) -> Tensor | None:
    """Lengths are integers of shape `shape`, on the device of `like`; None means that every set is full."""
    if lengths is None:
        return None
    if not isinstance(lengths, torch.Tensor) or lengths.dtype not in (torch.int64, torch.int32):
        what = _kind(lengths)
        if isinstance(lengths, torch.Tensor):
            hint = "Of a mask take .sum(-1)." if lengths.dtype == torch.bool else "Convert it with .long()."
            what = f"{lengths.dtype}. {hint}"
        raise TypeError(f"{function}: '{name}' must be an integer tensor (int64); got {what}")
    if like is not None:
        check_device(function, name, lengths, like)
    if tuple(lengths.shape) != tuple(shape):
        raise fail(function, name, f"have shape {tuple(shape)}", str(tuple(lengths.shape)))
    return lengths.to(torch.int64)


def check_lengths_range(function: str, name: str, lengths: Tensor, largest: int, smallest: int = 0) -> None:
    """Reads values, so call it inside an op and not while torch traces."""
    if lengths.numel() == 0:
        return
    low, high = (int(v) for v in torch.aminmax(lengths))
    if low < smallest or high > largest:
        at = int(((lengths < smallest) | (lengths > largest)).flatten().nonzero()[0])
        got = int(lengths.flatten()[at])
        hint = "An empty set has no distance to anything." if got == 0 and smallest == 1 else ""
        raise fail(function, name, f"lie in [{smallest}, {largest}]", f"{got} at flat index {at}", hint)


def deferred(bad: Tensor, function: str, argument: str, kind: str) -> bool:
    """Whether an error is raised later if one of these flags is set: on a CUDA device, where a look would wait."""
    return bad.is_cuda and defer is not None and defer(bad, function, argument, kind)


def check_finite(function: str, name: str, value: Tensor, lengths: Tensor | None = None) -> None:
    """No NaN or infinity among the first `lengths` points. A finite sum is enough; only else are all values read.

    Not where `value` is not `readable`.
    """
    if value.numel() == 0 or not readable(value):
        return
    if not value.is_cuda and math.isfinite(float(value.sum())):
        return
    bad = ~torch.isfinite(value)
    if lengths is not None:
        bad &= (torch.arange(value.shape[-2], device=value.device) < lengths[..., None])[..., None]
    if deferred(bad, function, name, "finite"):
        return
    if bool(bad.any()):
        where = tuple(bad.nonzero()[0].tolist())
        raise fail(
            function,
            name,
            "be finite",
            f"{float(value[where])} at index {where} ({int(bad.sum())} in all)",
            "Look for a division by zero or an exploded update before this call.",
        )


def check_filled(function: str, name: str, clouds: Tensor, lengths: Tensor | None = None) -> None:
    """Finite clouds (*, N, 3) of at least one point, for functions that hand them on under another name."""
    if clouds.shape[-2] == 0 and math.prod(clouds.shape[:-2]):  # a batch of no clouds has no empty one
        raise fail(function, name, "hold at least one point", str(tuple(clouds.shape)))
    check_finite(function, name, clouds.detach(), lengths)


def check_sets(
    function: str, a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, *, smallest: int
) -> None:
    """The values of two batches of sets: lengths in range, and finite coordinates."""
    for name, cloud, lengths in (("a", a, a_lengths), ("b", b, b_lengths)):
        if cloud.shape[1] < smallest and cloud.shape[0]:  # a batch of no sets has no empty one
            raise fail(function, name, "hold at least one point", str(tuple(cloud.shape)))
        check_lengths_range(function, f"{name}_lengths", lengths, cloud.shape[1], smallest)
        check_finite(function, name, cloud, lengths)


def check_transport(
    a: Tensor,
    b: Tensor,
    a_lengths: Tensor,
    b_lengths: Tensor,
    prices: Tensor,
    known_cost: Tensor,
    squared: bool,
) -> Tensor:
    """The values of the arguments of `earth_mover_distance`.

    Returns the largest cost (B,) that two points of a pair can have by their bounding box, above 0 because bid
    increments are relative to it.
    """
    name = "earth_mover_distance"
    check_sets(name, a, b, a_lengths, b_lengths, smallest=1)
    for argument, values in (("start.prices", prices), ("start.cost", known_cost)):
        check_finite(name, argument, values)
    if not len(a):
        return a.new_empty(0)
    extent = _extent(a.detach(), a_lengths, b.detach(), b_lengths)
    largest = extent.square() if squared else extent
    if not bool((largest < _auction.LARGEST_COST).all()):
        raise fail(name, "a", expected_extent(squared), f"{extent.max():.3g}", "Scale both down.")
    return largest.clamp(min=_auction.SMALLEST_COST).to(a.dtype)


def check_cost(function: str, cost: Tensor) -> None:
    """Costs of matching `a` with `b`, which are finite unless the sets span too much."""
    if not bool(torch.isfinite(cost).all()):
        raise fail(function, "a", expected_extent(squared=False), "more", "Scale both down.")


def expected_extent(squared: bool) -> str:
    """What a distance that matches points expects of the extent of its first argument."""
    if squared:
        return "span less than 1e9 together with 'b' for squared distances"
    return "span less than 1e18 together with 'b'"


def _extent(a: Tensor, a_lengths: Tensor, b: Tensor, b_lengths: Tensor) -> Tensor:
    """Diagonal of the bounding box of each pair, in float64."""
    low, high = [], []
    for cloud, counts in ((a, a_lengths), (b, b_lengths)):
        padding = (torch.arange(cloud.shape[1], device=cloud.device) >= counts[:, None])[..., None]
        low.append(cloud.masked_fill(padding, torch.inf).amin(1))
        high.append(cloud.masked_fill(padding, -torch.inf).amax(1))
    return (torch.maximum(*high) - torch.minimum(*low)).norm(dim=-1, dtype=torch.float64)


def check_depth(function: str, name: str, depth: Tensor) -> None:
    """Depth maps hold positive numbers, and +inf where they are empty. Not checked where they are not `readable`."""
    if not readable(depth):
        return
    good = depth > 0
    if deferred(~good, function, name, "depth"):
        return
    if not bool(good.all()):
        where = tuple((~good).nonzero()[0].tolist())
        raise fail(
            function,
            name,
            "be positive, and +inf where empty",
            f"{float(depth[where])} at index {where}",
            "If 0, -1 or NaN marks empty pixels: depth.masked_fill(~(depth > 0), float('inf')).",
        )


def check_picks(lengths: Tensor, size: int, counts: Tensor, starts: Tensor, *, allow_fewer: bool) -> None:
    """The values of the arguments of `farthest_point_sample`."""
    check_lengths_range("farthest_point_sample", "lengths", lengths, size)
    hint = "Pass allow_fewer=True to choose all points of a smaller cloud." if not allow_fewer else ""
    _check_at_most("k", counts, torch.full_like(counts, 2**31 - 1) if allow_fewer else lengths, lengths, hint)
    _check_at_most("start", starts, (lengths - 1).clamp(min=0), lengths, "")


def _check_at_most(name: str, values: Tensor, largest: Tensor, lengths: Tensor, hint: str) -> None:
    wrong = ((values < 0) | (values > largest)).nonzero()
    if len(wrong):
        cloud = int(wrong[0])
        value, limit = int(values[cloud]), int(largest[cloud])
        expected = "be at least 0" if value < 0 else f"be at most {limit}"
        got = f"{value} for cloud {cloud}, which has {int(lengths[cloud])} points"
        raise fail("farthest_point_sample", name, expected, got, hint)


def check_clouds(function: str, name: str, value: Any) -> Tensor:
    """A batch of clouds (B, N, 3)."""
    return check_tensor(function, name, value, ("B", "N", 3))


def check_points(function: str, name: str, value: Any, size: str) -> Tensor:
    """Points (*, size, 3), or (*, size, 2) in a plane; these are returned with a third coordinate of 0."""
    check_tensor(function, name, value, ("*", size, "3 or 2"))
    if value.shape[-1] == 2:
        return torch.nn.functional.pad(value, (0, 1))
    hint = f"The last size must be 3, or 2 for points in a plane, not {value.shape[-1]}."
    check_shape(function, name, value, ("*", size, 3), hint)
    return value


def check_number(
    function: str, name: str, value: Any, expected: str, fits: Callable[[float], bool], hint: str = ""
) -> float:
    """A number of Python or numpy, of which `fits` is true; `expected` says it in words."""
    if isinstance(value, Tensor):
        hint = hint or f"Pass a number, for instance {name}.item()."
        raise TypeError(
            f"{function}: '{name}' must be a Python or numpy number; got a torch.Tensor, which would get no gradient. "
            + hint
        )
    if isinstance(value, bool) or not isinstance(value, (numbers.Real, torch.SymFloat, torch.SymInt)):
        raise TypeError(
            f"{function}: '{name}' must be a Python or numpy number; got {value!r} ({type(value).__name__})."
        )
    if not fits(float(value)):
        raise fail(function, name, expected, repr(value))
    return float(value)


def check_integer(function: str, name: str, value: Any, expected: str, smallest: int) -> int:
    """A whole number of Python or numpy, at least `smallest`; `expected` says it in words."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < smallest:
        raise fail(function, name, expected, repr(value))
    return number


def check_flag(function: str, name: str, value: Any) -> bool:
    """True or False, of Python or numpy: a word such as "no" would count as True."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(
            f"{function}: '{name}' must be True or False; got {value!r} ({type(value).__name__})."
        )
    return bool(value)


def check_choice(function: str, name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise fail(function, name, "be one of " + ", ".join(repr(c) for c in choices), repr(value))
