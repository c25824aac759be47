"""The study of free clouds: its scenes are exact, its claims hold at a fraction of its length, and it resumes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
import trimesh
from PIL import Image

from diffpoint import chamfer_distance, unproject
from train.__main__ import main
from train.errors import UserError
from train.evaluation.metrics import in_silhouette
from train.experiments.front_vs_projection import networks_page, page
from train.experiments.front_vs_projection.free_clouds import LOSSES, fit_cloud
from train.experiments.front_vs_projection.shapes import Cameras, embedded_shape, shapes_of
from train.experiments.front_vs_projection.study import run

ONE, TWO, SPHERE = Cameras(1), Cameras(2), Cameras(6, sphere=True)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("cameras", [TWO, SPHERE], ids=lambda c: c.name)
def test_the_surface_is_where_the_depth_maps_are(cameras):
    """Also that the frame is that of the first camera."""
    scene = embedded_shape("chair").scene(cameras, seed=3)
    assert scene.depth.shape == (1, cameras.count, 56, 56)
    assert torch.equal(scene.camera.cam_from_world[0], torch.eye(4))
    assert scene.surface[..., 2].mean() == pytest.approx(2, abs=0.2)
    observed = unproject(scene.depth, scene.camera)
    for view in range(cameras.count):
        points = observed.points[:, view, : int(observed.lengths[0, view])]
        assert chamfer_distance(points, scene.surface, squared=False).a_to_b < 0.015
    assert in_silhouette(scene.surface, scene.camera, scene.depth, margin=1).float().mean() > 0.99


def test_cameras_of_the_sphere_look_from_above_and_from_below():
    position = Cameras(24, sphere=True).around(10.0).position
    assert torch.allclose(position.norm(dim=-1), torch.tensor(2.0, dtype=position.dtype))
    assert position[:, 1].max() > 1.8
    assert position[:, 1].min() < -1.8
    assert position.mean(0).norm() < 0.1
    assert (Cameras(8).around(0.0).position[:, 1] - 2 * torch.tensor(15.0).deg2rad().sin()).abs().max() < 1e-6


def test_a_scene_is_the_same_for_the_same_seed_and_another_for_another():
    shape = embedded_shape("car")
    one, again, other = (shape.scene(TWO, seed=seed) for seed in (0, 0, 1))
    for x, y, z in zip(one[1:], again[1:], other[1:], strict=True):
        assert torch.equal(x, y)
        assert not torch.equal(x, z)


def test_one_view_moves_the_points_of_the_projection_loss_along_the_axis_only():
    scene = embedded_shape("chair").scene(ONE, seed=0)
    fits = {
        name: fit_cloud(scene, LOSSES[name], iterations=60, rate=0.03)
        for name in LOSSES
        if name != "front_emd"
    }
    assert fits["projection"].sideways == fits["projection"].largest_sideways == 0
    assert fits["lin"].largest_sideways == 0
    assert min(fits["front"].sideways, fits["soft"].sideways) > 0.3
    measures = {name: fit.measures for name, fit in fits.items()}
    assert measures["front"].visible_cd < 0.1 * measures["projection"].visible_cd
    assert (
        measures["front"].visible_cd < measures["soft"].visible_cd < 0.8 * measures["projection"].visible_cd
    )
    assert measures["soft"].inside > 0.8 > 0.3 > measures["projection"].inside
    assert measures["lin"].left < 0.6, "it deletes what it cannot move"
    assert fits["projection"].losses[-1] < 0.3 * fits["projection"].losses[0], "it did fit its own loss"


def test_meshes_are_seen_from_everywhere_and_trees_from_their_own_views(tiny_data: Path, tmp_path: Path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.obj")
    box, chair = shapes_of([tmp_path, tiny_data], limit=1)[::-1]
    assert box.name.endswith("box")
    assert chair.source == tiny_data.name
    assert box.scene(SPHERE, seed=0).depth.shape == (1, 6, 56, 56)
    assert chair.scene(SPHERE, seed=0) is None
    # The tiny tree has maps of 64 pixels, from which 56 cannot be taken without making depths up.
    assert chair.scene(TWO, seed=0) is None


def _numbers(found: dict) -> list[dict]:
    """All but the times."""
    return [{k: v for k, v in fit.items() if k != "ms_per_iteration"} for fit in found["fits"]]


def test_the_study_writes_what_it_measured_resumes_and_repeats_itself(tmp_path: Path):
    settings = {"seeds": 1, "limit": 1, "iterations": 20, "settings": (ONE,), "progress": False}
    found = run([], tmp_path / "a", **settings)
    assert json.loads((tmp_path / "a" / "front-vs-projection.json").read_text()) == found
    assert [fit["loss"] for fit in found["fits"]] == list(LOSSES)
    text = (tmp_path / "a" / "front-vs-projection.md").read_text()
    assert "0 exactly" in text
    assert f"| {found['table'][ONE.name]['front']['visible_cd']['mean']:.2f} ± 0.00 |" in text
    for name in ("front-vs-projection.png", "front-vs-projection-clouds.png"):
        with Image.open(tmp_path / "a" / name) as picture:
            assert picture.size[0] > 1000
    with Image.open(tmp_path / "a" / "front-vs-projection-clouds.gif") as moving:
        assert moving.n_frames == 21

    cells = sorted((tmp_path / "a" / "free-clouds").iterdir())
    lost = next(path for path in cells if path.name.startswith("embedded_chair"))
    before = {path: path.stat().st_mtime_ns for path in cells}
    lost.unlink()
    again = run([], tmp_path / "a", **settings)
    assert _numbers(again) == _numbers(found)
    changed = {path for path in cells if path.stat().st_mtime_ns != before[path]}
    assert changed == {lost}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iterations": 5}, "a fit of 5 steps goes nowhere"),
        ({"seeds": 0}, "--seeds at least 1"),
        ({"limit": 9}, "--limit must be 1 to 3"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message, tmp_path: Path):
    with pytest.raises(UserError, match=message):
        run([], tmp_path / "out", progress=False, **options)
    with pytest.raises(UserError, match="no such file"):
        run([tmp_path / "nowhere"], tmp_path / "out", progress=False)
    assert not list(tmp_path.iterdir())


def test_the_command_reaches_the_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["experiment", "front-vs-projection", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, "--steps", "5"]) == 2
    assert "a fit of 5 steps goes nowhere" in capsys.readouterr().err


def test_the_published_page_shows_what_was_measured():
    docs = Path(__file__).parents[1] / "docs"
    found = json.loads((docs / "results" / "front-vs-projection.json").read_text())
    text = (docs / "front-vs-projection.md").read_text()
    made = page.markdown(found) + networks_page.markdown(found["networks"])
    rows = [line for line in made.splitlines() if line.startswith("| ") and re.search(r" ± | to ", line)]
    assert len(rows) > 50
    assert [row for row in rows if row not in text] == []
