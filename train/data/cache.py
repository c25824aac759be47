"""Shapes at the sizes of training, kept on disk: no picture is decoded twice, and all processes map the same pages.

    TREE/.prepared/96x128-maps28-decimate-v1/<synset>/<model>.safetensors

Each file holds one shape and says which files it was made from (their names, sizes and times) and the checksum of what
it holds; one that no longer fits them, or is damaged, is made again. A tree that cannot be written to has its files in
the user's cache folder, and the environment variable DIFFPOINT_PREPARED names a folder for all trees. They can be
deleted at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from tqdm import tqdm

from train.data.categories import category_of
from train.data.frames import Frame
from train.data.shrink import Sizes, SmallShape, shrink
from train.data.tree import ShapeError, frame_of, layout_of, read_shape
from train.data.work import run_all
from train.errors import UserError
from train.files import replacing

_VERSION = 1  # of the files, and of how shapes are shrunk
_TENSORS = ("images", "depth", "K", "cam_from_world", "points")
_PLACE = "DIFFPOINT_PREPARED"
_SHAPES_WORTH_A_PROCESS = 100  # it takes seconds to start


def prepare(
    root: Path, shapes: Sequence[str], sizes: Sizes, *, name: str = "shapes", progress: bool = True
) -> dict[str, SmallShape | ShapeError]:
    """The shapes of a tree, shrunk: from their prepared files, which are made where they are missing.

    A process that is killed while it makes them has lost the shapes it was working on, no others; several that start
    together wait for the one that makes them.

    Args:
        root: of the data tree.
        shapes: "synset/model".
        sizes: what they are shrunk to.
        name: what the bars call the shapes.
        progress: show bars.

    Returns:
        In the order of `shapes`: tensors that are mapped from the files, or why a shape cannot be had.

    Raises:
        UserError: `sizes` do not fit the renders.
    """
    tree = _Tree(root, sizes, _name(frame_of(root)))
    places = _places(root, sizes)
    found = _look_up(places, tree, shapes, name=name, progress=progress)
    missing = [shape for shape in shapes if shape not in found]
    if missing:
        place = _first_writable(places, root)
        if place is not None:
            with _one_at_a_time(place):
                # Another process may have made them while this one waited.
                found |= {shape: small for shape in missing if (small := _find(places, tree, shape)[0])}
                missing = [shape for shape in missing if shape not in found]
                found |= _make(place, tree, missing, name=name, progress=progress)
        found |= _read(tree, [shape for shape in missing if shape not in found], name=name, progress=progress)
    return {shape: found[shape] for shape in shapes}


class _Tree(NamedTuple):
    """A data tree, and what decides what is made of its files."""

    root: Path
    sizes: Sizes
    frame: str

    def source(self, shape: str) -> str:
        """Changes when a file of the shape changes, appears or goes, or when the tree is turned another way."""
        layout = layout_of(self.root)
        cloud = layout.cloud_file(shape)
        try:
            with os.scandir(layout.folder(shape)) as entries:
                lines = sorted(_line(entry.name, entry.stat()) for entry in entries)
            lines.append(_line(cloud.name, cloud.stat()))
        except OSError as error:
            lines = [str(error)]  # reading the shape will say more
        return hashlib.sha256("\n".join([self.frame, *lines]).encode()).hexdigest()[:32]

    def read(self, shape: str) -> SmallShape:
        """From its pictures."""
        return shrink(read_shape(self.root, shape), self.sizes)


def _name(frame: Frame) -> str:
    turns = (frame.turn_cloud, frame.turn_world, frame.turn_camera)
    return " ".join(repr(np.asarray(turn, float).tolist()) for turn in turns)


def _line(name: str, stat: os.stat_result) -> str:
    return f"{name} {stat.st_size} {stat.st_mtime_ns}"


def _places(root: Path, sizes: Sizes) -> list[Path]:
    """Folders where the shapes may be, the best first."""
    height, width = sizes.image_size
    settings = f"{height}x{width}-maps{sizes.map_size}-{sizes.pool}-v{_VERSION}"
    whole = root.resolve()
    tree = f"{whole.name}-{hashlib.sha256(str(whole).encode()).hexdigest()[:8]}"
    if chosen := os.environ.get(_PLACE):
        return [Path(chosen) / tree / settings]
    caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return [root / ".prepared" / settings, caches / "diffpoint" / "prepared" / tree / settings]


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
            _say(f"{root} cannot be written to; its prepared shapes are kept in {place}")
        return place
    _say(f"no place to keep prepared shapes ({reason}): they are read anew each time; see {_PLACE}")
    return None


@contextlib.contextmanager
def _one_at_a_time(place: Path) -> Iterator[None]:
    """Waits for other processes that make files in `place`. A file system without locks only costs their work twice."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    with (place / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _say(f"another process prepares the shapes in {place}; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:
            pass
        yield


