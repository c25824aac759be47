"""Training: one loop for both stages, whose differences are the values of `StageConfig`.

Start reading at `training_step`.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from diffpoint import diversity_loss
from models import PROFILES, Generator
from train.batches import Batch, LoadedSplit, load_split
from train.checkpoint import best_weights, latest_checkpoint, load_checkpoint, load_generator, save_checkpoint
from train.config import FitConfig, StageConfig, fit_config_from_json, to_json
from train.errors import UserError
from train.files import write_text
from train.interrupts import StopRequest
from train.log import RunLog
from train.objective import arrange_scenes, front_loss
from train.state import Training

_HEALTH_IMAGES = 12


class StepReport(NamedTuple):
    """What one training step saw; scalars without gradient."""

    loss: Tensor
    front: Tensor
    diversity: Tensor
    matched_share: Tensor
    fallback_share: Tensor


def training_step(
    model: Generator,
    optimiser: torch.optim.Optimizer,
    batch: Batch,
    codes: Tensor,
    stage: StageConfig,
    *,
    step: int,
) -> StepReport:
    """One step of either stage: predict, compare with what the cameras saw, push codes apart, descend.

    Args:
        model: the generator.
        optimiser: over its parameters.
        batch: B shapes with V views each.
        codes: (R, B*V, code_dim) from N(0, 1).
        stage: the stage's settings.
        step: number of this step within the stage, for the schedules.
    """
    for group in optimiser.param_groups:
        group["lr"] = stage.learning_rate_at(step)

    clouds = model(batch.images.flatten(0, 1), codes)  # (R, B*V, N, 3): the trunk sees each image once
    _check_finite(clouds, step)

    # Every cloud before its own image's camera, or a shape's clouds joined and before each of its cameras.
    scene = arrange_scenes(clouds, batch.camera, batch.depth, joined_views=stage.joined_views)
    front = front_loss(scene, stage.front)

    # Clouds of one image must differ as much as their codes do. Always single-view clouds, in both stages.
    beta = stage.diversity_weight(step)
    diversity = torch.zeros(())
    if beta > 0:
        some = slice(0, stage.diversity_images)
        thin = slice(step % stage.diversity_stride, None, stage.diversity_stride)
        diversity = diversity_loss(codes[:, some], clouds[:, some, thin], alpha=stage.exact_alpha)

    # The paper's sum; its third term, the latent critic's opinion of the clouds, belongs here.
    loss = front.loss + beta * diversity

    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return StepReport(
        loss.detach(), front.loss.detach(), diversity.detach(), front.matched_share, front.fallback_share
    )


def fit(data: Path, out: Path, config: FitConfig, *, resume: bool = False, progress: bool = True) -> bool:
    """Trains a generator and keeps everything about it in the run directory `out`.

    Args:
        data: root of a data tree with train and val splits.
        out: the run's directory; must not hold a run yet, unless resuming.
        config: the recipe.
        resume: continue the run in `out` from its newest checkpoint, to the same bits.
        progress: show bars.

    Returns:
        True when training is complete, False when a signal (Ctrl-C, SIGTERM) ended it early, after saving.

    Raises:
        UserError: unusable data or run, a configuration that does not fit them, or a training that has failed.
    """
    _check_run_directory(out, config, resume=resume)
    size = PROFILES[config.profile]
    read = functools.partial(
        load_split,
        data,
        image_size=(size.image_height, size.image_width),
        map_size=config.map_size,
        gt_pool=config.gt_pool,
        categories=config.categories,
        progress=progress,
    )
    train, val = read("train"), read("val", limit=config.validation_shapes)
    return _train(train, val, out, config, data_name=str(data), progress=progress)


def _train(
    train: LoadedSplit, val: LoadedSplit, out: Path, config: FitConfig, *, data_name: str, progress: bool
) -> bool:
    wanted_views = max(stage.views for stage in config.stages)
    if train.views < wanted_views:
        raise UserError(
            f"the data have {train.views} views per shape, the configuration asks for {wanted_views}"
        )
    training = Training(config, train)
    newest = latest_checkpoint(out)
    if newest is not None:
        training.restore(load_checkpoint(newest, training.model), where=newest)
    write_text(out / "config.json", to_json(config, data=data_name))
    log = RunLog(out, step=training.total_steps)
    try:
        with StopRequest() as stop:
            while training.stage_index < len(config.stages):
                if not _run_stage(training, train, val, out, log, stop, progress=progress):
                    return False
                if training.stage_index + 1 == len(config.stages):
                    break
                training.begin_stage(training.stage_index + 1, load_generator(best_weights(out, 1)))
    finally:
        log.close()
    return True


def _run_stage(
    training: Training,
    train: LoadedSplit,
    val: LoadedSplit,
    out: Path,
    log: RunLog,
    stop: StopRequest,
    *,
    progress: bool,
) -> bool:
    """Runs the current stage to its end; False if a signal ended it early."""
    config, stage, number = training.config, training.stage, training.stage_index + 1
    health_images = _health_images(val)
    bar = tqdm(
        total=stage.steps, initial=training.step, desc=f"stage {number}", unit="step", disable=not progress
    )
    clock = _Clock()
    shown: dict[str, str] = {}
    with bar:
        while training.step < stage.steps:
            with clock.waiting_for_data():
                batch = train.batch(*training.sampler.draw(stage.shapes, stage.views))
                codes = training.draw_codes(batch)
            report = training_step(
                training.model, training.optimiser, batch, codes, stage, step=training.step
            )
            training.step += 1
            training.total_steps += 1
            bar.update()

            last = training.step == stage.steps
            record: dict[str, Any] = {}
            if last or training.step % config.health_every == 0:
                record |= training.check_health(health_images)
            if last or training.step % config.validate_every == 0:
                record |= training.validate_and_keep_best(val, out)
            if record or training.step % config.log_every == 0:
                values = {name: value.item() for name, value in report._asdict().items()}
                record = {"stage": number, **values, **clock.read(), **record}
                record["diversity_weight"] = stage.diversity_weight(training.step - 1)
                record["learning_rate"] = stage.learning_rate_at(training.step - 1)
                log.write(training.total_steps, record)
                shown |= _bar_values(record)
                bar.set_postfix(shown, refresh=False)
            if last or stop.requested or training.step % config.checkpoint_every == 0:
                save_checkpoint(out, training.total_steps, training.model, training.state())
            if stop.requested:
                return False
    return True


class _Clock:
    """Seconds per step, and the share of them spent waiting for data, since the last reading."""

    def __init__(self) -> None:
        self._start, self._waited, self._steps = time.perf_counter(), 0.0, 0

    def waiting_for_data(self) -> _Clock:
        return self

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._waited += time.perf_counter() - self._began
        self._steps += 1

    def read(self) -> dict[str, float]:
        elapsed = time.perf_counter() - self._start
        values = {
            "seconds_per_step": elapsed / max(1, self._steps),
            "data_wait_share": self._waited / elapsed,
        }
        self._start, self._waited, self._steps = time.perf_counter(), 0.0, 0
        return values


def _bar_values(record: dict[str, Any]) -> dict[str, str]:
    names = {"front": "front", "diversity": "div", "image_sensitivity": "image", "code_sensitivity": "code"}
    shown = {short: f"{record[name]:.2f}" for name, short in names.items() if name in record}
    return shown | {"wait": f"{record['data_wait_share']:.0%}"}


def _check_finite(clouds: Tensor, step: int) -> None:
    if not clouds.detach().isfinite().all():
        raise UserError(
            f"stopped at step {step} of the stage: predictions are no longer finite; lower the learning rate"
        )


def _health_images(val: LoadedSplit) -> Tensor:
    """Up to 12 images, of as many shapes as there are."""
    count = min(_HEALTH_IMAGES, len(val) * val.views)
    numbers = torch.arange(count)
    shapes = numbers % len(val)
    views = (numbers // len(val) + shapes) % val.views
    return val.float_images(shapes, views[:, None])[:, 0]


def _check_run_directory(out: Path, config: FitConfig, *, resume: bool) -> None:
    saved = out / "config.json"
    if resume and not saved.exists():
        raise UserError(f"{out} holds no run to resume (no config.json); leave --resume out to start one")
    if not resume and saved.exists():
        raise UserError(f"{out} already holds a run; add --resume to continue it, or choose another --out")
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; --out names the run's directory")
    if resume:
        before = fit_config_from_json(saved.read_text(), where=str(saved))
        changed = [
            f.name for f in dataclasses.fields(config) if getattr(config, f.name) != getattr(before, f.name)
        ]
        if changed:
            raise UserError(
                f"{out} was started with other values of {', '.join(changed)}; resume it with the same ones"
            )
