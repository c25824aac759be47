"""Meshes of any make: good ones become shapes, bad ones are named, and none harms another."""

import csv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from train.data import ShapeTree, store
from train.data.meshes import MeshError, convert, load_surface
from train.data.sources import find_meshes, read_labels, shape_ids
from train.errors import UserError

SMALL = {"size": 32, "views": 2, "processes": 1}


def save_box(path, extents=(1.0, 2.0, 3.0)):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents).export(path)
    return path


def all_shapes(root):
    return [shape for split in store.SPLITS for shape in ShapeTree(root, split).iter_valid()]


def bad_meshes(folder):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "text.obj").write_text("Dear Sir or Madam,\nthis is a letter.\n")
    (folder / "no faces.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (folder / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (folder / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    (folder / "index.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (folder / "empty.glb").write_bytes(b"")
    (folder / "noise.ply").write_bytes(np.random.default_rng(0).bytes(500))
    return sorted(path.name for path in folder.iterdir())


def test_good_ones_are_made_and_each_bad_one_is_named(tmp_path):
    names = bad_meshes(tmp_path / "in" / "chairs")
    for suffix in ("obj", "glb", "ply", "off", "stl"):
        save_box(tmp_path / "in" / "chairs" / f"box.{suffix}")
    save_box(tmp_path / "in" / "Möbel und mehr" / "стул 1.obj")
    report = convert([tmp_path / "in"], tmp_path / "out", labels=None, **SMALL)
    assert report.made == 6
    assert sorted(failure.rpartition("/")[2] for failure in report.failures) == names
    assert all(report.failures.values())
    for name, reason in {"nan.obj": "NaN", "no faces.obj": "no faces", "point.obj": "no extent"}.items():
        assert reason in report.failures[f"in: chairs/{name}"]
        assert name in report.summary()
    assert report.categories == {"chair": 5, "unknown": 1}
    shapes = all_shapes(tmp_path / "out")
    assert len({shape.id for shape in shapes}) == 6
    assert all(shape.id.isascii() and " " not in shape.id for shape in shapes)


def test_surface_is_centred_with_diagonal_one_and_turned(tmp_path):
    path = save_box(tmp_path / "box.obj", (1.0, 2.0, 3.0))
    extents = np.ptp(load_surface(path).vertices, axis=0)
    np.testing.assert_allclose(extents, np.array([1, 2, 3]) / np.sqrt(14), atol=1e-6)
    z_up_to_y_up = (1, 0, 0, 0, 0, 1, 0, -1, 0)
    extents = np.ptp(load_surface(path, z_up_to_y_up).vertices, axis=0)
    np.testing.assert_allclose(extents, np.array([1, 3, 2]) / np.sqrt(14), atol=1e-6)


def test_a_mesh_alone_that_is_unusable_leaves_nothing(tmp_path):
    bad_meshes(tmp_path / "in")
    with pytest.raises(UserError, match=r"no faces\.obj: no faces"):
        convert([tmp_path / "in" / "no faces.obj"], tmp_path / "out", labels=None, **SMALL)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["missing", "letter.docx", "broken.zip", "nothing"])
def test_wrong_sources_are_refused(tmp_path, name):
    (tmp_path / "letter.docx").touch()
    (tmp_path / "broken.zip").write_text("no zip")
    (tmp_path / "nothing").mkdir()
    with pytest.raises(UserError, match=name):
        convert([tmp_path / name], tmp_path / "out", labels=None, **SMALL)
    assert not (tmp_path / "out").exists()


