"""The network under each loss: every loss trains, what is measured is what it says, and pages show it."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path

import pytest
import torch
from train.experiments.front_vs_projection.study import front_vs_projection
from train.methods.systems import build_network

from diffpoint import PinholeCamera
from models import Generator, build_generator
from models.parts import PointDecoder
from models.sizes import PROFILES as SIZES
from train.config import PROFILES
from train.errors import UserError
from train.evaluation.metrics import in_silhouette, visible_error
from train.experiments.front_vs_projection.free_clouds import LOSSES
from train.experiments.front_vs_projection.networks import TAUGHT, configs, densities, verdict
from train.experiments.run import Workbench
from train.methods.losses import Scene, supervise

INFINITY = float("inf")


@pytest.mark.slow
def test_the_whole_study_trains_measures_and_resumes(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the free clouds, which have tests of their own."""
    study = importlib.import_module("train.experiments.front_vs_projection.study")
    monkeypatch.setattr(study, "run", lambda *_, **__: {"fits": [], "table": {}})
    monkeypatch.setattr(study.page, "markdown", lambda found: "free clouds\n")
    for alike in ("projection", "soft"):
        monkeypatch.delitem(TAUGHT, alike)
    bench = Workbench((tiny_data,), tmp_path, "smoke", seeds=1, limit=3, steps=2, progress=False)
    monkeypatch.setattr("train.experiments.front_vs_projection.networks._VIEWS", 2)
    found = front_vs_projection(bench)
    networks = found["networks"]
    assert list(networks["single"]) == list(TAUGHT)
    assert "horizon" not in networks["many"]
    assert len(list((tmp_path / "runs").iterdir())) == len(configs(bench)) == 5
    front, horizon = (networks["single"][name]["stage1"] for name in ("front", "horizon"))
    assert front["visible"]["by_seed"] != horizon["visible"]["by_seed"]
    curve = networks["single"]["front"]["curves"][0]
    assert curve["step"] == [0, 1, 2]
    assert curve["left"] == curve["visible"][-1] / curve["visible"][0]
    assert networks["floor"]["inside"] > 0.8
    assert networks["floor"]["front_density"] == pytest.approx(1, abs=0.2)
    saved = json.loads((tmp_path / "front-vs-projection.json").read_text())
    assert saved["networks"] == json.loads(json.dumps(networks))
    text = (tmp_path / "front-vs-projection.md").read_text()
    assert text.startswith("free clouds\n")
    assert f"{front['visible']['mean']:.2f}" in text
    for picture in ("networks", "predictions"):
        assert (tmp_path / f"front-vs-projection-{picture}.png").stat().st_size > 10_000
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")}
    assert front_vs_projection(bench)["networks"] == networks
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")} == before


def test_trainings_differ_in_their_loss_alone() -> None:
    made = [taught.config(PROFILES["cpu"], single=True) for taught in TAUGHT.values()]
    plain = {
        dataclasses.replace(
            config,
            stage1=dataclasses.replace(config.stage1, supervision="front", visibility="zbuffer"),
            stage2=dataclasses.replace(config.stage2, supervision="front", visibility="zbuffer"),
        )
        for config in made
    }
    assert len(set(made)) == len(TAUGHT)
    assert len(plain) == 1
    assert {taught.colour for taught in TAUGHT.values()} <= {loss.colour for loss in LOSSES.values()}


def test_only_trees_are_trained_on(tiny_data: Path, tmp_path: Path) -> None:
    bench = Workbench((tmp_path, tiny_data, tmp_path / "mesh.obj"), tmp_path)
    assert bench.on_trees().data == (tiny_data,)


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
def plate() -> Scene:
    """A plate 0.1 behind where a camera saw one, a point for each pixel."""
    camera = PinholeCamera.look_at((0, 0, -2), focal_px=14.0, height=28, width=28)
    across = (torch.arange(8, 20) + 0.5 - 14) / 14
    x, y = torch.meshgrid(across, across, indexing="xy")
    z = torch.full_like(x, 2.1)
    points = torch.stack((-x * z, -y * z, z - 2), -1).reshape(1, -1, 3)
    depth = torch.full((1, 1, 28, 28), INFINITY)
    depth[..., 8:20, 8:20] = 2.0
    return Scene(points, camera, depth)


