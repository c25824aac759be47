"""The pose example's claims, at a third of its length."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        yield importlib.import_module("camera_pose")


@pytest.fixture(scope="module")
def result(example, tmp_path_factory):
    out = tmp_path_factory.mktemp("pose")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the example's main does
    try:
        return example.run(out, iterations=100), out
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize(
    ("loss", "factor"), [("key points", 100), ("depth map, views", 30), ("depth map, cloud", 8)]
)
def test_the_pose_error_falls_by_a_factor(result, loss, factor):
    errors = result[0][loss].errors
    assert errors[0].angle_deg == pytest.approx(20, abs=1e-3)
    assert errors[-1].angle_deg < 20 / factor
    assert errors[-1].distance < errors[0].distance / factor


def test_the_figure_is_written(result):
    assert (result[1] / "camera_pose.png").read_bytes()[:4] == b"\x89PNG"


def test_a_rigid_motion_turns_by_its_angle_and_keeps_lengths(example):
    motion = example.rigid_motion(torch.tensor([0.0, 0.0, torch.pi / 2, 0.0, 0.0, 0.5]))
    torch.testing.assert_close(motion @ torch.tensor([1.0, 0, 0, 1]), torch.tensor([0.0, 1.0, 0.5, 1.0]))
    turn = example.rigid_motion(torch.tensor([0.3, -1.0, 0.4, 1.0, 2.0, 3.0]))[:3, :3]
    torch.testing.assert_close(turn @ turn.T, torch.eye(3))


def test_the_true_pose_is_where_the_losses_are_least(example):
    scene = example.make_scene()
    start = example.PinholeCamera(scene.camera.K, scene.start_from_world, example.SIZE, example.SIZE)
    for loss in example.LOSSES.values():
        assert loss(scene, scene.camera) < 0.25 * loss(scene, start)
    assert example.pose_error(scene.camera.cam_from_world, scene.camera) == pytest.approx((0, 0), abs=1e-6)


def test_help_and_a_wrong_argument():
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {"PYTHONPATH": str(EXAMPLES.parent), "PATH": "", "COLUMNS": "100"}
        command = [sys.executable, str(EXAMPLES / "camera_pose.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    shown = call("--help")
    assert shown.returncode == 0, shown.stderr
    assert "--angle-deg" in shown.stdout
    assert "Finding a camera" in shown.stdout
    refused = call("--iterations", "3")
    assert refused.returncode == 2
    assert "at least 20" in refused.stderr
    assert "Traceback" not in refused.stderr
