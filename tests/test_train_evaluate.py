"""Evaluation: closed forms of the metrics, the retrieval baselines, and what evaluation.json holds."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from models import build_generator
from train.data.batches import load_split
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.metrics import cloud_errors, thin_out, transport_error
from train.evaluation.per_shape import METRICS
from train.evaluation.retrieval import medoid, nearest_by_image
from train.methods.weights import save_weights
from train.show.figures import errors_figure
from train.show.table import format_table


def _lattice() -> torch.Tensor:
    axis = torch.arange(5.0)
    return torch.cartesian_prod(axis, axis, axis)


def test_a_shifted_lattice_is_200_shifts_away() -> None:
    lattice = _lattice()
    errors = cloud_errors((lattice + torch.tensor([0.0, 0.06, 0.08]))[None], lattice[None])
    assert errors.cd.item() == pytest.approx(200 * 0.1, rel=1e-4)
    assert errors.gt_to_pred.item() == pytest.approx(errors.pred_to_gt.item(), rel=1e-4)


def test_missing_parts_cost_in_one_direction_only() -> None:
    lattice = _lattice()
    errors = cloud_errors(lattice[None, :25], lattice[None])
    assert errors.pred_to_gt.item() == 0
    assert errors.gt_to_pred.item() == pytest.approx(100 * (1 + 2 + 3 + 4) / 5, rel=1e-4)


def test_the_fscore_counts_points_within_a_hundredth() -> None:
    truth = _lattice()[None]
    near, far = truth + torch.tensor([0.009, 0.0, 0.0]), truth + torch.tensor([0.011, 0.0, 0.0])
    assert cloud_errors(near, truth).fscore.item() == 1
    assert cloud_errors(far, truth).fscore.item() == 0
    # Half of the truth is predicted, and as many points elsewhere: precision 1/2, recall 1/2.
    half = torch.cat([truth[:, :62], truth[:, :62] + 100], dim=1)
    precision, recall = 0.5, 62 / 125
    expected = 2 * precision * recall / (precision + recall)
    assert cloud_errors(half, truth).fscore.item() == pytest.approx(expected)


def test_the_transport_error_of_a_shift_is_the_shift_and_sees_crowding() -> None:
    torch.manual_seed(0)
    cloud = torch.rand(1, 64, 3)
    shifted = cloud + torch.tensor([0.0, 0.03, 0.04])
    assert transport_error(shifted, cloud, points=64).item() == pytest.approx(5.0, rel=0.021)
    assert transport_error(cloud, cloud, points=16).item() == 0
    # Every point of the first cloud is a point of the truth, but crowded on one half of it.
    truth = _lattice()[None]
    crowded = truth[:, :50].repeat(1, 3, 1)[:, :125]
    assert cloud_errors(crowded, truth).pred_to_gt.item() == 0
    assert transport_error(crowded, truth, points=125).item() > 50


def test_thinning_keeps_a_spread_out_subset_and_small_clouds_whole() -> None:
    torch.manual_seed(0)
    cloud = torch.rand(2, 400, 3)
    thin = thin_out(cloud, 50)
    assert thin.shape == (2, 50, 3)
    reach = torch.cdist(cloud, thin).amin(2).amax(1)
    assert (reach < torch.cdist(cloud, cloud[:, :50]).amin(2).amax(1)).all()
    assert thin_out(cloud, 400) is cloud


def test_the_medoid_is_the_cloud_in_the_middle() -> None:
    torch.manual_seed(0)
    base = torch.rand(512, 3)
    shifts = torch.tensor([-0.5, -0.2, 0.0, 0.3, 0.9])
    clouds = torch.stack([base + torch.tensor([shift, 0.0, 0.0]) for shift in shifts])
    assert medoid(clouds) == 2


@pytest.mark.parametrize("chunk_bytes", [2**28, 1], ids=["all at once", "one by one"])
def test_the_nearest_training_shape_by_image(
    chunk_bytes: int, tiny_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("train.evaluation.retrieval._CHUNK_BYTES", chunk_bytes)
    train, test = (
        load_split(tiny_data, name, image_size=(48, 64), map_size=16, progress=False)
        for name in ("train", "test")
    )
    found = nearest_by_image(train, train, views=(1, 4))
    assert all(index.tolist() == list(range(len(train))) for index in found.values())
    # Against all distances at once. The split twice: of equally near shapes the first counts.
    twice = dataclasses.replace(train, images=[*train.images] * 2, ids=train.ids * 2)
    known, seen = (torch.stack(list(split.images)).flatten(2).double() / 255 for split in (twice, test))
    distance = torch.cdist(seen.flatten(0, 1), known.flatten(0, 1)).view(len(test), 4, len(twice), 4).amin(3)
    for n, index in nearest_by_image(test, twice, views=(1, 2, 4)).items():
        assert index.tolist() == distance[:, :n].sum(1)[:, : len(train)].argmin(1).tolist()


def test_evaluation_holds_what_the_design_promises(smoke_run: Path, tiny_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "evaluation.json"
    result = evaluate(smoke_run, tiny_data, seeds=(0, 1), out=out, progress=False)
    assert json.loads(out.read_text()) == json.loads(json.dumps(result))
    assert {
        "profile",
        "config",
        "data",
        "seeds",
        "medoid",
        "views",
        "categories",
        "sensitivity",
    } <= result.keys()
    assert result["seeds"] == [0, 1]
    assert list(result["views"]) == ["1", "2", "4"]  # the data have four views
    for n, row in result["views"].items():
        assert list(row) == list(METRICS)
        assert {"gt_to_pred", "pred_to_gt", "cd", "fps_cd", "consistency"} <= row.keys()
        assert row["cd"] == pytest.approx(row["gt_to_pred"] + row["pred_to_gt"], rel=1e-5)
        assert row["fps_cd"] == pytest.approx(row["fps_gt_to_pred"] + row["fps_pred_to_gt"], rel=1e-5)
        assert row["emd"] > max(row["fps_pred_to_gt"] / 2, 0)
        assert 0 <= row["fscore_01"] < 0.5
        assert 0 < result["spread"][n]["cd"] < 1
        assert (row["consistency"] is None) == (n == "1")
        if n != "1":
            assert row["consistency"] < result["random_codes"][n]["consistency"]
    assert result["views"]["1"]["cd"] == result["views"]["1"]["fps_cd"]
    assert set(result["medoid"]) == {"cd", "fps_cd"}
    assert set(result["nearest_image"]) == {"1", "2", "4"}
    assert min(result["sensitivity"].values()) > 0.5
    shapes = {name: entry["shapes"] for name, entry in result["categories"].items()}
    assert sum(shapes.values()) == result["data"]["shapes"] == 3
    weighted = sum(entry["shapes"] * entry["views"]["4"]["cd"] for entry in result["categories"].values()) / 3
    assert weighted == pytest.approx(result["views"]["4"]["cd"], rel=1e-5)
    by_class = [entry["views"]["4"]["cd"] for entry in result["categories"].values()]
    assert result["class_average"]["4"]["cd"] == pytest.approx(sum(by_class) / len(by_class))
    for n in ("2", "4"):
        agreed = result["agreement"][n]
        assert agreed["random"] > agreed["searched"] > agreed["descended"]
        assert agreed["lowered_share"] >= 0.8
        assert agreed["descended"] == pytest.approx(result["views"][n]["consistency"], rel=1e-5)
    assert result["diversity"]["codes"] == 10
    assert result["diversity"]["mean"] > 0.5
    table = format_table(result)
    assert f"{result['views']['4']['cd']:.2f}" in table
    assert f"{result['spread']['4']['cd']:.3f}" in table
    assert "medoid" in table
    assert "mean over categories" in table


def test_a_network_without_codes_is_scored_by_what_applies(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    weights = tmp_path / "plain.safetensors"
    save_weights(build_generator("smoke", deterministic=True), weights)
    result = evaluate(weights, tiny_data, seeds=(0, 1), views=(4, 1, 4), limit=2)
    assert list(result["views"]) == ["1", "4"]
    assert result["random_codes"] == result["agreement"] == {}
    assert result["diversity"] is None
    assert result["sensitivity"]["code"] == 0
    assert result["views"]["4"]["consistency"] >= 0, "its views can still disagree"
    assert (tmp_path / "evaluation.json").exists()
    assert "no codes" in capsys.readouterr().out
    assert len(errors_figure(result).axes[0].lines) == 3


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"seeds": ()}, "--seeds needs at least one"),
        ({"views": (0, 2)}, "none below 1"),
        ({"limit": 0}, "--limit must be at least 1"),
    ],
)
def test_numbers_out_of_range_are_refused(
    wrong: dict, complaint: str, smoke_run: Path, tiny_data: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=complaint):
        evaluate(smoke_run, tiny_data, out=tmp_path / "never.json", progress=False, **wrong)
    assert not list(tmp_path.iterdir())


def test_evaluation_is_repeatable(smoke_run: Path, tiny_data: Path, tmp_path: Path) -> None:
    first, again = (
        evaluate(smoke_run, tiny_data, views=(2,), out=tmp_path / f"{i}.json", progress=False)
        for i in range(2)
    )
    assert first == again
