"""OBJ files as trimesh reads them: one kind of line ends and blanks, indices from 1, one library, colours up to 1."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

LIBRARY = "materials of all libraries.mtl"

_KEYWORDS = (b"v ", b"vt ", b"vn ")
_COLOURED = re.compile(rb"(?m)^(v(?: +\S+){3})((?: +\S+){3}) *$")

BRIGHTEST = 2
"""Floats up to this are colours in [0, 1], give or take some light; larger ones are in [0, 255]."""


def as_text(content: bytes) -> bytes:
    """UTF-8 without a byte order mark, each line ended by one newline."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", errors="replace").encode()
    content = content.removeprefix(b"\xef\xbb\xbf")
    if not content.isascii():
        content = content.decode("utf-8", errors="replace").encode()
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\0", b"")


def plain(content: bytes) -> tuple[bytes, list[str], bool]:
    """An OBJ file, the names of its material libraries, for which it names `LIBRARY`, and whether its vertices have
    colours of their own, more than one.

    Raises:
        ValueError: a face with the vertex 0.
    """
    content = re.sub(rb"\\[ \t]*\n", b" ", as_text(content)).replace(b"\t", b" ")
    if re.search(rb"(?m)^ +", content):
        content = re.sub(rb"(?m)^ +", b"", content)
    if b"#" in content:
        content = re.sub(rb"(?m)^((?:v|vt|vn|f) [^#\n]*)#.*$", rb"\1", content)
    if re.search(rb"(?m)^f .*-", content):
        content = b"\n".join(_from_the_start(content))
    if re.search(rb"(?m)^f(?: .*)? 0+(?=[/ ]|$)", content):  # trimesh takes it for the last vertex
        raise ValueError("a face with the vertex 0: OBJ files count from 1")
    content, is_coloured = _in_small_colours(content)
    named = [line.decode() for line in re.findall(rb"(?m)^mtllib +(.*?) *$", content)]
    if not named:
        return content, [], is_coloured
    content = re.sub(rb"(?m)^mtllib .*$", b"", content)
    libraries = [name for line in named for name in re.findall(r"\S.*?\.mtl(?= |$)", line, re.I) or [line]]
    return f"mtllib {LIBRARY}\n".encode() + content, libraries, is_coloured


def _in_small_colours(content: bytes) -> tuple[bytes, bool]:
    """The same with colours of vertices in [0, 1], and whether these differ."""
    first = re.search(rb"(?m)^v .*$", content)
    if first is None or not _COLOURED.fullmatch(first[0]):
        return content, False
    colours = {words for _, words in _COLOURED.findall(content)}
    if max(float(word) for words in colours for word in words.split()) > BRIGHTEST:
        small = {
            words: b"".join(b" %.4f" % (float(word) / 255) for word in words.split()) for words in colours
        }
        content = _COLOURED.sub(lambda match: match[1] + small[match[2]], content)
    return content, len(colours) > 1


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
    """The files that a mesh names; `LIBRARY` holds all of its material libraries that exist.

    With `pictures_only` it holds the materials that have a picture: the others would hide the colours of vertices.

    Attributes:
        has_pictures: whether a material has one.
    """

    def __init__(self, files: Any, names: list[str], *, pictures_only: bool) -> None:
        self._files = files
        found = []
        for each in names:
            try:
                found.append(files.get(each))
            except FileNotFoundError:  # `files` counts it
                continue
        materials = re.split(rb"(?m)^(?=newmtl )", b"\n".join(found))
        with_picture = [each for each in materials if b"map_kd " in each.lower()]
        self.has_pictures = bool(with_picture)
        self._content = b"".join(with_picture if pictures_only else materials)

    def get(self, name: str) -> bytes:
        return self._content if name == LIBRARY else self._files.get(name)

    __getitem__ = get
