"""Errors in the values of CUDA tensors, found by the kernels and raised without waiting for them.

A kernel that meets a bad value (NaN, a length out of range) adds to a counter in the device's memory, of which each
kind of error has one. The counters are copied to the host now and then, in the stream, and looked at when the copy has
arrived: the error is then raised by a later operator, as CUDA's own errors are. `configure(checks="immediate")` waits
for every operator instead and names the value.
"""

from __future__ import annotations

import atexit
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from diffpoint import _checks
from diffpoint._runtime import RUNTIME

_COUNTERS = 256
_KINDS = {
    "finite": ("be finite", "Look for a division by zero or an exploded update before this call."),
    "length": ("lie between 0 and the number of points", "An empty set has no distance to anything."),
    "depth": ("be positive, and +inf where empty", "If 0 marks empty pixels, fill them with float('inf')."),
    "picks": (
        "be at most the number of points, and 'start' below it",
        "allow_fewer=True takes all that there are.",
    ),
    "last row": ("end in the row [0, ..., 0, 1]", "Divide the matrix by its last entry, or transpose it."),
    "invertible": ("be invertible", "Is a focal length 0?"),
    "extent": (_checks.expected_extent(squared=False), "Scale both down."),
    "extent of squares": (_checks.expected_extent(squared=True), "Scale both down."),
}


class _Counters:
    """The counters of one device, and the newest copy of them on the host."""

    def __init__(self, device: torch.device) -> None:
        self.values = torch.zeros(_COUNTERS, dtype=torch.int32, device=device)
        on_gpu = device.type == "cuda"
        self.copy = torch.zeros(_COUNTERS, dtype=torch.int32, pin_memory=on_gpu)
        self.arrived: Any = None  # an event of the stream that the copy was queued in
        self.unnoticed = torch.zeros(1, dtype=torch.int32, device=device)  # what is counted with checks="off"


_names: dict[tuple[str, str, str], int] = {}
_counters: dict[torch.device, _Counters] = {}


def counter(like: Tensor, function: str, argument: str, kind: str) -> Tensor:
    """The counter (1,) int32 of a kind of error, on the device of `like`; a kernel adds 1 or more to it."""
    if RUNTIME.checks == "off":
        return _of(like.device).unnoticed
    slot = _names.setdefault((function, argument, kind), len(_names))
    return _of(like.device).values[slot : slot + 1]


def defer(bad: Tensor, function: str, argument: str, kind: str) -> bool:
    """Counts the flags `bad` on their device unless the settings ask for an answer now; returns whether it did."""
    if RUNTIME.checks == "immediate":
        return False
    if RUNTIME.checks == "deferred" and not _capturing(bad.device):
        counter(bad, function, argument, kind).add_(bad.sum())
        _poll(_of(bad.device))
    return True


_checks.defer = defer


def settle(like: Tensor, name_it: Callable[[], object]) -> None:
    """Ends an operator: raises the errors that are known by now.

    Args:
        like: a tensor on the device.
        name_it: checks the operator's arguments and raises the error that names the value; called where the operator
            waits for its kernels, and one of them has found an error.

    Raises:
        ValueError: a bad value, of this operator or of an earlier one.
    """
    if RUNTIME.checks == "off" or _capturing(like.device):
        return
    state = _of(like.device)
    if RUNTIME.checks == "immediate" or like.device.type != "cuda":
        if bool(state.values.any()):
            found = state.values.to("cpu", copy=True)
            state.values.zero_()
            name_it()
            _raise(found, "")
        return
    _poll(state)


def check_pending() -> None:
    """See `diffpoint.check_pending`."""
    for state in _counters.values():
        state.copy.copy_(state.values)
        _look_at(state)


def _of(device: torch.device) -> _Counters:
    if device not in _counters:
        _counters[device] = _Counters(device)
    return _counters[device]


def _capturing(device: torch.device) -> bool:
    return device.type == "cuda" and torch.cuda.is_current_stream_capturing()


def _poll(state: _Counters) -> None:
    """Looks at the last copy of the counters if it has arrived, and sends for the next."""
    if state.arrived is not None:
        if not state.arrived.query():
            return
        _look_at(state)
    state.copy.copy_(state.values, non_blocking=True)
    state.arrived = torch.get_device_module(state.values.device).Event()
    state.arrived.record()


def _look_at(state: _Counters) -> None:
    state.arrived = None
    if bool(state.copy.any()):
        found = state.copy.clone()
        state.values.zero_()
        state.copy.zero_()
        _raise(
            found,
            "An operator has met it before this call: diffpoint.configure(checks='immediate') names the place.",
        )


def _raise(found: Tensor, hint: str) -> None:
    for (function, argument, kind), slot in _names.items():
        if int(found[slot]):
            expected, remedy = _KINDS[kind]
            raise _checks.fail(
                function, argument, expected, f"{int(found[slot])} that are not", hint or remedy
            )


def _at_exit() -> None:
    try:
        check_pending()
    except ValueError as error:
        warnings.warn(f"found at exit: {error}", RuntimeWarning, stacklevel=1)
    except RuntimeError:  # the device has failed, which has been reported
        pass


atexit.register(_at_exit)
