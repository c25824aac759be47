"""Each example runs at a short setting, and what it claims holds there."""

from __future__ import annotations

import ast
import importlib
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import diffpoint as dp

EXAMPLES = Path(__file__).parents[1] / "examples"
PROGRAMS = ("autoencoder", "front_vs_projection", "warp_depth")


@pytest.fixture(scope="module")
def example():
    """Imports an example by its name, as if its folder was that of the started script."""
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        torch.set_num_threads(1)
        yield importlib.import_module
        torch.set_num_threads(threads)


def read_table(path: Path, keys: int) -> dict:
    """A Markdown table by the values of its first columns."""
    header, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in path.read_text().splitlines()
    ]
    return {
        row[0] if keys == 1 else tuple(row[:keys]): {
            name: float(cell) for name, cell in zip(header[keys:], row[keys:], strict=True) if cell
        }
        for row in rows
    }


def is_png(path: Path) -> bool:
    return path.read_bytes()[:4] == b"\x89PNG"


@pytest.fixture(scope="module")
def front_vs_projection(example, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("front_vs_projection")
    example("front_vs_projection").main(["--out", str(out), "--iterations", "40"])
    return out


@pytest.mark.parametrize("shape", ["chair", "table", "sofa"])
def test_the_front_constraint_fits_what_one_view_sees_and_the_projection_loss_does_not(
    front_vs_projection, shape
):
    table = read_table(front_vs_projection / "table.md", 3)
    front, projection = (table[shape, "1", loss] for loss in ("front constraint", "projection loss"))
    assert front["visible part"] <= 0.1 * projection["visible part"]
    assert front["inside silhouettes"] > 0.75 > 0.6 > projection["inside silhouettes"]
    assert projection["own loss, last"] < 0.3 * projection["own loss, first"], "it did fit its own loss"
    across = "gradient in the first camera's x, y"
    assert projection[across] == table[shape, "1", "Lin et al."][across] == 0
    assert front[across] > 0.5
    assert table[shape, "8", "projection loss"][across] > 0
    assert front["visible part"] < table[shape, "1", "soft projection loss"]["visible part"]
    assert table[shape, "1", "Lin et al."]["points left"] < 1 == front["points left"]


def test_front_vs_projection_writes_every_fit(front_vs_projection):
    assert len(read_table(front_vs_projection / "table.md", 3)) == 3 * 2 * 4
    assert is_png(front_vs_projection / "clouds.png")


def test_the_chamfer_distance_crowds_points_and_the_emd_spreads_them(example, tmp_path):
    settings = ["--out", str(tmp_path), "--steps", "100", "--shapes", "100", "--points", "128"]
    example("autoencoder").main(settings)
    table = read_table(tmp_path / "table.md", 1)
    assert table["EMD"]["EMD"] < 0.9 * table["chamfer"]["EMD"]
    assert table["EMD"]["crowding"] < 0.9 * table["chamfer"]["crowding"]
    for loss in ("chamfer", "EMD"):
        assert table[loss]["chamfer"] < 22, "about 32 before training: it did learn"
    assert is_png(tmp_path / "clouds.png")


@pytest.fixture(scope="module")
def warp_depth(example, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("warp_depth")
    example("warp_depth").main(["--out", str(out), "--iterations", "120"])
    return out


@pytest.mark.parametrize(("loss", "factor"), [("matched pixels", 100), ("warped depth", 40), ("clouds", 40)])
def test_the_pose_error_falls_by_a_factor(warp_depth, loss, factor):
    table = read_table(warp_depth / "table.md", 1)
    assert table["(first guess)"]["rotation error, degrees"] == pytest.approx(20, abs=1e-3)
    for error in ("rotation error, degrees", "distance"):
        assert table[loss][error] < table["(first guess)"][error] / factor
    assert is_png(warp_depth / "warp.png")


@pytest.mark.parametrize("loss", ["matched pixels", "warped depth", "clouds"])
def test_the_gradient_to_the_pose_is_that_of_finite_differences(example, loss):
    module = example("warp_depth")
    scene = module.Scene(*(x if x.dtype == torch.int64 else x.to(torch.float64) for x in module.make_scene()))

    def value(twist: torch.Tensor) -> torch.Tensor:
        pose = scene.second.cam_from_world @ module.rigid_motion(twist)
        return module.LOSSES[loss](
            scene, dp.PinholeCamera(scene.second.K, pose, *scene.first_depth.shape[2:])
        )

    at = torch.tensor([0.05, -0.03, 0.02, 0.01, 0.02, -0.03], dtype=torch.float64, requires_grad=True)
    value(at).backward()
    steps = 1e-7 * torch.eye(6, dtype=torch.float64)
    with torch.no_grad():
        slopes = torch.stack([(value(at + step) - value(at - step)) / 2e-7 for step in steps])
    torch.testing.assert_close(at.grad, slopes, rtol=1e-4, atol=1e-5)


def test_a_rigid_motion_rotates_by_its_angle_and_keeps_lengths(example):
    rigid_motion = example("warp_depth").rigid_motion
    motion = rigid_motion(torch.tensor([0.0, 0.0, torch.pi / 2, 0.0, 0.0, 0.5]))
    torch.testing.assert_close(motion @ torch.tensor([1.0, 0, 0, 1]), torch.tensor([0.0, 1.0, 0.5, 1.0]))
    rotation = rigid_motion(torch.tensor([0.3, -1.0, 0.4, 1.0, 2.0, 3.0]))[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))
    assert example("warp_depth").pose_error(motion, torch.eye(4)) == pytest.approx((90, 0.5))


def signed_distance(points: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
    """(N,) to the union of boxes (K, 6); negative inside."""
    low, high = boxes.view(-1, 2, 3).unbind(1)
    outside = torch.maximum(low - points[:, None], points[:, None] - high)
    return (outside.clamp(min=0).norm(dim=-1) + outside.amax(-1).clamp(max=0)).amin(-1)


@pytest.mark.parametrize("kind", ["chair", "table", "sofa", "lamp", "shelf"])
def test_points_and_depth_maps_of_furniture_lie_on_its_surface(example, kind):
    shapes = example("shapes")
    random = torch.Generator().manual_seed(0)
    for _ in range(5):
        boxes = shapes.furniture(kind, random)
        assert boxes.view(-1, 3).norm(dim=-1).max().item() == pytest.approx(0.5)
        points = shapes.sample_surface(boxes, 2048, random)
        assert points.shape == (2048, 3)
        assert signed_distance(points, boxes).abs().max() < 1e-5
        camera = shapes.orbit(torch.tensor([20.0, 200.0]))
        seen, lengths = dp.unproject(shapes.render_depth(boxes, camera)[None], camera)
        for view in range(2):
            assert lengths[0, view] > 100
            assert signed_distance(seen[0, view, : lengths[0, view]], boxes).abs().max() < 1e-5
            # From the camera to the point, one sees nothing else.
            between = torch.lerp(seen[0, view, : lengths[0, view]], camera.position[view], 0.01)
            assert signed_distance(between, boxes).min() > 0
    with pytest.raises(ValueError, match="must be one of chair, table"):
        shapes.furniture("piano", random)


def test_points_are_uniform_on_the_faces_that_are_outside(example):
    two_cubes = torch.tensor([[0.0, 0, 0, 1, 1, 1], [0, 1, 0, 1, 2, 1]])
    points = example("shapes").sample_surface(two_cubes, 20000, torch.Generator().manual_seed(0))
    assert not ((points[:, 1] == 1) & (points[:, [0, 2]] % 1 > 0).all(-1)).any(), "the face between the cubes"
    low = points[:, 1] < 1
    for face in (
        points[:, 1] == 0,
        points[:, 1] == 2,
        (points[:, 0] == 0) & low,
        (points[:, 2] == 1) & ~low,
    ):
        share = face.float().mean().item()
        assert share == pytest.approx(0.1, abs=4 * math.sqrt(0.1 * 0.9 / 20000))


@pytest.mark.parametrize("program", PROGRAMS)
def test_an_example_needs_the_layer_and_drawing_only(program):
    tree = ast.parse((EXAMPLES / f"{program}.py").read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    others = {name.split(".")[0] for name in imported} - sys.stdlib_module_names
    assert others <= {"diffpoint", "torch", "matplotlib", "shapes"}


@pytest.mark.parametrize(
    ("program", "wrong", "explained"),
    [
        ("autoencoder", ["--points", "5000"], "--points between 1 and 1024"),
        ("front_vs_projection", ["--iterations", "3"], "at least 20"),
        ("warp_depth", ["--iterations", "3"], "at least 20"),
    ],
)
def test_help_and_a_wrong_argument(example, capsys, program, wrong, explained):
    with pytest.raises(SystemExit, match="0"):
        example(program).main(["--help"])
    shown = capsys.readouterr().out
    assert f"python examples/{program}.py --out" in shown, "the docstring is the help"
    assert wrong[0] in shown
    with pytest.raises(SystemExit, match="2"):
        example(program).main(wrong)
    assert explained in capsys.readouterr().err


def test_an_example_starts_from_any_folder(tmp_path):
    script = EXAMPLES / "front_vs_projection.py"
    environment = {"PYTHONPATH": str(EXAMPLES.parent), "PATH": "", "COLUMNS": "100"}
    done = subprocess.run(
        [sys.executable, str(script), "--iterations", "3"],
        capture_output=True, text=True, env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "at least 20" in done.stderr
    assert "Traceback" not in done.stderr
