"""Training: one loop and one step for all methods and phases, whose differences are data.

`fit` is what the command line calls. `Trainer` holds what changes during a run and takes the steps; the loss of a step
is the method's (train/methods).
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from models import allow_tf32, widen
from train.config import FitConfig, PretrainConfig, StageConfig, fit_config_from_json, to_json
from train.data.augment import augment
from train.data.batches import Batch, LoadedSplit, Sampler
from train.data.layouts import require_depth
from train.device import CPU, SINGLE, World, connect, describe, moved
from train.errors import UserError
from train.evaluation.runs import (
    best_weights,
    latest_checkpoint,
    load_autoencoder,
    load_predictor,
    read_split,
)
from train.files import as_paths, write_text
from train.methods import get_method
from train.methods.base import Checks, Noise, Step, check_finite
from train.methods.optimisers import adam, set_learning_rate
from train.methods.weights import save_weights
from train.processes import StopRequest, progress_bar
from train.timer import Timer
from train.training.checkpoint import load_networks, load_state, save_checkpoint
from train.training.collapse import CollapseCheck
from train.training.log import RunLog
from train.training.pictures import draw_predictions
from train.training.validation import validate, validate_autoencoder

_COLLAPSE_CHECK_IMAGES = 12
# The number of each phase in the records of the log.
STAGES = {"autoencoder": 0, "stage1": 1, "stage2": 2}


def fit(
    data: str | Path | Sequence[str | Path],
    out: str | Path,
    config: FitConfig,
    *,
    resume: bool = False,
    progress: bool = True,
    device: torch.device = CPU,
) -> bool:
    """Trains a network and keeps everything about it in the run directory `out`.

    Args:
        data: root of a data tree with train and val splits, or of each of several that are put together.
        out: the run's directory; must not hold a run yet, unless resuming.
        config: the recipe.
        resume: continue the run in `out` from its newest checkpoint, to the same bits.
        progress: show bars, and say where the time went.
        device: on which the networks are trained; in a group of processes, each has its own. A checkpoint can be
            continued on another one, though not to the same bits.

    Returns:
        True when training is complete, False when a signal (Ctrl-C, SIGTERM) ended it early, after saving.

    Raises:
        UserError: unusable data or run, a configuration that does not fit them, or a training that has failed.
    """
    roots, out = as_paths(data), Path(out)
    world = connect(device)
    progress = progress and world.is_main
    _check_run_directory(out, config, resume=resume)
    method = get_method(config.system)
    method.check(config)
    if config.augmentation < 0:
        raise UserError(f"--augmentation must be at least 0; got {config.augmentation}")
    if not 0 <= config.framing <= 1:
        raise UserError(f"--framing is a share of the images, from 0 to 1; got {config.framing}")
    _check_precision(config, world.device)
    require_depth(roots)
    image_size = method.image_size(config)
    train = read_split(config, roots, "train", image_size=image_size, progress=progress)
    val = read_split(
        config, roots, "val", image_size=image_size, limit=config.validation_shapes, progress=progress
    )
    _check_fits(config, train, world)
    if world.device != CPU:
        train, val = train.to(world.device), val.to(world.device)
        if progress:
            where = (
                "on the GPU"
                if isinstance(train.images, Tensor)
                else "on the CPU, for lack of memory on the GPU"
            )
            print(f"training on {describe(world.device)}; the training images are {where}", file=sys.stderr)
    world.barrier()  # all have looked at the directory before one writes into it
    newest = latest_checkpoint(out)
    # A checkpoint has weights of its own; those that the run started from may be gone.
    trainer = Trainer(config if newest is None else dataclasses.replace(config, start=None), train, world)
    if newest is not None:
        trainer.resume(out, newest)
    else:
        if config.autoencoder and config.needs_autoencoder and world.is_main:
            save_weights(load_autoencoder(config.autoencoder), best_weights(out, "autoencoder"))
        trainer.begin_phase(trainer.phase_name, out)
    if world.is_main:
        write_text(out / "config.json", to_json(config, data=data))
    log = RunLog(out, step=trainer.total_steps, writes=world.is_main)
    try:
        with StopRequest() as stop:
            run = _Run(out, val, _collapse_check_images(val), log, stop, progress)
            names = list(config.phases)
            for name in names[names.index(trainer.phase_name) :]:
                if name != trainer.phase_name:
                    trainer.begin_phase(name, out)
                if not _run_phase(trainer, run):
                    return False
            return True
    finally:
        log.close()


class _Run(NamedTuple):
    """What stays the same during a run."""

    out: Path
    val: LoadedSplit
    collapse_check_images: Tensor
    log: RunLog
    stop: StopRequest
    progress: bool


def _run_phase(trainer: Trainer, run: _Run) -> bool:
    """Runs the current phase to its end; False if a signal ended it early."""
    config, timer, world = trainer.config, trainer.timer, trainer.world
    shown: dict[str, str] = {}

    drawn = config.picture_every > 0 and not trainer.pretraining
    periods = [config.collapse_check_every, config.validate_every, config.log_every, config.checkpoint_every]
    periods += [config.picture_every] if drawn else []

    def due(every: int) -> bool:
        return trainer.done or trainer.step % every == 0

    with progress_bar(
        title=trainer.phase_name,
        unit="step",
        total=trainer.phase.steps,
        initial=trainer.step,
        progress=run.progress,
    ) as bar:
        timer.reset()
        while not trainer.done:
            report = trainer.train_step()
            bar.update()
            stop = world.any(run.stop.requested)
            if stop or any(map(due, periods)):
                trainer.checks.settle()  # before anything is written

            record: dict[str, Any] = {}
            if due(config.collapse_check_every):
                record |= trainer.check_collapse(run.collapse_check_images)
            if due(config.validate_every):
                record |= trainer.validate_and_keep_best(run.val, run.out)
            if record or due(config.log_every):
                record = {"stage": STAGES[trainer.phase_name], **_means(report, world), **record}
                record |= trainer.schedule() | timer.read()
                run.log.write(trainer.total_steps, record)
                shown |= _bar_values(record)
                bar.set_postfix(shown, refresh=False)
            if world.is_main and drawn and due(config.picture_every):
                picture = run.out / "figures" / f"predictions-{trainer.total_steps:08d}.png"
                draw_predictions(trainer.state.network, run.val, picture, seed=config.seed)
            if world.is_main and (stop or due(config.checkpoint_every)):
                save_checkpoint(
                    run.out,
                    trainer.total_steps,
                    trainer.networks(),
                    trainer.state_dict(),
                    keep=config.keep_checkpoints,
                )
            timer.skip()
            if stop:
                return False
    if run.progress:
        print(f"{trainer.phase_name}: {timer.summary()}", file=sys.stderr)
    return True


class Trainer:
    """Everything that changes during a run and can be saved and restored, and the step that changes it.

    Args:
        config: the recipe.
        train: the training split.
        world: the processes that share each batch. All draw the same random numbers and take their shard.
    """

    def __init__(self, config: FitConfig, train: LoadedSplit, world: World = SINGLE) -> None:
        torch.manual_seed(config.seed)
        self.config, self.method = config, get_method(config.system)
        self.world, self.timer, self.checks = world, Timer(world.device), Checks()
        self.total_steps = 0
        self._train = train
        self._sampler = Sampler(len(train), train.views, seed=config.seed)
        self._random = torch.Generator().manual_seed(config.seed)
        self.method.check(config)
        self.state = self.method.new_state(config, self.device)
        if config.start:
            self._load_weights(Path(config.start))
        self.enter_phase(next(iter(config.phases)))

    @property
    def device(self) -> torch.device:
        """Of networks and batches. Random numbers are drawn on the CPU, so that they are the same on every device."""
        return self.world.device

    @property
    def phase(self) -> PretrainConfig | StageConfig:
        """Settings of the current phase."""
        return self.config.phases[self.phase_name]

    @property
    def pretraining(self) -> bool:
        """Does the current phase train the auto-encoder?"""
        return isinstance(self.phase, PretrainConfig)

    @property
    def trained_network(self) -> nn.Module:
        """The network that the current phase trains."""
        network = self.state.autoencoder if self.pretraining else self.state.network
        assert network is not None
        return network

    @property
    def done(self) -> bool:
        """Has the current phase made its steps?"""
        return self.step >= self.phase.steps

    def train_step(self) -> dict[str, Tensor]:
        """One step of the current phase: draw a batch, compute the method's loss, descend.

        Returns:
            Scalars without gradient, for the log.
        """
        state, timer, phase = self.state, self.timer, self.phase
        batch, noise = self.draw_batch()
        timer.mark("data")

        set_learning_rate(state.optimiser, phase.learning_rate_at(self.step))
        step = Step(phase, self.step, timer, self.world, self.checks)
        try:
            terms = self.method.losses[self.phase_name](state, batch, noise, step)
        except ValueError:
            # The layer refuses numbers that are not finite, perhaps before an open check has said so.
            self.checks.settle()
            raise
        check_finite(terms["loss"], "the loss is", step)
        timer.mark("loss")

        state.optimiser.zero_grad(set_to_none=True)
        with allow_tf32(self.config.precision == "tf32" and not self.pretraining):
            terms["loss"].backward()
        self.world.average_gradients(self.trained_network)
        state.optimiser.step()
        timer.mark("network")

        timer.end_step()
        self.step += 1
        self.total_steps += 1
        return {name: value.detach() for name, value in terms.items()}

    def draw_batch(self) -> tuple[Batch | Tensor, Noise]:
        """Draws the next batch of the current phase: this process's shard, and the random numbers that belong to it."""
        phase, shard = self.phase, self.world.shard
        if isinstance(phase, PretrainConfig):
            return self._draw_clouds(phase.shapes), Noise(torch.empty(0), torch.empty(0))
        shapes, views = self._sampler.draw(phase.shapes, phase.views)
        batch = self._train.batch(shard(shapes), shard(views))
        images = phase.shapes * phase.views
        codes = torch.randn(phase.codes, images, self.state.network.code_dim, generator=self._random)
        mix = torch.empty(0)
        if phase.gamma > 0:
            mix = torch.rand(phase.n_critic, phase.codes, images, generator=self._random)
            real = [self._clouds(shapes), *(self._draw_clouds(phase.shapes) for _ in range(phase.real_pool))]
            batch = batch._replace(real=shard(torch.stack(real), 1))
        strength, framing = self.config.augmentation, self.config.framing
        if strength > 0 or framing > 0:
            seeds = shard(torch.randint(2**62, (images,), generator=self._random))
            changed = augment(batch.images.flatten(0, 1), strength, seeds, framing=framing)
            batch = batch._replace(images=changed.view(batch.images.shape))
        if self.method.needs_targets(phase):
            batch = batch._replace(targets=self._train.targets(shard(shapes)))
        return batch, Noise(moved(shard(codes, 1), self.device), moved(shard(mix, -1), self.device))

    def _draw_clouds(self, shapes: int) -> Tensor:
        return self._clouds(self._sampler.draw(shapes, 1)[0])

    def _clouds(self, shapes: Tensor) -> Tensor:
        """(B,) shape numbers -> (B, N, 3) ground truth, N as many as a reconstruction has if there are as many."""
        assert self.state.autoencoder is not None
        known = self._train.points.shape[1]
        wanted = min(known, self.state.autoencoder.config.points)
        return self._train.clouds(shapes, self._sampler.draw_points(len(shapes), wanted, of=known))

    # --- phases

    def begin_phase(self, name: str, run: Path) -> None:
        """Starts a phase from the best weights of the phases before, with a new optimiser; the critic goes on."""
        self.world.barrier()  # until the main process has written those weights
        self.enter_phase(name)
        if name == "stage1" and self.config.needs_autoencoder:
            self._load_autoencoder(run)
        if name == "stage2" and "stage1" in self.config.phases:
            self._load_weights(best_weights(run, 1))
        self.method.begin_phase(self.state, name)

    def enter_phase(self, name: str) -> None:
        """Starts a phase with the weights as they are, and a new optimiser."""
        self.phase_name, self.step, self.best = name, 0, math.inf
        self.collapse_check = CollapseCheck(self.config)
        state, phase = self.state, self.phase
        if isinstance(phase, StageConfig):
            if state.autoencoder is not None:
                state.autoencoder.freeze()
            state.optimiser = self.method.optimiser(state.network.train(), phase)
        else:
            state.optimiser = adam(self.trained_network.train().requires_grad_(True))

    def _load_weights(self, run_or_file: Path) -> None:
        """Takes the weights of a network that differs at most in having a narrower decoder."""
        found, network = load_predictor(run_or_file), self.state.network
        theirs, ours = vars(found.config), vars(network.config)
        apart = [name for name in ours if theirs.get(name) != ours[name]]
        try:
            if type(found) is not type(network) or set(apart) - {"decoder_width"}:
                raise ValueError("other networks")
            widen(network, found)
        except ValueError:
            described = "; ".join(f"{name} {theirs.get(name)} there, {ours[name]} here" for name in apart)
            raise UserError(
                f"{run_or_file} holds the weights of another network than the one to be trained ("
                f"{described or 'another --system'}); start from one of the same kind, whose decoder may be "
                "narrower, or set --system, --profile, --decoder-width, --points-per-cell, --group-norm, "
                "--output-head and --deterministic as there"
            ) from None

    def _load_autoencoder(self, run: Path) -> None:
        found = load_autoencoder(best_weights(run, "autoencoder"))
        wanted = self.state.network.points
        if self.config.output_head == "latent" and found.config.points != wanted:
            raise UserError(
                f"the auto-encoder makes {found.config.points} points, the generator with output head 'latent' "
                f"{wanted}; train one of this profile, or leave --autoencoder out"
            )
        self.state.autoencoder = found.to(self.device)

    # --- what is measured on the way

    def schedule(self) -> dict[str, float]:
        """What the phase's schedules gave for the step that was just taken."""
        phase, step = self.phase, self.step - 1
        weight = {"diversity_weight": phase.diversity_weight(step)} if isinstance(phase, StageConfig) else {}
        return {"learning_rate": phase.learning_rate_at(step), **weight}

    def check_collapse(self, images: Tensor) -> dict[str, float]:
        """Measures what image and code do; ends a run whose network ignores its image."""
        if self.pretraining:
            return {}
        may_fail = self.phase_name != "stage1" or self.step >= self.config.collapse_patience
        return self.collapse_check(
            self.state.network, images, may_fail=may_fail, total_steps=self.total_steps
        )

    def validate_and_keep_best(self, val: LoadedSplit, run: Path) -> dict[str, float]:
        """Validates, and saves the weights if they are the phase's best so far, or if the last ones are wanted."""
        phase, seed = self.phase, self.config.seed
        if isinstance(phase, PretrainConfig):
            assert self.state.autoencoder is not None
            select, figures = "autoencoder_cd", validate_autoencoder(self.state.autoencoder, val, seed=seed)
        else:
            select, figures = phase.select, validate(self.state.network, val, seed=seed, world=self.world)
        if select == "last" or figures[f"val_{select}"] < self.best:
            self.best = figures.get(f"val_{select}", self.best)
            if self.world.is_main:
                save_weights(self.trained_network, best_weights(run, self.phase_name))
        return figures

    # --- checkpoints

    def networks(self) -> dict[str, nn.Module]:
        """The networks in a checkpoint of the current phase, by the names of their files."""
        if self.pretraining:
            return {"autoencoder": self.trained_network}
        critic = {} if self.state.critic is None else {"critic": self.state.critic}
        return {"weights": self.state.network, **critic}

    def state_dict(self) -> dict[str, Any]:
        """Everything but the weights that decides how training continues."""
        critic_optimiser = self.state.critic_optimiser
        return {
            "phase": self.phase_name,
            "step": self.step,
            "total_steps": self.total_steps,
            "best": self.best,
            "failed_collapse_checks": self.collapse_check.failed,
            "optimiser": self.state.optimiser.state_dict(),
            "critic_optimiser": None if critic_optimiser is None else critic_optimiser.state_dict(),
            "sampler": self._sampler.state(),
            "random": self._random.get_state(),
            "torch": torch.get_rng_state(),
            "fingerprint": self._train.fingerprint,
        }

    def resume(self, run: Path, checkpoint: Path) -> None:
        """Restores what `networks` and `state_dict` gave when a checkpoint of the run was written."""
        saved = load_state(checkpoint)
        if saved["fingerprint"] != self._train.fingerprint:
            raise UserError(
                f"{checkpoint} was trained on other data (their shapes or points differ); resume with those"
            )
        self.enter_phase(saved["phase"])
        if not self.pretraining and self.config.needs_autoencoder:
            self._load_autoencoder(run)
        load_networks(checkpoint, self.networks())
        self.step, self.total_steps, self.best = saved["step"], saved["total_steps"], saved["best"]
        # The second name is that of earlier versions.
        self.collapse_check.failed = saved.get("failed_collapse_checks", saved.get("deaf_checks", 0))
        self.state.optimiser.load_state_dict(saved["optimiser"])
        if self.state.critic_optimiser is not None:
            self.state.critic_optimiser.load_state_dict(saved["critic_optimiser"])
        self._sampler.restore(saved["sampler"])
        self._random.set_state(saved["random"])
        torch.set_rng_state(saved["torch"])


