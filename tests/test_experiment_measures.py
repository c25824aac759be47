"""Every experiment beside the tables: its measure gives known values on known shapes, and its result says what it
measured."""

from __future__ import annotations

import dataclasses
import importlib
import json
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from diffpoint import PinholeCamera
from models import build_generator
from models.parts import prepare_images
from tests.photographs import as_jpeg, surface_for, take
from train.config import InferenceConfig
from train.data.ambiguity_check import AmbiguousObject
from train.data.batches import Batch, LoadedSplit
from train.data.families.chair import CHAIR
from train.data.photos import convert_photos
from train.data.procedural import generate
from train.data.rays import has_embree
from train.data.solids import Solid, box, sample_union, surface_of
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.metrics import cloud_errors
from train.evaluation.per_shape import one_view_each, view_order
from train.evaluation.runs import load_autoencoder, read_metrics
from train.experiments.agreement import SETTINGS
from train.experiments.collapse import VARIANTS
from train.experiments.correlation import correlate, pearson, spearman
from train.experiments.coverage import APART, hidden_distances, make_object, reach
from train.experiments.hidden_points import Rays, Scene, embedded_scene, make_scene, quality
from train.experiments.one_armed import presence
from train.experiments.one_armed_chairs import (
    HIDDEN,
    SEED,
    SHOWN,
    Arms,
    OneArmedChair,
    arm_of,
    make_chair,
    one_armed_chairs,
    without,
)
from train.experiments.page import write_page
from train.experiments.paper import TABLES, with_critic
from train.experiments.photos import read_objects
from train.experiments.predictions import variation
from train.experiments.reconstructions import by_turns
from train.experiments.registry import load
from train.experiments.run import run_experiment
from train.experiments.runtime import medians
from train.experiments.status import status
from train.experiments.study import Study, of_method
from train.experiments.ten_predictions import below_real_shapes
from train.methods.weights import save_weights
from train.show import figures

needs_embree = pytest.mark.skipif(not has_embree(), reason="embreex has no wheel here")


def module(name: str) -> Any:
    """A module of the experiments, to shorten its constants."""
    return importlib.import_module(f"train.experiments.{name}")


@pytest.fixture(scope="module")
def study(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Study:
    """What all experiments of this file share, trainings included."""
    out = tmp_path_factory.mktemp("measures")
    return Study((tiny_data,), out, "smoke", seeds=1, limit=3, steps=3, progress=False)


def made_once(name: str, study: Study, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, Any], str]:
    """The result and the page; JSON and figure are there, and a second call trains and measures nothing."""
    result = run_experiment(name, study)
    assert json.loads((study.out / f"{name}.json").read_text()) == json.loads(json.dumps(result))
    with Image.open(study.out / f"{name}.png") as picture:
        assert min(picture.size) > 150 and picture.convert("L").getextrema()[0] < 128

    def times() -> dict[Path, int]:
        parts = ("runs", "metrics", "collapse")
        files = [path for part in parts for path in (study.out / part).rglob("*")]
        return {path: path.stat().st_mtime_ns for path in files}

    before = times()
    with monkeypatch.context() as patch:
        patch.setattr(figures, "save", lambda figure, path: None)  # takes a second, and measures nothing
        again = run_experiment(name, study)
    assert times() == before and json.dumps(again, sort_keys=True) == json.dumps(result, sort_keys=True)
    return result, (study.out / f"{name}.md").read_text()


# Predictions: where codes make a difference


