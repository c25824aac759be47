"""The methods of train/methods: recipes, losses and their units, oracles, and a whole run of each."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args

import pytest
import torch

from diffpoint import PinholeCamera, chamfer_distance, diversity_loss, splat_depth, unproject
from diffpoint.io import read_points
from diffpoint.visibility import METHODS as VISIBILITY_METHODS
from models import PROFILES as SIZES
from models.baselines import fixed_cameras, surface_points
from train.__main__ import main
from train.config import (
    EXACT_MEAN_EMD_FROM_PAPER,
    FitConfig,
    Profile,
    Visibility,
    fit_config_from_json,
    scaled,
    to_json,
    with_steps,
)
from train.data.batches import Batch, LoadedSplit, Targets, load_split
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.inference import reconstruct
from train.evaluation.per_shape import compare_clouds, evaluate_split
from train.evaluation.runs import config_of, load_generator, load_predictor, read_metrics
from train.methods import METHODS, get_method, recipe
from train.methods.base import Step
from train.methods.lin import fixed_depth
from train.methods.losses import diversity_term, front_loss, nearest_prediction_loss, pair_with_views
from train.methods.ours import highly_diverse
from train.methods.voxel_targets import hull_cells, solid_cells
from train.methods.weights import method_of
from train.training.trainer import Trainer, fit

_OURS = {profile: recipe("ours", profile) for profile in get_args(Profile)}
_OTHERS = [name for name in METHODS if name != "ours"]


def _split(data: Path, system: str, *, limit: int = 8) -> LoadedSplit:
    size = get_method(system).image_size(recipe(system, "smoke"))
    return load_split(data, "train", image_size=size, map_size=16, limit=limit, progress=False)


# --- recipes


@pytest.mark.parametrize("profile", get_args(Profile))
@pytest.mark.parametrize("system", METHODS)
def test_recipes_have_a_loss_for_each_phase_and_a_network_of_the_common_size(
    system: str, profile: str
) -> None:
    config, method = recipe(system, profile), get_method(system)
    method.check(config)
    assert (config.system, config.profile) == (system, profile)
    without_critic = system == "ours" and profile == "cpu"
    assert list(config.phases) == list(method.losses)[without_critic:]
    assert [phase.steps for phase in with_steps(config, 7).phases.values()] == [7] * len(config.phases)
    assert method.cloud_size(config) == SIZES[profile].points
    changed = dataclasses.replace(scaled(config, 0.5), categories=("chair",))
    assert fit_config_from_json(to_json(changed, data=Path("d")), where="") == changed
    if profile == "smoke":
        assert method.build(config).points == method.cloud_size(config)


def test_the_recipe_of_whole_shapes_is_the_default_and_differs_where_it_should() -> None:
    method = get_method("ours")
    assert method.recipes[0] == "whole-shapes"
    for profile, paper in _OURS.items():
        config = recipe("ours", profile, "whole-shapes")
        method.check(config)
        assert paper.recipe == "paper"
        assert not any(method.needs_targets(stage) or stage.shape_weight for stage in paper.stages)
        assert all(method.needs_targets(stage) and stage.codes > 1 for stage in config.stages)
        assert not any(stage.beta or stage.gamma for stage in config.stages)
        assert method.build(config).points == method.cloud_size(config) == 2 * SIZES[profile].points
        assert fit_config_from_json(to_json(config, data=Path("d")), where="") == config


def test_a_name_of_no_method_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(UserError, match=f"must be one of {', '.join(METHODS)}; got 'none'"):
        recipe("none", "smoke")


@pytest.mark.parametrize(
    ("system", "change", "complaint"),
    [
        (
            "ours",
            {"stage1": dataclasses.replace(recipe("ours", "smoke").stage1, codes=1)},
            "got --stage1.codes 1",
        ),
        ("ours", {"decoder_width": 0}, "--decoder-width must be at least 1; got 0"),
        ("ours", {"points_per_cell": 0}, "--points-per-cell must be at least 1; got 0"),
        ("psgn", {"output_head": "latent"}, "does not support"),
        ("psgn", {"deterministic": True}, "does not support"),
        ("psgn", {"variant": "highly-diverse"}, "does not support"),
        ("psgn", {"precision": "bfloat16"}, "computes in float32"),
        ("psgn", {"recipe": "whole-shapes"}, "has no recipe whole-shapes; leave --recipe at paper"),
        (
            "psgn",
            {"points_per_cell": 4},
            "has a network and a loss of its own; do not set --decoder-width, --points",
        ),
        (
            "psgn",
            {"stage1": dataclasses.replace(recipe("psgn", "smoke").stage1, optimiser="muon")},
            r"is trained by Adam; do not set --stage\*.optimiser",
        ),
        ("ptn", {"stage2": recipe("ptn", "smoke").stage1}, "has no stage2; leave its steps at 0"),
    ],
)
def test_settings_that_a_method_does_not_have_are_refused(
    system: str, change: dict[str, Any], complaint: str, tiny_data: Path, tmp_path: Path
) -> None:
    config = dataclasses.replace(recipe(system, "smoke"), **change)
    with pytest.raises(UserError, match=complaint if system == "ours" else f"--system {system} {complaint}"):
        fit(tiny_data, tmp_path / "run", config, progress=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"stage1": 3}', '{"unknown": 1}'])
def test_a_file_without_a_configuration_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"config\.json is not the configuration"):
        fit_config_from_json(text, where="config.json")


def test_the_full_profile_has_the_papers_numbers() -> None:
    first, second = _OURS["full"].stages
    assert (first.shapes, first.views, first.codes, first.steps) == (2, 8, 5, 40_000)
    assert (first.alpha, first.beta, first.front) == (0.2, 10, "emd")
    assert (second.alpha, second.beta, second.front, second.steps) == (0.1, 1, "chamfer", 100_000)
    assert (first.gamma, second.gamma, first.n_critic, first.penalty) == (0.1, 0.1, 1, 10)
    assert first.exact_alpha == pytest.approx(0.2 * EXACT_MEAN_EMD_FROM_PAPER)


def test_the_deterministic_counterpart_has_one_code_and_no_diversity_loss() -> None:
    for stage in dataclasses.replace(_OURS["cpu"], deterministic=True).stages:
        assert (stage.codes, stage.beta) == (1, 0)


def test_configurations_accept_every_visibility_method() -> None:
    assert get_args(Visibility) == VISIBILITY_METHODS


def test_schedules_follow_their_settings_and_the_length_of_the_phase() -> None:
    stage = dataclasses.replace(
        _OURS["cpu"].stage1, steps=100, ramp=(10, 30), beta=8.0, warmup=9, learning_rate=1e-3,
        final_learning_rate=1e-4,
    )  # fmt: skip
    assert [stage.diversity_weight(step) for step in (0, 10, 20, 30, 99)] == [0, 0, 4, 8, 8]
    assert stage.learning_rate_at(0) == pytest.approx(1e-4)
    assert stage.learning_rate_at(9) > 0.95e-3
    assert stage.learning_rate_at(100) == pytest.approx(1e-4)

    short = with_steps(_OURS["full"], 20).stage1
    assert (short.ramp, short.warmup) == ((0, 2), 0)  # of 40 000 steps: 1 000 to 4 000, and 500
    assert with_steps(_OURS["full"], 80_000).stage1.ramp == (2_000, 8_000)
    quarter = scaled(_OURS["cpu"], 0.25)
    assert [phase.steps for phase in (quarter.pretrain, quarter.stage1)] == [375, 1_000]
    assert (quarter.stage1.ramp, quarter.collapse_patience) == ((100, 300), 150)


# --- losses and their units


def _cameras(shapes: int, views: int, size: int) -> PinholeCamera:
    angles = torch.linspace(0, 5, shapes * views).reshape(shapes, views)
    eyes = 2 * torch.stack([angles.cos(), 0.2 * torch.ones_like(angles), angles.sin()], -1)
    return PinholeCamera.look_at(eyes, focal_px=1.875 * size, height=size, width=size)


@pytest.mark.parametrize("joined", [False, True])
def test_every_cloud_is_paired_with_the_cameras_of_its_own_images(joined: bool) -> None:
    codes, shapes, views, points = 3, 2, 4, 5
    tags = torch.arange(codes * shapes * views).reshape(codes, shapes * views)
    clouds = tags[..., None, None].expand(-1, -1, points, 3).float()
    camera = _cameras(shapes, views, 8)
    depth = torch.arange(shapes * views).reshape(shapes, views, 1, 1).expand(-1, -1, 8, 8).float() + 1
    paired = pair_with_views(clouds, Batch(torch.empty(0), depth, camera), joined_views=joined)
    together = views if joined else 1
    assert paired[0].shape == (codes * shapes * views // together, together * points, 3)
    for cloud, pose, maps in zip(paired[0], paired[1].cam_from_world, paired[2], strict=True):
        images = sorted({int(tag) % (shapes * views) for tag in cloud[:, 0]})
        assert len({int(tag) // (shapes * views) for tag in cloud[:, 0]}) == 1  # all of one code
        assert [int(value) - 1 for value in maps[:, 0, 0]] == images
        assert torch.equal(pose, camera.cam_from_world.flatten(0, 1)[images])


@pytest.mark.parametrize("distance", ["emd", "chamfer"])
def test_the_front_loss_has_the_papers_unit_and_an_empty_view_costs_nothing(distance: Any) -> None:
    """One view with all its points predicted 1 % too far along their rays, and one whose depth map is empty."""
    torch.manual_seed(0)
    camera = _cameras(1, 1, 8)
    depth = 1.9 + 0.2 * torch.rand(1, 1, 8, 8)
    depth[0, 0, :2] = torch.inf
    observed = unproject(depth, camera).points[0, 0, :48]
    moved = 0.01 * (observed - camera.position[0, 0])
    expected = (
        moved.norm(dim=-1).sum() * (56 / 8) ** 2 if distance == "emd" else 200 * moved.norm(dim=-1).mean()
    )
    points = (observed + moved)[None].requires_grad_()
    front = front_loss(points, camera, depth, distance)
    assert front.loss.item() == pytest.approx(expected.item(), rel=2e-2)
    assert front.statistics == {"matched_share": 1, "fallback_share": 0}
    (alone,) = torch.autograd.grad(front.loss, points)

    with_empty = torch.cat([depth, torch.full_like(depth, torch.inf)], 1)
    both = front_loss(points, camera.expand(1, 2), with_empty, distance)
    assert both.each.tolist() == [[front.loss.item(), 0]]
    (beside,) = torch.autograd.grad(both.each.sum(), points)
    assert torch.equal(beside, alone)
    assert both.statistics["fallback_share"] == 0
    nothing = front_loss(points, camera, with_empty[:, 1:], distance)
    assert not any(value.abs().sum() for value in (nothing.loss, *torch.autograd.grad(nothing.loss, points)))


def test_a_cloud_outside_the_image_is_counted_and_pulled_in() -> None:
    depth = torch.full((1, 1, 8, 8), 2.0)
    points = (torch.rand(1, 20, 3) + torch.tensor([0.0, 30.0, 0.0])).requires_grad_()
    front = front_loss(points, _cameras(1, 1, 8), depth, "chamfer")
    assert front.statistics["fallback_share"] == 1
    (gradient,) = torch.autograd.grad(front.loss, points)
    assert (gradient[..., 1] > 0).any()  # descent lowers y


def test_diversity_compares_a_part_of_the_images_and_points_of_single_views() -> None:
    """Half of the images and every other point, in turns; exchanging clouds between views changes the loss."""
    stage = dataclasses.replace(
        _OURS["cpu"].stage2, shapes=2, views=2, diversity_images=2, diversity_stride=2, alpha=1e-3
    )
    torch.manual_seed(0)
    codes, clouds = torch.randn(2, 4, 128), torch.rand(2, 4, 60, 3)
    compared = codes[:, [0, 2]], clouds[:, [0, 2], 1::2].contiguous()
    expected = diversity_loss(*compared, alpha=stage.exact_alpha, tolerance=0.2)
    assert torch.equal(diversity_term(codes, clouds, stage, views=2, step=3), expected)


def test_the_highly_diverse_variant_compares_joined_clouds() -> None:
    config = highly_diverse(_OURS["full"])
    stage = config.stage2
    assert (stage.joined_diversity, stage.beta, stage.steps, config.variant) == (
        True, 0.5, 40_000, "highly-diverse",
    )  # fmt: skip
    assert stage.exact_alpha == pytest.approx(15)
    assert config.stage1 == _OURS["full"].stage1
    small = highly_diverse(_OURS["cpu"]).stage2
    assert (small.joined_diversity, small.steps, small.exact_alpha) == (True, 800, pytest.approx(80))

    torch.manual_seed(0)
    views, codes, clouds = 4, torch.randn(3, 8, 128), torch.rand(3, 8, 300, 3)
    same = clouds[:1].expand_as(clouds)
    found = diversity_term(codes, same, stage, views=views, step=0)
    by_view = (codes[[0, 0, 1]] - codes[[1, 2, 2]]).norm(dim=-1).unflatten(1, (2, views))
    assert found.item() == pytest.approx(by_view.mean().item(), rel=1e-2)  # identical clouds have distance 0
    moved = torch.stack([clouds[0], clouds[0] + 0.5, clouds[0] + 1.0])
    assert diversity_term(codes, moved, stage, views=views, step=0) < found - 5


def test_only_the_best_of_n_predictions_gets_a_gradient(tiny_data: Path) -> None:
    trainer = Trainer(recipe("psgn-mon", "smoke"), _split(tiny_data, "psgn-mon"))
    batch, noise = trainer.draw_batch()
    codes = noise.codes.clone().requires_grad_()
    loss = trainer.method.losses["stage1"]
    report = loss(trainer.state, batch, noise._replace(codes=codes), Step(trainer.phase, 0))
    assert report["loss"] < report["mean_of_all"]
    (gradient,) = torch.autograd.grad(report["loss"], codes)
    assert (gradient.abs().sum(2) > 0).sum(0).tolist() == [1] * codes.shape[1]


def _flat_clouds(*, offset: float = 0.0) -> torch.Tensor:
    """(2, 3, 600, 3): two predictions for each of three images, squares at depth 0, or at depth 1."""
    square = torch.rand(600, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1.0, 1, 0])
    return torch.stack([square, square + torch.tensor([0, 0, 1.0])])[:, None].repeat(1, 3, 1, 1) + offset


def test_only_the_prediction_nearest_to_the_whole_shape_is_trained_on_it() -> None:
    """The shapes of the second and third image are the square at depth 1, which is their second prediction."""
    stage = dataclasses.replace(_OURS["cpu"].stage1, shape_weight=1.0)
    clouds = _flat_clouds(offset=0.01).requires_grad_()
    targets = _flat_clouds()[torch.tensor([0, 1, 1]), torch.arange(3)]
    loss, statistics = nearest_prediction_loss(clouds, targets, stage, step=3)
    (gradient,) = torch.autograd.grad(loss, clouds)
    trained = gradient.abs().sum((2, 3)) > 0
    assert trained.tolist() == [[True, False, False], [False, True, True]]
    assert (gradient.abs().sum(3) > 0).sum(2).amax() == 512  # a part of the points in each step
    nearest, others = statistics["nearest_emd"].item(), statistics["mean_emd"].item()
    assert nearest == pytest.approx(5, abs=4)
    assert others == pytest.approx((nearest + 100) / 2, rel=0.1)
    again, _ = nearest_prediction_loss(clouds, targets, stage, step=3)
    later, _ = nearest_prediction_loss(clouds, targets, stage, step=4)
    assert again == loss != later


def test_a_relaxed_loss_pulls_the_other_predictions_a_little() -> None:
    stage = dataclasses.replace(_OURS["cpu"].stage1, shape_weight=1.0, shape_relaxation=0.25)
    clouds = _flat_clouds(offset=0.01)[:, :1].requires_grad_()
    loss, statistics = nearest_prediction_loss(clouds, _flat_clouds()[0, :1], stage, step=0)
    strict, _ = nearest_prediction_loss(
        clouds, _flat_clouds()[0, :1], dataclasses.replace(stage, shape_relaxation=0.0), step=0
    )
    expected = 0.75 * strict + 0.25 * statistics["mean_emd"]
    torch.testing.assert_close(loss, expected)
    (gradient,) = torch.autograd.grad(loss, clouds)
    nearest, other = gradient[:, 0].sum(1)[:, 2]
    assert other == pytest.approx(0.25 * 100 / 2, rel=0.02)  # nearly straight towards depth 0
    assert nearest > 0


def test_the_whole_shape_loss_is_of_the_distance_that_was_asked_for() -> None:
    clouds, targets = _flat_clouds(offset=0.02)[:1], _flat_clouds()[0]
    stage = dataclasses.replace(_OURS["cpu"].stage1, shape_weight=1.0)
    found = {
        distance: nearest_prediction_loss(
            clouds, targets, dataclasses.replace(stage, shape_distance=distance), step=0
        )[0].item()
        for distance in ("emd", "chamfer", "both")
    }
    both = chamfer_distance(clouds[0], targets, squared=False)
    assert found["chamfer"] == pytest.approx(100 * (both.a_to_b + both.b_to_a).mean().item(), rel=1e-5)
    assert found["both"] == pytest.approx(found["emd"] + found["chamfer"], rel=1e-5)


def test_a_prediction_of_every_back_at_once_costs_more_than_one_of_the_right_back() -> None:
    """Half of the points on each of two possible backs: near by chamfer, far by the earth mover's distance."""
    one, other = _flat_clouds()[:, 0]
    everything = torch.cat([one[:300], other[300:]])
    stage = dataclasses.replace(_OURS["cpu"].stage1, shape_weight=1.0, shape_distance="emd")

    def loss(cloud: torch.Tensor, target: torch.Tensor) -> float:
        return nearest_prediction_loss(cloud[None, None], target[None], stage, step=0)[0].item()

    assert loss(everything, one) > loss(one, one) + 40
    assert loss(everything, other) > loss(other, other) + 40