def test_an_archive_cannot_write_outside(tmp_path):
    obj = save_box(tmp_path / "box.obj").read_bytes()
    with zipfile.ZipFile(tmp_path / "library.zip", "w") as archive:
        archive.writestr("../escaped.obj", obj)
        archive.writestr("/absolute.obj", obj)
        archive.writestr("sofa/good.obj", obj)
    scratch = tmp_path / "deep" / "scratch"
    scratch.mkdir(parents=True)
    meshes, refused = find_meshes([tmp_path / "library.zip"], scratch)
    assert [mesh.inside for mesh in meshes] == ["sofa/good.obj"]
    assert sorted(refused) == ["library.zip: ../escaped.obj", "library.zip: /absolute.obj"]
    assert not list((tmp_path / "deep").glob("*.obj"))
    report = convert([tmp_path / "library.zip"], tmp_path / "out", labels=None, **SMALL)
    assert (report.made, report.categories, len(report.failures)) == (1, {"sofa": 1}, 2)


def test_materials_and_textures_of_an_archive_reach_the_picture(tmp_path):
    """A red material on one face pair, a green texture on the other."""
    folder = tmp_path / "model"
    folder.mkdir()
    Image.new("RGB", (8, 8), (0, 255, 0)).save(folder / "green wood.png")
    (folder / "wall.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl wood\nKd 1 1 1\nmap_Kd green wood.png\n")
    (folder / "wall.obj").write_text(
        "mtllib wall.mtl\nv -1 0 0\nv 0 0 0\nv 0 1 0\nv -1 1 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "v 0 0 -0.1\nusemtl red\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\nf 1/1 2/2 7/3\n"
        "usemtl wood\nf 2/1 5/2 6/3\nf 2/1 6/3 3/4\n"
    )
    with zipfile.ZipFile(tmp_path / "library.sh3f", "w") as archive:
        for path in folder.iterdir():
            archive.write(path, f"display/{path.name}")
    convert([tmp_path / "library.sh3f"], tmp_path / "out", labels=None, size=64, views=8, processes=1)
    (shape,) = all_shapes(tmp_path / "out")
    eyes = shape.camera.position
    front = int(eyes[:, 2].argmax())
    red, green, blue = shape.images[front]
    is_red, is_green = red > green + 0.3, green > red + 0.3
    assert is_red.sum() > 100
    assert is_green.sum() > 100
    assert blue[is_red | is_green].median() < 0.1  # pixels on the edge mix with the background
    columns = [float(mask.nonzero()[:, 1].float().mean()) for mask in (is_red, is_green)]
    assert columns[0] < columns[1]


def test_vertex_and_face_colours(tmp_path):
    box = trimesh.creation.box()
    red, blue = (np.tile((*rgb, 255), (count, 1)) for rgb, count in (((255, 0, 0), 12), ((0, 0, 255), 8)))
    trimesh.Trimesh(box.vertices, box.faces, face_colors=red).export(tmp_path / "faces.ply")
    trimesh.Trimesh(box.vertices, box.faces, vertex_colors=blue).export(tmp_path / "vertices.ply")
    for name, colour in (("faces", (1, 0, 0)), ("vertices", (0, 0, 1))):
        corners = load_surface(tmp_path / f"{name}.ply").corner_colours
        np.testing.assert_allclose(corners.reshape(-1, 3), np.tile(colour, (36, 1)), atol=0.01)


def test_parts_of_a_scene_stand_where_its_graph_puts_them(tmp_path):
    scene = trimesh.Scene()
    for x in (0.0, 9.0):
        scene.add_geometry(
            trimesh.creation.box(), transform=trimesh.transformations.translation_matrix((x, 0, 0))
        )
    scene.export(tmp_path / "two.glb")
    extents = np.ptp(load_surface(tmp_path / "two.glb").vertices, axis=0)
    np.testing.assert_allclose(extents / extents[1], (10, 1, 1), rtol=1e-5)


def write_labels(path, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("library", "model", "category", "synset", "name"), *rows])
    return path


