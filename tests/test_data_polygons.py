"""Faces with more than three corners are covered once, whatever their outline and the format of the file."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from train.data.meshes import MeshError, load_surface
from train.data.polygons import triangulate
from train.data.surface import Surface

L = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (0, 2)]  # area 4; the fan from its first corner has area 5
COMB = [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
ARROW = [(0, 0), (2, 1), (4, 0), (2, 4)]
# A square hole, as programs write it whose polygons have no holes: along a cut and back.
RING = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]
ON_A_SIDE = [
    (0, 0),
    (1, 0),
    (2, 0),
    (2, 2),
    (1, 2),
    (1, 1),
    (1, 1),
    (0, 1),
]  # on a line, and twice at one place


def in_space(outline, axis: int = 2, tilt: float = 0.0) -> np.ndarray:
    points = np.insert(np.array(outline, float), axis, 2.0, axis=1)
    points[:, axis] += tilt * points[:, (axis + 1) % 3]
    return points


def vector_areas(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("outline, area", [(L, 4), (COMB, 11), (RING, 8), (ON_A_SIDE, 3)])
def test_a_polygon_is_covered_once_and_faces_where_it_faced(outline, area, axis, step):
    """Whatever corner comes first. All triangles face one way: none lies on another or outside."""
    for start in range(len(outline)):
        polygon = np.roll(in_space(outline, axis, 0.1), -start, axis=0)[::step]
        (triangles,) = triangulate(polygon, [range(len(polygon))])
        areas = vector_areas(polygon[triangles])
        seen = areas[:, axis] * step * (-1 if axis == 1 else 1)
        assert (seen > -1e-12).all()
        assert seen.sum() == pytest.approx(area)


def test_what_a_fan_covers_stays_a_fan():
    square, bent = in_space([(0, 0), (2, 0), (2, 2), (0, 2)]), in_space([(0, 0), (2, 0), (2, 2), (0, 2)])
    bent[1, 2] += 0.3
    turn = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    heptagon = in_space(np.stack((np.cos(turn), np.sin(turn)), axis=1), tilt=0.3).round(6)
    halved = in_space([(0, 0), (1, 0), (2, 0), (2, 2), (0, 2)])
    arrow = in_space([(0, 0), (2, -1), (0, 3), (-2, -1)])  # concave at its first corner, where the fan starts
    for polygon in (square, bent, heptagon, halved, arrow):
        fan = [[0, i, i + 1] for i in range(1, len(polygon) - 1)]
        assert triangulate(polygon, [range(len(polygon))])[0].tolist() == fan


@pytest.mark.parametrize(
    "polygon",
    [
        [(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)],  # crosses itself and has no area
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0.5, 0, 0)],  # a line there and back
        [(1, 1, 1)] * 5,
        [(0, 0, 0), (1, 0, 0), (np.nan, 1, 0), (0, 1, 0)],
        [(0, 0, 0), (1e200, 0, 0), (1e199, 1e199, 0), (0, 1e200, 0)],
        [(0, 0, 0), (1e-200, 0, 0), (1e-201, 1e-201, 0), (0, 1e-200, 0)],
    ],
)
def test_a_degenerate_polygon_is_a_fan(polygon):
    assert [len(each) for each in triangulate(np.array(polygon), [range(len(polygon))])] == [len(polygon) - 2]


def test_too_few_corners_and_vertices_that_do_not_exist():
    none, none_either, triangle, beyond = triangulate(in_space(L), [[], [0, 1], [0, 1, 2], [0, 1, 2, 9]])
    assert none.shape == none_either.shape == (0, 3)
    assert triangle.tolist() == [[0, 1, 2]]
    assert beyond.tolist() == [[0, 1, 2], [0, 2, 3]]


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=9))
def test_any_corners_become_triangles_of_them(corners):
    (triangles,) = triangulate(np.array(corners, float), [range(len(corners))])
    assert 1 <= len(triangles) <= len(corners) - 2
    assert triangles.min() >= 0
    assert triangles.max() < len(corners)


# In files: a prism over a concave polygon.


def prism(outline) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and faces, which look outwards."""
    count = len(outline)
    low, high = (np.insert(np.array(outline, float), 2, z, axis=1) for z in (0.0, 1.0))
    sides = [[i, (i + 1) % count, count + (i + 1) % count, count + i] for i in range(count)]
    return np.concatenate((low, high)), [list(range(count))[::-1], list(range(count, 2 * count)), *sides]


