"""Worker processes: results, failures, crashes, stops; and progress bars in a terminal and in a log file."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from train.errors import UserError
from train.processes import StopRequest, _LogLines, map_unordered, progress_bar, run_in_processes

REPOSITORY = Path(__file__).parents[1]


def ends(pid: int, seconds: float = 60) -> bool:
    """True if the process ends by itself."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def crash_on_two(job: int) -> int:
    if job == 2:
        os._exit(1)
    return job * 10


def test_a_process_that_crashes_costs_only_its_own_job() -> None:
    jobs = list(range(6))
    results = dict(map_unordered(crash_on_two, jobs, processes=2, title="crashing", unit="job"))
    assert isinstance(results.pop(2), OSError)
    assert results == {job: 10 * job for job in jobs if job != 2}


def note(folder: Path, number: int) -> None:
    """Writes down that it began, fails if it is number 1, and writes down that it finished."""
    (folder / f"{number} began").touch()
    if number == 1:
        raise UserError("number 1 is wrong")
    time.sleep(0.5)
    (folder / f"{number} finished").touch()


def test_after_a_failure_the_running_calls_finish_and_no_other_starts(tmp_path: Path) -> None:
    calls = [(tmp_path, number) for number in range(8)]
    with pytest.raises(UserError, match="number 1 is wrong") as caught:
        run_in_processes(note, calls, processes=2, title="notes", progress=False)
    assert "in note" in str(caught.value.__cause__)  # the worker's own traceback
    began, finished = (
        {path.name.split()[0] for path in tmp_path.glob(f"* {what}")} for what in ("began", "finished")
    )
    assert began - finished == {"1"}
    assert len(began) < 8


def crash(number: int) -> None:
    crash_on_two(2)


def test_a_call_whose_process_was_killed_is_an_error_for_the_user() -> None:
    with pytest.raises(UserError, match=r"one of the trainings was killed .* fewer --processes"):
        run_in_processes(crash, [(0,), (1,)], processes=2, title="trainings", progress=False)


def save_when_stopped(folder: Path, number: int) -> None:
    """As a training does: SIGTERM makes it save and end."""
    with StopRequest() as stop:
        (folder / f"{number} began").touch()
        while not stop.requested:
            time.sleep(0.01)
        time.sleep(0.3)  # a second SIGTERM would end it here
        (folder / f"{number} saved").touch()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_workers_once_and_no_other_child_process(
    tmp_path: Path, number: signal.Signals
) -> None:
    foreign = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    foreign.start()

    def interrupt() -> None:
        while len(list(tmp_path.glob("* began"))) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt, daemon=True).start()
    calls = [(tmp_path, call) for call in range(5)]
    try:
        with pytest.raises(KeyboardInterrupt):
            run_in_processes(save_when_stopped, calls, processes=2, title="trainings", progress=False)
        assert sorted(path.name for path in tmp_path.glob("* saved")) == ["0 saved", "1 saved"]
        assert not list(tmp_path.glob("[2-4] *"))
        assert foreign.is_alive()
    finally:
        foreign.kill()
        foreign.join()


_KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_processes import write_pid
from train.processes import run_in_processes
run_in_processes(write_pid, [(Path({folder!r}), k) for k in range(2)], processes=2, title="sleeps")
"""


def write_pid(folder: Path, number: int) -> None:
    (folder / f"{number}.tmp").write_text(str(os.getpid()))
    (folder / f"{number}.tmp").rename(folder / f"{number}.pid")
    time.sleep(60)


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = _KILLED.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", script], cwd=REPOSITORY, stderr=subprocess.DEVNULL
    ) as parent:
        while len(list(tmp_path.glob("*.pid"))) < 2:
            assert parent.poll() is None
            time.sleep(0.01)
        parent.kill()
    assert all(ends(int(path.read_text())) for path in tmp_path.glob("*.pid"))


_INTERRUPTED = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a suite in the background ignores it, and so its children
from train.processes import run_in_processes
print("begun", flush=True)
try:
    run_in_processes(time.sleep, [(60,)] * 4, processes=2, title="sleeps", progress=False)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("after_seconds", [0.02, 0.2, 1.0])  # while they start, and when they have started
def test_a_terminal_s_ctrl_c_reaches_the_workers_through_their_parent_only(after_seconds: float) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTED], cwd=REPOSITORY, start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert parent.stdout is not None
    assert parent.stdout.readline() == "begun\n"
    time.sleep(after_seconds)
    os.killpg(parent.pid, signal.SIGINT)  # the terminal signals the whole group
    out, errors = parent.communicate(timeout=60)
    assert (out, errors) == ("interrupted\n", "")


_SCRIPT = """
import math, sys
print("begun")
from train.processes import map_unordered
found = sorted(map_unordered(math.sqrt, [1, 4, 9], processes=2, title="roots", unit="root", progress=False))
print(found, __file__ == sys.argv[0], __spec__, "torch" in sys.modules)
"""


def test_a_script_without_a_main_guard_is_run_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(_SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False,
        env={"PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["begun", "[(1, 1.0), (4, 2.0), (9, 3.0)] True None False"]


def test_few_jobs_are_done_in_this_process() -> None:
    results = map_unordered(lambda job: os.getpid(), range(4), processes=None, title="few", unit="job")
    assert {pid for _, pid in results} == {os.getpid()}


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no way to give a process one core")
def test_a_process_with_one_core_starts_no_others() -> None:
    code = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import train.processes
from train.processes import map_unordered
train.processes._results = None  # would start workers
assert len(list(map_unordered(abs, range(-32, 0), processes=None, title="many", unit="job", progress=False))) == 32
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False, cwd=REPOSITORY
    )
    assert done.returncode == 0, done.stderr


def test_a_log_file_gets_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in progress_bar(range(100), title="counting", unit="number"):
        time.sleep(0.002)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("counting: 100%")
    monkeypatch.setattr(_LogLines, "_every_seconds", 0.2)
    with progress_bar(total=100, title="counting", unit="number") as bar:
        for number in range(100):
            time.sleep(0.01)
            bar.update()
            bar.set_postfix(loss=number)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 8
    assert lines[-1].startswith("counting: 100%")
    list(progress_bar(range(3), title="counting", unit="number", progress=False))
    list(progress_bar(range(3), title="counting", unit="number", leave=False))
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar_in_place(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    for _ in progress_bar(range(5), title="counting", unit="number", mininterval=0):
        pass
    written = capsys.readouterr().err
    assert written.count("\r") >= 5
    assert written.count("\n") == 1
