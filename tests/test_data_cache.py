"""Prepared shapes: the same tensors as a fresh reading, made again when they do not fit, wherever they can be kept."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from torch import Tensor

from diffpoint.io import read_points, write_points
from train.data import ShapeTree, tree_files
from train.data.batches import LoadedSplit, Sampler, load_split
from train.data.cache import prepare
from train.data.shape import Shape
from train.data.shrink import Sizes, shrink
from train.data.tree import _found_frame, read_shape

SIZES = Sizes((48, 64), 16)
REPOSITORY = Path(__file__).parents[1]


@pytest.fixture
def tree(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the tiny tree without prepared shapes, and a cache folder of its own."""
    root = tmp_path / "tree"
    shutil.copytree(tiny_data, root, ignore=shutil.ignore_patterns(".prepared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("DIFFPOINT_PREPARED", raising=False)
    return root


def _prepare(root: Path) -> dict[str, Shape]:
    shapes = prepare(root, ShapeTree(root, "train").ids, SIZES, progress=False)
    assert all(isinstance(shape, Shape) for shape in shapes.values())
    return {name: shape for name, shape in shapes.items() if isinstance(shape, Shape)}


def _fresh(root: Path) -> dict[str, Shape]:
    return {name: shrink(read_shape(root, name), SIZES) for name in ShapeTree(root, "train").ids}


def _same(some: dict[str, Shape], others: dict[str, Shape]) -> bool:
    return list(some) == list(others) and all(
        (a.dtype == b.dtype and torch.equal(a, b))
        if isinstance(a, Tensor) and isinstance(b, Tensor)
        else a == b
        for name in some
        for a, b in zip(some[name], others[name], strict=True)
    )


def _files(place: Path) -> dict[str, int]:
    """Prepared files and when they were made."""
    return {path.stem: path.stat().st_mtime_ns for path in sorted(place.rglob("*.safetensors"))}


def test_prepared_shapes_are_those_of_a_fresh_reading(tree: Path) -> None:
    first, fresh = _prepare(tree), _fresh(tree)
    made = _files(tree)
    assert set(made) == {name.split("/")[1] for name in fresh}
    assert _same(first, fresh)
    assert _same(_prepare(tree), fresh)
    assert _files(tree) == made


def test_no_picture_is_decoded_twice(tree: Path) -> None:
    """Pictures that cannot be decoded any more are not missed, as long as nothing says that they have changed."""
    before = _prepare(tree)
    for picture in (tree / tree_files.RENDERS).rglob("*.png"):
        status = picture.stat()
        picture.write_bytes(b"x" * status.st_size)
        os.utime(picture, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert _same(_prepare(tree), before)


def test_tensors_are_mapped_from_the_files(tree: Path) -> None:
    shapes = _prepare(tree)
    mapped = Path("/proc/self/maps")
    if not mapped.exists():
        pytest.skip("only Linux shows what is mapped")
    lines = [line for line in mapped.read_text().splitlines() if str(tree) in line]
    assert len(lines) >= len(shapes)


def test_other_sizes_have_files_of_their_own(tree: Path) -> None:
    ids = ShapeTree(tree, "train").ids[:1]
    for sizes in (SIZES, Sizes((48, 64), 16, "min"), Sizes((24, 32), 16), Sizes((48, 64), 32)):
        (shape,) = prepare(tree, ids, sizes, progress=False).values()
        assert isinstance(shape, Shape)
        assert shape.images.shape[-2:] == sizes.image_size
        assert shape.depth.shape[-1] == sizes.map_size
    assert len(list((tree / ".prepared").rglob("*.safetensors"))) == 4


def _repaint(root: Path, shape: str) -> None:
    path = tree_files.render_folder(root, shape) / "render_0.png"
    imageio.imwrite(path, 255 - imageio.imread(path))


def _lose_a_view(root: Path, shape: str) -> None:
    for kind in ("render_3.png", "depth_3.png", "camera_3.json"):
        (tree_files.render_folder(root, shape) / kind).unlink()


def _move_the_cloud(root: Path, shape: str) -> None:
    file = tree_files.cloud_file(root, shape)
    later = file.stat().st_mtime_ns + 1_000_000
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(later, later))


@pytest.mark.parametrize("change", [_repaint, _lose_a_view, _move_the_cloud])
def test_a_changed_shape_is_read_again(
    tree: Path, change: Callable[[Path, str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    before = _prepare(tree)
    made = _files(tree)
    victim = list(before)[1]
    change(tree, victim)
    after = _prepare(tree)
    assert _same(after, _fresh(tree))
    assert not _same({victim: after[victim]}, {victim: before[victim]})
    assert capsys.readouterr().err.count("1 prepared shape is outdated; made again") == 1
    again = _files(tree)
    assert [name for name in made if again[name] != made[name]] == [victim.split("/")[1]]


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1000] ^= 4
    path.write_bytes(content)


def _zero_the_end(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:-4096] + bytes(4096))


def _replace_by_text(path: Path) -> None:
    path.write_text("these are not the bytes you are looking for")


@pytest.mark.parametrize("damage", [_truncate, _empty, _flip_a_bit, _zero_the_end, _replace_by_text])
def test_a_damaged_file_is_made_again(
    tree: Path, damage: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    _prepare(tree)
    victim = min((tree / ".prepared").rglob("*.safetensors"))
    damage(victim)
    assert _same(_prepare(tree), _fresh(tree))
    assert capsys.readouterr().err.count("1 prepared shape is damaged; made again") == 1
    assert _same(_prepare(tree), _fresh(tree))
    assert capsys.readouterr().err == ""


def test_a_tree_that_cannot_be_written_to_is_prepared_elsewhere(
    tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tree / ".prepared").write_text("in the way, even of an administrator")
    assert _same(_prepare(tree), _fresh(tree))
    assert "cannot be written to; its prepared shapes are kept in" in capsys.readouterr().err
    made = _files(tmp_path / "cache")
    assert len(made) == len(ShapeTree(tree, "train"))
    assert _same(_prepare(tree), _fresh(tree))
    assert _files(tmp_path / "cache") == made
    assert capsys.readouterr().err == ""


def test_old_files_in_a_tree_that_cannot_be_written_to_are_passed_over(
    tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _prepare(tree)
    _repaint(tree, ShapeTree(tree, "train").ids[0])
    files = next((tree / ".prepared").iterdir())
    shutil.move(files, tmp_path / "aside")
    files.write_text("in the way, so that the user's own folder is taken")
    _prepare(tree)
    files.unlink()
    shutil.move(tmp_path / "aside", files)
    capsys.readouterr()
    assert _same(_prepare(tree), _fresh(tree))
    assert capsys.readouterr().err == ""


def test_a_turned_tree_is_read_again(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tree from elsewhere, whose clouds turn out to be in another frame than was thought."""
    (tree / "made_with.json").unlink()
    before = _prepare(tree)
    for file in (tree / tree_files.CLOUDS).rglob("*.ply"):
        status = file.stat()
        points = read_points(file)
        write_points(file, points[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0]))  # z up
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    _found_frame.cache_clear()
    after = _prepare(tree)
    assert _same(after, _fresh(tree))
    assert all(torch.allclose(after[name].points, before[name].points, atol=1e-6) for name in before)
    assert f"{len(before)} prepared shapes are outdated" in capsys.readouterr().err


def test_without_any_place_shapes_are_read_into_memory(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DIFFPOINT_PREPARED", "/proc/nowhere")
    assert _same(_prepare(tree), _fresh(tree))
    assert "no place to keep prepared shapes" in capsys.readouterr().err
    assert not _files(tree)


def test_the_environment_names_a_place_for_all_trees(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "deeper" / "tree"
    shutil.copytree(tree, other)
    monkeypatch.setenv("DIFFPOINT_PREPARED", str(tmp_path / "place"))
    _prepare(tree)
    _prepare(other)
    assert len(list((tmp_path / "place").rglob("*.safetensors"))) == 2 * len(ShapeTree(tree, "train"))
    assert not (tree / ".prepared").exists()


_PREPARE = """
import sys
from pathlib import Path
from train.data import ShapeTree
from train.data.cache import prepare
from train.data.shape import Shape
from train.data.shrink import Sizes
root = Path(sys.argv[1])
shapes = prepare(root, ShapeTree(root, "train").ids, Sizes((48, 64), 16))
assert all(isinstance(shape, Shape) for shape in shapes.values()), shapes
assert not any(name.split(".")[0] == "taichi" for name in sys.modules), "the kernels were started"
print(sum(int(shape.images.sum()) for shape in shapes.values()))
"""


def _begin_elsewhere(tree: Path) -> subprocess.Popen[str]:
    """A process that has begun to prepare a tree, of now many shapes, and has a while to go."""
    for synset in (tree / tree_files.LISTS / "train").glob("*.list"):
        lines = synset.read_text().split()
        for copy in (f"{line}_copy{k}" for line in lines[:4] for k in range(12)):
            lines.append(copy)
            original = copy.split("_copy")[0]
            (tree / tree_files.RENDERS / copy).symlink_to(tree / tree_files.RENDERS / original)
            (tree / tree_files.CLOUDS / f"{copy}.ply").symlink_to(
                tree / tree_files.CLOUDS / f"{original}.ply"
            )
        synset.write_text("\n".join(lines))
    process = subprocess.Popen(
        [sys.executable, "-c", _PREPARE, str(tree)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while len(_files(tree)) < 5:
        assert process.poll() is None
        time.sleep(0.01)
    return process


def test_a_killed_preparation_goes_on_where_it_was(tree: Path) -> None:
    process = _begin_elsewhere(tree)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    made = _files(tree)
    leftover = next((tree / ".prepared").rglob("*.safetensors")).with_name(".a.safetensors.0123.tmp")
    leftover.write_bytes(b"what it was writing")
    shapes = _prepare(tree)
    assert 5 <= len(made) < len(shapes)
    finished = _files(tree)
    assert len(finished) == len(shapes)
    assert finished.items() >= made.items()
    assert not leftover.exists()
    fresh = _fresh(tree)
    assert _same(shapes, fresh)


def test_processes_that_start_together_make_each_file_once(
    tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    process = _begin_elsewhere(tree)
    shapes = _prepare(tree)
    out, complaint = process.communicate()
    assert process.returncode == 0, complaint
    assert "another process prepares the shapes" in capsys.readouterr().err
    assert int(out) == sum(int(shape.images.sum()) for shape in shapes.values())
    finished = max(_files(tree).values())
    assert finished <= time.time_ns()
    assert _same(_prepare(tree), shapes)
    assert max(_files(tree).values()) == finished


def test_a_full_disk_costs_only_the_files(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))  # bytes of a file
    try:
        shapes = _prepare(tree)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert _same(shapes, _fresh(tree))
    assert "prepared shapes cannot be kept in" in capsys.readouterr().err
    assert not _files(tree)


def _batches(split: LoadedSplit, sampler: Sampler, count: int) -> list[torch.Tensor]:
    found = []
    for _ in range(count):
        batch = split.batch(*sampler.draw(4, 2))
        found += [batch.images, batch.depth, batch.camera.K, batch.camera.cam_from_world]
    return found


def test_the_same_seed_gives_the_same_batches_from_fresh_and_from_prepared_shapes(tree: Path) -> None:
    """Whole, stopped in the middle and continued from the sampler's state, and picked from a fresh reading by hand."""

    def load() -> LoadedSplit:
        return load_split(tree, "train", image_size=(48, 64), map_size=16, progress=False)

    first = load()
    whole = _batches(first, Sampler(len(first), first.views, seed=3), 6)

    stopped = Sampler(len(first), first.views, seed=3)
    begun = _batches(first, stopped, 2)
    resumed = Sampler(len(first), first.views, seed=9)
    resumed.restore(stopped.state())
    again = load()
    continued = begun + _batches(again, resumed, 4)
    assert again.fingerprint == first.fingerprint

    fresh = list(_fresh(tree).values())
    sampler, expected = Sampler(len(fresh), first.views, seed=3), []
    for _ in range(6):
        shapes, views = sampler.draw(4, 2)
        rows = [(fresh[shape], view) for shape, view in zip(shapes.tolist(), views, strict=True)]
        expected += [
            torch.stack([shape.images[view] for shape, view in rows]).float() / 255,
            torch.stack([shape.depth[view] for shape, view in rows]),
            torch.stack([shape.K[view] for shape, view in rows]),
            torch.stack([shape.cam_from_world[view] for shape, view in rows]),
        ]
    assert all(torch.equal(a, b) for a, b in zip(whole, expected, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(continued, expected, strict=True))
    assert len({tuple(np.unique(images.numpy())[:50]) for images in whole[::4]}) > 1