# --- targets and oracles

_AROUND = torch.tensor([[2.0, 0, 0], [-2, 0, 0], [0, 0.3, 2], [0, 0.3, -2], [0.1, 2, 0], [0.1, -2, 0]])
_CENTRES = torch.cartesian_prod(*[(torch.arange(16) + 0.5) / 16 - 0.5] * 3).view(1, 16, 16, 16, 3)


def _seen_from_around(points: torch.Tensor) -> Targets:
    camera = PinholeCamera.look_at(_AROUND[None], focal_px=105.0, height=56, width=56)
    return Targets(points, splat_depth(points, camera, radius=1.0).depth, camera)


def _directions() -> torch.Tensor:
    torch.manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(1, 30_000, 3), dim=-1)


def test_cells_are_filled_to_the_surface_and_not_beyond() -> None:
    targets = _seen_from_around(0.3 * _directions())
    cells, distance = solid_cells(targets, 16), _CENTRES.norm(dim=-1)
    assert cells[distance < 0.27].all()
    assert not cells[distance > 0.4].any()  # between, the hull of six views has corners
    points = surface_points(cells.float(), 500, threshold=0.5)
    both = chamfer_distance(points, targets.points, squared=False)
    assert max(both.a_to_b.item(), both.b_to_a.item()) < 1 / 16


