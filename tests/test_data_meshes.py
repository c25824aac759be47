"""Meshes of any make: good ones become shapes, bad ones are named, and none harms another."""

import csv
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from train.data import ShapeTree, tree_files
from train.data.mesh_sources import find_meshes, read_labels, shape_ids
from train.data.meshes import LEFT_OUT, MeshError, MeshOptions, MeshReport, convert, load_surface
from train.data.rasterise import Rasteriser
from train.data.render import Orbit, Renderer, draw_camera
from train.data.visible_samples import sample_visible
from train.errors import UserError

SMALL = {"size": 32, "views": 2, "processes": 1}


def save_box(path, extents=(1.0, 2.0, 3.0)):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(extents).export(path)
    return path


def all_shapes(root):
    return [shape for split in tree_files.SPLITS for shape in ShapeTree(root, split).iter_valid()]


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
    stamp = next((tmp_path / "out" / tree_files.RENDERS).glob("*/a/render_0.png")).stat().st_mtime_ns
    save_box(tmp_path / "in" / "b.obj")
    second = convert([tmp_path / "in"], tmp_path / "out", labels=None, **SMALL)
    assert (first.made, second.made, second.kept) == (1, 1, 1)
    assert next((tmp_path / "out" / tree_files.RENDERS).glob("*/a/render_0.png")).stat().st_mtime_ns == stamp


def test_unreadable_is_a_mesh_error(tmp_path):
    (tmp_path / "x.glb").write_bytes(b"glTF but not really")
    with pytest.raises(MeshError, match="cannot be read"):
        load_surface(tmp_path / "x.glb")


def test_the_shipped_furniture_labels_are_whole():
    labels = read_labels(Path(__file__).parents[1] / "train" / "data" / "furniture_labels.csv")
    assert len(labels) == 246
    assert len({(label.library, label.model) for label in labels}) == 246
    assert len({label.synset for label in labels}) == 12


def test_one_triangle_is_refused_as_flat_and_a_thin_board_is_not(tmp_path):
    (tmp_path / "triangle.obj").write_text("v 0 0 0\nv 1 0.3 0.2\nv 0 1 0.5\nf 1 2 3\n")
    with pytest.raises(MeshError, match="flat: all its faces lie in one plane"):
        load_surface(tmp_path / "triangle.obj")
    save_box(tmp_path / "board.obj", (1.0, 2.0, 0.001))
    assert len(load_surface(tmp_path / "board.obj").faces) == 12


def test_what_is_too_thin_for_its_pixels_is_named(tmp_path):
    save_box(tmp_path / "in" / "needle.obj", (1.0, 0.0002, 0.0002))
    save_box(tmp_path / "in" / "box.obj")
    report = convert([tmp_path / "in"], tmp_path / "out", size=16, views=4, processes=1)
    assert report.made == 1
    assert "shows nothing of it" in report.failures["in: needle.obj"]


def test_a_file_that_is_too_large_is_not_even_opened(tmp_path):
    with (tmp_path / "huge.ply").open("wb") as file:
        file.truncate(300 << 20)  # a hole: no space is taken
    with pytest.raises(MeshError, match="larger than 256 MB"):
        load_surface(tmp_path / "huge.ply")


def test_what_was_left_out_is_written_down(tmp_path):
    bad = tmp_path / "in" / "bad, or not.obj"
    save_box(tmp_path / "in" / "good.obj")
    bad.write_text("nothing")
    convert([tmp_path / "in"], tmp_path / "out", **SMALL)
    with (tmp_path / "out" / LEFT_OUT).open(newline="") as file:
        assert list(csv.reader(file)) == [["mesh", "reason"], ["in: bad, or not.obj", "no faces"]]
    bad.unlink()
    convert([tmp_path / "in"], tmp_path / "out", **SMALL)
    assert not (tmp_path / "out" / LEFT_OUT).exists()


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


def test_other_sources_into_the_same_folder_are_added_and_counted(tmp_path):
    for name in ("a", "b"):
        save_box(tmp_path / name / "model.obj")
        report = convert(
            [tmp_path / name], tmp_path / "out", options=MeshOptions(category=f"{name} kind"), **SMALL
        )
    assert (report.made, report.kept, report.others) == (1, 0, 1)
    assert report.categories == {"a_kind": 1, "b_kind": 1}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (MeshOptions(up="w"), "up must be one of y, z, x, -y"),
        (MeshOptions(scale=0.0), "scale must be positive"),
        (MeshOptions(orbit=Orbit(distance=1.0)), "the frame cuts shapes"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path, options, message):
    save_box(tmp_path / "a.obj")
    with pytest.raises(UserError, match=message):
        convert([tmp_path / "a.obj"], tmp_path / "out", options=options, **SMALL)
    assert not (tmp_path / "out").exists()


def test_labels_and_category_are_one_too_many(tmp_path):
    save_box(tmp_path / "a.obj")
    with pytest.raises(UserError, match="give one of them"):
        convert(
            [tmp_path], tmp_path / "out", labels=tmp_path / "x.csv", options=MeshOptions(category="chair")
        )


def test_the_up_axis_and_the_cameras_reach_the_views(tmp_path):
    """A mast along z, seen from the horizon: upright in the pictures, and as large as distance and focal say."""
    save_box(tmp_path / "mast.obj", (0.1, 0.1, 2.0))
    orbit = Orbit(elevation_deg=(0.0, 0.0), distance=4.0, focal=3.0)
    convert(
        [tmp_path / "mast.obj"],
        tmp_path / "out",
        size=128,
        views=3,
        processes=1,
        options=MeshOptions(up="z", orbit=orbit),
    )
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
    sides = {
        shape.id.split("/")[1]: np.ptp(shape.points.numpy(), axis=0) for shape in all_shapes(tmp_path / "out")
    }
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
