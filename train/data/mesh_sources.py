"""Finding meshes in folders, archives and single files; their categories and names."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import math
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from train.data.archives import ARCHIVE_SUFFIXES, Rotation, catalogue_rotations, is_library, unpack
from train.data.categories import SYNSET_OF, UNKNOWN, synset_of
from train.data.tree_files import CLOUDS
from train.errors import UserError

MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".off", ".stl")
_GENERAL_NAMES = {"model", "models", "model_normalized", "mesh", "meshes", "object"}
_NOT_A_MODEL = re.compile(rf"(^|/)(\.|__MACOSX/|{CLOUDS}/)")
"""Hidden files, the resource forks in macOS archives, and the clouds of a dataset made below the source."""

_SYNSET = re.compile(r"[01]\d{7}")  # WordNet's offsets; a folder that is a date starts with 2

UPRIGHT: dict[str, Rotation | None] = {
    "y": None,
    "z": (1, 0, 0, 0, 0, 1, 0, -1, 0),
    "x": (0, -1, 0, 1, 0, 0, 0, 0, 1),
    "-y": (-1, 0, 0, 0, -1, 0, 0, 0, 1),
    "-z": (1, 0, 0, 0, 0, -1, 0, 1, 0),
    "-x": (0, 1, 0, -1, 0, 0, 0, 0, 1),
}
"""Rotations to y up, by the axis that points up in the file. With z up, the front is assumed to be at -y."""


@dataclasses.dataclass(frozen=True)
class MeshFile:
    """A mesh that was found.

    Attributes:
        path: the file to load; in a scratch folder if it came out of an archive.
        library: name of the folder or archive it came from.
        inside: path inside the library, with forward slashes.
        synset: folder name of its category.
        rotation: 9 numbers, row by row, that turn the model upright and its front to +z; None for none.
    """

    path: Path
    library: str
    inside: str
    synset: str
    rotation: Rotation | None = None

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"{self.library}: {self.inside}"

    @property
    def root(self) -> Path:
        """The folder below which its materials and textures may be: its library's, at least the parent of its own."""
        parents = self.path.resolve().parents
        return parents[min(max(len(PurePosixPath(self.inside).parts) - 1, 1), len(parents) - 1)]


@dataclasses.dataclass(frozen=True)
class Label:
    """A line of a label file: the category of a model in a library."""

    library: str
    model: str
    synset: str
    turn: Rotation | None = None
    """Turns the model upright and its front to +z where its library's own rotation does not."""


def find_meshes(
    sources: Sequence[str | Path], scratch: str | Path, *, up: str = "y"
) -> tuple[list[MeshFile], dict[str, str]]:
    """All meshes of the sources; archives are unpacked below `scratch`.

    Args:
        sources: folders, archives and mesh files.
        scratch: a folder for what is unpacked; it must outlive the meshes.
        up: the axis that points up in the files, a key of `UPRIGHT`; not used for Sweet Home 3D libraries.

    Returns:
        The meshes, and by name the archive members that were refused.

    Raises:
        UserError: a source that is missing, or no folder, archive or mesh.
    """
    meshes: list[MeshFile] = []
    refused: dict[str, str] = {}
    scratch = Path(scratch)
    for source in {path.resolve(): path for path in map(Path, sources)}.values():
        if not source.exists():
            raise UserError(f"no such file or folder: {source}")
        if source.is_dir():
            meshes += _in_folder(source, source.resolve().name, UPRIGHT[up])
            archives = sorted(path for path in source.rglob("*") if path.suffix.lower() in ARCHIVE_SUFFIXES)
        elif source.suffix.lower() in ARCHIVE_SUFFIXES:
            archives = [source]
        elif source.suffix.lower() in MESH_SUFFIXES:
            meshes.append(
                MeshFile(
                    source,
                    source.resolve().parent.name,
                    source.name,
                    _synset_from(source.resolve().parts[-4:-1]),
                    UPRIGHT[up],
                )
            )
            archives = []
        else:
            known = ", ".join(ARCHIVE_SUFFIXES + MESH_SUFFIXES)
            raise UserError(f"{source} is neither a folder nor one of {known}")
        for archive in archives:
            folder = scratch / str(len(list(scratch.iterdir())))
            refused |= unpack(archive, folder)
            upright = None if is_library(folder) else UPRIGHT[up]
            meshes += _in_folder(folder, archive.name, upright, catalogue_rotations(folder))
    once = {mesh.path.resolve(): mesh for mesh in reversed(meshes)}  # a source may lie in another
    return list(reversed(once.values())), refused


def _in_folder(
    folder: Path, library: str, upright: Rotation | None, rotations: dict[str, Rotation] | None = None
) -> list[MeshFile]:
    found = []
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder).as_posix()
        if path.suffix.lower() in MESH_SUFFIXES and path.is_file() and not _NOT_A_MODEL.search(inside):
            synset = _synset_from((library, *PurePosixPath(inside).parts[:-1]))
            found.append(MeshFile(path, library, inside, synset, (rotations or {}).get(inside, upright)))
    return found


def _synset_from(parts: Iterable[str]) -> str:
    """The category after which a folder of the path is named (name, plural or synset); the innermost folder counts."""
    for part in reversed(tuple(parts)):
        if _SYNSET.fullmatch(part):
            return part
        for name in (part.lower(), part.lower().removesuffix("s")):
            if name in SYNSET_OF:
                return SYNSET_OF[name]
    return UNKNOWN


