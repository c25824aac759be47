"""Experiments that show: reconstructions beside other methods, chairs with one arm, and a user's photographs."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from PIL import Image

from tests.photographs import as_jpeg, surface_for, take
from train.data.families.chair import CHAIR
from train.data.photos import convert_photos
from train.data.procedural import generate
from train.data.solids import Solid
from train.errors import UserError
from train.evaluation.metrics import cloud_errors
from train.evaluation.per_shape import view_order
from train.experiments.one_armed.chairs import (
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
from train.experiments.one_armed.measure import configs, one_armed, presence
from train.experiments.page import write_page
from train.experiments.photos import photos, read_objects
from train.experiments.reconstructions import picked, reconstructions
from train.experiments.workbench import Workbench
from train.methods.recipes import with_system
from train.show import figures


@pytest.fixture(scope="module")
def bench(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    """What all experiments of this file share, trainings included."""
    out = tmp_path_factory.mktemp("pictures")
    return Workbench((tiny_data,), out, "smoke", seeds=1, limit=3, steps=3, progress=False)


@pytest.fixture(scope="module")
def chairs() -> list[OneArmedChair]:
    """The first one, and one with bent arms, whose other arm stays."""
    bent = make_chair((SEED, 36), 1)
    assert bent is not None
    return [next(one_armed_chairs()), bent]


def written_once(bench: Workbench, name: str, make: Callable[[], dict]) -> tuple[dict, str]:
    """The result and the page; JSON and figure are there, and a second call measures nothing again."""
    result = make()
    assert json.loads((bench.out / f"{name}.json").read_text()) == json.loads(json.dumps(result))
    with Image.open(bench.out / f"{name}.png") as picture:
        assert min(picture.size) > 150
        assert picture.convert("L").getextrema()[0] < 128
    kept = _times(bench)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            figures, "save", lambda figure, path: None
        )  # a second, and nothing to do with measuring
        assert json.dumps(make()) == json.dumps(result)
    assert _times(bench) == kept
    return result, (bench.out / f"{name}.md").read_text()


def _times(bench: Workbench) -> dict[Path, int]:
    files = [path for part in ("runs", "scores") for path in (bench.out / part).rglob("*")]
    return {path: path.stat().st_mtime_ns for path in files}


def test_reconstructions_stand_beside_other_methods(bench: Workbench) -> None:
    result, page = written_once(bench, "reconstructions", lambda: reconstructions(bench))
    assert result["views_of"] == {"ours": 4, "PSGN": 1, "3D-R2N2": 4}  # the data have four
    config = bench.config(lambda config: with_system(config, "psgn"), seed=0)
    test, model = bench.split(config, "test"), bench.network(config)
    for row, (name, errors) in enumerate(result["shapes"].items()):
        number = test.ids.index(name)
        assert errors["category"] == test.categories[number]
        first = view_order(test, 0)[number, :1]
        image = test.float_images(torch.tensor([number]), first[None])[:, 0]
        with torch.no_grad():
            cloud = model(image, torch.zeros(1, 1, model.code_dim))[0]
        assert errors["PSGN"]["cd"] == pytest.approx(
            cloud_errors(cloud, test.points[[number]]).cd.item(), abs=1e-3
        )
        assert errors["PSGN"]["cd"] == errors["PSGN"]["fps_cd"] != errors["ours"]["cd"]
        assert f"{errors['ours']['cd']:.2f} ({errors['ours']['fps_cd']:.2f})" in page.splitlines()[4 + row]
    ours = [each["ours"]["cd"] for each in result["shapes"].values()]
    assert result["mean"]["ours"]["cd"] == pytest.approx(sum(ours) / len(ours))


def test_every_category_is_shown_before_one_is_shown_twice() -> None:
    assert picked(["chair", "chair", "chair", "sofa", "lamp", "sofa"], 4).tolist() == [0, 3, 4, 1]
    assert picked(["chair"], 6).tolist() == [0]


class _WithArms(np.random.Generator):
    """Decides which arms the family's chair has, and draws everything else as ever."""

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


