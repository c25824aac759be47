"""Meshes of any format become shapes: where they are found, which way is up, what is wrong with bad ones."""

import csv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trees import all_shapes

from diffpoint.io import read_points
from train.data import tree_files
from train.data.mesh_sources import (
    UPRIGHT,
    MeshFile,
    find_meshes,
    keep_labelled,
    of_category,
    read_labels,
    shape_ids,
)
from train.data.meshes import LEFT_OUT, MeshOptions, MeshReport, convert, load_surface, sample_visible
from train.data.rays import Rasteriser
from train.data.render import Orbit, Renderer, draw_camera
from train.errors import UserError

SMALL = {"size": 32, "views": 2, "processes": 1}
BOX = trimesh.creation.box((1.0, 2.0, 3.0))
SHIPPED = Path(__file__).parents[1] / "train" / "data" / "furniture_labels.csv"


def save_box(path, extents=(1.0, 2.0, 3.0)):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents).export(path)
    return path


BAD = {  # name -> content, and what is said of it
    "text.obj": ("Dear Sir or Madam,\nthis is a letter.\n", ""),
    "no faces.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
    "nan.obj": ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no area"),
    "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "no extent"),
    "triangle.obj": ("v 0 0 0\nv 1 0.3 0.2\nv 0 1 0.5\nf 1 2 3\n", "flat: all its faces lie in one plane"),
    "index.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", ""),
    "empty.glb": (b"", "cannot be read"),
    "noise.ply": (np.random.default_rng(0).bytes(500), "cannot be read"),
}


def bad_meshes(folder):
    """Each of them, a mesh thinner than a pixel, and one that is too large to be opened."""
    folder.mkdir(parents=True)
    for name, (content, _) in BAD.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    save_box(folder / "needle.obj", (1.0, 0.0002, 0.0002))
    with (folder / "huge.ply").open("wb") as file:
        file.truncate(300 << 20)  # a hole: no space is taken
    said = {name: reason for name, (_, reason) in BAD.items()}
    return said | {"needle.obj": "shows nothing: the mesh is too thin", "huge.ply": "larger than 256 MB"}


def test_good_ones_are_made_and_each_bad_one_is_named(tmp_path):
    said = bad_meshes(tmp_path / "in" / "chairs")
    for suffix in ("obj", "glb", "ply", "off", "stl"):
        save_box(tmp_path / "in" / "chairs" / f"box.{suffix}")
    save_box(tmp_path / "in" / "Möbel und mehr" / "стул 1.obj", (1.0, 2.0, 0.01))
    report = convert([tmp_path / "in"], tmp_path / "out", size=16, views=4, processes=1)
    assert report.made == 6
    assert report.failures.keys() == {f"in: chairs/{name}" for name in said}
    for name, reason in said.items():
        found = report.failures[f"in: chairs/{name}"]
        assert found
        assert reason in found
        assert name in report.summary()
    assert report.categories == {"chair": 5, "unknown": 1}
    shapes = all_shapes(tmp_path / "out")
    assert len({shape.id for shape in shapes}) == 6
    assert all(shape.id.isascii() and " " not in shape.id for shape in shapes)
    with (tmp_path / "out" / LEFT_OUT).open(newline="") as file:
        assert dict(csv.reader(file)) == report.failures | {"mesh": "reason"}
    convert([tmp_path / "in" / "chairs" / "box.obj"], tmp_path / "out", size=16, views=4, processes=1)
    assert not (tmp_path / "out" / LEFT_OUT).exists()


def test_surface_is_centred_with_diagonal_one_and_turned(tmp_path):
    path = save_box(tmp_path / "box.obj", (1.0, 2.0, 3.0))
    extents = np.ptp(load_surface(path).vertices, axis=0)
    np.testing.assert_allclose(extents, np.array([1, 2, 3]) / np.sqrt(14), atol=1e-6)
    z_up_to_y_up = (1, 0, 0, 0, 0, 1, 0, -1, 0)
    extents = np.ptp(load_surface(path, z_up_to_y_up).vertices, axis=0)
    np.testing.assert_allclose(extents, np.array([1, 3, 2]) / np.sqrt(14), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no faces.obj", r"no faces\.obj: no faces"),
        ("missing", "missing"),
        ("letter.docx", "letter"),
        ("broken.zip", "broken"),
        ("nothing", "nothing"),
    ],
)
def test_sources_without_a_usable_mesh_are_refused_and_leave_nothing(tmp_path, name, said):
    (tmp_path / "no faces.obj").write_text(BAD["no faces.obj"][0])
    (tmp_path / "letter.docx").touch()
    (tmp_path / "broken.zip").write_text("no zip")
    (tmp_path / "nothing").mkdir()
    with pytest.raises(UserError, match=said):
        convert([tmp_path / name], tmp_path / "out", **SMALL)
    assert not (tmp_path / "out").exists()


