"""The experiment `runtime`: what hides a point, what a selection is worth, and that all of it is on the page."""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from diffpoint import PinholeCamera
from train.data.embree import has_embree
from train.data.solids import box, sample_union, surface_of
from train.experiments.hidden_points import Rays, Scene, embedded_scene, make_scene, quality
from train.experiments.run import Workbench
from train.experiments.runtime import medians, runtime

needs_embree = pytest.mark.skipif(not has_embree(), reason="embreex has no wheel here")


@needs_embree
def test_the_far_side_of_a_box_is_hidden() -> None:
    rays = Rays(surface_of([box((0.5, 0.4, 0.6), (0, 0, 0), np.ones(3))]))
    points = np.array([(0, 0, 0.3), (0.1, -0.1, 0.3), (0, 0, -0.3), (0, 0.2, 0), (2.0, 0, 0)])
    on_top = 0.15 * np.hypot(2, 0.2)  # its ray enters by the front, at 85 % of the way
    assert rays.behind(np.array([0, 0, 2.0]), points) == pytest.approx([0, 0, 0.6, on_top, 0], abs=1e-5)
    from_above = rays.behind(np.array([0, 2.0, 0]), points)
    assert from_above[3] == pytest.approx(0, abs=1e-5)
    assert (from_above[:3] > 0.01).all()


@needs_embree
def test_how_far_behind_decides_and_inner_faces_do_not() -> None:
    slab, within = (box((0.5, 0.5, depth), (0, 0, 0), np.ones(3)) for depth in (0.01, 0.004))
    scene = make_scene(
        "slab", "slab", surface_of([slab, within]), [500], lambda n, rng: sample_union([slab, within], n, rng)
    )
    x, y, z = scene.clouds[500].T
    assert (z.abs() > 0.0049).float().mean() > 0.9  # nearly all are on the two large faces, none inside
    facing = scene.camera.position[:, 2:].sign() * z
    inner = (x.abs() < 0.2) & (y.abs() < 0.2)  # nearer the rim, a ray may pass through a corner only
    large = inner & (z.abs() > 0.0049) & (scene.camera.position[:, 2:].abs() > 0.5)
    assert torch.equal(scene.hidden[500][large], (facing < 0)[large])
    loose = Scene(scene.name, scene.category, scene.camera, scene.clouds, scene.behind, epsilon=0.05)
    assert not loose.hidden[500][large].any()


def test_shares_of_a_selection_counted_by_hand() -> None:
    camera = PinholeCamera.look_at([(0.0, 0.0, -2.0)], focal_px=4.0, height=4, width=4)
    # Two share a pixel, whose owner is seen; one is alone in its pixel, but hidden by a surface without samples.
    cloud = torch.tensor([[0.1, 0.1, 0.0], [0.1, 0.1, 0.1], [-0.1, 0.1, 0.5]])
    scene = Scene("hand", "hand", camera, {3: cloud}, {3: torch.tensor([[0.0, 0.001, 0.4]])})
    assert quality([scene], 3, 4, "zbuffer") == {"hidden": 0.5, "recall": 0.5}
    strict = Scene("hand", "hand", camera, {3: cloud}, scene.behind, epsilon=0.0005)
    assert quality([strict], 3, 4, "zbuffer") == {"hidden": 0.5, "recall": 1.0}


def test_medians_of_runs_in_turns() -> None:
    now, calls = [0.0], []

    def run(name: str, seconds: list[float]) -> None:
        calls.append(name)
        now[0] += seconds.pop(0)

    long, short = [9.0, 0.5, 0.3, 0.4], [9.0, 0.02, 0.01, 0.09]  # what warms up does not count
    found = medians(
        {"long": lambda: run("long", long), "short": lambda: run("short", short)},
        rounds=3, clock=lambda: now[0],
    )  # fmt: skip
    assert found == pytest.approx({"long": 400, "short": 20})
    assert calls == ["long", "short"] * 4