def test_cells_of_a_thin_plate_and_of_corners_that_no_view_sees() -> None:
    plate = torch.rand(1, 4000, 3) * torch.tensor([0.6, 0.6, 0.0]) - torch.tensor([0.3, 0.3, 0.01])
    camera = PinholeCamera.look_at(_AROUND[None, 2:4], focal_px=40.0, height=16, width=16)
    filled = solid_cells(Targets(plate, splat_depth(plate, camera).depth, camera), 16)[0].nonzero()
    assert filled[:, 2].unique().tolist() == [7]
    assert len(filled) >= 0.9 * (0.6 * 16) ** 2


def test_silhouettes_fill_a_hollow_that_a_view_looks_into() -> None:
    directions = _directions()
    bowl = 0.3 * torch.cat([directions[..., :1], -directions[..., 1:2].abs(), directions[..., 2:]], -1)
    targets = _seen_from_around(bowl)
    solid, hull = solid_cells(targets, 16), hull_cells(targets, 16)
    x, y, z = _CENTRES.unbind(-1)
    hollow = (y < -0.03) & (y > -0.15) & (x.square() + z.square() < 0.15**2)
    assert hull[hollow].all()
    assert not solid[hollow].any()  # the view from above sees the bottom behind it
    assert hull[(y < -0.03) & (_CENTRES.norm(dim=-1) < 0.28)].all()  # no silhouette excludes the bowl itself
    assert not hull[_CENTRES.norm(dim=-1) > 0.45].any()


