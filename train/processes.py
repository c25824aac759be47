"""What long commands share: worker processes, Ctrl-C and SIGTERM as a request to stop, progress bars.

Nothing here imports torch: the command line imports this module, and a worker that needs no torch starts at once.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, Literal, TypeVar

from tqdm import tqdm

from train.errors import UserError
from train.files import DISK_ERRORS

Job = TypeVar("Job")


def run_in_processes(
    function: Callable[..., object],
    calls: Sequence[tuple[Any, ...]],
    *,
    processes: int,
    title: str,
    progress: bool = True,
) -> None:
    """Calls `function(*call)` for each call, in worker processes with one torch thread each. Results are dropped.

    On Ctrl-C or SIGTERM each worker gets SIGTERM once; a training then saves and ends. After a call that raises, no
    other is started; those that are running finish first.

    Args:
        function: importable by name, because it is pickled, as its arguments are.
        calls: the arguments of each call.
        processes: how many run at once, at most.
        title: what is done, in the plural; shown before the bar.
        progress: show a progress bar.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM.
        UserError: a worker was killed from outside, for instance for lack of memory.
        Exception: whatever the first call that failed has raised.
    """
    bar = progress_bar(total=len(calls), title=title, unit=title.removesuffix("s"), progress=progress)
    with bar:
        for _ in _results(function, calls, processes, on_crash="stop", title=title):
            bar.update()


def map_unordered(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    *,
    processes: int | None,
    title: str,
    unit: str,
    progress: bool = True,
    jobs_per_process: int = 8,
) -> Generator[tuple[Job, Any], None, None]:
    """Yields (job, function(job)) as the jobs finish; the result of one whose process crashed is an `OSError`.

    Args:
        function: importable by name; returns what is wrong with a job instead of raising it.
        jobs: can be pickled.
        processes: how many work at once; 1 means this process. None: one per core, if there are enough jobs.
        title: shown before the bar.
        unit: what a job is.
        progress: show a progress bar.
        jobs_per_process: with `processes=None`, how many jobs make it worth while to start a process.

    Raises:
        KeyboardInterrupt: Ctrl-C, or SIGTERM while there are workers.
        UserError: a result is an `OSError` which says that nothing more can be written.
    """
    if processes is None:
        processes = min(os.cpu_count() or 1, len(jobs) // jobs_per_process)
    if processes > 1:
        calls = [(job,) for job in jobs]
        results = _results(function, calls, processes, on_crash="return", title=title)
    else:
        results = ((number, function(job)) for number, job in enumerate(jobs))
    with progress_bar(total=len(jobs), title=title, unit=unit, progress=progress) as bar:
        for number, result in results:
            if isinstance(result, OSError) and result.errno in DISK_ERRORS:
                raise UserError(
                    f"{title} stopped: {result.strerror}. Finished files are kept; free some space, then run the same "
                    "command again"
                )
            bar.update()
            yield jobs[number], result


def _results(
    function: Callable[..., Any],
    calls: Sequence[tuple[Any, ...]],
    processes: int,
    *,
    on_crash: Literal["stop", "return"],
    title: str,
) -> Iterator[tuple[int, Any]]:
    """Yields (number of the call, result) as calls finish. A worker has one call at a time; none waits in a queue."""
    waiting = deque(enumerate(calls))
    idle: list[_Worker] = []
    busy: dict[Connection, tuple[_Worker, int]] = {}
    failed: BaseException | None = None
    finished = False
    with StopRequest() as stop:
        try:
            while busy or (waiting and failed is None):
                while waiting and failed is None and len(busy) < processes:
                    worker = idle.pop() if idle else _Worker()
                    number, call = waiting.popleft()
                    busy[worker.connection] = worker, number
                    worker.send(function, call)
                for connection in wait(list(busy), timeout=0.5):
                    worker, number = busy.pop(connection)  # type: ignore[arg-type]
                    try:
                        succeeded, result = worker.receive()
                    except (EOFError, OSError):
                        worker.end()
                        succeeded = on_crash == "return"
                        result = (
                            OSError("the process that worked on it crashed or ran out of memory")
                            if succeeded
                            else UserError(
                                f"one of the {title} was killed from outside (out of memory?); run the same command "
                                "again to continue, with fewer --processes"
                            )
                        )
                    else:
                        idle.append(worker)
                    if succeeded:
                        yield number, result
                    else:
                        failed = failed or result
                if stop.requested:
                    raise KeyboardInterrupt
            finished = True
        finally:
            workers = [*idle, *(worker for worker, _ in busy.values())]
            if not finished:
                for worker in workers:
                    worker.terminate()
            for worker in workers:
                worker.end()
    if failed is not None:
        raise failed


class _Worker:
    """A process that makes one call after the other, as they come through a pipe; it ends when the pipe is closed."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads can hang
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,))
        with _without_interrupts(), _without_main():
            self._process.start()
        theirs.close()

    def send(self, function: Callable[..., Any], call: tuple[Any, ...]) -> None:
        """Starts a call. Plain pickle, because multiprocessing's own would share tensors instead of copying them."""
        message = pickle.dumps((function, call))
        with suppress(BrokenPipeError):  # it crashed; `receive` finds out
            self.connection.send_bytes(message)

    def receive(self) -> tuple[bool, Any]:
        """(True, result) or (False, exception) of the call."""
        succeeded, result, trace = pickle.loads(self.connection.recv_bytes())
        if not succeeded:
            result.__cause__ = RuntimeError(f"in a worker process:\n{trace}")
        return succeeded, result

    def terminate(self) -> None:
        """Sends SIGTERM."""
        self._process.terminate()

    def end(self) -> None:
        """Waits until the process has ended, after its current call."""
        self.connection.close()
        self._process.join()
        self._process.close()


