"""Prepared shapes: the same tensors as a fresh reading, made again when they do not fit, wherever they can be kept."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch

from diffpoint.io import read_points, write_points
from train.__main__ import main
from train.data import Shape, ShapeTree, tree_files
from train.data.batches import LoadedSplit, Sampler, load_split
from train.data.cache import prepare
from train.data.packed import PackedShape, PackedViews
from train.data.shrink import Sizes, shrink
from train.data.tree import _found_frame, read_shape
from train.errors import UserError

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


def _prepare(root: Path) -> dict[str, PackedShape]:
    found = prepare(root, ShapeTree(root, "train").ids, SIZES, progress=False)
    shapes = {name: shape for name, shape in found.items() if isinstance(shape, PackedShape)}
    assert len(shapes) == len(found)
    return shapes


def _tensors(shape: Shape | PackedShape) -> tuple[torch.Tensor, ...]:
    return shape.images[:], shape.depth[:], shape.camera.K, shape.camera.cam_from_world, shape.points


def _same(some: Shape | PackedShape, other: Shape | PackedShape) -> bool:
    return all(
        a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(_tensors(some), _tensors(other), strict=True)
    )


def _assert_fresh(shapes: dict[str, PackedShape], root: Path) -> None:
    """They are what the tree's files give when they are read again."""
    assert list(shapes) == ShapeTree(root, "train").ids
    for name, shape in shapes.items():
        fresh = shrink(read_shape(root, name), SIZES)
        assert _same(shape, fresh)
        assert (shape.id, shape.category) == (name, fresh.category)


def _files(place: Path) -> dict[str, int]:
    """Prepared files and when they got their name."""
    return {path.stem: path.stat().st_ctime_ns for path in sorted(place.rglob("*.safetensors"))}


VIEWS = {
    "images": torch.randint(0, 256, (5, 3, 6, 8), dtype=torch.uint8),
    "images, channels last": torch.randint(0, 9, (5, 6, 8, 3), dtype=torch.uint8).movedim(-1, 1),
    "depth": torch.where(torch.rand(5, 7, 7) < 0.5, torch.inf, torch.rand(5, 7, 7)),
    "no depth": torch.tensor([torch.nan, -torch.nan, -0.0, 1e-42]).expand(5, 3, 4),
    "float64": torch.rand(5, 2, dtype=torch.float64),
    "scalars": torch.arange(5),
}
SOME = torch.tensor([3, 0, 0, -1])
INDICES = (2, -1, slice(None), slice(1, 4, 2), slice(0), SOME, SOME[:0], SOME.view(2, 2), torch.arange(5) > 2)


@pytest.mark.parametrize("kind", VIEWS)
def test_packed_views_are_indexed_as_the_tensor_is(kind: str) -> None:
    views = VIEWS[kind]
    packed = PackedViews.pack(views, "here")
    assert packed.shape == views.shape
    assert len(packed) == len(list(packed)) == 5
    for index in INDICES:
        unpacked, expected = packed[index], views[index]
        assert (unpacked.dtype, unpacked.shape) == (expected.dtype, expected.shape)
        assert unpacked.numpy().tobytes() == expected.numpy().tobytes()  # NaN and the sign of 0 too
    with pytest.raises(IndexError):
        packed[5]


def test_prepared_shapes_are_made_once_and_mapped(tree: Path) -> None:
    first = _prepare(tree)
    _assert_fresh(first, tree)
    made = _files(tree)
    assert set(made) == {name.split("/")[1] for name in first}
    for picture in (tree / tree_files.RENDERS).rglob("*.png"):  # unreadable, but it does not look changed
        status = picture.stat()
        picture.write_bytes(b"x" * status.st_size)
        os.utime(picture, ns=(status.st_atime_ns, status.st_mtime_ns))
    again = _prepare(tree)
    assert all(_same(again[name], first[name]) for name in first)
    assert _files(tree) == made
    mapped = Path("/proc/self/maps")
    if mapped.exists():
        assert len(
            {line.split()[-1] for line in mapped.read_text().splitlines() if str(tree) in line}
        ) >= len(first)