def test_an_archive_cannot_write_outside(tmp_path):
    obj = save_box(tmp_path / "box.obj").read_bytes()
    with zipfile.ZipFile(tmp_path / "library.zip", "w") as archive:
        archive.writestr("../escaped.obj", obj)
        archive.writestr("/absolute.obj", obj)
        archive.writestr(".", obj)
        archive.writestr("sofa/good.obj", obj)
    scratch = tmp_path / "deep" / "scratch"
    scratch.mkdir(parents=True)
    meshes, refused = find_meshes([tmp_path / "library.zip"], scratch)
    assert [mesh.inside for mesh in meshes] == ["sofa/good.obj"]
    outside = "its path leads out of the archive"
    assert refused == {
        "library.zip: ../escaped.obj": outside,
        "library.zip: /absolute.obj": outside,
        "library.zip: .": "its path names no file",
    }
    assert not list((tmp_path / "deep").glob("*.obj"))
    report = convert([tmp_path / "library.zip"], tmp_path / "out", **SMALL)
    assert (report.made, report.categories, len(report.failures)) == (1, {"sofa": 1}, 3)


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
    convert([tmp_path / "library.sh3f"], tmp_path / "out", size=64, views=8, processes=1)
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


def test_a_texture_lies_the_same_way_in_every_format(tmp_path):
    """A board on a foot with a picture of four colours: OBJ, GLB and glTF with files beside it."""
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:4, :4], picture[:4, 4:], picture[4:, :4] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    corners = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0, -1, -0.5)]
    uv = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0)]
    visual = trimesh.visual.TextureVisuals(
        uv=uv, material=trimesh.visual.material.SimpleMaterial(Image.fromarray(picture))
    )
    faces = [(0, 1, 2), (0, 2, 3), (0, 1, 4)]
    scene = trimesh.Scene(trimesh.Trimesh(corners, faces, visual=visual, process=False))
    scene.export(tmp_path / "x.glb")
    for suffix in ("obj", "gltf"):
        (tmp_path / suffix).mkdir()
        scene.export(tmp_path / suffix / f"x.{suffix}")
    camera = draw_camera(np.random.default_rng(0), 4, 64)
    pictures = [
        Renderer(load_surface(tmp_path / name)).render(camera).images.astype(int)
        for name in ("obj/x.obj", "gltf/x.gltf", "x.glb")
    ]
    assert np.ptp(pictures[0], axis=-1).max() > 100
    for other in pictures[1:]:
        assert (np.abs(other - pictures[0]) > 12).any(-1).mean() < 0.01


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
            ("", "c/model.obj", "lamp", "", "In any library"),
            ("", "gone.obj", "lamp", "", "Gone from all"),
        ],
    )
    report = convert([tmp_path / "lib"], tmp_path / "out", labels=labels, **SMALL)
    assert report.categories == {"chair": 1, "garden_gnome": 1, "lamp": 1}
    assert sorted(report.failures) == ["labels.csv: gone.obj", "lib: gone/model.obj"]
    ids = sorted(shape.id for shape in all_shapes(tmp_path / "out"))
    assert ids == ["03001627/a", "03636649/c", "garden_gnome/b"]


def test_meshes_without_a_label_are_made_too_and_leave_the_split_of_the_others(tmp_path):
    for number in range(12):
        save_box(tmp_path / "lib" / f"m{number}" / "model.obj")
    rows = [("lib", f"m{number}/model.obj", "chair", "", "") for number in range(8)]
    labels = write_labels(tmp_path / "labels.csv", rows)
    convert([tmp_path / "lib"], tmp_path / "few", labels=labels, **SMALL)
    report = convert([tmp_path / "lib"], tmp_path / "all", labels=labels, unlabelled=True, **SMALL)
    assert report.categories == {"chair": 8, "unknown": 4}
    for split in tree_files.SPLITS:
        few, everything = (tmp_path / name / tree_files.LISTS / split for name in ("few", "all"))
        assert (few / "03001627.list").read_text() == (everything / "03001627.list").read_text()
    with pytest.raises(UserError, match="give labels too"):
        convert([tmp_path / "lib"], tmp_path / "none", unlabelled=True, **SMALL)


