"""Peers that may not be installed (extra [bench]), and a loop for those that take a single cloud."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import os
from collections.abc import Callable
from types import ModuleType
from typing import Any


@functools.cache
def optional(name: str) -> ModuleType | None:
    """The module; None, with a line printed once, if it is missing or cannot be imported."""
    if os.environ.get("BENCHMARKS_WITHOUT_PEERS"):
        return None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return importlib.import_module(name)
    except Exception as error:  # a broken wheel may raise anything
        print(f"without {name}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
        return None


@functools.cache
def keops() -> ModuleType | None:
    """pykeops.torch if it can be imported, which needs a C++ compiler."""
    module = optional("pykeops")
    if module is None:
        return None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            module.set_verbose(False)
            return importlib.import_module("pykeops.torch")
    except Exception as error:
        print(f"without pykeops: {error}")
        return None


def each(count: int, function: Callable[[int], Any]) -> list[Any]:
    return [function(i) for i in range(count)]
