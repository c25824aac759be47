"""Long conversions: a kill, Ctrl-C, a full disk, an enormous mesh."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import trimesh
from PIL import Image
from trees import all_shapes, files_of

from train.__main__ import main
from train.data import tree_files
from train.data.meshes import convert

BOXES = 12
SETTINGS = {"size": 64, "views": 4}


def arguments(source, out, processes):
    words = ["data", "meshes", source, "--out", out, "--processes", processes]
    words += [word for name, value in SETTINGS.items() for word in (f"--{name}", value)]
    return [str(word) for word in words]


@pytest.fixture
def boxes(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(BOXES):
        trimesh.creation.box((1, 1 + number / 10, 2)).export(folder / f"box {number:02d}.ply")
    return folder


def finished(out):
    return len(list(out.glob(f"{tree_files.RENDERS}/*/box*")))


def test_a_killed_run_is_finished_by_the_next(boxes, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "train", *arguments(boxes, out, 1)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as run:
        while not finished(out):
            assert run.poll() is None
            time.sleep(0.002)
        run.kill()
    started = finished(out)
    assert 1 <= started < BOXES  # it was killed in the middle
    assert not (out / tree_files.LISTS).exists()

    report = convert(boxes, out, processes=1, **SETTINGS)
    assert report.made + report.kept == BOXES
    assert report.kept >= started
    convert(boxes, tmp_path / "whole", processes=1, **SETTINGS)
    assert files_of(out) == files_of(tmp_path / "whole")


def test_an_interrupted_command_ends_with_one_word(boxes, tmp_path, capsys):
    def interrupt():
        while not finished(tmp_path / "out"):
            time.sleep(0.002)
        os.kill(os.getpid(), signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by a suite in the background
    try:
        threading.Thread(target=interrupt, daemon=True).start()
        assert main(arguments(boxes, tmp_path / "out", 1)) == 130
    finally:
        signal.signal(signal.SIGINT, handler)
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted"


@contextlib.contextmanager
def small_files():
    """Files of more than 20 kB cannot be written, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_full_disk_stops_the_run_with_one_line(boxes, tmp_path, capsys, processes):
    out = tmp_path / "out"
    with small_files():  # the first cloud of 24 kB cannot be written
        assert main(arguments(boxes, out, processes)) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: rendering meshes stopped: File too large")
    assert "run the same command again" in last
    assert not list(out.glob(f"{tree_files.RENDERS}/*/*"))  # nothing half-written, not even hidden
    if processes == 1:
        assert convert(boxes, out, processes=1, **SETTINGS).made == BOXES


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere all names of files are Unicode")
def test_names_of_files_that_are_not_utf8(tmp_path, capsys):
    source = os.fsencode(tmp_path / "in")
    os.mkdir(source)
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    os.rename(tmp_path / "box.ply", source + b"/St\xfchle.ply")
    with open(source + b"/Caf\xe9.ply", "w"):
        pass
    Image.fromarray(np.pad(np.full((20, 20), 60, np.uint8), 20, constant_values=250)).save(tmp_path / "a.png")
    os.rename(tmp_path / "a.png", source + b"/Caf\xe9.png")
    meshes, photos = tmp_path / "meshes", tmp_path / "photos"
    assert main(["data", "meshes", str(tmp_path / "in"), "--out", str(meshes), "--size", "32"]) == 0
    assert main(["data", "photos", str(tmp_path / "in"), "--out", str(photos)]) == 0
    said = capsys.readouterr().out
    assert "made 1 shapes" in said
    assert "in/Caf\\udce9.png: plain background" in said
    assert b"Caf\xe9.ply" in (meshes / "left_out.csv").read_bytes()
    assert b"Caf\xe9.png" in (photos / "photos.json").read_bytes()


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
    """Within 3 GB and two minutes, beside a small mesh that is made all the same."""
    assert save_ball(tmp_path / "in" / "ball.ply", 1230) > 3_000_000
    trimesh.creation.box().export(tmp_path / "in" / "box.ply")
    command = [sys.executable, "-m", "train", *arguments(tmp_path / "in", tmp_path / "out", 1)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime - before.ru_utime < 120
    assert after.ru_maxrss < 3e6  # kB
    assert sorted(shape.id for shape in all_shapes(tmp_path / "out")) == ["unknown/ball", "unknown/box"]
