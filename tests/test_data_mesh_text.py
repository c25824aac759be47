"""Mesh files as other programs write them: encodings, texture options, colours, transparency, compression."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from train.data.meshes import MeshError, MeshOptions, convert, load_surface
from train.data.surface import Surface

_BOX = trimesh.exchange.obj.export_obj(trimesh.creation.box((1, 2, 3)))
_TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
_FACES = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]])
_TEXTURED = "mtllib m.mtl\nusemtl a\n" + "".join(
    [f"v {x:g} {y:g} {z:g}\n" for x, y, z in _TETRAHEDRON]
    + ["vt 0 0\nvt 1 0\nvt 0 1\n"]
    + [f"f {a + 1}/1 {b + 1}/2 {c + 1}/3\n" for a, b, c in _FACES]
)


def _colour(surface: Surface) -> list[float]:
    """Of the first corner; of the texture, if it has one."""
    if surface.textures:
        return (surface.textures[0][0, 0] / 255).tolist()
    return surface.corner_colours[0, 0].astype(float).round(3).tolist()


@pytest.mark.parametrize(
    "comment", ["# réalisé".encode("latin-1"), "# 椅子 模型".encode("gbk"), "# 椅子".encode()]
)
def test_comments_in_any_encoding(comment: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(comment + b"\n" + _BOX.encode())
    assert len(load_surface(tmp_path / "a.obj").faces) == 12


@pytest.mark.parametrize(
    "line",
    [
        "map_Kd red.png",
        "map_Kd -s 2 2 2 red.png",
        "map_kd -o 0.5 -clamp on -bm 0.2 red.png",
        "map_Kd -mm 0 1 red.png",
    ],
)
def test_options_of_a_texture_do_not_hide_it(line: str, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (255, 0, 0)).save(tmp_path / "red.png")
    (tmp_path / "m.mtl").write_text(f"newmtl a\n{line}\n")
    (tmp_path / "m.obj").write_text(_TEXTURED)
    surface = load_surface(tmp_path / "m.obj")
    assert _colour(surface) == [1, 0, 0]
    assert surface.missing_files == ()


def test_a_texture_with_spaces_in_its_name(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), (255, 0, 0)).save(tmp_path / "dark  red.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd dark  red.png\n")
    (tmp_path / "m.obj").write_text(_TEXTURED)
    assert _colour(load_surface(tmp_path / "m.obj")) == [1, 0, 0]


@pytest.mark.parametrize("name", ["broken.png", "sky.exr"])
def test_pictures_that_cannot_be_read_are_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("<html>not found")
    (tmp_path / "m.mtl").write_text(f"newmtl a\nKd 1 0 0\nmap_Kd {name}\n")
    (tmp_path / "a.obj").write_text(_TEXTURED)
    surface = load_surface(tmp_path / "a.obj")
    assert surface.missing_files == (name,)
    assert _colour(surface) == [1, 0, 0]


def test_grey_textures_of_16_bits(tmp_path: Path) -> None:
    Image.fromarray(np.full((8, 8), 51 << 8, np.uint16)).save(tmp_path / "grey.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd grey.png\n")
    (tmp_path / "a.obj").write_text(_TEXTURED)
    assert _colour(load_surface(tmp_path / "a.obj")) == [0.2, 0.2, 0.2]


def test_files_that_are_not_found_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "lib"
    folder.mkdir()
    (folder / "m.mtl").write_text("newmtl a\nKd 0 1 0\nmap_Kd gone.png\n")
    (folder / "m.obj").write_text(_TEXTURED)
    assert _colour(load_surface(folder / "m.obj")) == [0, 1, 0]
    options = {"size": 32, "views": 2, "processes": 1, "options": MeshOptions()}
    report = convert(folder, tmp_path / "out", **options)
    assert report.made == 1
    assert report.missing_files == {"lib: m.obj": ("gone.png",)}
    assert "1 meshes were made without files that they name:\n  lib: m.obj: gone.png" in report.summary()
    again = convert(folder, tmp_path / "out", **options)
    assert (again.made, again.kept, again.missing_files) == (0, 1, {})


@pytest.mark.parametrize(
    ("head", "of_vertex", "of_face"),
    [
        ("COFF\n4 4 0", "255 0 0 255", ""),
        ("COFF 4 4 0", "1.0 0.0 0.0 1.0", ""),
        ("OFF\n4 4 6", "", "255 0 0"),
        ("OFF\n4 4 6", "", "1.0 0.0 0.0 1.0"),
        ("COFF\n4 4 0", "255.0 0.0 0.0 255.0", ""),
        ("OFF4 4 6", "", "255 0 0"),  # as in ModelNet
        ("NOFF\n4 4 6", "0 0 1", "255 0 0"),
        ("STCNOFF\n4 4 6", "0 0 1 255 0 0 255 0.5 0.5", ""),
    ],
)
def test_colours_of_off_files(head: str, of_vertex: str, of_face: str, tmp_path: Path) -> None:
    vertices = [f"{x:g} {y:g} {z:g} {of_vertex}" for x, y, z in _TETRAHEDRON]
    faces = [f"3 {a} {b} {c} {of_face}" for a, b, c in _FACES]
    (tmp_path / "a.off").write_text("\n".join([head, "# a comment", *vertices, *faces, ""]))
    assert _colour(load_surface(tmp_path / "a.off")) == [1, 0, 0]


@pytest.mark.parametrize(("red", "other"), [("1 0.2 0", "0 0 1"), ("255 51 0", "0 0 255")])
def test_colours_of_obj_vertices(red: str, other: str, tmp_path: Path) -> None:
    # They go before the material's, as MeshLab writes one of grey for all.
    (tmp_path / "a.mtl").write_text("newmtl grey\nKd 0.75 0.75 0.75\n")
    vertices = [f"v {x:g} {y:g} {z:g} {red}" for x, y, z in _TETRAHEDRON]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in _FACES]
    (tmp_path / "a.obj").write_text(
        "\n".join(["mtllib a.mtl", *vertices, f"v 9 9 9 {other}", "usemtl grey", *faces])
    )
    assert _colour(load_surface(tmp_path / "a.obj")) == [1, 0.2, 0]


def test_texture_coordinates_without_a_picture_do_not_hide_colours_of_obj_vertices(tmp_path: Path) -> None:
    lines = _TEXTURED.splitlines()[1:]  # no library
    (tmp_path / "a.obj").write_text("\n".join(lines))
    assert _colour(load_surface(tmp_path / "a.obj")) == [0.7, 0.7, 0.7]  # as without texture coordinates
    lines = [f"{line} 1 0.2 0" if line.startswith("v ") else line for line in lines]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    assert _colour(load_surface(tmp_path / "a.obj")) == [1, 0.2, 0]


def test_obj_vertices_of_one_colour_do_not_hide_materials(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    vertices = [f"v {x:g} {y:g} {z:g} 1 1 1" for x, y, z in _TETRAHEDRON]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in _FACES]
    (tmp_path / "a.obj").write_text("\n".join(["mtllib a.mtl", *vertices, "usemtl red", *faces]))
    assert _colour(load_surface(tmp_path / "a.obj")) == [1, 0, 0]


@pytest.mark.parametrize(
    ("kind", "red"), [("ushort", "65535 13108 0"), ("float", "255 51 0"), ("double", "1 0.2 0")]
)
@pytest.mark.parametrize("of_faces", [False, True])
def test_colours_of_ply_files(kind: str, red: str, of_faces: bool, tmp_path: Path) -> None:
    colours = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    header = "ply\nformat ascii 1.0\nelement vertex 4\n"
    header += "".join(f"property float {name}\n" for name in "xyz") + ("" if of_faces else colours)
    header += "element face 4\nproperty list uchar int vertex_indices\n" + (colours if of_faces else "")
    vertices = [f"{x:g} {y:g} {z:g} {'' if of_faces else red}" for x, y, z in _TETRAHEDRON]
    faces = [f"3 {a} {b} {c} {red if of_faces else ''}" for a, b, c in _FACES]
    (tmp_path / "a.ply").write_text("\n".join([f"{header}end_header", *vertices, *faces, ""]))
    assert _colour(load_surface(tmp_path / "a.ply")) == [1, 0.2, 0]


def test_polygons_of_off_files(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = [
        "OFF",
        "8 6 0",
        *(f"{x} {y} {z}" for x, y, z in corners),
        *(f"4 {a} {b} {c} {d}" for a, b, c, d in sides),
    ]
    (tmp_path / "a.off").write_text("\n".join(lines))
    surface = load_surface(tmp_path / "a.off")
    assert len(surface.faces) == 12
    assert _colour(surface) == pytest.approx([0.7] * 3)
    for broken, said in (("\n".join(lines[:-1]), "ends early"), ("OF\n1 2", "does not start with OFF")):
        (tmp_path / "b.off").write_text(broken)
        with pytest.raises(MeshError, match=said):
            load_surface(tmp_path / "b.off")


@pytest.mark.parametrize("comment", ["no picture", "TextureFile gone.png"])
@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_texture_coordinates_without_a_picture_do_not_hide_colours(
    names: str, comment: str, tmp_path: Path
) -> None:
    properties = [f"property float {name}" for name in ("x y z " + names).split()]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", f"comment {comment}", "element vertex 4", *properties]
    header += ["element face 4", "property list uchar int vertex_indices", "end_header"]
    vertices = [f"{x:g} {y:g} {z:g} 0 0 255 0 0" for x, y, z in _TETRAHEDRON]
    (tmp_path / "a.ply").write_text(
        "\n".join([*header, *vertices, *(f"3 {a} {b} {c}" for a, b, c in _FACES), ""])
    )
    assert _colour(load_surface(tmp_path / "a.ply")) == [1, 0, 0]


@pytest.mark.parametrize(
    ("mode", "alpha", "expected"),
    [
        (None, 0, [1, 0, 0]),
        ("OPAQUE", 0, [1, 0, 0]),
        ("MASK", 100, [1, 1, 1]),
        ("MASK", 200, [1, 0, 0]),
        ("BLEND", 0, [1, 1, 1]),
    ],
)
def test_alpha_counts_only_where_the_material_says_so(
    mode: str | None, alpha: int, expected: list[float], tmp_path: Path
) -> None:
    material = PBRMaterial(baseColorTexture=Image.new("RGBA", (8, 8), (255, 0, 0, alpha)), alphaMode=mode)
    visual = trimesh.visual.TextureVisuals(uv=_TETRAHEDRON[:, :2], material=material)
    trimesh.Trimesh(_TETRAHEDRON, _FACES, visual=visual, process=False).export(tmp_path / "a.glb")
    assert _colour(load_surface(tmp_path / "a.glb")) == expected


def test_a_compressed_mesh_says_what_it_needs(tmp_path: Path) -> None:
    draco = "KHR_draco_mesh_compression"
    described = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": [draco]}).encode()
    described += b" " * (-len(described) % 4)
    chunk = struct.pack("<II", len(described), 0x4E4F534A) + described
    (tmp_path / "a.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk)
    with pytest.raises(MeshError, match="compressed with Draco: pip install DracoPy"):
        load_surface(tmp_path / "a.glb")
