"""What a run keeps: weights, and beside them the state from which training continues to the same bits.

    RUN/checkpoints/step-00000500/{weights,autoencoder,critic}.safetensors, state.pt   the newest, for --resume
    RUN/checkpoints/best-{autoencoder,stage1,stage2}.safetensors   each phase's, chosen on the validation split

A weights file carries the network's configuration in its header, so that it can be used on its own. The
generator's is called weights.safetensors.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from models import (
    Autoencoder,
    AutoencoderConfig,
    Critic,
    Generator,
    GeneratorConfig,
    Predictor,
    build_autoencoder,
    build_generator,
)
from models.baselines import (
    LinConfig,
    PTNConfig,
    R2N2Config,
    RecurrentReconstruction,
    SilhouetteReconstruction,
    StructureGenerator,
    build_lin,
    build_ptn,
    build_r2n2,
)
from train.config import PROFILES, FitConfig, fit_config_from_json
from train.errors import UserError
from train.files import remove, replacing
from train.recipes import with_system
from train.systems import system_of

_Network = TypeVar("_Network", bound=nn.Module)


class OtherVersionError(UserError):
    """Sound weights, of a network that this version of diffpoint builds otherwise."""


# Under which name a file's header keeps a network's configuration, and how the network is made from it.
_KINDS = {
    Generator: ("diffpoint.generator", lambda c: build_generator(config=GeneratorConfig(**c))),
    Autoencoder: ("diffpoint.autoencoder", lambda c: build_autoencoder(config=AutoencoderConfig(**c))),
    Critic: ("diffpoint.critic", lambda c: Critic(**c)),
    StructureGenerator: ("diffpoint.lin", lambda c: build_lin(config=LinConfig(**c))),
    RecurrentReconstruction: ("diffpoint.r2n2", lambda c: build_r2n2(config=R2N2Config(**c))),
    SilhouetteReconstruction: ("diffpoint.ptn", lambda c: build_ptn(config=PTNConfig(**c))),
}
_PREDICTORS = (Generator, StructureGenerator, RecurrentReconstruction, SilhouetteReconstruction)


def best_weights(run: Path, phase: int | str) -> Path:
    """Where a phase ("autoencoder", stage 1 or 2) keeps its best weights by validation."""
    name = f"stage{phase}" if isinstance(phase, int) else phase
    return run / "checkpoints" / f"best-{name}.safetensors"


def save_weights(model: nn.Module, path: Path) -> None:
    """Writes a network's weights and configuration, atomically."""
    name, _ = _KINDS[type(model)]
    tensors = {name: value.detach().contiguous() for name, value in model.state_dict().items()}
    config = getattr(model, "config", None)
    header = {name: json.dumps(dataclasses.asdict(config) if config else {})}
    with _space_for(path), replacing(path) as temporary:
        # Not save_file: it gives the file to its owner alone, and wraps the system's words about a full disk.
        temporary.write_bytes(save(tensors, metadata=header))


def load_generator(run_or_file: str | Path) -> Generator:
    """Loads the generator of a run (best of stage 2, else of stage 1, else the newest) or of a file.

    Returns:
        The generator in eval mode.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return _read(_weights_of_run(path) if path.is_dir() else path, Generator).eval()


def load_predictor(run_or_file: str | Path) -> Predictor:
    """As `load_generator`, of any system: the network of a run, or of a file, whatever it is.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return cast(Predictor, _read(_weights_of_run(path) if path.is_dir() else path, *_PREDICTORS)).eval()


