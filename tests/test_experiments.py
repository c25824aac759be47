"""Experiments: what they measure is what they write, on paper and in JSON."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from models import build_generator
from train.config import InferenceConfig
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.per_shape import ShapeMetrics, evaluate_split
from train.experiments.agreement import WAYS, agreement
from train.experiments.run import EXPERIMENTS, Workbench, run_experiment
from train.methods.weights import save_weights

_WAYS = {
    "random codes": InferenceConfig(groups=1, steps=0),
    "searched": InferenceConfig(groups=3, steps=0),
    "descended": InferenceConfig(groups=3, steps=3, step_size=1.0),
}


def test_agreement_writes_what_it_measured(smoke_run: Path, tiny_data: Path, tmp_path: Path) -> None:
    bench = Workbench((tiny_data,), tmp_path, "smoke", seeds=2, limit=2, progress=False)
    found = agreement(bench, smoke_run, views=3, ways=_WAYS)
    assert json.loads((tmp_path / "agreement.json").read_text()) == json.loads(json.dumps(found))
    assert sorted(path.name for path in tmp_path.glob("*.*")) == [
        f"agreement.{kind}" for kind in ("json", "md", "png")
    ]
    loss = {name: way["mean"]["consistency"] for name, way in found["ways"].items()}
    assert loss["descended"] < loss["searched"] < loss["random codes"]
    assert found["ways"]["descended"]["lowered_share"] == 1
    assert found["ways"]["searched"]["lowered_share"] is None
    assert found["ways"]["random codes"]["against_random"]["cd"] == {"mean": 0, "standard_error": 0}
    change = found["ways"]["descended"]["against_random"]["fps_cd"]["mean"]
    means = [found["ways"][name]["mean"]["fps_cd"] for name in ("descended", "random codes")]
    assert change == pytest.approx(means[0] - means[1], abs=1e-4)
    assert all(-1 <= r <= 1 for pair in found["correlation"].values() for r in pair.values())
    text = (tmp_path / "agreement.md").read_text()
    assert f"| {loss['descended']:.2f} |" in text
    assert f"disagree by {found['floor']:.2f}" in text
    with Image.open(tmp_path / "agreement.png") as picture:
        assert picture.size[0] > 1000


def test_agreement_goes_on_where_it_was(
    smoke_run: Path, tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scored: list[object] = []

    def counted(*args: object, **settings: object) -> ShapeMetrics:
        scored.append(settings)
        if len(scored) == 3:
            raise KeyboardInterrupt
        return evaluate_split(*args, **settings)

    module = importlib.import_module("train.experiments.agreement")
    monkeypatch.setattr(module, "evaluate_split", counted)
    monkeypatch.setattr(module, "_GROUPS", 2)
    bench = Workbench((tiny_data,), tmp_path, "smoke", seeds=1, limit=2, progress=False)
    with pytest.raises(KeyboardInterrupt):
        agreement(bench, smoke_run, views=2, ways=_WAYS)
    found = agreement(bench, smoke_run, views=2, ways=_WAYS)
    # The one that was interrupted is the only one that is taken again.
    assert len(scored) == 1 + len(_WAYS) + 2
    assert agreement(bench, smoke_run, views=2, ways=_WAYS) == found
    assert len(scored) == 1 + len(_WAYS) + 2  # all was kept
    other = tmp_path / "other.safetensors"
    torch.manual_seed(0)
    save_weights(build_generator("smoke"), other)
    assert agreement(bench, other, views=2, ways=_WAYS)["ways"] != found["ways"]


def test_random_codes_are_those_of_the_evaluation(smoke_run: Path, tiny_data: Path, tmp_path: Path) -> None:
    bench = Workbench((tiny_data,), tmp_path, "smoke", seeds=1, progress=False)
    found = agreement(bench, smoke_run, views=2, ways={"random codes": _WAYS["random codes"]})
    scored = evaluate(smoke_run, tiny_data, views=(2,), out=tmp_path / "evaluation.json", progress=False)
    assert found["ways"]["random codes"]["mean"] == pytest.approx(scored["random_codes"]["2"])


def test_the_paper_s_setting_is_among_the_ways() -> None:
    assert InferenceConfig(groups=5, steps=30, step_size=0.5) in WAYS.values()
    assert WAYS["random codes"] == InferenceConfig(groups=1, steps=0)


@pytest.mark.parametrize("name", sorted(set(EXPERIMENTS) - {"front-vs-projection", "photos", "runtime"}))
def test_no_data_is_said_and_nothing_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no data; name one or more data trees with --data"):
        run_experiment(name, Workbench((), tmp_path, "smoke", progress=False))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("views", [1, 5])
def test_a_wrong_number_of_views_is_refused(
    views: int, smoke_run: Path, tiny_data: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=rf"between 2 and the 4 that .* got {views}"):
        bench = Workbench((tiny_data,), tmp_path, "smoke", progress=False)
        run_experiment("agreement", bench, run=smoke_run, views=views)
    assert not list(tmp_path.iterdir())


def test_a_network_without_codes_is_refused(tiny_data: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    weights = tmp_path / "plain.safetensors"
    save_weights(build_generator("smoke", deterministic=True), weights)
    with pytest.raises(UserError, match="takes no codes"):
        run_experiment("agreement", Workbench((tiny_data,), tmp_path / "out", progress=False), run=weights)
    assert not (tmp_path / "out").exists()
