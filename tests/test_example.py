"""The example's claims, at a third of its length."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

EXAMPLE = Path(__file__).parents[1] / "examples" / "front_vs_projection.py"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    out = tmp_path_factory.mktemp("example")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the example's main does
    try:
        return runpy.run_path(str(EXAMPLE))["run"](out, iterations=70), out
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("shape", ["chair", "table", "sofa"])
def test_the_front_constraint_finds_what_one_view_sees_and_the_projection_loss_does_not(result, shape):
    fits, _ = result
    front, projection = (fits[shape, "1 horizontal view", loss] for loss in ("front", "projection"))
    assert front.measures.visible_cd <= 0.1 * projection.measures.visible_cd
    assert front.measures.inside > 0.75 > 0.6 > projection.measures.inside
    assert projection.losses[-1] < 0.3 * projection.losses[0], "it did fit its own loss"
    assert projection.sideways == projection.largest_sideways == 0
    assert front.sideways > 0.5
    soft = fits[shape, "1 horizontal view", "soft"].measures
    assert front.measures.visible_cd < soft.visible_cd < projection.measures.visible_cd


def test_table_and_figure_hold_every_fit(result):
    fits, out = result
    rows = (out / "table.md").read_text().splitlines()
    assert len(fits) == 24
    assert len(rows) == 2 + len(fits)
    assert len({row.count("|") for row in rows}) == 1
    assert (out / "clouds.png").read_bytes()[:4] == b"\x89PNG"


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
