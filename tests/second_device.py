"""A second device for a machine without a GPU: its tensors say that they are elsewhere, and compute on the CPU.

As on a GPU, an operation on tensors of both devices is an error, single numbers aside, and values reach the program
only by a copy. What runs here runs on any device, with the results of the CPU, unless it names CUDA itself.

    python tests/second_device.py DATA RUN     # all checks; prints the name of each, and its error if there is one

`test_device.py` starts it, in a process of its own: a device of Python's is registered for good.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

aten = torch.ops.aten


class _Backend(backend_registration._DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


backend_registration._setup_privateuseone_for_python_backend("elsewhere", backend_module=_Backend())
SECOND = torch.device("elsewhere:0")

_COPIES = {aten.copy_.default, aten._to_copy.default}
# Torch takes indices from the CPU, and waits for the device to have them.
_INDEXING = {
    aten.index.Tensor,
    aten.index_put_.default,
    aten.index_put.default,
    aten._index_put_impl_.default,
}
_NOT_EVEN_NUMBERS = {aten.cat.default, aten.stack.default}
_WAITING = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default}

WAITED: Counter[str] = Counter()
"""Files of this repository that waited for a value of the device -> how often."""


class Elsewhere(Tensor):
    """A tensor on the second device."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        made = Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype,
            device=SECOND,
        )  # fmt: skip
        made.here = here
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class Machine(TorchDispatchMode):
    """Inside, the second device can be used."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
    elsewhere = any(isinstance(value, Elsewhere) for value in tensors)
    if elsewhere and func not in _COPIES:
        numbers = 0 if func not in _NOT_EVEN_NUMBERS else -1
        here = [value for value in tensors if not isinstance(value, Elsewhere) and value.dim() > numbers]
        if here and func in _INDEXING and isinstance(args[0], Elsewhere):
            _note_wait()
        elif here:
            raise RuntimeError(f"{func}: expected all tensors to be on the same device")
    stays = elsewhere
    if (device := kwargs.get("device")) is not None:
        stays = torch.device(device).type == SECOND.type
        kwargs = kwargs | {"device": torch.device("cpu")}
    pinned = func is aten._pin_memory.default
    if func is aten.is_pinned.default:
        return False
    if func in _WAITING and elsewhere:
        _note_wait()
    if func is aten._to_copy.default and elsewhere != stays and not kwargs.get("non_blocking"):
        _note_wait()
    here_args, here_kwargs = tree_map_only(Elsewhere, lambda value: value.here, (args, kwargs))
    found = here_args[0].clone() if pinned else func(*here_args, **here_kwargs)
    if not stays:
        return found
    found = tree_map_only(Tensor, lambda v: v if isinstance(v, Elsewhere) else Elsewhere(v), found)
    return return_and_correct_aliasing(func, args, kwargs, found) if elsewhere else found


def _note_wait() -> None:
    root = str(Path(__file__).parents[1])
    for frame in reversed(traceback.extract_stack()):
        if (
            frame.filename.startswith(root)
            and frame.filename != __file__
            and "site-packages" not in frame.filename
        ):
            WAITED[f"{Path(frame.filename).relative_to(root)}:{frame.lineno} {frame.line}"] += 1
            return


# --- what is computed on both devices

import diffpoint  # noqa: E402
from diffpoint import io  # noqa: E402
from models import build_generator  # noqa: E402
from train.config import FitConfig, with_steps  # noqa: E402
from train.data.batches import LoadedSplit, load_split  # noqa: E402
from train.device import CPU, World  # noqa: E402
from train.errors import UserError  # noqa: E402
from train.evaluation.evaluate import evaluate  # noqa: E402
from train.evaluation.explore import explore  # noqa: E402
from train.evaluation.inference import predict, reconstruct  # noqa: E402
from train.evaluation.runs import load_autoencoder, load_generator, open_run, read_metrics  # noqa: E402
from train.methods import METHODS, get_method, recipe  # noqa: E402
from train.methods.base import Step, check_finite  # noqa: E402
from train.methods.weights import weights_digest  # noqa: E402
from train.training.trainer import Trainer, fit  # noqa: E402
from train.training.validation import validate, validate_autoencoder  # noqa: E402

_Check = Callable[[Path, Path], None]
CHECKS: dict[str, _Check] = {}


def check(function: _Check) -> _Check:
    CHECKS[function.__name__] = function
    return function


def close(a: Any, b: Any, *, tolerance: float = 1e-5) -> None:
    """Nested results of both devices; those of the second one may have stayed there."""
    a, b = tree_map_only(Tensor, lambda value: value.detach().cpu(), (a, b))
    torch.testing.assert_close(a, b, atol=tolerance, rtol=tolerance, equal_nan=True)


def _split(data: Path, name: Any, system: str = "ours") -> LoadedSplit:
    config = recipe(system, "smoke")
    size = get_method(system).image_size(config)
    return load_split(data, name, image_size=size, map_size=config.map_size, progress=False)


def _trained(
    data: Path, run: Path, config: FitConfig, device: torch.device, *, room: float
) -> dict[str, Any]:
    """The first step of each phase from fresh weights, its report and gradients; a second one is taken, too.

    Later steps are not compared: gradients are summed in another order, and Adam makes steps of their rounding.
    """
    split = _split(data, "train", config.system).to(device, room=room)
    found: dict[str, Any] = {}
    for phase in config.phases:
        trainer = Trainer(config, split, World(device))
        trainer.enter_phase(phase)
        if phase == "stage1" and config.needs_autoencoder:
            trainer._load_autoencoder(run)
        get_method(config.system).begin_phase(trainer.state, phase)
        trainer.step = 6  # within the ramp of the diversity loss
        network = trainer.trained_network
        found[f"{phase} report"] = trainer.train_step()
        gradients = [p.grad.flatten() for p in network.parameters() if p.grad is not None]
        found[f"{phase} gradients"] = torch.cat(gradients) / torch.cat(gradients).norm()
        assert trainer.train_step()["loss"].isfinite().item()
        assert {p.device for p in (*network.parameters(), *network.buffers())} == {device}
        found[f"{phase} random"] = [trainer.state_dict()[name] for name in ("random", "torch")]
    return found


def _same_steps(data: Path, run: Path, config: FitConfig, *, room: float = float("inf")) -> None:
    wanted = _trained(data, run, config, CPU, room=room)
    close(_trained(data, run, config, SECOND, room=room), wanted, tolerance=1e-4)


_WHOLE = recipe("ours", "smoke", "whole-shapes")


@check
def paper_recipe_and_critic(data: Path, run: Path) -> None:
    _same_steps(data, run, recipe("ours", "smoke"))


@check
def whole_shapes(data: Path, run: Path) -> None:
    _same_steps(data, run, _WHOLE)


@check
def views_that_stay_on_the_cpu(data: Path, run: Path) -> None:
    split = _split(data, "train")
    assert not isinstance(split.to(SECOND, room=0).images, Tensor)
    assert isinstance(split.to(SECOND).images, Tensor)
    _same_steps(data, run, _WHOLE, room=0)


@check
def other_supervision(data: Path, run: Path) -> None:
    for supervision in ("projection", "lin", "soft"):
        stage1 = dataclasses.replace(_WHOLE.stage1, supervision=supervision, shape_distance="both")
        stage2 = dataclasses.replace(_WHOLE.stage2, steps=0)
        _same_steps(data, run, dataclasses.replace(_WHOLE, stage1=stage1, stage2=stage2))


@check
def latent_head_and_horizon(data: Path, run: Path) -> None:
    config = recipe("ours", "smoke")
    stage1 = dataclasses.replace(config.stage1, visibility="horizon", real_pool=1, n_critic=2)
    _same_steps(data, run, dataclasses.replace(config, output_head="latent", stage1=stage1))


@check
def all_methods(data: Path, run: Path) -> None:
    for system in METHODS:
        if system != "ours":
            _same_steps(data, run, recipe(system, "smoke"))


@check
def a_step_waits_for_nothing_but_the_layer(data: Path, run: Path) -> None:
    """Checks of arguments in `diffpoint` wait; the training step around them does not."""
    for config in (_WHOLE, recipe("ours", "smoke")):
        trainer = Trainer(config, _split(data, "train").to(SECOND), World(SECOND))
        for phase in config.phases:
            trainer.enter_phase(phase)
            trainer.step = 6
            trainer.train_step()
            WAITED.clear()
            trainer.train_step()
            waited = {where: count for where, count in WAITED.items() if not where.startswith("diffpoint/")}
            assert not waited, waited


@check
def a_loss_that_is_not_finite_ends_the_training_before_anything_is_kept(data: Path, run: Path) -> None:
    """Found by the layer, whose error names an argument of its own; or by nobody until the next record."""
    config = dataclasses.replace(with_steps(_WHOLE, 40), checkpoint_every=20, log_every=20, picture_every=0)
    taken = Trainer.train_step

    def with_nan(trainer: Trainer) -> None:
        with torch.no_grad():
            next(trainer.state.network.parameters()).fill_(torch.nan)

    def with_open_check(trainer: Trainer) -> None:
        loss = torch.full((), torch.inf, device=SECOND)
        check_finite(loss, "the loss is", Step(trainer.phase, trainer.step, checks=trainer.checks))

    for spoil, what in ((with_nan, "predictions are"), (with_open_check, "the loss is")):

        def spoilt(trainer: Trainer, spoil: Callable[[Trainer], None] = spoil) -> dict[str, Tensor]:
            if trainer.total_steps == 13:
                spoil(trainer)
            return taken(trainer)

        Trainer.train_step = spoilt  # type: ignore[method-assign]
        with tempfile.TemporaryDirectory() as folder:
            try:
                fit(data, Path(folder) / "run", config, progress=False, device=SECOND)
            except UserError as error:
                assert f"stopped at step 13 of the stage: {what} no longer finite" in str(error), error
            else:
                raise AssertionError("it went on")
            finally:
                Trainer.train_step = taken  # type: ignore[method-assign]
            assert [record["step"] for record in read_metrics(Path(folder) / "run")] == [10]
            assert not list((Path(folder) / "run" / "checkpoints").glob("step-*"))


@check
def a_run_begun_on_one_device_goes_on_on_another(data: Path, run: Path) -> None:
    """`fit` with everything that it does on the way, and checkpoints for any device."""
    config = dataclasses.replace(
        with_steps(recipe("ours", "smoke"), 6), checkpoint_every=3, validate_every=3, collapse_check_every=3,
        picture_every=3,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        taken = Trainer.train_step
        for begun, continued in ((CPU, SECOND), (SECOND, CPU)):
            out = Path(folder) / begun.type

            def killed(trainer: Trainer) -> dict[str, Tensor]:
                if trainer.total_steps == 16:  # within stage 2
                    raise InterruptedError
                return taken(trainer)

            Trainer.train_step = killed  # type: ignore[method-assign]
            try:
                fit(data, out, config, progress=False, device=begun)
            except InterruptedError:
                pass
            finally:
                Trainer.train_step = taken  # type: ignore[method-assign]
            assert fit(data, out, config, resume=True, progress=False, device=continued)
        apart = [read_metrics(Path(folder) / device.type) for device in (CPU, SECOND)]
        assert len(apart[0]) == 18
        names = ("step", "loss", "front", "val_cd", "val_fps_cd", "image_sensitivity")
        chosen = [[{k: v for k, v in r.items() if k in names} for r in records] for records in apart]
        close(*chosen, tolerance=5e-2)  # 18 steps, see `_trained`
        assert weights_digest(load_generator(out, device="elsewhere:0")) == weights_digest(
            load_generator(out)
        )


@check
def inference(data: Path, run: Path) -> None:
    here, there = (open_run(run, device=device).model for device in (CPU, SECOND))
    images = _split(data, "test").float_images(torch.arange(2), torch.arange(3).expand(2, -1))
    config = recipe("ours", "smoke").inference
    for views, settings in (
        (3, config),
        (
            3,
            dataclasses.replace(config, patience=1, keep_best=True, keep_norm=True, prior=0.1, min_drop=0.01),
        ),
        (1, dataclasses.replace(config, medoid=True, groups=4)),
        (1, config),
    ):
        wanted = reconstruct(here, images[:, :views], settings=settings)
        found = reconstruct(there, images[:, :views], settings=settings)
        assert {value.device for value in found} == {CPU}
        close(found, wanted, tolerance=1e-4)
    close(predict(there, images[0, 0], 3, seed=1), predict(here, images[0, 0], 3, seed=1))
    codes = torch.zeros(2, here.code_dim)
    planes = [explore(model, images[0, :2], codes, progress=False) for model in (there, here)]
    close(*([each._asdict() for each in of] for of in planes), tolerance=1e-4)


@check
def evaluation(data: Path, run: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        both = [
            evaluate(
                run, data, seeds=(0, 1), views=(1, 2), out=Path(folder) / "evaluation.json", progress=False,
                device=device,
            )
            for device in (SECOND, CPU)
        ]  # fmt: skip
    assert json.dumps(both[0]).count("NaN") == 0
    apart = [{k: v for k, v in each.items() if k not in ("config", "data", "profile")} for each in both]
    close(*apart, tolerance=1e-3)
    assert both[0]["data"] == both[1]["data"]


@check
def validation(data: Path, run: Path) -> None:
    """Also where the split is on the other device."""
    val = _split(data, "val")
    here, there = (open_run(run, device=device).model for device in (CPU, SECOND))
    close(validate(there, val, seed=0), validate(here, val, seed=0), tolerance=1e-4)
    autoencoder = load_autoencoder(run)
    wanted = validate_autoencoder(autoencoder, val, seed=0)
    close(validate_autoencoder(autoencoder.to(SECOND), val, seed=0), wanted, tolerance=1e-4)


@check
def tf32(data: Path, run: Path) -> None:
    """The network alone: the last layers, and what leaves it, are float32, and the switches are put back."""
    model = build_generator("smoke").to(SECOND)
    images, codes = torch.rand(2, 3, 48, 64).to(SECOND), torch.randn(2, 2, model.code_dim).to(SECOND)
    seen: list[tuple[bool, bool]] = []
    switches = torch.backends.cuda.matmul, torch.backends.cudnn
    for layer in (model.trunk[0], model.decoder.down4[0], model.decoder.fc_points, model.decoder.conv_points):
        layer.register_forward_hook(lambda *_: seen.append(tuple(s.allow_tf32 for s in switches)))
    before = [switch.allow_tf32 for switch in switches]
    model.tf32 = True
    assert model(images, codes).dtype == torch.float32
    assert seen == [(True, True)] * 2 + [(False, False)] * 2
    assert [switch.allow_tf32 for switch in switches] == before
    seen.clear()
    model.tf32 = False
    model(images, codes)
    assert seen == [(False, False)] * 4


@check
def files(data: Path, run: Path) -> None:
    points, depth = torch.rand(5, 3), torch.rand(4, 6)
    with tempfile.TemporaryDirectory() as folder:
        io.write_points(Path(folder, "a.ply"), points.to(SECOND))
        close(io.read_points(Path(folder, "a.ply")), points)
        io.write_depth(Path(folder, "a.png"), depth.to(SECOND))
        close(io.read_depth(Path(folder, "a.png")), depth, tolerance=1e-4)


def main(data: Path, run: Path, *names: str) -> None:
    diffpoint.configure(threads=1)
    torch.set_num_threads(1)
    results: dict[str, str] = {}
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device=...) makes a copy that a mode sees
    with Machine():
        for name in names or CHECKS:
            try:
                CHECKS[name](data, run)
                results[name] = ""
            except Exception:
                found = traceback.format_exc().splitlines()
                at = max(i for i, line in enumerate(found) if line.startswith("  File "))
                results[name] = "\n".join(found[max(0, at - 12) : at + 8])
            print(name, results[name] or "holds", file=sys.stderr, flush=True)
    print(json.dumps(results))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]), *sys.argv[3:])