def test_the_depth_maps_of_fixed_cameras_are_orthographic() -> None:
    torch.manual_seed(0)
    points = torch.rand(2, 200, 3) - 0.5
    maps, seen = fixed_depth(points, 32), fixed_cameras(points)
    pixel = ((seen[..., :2] + 0.5) * 32).floor().long()
    inside = ((pixel >= 0) & (pixel < 32)).all(-1)
    x, y = pixel.clamp(0, 31).unbind(-1)
    there = maps.flatten(2).gather(2, y * 32 + x)
    assert (there <= seen[..., 2] + 1e-6)[inside].all()  # its own pixel shows the point, or a nearer one
    assert (there - seen[..., 2]).abs()[inside].lt(1e-6).float().mean() > 0.7


@pytest.mark.parametrize("system", ["psgn", "lin", "r2n2", "ptn"])
def test_an_oracle_is_far_better_than_a_fresh_network(system: str, tiny_data: Path) -> None:
    torch.manual_seed(0)
    config, method, split = recipe(system, "smoke"), get_method(system), _split(tiny_data, system, limit=4)
    network = method.build(config)
    oracle = method.oracle(network, split.targets(torch.arange(len(split))))
    assert oracle is not None
    best = compare_clouds(oracle, split.points, points=network.points)
    fresh = evaluate_split(network, split, config.inference, views=2, seed=0)
    assert (best["cd"] < 0.6 * fresh["cd"]).all()
    if system != "ptn":  # the visual hull of these data's few views is far larger than the shape
        cell = 100 / 16  # the smallest grids and maps have 16 cells to the unit
        assert (best["pred_to_gt"] < (1e-4 if system == "psgn" else cell)).all()


