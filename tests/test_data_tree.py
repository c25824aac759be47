"""The dataset on disk: what is written is read back, what is broken is named and skipped."""

import json
import shutil

import numpy as np
import pytest
import scipy.io
import torch
import trimesh
from trees import all_ids, all_shapes, halve

from diffpoint.io import write_depth
from train.data import ShapeError, ShapeTree, tree_files
from train.data.batches import load_split
from train.data.render import Views, orbit_camera
from train.data.tree import read_shape
from train.errors import UserError

SIZE = 16


def write(root, shape, *, seed=0, views=2):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1.5, 2.5, (views, SIZE, SIZE)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.5] = np.inf
    images = rng.integers(0, 256, (views, SIZE, SIZE, 3), dtype=np.uint8)
    camera = orbit_camera(rng.uniform(0, 360, views), rng.uniform(-20, 40, views), SIZE)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    written = Views(images, depth, camera)
    tree_files.write_shape(root, shape, written, points)
    return written, points


@pytest.fixture
def root(tmp_path):
    for number in range(10):
        write(tmp_path, f"03001627/chair{number}", seed=number)
    write(tmp_path, "03211117/display0")
    tree_files.write_lists(tmp_path, seed=0)
    return tmp_path


def test_round_trip(tmp_path):
    written, points = write(tmp_path, "03001627/one")
    tree_files.write_lists(tmp_path, seed=0)
    (shape,) = all_shapes(tmp_path)
    assert (shape.id, shape.category) == ("03001627/one", "chair")
    np.testing.assert_array_equal((shape.images.numpy() * 255).round(), written.images.transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(np.isfinite(shape.depth.numpy()), np.isfinite(written.depth))
    seen = np.isfinite(written.depth)
    np.testing.assert_allclose(shape.depth.numpy()[seen], written.depth[seen], atol=10 / 65535)
    np.testing.assert_allclose(shape.camera.K, written.camera.K, atol=1e-6)
    np.testing.assert_allclose(shape.camera.cam_from_world, written.camera.cam_from_world, atol=1e-6)
    assert (shape.camera.height, shape.camera.width) == (SIZE, SIZE)
    np.testing.assert_array_equal(shape.points, points)


def test_a_shape_appears_complete_or_not_at_all(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(tree_files, "write_points", fail)
    with pytest.raises(OSError, match="disk full"):
        write(tmp_path, "03001627/one")
    assert not tree_files.is_written(tmp_path, "03001627/one")
    assert list((tmp_path / tree_files.RENDERS / "03001627").iterdir()) == []


def test_leftovers_of_a_killed_run_are_cleared_and_never_listed(tmp_path):
    tree_files.prepare_output(tmp_path / "data", {"size": SIZE})
    write(tmp_path / "data", "03001627/one")
    leftover = tmp_path / "data" / tree_files.RENDERS / "03001627" / ".two.0badf00d.tmp"
    leftover.mkdir()
    assert tree_files.write_lists(tmp_path / "data", seed=0)["train"].keys() == {"03001627"}
    assert len(all_ids(tmp_path / "data")) == 1
    tree_files.prepare_output(tmp_path / "data", {"size": SIZE})
    assert not leftover.exists()


def test_other_settings_or_a_foreign_folder_are_refused(tmp_path):
    tree_files.prepare_output(tmp_path / "data", {"size": SIZE})
    with pytest.raises(UserError, match="size: 16 there, 32 now"):
        tree_files.prepare_output(tmp_path / "data", {"size": 32})
    (tmp_path / "data" / "made_with.json").write_text("{")
    with pytest.raises(UserError, match="cannot be read"):
        tree_files.prepare_output(tmp_path / "data", {"size": SIZE})
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UserError, match="choose"):
            tree_files.prepare_output(out, {"size": SIZE})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(UserError, match="no dataset"):
        tree_files.prepare_output(tmp_path / "mine", {"size": SIZE})


@pytest.mark.parametrize("count", [5, 6, 12])
def test_split_leaves_no_part_empty(count):
    for seed in range(30):
        split_of = tree_files.split_shapes([f"03001627/m{i}" for i in range(count)], seed=seed)
        assert set(split_of.values()) == set(tree_files.SPLITS)


def test_split_has_its_shares_is_seeded_and_stays_when_shapes_are_added():
    shapes = [f"03001627/m{i}" for i in range(2000)]
    split_of = tree_files.split_shapes(shapes, seed=0)
    shares = {split: list(split_of.values()).count(split) / 2000 for split in tree_files.SPLITS}
    assert shares == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.03)
    assert tree_files.split_shapes(shapes[:1000], seed=0) == {
        shape: split_of[shape] for shape in shapes[:1000]
    }
    assert tree_files.split_shapes(shapes, seed=1) != split_of


def test_hidden_variants_of_one_object_stay_in_one_split():
    split_of = tree_files.split_shapes([f"03001627/m{i}_h{k}" for i in range(50) for k in range(3)], seed=0)
    for i in range(50):
        assert len({split_of[f"03001627/m{i}_h{k}"] for k in range(3)}) == 1


