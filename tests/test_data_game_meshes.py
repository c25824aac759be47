"""AC3D and MD2 files: placement, colours, transparent faces, effects, concave polygons; the labels of such models."""

import csv
import struct
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from trees import all_shapes

from train.data.categories import category_of
from train.data.game_meshes import read_ac3d, read_md2
from train.data.mesh_sources import find_meshes, read_labels
from train.data.meshes import MeshError, convert, load_surface

SHIPPED = Path(__file__).parents[1] / "train" / "data" / "game_labels.csv"
HEADER = """AC3Db
MATERIAL "red paint" rgb 1 0 0  amb 0.2 0.2 0.2  emis 0 0 0  spec 0.5 0.5 0.5  shi 10  trans 0
MATERIAL "glass" rgb 0 0 1  amb 0.2 0.2 0.2  emis 0 0 0  spec 0.5 0.5 0.5  shi 10  trans 0.9
"""
TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


def no_files(name):
    raise FileNotFoundError(name)


def ac_object(vertices, surfaces, before="", kids=0, name="part"):
    """An object; surfaces are (flags, material, [(index, u, v), ...])."""
    lines = ["OBJECT poly", f'name "{name}"', *before.splitlines(), f"numvert {len(vertices)}"]
    lines += [" ".join(map(str, vertex)) for vertex in vertices]
    lines += [f"numsurf {len(surfaces)}"]
    for flags, material, corners in surfaces:
        lines += [f"SURF {flags}", f"mat {material}", f"refs {len(corners)}"]
        lines += [" ".join(map(str, corner)) for corner in corners]
    return "\n".join([*lines, f"kids {kids}", ""])


def world(*objects, kids=None):
    return HEADER + f"OBJECT world\nkids {len(objects) if kids is None else kids}\n" + "".join(objects)


def plain(indices):
    return [(index, 0, 0) for index in indices]


def triangles_of(scene):
    """Corners (F, 3, 3) and colours (F, 3) of untextured meshes."""
    meshes = scene.geometry.values()
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    return corners, np.concatenate([mesh.visual.face_colors[:, :3] for mesh in meshes])


def test_objects_stand_where_their_parents_put_them():
    """A child is turned and moved in its parent's frame; rotations multiply row vectors: x becomes the first row."""
    child = ac_object(TRIANGLE, [("0x20", 1, plain((0, 1, 2)))], "loc 0 5 0\nrot 0 0 1  0 1 0  -1 0 0")
    parent = ac_object(
        TRIANGLE, [("0x20", 0, plain((0, 1, 2)))], "rot 0 1 0  -1 0 0  0 0 1\nloc 10 0 0", kids=1
    )
    sibling = ac_object(TRIANGLE, [("0X20", 7, plain((0, 1, 2)))])
    corners, colours = triangles_of(read_ac3d(world(parent + child, sibling, kids=2).encode(), no_files))
    np.testing.assert_allclose(corners[0], [(10, 0, 0), (10, 1, 0), (9, 0, 0)], atol=1e-12)
    # the child's x turns to z, then stays; its origin (0, 5, 0) turns to (-5, 0, 0) and moves to (5, 0, 0)
    np.testing.assert_allclose(corners[1], [(5, 0, 0), (5, 0, 1), (4, 0, 0)], atol=1e-12)
    np.testing.assert_allclose(corners[2], TRIANGLE)
    assert colours.tolist() == [[255, 0, 0], [0, 0, 255], [178, 178, 178]]  # there is no material 7


def test_what_is_no_surface_is_left_out():
    """Lines, effects by their name, and text that looks like an object."""
    corners = plain((0, 1, 2))
    solid = ac_object(TRIANGLE, [("0x20", 0, corners), ("0x21", 0, corners), ("0x22", 0, corners)],
                      'data 25\nOBJECT poly\nkids 3\nnumvert\nurl "x"')  # fmt: skip
    effects = [
        ac_object(TRIANGLE, [("0x20", 0, corners)], name=name)
        for name in (
            "Wake-Stern",
            "propdisc",
            "Propeller.Fast",
            "prop_disc -shadow",
            "Chute",
            "ExternalFlame",
        )
    ]
    kept = [
        ac_object(TRIANGLE, [("0x20", 0, corners)], name=name) for name in ("propeller", "ChuteDoor", "hull")
    ]
    scene = read_ac3d(world(solid, *effects, *kept).encode(), no_files)
    assert len(triangles_of(scene)[0]) == 1 + len(kept)


