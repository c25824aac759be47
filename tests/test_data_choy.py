"""Choy's renderings: 24 pictures, a text file of cameras, clouds beside them, and no depth."""

import re
import shutil

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from diffpoint.camera import PinholeCamera
from diffpoint.io import read_points, write_points
from train.__main__ import main
from train.data import ShapeTree, tree_files
from train.data.check import check_tree
from train.data.choy_layout import cam_from_world, pictures_of
from train.data.render import Renderer
from train.data.surface import Surface
from train.errors import UserError

CHAIR, CAR = "03001627", "02958343"
SIZE, VIEWS = 137, 4


def turn(axis, degrees):
    """Right-handed rotation about an axis, as Blender's Euler angles are."""
    (i, j), angle = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis], np.radians(degrees)
    matrix = np.eye(3)
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


@pytest.mark.parametrize(
    "azimuth, elevation, in_plane", [(0, 0, 0), (37, 26, 0), (222.9, 28.6, 11), (10, -20, -50)]
)
def test_the_camera_is_the_one_their_blender_script_sets_up(azimuth, elevation, in_plane):
    """A camera on +x that looks back, child of an empty that is turned by the negative angles, around an OBJ file."""
    parent = turn("z", -azimuth) @ turn("y", -elevation) @ turn("x", -in_plane)
    blender_from_gl = parent @ turn("y", 90) @ turn("z", 90)
    blender_from_obj = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rotation = np.diag([1.0, -1, -1]) @ blender_from_gl.T @ blender_from_obj
    eye = blender_from_obj.T @ parent @ [1.3, 0, 0]
    pose = cam_from_world(azimuth, elevation, in_plane, 1.3)
    np.testing.assert_allclose(pose[:3, :3], rotation, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], -rotation @ eye, atol=1e-12)


def write_model(folder, mesh, rng):
    """Renders in their layout, through cameras written down as numbers in their text file only."""
    folder.mkdir(parents=True)
    rows = [
        (rng.uniform(0, 360), rng.uniform(25, 30), 0.0, rng.uniform(0.65, 0.95), 25.0) for _ in range(VIEWS)
    ]
    (folder / "rendering_metadata.txt").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    (folder / "renderings.txt").write_text("".join(f"{i:02d}.png\n" for i in range(VIEWS)))
    poses = torch.tensor(np.stack([cam_from_world(a, e, r, 1.75 * d) for a, e, r, d, _ in rows])).float()
    K = torch.tensor([[149.84375, 0, 68.5], [0, 149.84375, 68.5], [0, 0, 1]]).expand(VIEWS, 3, 3)
    faces = np.asarray(mesh.faces)
    surface = Surface.plain(np.asarray(mesh.vertices), faces, np.full((len(faces), 3), 0.5))
    views = Renderer(surface).render(PinholeCamera(K, poses, SIZE, SIZE))
    for i, (image, depth) in enumerate(zip(views.images, views.depth, strict=True)):
        alpha = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
        Image.fromarray(np.concatenate((image, alpha[..., None]), axis=2), "RGBA").save(
            folder / f"{i:02d}.png"
        )
    return views


@pytest.fixture(scope="module")
def choy(tmp_path_factory):
    """Twelve models, with clouds in a folder beside ShapeNetRendering."""
    root = tmp_path_factory.mktemp("choy") / "data"
    rng = np.random.default_rng(0)
    for number in range(12):
        shape = f"{(CHAIR, CAR)[number % 2]}/{number:032x}"
        boxes = [trimesh.creation.box(rng.uniform(0.05, 0.5, 3)) for _ in range(4)]
        mesh = trimesh.util.concatenate([box.apply_translation(rng.uniform(-0.3, 0.3, 3)) for box in boxes])
        mesh.apply_translation(-mesh.bounds.mean(0)).apply_scale(1 / np.linalg.norm(mesh.extents))
        write_model(root / "ShapeNetRendering" / shape / "rendering", mesh, rng)
        cloud = root / tree_files.CLOUDS / f"{shape}.ply"
        cloud.parent.mkdir(parents=True, exist_ok=True)
        write_points(cloud, torch.from_numpy(trimesh.sample.sample_surface(mesh, 2048, seed=0)[0]).float())
    return root


def test_a_tree_is_read_and_its_cameras_fit_its_clouds(choy, capsys):
    for path in (choy, choy / "ShapeNetRendering"):
        trees = [ShapeTree(path, split) for split in tree_files.SPLITS]
        assert sum(map(len, trees)) == 12
        assert all(len(tree) for tree in trees)
    shape = trees[0][0]
    assert shape.images.shape == (VIEWS, 3, SIZE, SIZE)
    assert not shape.has_depth
    assert torch.equal(shape.depth.isnan(), (shape.images < 0.9).any(1))
    assert main(["data", "check", str(choy)]) == 0
    said = capsys.readouterr().out
    assert "cameras, silhouettes and clouds agree in 12 of them: 100.00% of the points" in said
    assert "frames: clouds and cameras are in one frame, y up" in said
    assert "no depth maps: for reconstruct and evaluate, not for fit\nno problems" in said


