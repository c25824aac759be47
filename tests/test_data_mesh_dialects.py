"""OBJ, PLY and STL files as other programs write them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from train.data.meshes import MeshError, convert, load_surface
from train.errors import UserError

_CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)], float)
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_MIXED = [(0, 1, 3), (0, 3, 2), *_QUADS[1:]]
_SIDES = np.array([1, 2, 3]) / np.sqrt(14)
_VERTICES = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in _CORNERS)
_FACES = "".join(f"f {a + 1} {b + 1} {c + 1} {d + 1}\n" for a, b, c, d in _QUADS)
_OBJ = _VERTICES + _FACES


def _is_the_box(path: Path) -> bool:
    surface = load_surface(path)
    triangles = surface.vertices[surface.faces]
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    sides = np.ptp(triangles.reshape(-1, 3), axis=0)
    return np.allclose(sides, _SIDES, atol=1e-5) and np.isclose(area.sum() / 2, 22 / 14, atol=1e-5)


def _relative(a: str) -> str:
    """Each quad after its own four vertices."""
    return "".join(
        "".join(f"v {x:g} {y:g} {z:g}\nvt 0 0\n" for x, y, z in _CORNERS[list(quad)]) + a for quad in _QUADS
    )


@pytest.mark.parametrize(
    "content",
    [
        _relative("f -4 -3 -2 -1\n").encode(),
        _relative("f -4/-4 -3/-3 -2/-2 -1/-1\n").encode(),
        b"\xef\xbb\xbf" + _OBJ.encode(),
        _OBJ.encode("utf-16"),
        _OBJ.replace("\n", "\r").encode(),
        _OBJ.replace("\n", "\r\n").replace(" ", " \\\r\n", 40).encode(),
        _OBJ.replace(" ", "\t").encode(),
        _OBJ.replace("\n", "\n  ").encode(),
        _OBJ.replace("\n", " # of the box\n").encode(),
        _OBJ.encode() + b"\0\0",
    ],
)
def test_obj_dialects(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(content)
    assert _is_the_box(tmp_path / "a.obj")


@pytest.mark.parametrize(
    "named", ["mtllib a.mtl b c.mtl\n", "mtllib a.mtl\nmtllib b c.mtl\n", "mtllib A.MTL\n"]
)
def test_materials_of_several_libraries(named: str, tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_bytes(b"\xef\xbb\xbfnewmtl\tblue\r\n\tKd\t0 0 1\r\n")
    (tmp_path / "b c.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl grey\nKd 0.6\n")
    for colour, expected in {"blue": [0, 0, 1], "red": [1, 0, 0], "grey": [0.6] * 3}.items():
        if "b c" in named or colour == "blue":
            (tmp_path / "m.obj").write_text(f"{named}{_VERTICES}usemtl {colour}\n{_FACES}")
            surface = load_surface(tmp_path / "m.obj")
            assert surface.corner_colours[0, 0] == pytest.approx(expected, abs=1e-6)
            assert surface.missing_files == ()


def _ply(faces: list[tuple[int, ...]], order: str, *, colour: str = "red green blue") -> bytes:
    """A file whose faces have colours of their own: 0, 10, 20 ... of red."""
    layout = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {layout} 1.0", "element vertex 8", *(f"property float {each}" for each in "xyz")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += [*(f"property uchar {each}" for each in colour.split()), "end_header", ""]
    content = "\n".join(lines).encode()
    if not order:
        rows = [f"{x:g} {y:g} {z:g}" for x, y, z in _CORNERS]
        rows += [f"{len(face)} {' '.join(map(str, face))} {10 * i} 0 0" for i, face in enumerate(faces)]
        return content + "\n".join(rows).encode() + b"\n"
    content += b"".join(struct.pack(f"{order}3f", *corner) for corner in _CORNERS)
    for i, face in enumerate(faces):
        content += struct.pack(f"{order}B{len(face)}i3B", len(face), *face, 10 * i, 0, 0)
    return content


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("faces", [_QUADS, _MIXED])
@pytest.mark.parametrize("colour", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
def test_ply_dialects(order: str, faces: list[tuple[int, ...]], colour: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(_ply(faces, order, colour=colour))
    assert _is_the_box(tmp_path / "a.ply")
    surface = load_surface(tmp_path / "a.ply")
    colours = (surface.corner_colours[:, 0] * 255).round()
    assert sorted(set(colours[:, 0])) == [10 * i for i in range(len(faces))]


def test_ply_triangle_strips(tmp_path: Path) -> None:
    strips = [i for a, b, c, d in _QUADS for i in (a, b, d, c, -1)]
    lines = _ply([], "").decode().split("element face")[0] + "element tristrips 1\n"
    lines += "property list int int vertex_indices\nend_header\n"
    lines += (
        "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in _CORNERS)
        + f"{len(strips)} {' '.join(map(str, strips))}\n"
    )
    (tmp_path / "a.ply").write_text(lines)
    assert _is_the_box(tmp_path / "a.ply")
    surface = load_surface(tmp_path / "a.ply")
    triangles = surface.vertices[surface.faces]
    outwards = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    assert (np.sign(outwards) == np.sign(outwards[0])).all()


def _stl(kind: Callable[[trimesh.Trimesh], str | bytes]) -> bytes:
    made = kind(trimesh.creation.box((1, 2, 3)))
    return made.encode() if isinstance(made, str) else made


_TEXT, _BINARY = _stl(trimesh.exchange.stl.export_stl_ascii), _stl(trimesh.exchange.stl.export_stl)


@pytest.mark.parametrize(
    "content",
    [
        _TEXT,
        _TEXT.upper(),
        _BINARY,
        b"solid" + _BINARY[5:],
        b"solid facet" + _BINARY[11:],
        _BINARY + b"of another program",
    ],
)
def test_stl_dialects(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(content)
    assert _is_the_box(tmp_path / "a.stl")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.ply", _ply(_QUADS, "")[:-30], "ends early"),
        ("a.ply", _ply(_QUADS, "<")[:-30], "ends early"),
        ("a.ply", _ply(_MIXED, ">")[:-30], "ends early"),
        ("a.stl", _TEXT[:-300], "ends early"),
        ("a.stl", b"solid" + _BINARY[5:-60], "says 12 triangles and holds 10"),
        ("a.stl", b"", "holds 0"),
        ("a.off", b"", "does not start with OFF"),
        ("a.off", b"OFF BINARY\n" + bytes(12), "save it as text"),
        ("a.obj", _VERTICES.encode() + b"f 1 2 3\nf 2/1 3/1 0/1\n", "count from 1"),
        ("a.obj", _VERTICES.encode(), "no faces: points and lines"),
        ("a.obj", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
    ],
)
def test_files_that_are_not_whole_meshes_say_so(name: str, content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=said):
        load_surface(tmp_path / name)


def test_a_source_without_meshes_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "a.fbx").write_bytes(b"")
    with pytest.raises(UserError, match=r"no meshes in .*; looked for \.obj, \.glb"):
        convert(tmp_path, tmp_path / "out")
