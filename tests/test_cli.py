"""The command line: every user's mistake is one line and exit code 2, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from train.__main__ import main
from train.config import fit_config_from_json
from train.images import read_images


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "picture.png"
    pixels = np.full((40, 60, 3), 255, np.uint8)
    pixels[10:30, 20:40] = (200, 30, 30)
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("fit --data {tmp}/nowhere --out {tmp}/out --profile smoke", "nowhere"),
        ("fit --data {tmp}/empty --out {tmp}/out --profile smoke", "empty"),
        ("fit --data {data} --out {tmp}/noise.png --profile smoke", "noise.png is a file"),
        ("fit --data {data} --out {tmp}/out --profile smoke --resume", "no run to resume"),
        ("fit --data {data} --out {tmp}/out --profile smoke --steps 0", "--steps must be at least 1"),
        ("fit --data {data} --out {tmp}/out --profile cpu", "not a multiple of the map size 28"),
        ("fit --data {data} --out {tmp}/out --profile smoke --categories zebra", "zebra"),
        (
            "fit --data {data} --out {tmp}/out --profile smoke --stage1.views 9",
            "the configuration asks for 9",
        ),
        ("evaluate {tmp}/nowhere --data {data}", "nowhere"),
        ("evaluate {tmp}/empty --data {data}", "is not a run"),
        ("evaluate {run} --data {tmp}/nowhere --out {tmp}/out", "nowhere"),
        ("evaluate {run} --data {data} --views 7 --out {tmp}/out", "none of [7] can be evaluated"),
        ("reconstruct {tmp}/empty {tmp}/picture.png --out {tmp}/out", "is not a run"),
        ("reconstruct {tmp}/noise.png {tmp}/picture.png --out {tmp}/out", "holds no generator's weights"),
        ("reconstruct {run} {tmp}/nothing.png --out {tmp}/out", "nothing.png does not exist"),
        ("reconstruct {run} {tmp}/picture.png {tmp}/noise.png --out {tmp}/out", "noise.png is not an image"),
        ("reconstruct {run} {tmp}/empty --out {tmp}/out", "empty"),
        ("reconstruct {run} --out {tmp}/out", "1 to 24 images; got 0"),
        ("reconstruct {run} {tmp}/picture.png --out {tmp}/noise.png", "noise.png is a file"),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_code_2(
    command: str,
    complaint: str,
    smoke_run: Path,
    tiny_data: Path,
    picture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "noise.png").write_bytes(bytes(range(256)))
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.rglob("*"))
    run_before = sorted(smoke_run.rglob("*"))
    assert main(command.format(tmp=tmp_path, data=tiny_data, run=smoke_run).split()) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert complaint in lines[0]
    assert sorted(tmp_path.rglob("*")) == before
    assert sorted(smoke_run.rglob("*")) == run_before


def test_the_process_says_so_too(tmp_path: Path) -> None:
    """The whole way: no traceback, one line on stderr, nothing on stdout, the exit code of the process."""
    command = [sys.executable, "-m", "train", "evaluate", str(tmp_path / "nowhere"), "--data", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_fit_and_evaluate_from_the_command_line(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    fit = ["fit", "--data", str(tiny_data), "--out", str(run), "--profile", "smoke", "--steps", "2"]
    assert main([*fit, "--stage1.codes", "3", "--seed", "7"]) == 0
    config = fit_config_from_json((run / "config.json").read_text(), where="config.json")
    assert (config.seed, config.stage1.codes, config.stage1.steps, config.stage2.steps) == (7, 3, 2, 2)
    # A resumed run brings its own settings; only what contradicts them is refused.
    assert main(["fit", "--data", str(tiny_data), "--out", str(run), "--resume"]) == 0
    assert main(["fit", "--data", str(tiny_data), "--out", str(run), "--resume", "--seed", "8"]) == 2
    capsys.readouterr()
    assert main(["evaluate", str(run), "--data", str(tiny_data), "--seeds", "0", "--views", "1", "2"]) == 0
    assert "medoid of train" in capsys.readouterr().out
    assert list(json.loads((run / "evaluation.json").read_text())["views"]) == ["1", "2"]


def test_reconstruct_writes_a_cloud_and_a_page(smoke_run: Path, picture: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    assert (
        main(["reconstruct", str(smoke_run), str(picture), str(picture), "--out", str(out), "--steps", "1"])
        == 0
    )
    assert sorted(path.name for path in out.iterdir()) == ["reconstruction.html", "reconstruction.ply"]
    cloud = trimesh.load(out / "reconstruction.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert cloud.vertices.shape == (256, 3)
    assert np.abs(cloud.vertices).max() < 2


@pytest.mark.parametrize("command", ["", "data", "data procedural", "fit", "reconstruct", "evaluate", "demo"])
def test_help_is_there_without_loading_torch(command: str) -> None:
    code = "import sys; from train.__main__ import main\n"
    code += "try: main(sys.argv[1:])\nexcept SystemExit as e: code = e.code\n"
    code += "assert 'torch' not in sys.modules\nsys.exit(code)"
    done = subprocess.run(
        [sys.executable, "-c", code, *command.split(), "--help"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout


def test_fit_shows_the_profiles_own_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    for profile, steps in (("cpu", "4000"), ("full", "40000")):
        with pytest.raises(SystemExit):
            main(["fit", "--profile", profile, "--help"])
        assert f"(default: {steps})" in capsys.readouterr().out


def test_idle_threads_are_told_to_sleep_before_torch_starts() -> None:
    code = "import train.__main__, os, sys; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.split() == ["passive", "False"]


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "I;16"])
def test_pictures_of_every_kind_become_rgb_on_white(mode: str, tmp_path: Path) -> None:
    pixels = np.full((30, 50, 4), 255, np.uint8)
    pixels[..., 3] = 0
    pixels[10:20, 20:30] = (0, 0, 0, 255)
    image = Image.fromarray(pixels, "RGBA")
    if mode == "I;16":
        grey = np.where(pixels[..., 3] == 255, 0, 65535).astype(np.uint16)
        image = Image.fromarray(grey)
    elif mode in ("RGB", "L", "P"):
        white = Image.new("RGBA", image.size, "white")
        white.alpha_composite(image)
        image = white.convert(mode)
    else:
        image = image.convert(mode)
    image.save(tmp_path / "picture.png")
    result = read_images([tmp_path / "picture.png"], size=50)
    assert result.shape == (1, 3, 50, 50)
    assert result[0, :, 20:30, 20:30].max() < 0.02  # the black square, centred after padding 10 rows above
    assert result[0, :, :20].min() > 0.98
    assert result[0, :, 30:].min() > 0.98


def test_photographs_are_turned_as_the_camera_was_held(tmp_path: Path) -> None:
    pixels = np.full((40, 20, 3), 255, np.uint8)
    pixels[:10] = 0
    exif = Image.Exif()
    exif[0x0112] = 6  # turn a quarter clockwise to see it upright
    Image.fromarray(pixels).save(tmp_path / "photo.jpg", exif=exif, quality=95)
    result = read_images([tmp_path / "photo.jpg"], size=40)[0, 0]
    assert result[12:28, 32:].max() < 0.1  # the dark end, which was on top, is on the right
    assert result[12:28, :28].min() > 0.9