def test_predictions_are_measured_and_drawn(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    result, page = made_once("predictions", study, monkeypatch)
    assert result["categories"] and set(result["categories"]) <= {"chair", "display"}
    assert f"{result['all']['ratio']:.2f}" in page
    assert result["all"]["front"] > 0 and 0 < result["all"]["front_share"] < 1


def _ball(points: int) -> Tensor:
    directions = torch.randn(points, 3, generator=torch.Generator().manual_seed(0))
    return 0.4 * directions / directions.norm(dim=-1, keepdim=True)


def test_variation_is_told_apart_in_front_and_behind() -> None:
    camera = PinholeCamera.look_at(torch.tensor([[[0.0, 0, 2]]]), focal_px=105.0, height=56, width=56)
    noise = torch.randn(4, 1, 2000, 3, generator=torch.Generator().manual_seed(1))
    found = variation(_ball(2000) + 0.002 * noise, camera)
    assert (found["back"] / found["front"]).item() == pytest.approx(1, abs=0.05)
    assert (found["back_surface"] / found["front_surface"]).item() == pytest.approx(1, abs=0.1)
    assert found["front_share"].item() == pytest.approx(0.4, abs=0.1)  # the cap seen from five radii

    ball = _ball(2000)[None, None].repeat(3, 1, 1, 1)
    depth = torch.tensor([0.0, 0.1, 0.2])[:, None, None] * (ball[..., 2] < -0.1)
    found = variation(ball - torch.stack([0 * depth, 0 * depth, depth], -1), camera)
    assert found["front"].item() < 0.2 and found["front_surface"].item() < 0.2
    assert found["back"].item() > 10 * found["front"].item()


# Coverage: which backs are reached


def test_coverage_is_measured_and_drawn(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    result, page = made_once("coverage", study, monkeypatch)
    rows = result["rows"]
    assert rows["ours, 10 codes"]["reached"]["mean"] <= rows["ours, 50 codes"]["reached"]["mean"]
    assert rows["deterministic"]["reached"]["mean"] <= 1 / 3
    assert f"{rows['deterministic']['none']['mean']:.0%}" in page
    more = rows["highly diverse, 10 codes"]["reached"]["mean"] - rows["ours, 10 codes"]["reached"]["mean"]
    claim = result["claims"][1]
    assert claim["words"] == "backs reached, %: ours, 10 codes < highly diverse, 10 codes"
    assert claim["gain"] == pytest.approx(100 * more) and claim["words"] in page


def test_coverage_of_a_given_run_trains_nothing(
    study: Study, smoke_run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    of_run = dataclasses.replace(study, run=smoke_run, out=tmp_path / "out", seeds=2)
    result, page = made_once("coverage", of_run, monkeypatch)
    assert not (of_run.out / "runs").exists()
    row = result["rows"][f"{smoke_run}, 10 codes"]
    assert row["none"]["mean"] > 0.3  # after 50 steps
    assert f"the run {smoke_run}, codes drawn 2 times" in page
    assert not result["claims"]


def test_backs_cover_themselves_and_nothing_else_does() -> None:
    obj = make_object(AmbiguousObject("loudspeaker", (0, 2)), 64)
    near = obj.limits[APART]
    assert reach(hidden_distances(obj.backs, obj.backs), near) == (1, 0)
    assert reach(hidden_distances(obj.again[:, :1024].contiguous(), obj.backs), near) == (1, 0)
    one = hidden_distances(obj.backs[1:2].expand(4, -1, -1).contiguous(), obj.backs)
    assert reach(one, near) == (pytest.approx(1 / 3), 0) and one[:, 1].tolist() == [0] * 4
    beyond = obj.backs[2:].clone()
    beyond[..., 2] -= 0.4 * (beyond[..., 2] < 0)  # twice as deep as the deepest
    assert reach(hidden_distances(beyond, obj.backs), near) == (0, 1)
    # A small error of the front does not count.
    front = obj.backs[:1].clone()
    front[..., 2] += 0.03 * (front[..., 2] > front[..., 2].max() - 0.1)
    whole = hidden_distances(front, obj.backs, apart=None)[0, 0].item()
    assert hidden_distances(front, obj.backs)[0, 0].item() < 0.05 * whole


# Correlation


def test_correlation_is_measured_and_drawn(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module("correlation"), "GROUPS", 3)
    result, page = made_once("correlation", study, monkeypatch)
    found = result["within_shapes"]["cd"]["pearson"]
    assert found["by_seed"] == [found["mean"]] and -1 <= found["interval"][0] <= found["interval"][1] <= 1
    assert f"{found['mean']:+.2f} [" in page


def test_coefficients_of_known_data() -> None:
    x = np.tile(np.linspace(0, 1, 20), (3, 1))
    y = np.stack([x[0], -np.exp(x[1]), x[2] * 0])
    assert pearson(x, y) == pytest.approx([1, np.corrcoef(x[1], y[1])[0, 1], 0])
    assert spearman(x, y) == pytest.approx([1, -1, 0])
    over_shapes, means = correlate(x[:2], y[:2], spearman)
    assert over_shapes == pytest.approx([1, -1]) and sorted(np.unique(means.round(6))) == [-1, 0, 1]
    within, means = correlate(x[None, :2], y[None, :2], pearson)
    assert within == pytest.approx([(1 + pearson(x, y)[1]) / 2]) and len(means) > 1000


# Agreement


_FEW_SETTINGS = {
    "random codes": InferenceConfig(groups=1, steps=0),
    "searched": InferenceConfig(groups=3, steps=0),
    "descended": InferenceConfig(groups=3, steps=3, step_size=1.0),
}


def test_agreement_is_measured_once(
    smoke_run: Path, tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert InferenceConfig(groups=5, steps=30, step_size=0.5) in SETTINGS.values()  # the paper's
    monkeypatch.setattr(module("agreement"), "SETTINGS", _FEW_SETTINGS)
    monkeypatch.setattr(module("agreement"), "GROUPS", 2)
    study = Study((tiny_data,), tmp_path, "smoke", seeds=2, limit=2, run=smoke_run, views=3, progress=False)
    found, page = made_once("agreement", study, monkeypatch)
    loss = {name: each["mean"]["consistency"] for name, each in found["ways"].items()}
    assert loss["descended"] < loss["searched"] < loss["random codes"]
    assert found["ways"]["descended"]["lowered_share"] == 1
    assert found["ways"]["searched"]["lowered_share"] is None
    assert found["ways"]["random codes"]["against_random"]["cd"] == {"mean": 0, "standard_error": 0}
    change = found["ways"]["descended"]["against_random"]["fps_cd"]["mean"]
    means = [found["ways"][name]["mean"]["fps_cd"] for name in ("descended", "random codes")]
    assert change == pytest.approx(means[0] - means[1], abs=1e-4)
    assert all(-1 <= r <= 1 for pair in found["correlation"].values() for r in pair.values())
    assert f"| {loss['descended']:.2f} |" in page and f"loss of {found['floor']:.2f}" in page
    other = tmp_path / "other.safetensors"
    torch.manual_seed(0)
    save_weights(build_generator("smoke"), other)
    assert run_experiment("agreement", dataclasses.replace(study, run=other))["ways"] != found["ways"]


def test_random_codes_are_those_of_the_evaluation(
    smoke_run: Path, tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module("agreement"), "SETTINGS", {"random codes": InferenceConfig(groups=1, steps=0)})
    monkeypatch.setattr(module("agreement"), "GROUPS", 2)
    study = Study((tiny_data,), tmp_path, "smoke", seeds=1, run=smoke_run, views=2, progress=False)
    found = run_experiment("agreement", study)["ways"]["random codes"]["mean"]
    evaluated = evaluate(smoke_run, tiny_data, views=(2,), out=tmp_path / "evaluation.json", progress=False)
    assert found == pytest.approx(evaluated["random_codes"]["2"])


def test_what_agreement_cannot_use_is_named(smoke_run: Path, tiny_data: Path, tmp_path: Path) -> None:
    study = Study((tiny_data,), tmp_path / "out", "smoke", run=smoke_run, progress=False)
    for views in (1, 5):
        with pytest.raises(UserError, match=rf"between 2 and the 4 that .* got {views}"):
            run_experiment("agreement", dataclasses.replace(study, views=views))
    torch.manual_seed(0)
    weights = tmp_path / "plain.safetensors"
    save_weights(build_generator("smoke", deterministic=True), weights)
    with pytest.raises(UserError, match="takes no codes"):
        run_experiment("agreement", dataclasses.replace(study, run=weights))
    assert not (tmp_path / "out").exists()


# Critic, and ten predictions


def test_the_critics_output_is_that_of_the_log(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = TABLES["critic"]
    rows = tuple(dataclasses.replace(row, views=4) for row in table.rows)
    monkeypatch.setitem(TABLES, "critic", dataclasses.replace(table, rows=rows))
    result, _ = made_once("critic", study, monkeypatch)
    assert set(result["rows"]) == {row.name for row in rows}
    run = study.run_of(study.config(with_critic, seed=0))
    scores = [record["fake_score"] for record in read_metrics(run) if "fake_score" in record]
    parts = result["critic_output"][0]["fake"]
    assert sum(parts) / len(parts) == pytest.approx(sum(scores) / len(scores), rel=0.2)
    assert (study.out / "critic-outputs.png").stat().st_size > 10_000
    shutil.move(run, tmp_path / run.name)
    outlived = run_experiment("critic", dataclasses.replace(study, measures=False))
    shutil.move(tmp_path / run.name, run)
    assert outlived == result


def test_the_ground_truth_is_nearer_to_what_images_show_than_an_untrained_network(study: Study) -> None:
    table = TABLES["diversity"]
    found = {
        row.name: row.measure(row, study, table.config(row, study, seed=0))["visible"].mean()
        for row in table.rows
        if row.name in ("diversity loss, beta 10", "samples of the ground truth")
    }
    assert found["samples of the ground truth"] < 0.7 * found["diversity loss, beta 10"]


def test_a_critic_tells_noise_from_real_shapes_and_not_real_shapes_from_themselves(study: Study) -> None:
    config = study.config(with_critic, seed=0)
    encode = load_autoencoder(study.train(config)).encode_frozen
    test, train = study.split(config, "test"), study.split(config, "train")

    def below(noise: float) -> Tensor:
        def source(split: LoadedSplit, count: int) -> Iterator[tuple[Tensor, Batch, Tensor]]:
            for shapes, shown in one_view_each(split, 0):
                true = split.points[shapes, :128].expand(count, -1, -1, -1)
                yield shapes, shown, true + noise * torch.randn(true.shape)

        found = below_real_shapes(
            source, test, trained_on=train, encode=encode, points=128, seed=0, steps=150
        )
        assert found["critic"].shape == (len(test),)
        return found["critic"].mean()

    torch.manual_seed(0)
    none, some, more = below(0.0), below(0.1), below(0.3)
    assert none.abs() < 0.2 * some and some < more


# Collapse


def test_collapse_compares_the_variants_that_it_names(
    tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study((tiny_data,), tmp_path, "smoke", seeds=1, steps=4, progress=False)
    collapse = {"collapse": load("collapse")}
    (before,) = status(collapse, study)
    result, page = made_once("collapse", study, monkeypatch)
    (after,) = status(collapse, study)
    assert (before.trained, after.trained, after.runs, after.seconds) == (0, len(VARIANTS), len(VARIANTS), 0)
    assert before.seconds is None  # no training of the kind was timed in this directory
    rows = result["trees"][tiny_data.name]
    assert list(rows) == list(VARIANTS)
    usual = rows["as it is"]
    assert all(row["front"] != usual["front"] for name, row in rows.items() if name != "as it is")
    assert f"| as it is | {usual['image'][0]:.2f} |" in page


def test_variants_undo_what_they_name() -> None:
    torch.manual_seed(0)
    images = torch.rand(2, 3, 48, 64)
    seen: list[Tensor] = []
    model = build_generator("smoke")
    (uncentre,) = VARIANTS["images not centred"].network
    uncentre(model)
    first = model.trunk[1]
    assert isinstance(first, torch.nn.Conv2d)
    first.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    model.encode(images)
    torch.testing.assert_close(seen[0], images)
    assert (prepare_images(images, (48, 64)) - images).abs().max() > 0.1

    (initialise,) = VARIANTS["torch's initialisation"].network
    before = first.weight.std()
    initialise(model)
    assert first.weight.std() < 0.8 * before


# Reconstructions


def test_reconstructions_are_those_of_each_method(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    result, page = made_once("reconstructions", study, monkeypatch)
    assert result["views_of"] == {"ours": 4, "PSGN": 1, "3D-R2N2": 4}  # the data have four
    config = study.config(of_method("psgn"), seed=0)
    test, model = study.split(config, "test"), study.network(config)
    for row, (name, errors) in enumerate(result["shapes"].items()):
        number = test.ids.index(name)
        assert errors["category"] == test.categories[number]
        first = view_order(test, 0)[number, :1]
        image = test.float_images(torch.tensor([number]), first[None])[:, 0]
        with torch.no_grad():
            cloud = model(image, torch.zeros(1, 1, model.code_dim))[0]
        expected = cloud_errors(cloud, test.points[[number]]).cd.item()
        assert errors["PSGN"]["cd"] == pytest.approx(expected, abs=1e-3)
        assert errors["PSGN"]["cd"] == errors["PSGN"]["fps_cd"] != errors["ours"]["cd"]
        assert f"{errors['ours']['cd']:.2f} ({errors['ours']['fps_cd']:.2f})" in page.splitlines()[4 + row]
    ours = [each["ours"]["cd"] for each in result["shapes"].values()]
    assert result["mean"]["ours"]["cd"] == pytest.approx(sum(ours) / len(ours))
    assert by_turns(["chair", "chair", "chair", "sofa", "lamp", "sofa"], 4).tolist() == [0, 3, 4, 1]
    assert by_turns(["chair"], 6).tolist() == [0]


# Chairs with one arm


@pytest.fixture(scope="module")
def chairs() -> list[OneArmedChair]:
    """The first one, and one with bent arms, whose other arm stays."""
    bent = make_chair((SEED, 36), 1)
    assert bent is not None
    return [next(one_armed_chairs()), bent]


class _WithArms(np.random.Generator):
    """Decides which arms the family's chair has, and draws everything else as usual."""

    arms = 0

    def choice(self, a: Any, *args: Any, p: Any = None, **kwargs: Any) -> Any:
        drawn = super().choice(a, *args, p=p, **kwargs)
        return drawn if p is None else self.arms


def test_a_chair_without_one_arm_is_one_that_the_family_makes() -> None:
    def chair(seed: int, arms: int) -> list[Solid]:
        random = _WithArms(np.random.PCG64(seed))
        random.arms = arms
        return CHAIR.design(random).parts

    for seed in range(40):
        none, both, left, right = (chair(seed, arms) for arms in range(4))
        assert not arm_of(none, -1) and not arm_of(none, 1)
        for lost, kept in ((without(both, arm_of(both, 1)), left), (without(both, arm_of(both, -1)), right)):
            assert [solid.vertices.tolist() for solid in lost] == [solid.vertices.tolist() for solid in kept]


def test_only_the_second_view_shows_the_missing_arm(chairs: list[OneArmedChair]) -> None:
    assert [chair.side for chair in chairs] == [-1, 1]
    for chair in chairs:
        one, both, none = (chair.images(112, arms).astype(int) for arms in get_args(Arms))
        covered = (both < 250).any(-1).sum((1, 2))
        changed = (np.abs(one - both).max(-1) > 8).sum((1, 2)) / covered
        assert changed[0] <= 3 * HIDDEN and changed[1] > SHOWN
        present = (np.abs(one - none).max(-1) > 8).sum((1, 2))[0] / covered[0]
        assert present > 0.5 * SHOWN  # view A shows the other arm
        eye = chair.cameras(112).position[:, 0]
        assert eye[0] * chair.side > 0 > eye[1] * chair.side


def test_real_arms_count_as_one_and_missing_ones_as_none(chairs: list[OneArmedChair]) -> None:
    boxes = torch.from_numpy(np.stack([chair.boxes for chair in chairs]))
    shares = torch.from_numpy(np.stack([chair.shares for chair in chairs]))
    expected: dict[Arms, tuple[float, float]] = {"one": (0, 1), "both": (1, 0.95), "none": (0, 0)}
    for arms, (missing, present) in expected.items():
        clouds = torch.from_numpy(np.stack([chair.samples(20_000, arms) for chair in chairs]))
        found = presence(clouds[:, None], boxes, shares)[:, 0]
        assert found[:, 0].tolist() == pytest.approx([missing] * 2, abs=0.1 * missing)
        assert found[:, 1].tolist() == pytest.approx([present] * 2, abs=0.1 * present)


def test_one_armed_chairs_are_measured_and_drawn(
    study: Study, chairs: list[OneArmedChair], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module("one_armed"), "CHAIRS", 2)
    monkeypatch.setattr(module("one_armed"), "one_armed_chairs", lambda: iter(chairs))
    result, page = made_once("one-armed", study, monkeypatch)
    assert result["chairs"] == 2
    true = {column: found["mean"] for column, found in result["rows"]["the true chair"].items()}
    assert true["missing"] == true["none"] == 0
    assert true["present"] == pytest.approx(1, abs=0.2) and true["both"] == pytest.approx(1, abs=0.2)
    # View A is the same picture whatever is hidden, and so is the prediction of a network without codes.
    alone = result["rows"]["deterministic, A"]
    assert alone["missing"]["mean"] == pytest.approx(alone["both"]["mean"], abs=0.05)
    assert result["codes"]["least"] <= result["rows"]["ours, A, random codes"]["missing"]["mean"]
    for row in result["rows"].values():
        assert f"| {row['missing']['mean']:.2f} | {row['present']['mean']:.2f} |" in page
    claim = result["claims"][0]
    gain = result["rows"]["PSGN, A"]["missing"]["mean"] - result["rows"]["ours, A and B"]["missing"]["mean"]
    assert claim["gain"] == pytest.approx(gain) and f"{claim['gain']:+.2f}" in page


def test_chairs_have_to_be_trained_on_and_these_ones_must_not_be(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate(tmp_path / "data", shapes=5, categories=["display"], seed=0, size=32, views=1, processes=1)
    displays = dataclasses.replace(study, data=(tmp_path / "data",), out=tmp_path / "out")
    with pytest.raises(UserError, match="no chairs to train on"):
        run_experiment("one-armed", displays)
    monkeypatch.setattr(module("one_armed"), "SEED", 0)
    with pytest.raises(UserError, match="another seed"):
        run_experiment("one-armed", study)


# Photographs


@pytest.fixture(scope="module")
def pictures(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four rendered pictures of one object, a photograph of another, and a file that is none."""
    folder = tmp_path_factory.mktemp("photographs")
    views = next(path.parent for path in sorted(tiny_data.rglob("render_0.png")))
    for name in ("rendered", "chair", "broken"):
        (folder / name).mkdir()
    for view in views.glob("render_*.png"):
        shutil.copy(view, folder / "rendered")
    photograph = take(surface_for("chair", 3), np.random.default_rng(0), frame_px=(300, 400), object_px=240)
    (folder / "chair" / "front.jpg").write_bytes(as_jpeg(photograph, 90))
    (folder / "broken" / "broken.jpg").write_bytes(b"no picture")
    return folder


def test_photographs_are_reconstructed(study: Study, pictures: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result, page = made_once("photos", dataclasses.replace(study, pictures=pictures), monkeypatch)
    assert {name: each["pictures"] for name, each in result["objects"].items()} == {"chair": 1, "rendered": 4}
    assert result["objects"]["chair"]["agreed"] is None  # a single picture has no pairs
    losses = {step: result["objects"]["rendered"][step]["mean"] for step in ("random", "searched", "agreed")}
    assert losses["agreed"] < losses["searched"] and losses["random"] > 0
    assert " | ".join(f"{loss:.2f}" for loss in losses.values()) in page
    assert "not an image" in result["left_out"]["broken/broken.jpg"] and "broken/broken.jpg" in page
    again = write_page(study.out).read_text()
    assert f"--seeds {study.seeds} --pictures {pictures.name}`" in again


def test_photographs_are_reconstructed_by_a_given_run(
    pictures: Path, smoke_run: Path, tmp_path: Path
) -> None:
    study = Study((), tmp_path, "smoke", seeds=2, run=smoke_run, pictures=pictures, progress=False)
    result = run_experiment("photos", study)
    assert result["run"] == str(smoke_run) and len(result["objects"]["rendered"]["agreed"]["by_seed"]) == 2
    assert f"the run {smoke_run}, codes drawn 2 times" in (tmp_path / "photos.md").read_text()
    assert not (tmp_path / "runs").exists()


def test_too_many_photographs_are_named(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, most in (("OBJECTS", 2), ("MOST_IMAGES", 3)):
        monkeypatch.setattr(module("photos"), name, most)
    shutil.copytree(pictures, tmp_path / "more")
    shutil.copytree(pictures / "chair", tmp_path / "more" / "second chair")
    objects, left_out = read_objects(tmp_path / "more")
    assert [(each.name, len(each.pictures)) for each in objects] == [("chair", 1), ("rendered", 3)]
    assert left_out["rendered, further pictures"] == "3 are used"
    assert left_out["further objects"] == "2 are shown"


def test_cut_outs_are_taken_as_they_are_and_masks_used(pictures: Path, tmp_path: Path) -> None:
    convert_photos(pictures / "chair", tmp_path / "cut", processes=1)
    ((name, found),) = read_objects(tmp_path / "cut")[0]
    with Image.open(tmp_path / "cut" / name / "front.png") as picture:
        assert torch.equal(found[0], torch.from_numpy(np.array(picture)).permute(2, 0, 1) / 255)

    masked = tmp_path / "masked"
    masked.mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)  # not a plain background
    mask = np.zeros((120, 160), np.uint8)
    mask[30:90, 40:100] = 255
    Image.fromarray(pixels).save(masked / "object.png")
    Image.fromarray(mask).save(masked / "object_mask.png")
    ((_, found),) = read_objects(masked)[0]
    white = (found[0] == 1).all(0)
    assert white[:10].all() and white[:, :10].all() and not white[80:140, 80:140].any()


def test_pictures_that_cannot_be_used_are_named(study: Study, tmp_path: Path) -> None:
    def photos(pictures: Path | None) -> None:
        run_experiment("photos", dataclasses.replace(study, pictures=pictures))

    with pytest.raises(UserError, match="no pictures; --pictures names a folder"):
        photos(None)
    with pytest.raises(UserError, match="missing is no folder"):
        photos(tmp_path / "missing")
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(UserError, match=r"no picture in .* can be used; --pictures"):
        photos(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"photo\.jpg is not an image"):
        photos(tmp_path)


# Runtime, and hidden points


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
def test_the_distance_behind_decides_and_inner_faces_do_not() -> None:
    slab, within = (box((0.5, 0.5, depth), (0, 0, 0), np.ones(3)) for depth in (0.01, 0.004))
    scene = make_scene(
        "slab", "slab", surface_of([slab, within]), [500], lambda n, rng: sample_union([slab, within], n, rng)
    )
    x, y, z = scene.clouds[500].T
    assert (z.abs() > 0.0049).float().mean() > 0.9  # nearly all are on the two large faces, none inside
    facing = scene.camera.position[:, 2:].sign() * z
    inner = (x.abs() < 0.2) & (y.abs() < 0.2)  # nearer to the rim, a ray may pass through a corner only
    large = inner & (z.abs() > 0.0049) & (scene.camera.position[:, 2:].abs() > 0.5)
    assert torch.equal(scene.hidden[500][large], (facing < 0)[large])
    assert not dataclasses.replace(scene, epsilon=0.05).hidden[500][large].any()


def test_shares_of_a_selection_counted_by_hand() -> None:
    camera = PinholeCamera.look_at([(0.0, 0.0, -2.0)], focal_px=4.0, height=4, width=4)
    # Two share a pixel, whose owner is seen; one is alone in its pixel, but hidden by a surface without samples.
    cloud = torch.tensor([[0.1, 0.1, 0.0], [0.1, 0.1, 0.1], [-0.1, 0.1, 0.5]])
    scene = Scene("hand", "hand", camera, {3: cloud}, {3: torch.tensor([[0.0, 0.001, 0.4]])})
    assert quality([scene], 3, 4, "zbuffer") == {"hidden": 0.5, "recall": 0.5}
    strict = dataclasses.replace(scene, epsilon=0.0005)
    assert quality([strict], 3, 4, "zbuffer") == {"hidden": 0.5, "recall": 1.0}


def test_medians_of_calls_in_turns() -> None:
    now, calls = [0.0], []

    def call(name: str, seconds: list[float]) -> None:
        calls.append(name)
        now[0] += seconds.pop(0)

    long, short = [9.0, 0.5, 0.3, 0.4], [9.0, 0.02, 0.01, 0.09]  # the first call does not count
    found = medians(
        {"long": lambda: call("long", long), "short": lambda: call("short", short)},
        rounds=3, clock=lambda: now[0],
    )  # fmt: skip
    assert found == pytest.approx({"long": 400, "short": 20})
    assert calls == ["long", "short"] * 4


@needs_embree
def test_runtime_is_measured_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = module("runtime")
    monkeypatch.setattr(runtime, "COUNTS", (300, 1200))
    monkeypatch.setattr(runtime, "PAPER", {300: runtime.PAPER[2048], 1200: runtime.PAPER[10_000]})
    study = Study((), tmp_path, limit=2, steps=1, progress=False)
    result = run_experiment("runtime", study)
    assert json.loads((tmp_path / "runtime.json").read_text()) == json.loads(json.dumps(result))
    with Image.open(tmp_path / "runtime.png") as picture:
        assert min(picture.size) > 400 and picture.convert("L").getextrema()[0] < 128

    assert result["shapes"] == ["chair", "display"] and result["views"] == 8
    grid = {(r["method"], r["points"], r["epsilon"], r["side"]): r for r in result["grid"]}
    assert len(grid) == len(result["grid"]) == 2 * 2 * 2 * 4
    for base in result["base"]:
        count, epsilon = base["points"], base["epsilon"]
        maps = [grid["zbuffer", count, epsilon, side] for side in (28, 56, 112, 224)]
        for coarse, fine in pairwise(maps):
            assert 0 <= coarse["hidden"] < fine["hidden"] < base["hidden"]
            assert 0 < coarse["recall"] < fine["recall"] <= 1
        horizon = [grid["horizon", count, epsilon, side] for side in (28, 224)]
        assert horizon[0] == pytest.approx(horizon[1] | {"side": 28}, abs=0.01)
        assert horizon[0]["hidden"] < maps[1]["hidden"]
        assert grid["zbuffer", count, 0.02, 56]["hidden"] < grid["zbuffer", count, 0.002, 56]["hidden"]
    few, many = result["time"]
    assert few["triangulation"] < many["triangulation"]

    page = (tmp_path / "runtime.md").read_text()
    for claim, row in zip(result["claims"], result["time"], strict=True):
        by_shape = row["by_shape"]
        assert all(len(times) == 2 and min(times) > 0 for times in by_shape.values())
        gains = np.array(by_shape["triangulation"]) - 10 * np.array(by_shape["zbuffer"])
        assert claim["gain"] == pytest.approx(gains.mean()) and claim["words"] in page
    for row in result["grid"]:
        assert f"| {row['hidden']:.1%} / {row['recall']:.1%} |" in page
    for ours, paper in zip(result["time"], ("6.6 |  | 209.8 | 32", "10.2 |  | 1120.0 | 110"), strict=True):
        ratio = ours["triangulation"] / ours["zbuffer"]
        cells = f"{ours['zbuffer']:.2f} | {ours['horizon']:.2f} | {ours['triangulation']:.2f} | {ratio:.0f}"
        assert f"| {ours['points']} points | {cells} |" in page
        assert f"| {ours['points']} points, the paper | {paper} |" in page
    assert "2 shapes, 8 views" in page and "10.4% and 3.6%" in page

    saved = (tmp_path / "runtime" / "hidden.json").stat().st_mtime_ns
    monkeypatch.setattr(runtime, "quality", lambda *_: pytest.fail("the shares were kept"))
    again = run_experiment("runtime", study)
    assert (again["grid"], again["base"]) == (result["grid"], result["base"])
    assert (tmp_path / "runtime" / "hidden.json").stat().st_mtime_ns == saved


@needs_embree
def test_scenes_are_the_same_each_time() -> None:
    first, second = (embedded_scene("rifle", 0, [200]) for _ in range(2))
    assert torch.equal(first.clouds[200], second.clouds[200])
    assert torch.equal(first.behind[200], second.behind[200])
    assert torch.equal(first.camera.K, second.camera.K)
    elevation = torch.asin(first.camera.position[:, 1] / first.camera.position.norm(dim=-1)).rad2deg()
    assert elevation.min() >= -20 and elevation.max() <= 40 and len(elevation) == 8
