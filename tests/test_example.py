"""The example's claims, at a third of its length."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from diffpoint import chamfer_distance, unproject

EXAMPLE = Path(__file__).parents[1] / "examples" / "front_vs_projection.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(EXAMPLE))


@pytest.fixture(scope="module")
def result(example, tmp_path_factory):
    out = tmp_path_factory.mktemp("example")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the example's main does
    try:
        return example["run"](out, iterations=100), out
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("shape", ["chair", "table", "sofa"])
def test_the_front_constraint_finds_what_one_view_sees_and_the_projection_loss_does_not(result, shape):
    fits, _ = result
    front, projection = fits[shape, 1, "front"], fits[shape, 1, "projection"]
    assert front.measures.visible_cd <= 0.1 * projection.measures.visible_cd
    assert front.measures.inside > 0.8 > 0.5 > projection.measures.inside
    assert front.losses[-1] < 0.1 * front.losses[0]
    assert projection.losses[-1] < 0.1 * projection.losses[0], "it did fit its own loss"


@pytest.mark.parametrize("shape", ["chair", "table", "sofa"])
def test_one_view_of_the_projection_loss_pulls_along_the_axis_only(result, shape):
    fits, _ = result
    assert fits[shape, 1, "projection"].sideways == [0.0] * len(fits[shape, 1, "projection"].losses)
    assert min(fits[shape, 1, "front"].sideways) > 0.5


def test_table_and_figure_hold_every_fit(result):
    fits, out = result
    rows = (out / "table.md").read_text().splitlines()
    assert len(fits) == 12
    assert len(rows) == 2 + len(fits)
    assert len({row.count("|") for row in rows}) == 1
    assert (out / "front_vs_projection.png").read_bytes()[:4] == b"\x89PNG"


def test_depth_of_a_box_is_exact(example):
    """A cube before a camera on its axis: the near face fills f * side / z pixels at depth z."""
    camera = example["PinholeCamera"].look_at(
        torch.tensor([[0.0, 0.0, 2.0]]), focal_px=35.0, height=20, width=20
    )
    depth = example["box_depth"](torch.tensor([[-0.25, -0.25, -0.25, 0.25, 0.25, 0.25]]), camera)
    near = torch.isfinite(depth)
    assert near.sum() == round(35 * 0.5 / 1.75) ** 2
    torch.testing.assert_close(depth[near], torch.full((100,), 1.75))


def test_the_sampled_surface_is_where_the_depth_maps_are(example):
    for boxes in example["SHAPES"].values():
        scene = example["make_scene"](boxes, views=8)
        assert scene.surface.shape == (1, 4096, 3)
        observed = unproject(scene.depth, scene.camera)
        observed = observed.points[:, :, : int(observed.lengths.min())].flatten(1, 2)
        assert chamfer_distance(observed, scene.surface, squared=False).a_to_b < 0.015
        assert example["in_silhouette"](scene, scene.surface, margin=1).float().mean() > 0.99


def test_help_and_a_wrong_argument():
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {"PYTHONPATH": str(EXAMPLE.parents[1]), "PATH": "", "COLUMNS": "100"}
        return subprocess.run(
            [sys.executable, str(EXAMPLE), *arguments], capture_output=True, text=True, env=environment
        )

    shown = call("--help")
    assert shown.returncode == 0
    assert "--iterations" in shown.stdout
    assert "front constraint" in shown.stdout
    refused = call("--iterations", "3")
    assert refused.returncode == 2
    assert "at least 20" in refused.stderr
    assert "Traceback" not in refused.stderr
