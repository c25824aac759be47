"""Trainings and measurements side by side: networks this small use one core each better than all cores together."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch
from tqdm import tqdm

import diffpoint
from train.errors import UserError
from train.processes import StopRequest


def run_side_by_side(
    function: Callable[..., object],
    arguments: Sequence[tuple[Any, ...]],
    *,
    processes: int,
    title: str,
    progress: bool = True,
) -> None:
    """Calls a function with each of several arguments, in processes with one thread each.

    Ctrl-C and SIGTERM are passed on once to every process, where a training saves and ends; then KeyboardInterrupt is
    raised. A call that fails lets those that are under way come to their end, and is raised then.

    Args:
        function: importable by name; it and its arguments are pickled.
        arguments: of every call.
        processes: at once, if there are as many calls.
        title: of the bar: what is done, in the plural.
        progress: show it.

    Raises:
        UserError: a process was ended from outside.
    """
    processes = min(processes, len(arguments))
    context = multiprocessing.get_context("spawn")
    waiting, running = deque(arguments), set[Future[object]]()
    failed: BaseException | None = None
    with (
        StopRequest() as stop,
        ProcessPoolExecutor(processes, mp_context=context, initializer=_alone) as pool,
        tqdm(total=len(arguments), desc=title, unit=title.removesuffix("s"), disable=not progress) as bar,
    ):
        while running or (waiting and failed is None):
            # No more than run at once are handed over: what waits in the pool could not be taken back.
            while waiting and failed is None and len(running) < processes:
                running.add(pool.submit(function, *waiting.popleft()))
            done, running = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
            for future in done:
                failed = failed or future.exception()
                bar.update(failed is None)
            if stop.requested:
                for child in multiprocessing.active_children():
                    child.terminate()
                pool.shutdown(wait=True, cancel_futures=True)
                raise KeyboardInterrupt
    if isinstance(failed, BrokenProcessPool):
        raise UserError(
            f"one of the {title} was ended from outside (out of memory?); call again to continue, with fewer "
            "--processes"
        ) from None
    if failed is not None:
        raise failed


def _alone() -> None:
    """Prepares a worker: one thread, out of reach of the terminal's Ctrl-C, and not longer alive than its parent."""
    if hasattr(os, "setsid"):  # not on Windows
        os.setsid()
    torch.set_num_threads(1)
    diffpoint.configure(threads=1)
    threading.Thread(target=_watch, args=(os.getppid(),), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    os.kill(os.getpid(), signal.SIGTERM)