def test_labels_choose_and_name(tmp_path):
    for name in ("a", "b", "c"):
        save_box(tmp_path / "lib" / name / "model.obj")
    labels = write_labels(
        tmp_path / "labels.csv",
        [
            ("lib", "a/model.obj", "chair", "03001627", "A chair"),
            ("lib", "b/model.obj", "garden gnome", "", "A gnome"),
            ("lib", "gone/model.obj", "chair", "03001627", "Gone"),
            ("another library", "x.obj", "chair", "03001627", "Not asked for"),
        ],
    )
    report = convert([tmp_path / "lib"], tmp_path / "out", labels=labels, **SMALL)
    assert report.categories == {"chair": 1, "garden_gnome": 1}
    assert list(report.failures) == ["lib: gone/model.obj"]
    assert sorted(shape.id for shape in all_shapes(tmp_path / "out")) == ["03001627/a", "garden_gnome/b"]


def test_labels_that_fit_nothing_or_are_none(tmp_path):
    save_box(tmp_path / "lib" / "a.obj")
    foreign = write_labels(tmp_path / "foreign.csv", [("other", "a.obj", "chair", "", "")])
    headless = tmp_path / "headless.csv"
    headless.write_text("a,b\n1,2\n")
    for labels, message in (
        (foreign, "speaks of other, the sources are lib"),
        (headless, "no column model, category"),
        (tmp_path / "missing.csv", "cannot be read"),
    ):
        with pytest.raises(UserError, match=message):
            convert([tmp_path / "lib"], tmp_path / "out", labels=labels, **SMALL)
    assert not (tmp_path / "out").exists()


def test_what_is_no_model_is_not_even_a_failure(tmp_path):
    for name in (
        "real.obj",
        "__MACOSX/real.obj",
        "._real.obj",
        "out/pcdata_2048/unknown/real.ply",
        ".git/x.obj",
    ):
        save_box(tmp_path / name)
    assert [mesh.inside for mesh in find_meshes([tmp_path], tmp_path / "none")[0]] == ["real.obj"]


def test_a_shapenet_tree_keeps_its_names(tmp_path):
    save_box(tmp_path / "ShapeNetCore.v1" / "03001627" / "1a2b3c" / "model.obj")
    save_box(tmp_path / "ShapeNetCore.v1" / "02958343" / "4d5e6f" / "models" / "model_normalized.obj")
    meshes, _ = find_meshes([tmp_path / "ShapeNetCore.v1"], tmp_path)
    assert shape_ids(meshes) == ["02958343/4d5e6f", "03001627/1a2b3c"]


def test_names_are_unique_even_where_letters_are_lost(tmp_path):
    for name in ("椅子.obj", "机.obj", "Stuhl.obj", "stuhl.obj", "a_b.obj", "a/b.obj"):
        save_box(tmp_path / name)
    ids = shape_ids(find_meshes([tmp_path], tmp_path / "none")[0])
    assert len({each.lower() for each in ids}) == 6
    assert all(each.isascii() for each in ids)


def test_a_restarted_conversion_keeps_what_is_there(tmp_path):
    save_box(tmp_path / "in" / "a.obj")
    first = convert([tmp_path / "in"], tmp_path / "out", labels=None, **SMALL)
    stamp = next((tmp_path / "out" / store.RENDERS).glob("*/a/render_0.png")).stat().st_mtime_ns
    save_box(tmp_path / "in" / "b.obj")
    second = convert([tmp_path / "in"], tmp_path / "out", labels=None, **SMALL)
    assert (first.made, second.made, second.kept) == (1, 1, 1)
    assert next((tmp_path / "out" / store.RENDERS).glob("*/a/render_0.png")).stat().st_mtime_ns == stamp


def test_unreadable_is_a_mesh_error(tmp_path):
    (tmp_path / "x.glb").write_bytes(b"glTF but not really")
    with pytest.raises(MeshError, match="cannot be read"):
        load_surface(tmp_path / "x.glb")


def test_the_shipped_furniture_labels_are_whole():
    labels = read_labels(Path(__file__).parents[1] / "train" / "data" / "furniture_labels.csv")
    assert len(labels) == 246
    assert len({(label.library, label.model) for label in labels}) == 246
    assert len({label.synset for label in labels}) == 12
