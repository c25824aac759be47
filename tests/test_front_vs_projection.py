"""Front constraint against projection losses: scenes are exact, claims hold at a fraction of the length, results
resume."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from PIL import Image
from torch import Tensor

from diffpoint import PinholeCamera, chamfer_distance, unproject
from models import Generator, build_generator
from models.parts import PointDecoder
from models.sizes import PROFILES as SIZES
from train.__main__ import main
from train.config import FitConfig, StageConfig
from train.data.batches import Batch
from train.errors import UserError
from train.evaluation.metrics import in_silhouette, visible_error
from train.experiments.front_vs_projection import free_clouds, networks
from train.experiments.front_vs_projection.free_clouds import LOSSES, MANY, ONE, fit_cloud
from train.experiments.front_vs_projection.networks import TRAININGS, configs, densities, verdict
from train.experiments.front_vs_projection.scenes import Cameras, embedded_shape, shapes_of
from train.experiments.run import run_experiment
from train.experiments.study import Study
from train.methods import get_method, recipe
from train.methods.losses import view_loss

INFINITY = float("inf")
TWO, SPHERE = Cameras(2), Cameras(6, sphere=True)


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
        name: fit_cloud(scene, name, iterations=60, rate=0.03)[0] for name in LOSSES if name != "front_emd"
    }
    front, projection, lin, soft = fits.values()
    assert projection["sideways"] == projection["largest_sideways"] == lin["largest_sideways"] == 0
    assert min(front["sideways"], soft["sideways"]) > 0.3
    assert front["visible_cd"] < 0.1 * projection["visible_cd"]
    assert front["visible_cd"] < soft["visible_cd"] < 0.8 * projection["visible_cd"]
    assert soft["inside"] > 0.8 > 0.3 > projection["inside"]
    assert lin["left"] < 0.6, "it deletes what it cannot move"
    assert projection["last_loss"] < 0.3 * projection["first_loss"], "it did fit its own loss"


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


def test_free_clouds_are_fitted_once_and_repeat_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, value in (("_SHAPES", 1), ("RATES", (0.01, 0.03)), ("SETTINGS", (ONE, MANY))):
        monkeypatch.setattr(free_clouds, name, value)
    study = Study((), tmp_path, seeds=1, steps=20, progress=False)
    found, drawn = free_clouds.free_clouds(study)
    assert [fit["loss"] for fit in found["fits"] if fit["cameras"] == ONE.name] == list(LOSSES)
    text = free_clouds.markdown(json.loads(json.dumps(found)))
    assert "0 exactly" in text
    error = found["table"][ONE.name]["front"]["visible_cd"]
    assert f"| {error['mean']:.2f} ± {error['sd']:.2f} |" in text
    assert set(drawn) == {"", "-clouds"} and all(figure.get_size_inches()[0] > 8 for figure in drawn.values())
    with Image.open(tmp_path / "front-vs-projection-clouds.gif") as moving:
        assert moving.n_frames == 21

    cells = sorted((tmp_path / "free-clouds").iterdir())
    lost = next(path for path in cells if path.name.startswith("embedded_chair"))
    before = {path: path.stat().st_mtime_ns for path in cells}
    lost.unlink()
    monkeypatch.setattr(free_clouds, "draw", lambda *_: {})  # takes seconds, and fits nothing that is kept
    again, _ = free_clouds.free_clouds(study)
    assert _numbers(again) == _numbers(found)
    assert {path for path in cells if path.stat().st_mtime_ns != before[path]} == {lost}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 5}, "a fit needs at least --steps 20; got 5"),
        ({"limit": 9}, "--limit must be at most 3"),
        ({"data": (Path("nowhere"),)}, "no such file"),
    ],
)
def test_options_that_cannot_be_used_are_named(options, message, tmp_path: Path):
    study = dataclasses.replace(Study((), tmp_path / "out", progress=False), **options)
    with pytest.raises(UserError, match=message):
        run_experiment("front-vs-projection", study)
    assert not list(tmp_path.iterdir())


def test_the_command_reaches_the_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["experiment", "front-vs-projection", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, "--steps", "5"]) == 2
    assert "a fit needs at least --steps 20" in capsys.readouterr().err


def test_the_published_page_shows_what_was_measured():
    docs = Path(__file__).parents[1] / "docs"
    found = json.loads((docs / "results" / "front-vs-projection.json").read_text())
    text = (docs / "front-vs-projection.md").read_text()
    made = free_clouds.markdown(found) + networks.markdown(found["networks"])
    rows = [line for line in made.splitlines() if line.startswith("| ") and re.search(r" ± | to ", line)]
    assert len(rows) > 50
    assert [row for row in rows if row not in text] == []


@pytest.mark.slow
def test_networks_are_trained_measured_and_resumed(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the free clouds, which are tested above."""
    monkeypatch.setattr(free_clouds, "free_clouds", lambda study: ({"fits": [], "table": {}}, {}))
    monkeypatch.setattr(free_clouds, "markdown", lambda found: "free clouds\n")
    for alike in ("projection", "soft"):
        monkeypatch.delitem(TRAININGS, alike)
    study = Study((tiny_data,), tmp_path, "smoke", seeds=1, limit=3, steps=2, progress=False)
    monkeypatch.setattr(networks, "_VIEWS", 2)
    found = run_experiment("front-vs-projection", study)["networks"]
    assert list(found["single"]) == list(TRAININGS)
    assert "horizon" not in found["many"]
    assert len(list((tmp_path / "runs").iterdir())) == len(configs(study)) == 5
    front, horizon = (found["single"][name]["stage1"] for name in ("front", "horizon"))
    assert front["visible"]["by_seed"] != horizon["visible"]["by_seed"]
    curve = found["single"]["front"]["curves"][0]
    assert curve["step"] == [0, 1, 2]
    assert curve["left"] == curve["visible"][-1] / curve["visible"][0]
    assert found["floor"]["inside"] > 0.8
    assert found["floor"]["front_density"] == pytest.approx(1, abs=0.2)
    text = (tmp_path / "front-vs-projection.md").read_text()
    assert text.startswith("free clouds\n")
    assert f"{front['visible']['mean']:.2f}" in text
    for picture in ("networks", "predictions"):
        assert (tmp_path / f"front-vs-projection-{picture}.png").stat().st_size > 10_000
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")}
    assert run_experiment("front-vs-projection", study)["networks"] == found
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")} == before