@needs_embree
def test_runtime_is_measured_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["train.experiments.runtime"]
    monkeypatch.setattr(module, "COUNTS", (300, 1200))
    monkeypatch.setattr(module, "PAPER", {300: module.PAPER[2048], 1200: module.PAPER[10_000]})
    bench = Workbench((), tmp_path, limit=2, steps=1, progress=False)
    result = runtime(bench)
    assert json.loads((tmp_path / "runtime.json").read_text()) == json.loads(json.dumps(result))
    with Image.open(tmp_path / "runtime.png") as picture:
        assert min(picture.size) > 400 and picture.convert("L").getextrema()[0] < 128

    assert result["shapes"] == ["chair", "display"] and result["views"] == 8
    grid = {(r["method"], r["points"], r["epsilon"], r["side"]): r for r in result["grid"]}
    assert len(grid) == len(result["grid"]) == 2 * 2 * 2 * 4
    for count in (300, 1200):
        for epsilon in (0.002, 0.02):
            (base,) = (b for b in result["base"] if (b["points"], b["epsilon"]) == (count, epsilon))
            maps = [grid["zbuffer", count, epsilon, side] for side in (28, 56, 112, 224)]
            for coarse, fine in pairwise(maps):
                assert 0 <= coarse["hidden"] < fine["hidden"] < base["hidden"]
                assert 0 < coarse["recall"] < fine["recall"] <= 1
            horizon = [grid["horizon", count, epsilon, side] for side in (28, 224)]
            assert horizon[0] == pytest.approx(horizon[1] | {"side": 28}, abs=0.01)
            assert horizon[0]["hidden"] < maps[1]["hidden"]
        strict, loose = (grid["zbuffer", count, epsilon, 56]["hidden"] for epsilon in (0.002, 0.02))
        assert loose < strict
    few, many = result["time"]
    assert few["triangulation"] < many["triangulation"]
    assert all(
        len(times) == 2 and min(times) > 0 for row in (few, many) for times in row["by_shape"].values()
    )

    page = (tmp_path / "runtime.md").read_text()
    for claim, row in zip(result["claims"], result["time"], strict=True):
        by_shape = row["by_shape"]
        gains = np.array(by_shape["triangulation"]) - 10 * np.array(by_shape["zbuffer"])
        assert claim["gain"] == pytest.approx(gains.mean())
        assert claim["words"] in page
    for row in result["grid"]:
        assert f"| {row['hidden']:.1%} / {row['recall']:.1%} |" in page
    for ours, paper in zip(result["time"], ("6.6 |  | 209.8 | 32", "10.2 |  | 1120.0 | 110"), strict=True):
        ratio = ours["triangulation"] / ours["zbuffer"]
        cells = f"{ours['zbuffer']:.2f} | {ours['horizon']:.2f} | {ours['triangulation']:.2f} | {ratio:.0f}"
        assert f"| {ours['points']} points | {cells} |" in page
        assert f"| {ours['points']} points, the paper | {paper} |" in page
    assert "2 shapes, 8 views" in page and "10.4% and 3.6%" in page

    saved = tmp_path / "runtime" / "hidden.json"
    before = saved.stat().st_mtime_ns
    monkeypatch.setattr(module, "quality", lambda *_: pytest.fail("the shares were kept"))
    again = runtime(bench)
    assert (again["grid"], again["base"]) == (result["grid"], result["base"])
    assert saved.stat().st_mtime_ns == before


@needs_embree
def test_scenes_are_the_same_each_time() -> None:
    first, second = (embedded_scene("rifle", 0, [200]) for _ in range(2))
    assert torch.equal(first.clouds[200], second.clouds[200])
    assert torch.equal(first.behind[200], second.behind[200])
    assert torch.equal(first.camera.K, second.camera.K)
    elevation = torch.asin(first.camera.position[:, 1] / first.camera.position.norm(dim=-1)).rad2deg()
    assert elevation.min() >= -20 and elevation.max() <= 40 and len(elevation) == 8
