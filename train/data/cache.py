"""Shapes at the sizes of training, kept on disk: pictures are decoded once, and all processes map the same files.

    TREE/.prepared/96x128-maps28-decimate-v3/<synset>/<model>.safetensors

A file holds the tensors of one shape, its images and depth maps compressed view by view (train/data/packed.py). Its
header says from which files it was made (their names, sizes and times), its own time, and a checksum. When it is
opened, its size, its time and the files that it was made from are compared; one that does not fit is made again. The
checksum, which needs every byte, is left to `python -m train data check`: tensors are mapped, and read from the disk
when a batch needs them.

A tree that cannot be written to has its files in the user's cache folder, and the environment variable
DIFFPOINT_PREPARED names a folder for all trees. The files can be deleted at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from tqdm import tqdm

from diffpoint.camera import PinholeCamera
from train.data.categories import category_of
from train.data.layouts import layout_of
from train.data.packed import PackedShape, PackedViews
from train.data.shape import ShapeError
from train.data.shrink import Sizes, shrink
from train.data.tree import frame_of, read_shape
from train.errors import UserError
from train.files import replacing
from train.processes import map_unordered, progress_bar

_VERSION = 3  # of the files, and of how shapes are shrunk
_TENSORS = ("images", "depth", "ends", "K", "cam_from_world", "points")
_PLACE = "DIFFPOINT_PREPARED"
_SHAPES_PER_PROCESS = 100  # starting one takes seconds


def prepare(
    root: str | Path, shapes: Sequence[str], sizes: Sizes, *, name: str = "shapes", progress: bool = True
) -> dict[str, PackedShape | ShapeError]:
    """The shapes of a tree, shrunk: from their prepared files, which are made where they are missing.

    A process that is killed while it makes them loses only the shapes on which it was working; of several that start
    together one makes them and the others wait.

    Args:
        root: of the data tree.
        shapes: "synset/model".
        sizes: what they are shrunk to.
        name: what the progress bars call the shapes.
        progress: show progress bars.

    Returns:
        In the order of `shapes`: shapes as `shrink` returns them, packed, with tensors that are mapped from the files,
        or why a shape cannot be read.

    Raises:
        UserError: `sizes` do not fit the renders.
    """
    root = Path(root)
    frame = frame_of(root)
    turns = (frame.turn_cloud, frame.turn_world, frame.turn_camera)
    tree = _Tree(root, sizes, " ".join(repr(np.asarray(turn, float).tolist()) for turn in turns))
    (height, width), side, pool = sizes.image_size, sizes.map_size, sizes.pool
    places = [folder / f"{height}x{width}-maps{side}-{pool}-v{_VERSION}" for folder in _folders(root)]
    found: dict[str, PackedShape | ShapeError] = {}
    unusable: Counter[str] = Counter()
    for shape in progress_bar(shapes, title=f"opening {name}", unit="shape", progress=progress, leave=False):
        result = _open(places, tree, shape)
        if isinstance(result, PackedShape):
            found[shape] = result
        elif result:
            unusable[result] += 1
    for reason, count in sorted(unusable.items()):
        what = "shape is" if count == 1 else "shapes are"
        _print(f"{root}: {count} prepared {what} {reason}; made again")
    missing = [shape for shape in shapes if shape not in found]
    place = _first_writable(places, root) if missing else None
    if place is not None:
        with _one_at_a_time(place):
            # Another process may have made them while this one waited.
            found |= {
                shape: packed
                for shape in missing
                if isinstance(packed := _open(places, tree, shape), PackedShape)
            }
            if missing := [shape for shape in missing if shape not in found]:
                _remove_earlier_versions(place)
                made = _make(place, tree, missing, name=name, progress=progress)
                found |= made
                if any(isinstance(each, PackedShape) for each in made.values()):
                    _print(f"{place}: {_in_words(list(place.glob('*/*.safetensors')))}")
    missing = [shape for shape in missing if shape not in found]  # those whose files could not be kept
    for shape in progress_bar(
        missing, title=f"reading {name}", unit="shape", progress=progress and bool(missing)
    ):
        try:
            found[shape] = tree.read(shape)
        except ShapeError as error:
            found[shape] = error
        except UserError as error:
            raise UserError(f"{root}: {error}") from None
    return {shape: found[shape] for shape in shapes}


def damaged_files(root: str | Path) -> list[Path]:
    """The prepared files of a tree, of all sizes, whose content does not fit their checksum. Reads all of them."""
    damaged = []
    for folder in _folders(Path(root)):
        for path in sorted(folder.glob(f"*-v{_VERSION}/*/*.safetensors")):
            with contextlib.suppress(SafetensorError, OSError):
                about, tensors = _load(path)
                if about.get("checksum") == _checksum(tensors):
                    continue
            damaged.append(path)
    return damaged


class _Tree(NamedTuple):
    """A data tree, and all that decides what is made of its files."""

    root: Path
    sizes: Sizes
    frame: str

    def source(self, shape: str) -> str:
        """A hash that changes when a file of the shape changes, appears or goes, or when the tree is turned anew."""
        layout = layout_of(self.root)
        cloud = layout.cloud_file(shape)
        try:
            with os.scandir(layout.folder(shape)) as entries:
                lines = sorted(_line(entry.name, entry.stat()) for entry in entries)
            lines.append(_line(cloud.name, cloud.stat()))
        except OSError as error:
            lines = [str(error)]  # reading the shape fails with a better message
        return hashlib.sha256("\n".join([self.frame, *lines]).encode()).hexdigest()[:32]

    def read(self, shape: str) -> PackedShape:
        """The shape from its pictures, shrunk and packed."""
        return PackedShape.pack(shrink(read_shape(self.root, shape), self.sizes))


def _line(name: str, stat: os.stat_result) -> str:
    return f"{name} {stat.st_size} {stat.st_mtime_ns}"


def _folders(root: Path) -> list[Path]:
    """Folders where prepared files of a tree may be, the best first."""
    whole = root.resolve()
    tree = f"{whole.name}-{hashlib.sha256(str(whole).encode()).hexdigest()[:8]}"
    if chosen := os.environ.get(_PLACE):
        return [Path(chosen) / tree]
    caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return [root / ".prepared", caches / "diffpoint" / "prepared" / tree]


def _first_writable(places: Sequence[Path], root: Path) -> Path | None:
    reason = ""
    for number, place in enumerate(places):
        try:
            place.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place):
                pass
        except OSError as error:
            reason = f"{error.strerror}: {place}"
            continue
        if number:
            _print(f"{root} cannot be written to; its prepared shapes are kept in {place}")
        return place
    _print(f"no folder for prepared shapes can be written to ({reason}): they are read anew; see {_PLACE}")
    return None


@contextlib.contextmanager
def _one_at_a_time(place: Path) -> Iterator[None]:
    """Waits for other processes that make files in `place`; where files cannot be locked, work may be done twice."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    with (place / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _print(f"another process prepares the shapes in {place}; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:
            pass
        yield