def _look_up(
    places: Sequence[Path], tree: _Tree, shapes: Sequence[str], *, name: str, progress: bool
) -> dict[str, SmallShape | ShapeError]:
    """What is there already; files that cannot be used are counted and said."""
    found: dict[str, SmallShape | ShapeError] = {}
    unusable: Counter[str] = Counter()
    for shape in tqdm(shapes, desc=f"opening {name}", unit="shape", leave=False, disable=not progress):
        small, reason = _find(places, tree, shape)
        if small is not None:
            found[shape] = small
        elif reason:
            unusable[reason] += 1
    for reason, count in sorted(unusable.items()):
        what = "shape is" if count == 1 else "shapes are"
        _say(f"{tree.root}: {count} prepared {what} {reason}; made again")
    return found


def _find(places: Sequence[Path], tree: _Tree, shape: str) -> tuple[SmallShape | None, str]:
    """A prepared shape, from the first place that has it; else what is the matter with its file, if there is one."""
    source, reason = tree.source(shape), ""
    for place in places:
        result = _open(place, shape, source)
        if isinstance(result, SmallShape):
            return result, ""
        reason = reason or result
    return None, reason


def _open(place: Path, shape: str, source: str) -> SmallShape | str:
    """A prepared shape, or what is the matter with its file; nothing if there is none."""
    try:
        with safe_open(_file(place, shape), "pt") as file:
            about = file.metadata() or {}
            if about.get("source") != source:
                return "outdated"
            # Mapped, not read: pages come when they are touched and are the system's to take back.
            tensors = {name: file.get_tensor(name) for name in _TENSORS}
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except (SafetensorError, OSError):
        return "damaged"
    if about.get("checksum") != _checksum(tensors):
        return "damaged"
    return SmallShape(shape, category_of(shape.split("/")[0]), **tensors)


def _file(place: Path, shape: str) -> Path:
    return place / f"{shape}.safetensors"


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """A crash of the machine can leave zeros in a file whose name is already there."""
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
) -> dict[str, SmallShape | ShapeError]:
    """Makes the files of `shapes`, those for which there is room, and maps them."""
    for leftover in place.glob("*/.*.tmp"):  # of a process that was killed
        leftover.unlink(missing_ok=True)
    jobs = [_Job(place, tree, shape) for shape in shapes]
    processes = max(1, min(os.cpu_count() or 1, len(jobs) // _SHAPES_WORTH_A_PROCESS))
    made: dict[str, SmallShape | ShapeError] = {}
    results = run_all(
        _make_one, jobs, processes=processes, desc=f"preparing {name}", unit="shape", progress=progress
    )
    with contextlib.closing(results):
        for job, result in results:
            if isinstance(result, ShapeError):
                made[job.shape] = result
            elif isinstance(result, UserError):
                raise UserError(f"{tree.root}: {result}")
            elif isinstance(result, OSError):  # its process died
                made[job.shape] = ShapeError(f"{job.shape}: {result}")
            elif isinstance(result, _NoRoom):
                _say(f"prepared shapes cannot be kept in {place} ({result.reason}); see {_PLACE}")
                break
    for shape in shapes:
        if shape not in made and isinstance(opened := _open(place, shape, tree.source(shape)), SmallShape):
            made[shape] = opened
    return made


class _NoRoom(NamedTuple):
    """Why a file could not be written."""

    reason: str


def _make_one(job: _Job) -> UserError | _NoRoom | None:
    """Makes one file; runs in a process of its own, which needs no more than one thread and no kernels."""
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)
    try:
        source = job.tree.source(job.shape)  # before reading: what changes while it is read must not pass
        small = job.tree.read(job.shape)
        tensors = {name: getattr(small, name).contiguous() for name in _TENSORS}
        about = {"source": source, "checksum": _checksum(tensors)}
        with replacing(_file(job.place, job.shape)) as temporary:
            temporary.write_bytes(save(tensors, metadata=about))
    except UserError as error:
        return error
    except OSError as error:
        return _NoRoom(error.strerror or str(error))
    return None


def _read(
    tree: _Tree, shapes: Sequence[str], *, name: str, progress: bool
) -> dict[str, SmallShape | ShapeError]:
    """Shapes whose files could not be kept, in memory."""
    read: dict[str, SmallShape | ShapeError] = {}
    for shape in tqdm(shapes, desc=f"reading {name}", unit="shape", disable=not (progress and shapes)):
        try:
            read[shape] = tree.read(shape)
        except ShapeError as error:
            read[shape] = error
        except UserError as error:
            raise UserError(f"{tree.root}: {error}") from None
    return read


def _say(text: str) -> None:
    tqdm.write(text, file=sys.stderr)