def read_labels(path: str | Path) -> list[Label]:
    """Reads a label file with the columns model and category, and optionally library, synset and turn.

    A model is a path inside its library, which is the name of a source folder or archive; without one, inside any.

    A turn is an axis and the degrees by which a model is turned about it, after its library's own rotation: with `x90`
    a telephone that lies on its back stands up and faces +z.

    Raises:
        UserError: no such file, no such columns, or a turn of another form.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"the label file {path} cannot be read ({error})") from error
    missing = [column for column in ("model", "category") if not rows or rows[0].get(column) is None]
    if missing:
        raise UserError(f"the label file {path} has no column {', '.join(missing)}, or no lines")
    return [
        Label(
            row.get("library") or "",
            row["model"],
            row.get("synset") or synset_of(row["category"].strip()),
            _turn_of(row.get("turn") or "", f"{path}: {row['model']}"),
        )
        for row in rows
    ]


def _turn_of(text: str, where: str) -> Rotation | None:
    """The matrix, row by row, of a turn such as `y-90`: about y by -90 degrees, right-handed."""
    if not text.strip():
        return None
    parts = re.fullmatch(r"([xyz])(-?\d+)", text.strip())
    if parts is None:
        raise UserError(f"{where}: the turn {text!r} is not an axis and degrees, such as y90")
    angle = math.radians(int(parts[2]))
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[parts[1]]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = round(math.cos(angle), 12)
    matrix[second, first] = round(math.sin(angle), 12)
    matrix[first, second] = -matrix[second, first]
    return tuple(matrix.ravel().tolist())


def _followed_by(rotation: Rotation | None, turn: Rotation | None) -> Rotation | None:
    """The rotation that is `rotation` followed by `turn`."""
    if rotation is None or turn is None:
        return rotation or turn
    return tuple((np.reshape(turn, (3, 3)) @ np.reshape(rotation, (3, 3))).ravel().tolist())


def keep_labelled(
    meshes: Sequence[MeshFile], labels: Sequence[Label], path: str | Path
) -> tuple[list[MeshFile], dict[str, str]]:
    """The meshes that have a label, with its category; and reasons by the name of labelled ones that do not exist.

    Raises:
        UserError: no label fits any mesh.
    """
    by_place: dict[tuple[str, str], list[MeshFile]] = defaultdict(list)
    for mesh in meshes:
        by_place[mesh.library, mesh.inside].append(mesh)
        by_place["", mesh.inside].append(mesh)
    kept, absent = [], {}
    libraries = {mesh.library for mesh in meshes}
    for label in labels:
        found = by_place.get((label.library, label.model), [])
        for mesh in found:
            turned = _followed_by(mesh.rotation, label.turn)
            kept.append(dataclasses.replace(mesh, synset=label.synset, rotation=turned))
        if not found and label.library in libraries | {""}:
            absent[f"{label.library or Path(path).name}: {label.model}"] = (
                "the label file names it, but its library does not contain it"
            )
    if not kept:
        raise UserError(
            f"no line of {path} fits the meshes: its libraries are {_some({label.library for label in labels})}, "
            f"the sources are {_some(libraries)}"
        )
    return kept, absent


def of_category(meshes: Sequence[MeshFile], category: str) -> list[MeshFile]:
    """The meshes, all with one category: a name of the paper's, a synset, or any other name."""
    synset = _synset_from([category])
    synset = synset_of(category) if synset == UNKNOWN else synset
    return [dataclasses.replace(mesh, synset=synset) for mesh in meshes]


def _some(names: set[str]) -> str:
    return ", ".join(sorted(name or "any library" for name in names)[:5]) or "nothing"


def shape_ids(meshes: Sequence[MeshFile]) -> list[str]:
    """A name "synset/model" for each mesh: unique, valid on every file system, and the same in the next run.

    The model is named after its path without general words such as "model.obj"; where that is not plain ASCII, or two
    meshes would share the name, a hash of the library and the whole path follows.
    """
    plain = [_plain_name(mesh) for mesh in meshes]
    uses = Counter(f"{mesh.synset}/{name.lower()}" for mesh, (name, _) in zip(meshes, plain, strict=True))
    ids: list[str] = []
    hashes: Counter[str] = Counter()
    for mesh, (name, exact) in zip(meshes, plain, strict=True):
        if not exact or uses[f"{mesh.synset}/{name.lower()}"] > 1:
            name = f"{name}-{hashlib.sha256(mesh.name.encode()).hexdigest()[:8]}"
            hashes[name] += 1
            if hashes[name] > 1:  # libraries of one name
                name = f"{name}-{hashes[name]}"
        ids.append(f"{mesh.synset}/{name}")
    return ids


def _plain_name(mesh: MeshFile) -> tuple[str, bool]:
    """A name of safe characters, and whether it still has all characters of the path."""
    parts = list(PurePosixPath(mesh.inside).with_suffix("").parts)
    while len(parts) > 1 and (parts[-1].lower() in _GENERAL_NAMES or parts[-1] == parts[-2]):
        parts.pop()
    if len(parts) > 1 and _synset_from(parts[:1]) == mesh.synset:
        parts = parts[1:]
    name = "_".join(parts)
    ascii_name = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe = re.sub(r"[^A-Za-z0-9-]+", "_", ascii_name).strip("_-")[:100]
    return safe or "model", safe == name
