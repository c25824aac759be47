"""Photographs to pictures as the network expects them: the object alone on white, in a square, as large as in training.

    SOURCE/<object>/<name>.jpg                        one folder for each object
    SOURCE/[chair_final/]<listing>_<number>.JPG       Stanford Online Products: one listing is one object
    SOURCE/<name>.jpg                                 a single object

become `OUT/<object>/<name>.png`, with `OUT/<object>/masks/<name>.png`, white where the object was found, as large as
the photograph. Where the object is comes from a mask beside the photograph (`<name>_mask.png` or `masks/<name>.png`) if
there is one, else from its transparency, else from a search for a plain background. So a wrong mask can be corrected by
hand and put beside the photograph.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from train.data import tree_files
from train.data.cutout import cut_out
from train.data.images import PICTURE_SUFFIXES, UNREADABLE_SUFFIXES, read_rgba
from train.errors import UserError
from train.files import replacing, write_text
from train.processes import map_unordered

MASKS = "masks"

_PRODUCTS = "_final"
_LISTING = re.compile(r"(\d+)_(\d+)")
_MASK, _MASK_FOLDERS = "_mask", (MASKS, "mask")
_RECORD = "photos.json"

Masks = dict[str, Path]


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photograph: the object it shows, the name of the picture that is made of it, its file, and that of its mask."""

    object: str
    name: str
    path: Path
    mask: Path | None

    @property
    def title(self) -> str:
        """Its name in reports."""
        return f"{self.object}/{self.path.name}"

    @property
    def target(self) -> Path:
        """Its picture, below the new folder."""
        return Path(self.object, f"{self.name}.png")


@dataclasses.dataclass(frozen=True)
class PhotosReport:
    """What `convert_photos` did.

    Attributes:
        out: the new folder.
        kept: photographs that an earlier run had cut out.
        objects: in the folder.
        found: what was found in each photograph of this run, by its title.
        ways: how many were found by a mask, by transparency ("alpha"), by a plain background.
        failures: reasons by the title of the photograph.
    """

    out: Path
    kept: int
    objects: int
    found: dict[str, str]
    ways: dict[str, int]
    failures: dict[str, str]

    def summary(self) -> str:
        """Lines for the terminal."""
        earlier = f", {self.kept} were there" if self.kept else ""
        ways = ", ".join(f"{count} by {way}" for way, count in self.ways.items())
        lines = [
            f"{self.out}: cut {len(self.found)} photographs out{f' ({ways})' if ways else ''}{earlier}; "
            f"{self.objects} object{'s' if self.objects != 1 else ''}"
        ]
        lines += _some([f"  {title}: {words}" for title, words in self.found.items()])
        if self.failures:
            lines.append(f"{len(self.failures)} photographs were left out:")
            lines += _some([f"  {title}: {reason}" for title, reason in sorted(self.failures.items())])
        lines.append(
            f"look at the masks, then: python -m train reconstruct pretrained {self.out}/OBJECT --out DIR"
        )
        return "\n".join(lines)


def _some(lines: list[str], most: int = 40) -> list[str]:
    rest = len(lines) - most
    return lines if rest <= 0 else [*lines[:most], f"  ... and {rest} more, all in {_RECORD}"]


