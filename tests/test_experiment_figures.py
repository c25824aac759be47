"""Experiments that end in a figure: their measures say what is known beforehand, and they write what they measured."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from diffpoint import PinholeCamera
from train.data.ambiguity_check import AmbiguousObject
from train.experiments.correlation import correlation, over_shapes, pearson, spearman, within_shapes
from train.experiments.coverage import coverage, hidden_distances, make_object, near_distance, reach
from train.experiments.predictions import predictions, spread
from train.experiments.run import Workbench


@pytest.fixture(scope="module")
def bench(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    """What all experiments of this file share, trainings included."""
    out = tmp_path_factory.mktemp("figures")
    return Workbench((tiny_data,), out, "smoke", seeds=1, limit=3, steps=3, progress=False)


def check_written(bench: Workbench, name: str, result: dict) -> str:
    """JSON as returned, a figure that is one, and the page's text."""
    assert json.loads((bench.out / f"{name}.json").read_text()) == json.loads(json.dumps(result))
    with Image.open(bench.out / f"{name}.png") as picture:
        assert min(picture.size) > 150
        assert picture.convert("L").getextrema()[0] < 128
    return (bench.out / f"{name}.md").read_text()


def test_correlation_is_made_once_and_written(bench: Workbench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["train.experiments.correlation"], "GROUPS", 3)
    result = correlation(bench)
    text = check_written(bench, "correlation", result)
    found = result["within_shapes"]["cd"]["pearson"]
    assert found["by_seed"] == [found["mean"]] and -1 <= found["interval"][0] <= found["interval"][1] <= 1
    assert f"{found['mean']:+.2f} (" in text
    kept = {path: path.stat().st_mtime_ns for path in (bench.out / "scores").iterdir()}
    assert correlation(bench) == result
    assert {path: path.stat().st_mtime_ns for path in (bench.out / "scores").iterdir()} == kept


def test_coefficients_of_known_data() -> None:
    x = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None].expand(-1, 3)
    y = torch.stack([x[:, 0], -x[:, 0].exp(), x[:, 0] * 0], 1)
    assert pearson(x, y).tolist() == pytest.approx([1, np.corrcoef(x[:, 1], y[:, 1])[0, 1], 0])
    assert spearman(x, y).tolist() == pytest.approx([1, -1, 0])
    assert within_shapes(pearson, x[:, :2], torch.stack([x[:, 0], -x[:, 0]], 1)) == pytest.approx(0)
    assert over_shapes(spearman, x[:, 0], x[:, 0].square()) == pytest.approx(1)


def test_predictions_are_measured_and_drawn(bench: Workbench) -> None:
    result = predictions(bench)
    text = check_written(bench, "predictions", result)
    assert set(result["categories"]) == {"chair", "display"} & set(result["categories"]) != set()
    assert f"{result['all']['ratio']:.2f}" in text
    assert result["all"]["front"] > 0 and 0 < result["all"]["front_share"] < 1


def _ball(points: int, *, seed: int = 0) -> torch.Tensor:
    directions = torch.randn(points, 3, generator=torch.Generator().manual_seed(seed))
    return 0.4 * directions / directions.norm(dim=-1, keepdim=True)


def _front_camera() -> PinholeCamera:
    return PinholeCamera.look_at(torch.tensor([[[0.0, 0, 2]]]), focal_px=105.0, height=56, width=56)


def test_isotropic_noise_has_no_back() -> None:
    noise = torch.randn(4, 1, 2000, 3, generator=torch.Generator().manual_seed(1))
    found = spread(_ball(2000) + 0.002 * noise, _front_camera())
    assert (found["back"] / found["front"]).item() == pytest.approx(1, abs=0.05)
    assert (found["back_surface"] / found["front_surface"]).item() == pytest.approx(1, abs=0.1)
    assert found["front_share"].item() == pytest.approx(
        0.4, abs=0.1
    )  # the cap that an eye at five radii sees


def test_what_moves_only_behind_is_spread_of_the_back() -> None:
    ball = _ball(2000)[None, None].repeat(3, 1, 1, 1)
    behind = ball[..., 2] < -0.1
    depth = torch.tensor([0.0, 0.1, 0.2])[:, None, None] * behind
    found = spread(ball - torch.stack([0 * depth, 0 * depth, depth], -1), _front_camera())
    assert found["front"].item() < 0.2 and found["front_surface"].item() < 0.2
    assert found["back"].item() > 10 * found["front"].item()


def test_coverage_is_measured_and_drawn(bench: Workbench) -> None:
    result = coverage(bench)
    text = check_written(bench, "coverage", result)
    rows = result["rows"]
    assert rows["ours, 10 codes"]["reached"]["mean"] <= rows["ours, 50 codes"]["reached"]["mean"]
    assert rows["deterministic"]["reached"]["mean"] <= 1 / 3
    assert f"{rows['deterministic']['none']['mean']:.0%}" in text
    more = rows["highly diverse, 10 codes"]["reached"]["mean"] - rows["ours, 10 codes"]["reached"]["mean"]
    claim = result["claims"][1]
    assert claim["words"] == "backs reached, %: ours, 10 codes < highly diverse, 10 codes"
    assert claim["gain"] == pytest.approx(100 * more) and claim["words"] in text


def test_the_backs_themselves_cover_all_backs() -> None:
    obj = make_object(AmbiguousObject("loudspeaker", (0, 2)), 64)
    near = near_distance(obj.backs, obj.again)
    assert reach(hidden_distances(obj.backs, obj.backs), near) == (1, 0)
    assert reach(hidden_distances(obj.again[:, :1024].contiguous(), obj.backs), near) == (1, 0)
    one = hidden_distances(obj.backs[1:2].expand(4, -1, -1).contiguous(), obj.backs)
    assert reach(one, near) == (pytest.approx(1 / 3), 0)
    assert one[:, 1].tolist() == [0] * 4


def test_what_is_none_of_the_backs_is_told() -> None:
    obj = make_object(AmbiguousObject("loudspeaker", (0, 2)), 64)
    near = near_distance(obj.backs, obj.again)
    beyond = obj.backs[2:].clone()
    beyond[..., 2] -= 0.4 * (beyond[..., 2] < 0)  # twice as deep as the deepest
    assert reach(hidden_distances(beyond, obj.backs), near) == (0, 1)
    # A front that is off by a little is no matter of the back.
    front = obj.backs[:1].clone()
    front[..., 2] += 0.03 * (front[..., 2] > front[..., 2].max() - 0.1)
    whole = hidden_distances(front, obj.backs, apart=None)[0, 0].item()
    assert hidden_distances(front, obj.backs)[0, 0].item() < 0.05 * whole
