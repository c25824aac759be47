"""Looking at data: `data check` sees whether cameras, depth maps and clouds agree, `data show` draws them."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trees import Y_TO_Z_UP, all_ids, halve, turn_clouds

from diffpoint.io import read_depth, read_points, write_depth, write_points
from train.__main__ import main
from train.data import ShapeTree, tree_files
from train.data.check import check_tree
from train.data.consistency import measure_consistency
from train.data.contact_sheet import _arranged, show, strip_of
from train.data.meshes import convert
from train.data.procedural import generate
from train.errors import UserError

FURNITURE = Path("/usr/share/sweethome3d/furniture/KatorLegaz.sh3f")


@pytest.fixture(scope="module")
def procedural(tmp_path_factory):
    out = tmp_path_factory.mktemp("check") / "data"
    generate(out, shapes=6, categories=["chair", "display"], seed=0, size=112, views=4, processes=1)
    return out


def assert_agrees(report, shapes):
    assert report.problems == []
    assert len(report.consistencies) == shapes
    assert report.inside >= 0.99
    for each in report.consistencies:
        assert each.inside >= 0.99, each
        assert each.residual < 0.01, each
    assert "no problems" in report.summary()


def test_procedural_data_agree(procedural):
    assert_agrees(check_tree(procedural), 6)


def test_mesh_data_agree(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    trimesh.creation.torus(1.0, 0.3).export(folder / "torus.obj")
    trimesh.creation.annulus(0.6, 1.0, 1.5).export(folder / "ring.glb")
    trimesh.creation.capsule(2.0, 0.4).export(folder / "capsule.ply")
    table = [trimesh.creation.box((2, 0.1, 1))]
    for x, z in ((-0.9, -0.4), (0.9, -0.4), (-0.9, 0.4), (0.9, 0.4)):
        pose = trimesh.transformations.translation_matrix((x, -0.6, z))
        table.append(trimesh.creation.box((0.08, 1.2, 0.08), transform=pose))
    trimesh.util.concatenate(table).export(folder / "table.off")
    convert([folder], tmp_path / "out", size=112, views=4, processes=1)
    assert_agrees(check_tree(tmp_path / "out"), 4)


def test_real_furniture_agrees(tmp_path):
    if not FURNITURE.is_file():
        pytest.skip("the Debian package sweethome3d-furniture is not installed")
    labels = tmp_path / "labels.csv"
    shipped = Path(__file__).parents[1] / "train" / "data" / "furniture_labels.csv"
    lines = shipped.read_text().splitlines()
    of_library = [line for line in lines if line.startswith(FURNITURE.name)]
    labels.write_text("\n".join([lines[0], *of_library[::5]]) + "\n")
    report = convert([FURNITURE], tmp_path / "out", labels=labels, size=112, views=3, processes=1)
    assert report.failures == {}
    assert_agrees(check_tree(tmp_path / "out"), report.made)


def test_each_way_to_disagree_is_seen(procedural):
    tree = ShapeTree(procedural)
    # A deep body, so that no half turn maps the shape to itself.
    shape = next(each for each in tree.iter_valid() if each.id.endswith(("_h1", "_h2")))
    assert measure_consistency(shape).holds
    flip = torch.diag(torch.tensor([1.0, 1, -1]))
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    pushed = shape.camera.cam_from_world.clone()
    pushed[:, 2, 3] += 0.02
    wrong = {
        "mirrored cloud": dataclasses.replace(shape, points=shape.points @ flip),
        "z-up cloud": dataclasses.replace(shape, points=shape.points @ turn.T),
        "larger cloud": dataclasses.replace(shape, points=shape.points * 1.1),
        "views in another order": dataclasses.replace(shape, depth=shape.depth.roll(1, 0)),
        "depth as ray length": dataclasses.replace(shape, depth=shape.depth * 1.02),
        "camera further off": dataclasses.replace(
            shape, camera=dataclasses.replace(shape.camera, cam_from_world=pushed)
        ),
        "pixels off by three": dataclasses.replace(shape, depth=shape.depth.roll(3, -1)),
    }
    for name, each in wrong.items():
        assert not measure_consistency(each).holds, name


def test_problems_are_named(procedural, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(procedural, root)
    ids = all_ids(root)
    broken, moved, unlisted, absent, doubled = ids[:5]
    (tree_files.render_folder(root, broken) / "depth_2.png").write_bytes(b"no")
    camera = tree_files.render_folder(root, moved) / "camera_0.json"
    record = json.loads(camera.read_text())
    record["cam_from_world"] = (np.diag([-1.0, -1, 1, 1]) @ np.array(record["cam_from_world"])).tolist()
    camera.write_text(json.dumps(record))
    tree_files.cloud_file(root, absent).unlink()
    for split in tree_files.SPLITS:
        for path in (root / tree_files.LISTS / split).glob("*.list"):
            lines = [line for line in path.read_text().split() if line != unlisted]
            lines += [doubled] if doubled in lines else []
            path.write_text("".join(f"{line}\n" for line in lines))
    report = check_tree(root)
    for shape, what in (
        (broken, "depth_2.png cannot be read"),
        (moved, "do not agree"),
        (unlisted, "in no list"),
        (absent, "no file"),
        (doubled, "listed 2 times"),
    ):
        assert [p for p in report.problems if p.startswith(shape) and what in p], (what, report.problems)
    assert len(report.problems) == 5
    assert "5 problems" in report.summary()


# What is done to the folder of a shape, and what the line about it says. How files can be broken: test_data_tree.py.
DAMAGES = {
    "a picture cut short": (lambda f: halve(f / "render_1.png"), r"render_1\.png cannot be read"),
    "no last view": (
        lambda f: [(f / f"{kind}_3.{end}").unlink() for kind, end in FILES],
        r"3 views, elsewhere 4$",
    ),
    "an empty mask": (
        lambda f: write_depth(f / "depth_1.png", torch.full((112, 112), torch.inf)),
        "view 1 shows nothing",
    ),
    "no background": (
        lambda f: write_depth(f / "depth_1.png", torch.full((112, 112), 2.0)),
        "view 1 has no background",
    ),
    "other depth": (
        lambda f: write_depth(f / "depth_1.png", read_depth(f / "depth_1.png") + 1),
        "do not agree",
    ),
}
FILES = (("render", "png"), ("depth", "png"), ("camera", "json"))


def test_each_kind_of_damage_is_one_line_and_the_other_shapes_stand(procedural, tmp_path, capsys):
    root = tmp_path / "data"
    shutil.copytree(procedural, root)
    trees = [ShapeTree(root, split) for split in tree_files.SPLITS]
    victim = max(trees, key=len).ids[1]
    folder, copy = tree_files.render_folder(root, victim), tmp_path / "copy"
    shutil.copytree(folder, copy)
    whole = sum(map(len, trees))
    for name, (damage, said) in DAMAGES.items():
        damage(folder)
        report = check_tree(root, processes=1)
        about = [problem for problem in report.problems if problem.startswith(victim)]
        assert [problem for problem in about if re.search(said, problem)], (name, report.problems)
        assert len(report.problems) == len(about) <= 2, (name, report.problems)
        assert sum(each.holds for each in report.consistencies if each.id != victim) == whole - 1
        shutil.rmtree(folder)
        shutil.copytree(copy, folder)
    assert check_tree(root, processes=1).problems == []
    halve(folder / "render_0.png")
    assert main(["data", "check", str(root)]) == 1
    out = capsys.readouterr().out
    assert "1 problem:" in out
    assert f"{victim}: {folder / 'render_0.png'} cannot be read" in out


def test_pictures_of_another_object_and_shapes_unlike_the_rest_are_named(procedural, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(procedural, root)
    ids = all_ids(root)
    chair = next(shape for shape in ids if shape.startswith("03001627"))
    display = next(shape for shape in ids if shape.startswith("03211117"))
    chair_image = tree_files.render_folder(root, chair) / "render_2.png"
    shutil.copy(chair_image, tree_files.render_folder(root, display) / "render_2.png")
    few = ids[-1]
    write_points(tree_files.cloud_file(root, few), read_points(tree_files.cloud_file(root, few))[::2])
    problems = check_tree(root, processes=1).problems
    assert [p for p in problems if p.startswith(f"{display}: view 2: ") and "outside the mask" in p], problems
    assert [p for p in problems if p == f"{few}: 1024 points, elsewhere 2048"], problems
    assert len(problems) == 2


def test_a_tree_of_ours_whose_clouds_were_turned_is_not_turned_back_in_silence(procedural, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(procedural, root)
    turn_clouds(root, Y_TO_Z_UP)
    report = check_tree(root, processes=1)
    said = "clouds are z-up, cameras expect y-up; not as this program wrote them: make the data again"
    assert report.frame.verdict == said
    assert f"{root}: {said}" in report.problems


def test_no_data(tmp_path):
    with pytest.raises(UserError, match="no data"):
        check_tree(tmp_path)


# Contact sheets


@pytest.fixture(scope="module")
def lamps_and_cars(tmp_path_factory):
    root = tmp_path_factory.mktemp("show") / "data"
    generate(root, shapes=6, categories=["lamp", "car"], seed=0, size=64, views=3, processes=1)
    return root


def test_a_sheet_for_each_category(lamps_and_cars, tmp_path):
    sheets = show(lamps_and_cars, tmp_path / "sheets", shapes=2)
    assert sheets == {name: tmp_path / "sheets" / f"{name}.png" for name in ("lamp", "car")}
    tall, wide, _ = np.asarray(Image.open(sheets["lamp"])).shape
    assert (tall, wide) == (2 * (18 + 144), 7 * 144)
    only = show(lamps_and_cars, tmp_path / "one", categories=["car"], shapes=50)
    assert list(only) == ["car"]
    assert np.asarray(Image.open(only["car"])).shape[0] == 3 * (18 + 144)


def test_each_cell_shows_the_object_on_white(lamps_and_cars):
    strip = strip_of(ShapeTree(lamps_and_cars, "train")[0], split="train")
    title, cells = strip[:18], strip[18:].reshape(144, 7, 144, 3).transpose(1, 0, 2, 3)
    assert 0.005 < (title < 200).any(-1).mean() < 0.2
    for cell in cells:
        assert 0.01 < (cell < 250).any(-1).mean() < 0.6
        assert (cell[:3] > 250).all()
    ink = [(cell < 250).any(-1) for cell in cells]
    views, depth, cloud, behind = ink[:4], *ink[4:]
    assert _overlap(views[0], depth) > 0.9
    assert _overlap(views[0], cloud) > 0.75
    assert _overlap(views[0], cloud) > _overlap(views[0], behind)
    assert len(np.unique(cells[4][depth].reshape(-1, 3), axis=0)) > 100  # many depths, many colours
    assert 55 < max(abs(np.argwhere(each) - 71.5).max() for each in ink) < 72  # the object fills its cells


def _overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def test_many_shapes_stand_in_columns():
    strips = [np.full((2, 10, 3), k, np.uint8) for k in range(40)]
    sheet = _arranged(strips)
    assert sheet.shape == (20 * 2, 10 + 16 + 10, 3)
    assert sheet[::2, 0, 0].tolist() == list(range(20))
    assert sheet[::2, -1, 0].tolist() == list(range(20, 40))
    assert _arranged(strips[:16]).shape == (32, 10, 3)
    assert (_arranged(strips[:39])[-1, -1] == 255).all()


def test_broken_shapes_are_left_out_and_mistakes_named(lamps_and_cars, tmp_path, capsys):
    with pytest.raises(UserError, match="no shape of chair; it has: car, lamp"):
        show(lamps_and_cars, tmp_path, categories=["chair"])
    with pytest.raises(UserError, match="shapes must be"):
        show(lamps_and_cars, tmp_path, shapes=0)
    root = tmp_path / "broken"
    generate(root, shapes=2, categories=["lamp"], seed=1, size=32, views=1, processes=1)
    folders = sorted((root / tree_files.RENDERS).glob("*/*"))
    (folders[0] / "depth_0.png").write_bytes(b"no")
    assert main(["data", "show", str(root)]) == 0
    assert "lamp: " in capsys.readouterr().out
    assert np.asarray(Image.open(root / "contact" / "lamp.png")).shape[0] == 18 + 144
    assert main(["data", "check", str(root)]) == 1
    (folders[1] / "depth_0.png").write_bytes(b"no")
    with pytest.raises(UserError, match="no shape of lamp can be read"):
        show(root)