def _open(places: Sequence[Path], tree: _Tree, shape: str) -> PackedShape | str:
    """A shape from the first place that has a file that fits; else what is wrong with a file, "" if there is none."""
    source, reason = tree.source(shape), ""
    for place in places:
        path = _file(place, shape)
        try:
            about, tensors = _load(path)
            changed = about.get("time") != str(path.stat().st_mtime_ns)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (SafetensorError, OSError):
            reason = reason or "damaged"
            continue
        if about.get("source") != source or changed:
            reason = reason or ("outdated" if about.get("source") != source else "damaged")
            continue
        size, ends = tree.sizes.map_size, tensors["ends"]
        images = PackedViews(tensors["images"], ends[0], (3, *tree.sizes.image_size), torch.uint8, str(path))
        depth = PackedViews(tensors["depth"], ends[1], (size, size), torch.float32, str(path))
        camera = PinholeCamera(tensors["K"], tensors["cam_from_world"], size, size)
        category = category_of(shape.split("/")[0])
        return PackedShape(images, depth, camera, tensors["points"], shape, category)
    return reason


def _load(path: Path) -> tuple[Mapping[str, str], dict[str, Tensor]]:
    """The header of a file and its tensors: mapped, so that their pages are read when they are used.

    Raises:
        SafetensorError: no safetensors file, or its length is not what its header says.
    """
    with safe_open(path, "pt") as file:
        return file.metadata() or {}, {name: file.get_tensor(name) for name in _TENSORS}


