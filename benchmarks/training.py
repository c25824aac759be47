"""Where a training step's time goes, and the same step with the reference implementations of `diffpoint.reference`.

The data are generated in memory: reading files is not part of a step. Predictions are those of a network that has made
a few steps.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor

import diffpoint as dp
from benchmarks.inputs import surfaces
from benchmarks.peers import optional
from diffpoint import losses, reference
from models import PROFILES as SIZES
from train.config import FitConfig, StageConfig
from train.data.batches import LoadedSplit
from train.device import CPU, connect
from train.methods import losses as train_losses
from train.methods import recipe
from train.training.trainer import Trainer

_SHAPES, _VIEWS = 16, 8
_STEPS = {"smoke": (5, 10), "cpu": (5, 8), "full": (1, 2)}
"""Steps to warm up, and steps to measure."""
_WITH_REFERENCE = (
    "smoke",
    "cpu",
)  # with the full profile, the matrices of the reference would not fit the memory


def measure(*, quick: bool = False, device: torch.device = CPU) -> Iterator[dict[str, Any]]:
    """A row for both stages of each profile; on a GPU of those worth it, without the reference."""
    on_cpu = device == CPU
    profiles = ("smoke", "cpu") if quick else ("smoke", "cpu", "full") if on_cpu else ("cpu", "full")
    for profile in profiles:
        config = recipe("ours", profile)
        trainer = Trainer(config, _data(config).to(device), connect(device))
        for name in ("stage1", "stage2"):
            trainer.enter_phase(name)
            stage = trainer.phase
            assert isinstance(stage, StageConfig)
            warm, steps = _STEPS[profile] if on_cpu else (5, 15)
            # Where the diversity loss has its full weight, and the learning rate is small enough to change little.
            trainer.step = min(stage.ramp[1] + 1, stage.steps - 1)
            row = {"profile": profile, "stage": name[-1], **_shares(trainer, warm, 2 if quick else steps)}
            if profile in _WITH_REFERENCE and on_cpu:
                with reference_ops():
                    row["reference_ratio"] = 1e3 * _seconds(trainer.train_step) / row["ms"]
                if optimize := optional("scipy.optimize"):
                    solve = optimize.linear_sum_assignment
                    with reference_ops(lambda cost, solve=solve: torch.from_numpy(solve(cost)[1])):
                        row["scipy_ratio"] = 1e3 * _seconds(trainer.train_step) / row["ms"]
            parts = ", ".join(f"{part} {share:.0%}" for part, share in row["shares"].items())
            print(f"  {profile}, stage {row['stage']}: {row['ms']:.0f} ms a step ({parts})", flush=True)
            yield row


def _shares(trainer: Trainer, warm: int, steps: int) -> dict[str, Any]:
    """Median milliseconds of a step, and the shares of its parts."""
    for _ in range(warm):
        trainer.train_step()
    milliseconds: list[float] = []
    parts: dict[str, list[float]] = {}
    rendering: list[float] = []

    original = losses._front_sets

    def _front_sets(*arguments: Any, **options: Any) -> Any:
        start = _now()
        result = original(*arguments, **options)
        rendering.append(_now() - start)
        return result

    if trainer.device != CPU:  # looking into a step makes it wait for the GPU
        plain = [1e3 * _seconds(trainer.train_step) for _ in range(steps)]
    with _replaced(_front_sets):
        for _ in range(steps):
            rendering.clear()
            trainer.timer.reset()
            milliseconds.append(1e3 * _seconds(trainer.train_step))
            times = {k.removesuffix("_seconds"): v for k, v in trainer.timer.read().items()}
            times["splat and sample"] = sum(rendering)
            times["distances"] -= sum(rendering)
            for part in ("network", "critic", "splat and sample", "distances", "data"):
                parts.setdefault(part, []).append(times.get(part, 0.0))
    whole = sum(map(statistics.median, parts.values()))
    shares = {part: statistics.median(values) / whole for part, values in parts.items()}
    return {
        "ms": statistics.median(milliseconds if trainer.device == CPU else plain),
        "shares": shares,
        "layer_share": shares["splat and sample"] + shares["distances"],
    }


def _seconds(function: Callable[[], Any]) -> float:
    start = _now()
    function()
    return _now() - start


def _now() -> float:
    """Seconds, after what was given to a GPU."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def _data(config: FitConfig) -> LoadedSplit:
    """Shapes made of boxes, their depth maps, and noise for images."""
    size, side = SIZES[config.profile], config.map_size
    points = surfaces(_SHAPES, 4096)
    azimuth = torch.linspace(0, 2 * torch.pi, _VIEWS + 1)[:-1]
    eyes = 2 * torch.stack((0.95 * azimuth.cos(), torch.full_like(azimuth, 0.3), 0.95 * azimuth.sin()), -1)
    camera = dp.PinholeCamera.look_at(eyes, focal_px=420 * side / 224, height=side, width=side)
    camera = camera.expand(_SHAPES, _VIEWS)
    return LoadedSplit(
        images=torch.randint(
            0, 256, (_SHAPES, _VIEWS, 3, size.image_height, size.image_width), dtype=torch.uint8
        ),
        depth=dp.splat_depth(points, camera, radius=1.0).depth,
        K=camera.K.clone(),
        cam_from_world=camera.cam_from_world.clone(),
        points=points,
        ids=[f"made/{i}" for i in range(_SHAPES)],
        categories=["boxes"] * _SHAPES,
    )


@contextlib.contextmanager
def reference_ops(assign: Callable[[Any], Tensor] = reference.assign) -> Iterator[None]:
    """Within, the losses of training are computed by `diffpoint.reference`.

    Args:
        assign: replaces the reference's own search for the best assignment, which takes a second a pair.
    """

    def visible_points(points: Tensor, camera: dp.PinholeCamera, **_: Any) -> Tensor:
        return reference.splat_depth(points, camera.K, camera.cam_from_world, camera.height, camera.width)[2]

    def sample_view(points: Tensor, visible: Tensor) -> dp.ViewSample:
        return dp.ViewSample(*reference.sample_view(points, visible))

    def unproject(depth: Tensor, camera: dp.PinholeCamera) -> dp.PointSets:
        return dp.PointSets(*reference.unproject(depth, camera.K, camera.cam_from_world))

    def chamfer_distance(a: Tensor, b: Tensor, **options: Any) -> dp.Chamfer:
        return dp.Chamfer(*reference.chamfer_distance(a, b, **options))

    def earth_mover_distance(
        a: Tensor, b: Tensor, *, tolerance: float = 0.0, enough: Tensor | None = None, **lengths: Tensor
    ) -> dp.Transport:
        del tolerance, enough  # the reference is exact
        cost, assignment = reference.earth_mover_distance(a, b, **lengths)
        prices = a.new_zeros((*cost.shape, max(a.shape[-2], b.shape[-2])))
        converged = torch.ones_like(cost, dtype=torch.bool)
        return dp.Transport(cost, assignment, torch.zeros_like(cost), converged, prices)

    replacements = [visible_points, sample_view, unproject, chamfer_distance, earth_mover_distance]
    with mock.patch.object(reference, "assign", assign), _replaced(*replacements):
        yield


@contextlib.contextmanager
def _replaced(*functions: Callable) -> Iterator[None]:
    """Within, the losses use these functions instead of those of the same names."""
    with contextlib.ExitStack() as stack:
        for module in (losses, train_losses):
            for function in functions:
                if hasattr(module, function.__name__):
                    stack.enter_context(mock.patch.object(module, function.__name__, function))
        yield
