"""Unpacking zip archives and Sweet Home 3D libraries, and reading how a library rotates its models."""

from __future__ import annotations

import re
import shutil
import zipfile
from pathlib import Path, PurePosixPath

from train.errors import UserError
from train.files import DISK_ERRORS

ARCHIVE_SUFFIXES = (".zip", ".sh3f")
_CATALOGUE = "PluginFurnitureCatalog.properties"

Rotation = tuple[float, ...]
"""9 numbers, row by row."""


def unpack(archive: str | Path, folder: str | Path) -> dict[str, str]:
    """Unpacks an archive into a new folder; a member that names no file inside of it is refused and named.

    Returns:
        Reasons by the name of the member.

    Raises:
        UserError: no zip archive, or not enough space.
    """
    archive, folder = Path(archive), Path(folder)
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


def is_library(folder: str | Path) -> bool:
    """True for an unpacked Sweet Home 3D library, whose models stand upright and face +z."""
    return (Path(folder) / _CATALOGUE).is_file()


def catalogue_rotations(folder: str | Path) -> dict[str, Rotation]:
    """The rotations that a library gives to some of its models, by path inside the library."""
    if not is_library(folder):
        return {}
    content = (Path(folder) / _CATALOGUE).read_text("latin-1")
    entries = dict(re.findall(r"^(\w+#\d+)=(.*?)\s*$", content, re.MULTILINE))
    rotations = {}
    for key, model in entries.items():
        if key.startswith("model#"):
            numbers = entries.get(key.replace("model#", "modelRotation#"), "").split()
            if len(numbers) == 9:
                rotations[model.lstrip("/")] = tuple(float(number) for number in numbers)
    return rotations
