"""What long commands share: worker processes, Ctrl-C and SIGTERM as a request to stop, progress bars.

Nothing here imports torch: the command line imports this module, and a worker that needs no torch starts at once.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

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
    killed = UserError(
        f"one of the {title} was killed from outside (out of memory?); run the same command again to continue, with "
        "fewer --processes"
    )
    with progress_bar(total=len(calls), title=title, unit=title.removesuffix("s"), progress=progress) as bar:
        for _ in _results(function, calls, processes, crash=killed):
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
        processes: how many work at once; 1 means this process. None: one per core that this
            process may use, if there are enough jobs.
        title: shown before the bar.
        unit: what a job is.
        progress: show a progress bar.
        jobs_per_process: with `processes=None`, how many jobs make it worth while to start a process.

    Raises:
        KeyboardInterrupt: Ctrl-C, or SIGTERM while there are workers.
        UserError: a result is an `OSError` which says that nothing more can be written.
    """
    if os.name == "nt":
        processes = 1  # workers get their pipe in a way that Windows does not have
    if processes is None:
        from diffpoint import runtime_info  # here, for it imports torch

        processes = min(runtime_info().threads, len(jobs) // jobs_per_process)
    if processes > 1:
        crash = OSError("the process that worked on it crashed or ran out of memory")
        results = _results(function, [(job,) for job in jobs], processes, crash=crash)
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
    function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], processes: int, *, crash: Exception
) -> Iterator[tuple[int, Any]]:
    """Yields (number of the call, result) as calls finish. A worker has one call at a time; none waits in a queue.

    `crash` is the result of a call whose worker crashed, if it is an `OSError`; else it is raised as an exception of
    the call would be, after the running calls have finished.
    """
    waiting = deque(enumerate(calls))
    idle: list[_Worker] = []
    busy: dict[Any, tuple[_Worker, int]] = {}
    failed: BaseException | None = None
    interrupted = True
    with StopRequest() as stop:
        try:
            while busy or (waiting and failed is None):
                while waiting and failed is None and len(busy) < processes:
                    worker = idle.pop() if idle else _Worker()
                    number, call = waiting.popleft()
                    busy[worker.connection] = worker, number
                    worker.send(function, call)
                for connection in wait(list(busy), timeout=0.5):
                    worker, number = busy.pop(connection)
                    try:
                        succeeded, result = worker.receive()
                        idle.append(worker)
                    except (EOFError, OSError):
                        worker.end()
                        succeeded, result = isinstance(crash, OSError), crash
                    if succeeded:
                        yield number, result
                    else:
                        failed = failed or result
                if stop.requested:
                    raise KeyboardInterrupt
            interrupted = False
        except GeneratorExit:
            # The caller has stopped: running calls are finished, so that no file is left half-written.
            interrupted = stop.requested
            raise
        finally:
            workers = [*idle, *(worker for worker, _ in busy.values())]
            if interrupted:
                for worker in workers:
                    worker.process.terminate()
            for worker in workers:
                worker.end()
    if failed is not None:
        raise failed


class _Worker:
    """A Python process that makes one call after the other, as they come through a pipe, until the pipe is closed.

    It is a new interpreter, not a fork, which would hang where the parent has threads; and no process of
    `multiprocessing`, which would run the program's main script again. It leads a session of its own: a Ctrl-C in the
    terminal reaches the parent only, and a worker gets one SIGTERM from there.
    """

    def __init__(self) -> None:
        self.connection, theirs = Pipe()
        with theirs:
            code = (
                f"import sys; sys.path[:] = {sys.path!r}; from train.processes import _serve; "
                f"_serve({theirs.fileno()}, {os.getpid()})"
            )
            self.process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    def send(self, function: Callable[..., Any], call: tuple[Any, ...]) -> None:
        """Starts a call. Plain pickle, because `Connection.send` would share tensors instead of copying them."""
        message = pickle.dumps((function, call))
        with suppress(BrokenPipeError):  # it crashed; `receive` finds out
            self.connection.send_bytes(message)

    def receive(self) -> tuple[bool, Any]:
        """(True, result) or (False, exception) of the call."""
        succeeded, result, trace = pickle.loads(self.connection.recv_bytes())
        if not succeeded:
            result.__cause__ = RuntimeError(f"in a worker process:\n{trace}")
        return succeeded, result

    def end(self) -> None:
        """Waits until the process has ended, after its current call."""
        self.connection.close()
        self.process.wait()


def _serve(descriptor: int, parent: int) -> None:
    """The worker's main function."""
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    first = True
    with (
        Connection(descriptor) as connection,
        suppress(EOFError, ConnectionError),
    ):  # the parent has closed it
        while True:
            message = connection.recv_bytes()
            try:
                function, call = pickle.loads(message)
                if first:
                    _use_one_thread()
                first, message = False, pickle.dumps((True, function(*call), None))
            except BaseException as error:
                message = _pickled_error(error)
            connection.send_bytes(message)


def _end_with_parent(parent: int) -> None:
    """Without this, the workers of a killed process would go on."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGTERM)


def _pickled_error(error: BaseException) -> bytes:
    trace = "".join(traceback.format_exception(error))
    try:
        message = pickle.dumps((False, error, trace))
        pickle.loads(message)
    except Exception:  # some exceptions cannot be pickled
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}"), trace))
    return message


def _use_one_thread() -> None:
    """Networks and shapes this small use a core each better than all cores together."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "diffpoint" in sys.modules:
        sys.modules["diffpoint"].configure(threads=1)


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

    def _note(self, *_: object) -> None:
        self.requested = True
        self.__exit__()

    def __exit__(self, *_: object) -> None:
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
