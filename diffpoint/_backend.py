"""The choice between the compilers Taichi and Quadrants, and its import."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
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
    if name in sys.modules:
        return sys.modules[name]
    # No banner, no thread that looks for a new version on the network, no message that stdout is replaced.
    settings = {"TI_SKIP_VERSION_CHECK": "ON"}
    settings |= {f"ENABLE_{backend.upper()}_HEADER_PRINT": "0" for backend in BACKENDS}
    for variable, value in settings.items():
        os.environ.setdefault(variable, value)
    with home_directory(), without_warnings(), _environment(TI_LOG_LEVEL="error", QD_LOG_LEVEL="error"):
        return importlib.import_module(name)


@contextlib.contextmanager
def home_directory() -> Iterator[bool]:
    """A home directory, for daemons that have none in their environment: without one, Taichi aborts the process.

    Yields whether it is one to keep files in, which a stand-in is not.
    """
    if os.name != "posix" or os.environ.get("HOME") or os.environ.get("XDG_CACHE_HOME"):
        yield True
        return
    home = os.path.expanduser("~")  # from the list of users; unchanged if this one is not on it
    found = os.path.isabs(home)
    with _environment(HOME=home if found else tempfile.gettempdir()):
        yield found


@contextlib.contextmanager
def default_types() -> Iterator[None]:
    """Numbers in kernels are of 32 bits inside, whatever a host program has chosen when it started the compiler."""
    backend = import_backend()
    runtime = backend.lang.impl.get_runtime()
    before = getattr(runtime, "default_fp", None), getattr(runtime, "default_ip", None)
    wanted = backend.f32, backend.i32
    if None in before or before == wanted:
        yield
        return
    try:
        runtime.set_default_fp(wanted[0])
        runtime.set_default_ip(wanted[1])
        yield
    finally:
        runtime.set_default_fp(before[0])
        runtime.set_default_ip(before[1])


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Hides the compiler's warnings of its own code, which would end a program run with `python -W error`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Sets those environment variables that are not set, or are empty."""
    before = {name: os.environ.get(name) for name in variables}
    try:
        os.environ.update({name: value for name, value in variables.items() if not before[name]})
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