def test_trainings_differ_in_their_loss_alone() -> None:
    made = [training.single(recipe("ours", "cpu")) for training in TRAININGS.values()]
    plain = {
        dataclasses.replace(
            config,
            stage1=dataclasses.replace(config.stage1, supervision="front", visibility="zbuffer"),
            stage2=dataclasses.replace(config.stage2, supervision="front", visibility="zbuffer"),
        )
        for config in made
    }
    assert len(set(made)) == len(TRAININGS)
    assert len(plain) == 1
    assert {training.colour for training in TRAININGS.values()} <= {loss.colour for loss in LOSSES.values()}


def test_only_trees_are_trained_on(tiny_data: Path, tmp_path: Path) -> None:
    study = Study((tmp_path, tiny_data, tmp_path / "mesh.obj"), tmp_path)
    assert study.on_trees().data == (tiny_data,)


def test_even_clouds_are_even_and_crowded_fronts_are_seen() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-0.5, 0.5, 8)] * 3, indexing="ij"), -1).reshape(
        1, -1, 3
    )
    seen = grid[..., 2] < 0
    same = densities(grid, grid, seen)
    assert same["front_density"].item() == pytest.approx(1)
    assert same["imbalance"].item() == pytest.approx(0)
    front_only = densities(grid[:, seen[0]].repeat(1, 2, 1), grid, seen)
    assert front_only["front_density"].item() == pytest.approx(2)
    assert (
        0.3 < front_only["imbalance"].item() <= 0.5
    )  # half of the points would have to move, to within a part


def test_verdicts() -> None:
    assert verdict(0.29, 0.9) == "converged"
    assert verdict(0.5, 0.9) == "in between"
    assert verdict(0.8, 0.9) == verdict(0.1, 0.49) == "did not converge"


@pytest.fixture
def plate() -> tuple[Tensor, Batch]:
    """A plate 0.1 behind where a camera saw one, a point for each pixel: (1, 1, N, 3), and the camera's depth map."""
    camera = PinholeCamera.look_at((0, 0, -2), focal_px=14.0, height=28, width=28)
    across = (torch.arange(8, 20) + 0.5 - 14) / 14
    x, y = torch.meshgrid(across, across, indexing="xy")
    z = torch.full_like(x, 2.1)
    points = torch.stack((-x * z, -y * z, z - 2), -1).reshape(1, 1, -1, 3)
    depth = torch.full((1, 1, 28, 28), INFINITY)
    depth[..., 8:20, 8:20] = 2.0
    one_view = PinholeCamera(camera.K[None, None], camera.cam_from_world[None, None], 28, 28)
    return points, Batch(torch.ones(1, 1, 3, 28, 28), depth, one_view)


