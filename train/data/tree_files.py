"""The files of a data tree, laid out as in the paper's release: where they are, and how they are written.

    rendered-shapenet/<synset>/<model>/{render_i.png, depth_i.png, camera_i.json}
    pcdata_2048/<synset>/<model>.ply
    data_list/{train,val,test}/<synset>.list        lines "<synset>/<model>"

Depth is uint16 with z = value / 65535 * 10, and 65535 where nothing is seen.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch

from diffpoint.io import encode_depth, write_points
from train.data.render import Views
from train.errors import UserError
from train.files import remove, replacing, write_text

RENDERS, CLOUDS, LISTS = "rendered-shapenet", "pcdata_2048", "data_list"
SPLITS = ("train", "val", "test")
POINTS = 2048
_TEST_SHARE, _VAL_SHARE = 0.2, 0.1
SETTINGS = "made_with.json"
"""Holds the settings of the command that made the tree; trees from elsewhere lack it."""


def render_folder(root: str | Path, shape: str) -> Path:
    """The folder with the views of the shape "<synset>/<model>"."""
    return Path(root) / RENDERS / shape


def cloud_file(root: str | Path, shape: str) -> Path:
    """The file with the ground-truth cloud of the shape "<synset>/<model>"."""
    return Path(root) / CLOUDS / f"{shape}.ply"


def is_written(root: str | Path, shape: str) -> bool:
    """True if an earlier run finished this shape."""
    return render_folder(root, shape).is_dir() and cloud_file(root, shape).is_file()


def is_own(root: str | Path) -> bool:
    """True for a tree that this program made."""
    return (Path(root) / SETTINGS).is_file()


def write_shape(root: str | Path, shape: str, views: Views, points: np.ndarray) -> None:
    """Writes one shape. Its folder of views appears complete or not at all, whenever the process is killed.

    The cloud is written first and the folder is renamed into place last: a folder means "finished".
    """
    target, cloud = render_folder(root, shape), cloud_file(root, shape)
    cloud.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as folder:
        folder.mkdir()
        K, cam_from_world = views.camera.K.tolist(), views.camera.cam_from_world.tolist()
        for i, (image, depth) in enumerate(zip(views.images, views.depth, strict=True)):
            imageio.imwrite(folder / f"render_{i}.png", image, compress_level=3)
            imageio.imwrite(
                folder / f"depth_{i}.png", encode_depth(torch.from_numpy(depth)), compress_level=3
            )
            record = {
                "K": K[i],
                "cam_from_world": cam_from_world[i],
                "height": views.camera.height,
                "width": views.camera.width,
            }
            (folder / f"camera_{i}.json").write_text(json.dumps(record))
        write_points(cloud, torch.from_numpy(points.astype(np.float32)))
        remove(target)


def write_lists(root: str | Path, *, seed: int) -> dict[str, dict[str, int]]:
    """Splits the shapes on disk into train, val and test (about 70/10/20) and writes the lists.

    The split depends on the seed and the shape's own name, so that it stays when shapes are added. Hidden
    variants of one object, named `<object>_h<k>`, and stretched copies, `<object>_stretched<k>`, stay together. From
    five objects on, each category has at least one object in val and in test.

    Returns:
        Counts, by split and synset.
    """
    root = Path(root)
    shapes_by_synset: dict[str, list[str]] = defaultdict(list)
    for folder in sorted((root / RENDERS).glob("*/*")):
        shape = f"{folder.parent.name}/{folder.name}"
        if not folder.name.startswith(".") and is_written(root, shape):
            shapes_by_synset[folder.parent.name].append(shape)
    counts: dict[str, dict[str, int]] = {split: {} for split in SPLITS}
    for synset, shapes in shapes_by_synset.items():
        split_of = split_shapes(shapes, seed=seed)
        for split in SPLITS:
            lines = [shape for shape in shapes if split_of[shape] == split]
            counts[split][synset] = len(lines)
            write_text(root / LISTS / split / f"{synset}.list", "".join(f"{line}\n" for line in lines))
    return counts


def split_shapes(shapes: Iterable[str], *, seed: int) -> dict[str, str]:
    """The split of each shape of one category; see `write_lists`."""
    objects: dict[str, list[str]] = defaultdict(list)
    for shape in shapes:
        objects[re.sub(r"_(h|stretched)\d+$", "", shape)].append(shape)
    fraction = {name: hash_fraction(f"{seed}:{name}") for name in objects}
    order = sorted(objects, key=lambda name: fraction[name])
    split_of = {
        name: "test" if at < _TEST_SHARE else "val" if at < _TEST_SHARE + _VAL_SHARE else "train"
        for name, at in fraction.items()
    }
    for missing in (split for split in SPLITS if len(order) >= 5 and split not in split_of.values()):
        largest, _ = Counter(split_of.values()).most_common(1)[0]
        split_of[next(name for name in order if split_of[name] == largest)] = missing
    return {shape: split_of[name] for name in order for shape in objects[name]}


def hash_fraction(text: str) -> float:
    """A number in [0, 1) that depends on the text only."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") / 2**64


def prepare_output(out: str | Path, settings: dict) -> None:
    """Prepares the folder for a conversion, new or restarted, and refuses to mix data made with other settings.

    Raises:
        UserError: `out` is a file, holds something else, or holds data made with other settings.
    """
    out = Path(out)
    marker = out / SETTINGS
    if marker.is_file():
        try:
            earlier = dict(json.loads(marker.read_text()))
            changed = [
                f"{key}: {earlier.get(key)!r} there, {value!r} now"
                for key, value in settings.items()
                if earlier.get(key) != value
            ]
        except ValueError:
            changed = [f"{marker.name} cannot be read"]
        if changed:
            raise UserError(
                f"{out} holds data made with other settings ({'; '.join(changed)}); "
                "choose another --out, or delete the folder"
            )
        for pattern in (f"{RENDERS}/*/.*.tmp", f"{CLOUDS}/*/.*"):  # half-written by a run that was killed
            for leftover in out.glob(pattern):
                remove(leftover)
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(
            f"{out} exists and is no dataset of this program; choose a new or empty folder for --out"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_text(marker, json.dumps(settings, indent=1))
    except OSError as error:
        raise UserError(f"cannot write to {out} ({error.strerror}); choose another --out") from error


def discard(root: str | Path) -> None:
    """Removes a dataset in which nothing could be made."""
    root = Path(root)
    for name in (RENDERS, CLOUDS, LISTS, SETTINGS):
        remove(root / name)
    if not any(root.iterdir()):
        root.rmdir()


def require_between(**values: tuple[int, int, int]) -> None:
    """Refuses options, name=(value, lowest, highest), that are out of range.

    Raises:
        UserError: one is.
    """
    for name, (value, low, high) in values.items():
        if not low <= value <= high:
            raise UserError(f"{name} must be between {low} and {high}; got {value}")


def in_words(counts: dict[str, int]) -> str:
    """For instance "7 train, 1 val, 2 test"."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def first_of(failures: dict[str, str]) -> str:
    """The first of these reasons by name, and how many others there are."""
    name, reason = next(iter(failures.items()))
    return f"{name}: {reason}" + (f" (and {len(failures) - 1} others)" if len(failures) > 1 else "")