def test_categories_by_name_and_synset(root):
    for categories in (["display"], ["03211117"]):
        assert sum(len(ShapeTree(root, split, categories)) for split in tree_files.SPLITS) == 1
    with pytest.raises(UserError, match=r"no category 'hat'.*it has: chair, display"):
        ShapeTree(root, "train", ["hat"])


def test_no_data_says_how_to_make_some(tmp_path):
    with pytest.raises(UserError, match="python -m train data"):
        ShapeTree(tmp_path / "nothing")
    write(tmp_path, "03001627/one")
    with pytest.raises(UserError, match="incomplete: no data_list"):
        ShapeTree(tmp_path)


OUTSIDE = ["../../other/03001627/chair0", "/etc/passwd", "03001627/a/b", "03001627/", "..", "a\\b/c"]


def test_lines_of_a_list_that_lead_elsewhere_are_refused_by_name(root):
    """None of them is looked for, in the tree or in the folder of prepared shapes beside it."""
    shutil.copytree(root, root.parent / "other" / tree_files.RENDERS)  # what the first would find
    with (root / tree_files.LISTS / "train" / "03001627.list").open("a") as file:
        file.write("\n".join(OUTSIDE))
    tree = ShapeTree(root)
    names = [line if "/" in line else f"03001627/{line}" for line in OUTSIDE]
    assert list(tree.skipped) == names
    assert all("not of the form <synset>/<model>" in reason for reason in tree.skipped.values())
    assert not set(names) & set(tree.ids)
    assert len(load_split(root, "train", image_size=(16, 16), map_size=16, progress=False)) == len(tree)
    for name in names:
        with pytest.raises(ShapeError, match="not of the form"):
            read_shape(root, name)


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


BREAKAGES = {
    "truncated image": ("render_1.png", halve),
    "empty depth": ("depth_0.png", lambda path: path.write_bytes(b"")),
    "depth of 8 bits": ("depth_0.png", lambda path: shutil.copy(path.with_name("render_0.png"), path)),
    "other sizes": ("depth_0.png", lambda path: write_depth(path, torch.ones(8, 8))),
    "missing depth": ("depth_1.png", lambda path: path.unlink()),
    "broken json": ("camera_0.json", lambda path: path.write_text('{"K": [[1')),
    "no camera": ("camera_0.json", lambda path: path.write_text('{"K": [[1]], "cam_from_world": [[NaN]]}')),
    "no focal length": ("camera_0.json", lambda path: edit(path, K=[[0, 0, 8], [0, 0, 8], [0, 0, 1]])),
    "no pose": ("camera_0.json", lambda path: edit(path, cam_from_world=np.diag([1, 0, 1, 1]).tolist())),
    "mirror": ("camera_0.json", lambda path: edit(path, cam_from_world=np.diag([1, -1, 1, 1]).tolist())),
    "lacking key": ("camera_0.json", lambda path: path.write_text("{}")),
    "missing camera": ("camera_0.json", lambda path: path.unlink()),
    "truncated cloud": ("ply", halve),
    "text as cloud": ("ply", lambda path: path.write_text("hello")),
    "missing cloud": ("ply", lambda path: path.unlink()),
}


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_a_broken_file_is_named_and_skipped(root, breakage):
    name, damage = BREAKAGES[breakage]
    whole = len(ShapeTree(root).load_all(progress=False))
    victim = ShapeTree(root).ids[1]
    file = (
        tree_files.cloud_file(root, victim)
        if name == "ply"
        else tree_files.render_folder(root, victim) / name
    )
    damage(file)
    tree = ShapeTree(root)
    assert len(tree.load_all(progress=False)) == whole - 1
    assert list(tree.skipped) == [victim]
    assert victim in tree.skipped[victim]
    assert (file.name if breakage != "other sizes" else "pictures of view 0") in tree.skipped[victim]
    if breakage != "missing cloud":
        with pytest.raises(ShapeError, match=victim):
            tree[1]


def test_the_release_s_camera_files_are_read(root):
    shape = ShapeTree(root)[0]
    for i in range(2):
        file = tree_files.render_folder(root, shape.id) / f"camera_{i}.json"
        record = json.loads(file.read_text())
        file.unlink()
        extrinsic = np.array(record["cam_from_world"])[:3]
        scipy.io.savemat(file.with_suffix(".mat"), {"K": np.array(record["K"]), "extrinsic": extrinsic})
    again = ShapeTree(root)[0]
    np.testing.assert_array_equal(again.camera.cam_from_world, shape.camera.cam_from_world)
    np.testing.assert_array_equal(again.camera.K, shape.camera.K)


def test_a_text_ply_is_read(root):
    shape = ShapeTree(root)[0]
    cloud = trimesh.PointCloud(np.eye(3))
    cloud.export(tree_files.cloud_file(root, shape.id), encoding="ascii")
    np.testing.assert_array_equal(ShapeTree(root)[0].points, np.eye(3))
