"""The choice between the compilers Taichi and Quadrants, and its import."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import sys
from types import ModuleType

BACKENDS = ("taichi", "quadrants")


@functools.cache
def backend_name() -> str:
    """The module that compiles the kernels in this process: DIFFPOINT_BACKEND, else taichi, else its fork quadrants."""
    name = os.environ.get("DIFFPOINT_BACKEND", "")
    if name not in ("", *BACKENDS):
        raise RuntimeError(f"diffpoint: DIFFPOINT_BACKEND must be 'taichi' or 'quadrants'; got {name!r}.")
    for candidate in (name,) if name else BACKENDS:
        if candidate in sys.modules or importlib.util.find_spec(candidate) is not None:
            return candidate
    raise ImportError(
        f"diffpoint: DIFFPOINT_BACKEND is {name!r}, which is not installed. Install it: pip install {name}."
        if name
        else "diffpoint: neither taichi nor quadrants is installed. Install one: pip install taichi."
    )


def import_backend() -> ModuleType:
    """The module of `backend_name`, imported without its messages."""
    name = backend_name()
    if name not in sys.modules:
        for backend in BACKENDS:
            os.environ.setdefault(f"ENABLE_{backend.upper()}_HEADER_PRINT", "0")
        os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # it would start a thread and use the network
    return importlib.import_module(name)
