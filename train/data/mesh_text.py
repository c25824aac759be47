"""What trimesh misses in the formats that it reads: encodings, options of textures, colours, compression."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

from train.data import gltf, obj_text, ply_text
from train.data.polygons import clip_concave, triangulate

# Options of a texture in an MTL file, and how many values each takes at most; those of -o, -s and -t are numbers.
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-mm": 2, "-bm": 1, "-o": 3, "-s": 3, "-t": 3, "-texres": 1,
    "-boost": 1, "-imfchan": 1, "-type": 1,
}  # fmt: skip
_POLYGON = re.compile(rb"^f((?: +\d+(?:/\d*){0,2}){4,}) *$", re.MULTILINE)
"""A face of an OBJ file with more than three corners."""

_VERTEX = re.compile(rb"^v +(\S+) +(\S+) +(\S+)", re.MULTILINE)


def read_obj(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an OBJ file in any encoding: only names and comments can have letters that are not ASCII."""
    content, names, is_coloured = obj_text.plain(content)
    libraries = obj_text.Libraries(files, names, pictures_only=is_coloured)
    if not libraries.has_pictures:  # for texture coordinates alone trimesh makes a dark picture of its own
        content = re.sub(rb"(?m)^vt .*$", b"", content)
    return _load(_in_triangles(content), "obj", libraries)


def _in_triangles(content: bytes) -> bytes:
    """A plain OBJ file whose concave faces are written as triangles; of the others trimesh makes fans."""
    places = [face.span(1) for face in _POLYGON.finditer(content)]
    if not places:
        return content
    numbers = (float(number) for vertex in _VERTEX.finditer(content) for number in vertex.groups())
    try:
        vertices = np.fromiter(numbers, float).reshape(-1, 3)
    except ValueError:  # trimesh says what is wrong with them
        return content
    faces = [content[start:end] for start, end in places]
    sizes = np.array([len(face.split()) for face in faces])
    indices = np.array(re.sub(rb"/\S*", b"", b"".join(faces)).split()).astype(int) - 1
    pieces, at = [], 0
    for number, triangles in sorted(clip_concave(vertices, indices, sizes).items()):
        (start, end), corners = places[number], faces[number].split()
        lines = (b" " + b" ".join(corners[corner] for corner in triangle) for triangle in triangles.tolist())
        pieces += [content[at:start], b"\nf".join(lines)]
        at = end
    return b"".join([*pieces, content[at:]])


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
    if not _has_picture(header, files):
        header = re.sub(rb"(?m)^comment +TextureFile.*\n", b"", header)
        header = re.sub(
            rb"(?m)^(property .*\b)(s|t|u|v|texture_u|texture_v|texcoord)[ \t]*(\r?)$", rb"\1_\2\3", header
        )
    scene = _load(header + end + body, "ply", files)
    for mesh in scene.geometry.values():
        if isinstance(mesh, trimesh.Trimesh):
            _scale_colours(mesh)
            _cover_polygons(mesh)
    return scene


def _has_picture(header: bytes, files: Any) -> bool:
    named = re.search(rb"(?m)^comment +TextureFile +(.*)$", header)
    try:
        return named is not None and bool(files.get(named[1].decode(errors="replace")))
    except FileNotFoundError:  # `files` counts it
        return False


def _scale_colours(mesh: trimesh.Trimesh) -> None:
    """Reads again what trimesh takes for 8 bits or for [0, 1]: integers up to 65535, and floats up to 255."""
    visual = mesh.visual
    if not isinstance(visual, ColorVisuals) or visual.kind not in ("vertex", "face"):
        return
    columns = mesh.metadata["_ply_raw"][visual.kind]["data"]
    values = np.column_stack([columns[name] for name in ("red", "green", "blue")])
    top = 65535 if values.dtype.kind in "iu" else 255
    if values.max() > (255 if top == 65535 else obj_text.BRIGHTEST):
        mesh.visual = ColorVisuals(mesh, **{f"{visual.kind}_colors": values / top})


def _cover_polygons(mesh: trimesh.Trimesh) -> None:
    """Replaces the fans that trimesh made of a PLY file's concave polygons; colours go with their faces."""
    polygons = _polygons_of_ply(mesh)
    sizes = np.array([len(polygon) for polygon in polygons], int)
    if (sizes == 3).all():
        return
    # A number for each corner of each polygon, and what trimesh makes of these: so it is known which corner of the
    # file became which vertex of the mesh, and to which polygon a triangle belongs.
    starts = np.cumsum(sizes) - sizes
    fans = trimesh.geometry.triangulate_quads(np.split(np.arange(sizes.sum()), starts[1:]))
    if fans.shape != mesh.faces.shape:
        return
    vertex = np.zeros(sizes.sum(), int)
    vertex[fans] = mesh.faces
    owner = np.repeat(np.arange(len(sizes)), sizes)
    clipped = clip_concave(mesh.vertices, vertex, sizes)
    kept = fans[~np.isin(owner[fans[:, 0]], list(clipped))]
    corners = np.concatenate([kept, *(starts[number] + found for number, found in clipped.items())])
    visual = mesh.visual
    mesh.faces = vertex[corners]
    if isinstance(visual, ColorVisuals) and visual.kind == "face" and len(visual.face_colors) == len(sizes):
        mesh.visual = ColorVisuals(mesh, face_colors=visual.face_colors[owner[corners[:, 0]]])