def test_what_was_made_is_said_to_cost(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train, val = (ShapeTree(tree, split).ids for split in ("train", "val"))
    for made, total in ((train, len(train)), (val, len(train) + len(val))):
        prepare(tree, made, SIZES, progress=False)
        (place,) = (tree / ".prepared").iterdir()
        size = sum(path.stat().st_size for path in place.rglob("*.safetensors"))
        assert capsys.readouterr().err == f"{place}: {total} prepared shapes, {size / 1e6:.1f} MB\n"
    (tree_files.render_folder(tree, train[0]) / "render_0.png").write_text("no picture")
    prepare(tree, train, SIZES, progress=False)
    prepare(tree, val, SIZES, progress=False)
    assert "MB" not in capsys.readouterr().err  # nothing was made


def test_what_an_earlier_version_has_prepared_is_deleted(
    tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    decimated, pooled = (tree / ".prepared" / f"48x64-maps16-{pool}" for pool in ("decimate", "min"))
    for place, version in ((decimated, 1), (decimated, 2), (decimated, 4), (pooled, 2)):
        file = place.with_name(f"{place.name}-v{version}") / "03001627" / "a.safetensors"
        file.parent.mkdir(parents=True)
        file.write_bytes(bytes(100_000))
        (file.parents[1] / ".lock").touch()
    other = tree / ".prepared" / "48x64-maps16-decimate-v1" / "notes.txt"
    other.write_text("mine")
    _assert_fresh(_prepare(tree), tree)
    said = capsys.readouterr().err
    for version in (1, 2):
        assert f"{decimated}-v{version}: 1 prepared shape, 0.1 MB of an earlier version deleted\n" in said
    left = {path.name for path in (tree / ".prepared").iterdir()}
    assert left == {f"{decimated.name}-v{version}" for version in (1, 3, 4)} | {f"{pooled.name}-v2"}
    assert list(other.parent.iterdir()) == [other]


def test_other_sizes_have_files_of_their_own(tree: Path) -> None:
    ids = ShapeTree(tree, "train").ids[:1]
    for sizes in (SIZES, Sizes((48, 64), 16, "min"), Sizes((24, 32), 16), Sizes((48, 64), 32)):
        (shape,) = prepare(str(tree), ids, sizes, progress=False).values()
        assert isinstance(shape, PackedShape)
        assert shape.images.shape[-2:] == sizes.image_size
        assert shape.depth.shape[-1] == shape.camera.height == sizes.map_size
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
    _assert_fresh(after, tree)
    assert not _same(after[victim], before[victim])
    assert capsys.readouterr().err.count("1 prepared shape is outdated; made again") == 1
    again = _files(tree)
    assert [name for name in made if again[name] != made[name]] == [victim.split("/")[1]]


def _flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1000] ^= 4
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "one bit": _flip_a_bit,
    "zeros at the end": lambda path: path.write_bytes(path.read_bytes()[:-4096] + bytes(4096)),
    "text": lambda path: path.write_text("these are not the bytes you are looking for"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_made_again(tree: Path, damage: str, capsys: pytest.CaptureFixture[str]) -> None:
    _prepare(tree)
    DAMAGES[damage](min((tree / ".prepared").rglob("*.safetensors")))
    _assert_fresh(_prepare(tree), tree)
    assert capsys.readouterr().err.count("1 prepared shape is damaged; made again") == 1
    _assert_fresh(_prepare(tree), tree)
    assert capsys.readouterr().err == ""


def test_damage_by_the_disk_is_found_by_data_check(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A start compares sizes and times only; the checksum is for the check, which reads everything."""
    _prepare(tree)
    victim = min((tree / ".prepared").rglob("*.safetensors"))
    written = victim.stat().st_mtime_ns
    _flip_a_bit(victim)
    os.utime(victim, ns=(written, written))
    assert main(["data", "check", str(tree)]) == 1
    said = capsys.readouterr().out
    assert "1 problem:" in said
    assert f"{victim}: prepared for training, and damaged; delete it" in said
    victim.unlink()
    _assert_fresh(_prepare(tree), tree)
    assert main(["data", "check", str(tree)]) == 0


@pytest.mark.parametrize("tensor", ["images", "depth", "ends"])
def test_damage_by_the_disk_is_found_when_a_batch_draws_the_view(tree: Path, tensor: str) -> None:
    def draw() -> torch.Tensor:
        split = load_split(tree, "train", image_size=(48, 64), map_size=16, progress=False)
        batch = split.batch(torch.tensor([0]), torch.arange(split.views)[None])
        return torch.cat([batch.images.flatten(), batch.depth.flatten()])

    whole = draw()
    (place,) = (tree / ".prepared").iterdir()
    victim = place / f"{ShapeTree(tree, 'train').ids[0]}.safetensors"
    written, content = victim.stat().st_mtime_ns, bytearray(victim.read_bytes())
    start = 8 + int.from_bytes(content[:8], "little")
    first, end = json.loads(content[8:start])[tensor]["data_offsets"]
    content[start + (first + end) // 2] ^= 4
    victim.write_bytes(content)
    os.utime(victim, ns=(written, written))
    with pytest.raises(UserError, match=rf"^{victim}: view \d cannot be decompressed .* Delete it and run"):
        draw()
    victim.unlink()
    assert torch.equal(draw(), whole)


def test_a_tree_that_cannot_be_written_to_is_prepared_elsewhere(
    tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tree / ".prepared").write_text("in the way, even of an administrator")
    made = {}
    for message in ("cannot be written to; its prepared shapes are kept in", ""):
        _assert_fresh(_prepare(tree), tree)
        error = capsys.readouterr().err
        assert message in error if message else error == ""
        made[message] = _files(tmp_path / "cache")
    assert len(made[""]) == len(ShapeTree(tree, "train"))
    assert len({str(files) for files in made.values()}) == 1


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
    _assert_fresh(_prepare(tree), tree)
    assert capsys.readouterr().err == ""


def test_a_turned_tree_is_read_again(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A tree from elsewhere, whose clouds turn out to have another axis convention than before."""
    (tree / "made_with.json").unlink()
    before = _prepare(tree)
    for file in (tree / tree_files.CLOUDS).rglob("*.ply"):
        status = file.stat()
        points = read_points(file)
        write_points(file, points[:, [0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0]))  # z up
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    _found_frame.cache_clear()
    after = _prepare(tree)
    _assert_fresh(after, tree)
    assert all(torch.allclose(after[name].points, before[name].points, atol=1e-6) for name in before)
    assert f"{len(before)} prepared shapes are outdated" in capsys.readouterr().err


def test_without_any_place_shapes_are_read_into_memory(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DIFFPOINT_PREPARED", "/proc/nowhere")
    _assert_fresh(_prepare(tree), tree)
    assert "no folder for prepared shapes can be written to" in capsys.readouterr().err
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


def test_a_killed_preparation_is_finished_by_the_next(tree: Path) -> None:
    _prepare(tree)
    place = next((tree / ".prepared").iterdir())
    lost, *kept = sorted(place.rglob("*.safetensors"))
    lost.unlink()
    leftover = lost.with_name(".a.safetensors.0123.tmp")
    leftover.write_bytes(b"what it was writing")
    made = _files(tree)
    _assert_fresh(_prepare(tree), tree)
    finished = _files(tree)
    assert finished.items() >= made.items()
    assert len(finished) == len(kept) + 1
    assert not leftover.exists()


_PREPARE = """
import sys
from train.data import ShapeTree
from train.data.cache import prepare
from train.data.shrink import Sizes
prepare(sys.argv[1], ShapeTree(sys.argv[1], "train").ids, Sizes((48, 64), 16))
assert not any(name.split(".")[0] == "taichi" for name in sys.modules), "the kernels were started"
"""


def test_processes_that_start_together_make_each_file_once(tree: Path) -> None:
    place = tree / ".prepared" / "48x64-maps16-decimate-v3"
    place.mkdir(parents=True)
    with (place / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # as the process that makes them
        other = subprocess.Popen(
            [sys.executable, "-c", _PREPARE, str(tree)], cwd=REPOSITORY, stderr=subprocess.PIPE, text=True
        )
        assert other.stderr is not None
        waits = next(line for line in other.stderr if "opening" not in line)
        assert f"another process prepares the shapes in {place}; waiting for it" in waits
        shutil.copytree(tree, tree.parent / "twin", ignore=shutil.ignore_patterns(".prepared"))
        _prepare(tree.parent / "twin")
        for path in (tree.parent / "twin" / ".prepared" / place.name).iterdir():
            if path.is_dir():
                shutil.copytree(path, place / path.name)
        made = _files(tree)
        assert other.poll() is None
    _, complaint = other.communicate(timeout=60)
    assert other.returncode == 0, complaint
    assert _files(tree) == made


def test_a_full_disk_costs_only_the_files(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))  # bytes of a file
    try:
        shapes = _prepare(tree)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    _assert_fresh(shapes, tree)
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

    fresh = [_tensors(shrink(read_shape(tree, name), SIZES))[:4] for name in ShapeTree(tree, "train").ids]
    sampler, expected = Sampler(len(fresh), first.views, seed=3), []
    for _ in range(6):
        shapes, views = sampler.draw(4, 2)
        rows = [
            [values[view] for values in fresh[shape]]
            for shape, view in zip(shapes.tolist(), views, strict=True)
        ]
        images, *others = (torch.stack(values) for values in zip(*rows, strict=True))
        expected += [images.float() / 255, *others]
    assert all(torch.equal(a, b) for a, b in zip(whole, expected, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(continued, expected, strict=True))
    assert len({images.sum().item() for images in whole[::4]}) > 1
