"""Training: one loop for the auto-encoder and both stages, whose differences are data.

What happens in a step is in train/step.py; what a run keeps, in train/state.py.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from train.config import FitConfig, fit_config_from_json, to_json
from train.data.batches import LoadedSplit
from train.data.tree import require_depth
from train.distributed import World, gather
from train.errors import UserError
from train.evaluation.runs import best_weights, latest_checkpoint, load_autoencoder, read_split
from train.files import write_text
from train.methods.systems import image_size
from train.methods.weights import save_weights
from train.processes import StopRequest
from train.training.checkpoint import save_checkpoint
from train.training.log import RunLog
from train.training.pictures import draw_predictions
from train.training.state import Training

_HEALTH_IMAGES = 12
# The number that records carry for a phase.
STAGES = {"autoencoder": 0, "stage1": 1, "stage2": 2}


class _Run(NamedTuple):
    """What stays the same while a run goes on."""

    out: Path
    train: LoadedSplit
    val: LoadedSplit
    health_images: Tensor
    log: RunLog
    stop: StopRequest
    world: World
    progress: bool


def fit(
    data: Path | Sequence[Path], out: Path, config: FitConfig, *, resume: bool = False, progress: bool = True
) -> bool:
    """Trains a generator and keeps everything about it in the run directory `out`.

    Args:
        data: root of a data tree with train and val splits, or of each of several that are put together.
        out: the run's directory; must not hold a run yet, unless resuming.
        config: the recipe.
        resume: continue the run in `out` from its newest checkpoint, to the same bits.
        progress: show bars, and say where the time went.

    Returns:
        True when training is complete, False when a signal (Ctrl-C, SIGTERM) ended it early, after saving.

    Raises:
        UserError: unusable data or run, a configuration that does not fit them, or a training that has failed.
    """
    world = gather()
    progress = progress and world.writes
    _check_run_directory(out, config, resume=resume)
    require_depth([data] if isinstance(data, Path) else data)
    read = functools.partial(read_split, config, data, image_size=image_size(config), progress=progress)
    train, val = read("train"), read("val", limit=config.validation_shapes)
    _check_fits(config, train, world)
    world.wait()  # all have looked at the directory before one writes into it
    newest = latest_checkpoint(out)
    # A checkpoint has weights of its own; those that the run started from may be gone.
    training = Training(config if newest is None else dataclasses.replace(config, start=None), train, world)
    if newest is not None:
        training.resume(out, newest)
    else:
        if config.autoencoder and config.needs_autoencoder and world.writes:
            save_weights(load_autoencoder(config.autoencoder), best_weights(out, "autoencoder"))
        training.begin_phase(training.phase_name, out)
    if world.writes:
        write_text(out / "config.json", to_json(config, data=data))
    log = RunLog(out, step=training.total_steps, writes=world.writes)
    try:
        with StopRequest() as stop:
            return _run(training, _Run(out, train, val, _health_images(val), log, stop, world, progress))
    finally:
        log.close()


def _run(training: Training, run: _Run) -> bool:
    """Runs all phases that are left; False if a signal ended one early."""
    names = list(training.config.phases)
    for name in names[names.index(training.phase_name) :]:
        if name != training.phase_name:
            training.begin_phase(name, run.out)
        if not _run_phase(training, run):
            return False
    return True


def _run_phase(training: Training, run: _Run) -> bool:
    """Runs the current phase to its end; False if a signal ended it early."""
    config, phase, laps, world = training.config, training.phase, training.laps, run.world
    shown: dict[str, str] = {}

    def due(every: int) -> bool:
        return training.done or training.step % every == 0

    with tqdm(
        total=phase.steps, initial=training.step, desc=training.phase_name, disable=not run.progress
    ) as bar:
        laps.begin()
        while not training.done:
            report = training.advance()
            bar.update()
            stop = world.any(run.stop.requested)

            record: dict[str, Any] = {}
            if due(config.health_every):
                record |= training.check_health(run.health_images)
            if due(config.validate_every):
                record |= training.validate_and_keep_best(run.val, run.out)
            if record or due(config.log_every):
                record = {"stage": STAGES[training.phase_name], **_means(report, world), **record}
                record |= training.schedule() | laps.read()
                run.log.write(training.total_steps, record)
                shown |= _bar_values(record)
                bar.set_postfix(shown, refresh=False)
            drawn = config.picture_every > 0 and training.phase_name != "autoencoder"
            if world.writes and drawn and due(config.picture_every):
                picture = run.out / "figures" / f"predictions-{training.total_steps:08d}.png"
                draw_predictions(training.learner.generator, run.val, picture, seed=config.seed)
            if world.writes and (stop or due(config.checkpoint_every)):
                save_checkpoint(
                    run.out,
                    training.total_steps,
                    training.networks(),
                    training.state(),
                    keep=config.keep_checkpoints,
                )
            laps.skip()
            if stop:
                return False
    if run.progress:
        print(f"{training.phase_name}: {laps.summary()}", file=sys.stderr)
    return True


def _means(report: Mapping[str, Tensor], world: World) -> dict[str, float]:
    """A step's scalars, averaged over the processes."""
    return dict(zip(report, world.mean(torch.stack(list(report.values()))).tolist(), strict=True))


def _bar_values(record: Mapping[str, Any]) -> dict[str, str]:
    names = {
        "cd": "cd", "front": "front", "matched_share": "matched", "diversity": "div", "critic_loss": "critic",
        "image_sensitivity": "image", "code_sensitivity": "code",
    }  # fmt: skip
    shown = {short: f"{record[name]:.2f}" for name, short in names.items() if name in record}
    return shown | {"wait": f"{record['data_wait_share']:.0%}"}


def _health_images(val: LoadedSplit) -> Tensor:
    """Up to 12 images, of as many shapes as there are."""
    count = min(_HEALTH_IMAGES, len(val) * val.views)
    numbers = torch.arange(count)
    shapes = numbers % len(val)
    views = (numbers // len(val) + shapes) % val.views
    return val.float_images(shapes, views[:, None])[:, 0]


def _check_fits(config: FitConfig, train: LoadedSplit, world: World) -> None:
    if not config.phases:
        raise UserError("nothing to train: every phase has 0 steps")
    if world.size > 1 and config.system == "lin":
        raise UserError("--system lin cannot be shared by processes: its batch norms need the whole batch")
    wanted_views = max(stage.views for stage in config.stages)
    if train.views < wanted_views:
        raise UserError(
            f"the data have {train.views} views per shape, the configuration asks for {wanted_views}"
        )
    for stage in config.stages:
        if stage.shapes % world.size:
            raise UserError(
                f"{world.size} processes cannot share {stage.shapes} shapes equally; change --stage1.shapes, "
                "--stage2.shapes or the number of processes"
            )


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
