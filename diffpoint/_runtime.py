"""Starts Taichi at the first op unless the host program has; never restarts it, and refuses to use it after a fork."""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import inspect
import io
import math
import os
import platform
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Literal, get_args

from diffpoint import _checks
from diffpoint._backend import BACKENDS, backend_name, home_directory, import_backend, without_warnings
from diffpoint._launch import FastCall

Checks = Literal["deferred", "immediate", "off"]

# Taichi runs a parallel loop of up to 512 iterations on one thread unless it was started with other settings.
# Where the host program started Taichi, every loop therefore has this many times the iterations, of which one in so
# many does work.
_HOST_SPREAD = 512


@dataclass(frozen=True)
class RuntimeInfo:
    """What `runtime_info` returns."""

    backend: str
    """Module that compiles the kernels: taichi, or its fork quadrants."""
    version: str
    started: bool
    """Whether an op has run, or the host program started Taichi."""
    owner: str
    """Who started Taichi: "diffpoint", "host" or "nobody"."""
    threads: int
    cache: bool
    """Whether compiled kernels are cached on disk for later processes; False also where there is no place for them."""
    processor: str
    """Name of the processor, if the system reports it, to label measured times with."""


class _Runtime:
    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.threads: int | None = None
        self.cache = True
        self.checks: Checks = "deferred"
        self.program: Any = None
        self.forked = False
        self.kernels: dict[tuple[str, str], SimpleNamespace] = {}
        self.calls: dict[tuple[str, str, str], FastCall] = {}

    def current_program(self) -> Any:
        """The running Taichi program, started here or by the host; None before."""
        backend = sys.modules.get(backend_name())
        if backend is None:
            return None
        runtime = backend.lang.impl.get_runtime()
        return (
            runtime._prog if hasattr(runtime, "_prog") else runtime.prog
        )  # quadrants' `prog` raises before a start

    def ensure_started(self) -> int:
        """Start Taichi unless it runs. Returns the spread factor of parallel loops (see kernels/__init__.py)."""
        if self.forked:
            raise RuntimeError(
                "diffpoint: this process was forked after Taichi had started, and Taichi's threads do not survive a "
                "fork. Start workers with 'spawn', e.g. DataLoader(..., multiprocessing_context='spawn'), or call no "
                "diffpoint op in them."
            )
        program = self.current_program()
        if program is None:
            program = self._start()
        return 1 if program is self.program else _HOST_SPREAD

    def _start(self) -> Any:
        ti = import_backend()
        with (
            contextlib.redirect_stdout(io.StringIO()),  # init prints its version
            home_directory() as lasting,
            without_warnings(),
        ):
            self.cache = self.cache and lasting and _has_cache_folder(ti)
            ti.init(
                arch=ti.cpu,
                log_level=ti.ERROR,
                cpu_max_num_threads=self.threads or available_threads(),
                offline_cache=self.cache,
                fast_math=False,  # it would assume that there are no infinities, but empty pixels are +inf
                # With these, a parallel loop of two iterations already runs on two threads.
                make_cpu_multithreading_loop=False,
                default_cpu_block_dim=1,
            )
        self.program = self.current_program()
        return self.program

    def release(self) -> None:
        """Let go of the program at the end of the process: Taichi writes its cache when nothing refers to it any more.

        Not where it has no folder: it would crash, even with its cache turned off. Nor in a forked child, where it
        would wait for its threads, which are missing.
        """
        with self.lock:
            if self.program is None or not self.cache or self.forked:
                return
            if _has_cache_folder(import_backend()):
                self.calls.clear()
                self.kernels.clear()
                self.program = None

    def kernel(self, module: str, real: str) -> SimpleNamespace:
        """The kernels of `diffpoint.kernels.<module>` for "f32" or "f64"."""
        key = (module, real)
        if key not in self.kernels:
            ti = import_backend()
            with without_warnings():
                build = importlib.import_module(f"diffpoint.kernels.{module}").build
                self.kernels[key] = build(getattr(ti, real))
        return self.kernels[key]

    def call(self, module: str, kernel: str, real: str) -> FastCall:
        """One of these kernels, with less overhead than Taichi's own call."""
        key = (module, kernel, real)
        if key not in self.calls:
            self.calls[key] = FastCall(getattr(self.kernel(module, real), kernel))
        return self.calls[key]

    def argument_name(self, module: str, kernel: str, position: int) -> str:
        """Name of an argument in the kernel's source, for error messages."""
        return list(inspect.signature(getattr(self.kernel(module, "f32"), kernel)).parameters)[position]