def test_strips_of_torcs_have_normals_behind_their_vertices():
    vertices = [(0, 0, 0, 9, 9, 9), (1, 0, 0, 9, 9, 9), (0, 1, 0, 9, 9, 9), (1, 1, 0, 9, 9, 9)]
    corners = [(index, 0, 0, 5, 5) for index in range(4)]
    made, _ = triangles_of(read_ac3d(world(ac_object(vertices, [("0x14", 0, corners)])).encode(), no_files))
    assert sorted(map(tuple, made.reshape(-1, 3).tolist())) == sorted(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    )


def test_files_of_careless_writers_are_read():
    """Fewer children than announced, empty lines, and lines that end as on Windows."""
    part = ac_object(TRIANGLE, [("0x20", 0, plain((0, 1, 2)))]).replace("1 0 0\n", "1 0 0\n\n", 1)
    content = world(part, kids=3).replace("\n", "\r\n").encode()
    assert len(triangles_of(read_ac3d(content, no_files))[0]) == 1


def textured(tmp_path, picture, before=""):
    """A tetrahedron whose first face shows the left half of a picture and the others its right half."""
    Image.fromarray(picture).save(tmp_path / "paint.png")
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    left, right = [(0.1, 0.1), (0.4, 0.1), (0.1, 0.9)], [(0.6, 0.1), (0.9, 0.1), (0.6, 0.9)]
    faces = [((0, 1, 2), left), ((0, 1, 3), right), ((0, 2, 3), right), ((1, 2, 3), right)]
    surfaces = [
        ("0x20", 0, [(index, *uv) for index, uv in zip(face, places, strict=True)]) for face, places in faces
    ]
    path = tmp_path / "x.ac"
    path.write_text(world(ac_object(vertices, surfaces, 'texture "paint.png"\n' + before)))
    return path


def test_textures_are_repeated_shifted_and_shared(tmp_path):
    picture = np.full((4, 4, 3), 200, np.uint8)
    surface = load_surface(textured(tmp_path, picture, "texrep 2 3\ntexoff 0.5 0.25"))
    assert len(surface.textures) == 1 and (surface.face_texture == 0).all()
    np.testing.assert_allclose(surface.corner_uv[0], [(0.7, 0.55), (1.3, 0.55), (0.7, 2.95)], rtol=1e-6)


def test_faces_are_left_out_where_their_texture_is_clear(tmp_path):
    picture = np.full((8, 8, 4), 255, np.uint8)
    assert len(load_surface(textured(tmp_path, picture)).faces) == 4
    picture[:, :4, 3] = 60  # the left half
    assert len(load_surface(textured(tmp_path, picture)).faces) == 3


def test_the_paint_of_an_airline_is_used_and_no_paint_is_no_error(tmp_path):
    """FlightGear: Models/x.ac names paint.png, which lies in Textures/<airline>/."""
    (tmp_path / "Models").mkdir()
    path = textured(tmp_path / "Models", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "Models" / "paint.png").unlink()
    assert load_surface(path).corner_colours[0, 0].tolist() == [1, 0, 0]  # the material's
    for airline, value in (("B", 50), ("A", 100)):
        (tmp_path / "Textures" / airline).mkdir(parents=True)
        Image.fromarray(np.full((4, 4, 3), value, np.uint8)).save(
            tmp_path / "Textures" / airline / "paint.png"
        )
    assert load_surface(path).textures[0].max() == 100
    assert not load_surface(path, root=path.parent).textures  # not below the folder of the library


def md2(skin=".skin", corners=((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))):
    """A tetrahedron of 2 x 4 x 6 units with its top on +z, and a texture of 10 x 20 pixels."""
    packed = [(0, 0, 0), (255, 0, 0), (0, 255, 0), (0, 0, 255)]
    places = [(0, 0), (10, 0), (0, 20), (10, 20)]
    skins = skin.encode().ljust(64, b"\0") if skin else b""
    uv = b"".join(struct.pack("<2h", *place) for place in places)
    faces = b"".join(struct.pack("<6H", *face, *face) for face in corners)
    frame = struct.pack("<6f", 2 / 255, 4 / 255, 6 / 255, 1, 1, 1) + b"frame".ljust(16, b"\0")
    frame += b"".join(struct.pack("4B", *vertex, 0) for vertex in packed)
    starts = np.cumsum([68, len(skins), len(uv), len(faces)])
    sizes = (10, 20, len(frame), bool(skin), len(packed), len(places), len(corners), 0, 1)
    header = struct.pack("<4s16i", b"IDP2", 8, *sizes, *starts, 0, starts[-1] + len(frame))
    return header + skins + uv + faces + frame


