"""The other methods through `fit`: recipes, what their lessons are taught with, learning by heart, and whole runs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args

import pytest
import torch

from diffpoint import PinholeCamera, chamfer_distance, farthest_point_sample, splat_depth
from diffpoint.io import read_points
from models import PROFILES as SIZES
from models import Generator
from models.baselines import Baseline, StructureGenerator, fixed_cameras, surface_points
from train.__main__ import main
from train.config import PROFILES, StageConfig, System, fit_config_from_json, to_json, with_steps
from train.data.batches import LoadedSplit, Truth, load_split
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.inference import reconstruct
from train.evaluation.per_shape import compare_clouds, evaluate_split
from train.evaluation.runs import config_of, latest_checkpoint, load_generator, load_predictor, read_metrics
from train.methods.lessons import Given
from train.methods.recipes import with_system
from train.methods.systems import METHODS, build_network, cloud_size, image_size, system_of, taught_step
from train.methods.targets import fixed_depth, hull_cells, solid_cells
from train.training import state as state_module
from train.training.state import Training
from train.training.trainer import fit

_SMOKE = PROFILES["smoke"]
_OTHERS = [system for system in get_args(System) if system != "ours"]


def _split(data: Path, system: System, *, limit: int = 8) -> LoadedSplit:
    size = image_size(with_system(_SMOKE, system))
    return load_split(data, "train", image_size=size, map_size=16, limit=limit, progress=False)


# --- recipes


@pytest.mark.parametrize("profile", sorted(PROFILES))
@pytest.mark.parametrize("system", _OTHERS)
def test_every_recipe_has_a_lesson_and_a_size_for_each_phase(system: System, profile: str) -> None:
    config = with_system(PROFILES[profile], system)
    method = METHODS[system]
    assert list(config.phases) == list(method.lessons)
    assert fit_config_from_json(to_json(config, data=Path("d")), where="") == config
    assert method.sizes[profile].points == SIZES[profile].points
    assert [phase.steps for phase in with_steps(config, 7).phases.values()] == [7] * len(method.lessons)
    assert with_steps(config, 7).phases.keys() == config.phases.keys()


@pytest.mark.parametrize("system", get_args(System))
def test_the_size_of_a_cloud_is_known_without_its_network(system: System) -> None:
    config = with_system(_SMOKE, system)
    assert cloud_size(config) == build_network(config).points


def test_our_own_recipe_is_left_alone() -> None:
    assert with_system(_SMOKE, "ours") is _SMOKE


def test_a_phase_of_no_steps_is_left_out(tiny_data: Path, tmp_path: Path) -> None:
    only_second = dataclasses.replace(
        _SMOKE, stage1=dataclasses.replace(_SMOKE.stage1, steps=0, gamma=0.0), stage2=dataclasses.replace(
            _SMOKE.stage2, steps=2, gamma=0.0
        )
    )  # fmt: skip
    assert list(only_second.phases) == ["stage2"]
    assert fit(tiny_data, tmp_path / "run", only_second, progress=False)
    assert [record["stage"] for record in read_metrics(tmp_path / "run")] == [2, 2]
    none = dataclasses.replace(only_second, stage2=only_second.stage1)
    with pytest.raises(UserError, match="every phase has 0 steps"):
        fit(tiny_data, tmp_path / "none", none, progress=False)


@pytest.mark.parametrize(
    "change",
    [{"ending": "latent"}, {"deterministic": True}, {"variant": "highly-diverse"}, {"stage2": _SMOKE.stage2}],
    ids=lambda change: next(iter(change)),
)
def test_settings_of_our_own_system_are_refused(
    change: dict[str, Any], tiny_data: Path, tmp_path: Path
) -> None:
    config = dataclasses.replace(with_system(_SMOKE, "psgn"), **change)
    with pytest.raises(UserError, match=r"--system psgn (knows no|has no)"):
        fit(tiny_data, tmp_path / "run", config, progress=False)
    assert not (tmp_path / "run").exists()


# --- what the lessons are taught with


def _sphere(radius: float, *, eyes: torch.Tensor) -> Truth:
    directions = torch.nn.functional.normalize(torch.randn(1, 30_000, 3), dim=-1)
    camera = PinholeCamera.look_at(eyes[None], focal_px=105.0, height=56, width=56)
    return Truth(radius * directions, splat_depth(radius * directions, camera, radius=1.0).depth, camera)


_AROUND = torch.tensor([[2.0, 0, 0], [-2, 0, 0], [0, 0.3, 2], [0, 0.3, -2], [0.1, 2, 0], [0.1, -2, 0]])


def test_cells_are_filled_to_the_surface_and_not_beyond() -> None:
    torch.manual_seed(0)
    truth = _sphere(0.3, eyes=_AROUND)
    cells = solid_cells(truth, 16)
    centres = (torch.arange(16) + 0.5) / 16 - 0.5
    distance = torch.cartesian_prod(centres, centres, centres).norm(dim=1).view(1, 16, 16, 16)
    assert cells[distance < 0.27].all()
    assert not cells[distance > 0.4].any()  # between, the hull of six views has corners
    points = surface_points(cells.float(), 500, threshold=0.5)
    both = chamfer_distance(points, truth.points, squared=False)
    assert max(both.a_to_b.item(), both.b_to_a.item()) < 1 / 16


def test_cells_of_a_thin_plate_and_of_corners_that_no_view_sees() -> None:
    plate = torch.rand(1, 4000, 3) * torch.tensor([0.6, 0.6, 0.0]) - torch.tensor([0.3, 0.3, 0.01])
    camera = PinholeCamera.look_at(_AROUND[None, 2:4], focal_px=40.0, height=16, width=16)
    cells = solid_cells(Truth(plate, splat_depth(plate, camera).depth, camera), 16)
    filled = cells[0].nonzero()
    assert filled[:, 2].unique().tolist() == [7]
    assert len(filled) >= 0.9 * (0.6 * 16) ** 2


def test_silhouettes_fill_a_hollow_that_a_view_looks_into() -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(1, 30_000, 3), dim=-1)
    bowl = 0.3 * torch.cat([directions[..., :1], -directions[..., 1:2].abs(), directions[..., 2:]], -1)
    camera = PinholeCamera.look_at(_AROUND[None], focal_px=105.0, height=56, width=56)
    truth = Truth(bowl, splat_depth(bowl, camera, radius=1.0).depth, camera)
    solid, hull = solid_cells(truth, 16), hull_cells(truth, 16)
    x, y, z = torch.cartesian_prod(*[(torch.arange(16) + 0.5) / 16 - 0.5] * 3).T.reshape(3, 1, 16, 16, 16)
    from_middle = torch.stack([x, y, z]).norm(dim=0)
    hollow = (y < -0.03) & (y > -0.15) & (x.square() + z.square() < 0.15**2)
    assert hull[hollow].all()
    assert not solid[hollow].any()  # the view from above sees the bottom behind it
    assert hull[(y < -0.03) & (from_middle < 0.28)].all()  # no outline rules out what is there
    assert not hull[from_middle > 0.45].any()


@pytest.mark.parametrize("system", [name for name, method in METHODS.items() if method.ideal])
def test_a_lesson_learnt_without_an_error_comes_near_the_truth(system: System, tiny_data: Path) -> None:
    torch.manual_seed(0)
    config = with_system(_SMOKE, system)
    network, split, ideal = build_network(config), _split(tiny_data, system, limit=4), METHODS[system].ideal
    shapes = torch.arange(len(split))
    assert ideal is not None
    taught = compare_clouds(ideal(network, split.truth(shapes)), split.points, points=network.points)
    fresh = evaluate_split(network, split, config.inference, views=2, seed=0)
    assert (taught["cd"] < 0.6 * fresh["cd"]).all()
    if system != "ptn":  # a hull of these data's few views goes far beyond the surface
        cell = 100 / 16  # the smallest grids and maps have 16 to the world's unit
        assert (taught["pred_to_gt"] < (1e-4 if system == "psgn" else cell)).all()


def test_fixed_depth_is_orthographic() -> None:
    torch.manual_seed(0)
    points = torch.rand(2, 200, 3) - 0.5
    maps = fixed_depth(points, 32)
    seen = fixed_cameras(points)
    pixel = ((seen[..., :2] + 0.5) * 32).floor().long()
    inside = ((pixel >= 0) & (pixel < 32)).all(-1)
    x, y = pixel.clamp(0, 31).unbind(-1)
    there = maps.flatten(2).gather(2, y * 32 + x)
    assert (there <= seen[..., 2] + 1e-6)[inside].all()  # its own pixel shows the point, or one before it
    assert (there - seen[..., 2]).abs()[inside].lt(1e-6).float().mean() > 0.7


# --- lessons


@pytest.mark.parametrize(
    ("system", "steps", "left"),
    [
        ("psgn", 50, 0.4), ("psgn-mon", 50, 0.6), ("front-mon", 110, 0.6), ("lin", 50, 0.8), ("r2n2", 40, 0.5),
        ("ptn", 50, 0.7),
    ],
)  # fmt: skip
def test_one_batch_can_be_learnt_by_heart(system: System, steps: int, left: float, tiny_data: Path) -> None:
    """The loss on one batch of three shapes falls below a share of what it was, in every phase."""
    config = with_system(_SMOKE, system)
    training = Training(config, _split(tiny_data, system))
    learner = training.learner
    for phase, lesson in METHODS[system].lessons.items():
        stage = config.phases[phase]
        assert isinstance(stage, StageConfig)
        stage = dataclasses.replace(stage, steps=steps, learning_rate=2e-3, final_learning_rate=1e-3)
        batch, chance = training._draw(stage)
        assert batch.truth is not None
        losses = [
            taught_step(learner, Given(batch, batch.truth, chance.codes, stage, step), lesson)["loss"].item()
            for step in range(steps)
        ]
        if phase == "stage1":
            assert min(losses[-3:]) < left * max(
                losses[:20]
            )  # a front that sees more points has more to pay first
        else:
            assert sum(losses[-10:]) < sum(losses[:10])


def test_only_the_nearest_of_the_codes_clouds_learns(tiny_data: Path) -> None:
    training = Training(with_system(_SMOKE, "psgn-mon"), _split(tiny_data, "psgn-mon"))
    batch, chance = training._draw(training.config.stage1)
    assert batch.truth is not None
    generator = training.learner.generator
    codes = chance.codes.clone().requires_grad_()
    given = Given(batch, batch.truth, codes, training.config.stage1, 0)
    report = METHODS["psgn-mon"].lessons["stage1"](generator, given)
    assert report["loss"] < report["mean_of_all"]
    (gradient,) = torch.autograd.grad(report["loss"], codes)
    assert (gradient.abs().sum(2) > 0).sum(0).tolist() == [1] * codes.shape[1]


def test_a_loss_that_explodes_says_so(tiny_data: Path) -> None:
    config = with_system(_SMOKE, "ptn")
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, learning_rate=1e38))
    training = Training(config, _split(tiny_data, "ptn"))
    with pytest.raises(UserError, match="no longer finite; lower the learning rate"):
        for _ in range(4):
            training.advance()


# --- whole runs


@pytest.fixture(scope="module", params=_OTHERS)
def run(request: pytest.FixtureRequest, tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the smoke profile, one for each of the other methods."""
    path = tmp_path_factory.mktemp("runs") / request.param
    assert fit(tiny_data, path, with_system(_SMOKE, request.param), progress=False)
    return path