def _file(place: Path, shape: str) -> Path:
    return place / f"{shape}.safetensors"


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    value = 0
    for name in _TENSORS:
        value = zlib.crc32(tensors[name].numpy().data, value)
    return f"{value:08x}"


class _Job(NamedTuple):
    place: Path
    tree: _Tree
    shape: str


def _make(
    place: Path, tree: _Tree, shapes: Sequence[str], *, name: str, progress: bool
) -> dict[str, PackedShape | ShapeError]:
    """Makes the files of `shapes`, as many as there is room for, and maps them."""
    for leftover in place.glob("*/.*.tmp"):  # of a process that was killed
        leftover.unlink(missing_ok=True)
    jobs = [_Job(place, tree, shape) for shape in shapes]
    made: dict[str, PackedShape | ShapeError] = {}
    results = map_unordered(
        _make_one,
        jobs,
        processes=None,
        title=f"preparing {name}",
        unit="shape",
        progress=progress,
        jobs_per_process=_SHAPES_PER_PROCESS,
    )
    with contextlib.closing(results):
        for job, result in results:
            if isinstance(result, ShapeError):
                made[job.shape] = result
            elif isinstance(result, UserError):
                raise UserError(f"{tree.root}: {result}")
            elif isinstance(result, OSError):  # its process crashed
                made[job.shape] = ShapeError(f"{job.shape}: {result}")
            elif result:
                _print(f"prepared shapes cannot be kept in {place} ({result}); see {_PLACE}")
                break
    for shape in shapes:
        if shape not in made and isinstance(opened := _open([place], tree, shape), PackedShape):
            made[shape] = opened
    return made


def _make_one(job: _Job) -> UserError | str:
    """Makes one file, perhaps in a worker process; returns why it could not be written, "" if it is there."""
    try:
        source = job.tree.source(job.shape)  # first, so that a change while it is read is noticed later
        packed = job.tree.read(job.shape)
        ends = torch.stack((packed.images.ends, packed.depth.ends))  # (2, V)
        K, cam_from_world = packed.camera.K, packed.camera.cam_from_world
        values = (packed.images.data, packed.depth.data, ends, K, cam_from_world, packed.points)
        tensors = {name: value.contiguous() for name, value in zip(_TENSORS, values, strict=True)}
        # The file gets this time, in whole seconds, which every file system and copy keeps: a later change shows.
        written = int(time.time()) * 10**9
        about = {"source": source, "time": str(written), "checksum": _checksum(tensors)}
        with replacing(_file(job.place, job.shape)) as temporary:
            with temporary.open("wb") as file:
                file.write(save(tensors, metadata=about))
                file.flush()
                os.fsync(file.fileno())  # else a crash of the machine can leave zeros under the final name
            os.utime(temporary, ns=(written, written))
    except UserError as error:
        return error
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _remove_earlier_versions(place: Path) -> None:
    """Deletes what earlier versions of this program prepared at the same sizes; other files beside it stay."""
    for version in range(1, _VERSION):
        old = place.with_name(place.name.removesuffix(str(_VERSION)) + str(version))
        files = list(old.glob("*/*.safetensors"))
        if not files:
            continue
        try:
            with _one_at_a_time(old):
                found = _in_words(files)
                for path in (*files, *old.glob("*/.*.tmp"), old / ".lock"):
                    path.unlink(missing_ok=True)
        except OSError as error:  # another user's, or on Windows in use
            _print(f"{old}: made by an earlier version and not used any more; delete it ({error.strerror})")
            continue
        with contextlib.suppress(OSError):  # there are other files
            for folder in (*{path.parent for path in files}, old):
                folder.rmdir()
        _print(f"{old}: {found} of an earlier version deleted")


def _in_words(files: Collection[Path]) -> str:
    """How many prepared shapes, and what they take."""
    size = sum(path.stat().st_size for path in files)
    shapes = "shape" if len(files) == 1 else "shapes"
    return f"{len(files)} prepared {shapes}, " + (
        f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"
    )


def _print(text: str) -> None:
    tqdm.write(text, file=sys.stderr)
