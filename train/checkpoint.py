"""What a run keeps: weights, and beside them the state from which training continues to the same bits.

    RUN/checkpoints/step-00000500/{weights.safetensors, state.pt}   the newest two, for --resume
    RUN/checkpoints/best-stage1.safetensors, best-stage2.safetensors   chosen on the validation split

A weights file carries the network's configuration in its header, so that it can be used on its own.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from models import Generator, GeneratorConfig, build_generator
from train.config import PROFILES, FitConfig, fit_config_from_json
from train.errors import UserError
from train.files import remove, replacing

_HEADER = "diffpoint.generator"
_KEPT = 2


def best_weights(run: Path, stage: int) -> Path:
    """Where stage 1 or 2 keeps its best weights by validation."""
    return run / "checkpoints" / f"best-stage{stage}.safetensors"


def save_weights(model: Generator, path: Path) -> None:
    """Writes a generator's weights and configuration, atomically."""
    tensors = {name: value.detach().contiguous() for name, value in model.state_dict().items()}
    header = {_HEADER: json.dumps(dataclasses.asdict(model.config))}
    with replacing(path) as temporary:
        save_file(tensors, temporary, metadata=header)


def load_generator(run_or_file: str | Path) -> Generator:
    """Loads the generator of a run (best of stage 2, else of stage 1, else the newest) or of a file.

    Returns:
        The generator in eval mode.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    if path.is_dir():
        path = _weights_of_run(path)
    elif not path.exists():
        raise UserError(f"{path} does not exist; name a run that `fit` wrote, or a .safetensors file of one")
    return _read_generator(path).eval()


def config_of(run_or_file: str | Path, model: Generator) -> FitConfig:
    """The configuration of a run, or for a lone file of weights that of its profile."""
    file = Path(run_or_file) / "config.json"
    if file.exists():
        return fit_config_from_json(file.read_text(), where=str(file))
    return dataclasses.replace(PROFILES[model.profile], deterministic=model.config.deterministic)


def _weights_of_run(run: Path) -> Path:
    newest = latest_checkpoint(run)
    candidates = [best_weights(run, 2), best_weights(run, 1)]
    candidates += [newest / "weights.safetensors"] if newest else []
    for path in candidates:
        if path.exists():
            return path
    raise UserError(
        f"{run} is not a run: it holds no checkpoints/*.safetensors; make one with `fit --out {run}`"
    )


def _read_generator(path: Path) -> Generator:
    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get(_HEADER)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        if header is None:
            raise ValueError("it has no diffpoint header")
        model = build_generator(config=GeneratorConfig(**json.loads(header)))
        model.load_state_dict(tensors)
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(f"{path} holds no generator's weights ({reason})") from None
    return model


def save_checkpoint(run: Path, step: int, model: Generator, state: dict[str, Any]) -> None:
    """Writes one resumable checkpoint, atomically, then drops all but the newest two.

    Args:
        run: the run's directory.
        step: steps done, over all stages.
        model: the generator.
        state: everything else, as tensors, numbers, strings, lists and dicts.
    """
    target = run / "checkpoints" / f"step-{step:08d}"
    remove(target)
    with replacing(target) as directory:
        directory.mkdir()
        save_weights(model, directory / "weights.safetensors")
        torch.save(state, directory / "state.pt")
    for old in _checkpoints(run)[:-_KEPT]:
        remove(old)


def latest_checkpoint(run: Path) -> Path | None:
    """The newest complete checkpoint of a run, or None."""
    checkpoints = _checkpoints(run)
    return checkpoints[-1] if checkpoints else None


def load_checkpoint(directory: Path, model: nn.Module) -> dict[str, Any]:
    """Puts a checkpoint's weights into the model and returns its state."""
    model.load_state_dict(_read_generator(directory / "weights.safetensors").state_dict())
    try:
        return torch.load(directory / "state.pt", weights_only=True)
    except Exception as error:  # a damaged pickle fails in every way there is
        raise UserError(
            f"{directory / 'state.pt'} cannot be read ({type(error).__name__}); delete {directory} to resume "
            "from the checkpoint before it"
        ) from None


def _checkpoints(run: Path) -> list[Path]:
    return sorted((run / "checkpoints").glob("step-????????"))