def test_stretched_copies_are_other_shapes_in_the_split_of_their_mesh(tmp_path):
    for number in range(12):
        save_box(tmp_path / "lib" / f"m{number}" / "model.obj", (1.0, 1.0, 1.0))
    plain, more = tmp_path / "plain", tmp_path / "more"
    convert([tmp_path / "lib"], plain, **SMALL)
    convert([tmp_path / "lib"], more, options=MeshOptions(stretched=1), **SMALL)
    report = convert([tmp_path / "lib"], more, options=MeshOptions(stretched=2), **SMALL)
    assert (report.made, report.kept) == (12, 24)
    for split in tree_files.SPLITS:
        few, everything = (
            (tree / tree_files.LISTS / split / "unknown.list").read_text().split() for tree in (plain, more)
        )
        assert sorted(everything) == sorted(
            name + copy for name in few for copy in ("", "_stretched1", "_stretched2")
        )
    clouds = [read_points(tree_files.cloud_file(more, f"unknown/m0{copy}")) for copy in ("", "_stretched1")]
    cube, box = (cloud.amax(0) - cloud.amin(0) for cloud in clouds)
    assert cube.max() - cube.min() < 0.02 < box.max() - box.min()
    assert abs(box.norm() - 1) < 0.02
    cameras = [
        (tree_files.render_folder(more, f"unknown/m0{copy}") / "camera_0.json").read_text()
        for copy in ("", "_stretched1", "_stretched2")
    ]
    assert len(set(cameras)) == 3
    with pytest.raises(UserError, match="stretched must be between 0 and 99; got -1"):
        convert([tmp_path / "lib"], more, options=MeshOptions(stretched=-1), **SMALL)


def test_labels_that_fit_nothing_or_are_none(tmp_path):
    save_box(tmp_path / "lib" / "a.obj")
    foreign = write_labels(tmp_path / "foreign.csv", [("other", "a.obj", "chair", "", "")])
    headless = tmp_path / "headless.csv"
    headless.write_text("a,b\n1,2\n")
    for labels, message in (
        (foreign, "its libraries are other, the sources are lib"),
        (headless, "no column model, category"),
        (tmp_path / "missing.csv", "cannot be read"),
    ):
        with pytest.raises(UserError, match=message):
            convert([tmp_path / "lib"], tmp_path / "out", labels=labels, **SMALL)
    assert not (tmp_path / "out").exists()


def test_what_is_no_model_is_not_even_a_failure(tmp_path):
    names = "real.obj __MACOSX/real.obj ._real.obj out/pcdata_2048/unknown/real.ply .git/x.obj"
    for name in names.split():
        save_box(tmp_path / name)
    assert [mesh.inside for mesh in find_meshes([tmp_path], tmp_path / "none")[0]] == ["real.obj"]


def test_names_are_unique_even_where_letters_are_lost(tmp_path):
    for name in ("椅子.obj", "机.obj", "Stuhl.obj", "stuhl.obj", "a_b.obj", "a/b.obj"):
        save_box(tmp_path / name)
    ids = shape_ids(find_meshes([tmp_path], tmp_path / "none")[0])
    assert len({each.lower() for each in ids}) == 6
    assert all(each.isascii() for each in ids)


def test_a_long_list_is_cut_on_the_terminal(tmp_path):
    failures = {f"mesh {i:02d}": "no faces" for i in range(50)}
    lines = MeshReport(tmp_path, 1, 2, 3, {"train": 6}, {"chair": 6}, failures).summary().splitlines()
    assert "made 1 shapes, 2 were there, 3 are not from these sources" in lines[0]
    assert lines[1] == "50 meshes were left out:"
    assert lines[-1] == f"  and 30 others; {tmp_path / LEFT_OUT} names all"


def test_other_settings_into_the_same_folder_are_refused(tmp_path):
    save_box(tmp_path / "in" / "a.obj")
    convert([tmp_path / "in"], tmp_path / "out", **SMALL)
    for options, message in (
        (MeshOptions(up="z"), "up: 'y' there, 'z' now"),
        (MeshOptions(scale=0.1), "scale: None there, 0.1 now"),
        (MeshOptions(drop_hidden=True), "drop hidden: False there, True now"),
        (MeshOptions(orbit=Orbit(elevation_deg=(0.0, 10.0))), "elevation"),
        (MeshOptions(orbit=Orbit(distance=3.0)), "distance: 2.0 there, 3.0 now"),
        (MeshOptions(orbit=Orbit(focal=1.5)), "focal"),
    ):
        with pytest.raises(UserError, match=message):
            convert([tmp_path / "in"], tmp_path / "out", options=options, **SMALL)
    assert len(all_shapes(tmp_path / "out")) == 1


