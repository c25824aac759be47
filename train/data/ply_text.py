"""PLY files as trimesh reads them: what it misses are lists of several lengths, strips, and ends that are missing."""

from __future__ import annotations

import re
import struct
from typing import Any, NamedTuple

import numpy as np

_TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H", "uint16": "H",
    "int": "i", "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f", "double": "d", "float64": "d",
}  # fmt: skip
_COLOURS = {
    "diffuse_red": "red",
    "diffuse_green": "green",
    "diffuse_blue": "blue",
    "r": "red",
    "g": "green",
    "b": "blue",
}


class _Element(NamedTuple):
    name: str
    count: int
    properties: list[list[str]]
    """The words of each line after "property"."""


def plain(content: bytes) -> bytes:
    """A PLY file with the same content.

    Raises:
        ValueError: it ends early.
    """
    start = content.find(b"end_header")
    if start < 0 or content[:3] != b"ply":
        return content  # trimesh says what is wrong
    if b"\n" not in content[:start]:
        if b"ascii" not in content[:start]:
            return content
        content = content.replace(b"\r", b"\n")
    body = content.index(b"\n", start) + 1
    header = content[:body].decode("latin-1").replace("\r\n", "\n")
    for old, new in _COLOURS.items():
        header = re.sub(rf"(?m)^(property \w+ ){old}[ \t]*$", rf"\1{new}", header)
    elements = _elements(header)
    if re.search(r"(?m)^format ascii", header):
        lines = content[body:].split(b"\n")
        if sum(bool(line.strip()) for line in lines) < sum(each.count for each in elements):
            raise ValueError("the file ends early")
        rows = [line.decode("latin-1").split() for line in lines if line.strip()] if _strips(elements) else []
    else:
        order = ">" if "big" in header else "<"
        if not _strips(elements) and not _has_uneven_lists(content, body, elements, order):
            return header.encode("latin-1") + content[body:]
        rows = _binary_rows(content, body, elements, order)
    if not rows:
        return header.encode("latin-1") + content[body:]
    return _as_text(header, elements, rows)


def _elements(header: str) -> list[_Element]:
    found: list[_Element] = []
    for line in header.split("\n"):
        words = line.split()
        if words[:1] == ["element"]:
            found.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and found:
            found[-1].properties.append(words[1:])
    return found


def _strips(elements: list[_Element]) -> bool:
    return any(each.name == "tristrips" for each in elements)


def _row_format(element: _Element, order: str, lengths: list[int]) -> str:
    """The format of a row whose lists have these lengths."""
    left = iter(lengths)
    parts = [
        f"{_TYPES[words[1]]}{next(left)}{_TYPES[words[2]]}" if words[0] == "list" else _TYPES[words[0]]
        for words in element.properties
    ]
    return order + "".join(parts)


def _has_uneven_lists(content: bytes, at: int, elements: list[_Element], order: str) -> bool:
    """Whether lists of one element differ in length; trimesh takes the first length for that of all."""
    for element in elements:
        lists = [words for words in element.properties if words[0] == "list"]
        if not element.count:
            continue
        lengths = _lengths(content, at, element, order) if lists else []
        size = struct.calcsize(_row_format(element, order, lengths))
        if at + size * element.count > len(content):
            # Of rows that differ in length the first may be the longest; `_binary_rows` finds out.
            if lists:
                return True
            raise ValueError("the file ends early")
        rows = np.frombuffer(content, np.uint8, size * element.count, at).reshape(element.count, size)
        for number, place in enumerate(_places_of_lengths(element, order, lengths)):
            kind = _TYPES[lists[number][1]]
            stored = rows[:, place : place + struct.calcsize(order + kind)].tobytes()
            if (np.frombuffer(stored, order + kind) != lengths[number]).any():
                return True
        at += size * element.count
    return False


def _places_of_lengths(element: _Element, order: str, lengths: list[int]) -> list[int]:
    """Where in a row the lengths of its lists are."""
    places, done = [], 0
    for i, words in enumerate(element.properties):
        if words[0] == "list":
            before = element._replace(properties=element.properties[:i])
            places.append(struct.calcsize(_row_format(before, order, lengths[:done])))
            done += 1
    return places


def _lengths(content: bytes, at: int, element: _Element, order: str) -> list[int]:
    """The lengths of the lists in the row that begins here."""
    lengths: list[int] = []
    for words in element.properties:
        kind = _TYPES[words[1] if words[0] == "list" else words[0]]
        size = struct.calcsize(order + kind)
        if at + size > len(content):
            raise ValueError("the file ends early")
        if words[0] == "list":
            lengths.append(struct.unpack_from(order + kind, content, at)[0])
            at += size + lengths[-1] * struct.calcsize(order + _TYPES[words[2]])
        else:
            at += size
    return lengths


def _binary_rows(content: bytes, at: int, elements: list[_Element], order: str) -> list[list[Any]]:
    rows = []
    for element in elements:
        formats: dict[tuple[int, ...], struct.Struct] = {}
        for _ in range(element.count):
            lengths = _lengths(content, at, element, order)
            row = formats.setdefault(tuple(lengths), struct.Struct(_row_format(element, order, lengths)))
            if at + row.size > len(content):
                raise ValueError("the file ends early")
            rows.append(list(row.unpack_from(content, at)))
            at += row.size
    return rows


def _as_text(header: str, elements: list[_Element], rows: list[list[Any]]) -> bytes:
    """An ASCII file; triangle strips become faces."""
    header = re.sub(r"(?m)^format .*$", "format ascii 1.0", header)
    lines, done = [], 0
    for element in elements:
        own = rows[done : done + element.count]
        done += element.count
        if element.name == "tristrips":
            faces = [face for row in own for face in _faces_of_strips([int(word) for word in row[1:]])]
            header = re.sub(r"(?m)^element tristrips .*$", f"element face {len(faces)}", header)
            own = [[3, *face] for face in faces]
        lines += [" ".join(map(str, row)) for row in own]
    return (header + "\n".join(lines) + "\n").encode("latin-1")


def _faces_of_strips(indices: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of strips that are separated by -1; every other one is wound the other way round."""
    faces, first = [], 0
    for i in range(2, len(indices)):
        if -1 in indices[i - 2 : i + 1]:
            first = i + 1 if indices[i] == -1 else first
            continue
        a, b, c = indices[i - 2 : i + 1]
        faces.append((a, b, c) if (i - 2 - first) % 2 == 0 else (b, a, c))
    return faces
