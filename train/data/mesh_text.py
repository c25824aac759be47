"""What trimesh misses in the formats that it reads: encodings, options of textures, colours, compression."""

from __future__ import annotations

import importlib.util
import io
import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from train.data import gltf, obj_text, ply_text

# Options of a texture in an MTL file, and how many values each takes at most; those of -o, -s and -t are numbers.
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-mm": 2, "-bm": 1, "-o": 3, "-s": 3, "-t": 3, "-texres": 1,
    "-boost": 1, "-imfchan": 1, "-type": 1,
}  # fmt: skip
_DRACO = "KHR_draco_mesh_compression"


def read_obj(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an OBJ file in any encoding: only names and comments can have letters that are not ASCII."""
    content, libraries = obj_text.plain(content)
    return _load(content, "obj", obj_text.Libraries(files, libraries))


def clean_mtl(content: bytes) -> bytes:
    """An MTL file without the options of its textures, in UTF-8.

    Example:
        >>> clean_mtl(b"newmtl a\\nmap_Kd -s 2 2 2 -clamp on dark red.png\\n")
        b'newmtl a\\nmap_Kd dark red.png\\n'
    """
    lines = obj_text.as_text(content).decode().replace("\t", " ").split("\n")
    return "".join(f"{_without_options(_grey(line.strip()))}\n" for line in lines if line.strip()).encode()


def _grey(line: str) -> str:
    """A colour of one number is grey."""
    words = line.split()
    return " ".join([*words, words[1], words[1]]) if len(words) == 2 and words[0] == "Kd" else line


def _without_options(line: str) -> str:
    words = line.split()
    if len(words) < 3 or words[0].lower() != "map_kd" or words[1] not in _OPTIONS:
        return line
    rest = words[1:]
    while rest and rest[0] in _OPTIONS:
        option, *rest = rest
        for _ in range(_OPTIONS[option]):
            if len(rest) > 1 and (_OPTIONS[option] == 1 or _is_number(rest[0])):
                rest = rest[1:]
    return " ".join([words[0], *rest])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_ply(content: bytes, files: Any) -> trimesh.Scene:
    """Reads a PLY file; texture coordinates without a picture do not hide the colours of its vertices."""
    header, end, body = ply_text.plain(content).partition(b"end_header")
    if b"TextureFile" not in header:
        header = re.sub(
            rb"(?m)^(property .*\b)(s|t|u|v|texture_u|texture_v|texcoord)[ \t]*(\r?)$", rb"\1_\2\3", header
        )
    return _load(header + end + body, "ply", files)


def read_off(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an OFF file with the colours of its vertices (COFF) or faces."""
    text = re.sub(r"#.*", "", obj_text.as_text(content).decode())
    lines = [line.split() for line in text.splitlines() if line.strip()]
    match = re.fullmatch(r"(C?)OFF", lines[0][0], re.IGNORECASE)
    if not match:
        raise ValueError("does not start with OFF or COFF")
    lines[0] = lines[0][1:]
    lines = lines if lines[0] else lines[1:]
    vertex_count, face_count = map(int, lines[0][:2])
    of_vertices, of_faces = lines[1 : 1 + vertex_count], lines[1 + vertex_count :][:face_count]
    if len(of_faces) < face_count:
        raise ValueError("the file ends early")
    vertices = np.array([line[:3] for line in of_vertices], float)
    faces, colours = [], []
    for count, *rest in of_faces:
        corners, colour = rest[: int(count)], rest[int(count) :]
        for second, third in itertools.pairwise(corners[1:]):
            faces.append([corners[0], second, third])
            colours.append(colour)
    given: dict[str, Any] = {}
    if match[1]:
        given["vertex_colors"] = _colours([line[3:] for line in of_vertices])
    elif colours and all(len(colour) >= 3 for colour in colours):
        given["face_colors"] = _colours(colours)
    triangles = np.array(faces, int).reshape(-1, 3)
    return trimesh.Scene(trimesh.Trimesh(vertices, triangles, process=False, **given))


def _colours(words: list[list[str]]) -> np.ndarray:
    """(N, 3) uint8 of integers up to 255, or of floats up to 1."""
    values = np.array([each[:3] for each in words], float)
    is_float = any("." in word for each in words for word in each[:3])
    return (255 * values if is_float else values).round().clip(0, 255).astype(np.uint8)


def read_gltf(content: bytes, files: Any) -> trimesh.Scene:
    """Reads a GLB or glTF file; one compressed with Draco needs the package DracoPy."""
    required = gltf.described(content).get("extensionsRequired", ())
    if _DRACO in required and importlib.util.find_spec("DracoPy") is None:
        raise ValueError(
            "its geometry is compressed with Draco: pip install DracoPy, or save it uncompressed"
        )
    return _load(gltf.plain(content, files.get), "glb", files)


def _load(content: bytes, kind: str, files: Any) -> trimesh.Scene:
    found = trimesh.load(io.BytesIO(content), file_type=kind, resolver=files, force="scene", process=False)
    assert isinstance(found, trimesh.Scene)
    return found


def read_stl(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an STL file, in text or binary, which must be whole."""
    is_text = content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower()
    if is_text:
        if b"endsolid" not in content[-4096:].lower():
            raise ValueError("the file ends early: endsolid is missing")
    elif len(content) < 84 + 50 * (count := int.from_bytes(content[80:84], "little")) or not count:
        held = max(len(content) - 84, 0) // 50
        raise ValueError(f"neither text nor a whole binary file: it says {count} triangles and holds {held}")
    return _load(content, "stl_ascii" if is_text else "stl", files)


READERS: dict[str, Callable[[bytes, Any], trimesh.Scene]] = {
    ".obj": read_obj, ".ply": read_ply, ".off": read_off, ".glb": read_gltf, ".gltf": read_gltf,
    ".stl": read_stl,
}  # fmt: skip
"""Suffix -> reader: (content of the file, resolver of the files that it names) -> scene."""