def test_a_second_run_adds_what_is_new_and_keeps_the_rest(tmp_path):
    made = []
    for name in ("a", "b", "b"):
        save_box(tmp_path / name / "model.obj")
        options = MeshOptions(category=f"{name} kind")
        report = convert([tmp_path / name], tmp_path / "out", options=options, **SMALL)
        made.append((report.made, report.kept, report.others))
        stamp = next((tmp_path / "out" / tree_files.RENDERS).glob("a_kind/*/render_0.png")).stat().st_mtime_ns
        made[-1] += (stamp,)
    assert made == [(1, 0, 0, stamp), (1, 0, 1, stamp), (0, 1, 1, stamp)]
    assert report.categories == {"a_kind": 1, "b_kind": 1}


@pytest.mark.parametrize(
    ("options", "labels", "message"),
    [
        (MeshOptions(up="w"), None, "up must be one of y, z, x, -y"),
        (MeshOptions(scale=0.0), None, "scale must be positive"),
        (MeshOptions(orbit=Orbit(distance=1.0)), None, "the frame cuts shapes"),
        (MeshOptions(category="chair"), "x.csv", "give one of them"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path, options, labels, message):
    save_box(tmp_path / "a.obj")
    with pytest.raises(UserError, match=message):
        convert(tmp_path / "a.obj", tmp_path / "out", labels=labels, options=options, **SMALL)
    assert not (tmp_path / "out").exists()


def test_the_up_axis_and_the_cameras_reach_the_views(tmp_path):
    """A mast along z, seen from the horizon: upright in the pictures, and as large as distance and focal say."""
    save_box(tmp_path / "mast.obj", (0.1, 0.1, 2.0))
    orbit = Orbit(elevation_deg=(0.0, 0.0), distance=4.0, focal=3.0)
    options = MeshOptions(up="z", orbit=orbit)
    convert(tmp_path / "mast.obj", tmp_path / "out", size=128, views=3, processes=1, options=options)
    (shape,) = all_shapes(tmp_path / "out")
    for mask in np.isfinite(shape.depth.numpy()):
        rows, columns = np.argwhere(mask).T
        assert abs(np.ptp(rows) + 1 - 3 * 128 / 4) < 4
        assert np.ptp(columns) < 12
    assert np.ptp(shape.points.numpy(), axis=0).argmax() == 1


def test_a_scale_keeps_sizes_apart_and_refuses_what_the_frame_would_cut(tmp_path):
    for name, side in (("small", 100.0), ("large", 200.0), ("huge", 900.0)):  # say, in millimetres
        save_box(tmp_path / "in" / f"{name}.obj", (side, side, side))
    report = convert([tmp_path / "in"], tmp_path / "out", options=MeshOptions(scale=0.002), **SMALL)
    sides = {shape.id[8:]: np.ptp(shape.points.numpy(), axis=0) for shape in all_shapes(tmp_path / "out")}
    np.testing.assert_allclose(sides["small"], 0.2, atol=1e-3)
    np.testing.assert_allclose(sides["large"], 0.4, atol=1e-3)
    assert list(report.failures) == ["in: huge.obj"]
    assert "radius is 1.56 world units and the frame holds 0.52" in report.failures["in: huge.obj"]


def test_hidden_points_are_dropped_as_an_option(tmp_path):
    """A closed box in an open one: nothing of what is in the closed box, but the open one's inside."""
    parts = []
    for extents, inner in (((0.4, 0.4, 0.4), True), ((0.3, 0.3, 0.3), True), ((1.0, 1.0, 1.0), False)):
        part = trimesh.creation.box(extents)
        if not inner:
            part.update_faces(~np.isclose(part.triangles_center[:, 1], 0.5))  # no lid
        parts.append(part)
    (tmp_path / "in").mkdir()
    trimesh.util.concatenate(parts).export(tmp_path / "in" / "boxes.ply")
    for name, drop in (("all", False), ("seen", True)):
        convert([tmp_path / "in"], tmp_path / name, options=MeshOptions(drop_hidden=drop), **SMALL)
    every, seen = (all_shapes(tmp_path / name)[0].points.numpy() * np.sqrt(3) for name in ("all", "seen"))
    reach = np.abs(every).max(1)
    assert np.isclose(reach, 0.15, atol=1e-3).sum() > 100  # the innermost box
    reach = np.abs(seen).max(1)
    assert len(seen) == tree_files.POINTS
    assert not np.isclose(reach, 0.15, atol=1e-3).any()
    assert np.isclose(reach, 0.2, atol=1e-3).sum() > 100  # the closed box, seen through the open side
    share = np.isclose(reach, 0.5, atol=1e-3).mean()
    assert abs(share - 5 / (5 + 6 * 0.16)) < 0.05  # all five walls, by area


def test_hidden_points_without_embree(tmp_path):
    outer, inner = trimesh.creation.box((0.5, 0.5, 0.5)), trimesh.creation.icosphere(2, radius=0.2)
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "a.ply")
    renderer = Renderer(load_surface(tmp_path / "a.ply"), Rasteriser)
    camera = draw_camera(np.random.default_rng(0), 2, 64)
    points = sample_visible(renderer, camera, 300, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(points).max(1), 0.5 / np.sqrt(3), atol=1e-6)


def save_textured(folder, name, images):
    """A box as ShapeNet stores it: OBJ and MTL side by side, the texture in a folder, named relative to them."""
    (folder / images).mkdir(parents=True)
    Image.new("RGB", (4, 4), (200, 30, 30)).save(folder / images / "texture0.jpg")
    (folder / f"{name}.mtl").write_text(f"newmtl wood\nKd 1 1 1\nmap_Kd {images}/texture0.jpg\n")
    lines = [f"mtllib {name}.mtl", "vt 0.5 0.5", "usemtl wood"]
    lines += [f"v {x} {y} {z}" for x, y, z in BOX.vertices]
    lines += [f"f {a}/1 {b}/1 {c}/1" for a, b, c in BOX.faces + 1]
    (folder / f"{name}.obj").write_text("\n".join(lines))


def test_shapenet_trees_of_both_versions_with_their_textures(tmp_path):
    v1, v2 = tmp_path / "ShapeNetCore.v1", tmp_path / "ShapeNetCore.v2"
    save_textured(v1 / "03001627" / "1a6f61", "model", "images")
    save_textured(v1 / "02747177" / "ab12", "model", "images")  # trash bin: none of the paper's thirteen
    save_textured(v2 / "02691156" / "10155655850468db" / "models", "model_normalized", "../images")
    (v2 / "02691156/10155655850468db/models/model_normalized.solid.binvox").write_bytes(b"#binvox")
    (v2 / "taxonomy.json").write_text("[]")
    report = convert([v1, v2], tmp_path / "out", **SMALL)
    assert not report.failures
    assert report.categories == {"02747177": 1, "chair": 1, "airplane": 1}
    shapes = all_shapes(tmp_path / "out")
    ids = {"03001627/1a6f61", "02747177/ab12", "02691156/10155655850468db"}
    assert {shape.id for shape in shapes} == ids
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
    surfaces = {mesh.path.parent.name: load_surface(mesh.path, root=mesh.root) for mesh in meshes}
    textures = {name: len(surface.textures) for name, surface in surfaces.items()}
    assert textures == {"windows": 1, "thief": 0}


def test_a_shapenet_synset_as_a_zip(tmp_path):
    with zipfile.ZipFile(tmp_path / "03001627.zip", "w") as archive:
        archive.write(save_box(tmp_path / "model.obj"), "03001627/1a6f61/model.obj")
    (tmp_path / "scratch").mkdir()
    meshes, _ = find_meshes([tmp_path / "03001627.zip"], tmp_path / "scratch")
    assert shape_ids(meshes) == ["03001627/1a6f61"]


@pytest.mark.parametrize(
    ("folder", "synset"), [("sofas", "04256520"), ("20240131", "unknown"), ("attic", "unknown")]
)
def test_single_files_are_what_their_folders_say(tmp_path, folder, synset):
    meshes, _ = find_meshes([save_box(tmp_path / folder / "x.off")], tmp_path)
    assert [mesh.synset for mesh in meshes] == [synset]


def test_a_mesh_that_is_named_twice_counts_once_and_libraries_may_share_a_name(tmp_path):
    for place in ("here", "there"):
        save_box(tmp_path / place / "models" / "sofa" / "x.off")
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
    save_box(tmp_path / "tables" / "x.off")
    meshes, _ = find_meshes([tmp_path], tmp_path)
    assert [mesh.synset for mesh in of_category(meshes, category)] == [synset]


def test_each_axis_is_turned_up_and_none_is_mirrored(tmp_path):
    save_box(tmp_path / "x.off")
    for up, rotation in UPRIGHT.items():
        matrix = np.eye(3) if rotation is None else np.reshape(rotation, (3, 3))
        axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
        np.testing.assert_array_equal(matrix @ axis, (0, 1, 0))
        assert np.linalg.det(matrix) == pytest.approx(1)
        (mesh,), _ = find_meshes([tmp_path / "x.off"], tmp_path, up=up)
        extents = np.ptp(load_surface(mesh.path, mesh.rotation).vertices, axis=0) * np.sqrt(14)
        assert extents[1] == pytest.approx({"x": 1, "y": 2, "z": 3}[up[-1]])


def test_a_furniture_library_says_itself_which_way_is_up(tmp_path):
    save_box(tmp_path / "x.obj")
    catalogue = "id#1=a\nmodel#1=/a/x.obj\nid#2=b\nmodel#2=/b/x.obj\nmodelRotation#2=1 0 0 0 0 1 0 -1 0\n"
    with zipfile.ZipFile(tmp_path / "lib.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", catalogue)
        for folder in ("a", "b"):
            archive.write(tmp_path / "x.obj", f"{folder}/x.obj")
    (tmp_path / "scratch").mkdir()
    meshes, _ = find_meshes([tmp_path / "lib.sh3f"], tmp_path / "scratch", up="-x")
    assert [mesh.rotation for mesh in meshes] == [None, (1, 0, 0, 0, 0, 1, 0, -1, 0)]


def labels_with(path, *turns):
    lines = [f"a.zip,m{i}.obj,chair,{turn}\n" for i, turn in enumerate(turns)]
    path.write_text("library,model,category,turn\n" + "".join(lines))
    return read_labels(path)


def matrix(rotation):
    return np.reshape(rotation, (3, 3))


def test_turns_are_right_handed_about_an_axis(tmp_path):
    none, about_x, about_y, half = labels_with(tmp_path / "labels.csv", "", "x90", "y-90", " y180")
    assert none.turn is None
    lying = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the head, the face, and the right-hand side
    standing = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    assert np.array_equal(lying @ matrix(about_x.turn).T, standing)
    assert np.array_equal(matrix(about_y.turn) @ [1, 0, 0], [0, 0, 1])
    assert np.array_equal(matrix(half.turn), np.diag([-1, 1, -1]))


def test_a_turn_follows_the_library_s_own_rotation(tmp_path):
    labels = labels_with(tmp_path / "labels.csv", "y90", "y90", "")
    own = tuple(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).ravel())  # z up -> y up
    meshes = [
        MeshFile(Path(f"m{i}.obj"), "a.zip", f"m{i}.obj", "unknown", rotation)
        for i, rotation in enumerate((own, None, own))
    ]
    (both, turn, rotation), absent = keep_labelled(meshes, labels, tmp_path / "labels.csv")
    assert not absent
    assert np.array_equal(matrix(both.rotation) @ [0, 0, 1], [0, 1, 0])  # up, which a turn about y leaves
    assert np.array_equal(matrix(both.rotation) @ [1, 0, 0], [0, 0, -1])
    assert turn.rotation == labels[1].turn
    assert rotation.rotation == own


@pytest.mark.parametrize("turn", ["90", "w90", "x90.5", "yaw"])
def test_a_turn_that_is_none_is_named(tmp_path, turn):
    with pytest.raises(
        UserError, match=r"labels\.csv: m0\.obj: the turn .* is not an axis and degrees, such as y90"
    ):
        labels_with(tmp_path / "labels.csv", turn)


def test_the_shipped_furniture_labels_are_complete_and_stand_telephones_up():
    labels = read_labels(SHIPPED)
    assert len(labels) == len({(label.library, label.model) for label in labels}) == 246
    assert len({label.synset for label in labels}) == 12
    turned = {label.model.split("/")[-1]: label for label in labels if label.turn is not None}
    for model in ("iphone.obj", "mobile.obj"):
        assert np.array_equal(matrix(turned[model].turn) @ [0, 1, 0], [0, 0, 1])