@pytest.mark.parametrize("front", ["emd", "chamfer"])
def test_projection_losses_take_the_unit_of_the_front_constraint(plate: Scene, front: str) -> None:
    stage = dataclasses.replace(PROFILES["cpu"].stage1, front=front, supervision="projection")
    value = supervise(plate, stage, step=0).loss.item()
    expected = 0.1 * 144 * (56 / 28) ** 2 if front == "emd" else 100 * 0.1
    assert value == pytest.approx(expected, rel=1e-4)
    like = supervise(plate, dataclasses.replace(stage, supervision="front"), step=0).loss.item()
    assert (1 if front == "emd" else 2) * expected == pytest.approx(like, rel=0.15)  # chamfer: both ways


def test_every_supervision_has_a_gradient_and_soft_ones_sharpen(plate: Scene) -> None:
    steps = PROFILES["cpu"].stage1.steps
    for supervision in ("front", "projection", "lin", "soft"):
        stage = dataclasses.replace(PROFILES["cpu"].stage1, supervision=supervision)
        points = (plate.points + 0.02).requires_grad_()
        logits = torch.full(points.shape[:2], 0.5).requires_grad_()
        found = supervise(plate._replace(points=points, logits=logits), stage, step=steps)
        found.loss.backward()
        assert points.grad is not None
        sideways = points.grad[..., :2].abs().max().item()
        assert (sideways > 1e-4) == (supervision in ("front", "soft")), supervision
        assert (logits.grad is not None) == (supervision == "lin")
        assert ("matched_share" in found.shares) == (supervision == "front")
    soft = dataclasses.replace(PROFILES["cpu"].stage1, supervision="soft")
    early, late = (supervise(plate, soft, step=step).loss.item() for step in (0, steps))
    assert early != late


def test_points_that_do_not_exist_are_replaced_by_those_that_do() -> None:
    torch.manual_seed(0)
    config = dataclasses.replace(PROFILES["smoke"], stage1=_lin(PROFILES["smoke"].stage1))
    model = build_network(config)
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
    assert torch.equal(shown[:, :, -1], predicted.points[:, :, 1])  # the first that exists, once more


def test_supervision_belongs_to_our_own_system(tmp_path: Path) -> None:
    config = dataclasses.replace(PROFILES["smoke"], system="psgn", stage1=_lin(PROFILES["smoke"].stage1))
    with pytest.raises(UserError, match="supervision and visibility"):
        build_network(config)
    latent = dataclasses.replace(PROFILES["smoke"], ending="latent", stage1=_lin(PROFILES["smoke"].stage1))
    with pytest.raises(UserError, match="leave --ending at points"):
        build_network(latent)
    with pytest.raises(ValueError, match="occupancy_logits needs"):
        build_generator(
            config=dataclasses.replace(SIZES["smoke"], occupancy_logits=True, output_head="latent")
        )


def _lin(stage):
    return dataclasses.replace(stage, supervision="lin")


def test_what_a_view_saw_is_what_is_measured(plate: Scene) -> None:
    assert in_silhouette(plate.points, plate.camera, plate.depth).all()
    assert visible_error(plate.points, plate.camera, plate.depth).item() == pytest.approx(20, rel=0.15)
    outside = plate.points + torch.tensor([1.2, 0.0, 0.0])
    assert in_silhouette(outside, plate.camera, plate.depth).float().mean() == pytest.approx(1 / 3)
    assert in_silhouette(outside, plate.camera, plate.depth, margin=8).all()
    gone = plate.points + torch.tensor([30.0, 0.0, 0.0])
    assert not in_silhouette(gone, plate.camera, plate.depth, margin=28).any()
