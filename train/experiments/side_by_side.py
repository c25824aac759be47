"""Trainings and measurements in parallel: networks this small use one core each better than all cores together."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.synchronize import Event
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

    Ctrl-C and SIGTERM are passed on once to every process of this call, where a training saves and ends; then
    KeyboardInterrupt is raised. If a call fails, those that run at the same time are finished before it is raised.

    Args:
        function: importable by name; it and its arguments are pickled.
        arguments: of every call.
        processes: at once, if there are as many calls.
        title: of the progress bar: what is done, in the plural.
        progress: show it.

    Raises:
        UserError: a process was ended from outside.
    """
    processes = min(processes, len(arguments))
    context = multiprocessing.get_context("spawn")
    ended = context.Event()
    waiting, running = deque(arguments), set[Future[object]]()
    failed: BaseException | None = None
    with (
        StopRequest() as stop,
        ProcessPoolExecutor(processes, context, initializer=_start_worker, initargs=(ended,)) as pool,
        tqdm(total=len(arguments), desc=title, unit=title.removesuffix("s"), disable=not progress) as bar,
    ):
        while running or (waiting and failed is None):
            # Only as many as run at once are handed over: what waits in the pool could not be taken back.
            while waiting and failed is None and len(running) < processes:
                running.add(pool.submit(function, *waiting.popleft()))
            done, running = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
            for future in done:
                failed = failed or future.exception()
                bar.update(failed is None)
            if stop.requested:
                ended.set()  # reaches the workers of this pool alone, not other children of the program
                pool.shutdown(wait=True, cancel_futures=True)
                raise KeyboardInterrupt
    if isinstance(failed, BrokenProcessPool):
        raise UserError(
            f"one of the {title} was ended from outside (out of memory?); call again to continue, with fewer "
            "--processes"
        ) from None
    if failed is not None:
        raise failed


def _start_worker(ended: Event) -> None:
    """Prepares a worker: one thread, not reached by the terminal's Ctrl-C, and ended with its parent."""
    if hasattr(os, "setsid"):  # not on Windows
        os.setsid()
    torch.set_num_threads(1)
    diffpoint.configure(threads=1)
    threading.Thread(target=_watch, args=(os.getppid(), ended), daemon=True).start()


def _watch(parent: int, ended: Event) -> None:
    while not ended.wait(1) and os.getppid() == parent:
        pass
    os.kill(os.getpid(), signal.SIGTERM)
