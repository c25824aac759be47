"""What a user may name as a run: a directory of `fit`, a file of weights, or the word `pretrained`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from models import Autoencoder, Generator, Predictor
from train.config import FitConfig, fit_config_from_json
from train.data.batches import LoadedSplit, load_split
from train.errors import UserError
from train.methods.weights import method_of, predictor_classes, read_weights

PRETRAINED = "pretrained"
"""The word for the weights that come with the repository; a file or directory of that name goes first."""
_SHIPPED = Path(__file__).parents[1] / "pretrained"


class OpenRun(NamedTuple):
    """A trained network, how it was trained, and the directory where what is found out about it belongs.

    `folder` is None for the weights that come with the repository.
    """

    model: Predictor
    config: FitConfig
    folder: Path | None

    def load_split(
        self,
        data: Path,
        split: Literal["train", "val", "test"],
        *,
        limit: int | None = None,
        progress: bool = True,
    ) -> LoadedSplit:
        """Reads a split as the run was trained: its image and map sizes, its categories."""
        size = (self.model.config.image_height, self.model.config.image_width)
        return read_split(self.config, data, split, image_size=size, limit=limit, progress=progress)


def read_split(
    config: FitConfig,
    data: Path | Sequence[Path],
    split: Literal["train", "val", "test"],
    *,
    image_size: tuple[int, int],
    limit: int | None = None,
    progress: bool = True,
) -> LoadedSplit:
    """Reads a split as a configuration asks for it: its map size and pooling, its categories; see `load_split`."""
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


def open_run(run: Path) -> OpenRun:
    """Loads the network of a run.

    Args:
        run: a run's directory, a .safetensors file of one, or `Path("pretrained")`.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    if run != Path(PRETRAINED) or run.exists():
        model = load_predictor(run)
        return OpenRun(model, config_of(run, model), run if run.is_dir() else run.parent)
    weights = _SHIPPED / "generator.safetensors"
    if not weights.exists():
        raise UserError(
            f"'{PRETRAINED}' means the weights in {weights}, and there are none; train your own "
            "(python -m train data procedural --out data --shapes 400 --size 112, then python -m train fit "
            "--data data --out run, about an hour) and name that run instead"
        )
    model = load_predictor(weights)
    return OpenRun(model, config_of(_SHIPPED, model), None)


def best_weights(run: Path, phase: int | str) -> Path:
    """Where a phase ("autoencoder", stage 1 or 2) keeps its best weights by validation."""
    name = f"stage{phase}" if isinstance(phase, int) else phase
    return run / "checkpoints" / f"best-{name}.safetensors"


def load_generator(run_or_file: str | Path) -> Generator:
    """Loads the generator of a run (best of stage 2, else of stage 1, else the newest) or of a file.

    Returns:
        The generator in eval mode.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return read_weights(_weights_of_run(path) if path.is_dir() else path, Generator).eval()


def load_predictor(run_or_file: str | Path) -> Predictor:
    """As `load_generator`, of any system: the network of a run, or of a file, whatever it is.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return read_weights(_weights_of_run(path) if path.is_dir() else path, *predictor_classes()).eval()


def load_autoencoder(run_or_file: str | Path) -> Autoencoder:
    """Loads the best auto-encoder of a run, or that of a file, in eval mode and frozen.

    Raises:
        UserError: there is nothing of the kind, or it cannot be read.
    """
    path = Path(run_or_file)
    return read_weights(best_weights(path, "autoencoder") if path.is_dir() else path, Autoencoder).freeze()


def config_of(run_or_file: str | Path, model: Predictor) -> FitConfig:
    """The configuration of a run, or for a lone file of weights that of its profile and system."""
    file = Path(run_or_file) / "config.json"
    if file.exists():
        return fit_config_from_json(file.read_text(), where=str(file))
    return method_of(model).recipe_of(model)


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


def latest_checkpoint(run: Path) -> Path | None:
    """The newest complete checkpoint of a run, or None."""
    found = checkpoints(run)
    return found[-1] if found else None


def checkpoints(run: Path) -> list[Path]:
    return sorted((run / "checkpoints").glob("step-????????"))


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """All records of a run, in order."""
    return [json.loads(line) for line in complete_lines(run / "metrics.jsonl")]


def complete_lines(path: Path) -> list[str]:
    """The lines of a file; one cut short by a kill is left out."""
    if not path.exists():
        return []
    return [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
