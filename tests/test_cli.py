"""The command line: every user's mistake is one line and exit code 2, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from train.__main__ import main
from train.config import fit_config_from_json
from train.data.images import is_cut_out, read_images
from train.data.procedural import generate
from train.errors import UserError
from train.evaluation.runs import best_weights, load_autoencoder, load_generator, open_run, read_metrics
from train.methods import METHODS


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
        (
            "fit --data {data} --out {tmp}/out --profile smoke --framing 2",
            "--framing is a share of the images",
        ),
        (
            "fit --data {data} --out {tmp}/out --profile smoke --augmentation=-1",
            "--augmentation must be at least 0",
        ),
        ("fit --data {data} --out {tmp}/out --profile cpu", "not a multiple of the map size 28"),
        ("fit --data {data} --out {tmp}/out --profile smoke --categories zebra", "zebra"),
        ("fit --data {data} --out {tmp}/out --profile smoke --stage1.views 9", "configuration asks for 9"),
        (
            "fit --data {data} --out {tmp}/out --system pix2mesh",
            f"one of {', '.join(METHODS)}; got 'pix2mesh'",
        ),
        ("fit --data {data} --out {tmp}/out --system=ptn --stage1.gamma 1", "ptn does not support a critic"),
        ("fit --data {data} --out {run} --profile smoke", "already holds a run"),
        ("fit --data {data} --out {run} --resume --seed 1 --map-size 8", "other values of map_size, seed"),
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
        ("reconstruct {run} {tmp}/picture.png --out {tmp}/noise.png/a", "noise.png is a file, not a"),
        ("evaluate {run} --data {data} --out {tmp}/noise.png/a.json", "noise.png is a file, not a"),
        ("evaluate {run} --data {data} --out {tmp}/empty", "empty is a directory where a file"),
        ("export {run} --out {tmp}/noise.png/a.safetensors", "noise.png is a file, not a"),
        (
            "experiment agreement --run {run} --data {data} --out {tmp}/noise.png",
            "noise.png is a file, not a",
        ),
        ("reconstruct {run} {tmp}/picture.png --out {tmp}/out --groups 0", "--groups must be at least 1"),
        ("evaluate {run} --data {data} --views 0,2 --out {tmp}/out", "none below 1; got [0, 2]"),
        ("evaluate {run} --data {data} --seeds --out {tmp}/out", "--seeds needs at least one number"),
        ("evaluate {run} --data {data} --limit 0 --out {tmp}/out", "--limit must be at least 1"),
        ("experiment agreement --run {tmp}/empty --data {data} --out {tmp}/out", "is not a run"),
        ("experiment agreement --run {run} --data {data} --out {tmp}/out --views 9", "between 2 and the 4"),
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
    where = ["fit", "--data", str(tiny_data), "--out", str(run := tmp_path / "run")]
    assert main([*where, "--profile", "smoke", "--steps", "2", "--stage1.codes", "3", "--seed", "7"]) == 0
    config = fit_config_from_json((run / "config.json").read_text(), where="config.json")
    assert (config.seed, config.stage1.codes, config.stage1.steps, config.stage2.steps) == (7, 3, 2, 2)
    assert main([*where, "--resume"]) == 0  # with the run's own settings
    capsys.readouterr()
    for views in (["1", "2"], ["1,2"]):
        assert main(["evaluate", str(run), "--data", str(tiny_data), "--seeds", "0", "--views", *views]) == 0
        assert "medoid of train" in capsys.readouterr().out
        assert list(json.loads((run / "evaluation.json").read_text())["views"]) == ["1", "2"]
        (run / "evaluation.json").unlink()


def test_variant_latent_head_and_a_trained_auto_encoder_by_their_old_names(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    """Options of earlier versions: --ending, --health-every and --health-patience."""
    run = tmp_path / "run"
    command = ["fit", "--data", str(tiny_data), "--out", str(run), "--profile", "smoke", "--steps", "3"]
    command += ["--variant", "highly-diverse", "--autoencoder", str(smoke_run)]
    assert main([*command, "--ending", "latent", "--health-every", "2", "--health-patience=9"]) == 0
    config = fit_config_from_json((run / "config.json").read_text(), where="config.json")
    stage2 = config.stage2
    assert (config.variant, stage2.joined_diversity, stage2.steps) == ("highly-diverse", True, 3)
    assert (config.output_head, config.collapse_check_every, config.collapse_patience) == ("latent", 2, 9)
    records = read_metrics(run)
    assert [record["stage"] for record in records] == [1, 1, 1, 2, 2, 2]
    assert ["image_sensitivity" in record for record in records] == [False, True, True] * 2
    decoder, given = (
        load_generator(run).shape_decoder,
        load_autoencoder(best_weights(smoke_run, "autoencoder")),
    )
    assert decoder is not None
    expected = given.decode.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in decoder.state_dict().items())


def test_reconstruct_writes_a_cloud_and_a_page(smoke_run: Path, picture: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    assert (
        main(["reconstruct", str(smoke_run), str(picture), str(picture), "--out", str(out), "--steps", "1"])
        == 0
    )
    names = ["explore.html", "reconstruction.html", "reconstruction.ply"]
    assert sorted(path.name for path in out.iterdir()) == names
    cloud = trimesh.load(out / "reconstruction.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert cloud.vertices.shape == (256, 3)
    assert np.abs(cloud.vertices).max() < 2


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the weights that come with the repository are looked for; nothing is there yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("train.evaluation.runs._SHIPPED", tmp_path / "shipped")
    return tmp_path / "shipped" / "generator.safetensors"


def test_the_weights_that_come_with_the_repository_know_shapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    generate(Path("data"), shapes=10, categories=["chair", "car"], seed=7, size=56, views=4, processes=1)
    command = ["evaluate", "pretrained", "--data", "data", "--views", "1", "4", "--seeds", "0"]
    assert main([*command, "--out", "scores.json"]) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["profile"] == "cpu"
    assert scores["views"]["4"]["cd"] < min(scores["views"]["1"]["cd"], scores["medoid"]["cd"])


def test_the_word_pretrained_says_what_is_missing(
    shipped: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", "pretrained", str(picture), "--out", str(tmp_path / "out")]) == 2
    complaint = capsys.readouterr().err
    assert str(shipped) in complaint
    assert "python -m train fit" in complaint
    assert complaint.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_word_pretrained_names_the_shipped_weights(
    shipped: Path, smoke_run: Path, tiny_data: Path, picture: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shipped.parent.mkdir()
    shutil.copy(smoke_run / "checkpoints" / "best-stage2.safetensors", shipped)
    command = ["reconstruct", "pretrained", str(picture), str(picture), "--steps", "1"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "reconstruction.ply").exists()
    evaluate = ["evaluate", "pretrained", "--data", str(tiny_data), "--views", "1", "--seeds", "0"]
    assert main(evaluate) == 2
    assert "say where to write with --out" in capsys.readouterr().err
    assert main([*evaluate, "--out", str(tmp_path / "scores.json")]) == 0
    assert json.loads((tmp_path / "scores.json").read_text())["profile"] == "smoke"
    assert [path.name for path in shipped.parent.iterdir()] == [shipped.name]


def test_a_directory_of_that_name_goes_first(shipped: Path, picture: Path, tmp_path: Path) -> None:
    (tmp_path / "pretrained").mkdir()
    with pytest.raises(UserError, match="pretrained is not a run"):
        open_run(Path("pretrained"))


def test_help_of_everything_but_fit_does_not_load_torch() -> None:
    commands = ["", "data", "data procedural", "export", "reconstruct", "evaluate", "experiment", "demo"]
    code = f"""