def test_only_the_second_view_tells(chairs: list[OneArmedChair]) -> None:
    assert [chair.side for chair in chairs] == [-1, 1]
    for chair in chairs:
        one, both, none = (chair.images(112, arms).astype(int) for arms in get_args(Arms))
        covered = (both < 250).any(-1).sum((1, 2))
        changed = (np.abs(one - both).max(-1) > 8).sum((1, 2)) / covered
        assert changed[0] <= 3 * HIDDEN and changed[1] > SHOWN
        assert (np.abs(one - none).max(-1) > 8).sum((1, 2))[0] / covered[
            0
        ] > 0.5 * SHOWN  # A shows the other arm
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
    bench: Workbench, chairs: list[OneArmedChair], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[one_armed.__module__], "CHAIRS", 2)
    monkeypatch.setattr(sys.modules[one_armed.__module__], "one_armed_chairs", lambda: iter(chairs))
    result, page = written_once(bench, "one-armed", lambda: one_armed(bench))
    assert all(bench.is_trained(config) for config in configs(bench)) and result["chairs"] == 2
    truth = {column: found["mean"] for column, found in result["rows"]["the true chair"].items()}
    assert truth["missing"] == truth["none"] == 0
    assert truth["present"] == pytest.approx(1, abs=0.2) and truth["both"] == pytest.approx(1, abs=0.2)
    # View A is the same picture whatever is hidden, and so is what a network without codes makes of it.
    alone = result["rows"]["deterministic, A"]
    assert alone["missing"]["mean"] == pytest.approx(alone["both"]["mean"], abs=0.05)
    assert result["codes"]["least"] <= result["rows"]["ours, A, random codes"]["missing"]["mean"]
    for row in result["rows"].values():
        assert f"| {row['missing']['mean']:.2f} | {row['present']['mean']:.2f} |" in page
    claim = result["claims"][0]
    gain = result["rows"]["PSGN, A"]["missing"]["mean"] - result["rows"]["ours, A and B"]["missing"]["mean"]
    assert claim["gain"] == pytest.approx(gain) and f"{claim['gain']:+.2f}" in page
    assert claim["verdict"] in page


def test_chairs_have_to_be_trained_on_and_these_ones_must_not_be(
    bench: Workbench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate(tmp_path / "data", shapes=5, categories=["display"], seed=0, size=32, views=1, processes=1)
    with pytest.raises(UserError, match="no chairs to train on"):
        one_armed(Workbench((tmp_path / "data",), tmp_path / "out", "smoke", progress=False))
    monkeypatch.setattr(sys.modules[one_armed.__module__], "SEED", 0)
    with pytest.raises(UserError, match="another seed"):
        one_armed(bench)


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


def test_photographs_are_reconstructed(bench: Workbench, pictures: Path) -> None:
    result, page = written_once(bench, "photos", lambda: photos(bench, pictures))
    assert {name: each["pictures"] for name, each in result["objects"].items()} == {"chair": 1, "rendered": 4}
    assert result["objects"]["chair"]["agreed"] is None  # nothing to agree on
    losses = result["objects"]["rendered"]
    assert losses["agreed"]["mean"] < losses["searched"]["mean"] and losses["random"]["mean"] > 0
    assert (
        f"{losses['random']['mean']:.2f} | {losses['searched']['mean']:.2f} | {losses['agreed']['mean']:.2f}"
        in page
    )
    assert "not an image" in result["left_out"]["broken/broken.jpg"] and "broken/broken.jpg" in page
    again = write_page(bench.out).read_text()
    assert f"--seeds {bench.seeds} --pictures {pictures.name}`" in again


def test_too_many_photographs_are_named(
    pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, most in (("OBJECTS", 2), ("MOST_IMAGES", 3)):
        monkeypatch.setattr(sys.modules[photos.__module__], name, most)
    shutil.copytree(pictures, tmp_path / "more")
    shutil.copytree(pictures / "chair", tmp_path / "more" / "second chair")
    objects, left_out = read_objects(tmp_path / "more")
    assert [(each.name, len(each.pictures)) for each in objects] == [("chair", 1), ("rendered", 3)]
    assert left_out["rendered, further pictures"] == "3 are used"
    assert left_out["further objects"] == "2 are shown"


def test_pictures_that_data_photos_made_are_taken_as_they_are(pictures: Path, tmp_path: Path) -> None:
    convert_photos(pictures / "chair", tmp_path / "cut", processes=1)
    ((name, found),) = read_objects(tmp_path / "cut")[0]
    with Image.open(tmp_path / "cut" / name / "front.png") as picture:
        assert torch.equal(found[0], torch.from_numpy(np.array(picture)).permute(2, 0, 1) / 255)


def test_a_mask_goes_before_the_background(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)  # nothing plain about it
    mask = np.zeros((120, 160), np.uint8)
    mask[30:90, 40:100] = 255
    Image.fromarray(pixels).save(tmp_path / "object.png")
    Image.fromarray(mask).save(tmp_path / "object_mask.png")
    ((_, found),) = read_objects(tmp_path)[0]
    white = (found[0] == 1).all(0)
    assert white[:10].all() and white[:, :10].all() and not white[80:140, 80:140].any()


def test_what_cannot_be_shown_is_named(bench: Workbench, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no pictures; --pictures names a folder"):
        photos(bench, None)
    with pytest.raises(UserError, match="missing is no folder"):
        photos(bench, tmp_path / "missing")
    (tmp_path / "notes.txt").write_text("no picture")
    with pytest.raises(UserError, match=r"no picture in .* can be used; --pictures"):
        photos(bench, tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"photo\.jpg is not an image"):
        photos(bench, tmp_path)
