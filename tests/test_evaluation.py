"""Evaluation: metrics in closed form, retrieval, evaluation.json; inference by search and descent; weights."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import train
from diffpoint import consistency_loss
from models import PROFILES, Generator, build_generator
from train.__main__ import main
from train.config import InferenceConfig
from train.data.batches import load_split
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors, thin_out, transport_error
from train.evaluation.per_shape import METRICS
from train.evaluation.retrieval import medoid, nearest_by_image
from train.methods.weights import save_weights
from train.show.figures import errors_figure
from train.show.summary import format_result

# --- metrics and retrieval


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
    target = _lattice()[None]
    near, far = target + torch.tensor([0.009, 0.0, 0.0]), target + torch.tensor([0.011, 0.0, 0.0])
    assert cloud_errors(near, target).fscore.item() == 1
    assert cloud_errors(far, target).fscore.item() == 0
    # Half of the target is predicted, and as many points elsewhere: precision 1/2, recall 1/2.
    half = torch.cat([target[:, :62], target[:, :62] + 100], dim=1)
    precision, recall = 0.5, 62 / 125
    expected = 2 * precision * recall / (precision + recall)
    assert cloud_errors(half, target).fscore.item() == pytest.approx(expected)


def test_the_transport_error_of_a_shift_is_the_shift_and_sees_crowding() -> None:
    torch.manual_seed(0)
    cloud = torch.rand(1, 64, 3)
    shifted = cloud + torch.tensor([0.0, 0.03, 0.04])
    assert transport_error(shifted, cloud, points=64).item() == pytest.approx(5.0, rel=0.021)
    assert transport_error(cloud, cloud, points=16).item() == 0
    # Every point of the first cloud is a point of the target, but crowded on one half of it.
    target = _lattice()[None]
    crowded = target[:, :50].repeat(1, 3, 1)[:, :125]
    assert cloud_errors(crowded, target).pred_to_gt.item() == 0
    assert transport_error(crowded, target, points=125).item() > 50


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
    known, seen = (
        torch.stack([each[:] for each in split.images]).flatten(2).double() / 255 for split in (twice, test)
    )
    distance = torch.cdist(seen.flatten(0, 1), known.flatten(0, 1)).view(len(test), 4, len(twice), 4).amin(3)
    for n, index in nearest_by_image(test, twice, views=(1, 2, 4)).items():
        assert index.tolist() == distance[:, :n].sum(1)[:, : len(train)].argmin(1).tolist()


# --- evaluation.json


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
    table = format_result(result)
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
    out = tmp_path / "framed.json"
    framed = evaluate(smoke_run, tiny_data, views=(2,), framed=True, out=out, progress=False)
    assert framed["data"]["framed"] and not first["data"]["framed"]
    assert framed["views"] != first["views"], "other pictures give other predictions"
    assert framed["nearest_image"] != first["nearest_image"]
    assert framed["medoid"] == first["medoid"]


# --- search and descent on the codes


@pytest.fixture(scope="module")
def model() -> Generator:
    torch.manual_seed(0)
    return build_generator("smoke").eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """(2, 3, 3, 48, 64): two objects in three views each."""
    generator = torch.Generator().manual_seed(1)
    images = torch.ones(2, 3, 3, 48, 64)
    images[..., 10:40, 12:50] = torch.rand(2, 3, 3, 30, 38, generator=generator)
    return images


def test_search_and_descent_bring_agreement(model: Generator, images: torch.Tensor) -> None:
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    found = reconstruct(model, images, groups=3, steps=8, step_size=2.0)
    assert found.points.shape == (2, 3 * model.points, 3)
    assert found.history.shape == (9, 2)
    assert (found.history[-1] < found.history[0]).all()
    one_by_one = found.points.unflatten(1, (3, model.points))
    torch.testing.assert_close(found.history[-1], 100 * consistency_loss(one_by_one, reduction="none"))
    torch.testing.assert_close(
        one_by_one.flatten(0, 1), model(images.flatten(0, 1), found.codes.flatten(0, 1)[None])[0].detach()
    )
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())


def test_the_descent_starts_from_the_most_consistent_group(model: Generator, images: torch.Tensor) -> None:
    starts = [reconstruct(model, images, groups=groups, steps=0).history[0] for groups in (1, 2, 5)]
    assert (starts[1] <= starts[0]).all()
    assert (starts[2] <= starts[1]).all()
    assert (starts[2] < starts[0]).any()


def test_the_codes_move_only_by_the_descent(model: Generator, images: torch.Tensor) -> None:
    searched = reconstruct(model, images, groups=2, steps=0).codes
    descended = reconstruct(model, images, groups=2, steps=2).codes
    moved = (descended - searched).norm(dim=-1)
    assert (moved > 0).all()
    assert torch.equal(searched, reconstruct(model, images, groups=2, steps=2, step_size=0.0).codes)


def test_objects_do_not_interact(model: Generator, images: torch.Tensor) -> None:
    together = reconstruct(model, images, groups=2, steps=3)
    other = images.clone()
    other[1] = other[1].flip(-1) * 0.5
    beside_another = reconstruct(model, other, groups=2, steps=3)
    torch.testing.assert_close(together.points[0], beside_another.points[0])
    assert not torch.allclose(together.points[1], beside_another.points[1])


def test_the_seed_decides(model: Generator, images: torch.Tensor) -> None:
    first, again, other = (reconstruct(model, images, groups=2, steps=1, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.codes, other.codes)


def test_one_object_needs_no_batch_dimension(model: Generator, images: torch.Tensor) -> None:
    assert torch.equal(
        reconstruct(model, images[0], groups=2, steps=1).points,
        reconstruct(model, images[:1], groups=2, steps=1).points,
    )


def test_one_view_has_nothing_to_agree_with(model: Generator, images: torch.Tensor) -> None:
    found = reconstruct(model, images[:, :1], groups=2, steps=5)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, model.points, 3)


def test_of_one_view_s_predictions_the_medoid_is_kept(model: Generator, images: torch.Tensor) -> None:
    settings = InferenceConfig(groups=7, medoid=True)
    found = reconstruct(model, images[:, :1], settings=settings, seed=3)
    drawn = torch.randn(7, 2, 1, model.code_dim, generator=torch.Generator().manual_seed(3))[:, :, 0]
    clouds = model(images[:, 0], drawn).detach()
    for image in range(2):
        distances = [
            sum(100 * consistency_loss(torch.stack([a, b])).item() for b in clouds[:, image] if b is not a)
            for a in clouds[:, image]
        ]
        torch.testing.assert_close(found.codes[image, 0], drawn[distances.index(min(distances)), image])
    first = reconstruct(model, images[:, :1], settings=dataclasses.replace(settings, medoid=False), seed=3)
    torch.testing.assert_close(first.codes[:, 0], drawn[0])
    assert not torch.equal(first.codes, found.codes)


def test_a_deterministic_network_has_nothing_to_choose(images: torch.Tensor) -> None:
    plain = build_generator("smoke", deterministic=True)
    found = reconstruct(plain, images)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, 3 * plain.points, 3)


def test_the_history_is_that_of_plain_descent(model: Generator, images: torch.Tensor) -> None:
    """The rows of `history` against a loop written out here."""
    found = reconstruct(model, images, groups=1, steps=3, step_size=2.0)
    codes = reconstruct(model, images, groups=1, steps=0).codes
    losses = []
    for _ in range(4):
        codes = codes.detach().requires_grad_()
        clouds = model(images.flatten(0, 1), codes.flatten(0, 1)[None])[0].unflatten(0, (2, 3))
        loss = 100 * consistency_loss(clouds, reduction="none")
        losses.append(loss.detach())
        codes = codes - 2.0 * torch.autograd.grad(loss.sum(), codes)[0]
    torch.testing.assert_close(found.history, torch.stack(losses))
    assert found.kept.tolist() == [3, 3]


def test_the_best_codes_are_kept_when_the_descent_overshoots(model: Generator, images: torch.Tensor) -> None:
    wild = InferenceConfig(groups=1, steps=12, step_size=3_000.0)
    last, best = (
        reconstruct(model, images, settings=dataclasses.replace(wild, keep_best=keep))
        for keep in (False, True)
    )
    torch.testing.assert_close(last.history, best.history)
    assert (last.history[-1] > last.history.amin(0)).any(), "these steps are meant to overshoot"
    assert torch.equal(best.kept, best.history.argmin(0))
    assert last.kept.tolist() == [12, 12]
    for found in (last, best):
        clouds = found.points.unflatten(1, (3, model.points))
        kept = found.history.gather(0, found.kept[None])[0]
        torch.testing.assert_close(100 * consistency_loss(clouds, reduction="none"), kept)


def test_each_object_stops_when_its_own_loss_no_longer_falls(model: Generator, images: torch.Tensor) -> None:
    patient = InferenceConfig(groups=1, steps=20, step_size=1.0)
    whole = reconstruct(model, images, settings=patient).history
    drops = -whole.diff(dim=0)
    # A threshold between the two objects' first drops: one object stops at once, the other goes on.
    order = drops[0].argsort()
    threshold = drops[0].mean().item()
    stopping = dataclasses.replace(patient, patience=1, min_drop=threshold)
    found = reconstruct(model, images, settings=stopping)
    assert found.kept[order[0]] == 1
    assert found.kept[order[1]] > 1
    assert len(found.history) == 1 + found.kept.max()
    for shape, step in enumerate(found.kept.tolist()):
        torch.testing.assert_close(found.history[: step + 1, shape], whole[: step + 1, shape])
        assert (found.history[step:, shape] == found.history[step, shape]).all()


def test_restraints_hold_the_codes_near_where_they_were_drawn(model: Generator, images: torch.Tensor) -> None:
    far = InferenceConfig(groups=1, steps=6, step_size=50.0)
    start = reconstruct(model, images, groups=1, steps=0).codes.norm(dim=-1)
    free = reconstruct(model, images, settings=far).codes.norm(dim=-1)
    held = reconstruct(model, images, settings=dataclasses.replace(far, keep_norm=True)).codes.norm(dim=-1)
    pulled = reconstruct(model, images, settings=dataclasses.replace(far, prior=0.01)).codes.norm(dim=-1)
    assert not torch.allclose(free, start, rtol=1e-3)
    torch.testing.assert_close(held, start)
    assert (pulled < free).all()


def test_parts_of_a_batch_make_the_whole(
    model: Generator, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopping = InferenceConfig(groups=2, steps=5, step_size=1.0, patience=1, min_drop=0.05)
    whole = reconstruct(model, images, settings=stopping)
    monkeypatch.setattr("train.evaluation.inference._POINTS_AT_ONCE", 1)
    in_parts = reconstruct(model, images, settings=stopping)
    assert torch.equal(whole.kept, in_parts.kept)
    assert len(set(whole.kept.tolist())) == 2, "the parts are meant to stop at different steps"
    # The network rounds differently at another batch size, and nearest points may change with it.
    torch.testing.assert_close(whole.history, in_parts.history, rtol=1e-3, atol=0)
    torch.testing.assert_close(whole.points, in_parts.points, rtol=0, atol=5e-3)


def test_two_dozen_views_agree(model: Generator) -> None:
    images = torch.rand(24, 3, 48, 64, generator=torch.Generator().manual_seed(2))
    found = reconstruct(model, images, groups=2, steps=2, step_size=2.0)
    assert found.points.shape == (1, 24 * model.points, 3)
    assert found.history[-1] < found.history[0]


def test_arguments_go_before_settings(model: Generator, images: torch.Tensor) -> None:
    settings = InferenceConfig(groups=1, steps=7, step_size=0.3)
    found = reconstruct(model, images, steps=2, settings=settings)
    assert len(found.history) == 3
    assert torch.equal(found.codes, reconstruct(model, images, groups=1, steps=2, step_size=0.3).codes)
    assert len(reconstruct(model, images[:1, :2]).history) == 31, "30 steps when nothing is said"


def test_wrong_arguments_are_named(model: Generator) -> None:
    with pytest.raises(ValueError, match=r"'images' must be .* got \(3, 48, 64\)"):
        reconstruct(model, torch.ones(3, 48, 64))
    with pytest.raises(ValueError, match="'images' must be"):
        reconstruct(model, torch.ones(0, 3, 48, 64))
    with pytest.raises(ValueError, match="groups >= 1"):
        reconstruct(model, torch.ones(2, 3, 48, 64), groups=0)
    with pytest.raises(ValueError, match=r"patience >= 0; got 5, 30 and -1"):
        reconstruct(model, torch.ones(2, 3, 48, 64), settings=InferenceConfig(patience=-1))


# --- weights


def _header(path: Path) -> dict:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["diffpoint.generator"])


def test_headers_of_earlier_versions_are_read_and_new_names_written(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = build_generator(config=dataclasses.replace(PROFILES["smoke"], occupancy_logits=True))
    save_weights(model, tmp_path / "new.safetensors")
    header = _header(tmp_path / "new.safetensors")
    assert header == dataclasses.asdict(model.config)

    header["ending"], header["existence"] = header.pop("output_head"), header.pop("occupancy_logits")
    tensors = {name: value.contiguous() for name, value in model.state_dict().items()}
    save_file(tensors, tmp_path / "old.safetensors", {"diffpoint.generator": json.dumps(header)})
    old = train.load_generator(tmp_path / "old.safetensors")
    assert old.config == model.config
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in old.state_dict().items())


def test_a_run_becomes_one_file_of_half_the_size(smoke_run: Path, tmp_path: Path) -> None:
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    assert main(["export", str(smoke_run), "--out", str(whole)]) == 0
    assert main(["export", str(smoke_run), "--out", str(half), "--half"]) == 0
    assert half.stat().st_size < 0.55 * whole.stat().st_size
    expected, exact, near = (train.load_generator(each) for each in (smoke_run, whole, half))
    images, codes = torch.rand(2, 3, 48, 64), torch.randn(2, 2, expected.code_dim)
    clouds = expected(images, codes)
    assert torch.equal(exact(images, codes), clouds)
    assert 0 < (near(images, codes) - clouds).abs().max() < 2e-3
    assert main(["export", str(smoke_run), "--out", str(tmp_path / "weights.pt")]) == 2
    assert not (tmp_path / "weights.pt").exists()


def test_the_shipped_weights_load() -> None:
    model = train.load_generator("pretrained")
    assert model.config.output_head == "points"
    assert not model.training


# --- from Python


def test_a_bare_import_offers_the_python_interface_and_loads_nothing() -> None:
    code = """
import sys, train
assert "torch" not in sys.modules and {"load_generator", "reconstruct", "data"} <= set(dir(train))
import torch
model = train.load_generator("pretrained")
found = train.reconstruct(model, torch.rand(2, 3, 32, 32), groups=2, steps=1, seed=0)
assert isinstance(found, train.Reconstruction) and found.points.shape == (1, 2 * model.points, 3)
assert train.data.ShapeTree.__name__ == "ShapeTree" and not model.training
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with pytest.raises(AttributeError, match="no attribute 'load_critic'"):
        _ = train.load_critic  # pyright: ignore[reportAttributeAccessIssue]


def test_a_run_can_be_named_by_its_directory_or_file_as_str_or_path(smoke_run: Path) -> None:
    best = smoke_run / "checkpoints" / "best-stage2.safetensors"
    weights = [train.load_generator(named).state_dict() for named in (smoke_run, str(smoke_run), str(best))]
    for other in weights[1:]:
        assert all(torch.equal(value, weights[0][name]) for name, value in other.items())