def _serve(connection: Connection) -> None:
    """What a worker does."""
    if hasattr(os, "setsid"):  # not on Windows
        os.setsid()  # a terminal's Ctrl-C, or a SIGTERM to the whole group, would come beside the parent's SIGTERM
    threading.Thread(target=_end_with_parent, daemon=True).start()
    first = True
    with suppress(EOFError, ConnectionError):  # the parent has no more calls, or has ended
        while True:
            message = connection.recv_bytes()
            try:
                function, call = pickle.loads(message)
                if first:
                    _use_one_thread()
                first, answer = False, pickle.dumps((True, function(*call), None))
            except BaseException as error:
                answer = _pickled_error(error)
            connection.send_bytes(answer)


def _pickled_error(error: BaseException) -> bytes:
    trace = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    try:
        message = pickle.dumps((False, error, trace))
        pickle.loads(message)
    except Exception:  # some exceptions cannot be pickled
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}"), trace))
    return message


def _use_one_thread() -> None:
    """Networks and shapes this small use a core each better than all cores together."""
    if "torch" in sys.modules:
        import torch

        torch.set_num_threads(1)
    if "diffpoint" in sys.modules:
        import diffpoint

        diffpoint.configure(threads=1)


def _end_with_parent() -> None:
    """Without this, the workers of a killed process would go on."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Processes started in this block never see Ctrl-C, from their first moment on: a child inherits the blocking."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # else the first process starts it, which unblocks the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _without_main() -> Iterator[None]:
    """Processes started in this block do not import the program's main script.

    A script without `if __name__ == "__main__"` would start again in each of them.
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


class StopRequest:
    """Inside its block, the first SIGINT or SIGTERM sets `requested`; a second one interrupts as usual.

    Outside the main thread, where Python allows no handlers, signals keep their usual meaning.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()


def progress_bar(
    iterable: Iterable[Any] | None = None,
    *,
    title: str,
    unit: str,
    total: int | None = None,
    progress: bool = True,
    **options: Any,
) -> tqdm:
    """A tqdm bar on stderr; where that is no terminal but a file, a line every 30 seconds and one at the end.

    Args:
        iterable: what is looped over; without one, call `update`.
        title: what is done; shown before the bar.
        unit: what is counted, in the singular.
        total: how many there are, if `iterable` has no length.
        progress: False shows nothing.
        options: others of tqdm.
    """
    kind = tqdm if getattr(sys.stderr, "isatty", bool)() else _LogLines
    return kind(iterable, desc=title, unit=unit, total=total, disable=not progress, **options)


class _LogLines(tqdm):
    """Progress as lines of a log file."""

    _every_seconds = 30.0
    _due: float | None = None

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        now = time.monotonic()
        if self._due is not None and now < self._due:
            return False
        if self._due is not None:
            print(self, file=self.fp, flush=True)
        self._due = now + self._every_seconds
        return True

    def clear(self, nolock: bool = False) -> None:
        """Nothing is drawn that could be in the way of other lines."""

    def close(self) -> None:
        if not self.disable and self.leave is not False:
            print(self, file=self.fp, flush=True)
        self.sp = None  # tqdm's own last line moves the cursor
        super().close()