def _has_cache_folder(ti: ModuleType) -> bool:
    """Whether the folder for compiled kernels exists or can be made.

    One that exists may be read-only: its kernels are used, and none are added.
    """
    prefix = {"taichi": "TI", "quadrants": "QD"}[ti.__name__]
    folder = os.environ.get(f"{prefix}_OFFLINE_CACHE_FILE_PATH")
    folder = folder or ti.lang.impl.default_cfg().offline_cache_file_path
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return True


def available_threads(
    groups: Path = Path("/sys/fs/cgroup"), membership: Path = Path("/proc/self/cgroup")
) -> int:
    """Number of cores that this process may use: of those it may run on, as many as its CPU quota pays for.

    Args:
        groups: where the control groups of the system are; containers get their quotas through them.
        membership: lists the groups of this process.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([cores, *(math.ceil(quota) for quota in _cpu_quotas(groups, membership))]))


def _cpu_quotas(groups: Path, membership: Path) -> Iterator[float]:
    """Seconds of CPU time per second that the control groups of this process allow, in both versions of these."""
    for line in _read(membership).splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers and "cpu" not in controllers.split(","):
            continue
        roots = [groups, groups / "unified"] if not controllers else [groups / "cpu", groups / controllers]
        # A limit of a group holds for those below it. In a container the path may be that of the host, of which only
        # the last part, or nothing, is mounted.
        folders = [Path(path.lstrip("/")), *Path(path.lstrip("/")).parents]
        for folder in (root / folder for root in roots for folder in folders):
            quota, _, period = _read(folder / "cpu.max").strip().partition(" ")
            if controllers:
                quota, period = (_read(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period"))
            if quota.isdecimal() and period.isdecimal() and int(quota) and int(period):  # else "max" or -1
                yield int(quota) / int(period)


def _read(file: Path) -> str:
    """Its text; nothing if it cannot be read."""
    try:
        return file.read_text()
    except OSError:
        return ""


RUNTIME = _Runtime()


def _mark_forked() -> None:
    if any(name in sys.modules for name in BACKENDS) and RUNTIME.current_program() is not None:
        RUNTIME.forked = True
    RUNTIME.lock = threading.RLock()  # another thread of the parent may have held the old one


atexit.register(RUNTIME.release)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_forked)


def configure(*, threads: int | None = None, cache: bool | None = None, checks: Checks | None = None) -> None:
    """Set how the kernels run; call it before the first op. Only `checks` may be changed later.

    Args:
        threads: number of threads of the CPU kernels; None means every core that this process may use, CPU quotas of
            containers included.
        cache: cache compiled CPU kernels on disk, so that the next process starts in a fraction of a second; None means
            yes.
        checks: when values of CUDA tensors that are not allowed (NaN, a length out of range) become errors. "deferred",
            the default, does not wait for the GPU: a later op raises the error, or `check_pending()`. "immediate" waits
            for every op and names the place of the value. "off" leaves them unnoticed. On the CPU every op raises its
            own errors at once. None changes nothing.

    Raises:
        RuntimeError: threads or cache after an op has run already (Taichi cannot be started twice in a process).
        ValueError: fewer than one thread, or unknown checks.

    Example:
        >>> import subprocess, sys
        >>> code = "import diffpoint; diffpoint.configure(threads=1); print(diffpoint.runtime_info().threads)"
        >>> subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip()
        '1'
    """
    if threads is not None:
        threads = _checks.check_integer("configure", "threads", threads, "be a positive integer or None", 1)
    if cache is not None:
        cache = _checks.check_flag("configure", "cache", cache)
    if checks is not None:
        _checks.check_choice("configure", "checks", checks, get_args(Checks))
    with RUNTIME.lock:
        if checks is not None:
            RUNTIME.checks = checks
            if threads is None and cache is None:
                return
        if RUNTIME.program is not None:
            raise RuntimeError(
                "configure: the kernels have started already; call configure() before the first op."
            )
        RUNTIME.threads = threads
        RUNTIME.cache = cache is not False


def runtime_info() -> RuntimeInfo:
    """Which backend runs the kernels, who started it, and on how many threads.

    Example:
        >>> runtime_info().backend in ("taichi", "quadrants")
        True
    """
    with RUNTIME.lock:
        ti = import_backend()
        program = RUNTIME.current_program()
        if program is None:
            owner, threads = "nobody", RUNTIME.threads or available_threads()
        else:
            owner = "diffpoint" if program is RUNTIME.program else "host"
            threads = int(ti.lang.impl.current_cfg().cpu_max_num_threads)
        return RuntimeInfo(
            backend=ti.__name__,
            version=".".join(str(part) for part in ti.__version__),
            started=program is not None,
            owner=owner,
            threads=threads,
            cache=RUNTIME.cache,
            processor=_processor_name(),
        )


@functools.cache  # `runtime_info` is called at every splat
def _processor_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")  # on Linux `platform` does not return the name
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
