"""What a user may name as a run: a directory of `fit`, a file of weights, or the word `pretrained`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from models import Predictor
from train.batches import LoadedSplit, load_split
from train.checkpoint import config_of, load_predictor
from train.config import FitConfig
from train.errors import UserError

PRETRAINED = "pretrained"
"""The word for the weights that come with the repository; a file or directory of that name goes first."""
_SHIPPED = Path(__file__).parent / "pretrained"


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