def test_lists_are_followed_where_there_are_some(choy, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(choy, root)
    lists = root / tree_files.LISTS / "test"
    lists.mkdir(parents=True)
    named = f"{CHAIR}/{4:032x}"
    (lists / f"{CHAIR}.list").write_text(f"{named}\n")
    assert ShapeTree(root, "test").ids == [named]
    assert ShapeTree(root / "ShapeNetRendering", "test", ["chair"]).ids == [named]


def test_clouds_with_z_up_are_turned(choy, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(choy, root)
    for path in (root / tree_files.CLOUDS).glob("*/*.ply"):
        x, y, z = read_points(path).T
        write_points(path, torch.stack((x, -z, y), 1))
    report = check_tree(root, processes=1)
    assert report.frame.verdict.startswith("clouds are z-up, cameras expect y-up: clouds are turned")
    assert report.problems == []


def test_without_clouds_it_says_where_they_go_and_what_works_anyway(choy, tmp_path):
    shutil.copytree(choy / "ShapeNetRendering", tmp_path / "ShapeNetRendering")
    with pytest.raises(UserError, match=r"no ground truth: put or link the clouds.*pcdata_2048.*reconstruct"):
        ShapeTree(tmp_path)


def halve(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES = {
    "a missing picture": (lambda f: (f / "02.png").unlink(), r"02\.png is missing"),
    "a picture cut short": (lambda f: halve(f / "02.png"), r"02\.png cannot be read"),
    "a picture of another size": (
        lambda f: Image.open(f / "02.png").resize((64, 64)).save(f / "02.png"),
        r"02\.png is \(64, 64\) pixels",
    ),
    "no alpha": (lambda f: Image.open(f / "02.png").convert("RGB").save(f / "02.png"), "no alpha channel"),
    "a line too few": (
        lambda f: (f / "rendering_metadata.txt").write_text("0 25 0 0.8 25\n"),
        "4 pictures and 1 lines",
    ),
    "no numbers": (lambda f: (f / "rendering_metadata.txt").write_text("0 25\n"), "line 1 is not azimuth"),
    "other cameras": (
        lambda f: (f / "rendering_metadata.txt").write_text("90 -60 0 0.5 25\n" * 4),
        "silhouettes and cloud do not agree",
    ),
    "an empty mask": (
        lambda f: Image.new("RGBA", (SIZE, SIZE)).save(f / "02.png"),
        "view 2 shows nothing",
    ),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_broken_models_are_named_and_the_others_stand(choy, tmp_path, kind):
    root = tmp_path / "data"
    shutil.copytree(choy, root)
    damage, said = DAMAGES[kind]
    victim = f"{CAR}/{5:032x}"
    damage(root / "ShapeNetRendering" / victim / "rendering")
    report = check_tree(root, processes=1)
    assert [problem for problem in report.problems if problem.startswith(victim) and re.search(said, problem)]
    assert all(problem.startswith(victim) for problem in report.problems)
    assert sum(each.holds for each in report.consistencies) == 11


def test_a_run_is_evaluated_on_it(choy, smoke_run, tmp_path, capsys):
    out = tmp_path / "evaluation.json"
    arguments = [
        "evaluate",
        str(smoke_run),
        "--data",
        str(choy),
        "--views",
        "1,2",
        "--seeds",
        "0",
        "--split",
        "train",
    ]
    assert main([*arguments, "--out", str(out)]) == 0
    assert out.is_file()


def test_training_on_it_is_refused_in_one_line(choy, tmp_path, capsys):
    assert main(["fit", "--data", str(choy), "--out", str(tmp_path / "run"), "--profile", "smoke"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.match(r"error: .* no depth maps.*training needs them.*reconstruct and evaluate", error)
    assert not (tmp_path / "run").exists()


def test_a_folder_of_pictures_is_reconstructed_from(choy, smoke_run, tmp_path, capsys):
    model = choy / "ShapeNetRendering" / CHAIR / f"{0:032x}"
    assert [path.name for path in pictures_of(model)] == ["00.png", "01.png", "02.png", "03.png"]
    for folder in (model, model / "rendering"):
        out = tmp_path / folder.name
        assert main(["reconstruct", str(smoke_run), str(folder), "--out", str(out), "--steps", "0"]) == 0
        assert (out / "reconstruction.ply").is_file()
        assert "from 4 images" in capsys.readouterr().out