def convert_photos(
    source: str | Path,
    out: str | Path,
    *,
    size: int = 224,
    fewest: int = 1,
    objects: int | None = None,
    processes: int | None = None,
) -> PhotosReport:
    """Cuts the objects out of photographs; running it again finishes or extends it.

    Args:
        source: folder of folders, a folder of one object, or Stanford Online Products.
        out: new folder.
        size: side of the pictures.
        fewest: leave out objects with fewer photographs.
        objects: at most so many, None for all.
        processes: None for one per core.

    Raises:
        UserError: no photographs, or not a single usable one; a folder that holds something else.
    """
    source, out = Path(source), Path(out)
    tree_files.require_between(size=(size, 16, 2048))
    if fewest < 1 or (objects is not None and objects < 1):
        raise UserError(f"fewest and objects must be at least 1; got {fewest} and {objects}")
    by_object, failures = find_photos(source, without=out)
    by_object = {name: photos for name, photos in by_object.items() if len(photos) >= fewest}
    if not by_object:
        few = f" of an object with at least {fewest}" if fewest > 1 else ""
        said = "".join(f"; {name}: {reason}" for name, reason in list(failures.items())[:1])
        raise UserError(f"no photographs{few} in {source}; looked for {', '.join(PICTURE_SUFFIXES)}{said}")
    chosen = [photo for name in list(by_object)[:objects] for photo in by_object[name]]
    tree_files.prepare_output(out, {"kind": "photos", "size": size})
    for leftover in list(out.glob("**/.*.tmp")):
        leftover.unlink(missing_ok=True)
    try:
        record = (out / _RECORD).read_text(encoding="utf-8", errors="surrogateescape")
        earlier = dict(json.loads(record)).get("found", {})
    except (OSError, ValueError):
        earlier = {}
    jobs = [_Job(photo, out / photo.target, size) for photo in chosen if not (out / photo.target).is_file()]
    found: dict[str, str] = {}
    ways: Counter[str] = Counter()
    for job, result in map_unordered(_cut_one, jobs, processes=processes, title="cutting out", unit="photo"):
        if isinstance(result, tuple):
            ways[result[0]] += 1
            found[job.photo.title] = result[1]
        else:
            failures[job.photo.title] = str(result)
    kept = len(chosen) - len(jobs)
    if not kept and not found:
        tree_files.discard(out)
        raise UserError(f"no photograph can be used; {tree_files.first_of(failures)}")
    found = {job.photo.title: found[job.photo.title] for job in jobs if job.photo.title in found}
    record = {"found": {**earlier, **found}, "left out": failures}
    write_text(out / _RECORD, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    made = {photo.object for photo in chosen if (out / photo.target).is_file()}
    return PhotosReport(out, kept, len(made), found, dict(ways), failures)


def find_photos(
    source: str | Path, *, without: str | Path | None = None
) -> tuple[dict[str, list[Photo]], dict[str, str]]:
    """The photographs below a folder by object, and why some files cannot be read, by name.

    Args:
        source: the folder.
        without: a folder below it that holds no photographs, such as the pictures that an earlier run has made.

    Raises:
        UserError: `source` is no folder.
    """
    source = Path(source)
    if not source.is_dir():
        raise UserError(f"{source} is no folder; name one that holds a folder of photographs for each object")
    by_folder: dict[Path, list[Path]] = defaultdict(list)
    failures = {}
    made = None if without is None else Path(without).resolve()
    for path in sorted(source.rglob("*")):
        if made is not None and made in path.resolve().parents:
            continue
        inside = path.relative_to(source)
        hidden = any(part.startswith(".") for part in inside.parts)
        if hidden or is_mask(path) or not path.is_file():
            continue
        if path.suffix.lower() in PICTURE_SUFFIXES:
            by_folder[path.parent].append(path)
        elif path.suffix.lower() in UNREADABLE_SUFFIXES:
            failures[str(inside)] = f"{path.suffix} pictures cannot be read; save it as JPEG or PNG"
    found: dict[str, list[Photo]] = defaultdict(list)
    for folder, paths in by_folder.items():
        stems, masks = Counter(path.stem for path in paths), masks_in(folder)
        for path in paths:
            name = path.stem if stems[path.stem] == 1 else path.name.replace(".", "_")
            title = _object_of(path, paths, source)
            found[title].append(Photo(title, name, path, mask_of(path, masks)))
    return dict(found), failures


def _object_of(path: Path, beside: list[Path], source: Path) -> str:
    """The object's name: its folder's, below that of Stanford Online Products the listing's number."""
    folder = path.parent.relative_to(source)
    numbered = [_LISTING.fullmatch(each.stem) for each in beside]
    match = _LISTING.fullmatch(path.stem)
    if match and (path.parent.name.endswith(_PRODUCTS) or (all(numbered) and len(beside) > 1)):
        return str(Path(*[part.removesuffix(_PRODUCTS) for part in folder.parts], match[1]))
    return str(folder) if folder.parts else source.resolve().name


def is_mask(path: str | Path) -> bool:
    """Whether a picture is by its name the mask of a photograph. The case of letters does not matter."""
    path = Path(path)
    return path.stem.lower().endswith(_MASK) or path.parent.name.lower() in _MASK_FOLDERS


def masks_in(folder: str | Path) -> Masks:
    """The masks of a folder's photographs, by the names of these as they are and in small letters, without suffix."""
    folder = Path(folder)
    folders = [each for each in folder.iterdir() if each.name.lower() in _MASK_FOLDERS and each.is_dir()]
    found = {
        path.stem[: -len(_MASK)] if path.stem.lower().endswith(_MASK) else path.stem: path
        for each in (*folders, folder)  # a mask beside its photograph goes first
        for path in sorted(each.iterdir())
        if path.suffix.lower() in PICTURE_SUFFIXES and is_mask(path)
    }
    return {name.lower(): path for name, path in found.items()} | found


def mask_of(path: str | Path, masks: Masks) -> Path | None:
    """The mask of a photograph, among those of `masks_in` its folder."""
    name = Path(path).stem
    return masks.get(name) or masks.get(name.lower())


class _Job(NamedTuple):
    photo: Photo
    target: Path
    size: int


def _cut_one(job: _Job) -> tuple[str, str] | Exception:
    """Writes one mask and then its picture; returns how the object was found, and a description."""
    photo = job.photo
    try:
        made = cut_out(read_rgba(photo.path), size=job.size, given=photo.mask and read_rgba(photo.mask))
        mask = job.target.parent / MASKS / job.target.name
        for path, pixels in ((mask, made.mask.astype(np.uint8) * 255), (job.target, made.picture)):
            with replacing(path) as temporary:
                Image.fromarray(pixels).save(temporary, format="PNG")
    except (UserError, OSError) as error:  # a full disk among them, which stops everything
        return error
    except Exception as error:  # whatever is wrong with one photograph, the others must be made
        return UserError(f"{type(error).__name__}: {error}")
    return made.way, made.found
