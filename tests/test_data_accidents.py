"""What befalls a long conversion: a kill, a full disk, an enormous mesh. Each in a process of its own."""

import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import trimesh

from train.data import ShapeTree, tree_files
from train.data.meshes import convert

BOXES = 16
SETTINGS = {"size": 112, "views": 6}


def command(source, out, processes):
    words = ["data", "meshes", source, "--out", out, "--processes", processes]
    words += [word for name, value in SETTINGS.items() for word in (f"--{name}", value)]
    return [sys.executable, "-m", "train", *map(str, words)]


def save_boxes(folder, count=BOXES):
    folder.mkdir()
    for number in range(count):
        trimesh.creation.box((1, 1 + number / 10, 2)).export(folder / f"box {number:02d}.ply")


def files_of(root):
    return {
        path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def ends(group, seconds=60):
    """True if all processes of the group end by themselves."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_a_killed_run_leaves_no_process_and_is_finished_by_the_next(tmp_path):
    save_boxes(tmp_path / "in")
    out = tmp_path / "out"
    run = subprocess.Popen(
        command(tmp_path / "in", out, 2), start_new_session=True, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not list(out.glob(f"{tree_files.RENDERS}/*/box*")) and time.monotonic() < deadline:
        time.sleep(0.005)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    started = len(list(out.glob(f"{tree_files.RENDERS}/*/box*")))
    assert 1 <= started < BOXES  # it was killed in the middle
    assert not (out / tree_files.LISTS).exists()
    assert ends(run.pid)  # its workers went with it

    report = convert([tmp_path / "in"], out, processes=1, **SETTINGS)
    assert report.made + report.kept == BOXES
    assert report.kept >= started
    convert([tmp_path / "in"], tmp_path / "whole", processes=1, **SETTINGS)
    assert files_of(out) == files_of(tmp_path / "whole")


@pytest.fixture
def heeds_interrupts():
    """A suite that a shell started in the background ignores SIGINT, and so would the processes that it starts."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.mark.usefixtures("heeds_interrupts")
def test_an_interrupted_run_ends_at_once_with_one_word(tmp_path):
    """Also its workers, which a terminal interrupts as well, while they are still starting."""
    save_boxes(tmp_path / "in", 300)  # enough to be at work still on a machine that has other work to do
    run = subprocess.Popen(
        command(tmp_path / "in", tmp_path / "out", 2),
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "out" / "made_with.json").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(1)
    os.killpg(run.pid, signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130
    assert errors.splitlines()[-1] == "interrupted"
    assert "Traceback" not in errors
    assert ends(run.pid)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs limits of the system")
@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_full_disk_stops_the_run_with_one_line(tmp_path, processes):
    """A limit on the size of files stands for the disk: the first cloud of 24 kB cannot be written."""
    save_boxes(tmp_path / "in")
    out = tmp_path / "out"
    result = subprocess.run(
        command(tmp_path / "in", out, processes),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 2
    last = result.stderr.splitlines()[-1]
    assert last.startswith("error: rendering meshes stopped: File too large")
    assert "run the same command again" in last
    assert "Traceback" not in result.stderr
    assert not list(out.glob(f"{tree_files.RENDERS}/*/*"))  # nothing half-written, not even hidden
    if processes == 1:
        assert convert([tmp_path / "in"], out, processes=1, **SETTINGS).made == BOXES


def save_ball(path, side):
    """A binary PLY of 2 (side - 1)^2 faces: a bumpy sphere."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, side), np.linspace(0.01, np.pi - 0.01, side))
    radius = 1 + 0.02 * np.sin(40 * u) * np.sin(30 * v)
    corners = radius[..., None] * np.stack((np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)), -1)
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    path.parent.mkdir()
    trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False).export(path)
    return len(faces)


@pytest.mark.slow
def test_three_million_faces_take_neither_all_memory_nor_all_day(tmp_path):
    """Within 3 GB and two minutes, beside a small mesh that is none the worse for it."""
    assert save_ball(tmp_path / "in" / "ball.ply", 1230) > 3_000_000
    trimesh.creation.box().export(tmp_path / "in" / "box.ply")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command(tmp_path / "in", tmp_path / "out", 1), check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime - before.ru_utime < 120
    assert after.ru_maxrss < 3e6  # kB
    shapes = [
        shape for split in tree_files.SPLITS for shape in ShapeTree(tmp_path / "out", split).iter_valid()
    ]
    assert sorted(shape.id for shape in shapes) == ["unknown/ball", "unknown/box"]
