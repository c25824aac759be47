"""Finding meshes in folders, zip archives, Sweet Home 3D libraries and single files; their categories and names."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import re
import shutil
import unicodedata
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial import transform

from train.data.categories import SYNSET_OF, UNKNOWN, synset_of
from train.data.tree_files import CLOUDS
from train.errors import UserError
from train.files import DISK_ERRORS

Rotation = tuple[float, ...]
"""9 numbers, row by row."""

ARCHIVE_SUFFIXES = (".zip", ".sh3f", ".pk3")
MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".off", ".stl", ".ac", ".acc", ".md2")
_GENERAL_NAMES = {"model", "models", "model_normalized", "mesh", "meshes", "object"}
_NOT_A_MODEL = re.compile(rf"(^|/)(\.|__MACOSX/|{CLOUDS}/)")
"""Hidden files, the resource forks in macOS archives, and the clouds of a dataset made below the source."""

_CATALOGUE = "PluginFurnitureCatalog.properties"
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
        whole, archives = source.resolve(), []
        if source.is_dir():
            meshes += _in_folder(source, whole.name, UPRIGHT[up])
            archives = sorted(path for path in source.rglob("*") if path.suffix.lower() in ARCHIVE_SUFFIXES)
        elif source.suffix.lower() in ARCHIVE_SUFFIXES:
            archives = [source]
        elif source.suffix.lower() in MESH_SUFFIXES:
            synset = _synset_from(whole.parts[-4:-1])
            meshes.append(MeshFile(source, whole.parent.name, source.name, synset, UPRIGHT[up]))
        else:
            known = ", ".join(ARCHIVE_SUFFIXES + MESH_SUFFIXES)
            raise UserError(f"{source} is neither a folder nor one of {known}")
        for archive in archives:
            folder = scratch / str(len(list(scratch.iterdir())))
            refused |= _unpack(archive, folder)
            if (folder / _CATALOGUE).is_file():  # models of a furniture library stand upright and face +z
                meshes += _in_folder(folder, archive.name, None, _catalogue_rotations(folder))
            else:
                meshes += _in_folder(folder, archive.name, UPRIGHT[up])
    once = {mesh.path.resolve(): mesh for mesh in reversed(meshes)}  # a source may lie in another
    return list(reversed(once.values())), refused


def _unpack(archive: Path, folder: Path) -> dict[str, str]:
    """Unpacks an archive into a new folder; returns why members were refused, by their names.

    Raises:
        UserError: no zip archive, or not enough space.
    """
    refused = {}
    folder.mkdir(parents=True)
    try:
        with zipfile.ZipFile(archive) as content:
            members = [member for member in content.infolist() if not member.filename.endswith("/")]
            if sum(member.file_size for member in members) > shutil.disk_usage(folder).free:
                raise UserError(
                    f"{archive} unpacks to more than the free space of {folder.parent}; set TMPDIR to a larger place"
                )
            for member in members:
                parts = PurePosixPath(member.filename.replace("\\", "/")).parts
                name = f"{archive.name}: {member.filename}"
                if not parts:
                    refused[name] = "its path names no file"
                    continue
                if ".." in parts or member.filename.startswith(("/", "\\")) or ":" in parts[0]:
                    refused[name] = "its path leads out of the archive"
                    continue
                try:
                    content.extract(member, folder)
                except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError, EOFError) as error:
                    if isinstance(error, OSError) and error.errno in DISK_ERRORS:
                        raise UserError(
                            f"{archive} cannot be unpacked in {folder.parent} ({error.strerror}); "
                            "set TMPDIR to a larger place"
                        ) from error
                    refused[name] = f"cannot be unpacked ({error})"
    except zipfile.BadZipFile as error:
        raise UserError(f"{archive} is not a zip archive ({error}); download it again") from error
    return refused


def _catalogue_rotations(folder: Path) -> dict[str, Rotation]:
    """The rotations that a furniture library gives to some of its models, by path inside the library."""
    content = (folder / _CATALOGUE).read_text("latin-1")
    entries = dict(re.findall(r"^(\w+#\d+)=(.*?)\s*$", content, re.MULTILINE))
    rotations = {}
    for key, model in entries.items():
        numbers = entries.get(key.replace("model#", "modelRotation#"), "").split()
        if key.startswith("model#") and len(numbers) == 9:
            rotations[model.lstrip("/")] = tuple(map(float, numbers))
    return rotations


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
    matrix = transform.Rotation.from_euler(parts[1], int(parts[2]), degrees=True).as_matrix()
    return tuple(matrix.round(12).ravel().tolist())


def keep_labelled(
    meshes: Sequence[MeshFile], labels: Sequence[Label], path: str | Path, *, others: bool = False
) -> tuple[list[MeshFile], dict[str, str]]:
    """The meshes that have a label, with its category; and reasons by the name of labelled ones that do not exist.

    With `others`, the meshes without a label follow, with the category that they have.

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
            rotation = mesh.rotation or label.turn
            if mesh.rotation and label.turn:
                both = np.reshape(label.turn, (3, 3)) @ np.reshape(mesh.rotation, (3, 3))
                rotation = tuple(both.ravel().tolist())
            kept.append(dataclasses.replace(mesh, synset=label.synset, rotation=rotation))
        if not found and label.library in libraries | {""}:
            absent[f"{label.library or Path(path).name}: {label.model}"] = (
                "the label file names it, but its library does not contain it"
            )
    if not kept:
        named, given = (
            ", ".join(sorted(name or "any library" for name in names)[:5]) or "nothing"
            for names in ({label.library for label in labels}, libraries)
        )
        raise UserError(
            f"no line of {path} fits the meshes: its libraries are {named}, the sources are {given}"
        )
    if others:
        labelled = {mesh.name for mesh in kept}
        kept += [mesh for mesh in meshes if mesh.name not in labelled]
    return kept, absent


def of_category(meshes: Sequence[MeshFile], category: str) -> list[MeshFile]:
    """The meshes, all with one category: a name of the paper's, a synset, or any other name."""
    synset = _synset_from([category])
    synset = synset_of(category) if synset == UNKNOWN else synset
    return [dataclasses.replace(mesh, synset=synset) for mesh in meshes]


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
            whole = mesh.name.encode(errors="surrogateescape")  # a name need not be UTF-8
            name = f"{name}-{hashlib.sha256(whole).hexdigest()[:8]}"
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