def _polygons_of_ply(mesh: trimesh.Trimesh) -> np.ndarray | Sequence[np.ndarray]:
    """The faces as the file has them, with the file's own numbers of vertices."""
    faces = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    names = faces.dtype.names if isinstance(faces, np.ndarray) else faces
    name = next((each for each in ("vertex_indices", "vertex_index") if each in (names or ())), None)
    if name is None:
        return []
    return faces[name]["f1"] if isinstance(faces, np.ndarray) else faces[name]


def read_off(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an OFF file with the colours of its vertices (COFF) or faces; normals (NOFF) are skipped."""
    text = re.sub(r"#.*", "", obj_text.as_text(content).decode())
    lines = [line.split() for line in text.splitlines() if line.strip()]
    # ModelNet has files whose first line is "OFF490 518 0".
    match = re.fullmatch(r"(?:ST)?(C?)(N?)OFF(\d*)", lines[0][0] if lines else "", re.IGNORECASE)
    if not match:
        raise ValueError("does not start with OFF, COFF, NOFF or CNOFF")
    lines[0] = [word for word in (match[3], *lines[0][1:]) if word]
    lines = lines if lines[0] else lines[1:]
    if lines[:1] == [["BINARY"]]:
        raise ValueError("a binary OFF file: save it as text")
    vertex_count, face_count = map(int, lines[0][:2])
    of_vertices, of_faces = lines[1 : 1 + vertex_count], lines[1 + vertex_count :][:face_count]
    if len(of_faces) < face_count:
        raise ValueError("the file ends early")
    vertices = np.array([line[:3] for line in of_vertices], float)
    polygons = [[int(corner) for corner in line[1 : 1 + int(line[0])]] for line in of_faces]
    faces, colours = [], []
    for line, polygon, triangles in zip(of_faces, polygons, triangulate(vertices, polygons), strict=True):
        faces += [[polygon[corner] for corner in triangle] for triangle in triangles.tolist()]
        colours += [line[1 + len(polygon) :]] * len(triangles)
    given: dict[str, Any] = {}
    if match[1]:
        first = 6 if match[2] else 3
        given["vertex_colors"] = _colours([line[first:] for line in of_vertices])
    elif colours and all(len(colour) >= 3 for colour in colours):
        given["face_colors"] = _colours(colours)
    triangles = np.array(faces, int).reshape(-1, 3)
    return trimesh.Scene(trimesh.Trimesh(vertices, triangles, process=False, **given))


def _colours(words: list[list[str]]) -> np.ndarray:
    """(N, 3) uint8 of integers up to 255, or of floats up to 1."""
    values = np.array([each[:3] for each in words], float)
    is_float = values.max(initial=0) <= obj_text.BRIGHTEST and any(
        "." in word for each in words for word in each[:3]
    )
    return (255 * values if is_float else values).round().clip(0, 255).astype(np.uint8)


def read_gltf(content: bytes, files: Any) -> trimesh.Scene:
    """Reads a GLB or glTF file; one compressed with Draco needs the package DracoPy."""
    return _load(gltf.plain(content, files.get), "glb", files)


def _load(content: bytes, kind: str, files: Any) -> trimesh.Scene:
    found = trimesh.load(io.BytesIO(content), file_type=kind, resolver=files, force="scene", process=False)
    assert isinstance(found, trimesh.Scene)
    return found


def read_stl(content: bytes, files: Any) -> trimesh.Scene:
    """Reads an STL file, in text or binary, which must be whole."""
    count = int.from_bytes(content[80:84], "little")  # of a text, four letters: more than any file holds
    whole = 84 + 50 * count
    if count and len(content) >= whole:
        return _load(content[:whole], "stl", files)  # trimesh takes a file with more behind it for text
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096].lower():
        if b"endsolid" not in content[-4096:].lower():
            raise ValueError("the file ends early: endsolid is missing")
        return _load(content, "stl_ascii", files)
    held = max(len(content) - 84, 0) // 50
    raise ValueError(f"neither text nor a whole binary file: it says {count} triangles and holds {held}")


READERS: dict[str, Callable[[bytes, Any], trimesh.Scene]] = {
    ".obj": read_obj, ".ply": read_ply, ".off": read_off, ".glb": read_gltf, ".gltf": read_gltf,
    ".stl": read_stl,
}  # fmt: skip
"""Suffix -> reader: (content of the file, resolver of the files that it names) -> scene."""
