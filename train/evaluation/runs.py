"""Trained runs on disk: a directory written by `fit`, a file of weights, or "pretrained" for the shipped weights."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from models import Autoencoder, Generator, Predictor
from train.config import FitConfig, fit_config_from_json
from train.data.batches import LoadedSplit, load_split
from train.device import CPU
from train.errors import UserError
from train.files import require_writable
from train.methods.weights import method_of, predictor_classes, read_weights, save_weights

PRETRAINED = "pretrained"
"""Names the weights that come with the repository, unless there is a file or directory of that name."""
_SHIPPED = Path(__file__).parents[1] / "pretrained"


class OpenRun(NamedTuple):
    """A trained network, its training's configuration, and the directory for results about it.

    `folder` is None for the weights that come with the repository.
    """

    model: Predictor
    config: FitConfig
    folder: Path | None

    def load_split(
        self,
        data: str | Path,
        split: Literal["train", "val", "test"],
        *,
        limit: int | None = None,
        progress: bool = True,
    ) -> LoadedSplit:
        """Loads a split with the run's image size, map size and categories, onto the network's device."""
        size = (self.model.config.image_height, self.model.config.image_width)
        found = read_split(self.config, data, split, image_size=size, limit=limit, progress=progress)
        return found.to(self.model.device)


def read_split(
    config: FitConfig,
    data: str | Path | Sequence[str | Path],
    split: Literal["train", "val", "test"],
    *,
    image_size: tuple[int, int],
    limit: int | None = None,
    progress: bool = True,
) -> LoadedSplit:
    """Loads a split with a configuration's map size, pooling and categories; see `load_split`."""
    return load_split(
        data,
        split,
        image_size=image_size,
        map_size=config.map_size,
        gt_pool=config.gt_pool,
        categories=config.categories,
        limit=limit,
        progress=progress,
    )


def open_run(run: str | Path, *, device: torch.device = CPU) -> OpenRun:
    """Loads the network of a run with its configuration.

    Args:
        run: a run's directory, a .safetensors file of one, or "pretrained".
        device: on which the network shall be.

    Raises:
        UserError: no such run, or it cannot be read.
    """
    path = Path(run)
    model = load_predictor(path, device=device)
    if _is_shipped(path):
        return OpenRun(model, config_of(_SHIPPED, model), None)
    return OpenRun(model, config_of(path, model), path if path.is_dir() else path.parent)


def best_weights(run: str | Path, phase: int | str) -> Path:
    """The file with a phase's best weights by validation; the phase is "autoencoder" or the number of a stage."""
    name = f"stage{phase}" if isinstance(phase, int) else phase
    return Path(run) / "checkpoints" / f"best-{name}.safetensors"


def load_generator(run_or_file: str | Path, *, device: torch.device | str = CPU) -> Generator:
    """Loads the generator of a run (best weights of stage 2, else of stage 1, else the newest checkpoint).

    Args:
        run_or_file: a run's directory, a .safetensors file of one, or "pretrained".
        device: where it shall be, as `torch.nn.Module.to` takes it, whatever device it was trained on. `reconstruct`
            takes images on any device, then.

    Returns:
        The generator in eval mode.

    Raises:
        UserError: no such run, one of a baseline, or it cannot be read.
    """
    return read_weights(_weights_file(Path(run_or_file)), Generator).eval().to(device)


def load_predictor(run_or_file: str | Path, *, device: torch.device | str = CPU) -> Predictor:
    """As `load_generator`, for the network of any system."""
    return read_weights(_weights_file(Path(run_or_file)), *predictor_classes()).eval().to(device)


def load_autoencoder(run_or_file: str | Path) -> Autoencoder:
    """Loads the best auto-encoder of a run, or that of a file, in eval mode and frozen.

    Raises:
        UserError: no such file, or it cannot be read.
    """
    path = Path(run_or_file)
    return read_weights(best_weights(path, "autoencoder") if path.is_dir() else path, Autoencoder).freeze()


def export_weights(run: str | Path, out: str | Path, *, half: bool = False) -> None:
    """Writes the best weights of a run to one file, which can be used wherever a run is expected.

    Args:
        run: a run's directory, a .safetensors file of one, or "pretrained".
        out: the .safetensors file.
        half: in float16: half the size. Coordinates change by about 0.0003 world units.

    Raises:
        UserError: no such run, a name that does not end in .safetensors, or a file that cannot be written.
    """
    out = Path(out)
    if out.suffix != ".safetensors":
        raise UserError(f"{out} is not the name of a weights file; --out must end in .safetensors")
    require_writable(out)
    save_weights(load_predictor(run), out, half=half)


def config_of(run_or_file: str | Path, model: Predictor) -> FitConfig:
    """The configuration of a run; for a file of weights the default of its profile and system."""
    file = Path(run_or_file) / "config.json"
    if file.exists():
        return fit_config_from_json(file.read_text(), where=str(file))
    return method_of(model).recipe_of(model)


def _is_shipped(path: Path) -> bool:
    return path == Path(PRETRAINED) and not path.exists()


def _weights_file(path: Path) -> Path:
    if path.is_dir():
        return _weights_of_run(path)
    if not _is_shipped(path):
        return path
    weights = _SHIPPED / "generator.safetensors"
    if not weights.exists():
        raise UserError(
            f"'{PRETRAINED}' means the weights in {weights}, which does not exist; train your own "
            "(python -m train data procedural --out data --shapes 400 --size 112, then python -m train fit "
            "--data data --out run, about an hour) and name that run instead"
        )
    return weights


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


def latest_checkpoint(run: str | Path) -> Path | None:
    """The newest complete checkpoint of a run, or None."""
    found = checkpoints(run)
    return found[-1] if found else None


def checkpoints(run: str | Path) -> list[Path]:
    """All complete checkpoints of a run, oldest first."""
    return sorted((Path(run) / "checkpoints").glob("step-????????"))


def read_metrics(run: str | Path) -> list[dict[str, Any]]:
    """All records of a run's metrics.jsonl, in order."""
    return [json.loads(line) for line in complete_lines(Path(run) / "metrics.jsonl")]


def complete_lines(path: Path) -> list[str]:
    """The lines of a file without an incomplete last one, which a killed process leaves; none without the file."""
    if not path.exists():
        return []
    return [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