def test_runs_are_trained_scored_and_asked(run: Path, tiny_data: Path) -> None:
    system: Any = run.name
    config = with_system(_SMOKE, system)
    records = read_metrics(run)
    assert len(records) == sum(phase.steps for phase in config.phases.values())
    assert all(torch.tensor(record["loss"]).isfinite() for record in records)
    assert {"val_cd_1", "val_cd", "val_fps_cd", "image_sensitivity"} <= records[-1].keys()

    network = load_predictor(run)
    own = METHODS[system].kind
    assert isinstance(network, own or Generator)
    assert system_of(network) == (system if own else "ours")
    assert config_of(run, network).system == system
    assert config_of(run / "checkpoints" / "best-stage1.safetensors", network).system == system_of(network)

    result = evaluate(run, tiny_data, seeds=(0,), views=(1, 3), progress=False)
    assert result["config"]["system"] == system
    assert json.loads((run / "evaluation.json").read_text())["views"]["3"]["cd"] == result["views"]["3"]["cd"]
    assert result["views"]["3"]["fps_cd"] > 0
    assert (result["diversity"] is None) == (system not in ("psgn-mon", "front-mon"))


def test_reconstruct_from_pictures_of_files(run: Path, tiny_data: Path, tmp_path: Path) -> None:
    pictures = sorted(tiny_data.glob("rendered-shapenet/*/*/render_*.png"))[:3]
    assert main(["reconstruct", str(run), *map(str, pictures), "--out", str(tmp_path)]) == 0
    network = load_predictor(run)
    cloud = read_points(tmp_path / "reconstruction.ply")
    expected = 1 if isinstance(network, Baseline) and network.reads_views_together else 3
    per_view = 512 if isinstance(network, StructureGenerator) else network.points
    assert len(cloud) == expected * per_view