def _means(report: Mapping[str, Tensor], world: World) -> dict[str, float]:
    """A step's scalars, averaged over the processes."""
    return dict(zip(report, world.mean(torch.stack(list(report.values()))).cpu().tolist(), strict=True))


def _bar_values(record: Mapping[str, Any]) -> dict[str, str]:
    names = {
        "cd": "cd", "front": "front", "shape": "shape", "matched_share": "matched", "diversity": "div",
        "critic_loss": "critic", "image_sensitivity": "image", "code_sensitivity": "code",
    }  # fmt: skip
    shown = {short: f"{record[name]:.2f}" for name, short in names.items() if name in record}
    return shown | {"wait": f"{record['data_wait_share']:.0%}"}


def _collapse_check_images(val: LoadedSplit) -> Tensor:
    """Up to 12 images, of as many shapes as there are."""
    count = min(_COLLAPSE_CHECK_IMAGES, len(val) * val.views)
    numbers = torch.arange(count)
    shapes = numbers % len(val)
    views = (numbers // len(val) + shapes) % val.views
    return val.float_images(shapes, views[:, None])[:, 0]


def _check_precision(config: FitConfig, device: torch.device) -> None:
    if config.precision == "tf32" and device.type == "cpu":
        raise UserError("--precision tf32 is a format of NVIDIA GPUs; a CPU computes in float32 or bfloat16")
    if config.precision == "bfloat16" and device.type == "cuda" and not torch.cuda.is_bf16_supported(False):
        raise UserError(
            f"{describe(device)} does not compute in bfloat16 (GPUs since Ampere do); leave --precision at float32"
        )


def _check_fits(config: FitConfig, train: LoadedSplit, world: World) -> None:
    if not config.phases:
        raise UserError("nothing to train: every phase has 0 steps")
    if world.size > 1 and (reason := get_method(config.system).needs_whole_batch):
        raise UserError(f"--system {config.system} cannot run on several processes: {reason}")
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