@pytest.mark.parametrize("system", ["ours", "psgn-mon", "front-mon"])
def test_methods_with_codes_have_no_oracle(system: str, tiny_data: Path) -> None:
    method = get_method(system)
    targets = _split(tiny_data, system, limit=1).targets(torch.arange(1))
    assert method.oracle(method.build(recipe(system, "smoke")), targets) is None


# --- training


def _stages(config: FitConfig, **settings: Any) -> FitConfig:
    stage1, stage2 = (
        dataclasses.replace(stage, **settings) if stage.steps else stage
        for stage in (config.stage1, config.stage2)
    )
    return dataclasses.replace(config, stage1=stage1, stage2=stage2)


@pytest.mark.parametrize(
    ("system", "steps", "left"),
    [
        ("psgn", 50, 0.4), ("psgn-mon", 50, 0.6), ("front-mon", 110, 0.6), ("lin", 50, 0.8), ("r2n2", 40, 0.5),
        ("ptn", 50, 0.7),
    ],
)  # fmt: skip
def test_one_batch_can_be_overfitted(
    system: str, steps: int, left: float, tiny_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss on one batch of three shapes falls below a share of its largest value, in every phase."""
    config = _stages(recipe(system, "smoke"), steps=steps, learning_rate=2e-3, final_learning_rate=1e-3)
    trainer = Trainer(config, _split(tiny_data, system))
    for phase in config.phases:
        trainer.enter_phase(phase)
        drawn = trainer.draw_batch()
        monkeypatch.setattr(trainer, "draw_batch", lambda drawn=drawn: drawn)
        losses = [trainer.train_step()["loss"].item() for _ in range(steps)]
        monkeypatch.undo()
        if phase == "stage1":  # the front loss first rises with the number of visible points
            assert min(losses[-3:]) < left * max(losses[:20])
        else:
            assert sum(losses[-10:]) < sum(losses[:10])


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_one_shape_can_be_overfitted_by_our_method(precision: Any, train_split: LoadedSplit) -> None:
    """One shape, four joined views, without a critic: the front loss falls below 40 % of its start."""
    stage = dataclasses.replace(
        _OURS["smoke"].stage2, steps=100, shapes=1, views=4, codes=2, gamma=0.0, learning_rate=1e-3
    )
    one = dataclasses.replace(
        train_split, images=train_split.images[:1], depth=train_split.depth[:1], ids=train_split.ids[:1]
    )
    config = dataclasses.replace(_OURS["smoke"], stage1=stage, stage2=stage, precision=precision)
    trainer = Trainer(config, one)
    fronts = [trainer.train_step()["front"].item() for _ in range(stage.steps)]
    assert sum(fronts[-10:]) / 10 < 0.4 * fronts[0]


@pytest.mark.parametrize("system", ["ours", "ptn"])
def test_a_training_that_diverges_is_stopped(system: str, tiny_data: Path, tmp_path: Path) -> None:
    config = _stages(recipe(system, "smoke"), learning_rate=1e38, warmup=0, gamma=0.0)
    with pytest.raises(UserError, match="no longer finite; lower the learning rate"):
        fit(tiny_data, tmp_path / "run", config, progress=False)


@pytest.mark.parametrize("system", _OTHERS)
def test_a_run_of_each_method_is_trained_evaluated_and_used(
    system: str, tiny_data: Path, tmp_path: Path
) -> None:
    run, config = tmp_path / "run", recipe(system, "smoke")
    fit_it = ["fit", "--data", str(tiny_data), "--out", str(run), "--profile", "smoke", "--system", system]
    assert main(fit_it) == 0
    records = read_metrics(run)
    assert len(records) == sum(phase.steps for phase in config.phases.values())
    assert all(torch.tensor(record["loss"]).isfinite() for record in records)
    assert {"val_cd_1", "val_cd", "val_fps_cd", "image_sensitivity"} <= records[-1].keys()

    network, method = load_predictor(run), get_method(system)
    assert type(network) is method.network_class
    assert config_of(run, network) == config
    shares_our_network = system in ("psgn", "psgn-mon", "front-mon")
    of_a_lone_file = config_of(run / "checkpoints" / "best-stage1.safetensors", network)
    assert of_a_lone_file.system == method_of(network).name == ("ours" if shares_our_network else system)
    if not shares_our_network:
        with pytest.raises(UserError, match="holds no generator's weights"):
            load_generator(run)

    result = evaluate(run, tiny_data, seeds=(0,), views=(1, 3), progress=False)
    assert result["config"]["system"] == system
    assert json.loads((run / "evaluation.json").read_text())["views"]["3"]["cd"] == result["views"]["3"]["cd"]
    assert result["views"]["3"]["fps_cd"] > 0
    assert (result["diversity"] is None) == (system not in ("psgn-mon", "front-mon"))

    pictures = sorted(tiny_data.glob("rendered-shapenet/*/*/render_*.png"))[:3]
    assert main(["reconstruct", str(run), *map(str, pictures), "--out", str(tmp_path / "cloud")]) == 0
    cloud = read_points(tmp_path / "cloud" / "reconstruction.ply")
    assert len(cloud) == {"r2n2": 128, "lin": 3 * 512}.get(system, 3 * 128)


def test_predictions_of_several_views_are_scored_one_by_one(tiny_data: Path) -> None:
    split, config = _split(tiny_data, "ptn", limit=3), recipe("ptn", "smoke")
    network = get_method("ptn").build(config)
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


def test_a_network_that_reads_views_together_has_no_consistency(tiny_data: Path) -> None:
    split, config = _split(tiny_data, "r2n2", limit=2), recipe("r2n2", "smoke")
    scores = evaluate_split(get_method("r2n2").build(config), split, config.inference, views=3, seed=0)
    assert "consistency" not in scores
    assert scores["cd"].shape == (2,)


def test_dense_predictions_are_thinned_to_the_size_of_the_others(tiny_data: Path) -> None:
    torch.manual_seed(0)
    split, config = _split(tiny_data, "lin", limit=1), recipe("lin", "smoke")
    network = get_method("lin").build(config)
    found = reconstruct(network, split.float_images(torch.arange(1), torch.zeros(1, 1, dtype=torch.int64)))
    assert found.points.shape[1] == 4 * network.points
    scores = evaluate_split(network, split, config.inference, views=1, seed=0)
    assert (scores["fps_gt_to_pred"] > scores["gt_to_pred"]).all()


# --- a method of one's own