def _stage(supervision: str, **settings: Any) -> StageConfig:
    return dataclasses.replace(recipe("ours", "cpu").stage1, supervision=supervision, **settings)


@pytest.mark.parametrize("front", ["emd", "chamfer"])
def test_projection_losses_have_the_unit_of_the_front_constraint(
    plate: tuple[Tensor, Batch], front: str
) -> None:
    value = view_loss(*plate, _stage("projection", front=front), step=0).loss.item()
    expected = 0.1 * 144 * (56 / 28) ** 2 if front == "emd" else 100 * 0.1
    assert value == pytest.approx(expected, rel=1e-4)
    like = view_loss(*plate, _stage("front", front=front), step=0).loss.item()
    assert (1 if front == "emd" else 2) * expected == pytest.approx(like, rel=0.15)  # chamfer: both ways


def test_every_supervision_has_a_gradient_and_soft_ones_sharpen(plate: tuple[Tensor, Batch]) -> None:
    clouds, batch = plate
    steps = _stage("soft").steps
    for supervision in ("front", "projection", "lin", "soft"):
        points = (clouds + 0.02).requires_grad_()
        logits = torch.full(points.shape[:3], 0.5).requires_grad_()
        found = view_loss(points, batch, _stage(supervision), step=steps, logits=logits)
        found.loss.backward()
        assert points.grad is not None
        sideways = points.grad[..., :2].abs().max().item()
        assert (sideways > 1e-4) == (supervision in ("front", "soft")), supervision
        assert (logits.grad is not None) == (supervision == "lin")
        assert ("matched_share" in found.statistics) == (supervision == "front")
    early, late = (view_loss(*plate, _stage("soft"), step=step).loss.item() for step in (0, steps))
    assert early != late


def _lin(**settings: Any) -> FitConfig:
    config = recipe("ours", "smoke")
    return dataclasses.replace(
        config, stage1=dataclasses.replace(config.stage1, supervision="lin"), **settings
    )


def test_points_that_do_not_exist_are_replaced_by_those_that_do() -> None:
    torch.manual_seed(0)
    config = _lin()
    model = get_method("ours").build(config)
    assert isinstance(model, Generator)
    assert isinstance(model.decoder, PointDecoder)
    assert model.config == dataclasses.replace(SIZES["smoke"], occupancy_logits=True)
    images, codes = torch.rand(2, 3, 64, 64), torch.randn(3, 2, model.code_dim)
    predicted = model.predict(images, codes)
    assert predicted.logits is not None
    assert (predicted.logits > 0).all()  # fresh networks keep all points
    assert torch.equal(model(images, codes), predicted.points)
    with torch.no_grad():
        model.decoder.fc_points.bias[3] = -10.0  # of the first point
    logits = model.predict(images, codes).logits
    assert logits is not None
    assert (logits[..., 0] < 0).all()
    shown = model(images, codes)
    assert shown.shape == predicted.points.shape
    assert torch.equal(shown[:, :, :-1], predicted.points[:, :, 1:])
    assert torch.equal(shown[:, :, -1], predicted.points[:, :, 1])  # the first that exists is repeated


def test_supervision_belongs_to_our_own_method() -> None:
    with pytest.raises(UserError, match="supervision"):
        get_method("psgn").check(_lin(system="psgn"))
    with pytest.raises(UserError, match="leave --output-head at points"):
        get_method("ours").check(_lin(output_head="latent"))
    with pytest.raises(ValueError, match="occupancy_logits needs"):
        build_generator(
            config=dataclasses.replace(SIZES["smoke"], occupancy_logits=True, output_head="latent")
        )


def test_silhouettes_and_the_visible_part_are_those_of_the_view(plate: tuple[Tensor, Batch]) -> None:
    clouds, (_, depth, cameras, *_) = plate
    points, camera = clouds[0], cameras[0]
    assert in_silhouette(points, camera, depth).all()
    assert visible_error(points, camera, depth).item() == pytest.approx(20, rel=0.15)
    outside = points + torch.tensor([1.2, 0.0, 0.0])
    assert in_silhouette(outside, camera, depth).float().mean() == pytest.approx(1 / 3)
    assert in_silhouette(outside, camera, depth, margin=8).all()
    gone = points + torch.tensor([30.0, 0.0, 0.0])
    assert not in_silhouette(gone, camera, depth, margin=28).any()
