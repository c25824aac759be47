"""OBJ files as trimesh reads them: one kind of line ends and blanks, indices that count from the start, one library."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

LIBRARY = "materials of all libraries.mtl"

_KEYWORDS = (b"v ", b"vt ", b"vn ")


def as_text(content: bytes) -> bytes:
    """UTF-8 without a byte order mark, each line ended by one newline."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", errors="replace").encode()
    content = content.removeprefix(b"\xef\xbb\xbf")
    if not content.isascii():
        content = content.decode("utf-8", errors="replace").encode()
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\0", b"")


def plain(content: bytes) -> tuple[bytes, list[str]]:
    """An OBJ file, and the names of its material libraries, for which it names `LIBRARY`."""
    content = re.sub(rb"\\[ \t]*\n", b" ", as_text(content)).replace(b"\t", b" ")
    if re.search(rb"(?m)^ +", content):
        content = re.sub(rb"(?m)^ +", b"", content)
    if b"#" in content:
        content = re.sub(rb"(?m)^((?:v|vt|vn|f) [^#\n]*)#.*$", rb"\1", content)
    if re.search(rb"(?m)^f .*-", content):
        content = b"\n".join(_from_the_start(content))
    named = [line.decode() for line in re.findall(rb"(?m)^mtllib +(.*?) *$", content)]
    if not named:
        return content, []
    content = re.sub(rb"(?m)^mtllib .*$", b"", content)
    libraries = [name for line in named for name in re.findall(r"\S.*?\.mtl(?= |$)", line, re.I) or [line]]
    return f"mtllib {LIBRARY}\n".encode() + content, libraries


def _from_the_start(content: bytes) -> Iterator[bytes]:
    """The lines with indices of at least 1: negative ones count back from the line that they are in."""
    written = [0, 0, 0]  # vertices, texture coordinates, normals
    for line in content.split(b"\n"):
        if line.startswith(_KEYWORDS):
            written[{b" ": 0, b"t": 1, b"n": 2}[line[1:2]]] += 1
        elif line.startswith(b"f ") and b"-" in line:
            corners = [
                b"/".join(
                    str(written[kind] + 1 + int(index)).encode() if index.startswith(b"-") else index
                    for kind, index in enumerate(corner.split(b"/"))
                )
                for corner in line.split()[1:]
            ]
            line = b" ".join((b"f", *corners))
        yield line


class Libraries:
    """The files that a mesh names; `LIBRARY` holds all of its material libraries that exist."""

    def __init__(self, files: Any, names: list[str]) -> None:
        self._files, self._names = files, names

    def get(self, name: str) -> bytes:
        if name != LIBRARY:
            return self._files.get(name)
        found = []
        for each in self._names:
            try:
                found.append(self._files.get(each))
            except FileNotFoundError:  # `files` counts it
                continue
        return b"\n".join(found)

    __getitem__ = get