def load_autoencoder(run_or_file: str | Path) -> Autoencoder:
    """Loads the best auto-encoder of a run, or that of a file, in eval mode and frozen.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return _read(best_weights(path, "autoencoder") if path.is_dir() else path, Autoencoder).freeze()


def config_of(run_or_file: str | Path, model: Predictor) -> FitConfig:
    """The configuration of a run, or for a lone file of weights that of its profile and system."""
    file = Path(run_or_file) / "config.json"
    if file.exists():
        return fit_config_from_json(file.read_text(), where=str(file))
    profile = PROFILES[model.profile]
    if not isinstance(model, Generator):
        return with_system(profile, system_of(model))
    return dataclasses.replace(profile, deterministic=model.config.deterministic)


def _weights_of_run(run: Path) -> Path:
    newest = latest_checkpoint(run)
    candidates = [best_weights(run, 2), best_weights(run, 1)]
    candidates += [newest / "weights.safetensors"] if newest else []
    for path in candidates:
        if path.exists():
            return path
    if newest:
        raise UserError(f"{run} holds no generator yet: its auto-encoder is still being trained")
    raise UserError(
        f"{run} is not a run: it holds no checkpoints/*.safetensors; make one with `fit --out {run}`"
    )


def _read(path: Path, *kinds: type[_Network]) -> _Network:
    """The network in a file, which is one of these kinds."""
    if not path.exists():
        raise UserError(f"{path} does not exist; name a run that `fit` wrote, or a .safetensors file of one")
    try:
        with safe_open(path, framework="pt") as file:
            headers = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        found = [_KINDS[kind] for kind in kinds if _KINDS[kind][0] in headers]
        if not found:
            raise ValueError(f"it has no {_KINDS[kinds[0]][0]} header")
        name, build = found[0]
        model = build(_with_tuples(json.loads(headers[name])))
        theirs, ours = (
            {key: value.shape for key, value in of.items()} for of in (tensors, model.state_dict())
        )
        if theirs != ours:
            odd = sorted({key for key, _ in theirs.items() ^ ours.items()})
            raise OtherVersionError(
                f"{path} was written by another version of diffpoint: its {type(model).__name__} has other weights "
                f"({len(odd)} of them, {odd[0]} first); train it anew, or read it with that version"
            )
        model.load_state_dict(tensors)
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(f"{path} holds no {kinds[0].__name__.lower()}'s weights ({reason})") from None
    return model


def _with_tuples(config: dict[str, Any]) -> dict[str, Any]:
    """JSON knows lists only; configurations hold tuples."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in config.items()}


def save_checkpoint(
    run: Path, step: int, networks: Mapping[str, nn.Module], state: dict[str, Any], *, keep: int = 2
) -> None:
    """Writes one resumable checkpoint, atomically, then drops all but the newest.

    Args:
        run: the run's directory.
        step: steps done, over all phases.
        networks: by the names of their files.
        state: everything else, as tensors, numbers, strings, lists and dicts.
        keep: how many checkpoints to keep.

    Raises:
        UserError: it cannot be written; the checkpoints before it are untouched.
    """
    target = run / "checkpoints" / f"step-{step:08d}"
    remove(target)
    with _space_for(target), replacing(target) as directory:
        directory.mkdir()
        for name, network in networks.items():
            save_weights(network, directory / f"{name}.safetensors")
        buffer = io.BytesIO()  # torch's own writer answers a full disk with a riddle
        torch.save(state, buffer)
        (directory / "state.pt").write_bytes(buffer.getbuffer())
    for old in _checkpoints(run)[:-keep]:
        remove(old)


@contextmanager
def _space_for(target: Path) -> Iterator[None]:
    """Turns a failed write into words; those inside are left as they are."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{target} cannot be written ({error}); what was saved before is untouched: make room and continue "
            "with --resume"
        ) from error


def latest_checkpoint(run: Path) -> Path | None:
    """The newest complete checkpoint of a run, or None."""
    checkpoints = _checkpoints(run)
    return checkpoints[-1] if checkpoints else None


def load_networks(directory: Path, networks: Mapping[str, nn.Module]) -> None:
    """Puts a checkpoint's weights into networks of the same sizes.

    Raises:
        UserError: a part of it is missing or cannot be read.
    """
    for name, network in networks.items():
        with _unreadable(directory, f"{name}.safetensors"):
            network.load_state_dict(_read(directory / f"{name}.safetensors", type(network)).state_dict())


def load_state(directory: Path) -> dict[str, Any]:
    """A checkpoint's state.

    Raises:
        UserError: it is missing or cannot be read.
    """
    with _unreadable(directory, "state.pt"):
        return torch.load(directory / "state.pt", weights_only=True)


@contextmanager
def _unreadable(directory: Path, name: str) -> Iterator[None]:
    """Says what to do about a damaged part of a checkpoint."""
    try:
        yield
    except OtherVersionError:  # not damaged; the checkpoint before it is no better
        raise
    except Exception as error:  # a damaged pickle fails in every way there is
        reason = str(error) if isinstance(error, UserError) else type(error).__name__
        raise UserError(
            f"{directory / name} cannot be read ({reason}); delete {directory} to resume from the checkpoint "
            "before it"
        ) from None


def _checkpoints(run: Path) -> list[Path]:
    return sorted((run / "checkpoints").glob("step-????????"))