def test_md2_stands_upright_with_its_skin(tmp_path):
    (mesh,) = read_md2(md2(""), no_files).geometry.values()
    np.testing.assert_allclose(
        mesh.vertices[mesh.faces][0], [(1, 1, -1), (3, 1, -1), (1, 1, -5)], atol=1e-6
    )  # x stays, the file's z is up and its y points to -z
    assert mesh.vertices[:, 1].max() == pytest.approx(7)

    picture = np.zeros((20, 10, 3), np.uint8)
    picture[0, 0] = 255, 0, 0
    Image.fromarray(picture).save(tmp_path / "skin.png")
    (tmp_path / "x.md2").write_bytes(md2())
    surface = load_surface(tmp_path / "x.md2")
    assert surface.textures[0][0, 0].tolist() == [255, 0, 0]
    np.testing.assert_allclose(surface.corner_uv[0], [(0, 1), (1, 1), (0, 0)], atol=1e-6)  # v up


BROKEN = {
    "header.ac": (b"AC3", "does not start with AC3D"),
    "short.ac": (world(ac_object(TRIANGLE, [])).encode()[:-30], "ends early"),
    "index.ac": (
        world(ac_object(TRIANGLE, [("0x20", 0, plain((0, 1, 9)))])).encode(),
        "line 18: refs to vertices",
    ),
    "word.ac": (HEADER.encode() + b"OBJET world\n", "line 4: 'OBJET' where a MATERIAL or an OBJECT"),
    "empty.ac": (world().encode(), "no faces"),
    "header.md2": (b"IDP3" + md2()[4:], "does not start with IDP2"),
    "short.md2": (md2()[:-8], "cannot be read"),
    "index.md2": (md2(corners=((0, 1, 9),)), "indices of vertices that it does not have"),
    "empty.md2": (md2(corners=()), "no faces"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_say_what_is_wrong(tmp_path, name):
    content, reason = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=reason):
        load_surface(tmp_path / name)


def test_a_tree_is_made_of_folders_and_pk3_archives(tmp_path):
    (tmp_path / "sim").mkdir()
    textured(tmp_path / "sim", np.full((4, 4, 3), 90, np.uint8))
    with zipfile.ZipFile(tmp_path / "0models.pk3", "w") as archive:
        archive.writestr("models/gun/gun.md2", md2())
    sources = [tmp_path / "sim", tmp_path / "0models.pk3"]
    (tmp_path / "scratch").mkdir()
    found, _ = find_meshes(sources, tmp_path / "scratch")
    assert [(mesh.library, mesh.inside) for mesh in found] == [
        ("sim", "x.ac"),
        ("0models.pk3", "models/gun/gun.md2"),
    ]
    labels = tmp_path / "labels.csv"
    with labels.open("w", newline="") as file:
        csv.writer(file).writerows(
            [
                ("library", "model", "category", "turn"),
                ("sim", "x.ac", "airplane", "y90"),
                ("0models.pk3", "models/gun/gun.md2", "rifle", ""),
            ]
        )
    report = convert(sources, tmp_path / "out", labels=labels, size=32, views=2, processes=1)
    assert report.categories == {"airplane": 1, "rifle": 1} and not report.failures
    assert len(all_shapes(tmp_path / "out")) == 2


def test_the_shipped_game_labels_name_each_model_once():
    labels = read_labels(SHIPPED)
    assert len(labels) == len({(label.library, label.model) for label in labels}) == 166
    counts = Counter(category_of(label.synset) for label in labels)
    assert counts.items() >= {"airplane": 100, "watercraft": 25, "rifle": 18, "car": 10}.items()
    # no two variants of one airliner, which would be in training and test
    folders = [label.model.split("/")[2] for label in labels if label.model.startswith("AI/Aircraft/")]
    assert len(folders) == len(set(folders))