import os, sys
os.environ.pop("OMP_WAIT_POLICY", None)
from train.__main__ import main
for command in {commands}:
    try:
        main([*command.split(), "--help"])
    except SystemExit as end:
        assert end.code == 0
assert "torch" not in sys.modules
assert os.environ["OMP_WAIT_POLICY"] == "passive"  # before torch starts its threads
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: python -m train") == len(commands)


def test_fit_shows_its_methods_and_the_defaults_of_profile_and_method(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for options, steps in (["--profile", "full"], "40000"), (["--system=lin"], "8000"):
        with pytest.raises(SystemExit):
            main(["fit", *options, "--help"])
        shown = capsys.readouterr().out
        assert f"(default: {steps})" in shown
        assert all(f"{name}: {method.summary[:20]}" in shown for name, method in METHODS.items())


@pytest.mark.parametrize(
    ("options", "name", "weight"),
    [
        ([], "whole-shapes", 2.0),
        (["--recipe", "paper"], "paper", 0.0),
        (["--variant", "highly-diverse"], "paper", 0.0),
        (["--system", "psgn"], "paper", 0.0),
    ],
)
def test_fit_learns_from_whole_shapes_unless_the_paper_is_asked_for(
    options: list[str], name: str, weight: float, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["fit", *options, "--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert re.search(rf"--recipe \{{whole-shapes,paper\}} .{{0,300}}\(default: {name}\)", shown)
    assert re.search(rf"--stage1.shape-weight FLOAT .{{0,300}}\(default: {weight}\)", shown)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "I;16", "I", "F"])
def test_pictures_of_every_kind_become_rgb_on_white(mode: str, tmp_path: Path) -> None:
    pixels = np.full((30, 50, 4), 255, np.uint8)
    pixels[..., 3] = 0
    pixels[10:20, 20:30] = (0, 0, 0, 255)
    image = Image.fromarray(pixels, "RGBA")
    if mode in ("I;16", "I", "F"):
        white, kind = {"I;16": (65535, np.uint16), "I": (65535, np.int32), "F": (1, np.float32)}[mode]
        image = Image.fromarray(np.where(pixels[..., 3] == 255, 0, white).astype(kind))
    elif mode == "PA":  # a palette whose transparent entry shows through: what GIFs and many icons are
        image = image.quantize(colors=4)
    elif mode in ("RGB", "L", "P", "1", "CMYK"):
        white = Image.new("RGBA", image.size, "white")
        white.alpha_composite(image)
        image = white.convert(mode)
    else:
        image = image.convert(mode)
    path = tmp_path / ("picture.tif" if mode in ("CMYK", "I", "F") else "picture.png")
    image.save(path)
    with Image.open(path) as saved:
        assert saved.mode == {"PA": "P"}.get(mode, mode)
    result = read_images([path], size=50)
    assert result.shape == (1, 3, 50, 50)
    assert result[0, :, 20:30, 20:30].max() < 0.02  # the black square, centred after padding 10 rows above
    assert result[0, :, :20].min() > 0.98
    assert result[0, :, 30:].min() > 0.98


def test_a_picture_too_small_or_cut_short_is_refused_by_name(picture: Path, tmp_path: Path) -> None:
    Image.new("RGB", (200, 15), "red").save(tmp_path / "strip.png")
    with pytest.raises(UserError, match=r"strip\.png is 200 x 15 pixels; at least 16 x 16"):
        read_images([picture, tmp_path / "strip.png"])
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    for name in ("half.png", "half.jpg"):
        Image.fromarray(noise).save(tmp_path / name)
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(UserError, match=rf"{name} is not an image that can be read \(.+\)$"):
            read_images([tmp_path / name])
    Image.new("RGBA", (40, 40), (200, 0, 0, 0)).save(tmp_path / "clear.png")
    with pytest.raises(UserError, match=r"clear\.png shows nothing"):
        read_images([picture, tmp_path / "clear.png"])
    (tmp_path / "empty.png").touch()
    with pytest.raises(UserError, match=r"empty\.png is not an image"):
        read_images([tmp_path / "empty.png"])
    Image.fromarray(np.full((20, 20), np.nan, np.float32)).save(tmp_path / "nan.tif")
    with pytest.raises(UserError, match=r"nan\.tif .*not finite"):
        read_images([tmp_path / "nan.tif"])


def test_a_background_that_was_not_removed_is_pointed_out(
    smoke_run: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (60, 40), (120, 140, 90)).save(tmp_path / "lawn.png")
    pictures = [str(picture), str(tmp_path / "lawn.png")]
    assert (
        main(["reconstruct", str(smoke_run), *pictures, "--out", str(tmp_path / "out"), "--steps", "0"]) == 0
    )
    note = capsys.readouterr().err
    assert "lawn.png" in note
    assert "picture.png" not in note
    # The object may touch one side of its frame.
    standing = np.ones((32, 32, 4), np.float32)
    standing[10:, 4:28, :3] = 0.2
    assert is_cut_out(standing)


def test_photographs_are_turned_as_the_camera_was_held(tmp_path: Path) -> None:
    pixels = np.full((40, 20, 3), 255, np.uint8)
    pixels[:10] = 0
    exif = Image.Exif()
    exif[0x0112] = 6  # turn a quarter clockwise to see it upright
    Image.fromarray(pixels).save(tmp_path / "photo.jpg", exif=exif, quality=95)
    result = read_images([tmp_path / "photo.jpg"], size=40)[0, 0]
    assert result[12:28, 32:].max() < 0.1  # the dark end, which was on top, is on the right
    assert result[12:28, :28].min() > 0.9


@pytest.mark.skipif(os.name != "posix", reason="pipes of a POSIX shell")
@pytest.mark.parametrize(
    ("output", "expected", "said"), [("pipe", 141, b""), ("/dev/full", 2, b"No space left"), (None, 0, b"")]
)
def test_output_that_cannot_be_written(output: str | None, expected: int, said: bytes) -> None:
    command = [sys.executable, "-m", "train", "--help"]
    if output is None:
        command = ["sh", "-c", '"$0" -m train --help >&-', sys.executable]
    if output == "pipe":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open(output or os.devnull, os.O_WRONLY)
    try:
        done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    finally:
        os.close(writer)
    assert done.returncode == expected
    assert said in done.stderr
    assert said or not done.stderr
