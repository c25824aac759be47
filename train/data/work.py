"""Many independent jobs over processes, with a progress bar; one that dies takes no other with it."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.context import SpawnContext
from typing import Any, TypeVar

from tqdm import tqdm

from train.errors import UserError

UNWRITABLE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
"""Errors of the disk and not of the file: no other file can be written either."""

Job = TypeVar("Job")
_JOBS_WORTH_A_PROCESS = 8


def run_all(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    *,
    processes: int | None,
    desc: str,
    unit: str,
    progress: bool = True,
) -> Generator[tuple[Job, Any], None, None]:
    """Yield (job, result) as jobs end. `function` must return its failures; a crash yields an `OSError`.

    Args:
        function: a module-level function of one picklable job.
        processes: at most this many; None means one per core, and only this one for a handful of jobs.
        desc: of the bar.
        unit: of the bar.
        progress: show the bar.

    Raises:
        UserError: a job's result says that the disk is full.
    """
    wanted = processes or min(os.cpu_count() or 1, -(-len(jobs) // _JOBS_WORTH_A_PROCESS))
    with tqdm(total=len(jobs), desc=desc, unit=unit, disable=not progress) as bar:
        if wanted <= 1:
            results = ((job, function(job)) for job in jobs)
        else:
            results = _in_pool(function, jobs, wanted)
        for job, result in results:
            if isinstance(result, OSError) and result.errno in UNWRITABLE:
                raise UserError(
                    f"{desc} stopped: {result.strerror}. What is finished stays; make room, then run the same "
                    "command again"
                )
            bar.update()
            yield job, result


def _in_pool(
    function: Callable[[Job], Any], jobs: Sequence[Job], processes: int
) -> Iterator[tuple[Job, Any]]:
    """A crash breaks the whole pool of processes: those it worked on then run alone, the rest in a new pool."""
    # Not forked: a child of a process with torch's or Taichi's threads can hang.
    context = multiprocessing.get_context("spawn")
    left = dict.fromkeys(range(len(jobs)))
    others = set(multiprocessing.active_children())
    while left:
        pool = ProcessPoolExecutor(min(processes, len(left)), mp_context=context, initializer=_follow_parent)
        try:
            with without_interrupts(), _without_main():
                futures = {pool.submit(function, jobs[number]): number for number in left}
            for future in as_completed(futures):
                result = future.result()
                del left[futures[future]]
                yield jobs[futures[future]], result
        except KeyboardInterrupt:  # whoever asked for it does not wait for the jobs that are under way
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
            raise
        except BrokenProcessPool:
            for number in list(left)[:processes]:  # jobs start in order: it worked on the first ones not done
                del left[number]
                yield jobs[number], _alone(function, jobs[number], context)
        finally:
            pool.shutdown(cancel_futures=True)


def _alone(function: Callable[[Job], Any], job: Job, context: SpawnContext) -> Any:
    with ProcessPoolExecutor(1, mp_context=context, initializer=_follow_parent) as pool:
        try:
            with without_interrupts(), _without_main():
                future = pool.submit(function, job)
            return future.result()
        except BrokenProcessPool:
            return OSError("the process that worked on it crashed or ran out of memory")


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes started in this block leave Ctrl-C to their parent, from their first moment on.

    One that comes while they start is answered at the block's end.
    """
    if threading.current_thread() is not threading.main_thread():  # where Python allows no handlers
        yield
        return
    came: list[bool] = []
    handler = signal.signal(signal.SIGINT, lambda *_: came.append(True))
    blocks = hasattr(signal, "pthread_sigmask")  # what is blocked stays so in a child; a handler does not
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else set()
    try:
        yield
    finally:
        if blocks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def _without_main() -> Iterator[None]:
    """Processes started in this block do not import the program's main script, which they have no use for.

    A script without `if __name__ == "__main__"` would begin again in each of them, and wait there for its parent.
    """
    main = sys.modules["__main__"]
    hidden = {name: getattr(main, name) for name in ("__spec__", "__file__") if hasattr(main, name)}
    for name in hidden:
        setattr(main, name, None)
    try:
        yield
    finally:
        for name, value in hidden.items():
            setattr(main, name, value)


def _follow_parent() -> None:
    """End with the parent: the children of a killed process would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
