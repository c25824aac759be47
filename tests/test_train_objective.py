"""The training loss: who meets whose camera, the paper's units, the schedules."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import get_args

import pytest
import torch

from diffpoint import PinholeCamera, diversity_loss, unproject
from diffpoint.visibility import METHODS
from train.config import (
    EXACT_MEAN_EMD_FROM_PAPER,
    PROFILES,
    Visibility,
    fit_config_from_json,
    scaled,
    to_json,
    with_steps,
    with_variant,
)
from train.errors import UserError
from train.methods.losses import Scene, arrange_scenes, front_loss, spread_loss


def _cameras(shapes: int, views: int, size: int) -> PinholeCamera:
    angles = torch.linspace(0, 5, shapes * views).reshape(shapes, views)
    eyes = 2 * torch.stack([angles.cos(), 0.2 * torch.ones_like(angles), angles.sin()], -1)
    return PinholeCamera.look_at(eyes, focal_px=1.875 * size, height=size, width=size)


@pytest.mark.parametrize("joined", [False, True])
def test_every_cloud_meets_the_cameras_of_its_own_images(joined: bool) -> None:
    codes, shapes, views, points = 3, 2, 4, 5
    tags = torch.arange(codes * shapes * views).reshape(codes, shapes * views)
    clouds = tags[..., None, None].expand(-1, -1, points, 3).float()
    camera = _cameras(shapes, views, 8)
    depth = torch.arange(shapes * views).reshape(shapes, views, 1, 1).expand(-1, -1, 8, 8).float() + 1
    scene = arrange_scenes(clouds, camera, depth, joined_views=joined)
    together = views if joined else 1
    assert scene.points.shape == (codes * shapes * views // together, together * points, 3)
    for row in range(len(scene.points)):
        images = sorted({int(tag) % (shapes * views) for tag in scene.points[row, :, 0]})
        assert len({int(tag) // (shapes * views) for tag in scene.points[row, :, 0]}) == 1  # one code slot
        assert [int(value) - 1 for value in scene.depth[row, :, 0, 0]] == images
        expected = camera.cam_from_world.flatten(0, 1)[images]
        assert torch.equal(scene.camera.cam_from_world[row], expected)


@pytest.mark.parametrize("distance", ["emd", "chamfer"])
def test_front_loss_has_the_papers_unit(distance: str) -> None:
    """Every observed point is predicted, 1 % too far along its ray: the distances are known."""
    torch.manual_seed(0)
    camera = _cameras(1, 1, 8)
    depth = 1.9 + 0.2 * torch.rand(1, 1, 8, 8)
    depth[0, 0, :2] = torch.inf
    observed = unproject(depth, camera).points[0, 0, :48]
    moved = 0.01 * (observed - camera.position[0, 0])
    scene = Scene((observed + moved)[None], camera, depth)
    front = front_loss(scene, "emd" if distance == "emd" else "chamfer")
    distances = moved.norm(dim=-1)
    expected = distances.sum() * (56 / 8) ** 2 if distance == "emd" else 200 * distances.mean()
    assert front.loss.item() == pytest.approx(expected.item(), rel=2e-2)
    assert front.shares["matched_share"] == 1
    assert front.shares["fallback_share"] == 0


def test_a_cloud_out_of_sight_is_counted_and_pulled_in() -> None:
    camera = _cameras(1, 1, 8)
    depth = torch.full((1, 1, 8, 8), 2.0)
    points = (torch.rand(1, 20, 3) + torch.tensor([0.0, 30.0, 0.0])).requires_grad_()
    front = front_loss(Scene(points, camera, depth), "chamfer")
    front.loss.backward()
    assert front.shares["fallback_share"] == 1
    assert points.grad is not None
    assert (points.grad[..., 1] > 0).any()  # descent lowers y


def test_diversity_waits_for_the_image_and_the_rate_warms_up_and_cools_down() -> None:
    stage = dataclasses.replace(
        PROFILES["cpu"].stage1,
        steps=100,
        ramp=(10, 30),
        beta=8.0,
        warmup=9,
        learning_rate=1e-3,
        final_learning_rate=1e-4,
    )
    assert [stage.diversity_weight(step) for step in (0, 10, 20, 30, 99)] == [0, 0, 4, 8, 8]
    assert stage.learning_rate_at(0) == pytest.approx(1e-4)
    assert stage.learning_rate_at(9) > 0.95e-3
    assert stage.learning_rate_at(100) == pytest.approx(1e-4)


def test_full_profile_holds_the_papers_numbers() -> None:
    first, second = PROFILES["full"].stages
    assert (first.shapes, first.views, first.codes, first.steps) == (2, 8, 5, 40_000)
    assert (first.alpha, first.beta, first.front) == (0.2, 10, "emd")
    assert (second.alpha, second.beta, second.front, second.steps) == (0.1, 1, "chamfer", 100_000)
    assert (first.gamma, second.gamma, first.n_critic, first.penalty) == (0.1, 0.1, 1, 10)
    assert first.exact_alpha == pytest.approx(0.2 * EXACT_MEAN_EMD_FROM_PAPER)


def test_the_deterministic_counterpart_diversifies_nothing() -> None:
    for stage in dataclasses.replace(PROFILES["cpu"], deterministic=True).stages:
        assert (stage.codes, stage.beta) == (1, 0)


def test_configurations_know_every_way_to_tell_what_a_camera_sees() -> None:
    assert get_args(Visibility) == METHODS


@pytest.mark.parametrize("profile", ["full", "cpu", "smoke"])
def test_configurations_survive_the_way_to_disk(profile: str) -> None:
    config = dataclasses.replace(scaled(PROFILES[profile], 0.5), categories=("chair",))
    assert fit_config_from_json(to_json(config, data=Path("somewhere")), where="x") == config


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"stage1": 3}', '{"unknown": 1}'])
def test_what_is_no_configuration_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"config\.json is not the configuration"):
        fit_config_from_json(text, where="config.json")


def test_scaling_shortens_everything_alike() -> None:
    config = scaled(PROFILES["cpu"], 0.25)
    assert config.pretrain.steps == PROFILES["cpu"].pretrain.steps // 4
    assert config.stage1.steps == PROFILES["cpu"].stage1.steps // 4
    assert config.stage1.ramp[1] == PROFILES["cpu"].stage1.ramp[1] // 4


def test_other_lengths_keep_ramps_and_warm_ups_in_proportion() -> None:
    config = with_steps(PROFILES["full"], 20)
    assert (config.pretrain.steps, config.stage1.steps, config.stage2.steps) == (20, 20, 20)
    assert config.stage1.ramp == (0, 2)  # of 40 000 steps, 1 000 and 4 000
    assert config.stage1.warmup == 0
    assert with_steps(PROFILES["full"], 80_000).stage1.ramp == (2_000, 8_000)


def test_the_highly_diverse_model_asks_the_joined_clouds_for_a_whole_object_of_change() -> None:
    config = with_variant(PROFILES["full"], "highly-diverse")
    stage = config.stage2
    assert (stage.joined_diversity, stage.beta, stage.steps) == (True, 0.5, 40_000)
    assert stage.exact_alpha == pytest.approx(15)
    assert config.stage1 == PROFILES["full"].stage1
    assert with_variant(PROFILES["full"], "standard") == PROFILES["full"]
    # Without a critic, for a fifth.
    small = with_variant(PROFILES["cpu"], "highly-diverse").stage2
    assert (small.joined_diversity, small.steps, small.exact_alpha) == (True, 800, pytest.approx(80))

    torch.manual_seed(0)
    views, codes, clouds = 4, torch.randn(3, 8, 128), torch.rand(3, 8, 300, 3)
    same = clouds[:1].expand_as(clouds)
    spread = spread_loss(codes, same, stage, views=views, step=0)
    by_view = (codes[[0, 0, 1]] - codes[[1, 2, 2]]).norm(dim=-1).unflatten(1, (2, views))
    assert spread.item() == pytest.approx(by_view.mean().item(), rel=1e-2)  # identical clouds move nothing
    moved = torch.stack([clouds[0], clouds[0] + 0.5, clouds[0] + 1.0])
    assert spread_loss(codes, moved, stage, views=views, step=0) < spread - 5


def test_the_stages_compare_the_clouds_of_single_images() -> None:
    """Half of the images and every other point, in turns; exchanging clouds between views changes the loss."""
    stage = dataclasses.replace(
        PROFILES["cpu"].stage2, shapes=2, views=2, diversity_images=2, diversity_stride=2, alpha=1e-3
    )
    torch.manual_seed(0)
    codes, clouds = torch.randn(2, 4, 128), torch.rand(2, 4, 60, 3)
    compared = codes[:, [0, 2]], clouds[:, [0, 2], 1::2].contiguous()
    expected = diversity_loss(*compared, alpha=stage.exact_alpha, tolerance=0.2)
    assert torch.equal(spread_loss(codes, clouds, stage, views=2, step=3), expected)