def write_obj(path: Path, vertices, faces) -> None:
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices]
    path.write_text("\n".join([*lines, *("f " + " ".join(str(i + 1) for i in face) for face in faces), ""]))


def write_relative_obj(path: Path, vertices, faces) -> None:
    """Vertices counted from the last; long lines continued; lines that end as on Windows."""
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices]
    lines += ["f " + " \\\n".join(str(i - len(vertices)) for i in face) for face in faces]
    path.write_bytes("\r\n".join([*lines, ""]).replace("\\\n", "\\\r\n").encode())


def write_off(path: Path, vertices, faces) -> None:
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0", *(f"{x:g} {y:g} {z:g}" for x, y, z in vertices)]
    path.write_text("\n".join([*lines, *(" ".join(map(str, [len(face), *face])) for face in faces), ""]))


def ply_header(kind: str, vertices, faces, *properties: str) -> list[str]:
    header = ["ply", f"format {kind} 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", *properties]
    return [*header, "end_header"]


def write_ply(path: Path, vertices, faces) -> None:
    lines = [" ".join(map(str, row)) for row in (*vertices, *([len(face), *face] for face in faces))]
    path.write_text("\n".join([*ply_header("ascii", vertices, faces), *lines, ""]))


def write_binary_ply(path: Path, vertices, faces) -> None:
    content = b"".join(struct.pack("<3f", *row) for row in vertices)
    content += b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    path.write_bytes("\n".join([*ply_header("binary_little_endian", vertices, faces), ""]).encode() + content)


def write_ac(path: Path, vertices, faces) -> None:
    lines = ["AC3Db", 'MATERIAL "" rgb 1 1 1', "OBJECT poly", f"numvert {len(vertices)}"]
    lines += [*(f"{x:g} {y:g} {z:g}" for x, y, z in vertices), f"numsurf {len(faces)}"]
    for face in faces:
        lines += ["SURF 0x0", "mat 0", f"refs {len(face)}", *(f"{i} 0 0" for i in face)]
    path.write_text("\n".join([*lines, "kids 0", ""]))


WRITERS = {
    "a.obj": write_obj, "relative.obj": write_relative_obj, "a.off": write_off,
    "a.ply": write_ply, "binary.ply": write_binary_ply, "a.ac": write_ac,
}  # fmt: skip


def area_and_volume(surface: Surface) -> tuple[float, float]:
    corners = surface.vertices[surface.faces]
    areas = vector_areas(corners)
    return np.linalg.norm(areas, axis=1).sum(), (areas * corners[:, 0]).sum() / 3


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("outline, area, around", [(L, 4, 10), (COMB, 11, 24), (ARROW, 6, 6 * 5**0.5)])
def test_a_concave_face_of_a_file_does_not_spill_over_its_notch(name, outline, area, around, tmp_path):
    vertices, faces = prism(outline)
    WRITERS[name](tmp_path / name, vertices, faces)
    surface = load_surface(tmp_path / name, scale=1.0)
    assert area_and_volume(surface) == pytest.approx((2 * area + around, area))
    assert len(surface.faces) == 4 * len(outline) - 4


@pytest.mark.parametrize("name", WRITERS)
def test_a_convex_face_of_a_file_is_a_fan_as_ever(name, tmp_path):
    outline = [(0, 0), (2, 0), (3, 2), (1, 3), (-1, 2)]
    vertices, faces = prism(outline)
    WRITERS[name](tmp_path / name, vertices, faces)
    surface = load_surface(tmp_path / name, scale=1.0)
    middle = (vertices.max(0) + vertices.min(0)) / 2
    fans = [vertices[[face[0], face[i], face[i + 1]]] for face in faces for i in range(1, len(face) - 1)]
    expected = {frozenset(map(tuple, (fan - middle).round(6))) for fan in fans}
    assert {
        frozenset(map(tuple, corners.round(6))) for corners in surface.vertices[surface.faces]
    } == expected