class _Killed(BaseException):
    pass


_OFTEN_SAVED = dataclasses.replace(with_system(_SMOKE, "lin"), checkpoint_every=3)


@pytest.fixture(scope="module")
def whole_run(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the method with batch norms, whose running statistics have to come back too."""
    path = tmp_path_factory.mktemp("whole") / "run"
    assert fit(tiny_data, path, _OFTEN_SAVED, progress=False)
    return path


@pytest.mark.parametrize("killed_at", [5, 13, 16], ids=["first phase", "its border", "second phase"])
def test_a_killed_run_resumes_to_the_same_bits(
    killed_at: int, tiny_data: Path, whole_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []

    def dying_step(*args: Any, **settings: Any) -> Any:
        steps.append(1)
        if len(steps) == killed_at:
            raise _Killed
        return taught_step(*args, **settings)

    monkeypatch.setattr(state_module, "taught_step", dying_step)
    with pytest.raises(_Killed):
        fit(tiny_data, tmp_path / "run", _OFTEN_SAVED, progress=False)
    monkeypatch.undo()
    assert fit(tiny_data, tmp_path / "run", _OFTEN_SAVED, resume=True, progress=False)
    for name in ("best-stage1", "best-stage2"):
        file = Path("checkpoints") / f"{name}.safetensors"
        assert (tmp_path / "run" / file).read_bytes() == (whole_run / file).read_bytes()
    newest, whole = latest_checkpoint(tmp_path / "run"), latest_checkpoint(whole_run)
    assert newest is not None
    assert whole is not None
    weights = "weights.safetensors"
    assert (newest / weights).read_bytes() == (whole / weights).read_bytes()


def test_from_the_command_line(tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ["--data", str(tiny_data), "--out", str(tmp_path / "run")]
    assert main(["fit", *where, "--profile", "smoke", "--system", "r2n2", "--steps", "2"]) == 0
    saved = fit_config_from_json((tmp_path / "run" / "config.json").read_text(), where="config.json")
    assert saved == with_steps(with_system(_SMOKE, "r2n2"), 2)
    with pytest.raises(UserError, match="holds no generator's weights"):
        load_generator(tmp_path / "run")


# --- scores


def test_predictions_of_several_views_are_scored_one_by_one(tiny_data: Path) -> None:
    split = _split(tiny_data, "ptn", limit=3)
    config = with_system(_SMOKE, "ptn")
    network = METHODS["ptn"].build("smoke")
    each = evaluate_split(network, split, config.inference, views=3, seed=0)
    joined_settings = dataclasses.replace(config.inference, scored="joined")
    joined = evaluate_split(network, split, joined_settings, views=3, seed=0)
    found = reconstruct(network, split.float_images(torch.arange(3), torch.arange(3).expand(3, -1)))
    assert found.points.shape == (3, 3 * network.points, 3)
    assert found.codes.shape == (3, 3, 0)
    assert (each["best_cd"] <= each["cd"]).all()
    assert "best_cd" not in joined
    assert (joined["gt_to_pred"] < each["gt_to_pred"]).all()  # three times the points
    one = evaluate_split(network, split, config.inference, views=1, seed=0)
    torch.testing.assert_close(one["best_cd"], one["cd"])


def test_a_network_that_reads_views_together_has_nothing_to_disagree_about(tiny_data: Path) -> None:
    split = _split(tiny_data, "r2n2", limit=2)
    network = METHODS["r2n2"].build("smoke")
    scores = evaluate_split(network, split, with_system(_SMOKE, "r2n2").inference, views=3, seed=0)
    assert "consistency" not in scores
    assert scores["cd"].shape == (2,)


def test_dense_answers_are_thinned_to_the_size_of_the_others(tiny_data: Path) -> None:
    torch.manual_seed(0)
    split = _split(tiny_data, "lin", limit=1)
    network = METHODS["lin"].build("smoke")
    assert isinstance(network, Baseline)
    answer = network.predict_views(split.float_images(torch.arange(1), torch.zeros(1, 1, dtype=torch.int64)))[
        0
    ]
    assert answer.shape[1] == 4 * network.points
    index = farthest_point_sample(answer, network.points)
    thinned = torch.take_along_dim(answer, index[..., None], 1)
    both = chamfer_distance(thinned, split.points[:1], squared=False)
    scores = evaluate_split(network, split, with_system(_SMOKE, "lin").inference, views=1, seed=0)
    assert scores["fps_cd"].item() > scores["cd"].item() - 1e-3
    assert 100 * (both.a_to_b + both.b_to_a).item() > 0
