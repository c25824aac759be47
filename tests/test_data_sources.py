"""Where meshes are found, what they are, and which way is up."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from train.data import ShapeTree, tree_files
from train.data.mesh_sources import UPRIGHT, find_meshes, keep_labelled, of_category, read_labels, shape_ids
from train.data.meshes import convert, load_surface

SMALL = {"size": 32, "views": 2, "processes": 1}
BOX = trimesh.creation.box((1.0, 2.0, 3.0))


def save_textured(folder: Path, name: str, images: str) -> None:
    """A box as ShapeNet stores it: OBJ and MTL side by side, the texture in a folder, named relative to them."""
    folder.mkdir(parents=True)
    (folder / images).mkdir(parents=True)
    Image.new("RGB", (4, 4), (200, 30, 30)).save(folder / images / "texture0.jpg")
    (folder / f"{name}.mtl").write_text(f"newmtl wood\nKd 1 1 1\nmap_Kd {images}/texture0.jpg\n")
    lines = [
        f"mtllib {name}.mtl",
        *(f"v {x} {y} {z}" for x, y, z in BOX.vertices),
        "vt 0.5 0.5",
        "usemtl wood",
    ]
    lines += [f"f {a}/1 {b}/1 {c}/1" for a, b, c in BOX.faces + 1]
    (folder / f"{name}.obj").write_text("\n".join(lines))


def test_shapenet_trees_of_both_versions_with_their_textures(tmp_path):
    v1, v2 = tmp_path / "ShapeNetCore.v1", tmp_path / "ShapeNetCore.v2"
    save_textured(v1 / "03001627" / "1a6f61", "model", "images")
    save_textured(v1 / "02747177" / "ab12", "model", "images")  # trash bin: none of the paper's thirteen
    save_textured(v2 / "02691156" / "10155655850468db" / "models", "model_normalized", "../images")
    (v2 / "02691156" / "10155655850468db" / "models" / "model_normalized.solid.binvox").write_bytes(
        b"#binvox"
    )
    (v2 / "taxonomy.json").write_text("[]")
    report = convert([v1, v2], tmp_path / "out", **SMALL)
    assert not report.failures
    assert report.categories == {"02747177": 1, "chair": 1, "airplane": 1}
    shapes = [
        shape for split in tree_files.SPLITS for shape in ShapeTree(tmp_path / "out", split).iter_valid()
    ]
    assert {shape.id for shape in shapes} == {
        "03001627/1a6f61",
        "02747177/ab12",
        "02691156/10155655850468db",
    }
    for shape in shapes:
        seen = shape.depth.isfinite()
        red, green, _ = shape.images.movedim(1, 0)
        assert (red > 2 * green)[seen].float().mean() > 0.9  # the texture, not grey


def test_textures_are_found_by_slashes_of_either_kind_and_only_in_the_library(tmp_path):
    library = tmp_path / "library"
    for name, texture in (("windows", r"..\..\pictures\x.jpg"), ("thief", "../../../secret/x.jpg")):
        save_textured(library / "models" / name, "x", "images")
        (library / "models" / name / "x.mtl").write_text(f"newmtl wood\nKd 1 1 1\nmap_Kd {texture}\n")
    for folder in (library / "pictures", tmp_path / "secret"):
        folder.mkdir()
        Image.new("RGB", (4, 4), (200, 30, 30)).save(folder / "x.jpg")
    meshes, _ = find_meshes([library], tmp_path)
    textures = {
        mesh.path.parent.name: len(load_surface(mesh.path, root=mesh.root).textures) for mesh in meshes
    }
    assert textures == {"windows": 1, "thief": 0}


def test_a_shapenet_synset_as_a_zip(tmp_path):
    BOX.export(tmp_path / "model.obj")
    with zipfile.ZipFile(tmp_path / "03001627.zip", "w") as archive:
        archive.write(tmp_path / "model.obj", "03001627/1a6f61/model.obj")
    (tmp_path / "scratch").mkdir()
    meshes, _ = find_meshes([tmp_path / "03001627.zip"], tmp_path / "scratch")
    assert shape_ids(meshes) == ["03001627/1a6f61"]


def test_single_files_are_what_their_folders_say(tmp_path):
    for folder in ("sofas", "20240131", "attic"):
        (tmp_path / folder).mkdir()
        BOX.export(tmp_path / folder / "x.off")
        meshes, _ = find_meshes([tmp_path / folder / "x.off"], tmp_path)
        assert [mesh.synset for mesh in meshes] == ["04256520" if folder == "sofas" else "unknown"]


def test_a_mesh_that_is_named_twice_counts_once_and_libraries_may_share_a_name(tmp_path):
    for place in ("here", "there"):
        (tmp_path / place / "models" / "sofa").mkdir(parents=True)
        BOX.export(tmp_path / place / "models" / "sofa" / "x.off")
    here, there = tmp_path / "here" / "models", tmp_path / "there" / "models"
    meshes, _ = find_meshes([here, here / "sofa" / "x.off", here / ".." / "models", there], tmp_path)
    assert [mesh.path.resolve() for mesh in meshes] == [here / "sofa" / "x.off", there / "sofa" / "x.off"]
    first, second = shape_ids(meshes)
    assert first.startswith("04256520/x-")
    assert second == f"{first}-2"


@pytest.mark.parametrize(
    ("category", "synset"),
    [
        ("Chairs", "03001627"),
        ("03001627", "03001627"),
        ("02747177", "02747177"),
        ("garden gnome", "garden_gnome"),
    ],
)
def test_a_category_for_all(tmp_path, category, synset):
    (tmp_path / "tables").mkdir()
    BOX.export(tmp_path / "tables" / "x.off")
    meshes, _ = find_meshes([tmp_path], tmp_path)
    assert [mesh.synset for mesh in of_category(meshes, category)] == [synset]


def test_labels_without_a_library_fit_any(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        BOX.export(tmp_path / folder / "x.off")
    (tmp_path / "labels.csv").write_text("model,category\nx.off,lamp\ngone.off,lamp\n")
    meshes, _ = find_meshes([tmp_path / "one", tmp_path / "two"], tmp_path)
    kept, absent = keep_labelled(meshes, read_labels(tmp_path / "labels.csv"), tmp_path / "labels.csv")
    assert [(mesh.library, mesh.synset) for mesh in kept] == [("one", "03636649"), ("two", "03636649")]
    assert list(absent) == ["labels.csv: gone.off"]


def test_each_axis_is_turned_up_and_none_is_mirrored(tmp_path):
    BOX.export(tmp_path / "x.off")
    for up, rotation in UPRIGHT.items():
        matrix = np.eye(3) if rotation is None else np.reshape(rotation, (3, 3))
        axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
        np.testing.assert_array_equal(matrix @ axis, (0, 1, 0))
        assert np.linalg.det(matrix) == pytest.approx(1)
        (mesh,), _ = find_meshes([tmp_path / "x.off"], tmp_path, up=up)
        extents = np.ptp(load_surface(mesh.path, mesh.rotation).vertices, axis=0) * np.sqrt(14)
        assert extents[1] == pytest.approx({"x": 1, "y": 2, "z": 3}[up[-1]])


def test_a_furniture_library_says_itself_which_way_is_up(tmp_path):
    BOX.export(tmp_path / "x.obj")
    catalogue = "id#1=a\nmodel#1=/a/x.obj\nid#2=b\nmodel#2=/b/x.obj\nmodelRotation#2=1 0 0 0 0 1 0 -1 0\n"
    with zipfile.ZipFile(tmp_path / "lib.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", catalogue)
        for folder in ("a", "b"):
            archive.write(tmp_path / "x.obj", f"{folder}/x.obj")
    (tmp_path / "scratch").mkdir()
    meshes, _ = find_meshes([tmp_path / "lib.sh3f"], tmp_path / "scratch", up="-x")
    assert [mesh.rotation for mesh in meshes] == [None, (1, 0, 0, 0, 0, 1, 0, -1, 0)]