def test_texture_coordinates_of_obj_files_stay_at_their_corners(tmp_path):
    """The picture lies over the L as its own coordinates say, whatever triangles cover it."""
    vertices, faces = prism(L)
    Image.new("RGB", (8, 8), (255, 0, 0)).save(tmp_path / "red.png")
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd red.png\n")
    lines = ["mtllib m.mtl", *(f"v {x:g} {y:g} {z:g}" for x, y, z in vertices)]
    lines += [f"vt {x / 3 + z / 8:g} {y / 2:g}" for x, y, z in vertices]
    lines += [
        f"vt {x / 6:g} {y / 4:g}" for x, y, _ in vertices
    ]  # of the sides, which share vertices with the ends
    lines += ["vn 0 0 1", "usemtl a"]
    for number, face in enumerate(faces):
        shift = 1 if number < 2 else 1 + len(vertices)
        lines.append("f " + " ".join(f"{i + 1}/{i + shift}/1" for i in face))
    (tmp_path / "a.obj").write_text("\n".join([*lines, ""]))
    surface = load_surface(tmp_path / "a.obj", scale=1.0)
    corners = surface.vertices[surface.faces] + vertices.max(0) / 2
    assert area_and_volume(surface) == pytest.approx((18, 4))
    is_end = np.ptp(corners[..., 2], axis=1) < 1e-9
    x, y, z = np.moveaxis(corners, 2, 0)
    ends, sides = np.stack((x / 3 + z / 8, y / 2), axis=2), np.stack((x / 6, y / 4), axis=2)
    np.testing.assert_allclose(surface.corner_uv, np.where(is_end[:, None, None], ends, sides), atol=1e-5)


@pytest.mark.parametrize("outline", [L, L[:5]])
def test_colours_of_faces_of_ply_files_stay_on_their_faces(outline, tmp_path):
    """The ends are red, the sides green; polygons of several sizes, and of one."""
    vertices, faces = prism(outline)
    for kept, expected in (
        (faces, {0.0: "red", 1.0: "red"}),
        (faces[2:], {}),
        (faces[:2], {0.0: "red", 1.0: "red"}),
    ):
        header = ply_header(
            "ascii", vertices, kept, *(f"property uchar {c}" for c in ("red", "green", "blue"))
        )
        colours = [(255, 0, 0) if len(face) > 4 else (0, 255, 0) for face in kept]
        rows = [[len(face), *face, *colour] for face, colour in zip(kept, colours, strict=True)]
        lines = [" ".join(map(str, row)) for row in (*vertices, *rows)]
        (tmp_path / "a.ply").write_text("\n".join([*header, *lines, ""]))
        surface = load_surface(tmp_path / "a.ply", scale=1.0)
        heights = surface.vertices[surface.faces][..., 2] + vertices[:, 2].max() / 2
        for height, colour in zip(heights, surface.corner_colours, strict=True):
            is_red = np.ptp(height) < 1e-9 and height[0].round(6) in expected
            assert colour.tolist() == [[1, 0, 0] if is_red else [0, 1, 0]] * 3


def test_texture_coordinates_of_ply_files_stay_at_their_corners(tmp_path):
    vertices, faces = prism(ARROW)
    Image.new("RGB", (8, 8), (255, 0, 0)).save(tmp_path / "red.png")
    header = ply_header("ascii", vertices, faces, "property list uchar float texcoord")
    header.insert(2, "comment TextureFile red.png")
    places = [[c for i in face for c in (vertices[i, 0] / 4, vertices[i, 1] / 4)] for face in faces]
    rows = [[len(face), *face, len(uv), *uv] for face, uv in zip(faces, places, strict=True)]
    lines = [" ".join(map(str, row)) for row in (*vertices, *rows)]
    (tmp_path / "a.ply").write_text("\n".join([*header, *lines, ""]))
    surface = load_surface(tmp_path / "a.ply", scale=1.0)
    assert area_and_volume(surface)[1] == pytest.approx(6)
    corners = surface.vertices[surface.faces] + vertices.max(0) / 2
    np.testing.assert_allclose(surface.corner_uv, corners[..., :2] / 4, atol=1e-6)


def test_a_face_that_cannot_be_read_is_left_to_the_reader(tmp_path):
    """Of the polygons with vertices that do not exist nothing is rewritten, and the mesh is refused as ever."""
    vertices, faces = prism(L)
    for name in ("a.obj", "a.off", "a.ply"):
        WRITERS[name](tmp_path / name, vertices, [*faces, [0, 1, 2, 99]])
        with pytest.raises(MeshError):
            load_surface(tmp_path / name)


def test_what_stands_between_the_faces_of_an_obj_file_stays_there(tmp_path):
    """Also faces that are written before some of their vertices, and faces that are commented out."""
    vertices, faces = prism(L)
    points = [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices]
    first, *others = ["f " + " ".join(f"{i + 1}" for i in face) for face in faces]
    lines = [*points[:4], first, "s off", "g a b", *points[4:], "# f 1 2 3 4", *others]
    (tmp_path / "a.obj").write_text("\n".join([*lines, ""]))
    surface = load_surface(tmp_path / "a.obj", scale=1.0)
    assert area_and_volume(surface) == pytest.approx((18, 4))
