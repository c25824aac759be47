"""Examples for a report: test shapes with predictions from one image and a reconstruction from all images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from models import Predictor
from train.config import FitConfig, fit_config_from_json
from train.data import Shape, ShapeTree
from train.device import CPU
from train.errors import UserError
from train.evaluation.inference import predict, reconstruct
from train.evaluation.runs import load_predictor, read_metrics
from train.show import figures
from train.show.report import write_report

_CODES = 4
_SHAPES = 3


def report_run(
    out: str | Path,
    *,
    run: str | Path,
    data: str | Path,
    seconds: Mapping[str, float] | None = None,
    seed: int = 0,
    first: Sequence[str] = (),
    device: torch.device = CPU,
) -> Path:
    """Writes out/report.html and out/figures/*.png about an evaluated run.

    Args:
        out: directory to write to.
        run: directory of the run; must hold evaluation.json.
        data: root of the data tree; examples come from its test split.
        seconds: duration of each phase, for the record.
        seed: of the examples' random codes.
        first: parts of the page that precede those about the run.
        device: where the predictions are computed.

    Returns:
        The page.

    Raises:
        UserError: no run, no evaluation or no data there.
    """
    run = Path(run)
    if not (run / "evaluation.json").exists():
        raise UserError(
            f"{run} has no evaluation.json; make it with: python -m train evaluate {run} --data {data}"
        )
    config = (run / "config.json").read_text()
    settings = fit_config_from_json(config, where=str(run / "config.json"))
    model, shapes = load_predictor(run, device=device), pick_shapes(ShapeTree(data, "test"))
    return write_report(
        out,
        result=json.loads((run / "evaluation.json").read_text()),
        examples=[make_example(model, shape, settings, seed=seed) for shape in shapes],
        records=read_metrics(run),
        config=config,
        run=str(run),
        seconds=seconds or {},
        first=first,
    )


@torch.no_grad()
def make_example(
    model: Predictor, shape: Shape, config: FitConfig, *, seed: int, codes: int = _CODES
) -> figures.Example:
    """Predictions from the image that shows a shape's front best, and a reconstruction from all images."""
    # Objects face +z, so that this view does not show their back.
    chosen = int(shape.camera.position[:, 2].argmax())
    predictions = predict(model, shape.images[chosen], codes, seed=seed)
    found = reconstruct(model, shape.images, seed=seed, settings=config.inference)
    images, camera = figures.close_up(shape.images, shape.camera, shape.points)
    return figures.Example(images, camera, chosen, predictions, found.points[0], shape.points)


def pick_shapes(tree: ShapeTree, count: int = _SHAPES) -> list[Shape]:
    """A few readable shapes, of as many categories as there are.

    Raises:
        UserError: no shape of the split can be read.
    """
    by_category: dict[str, list[Shape]] = {}
    for shape in tree.iter_valid():
        same = by_category.setdefault(shape.category, [])
        if len(same) < count:
            same.append(shape)
    ranked = [(rank, shape) for same in by_category.values() for rank, shape in enumerate(same)]
    picked = [shape for _, shape in sorted(ranked, key=lambda pair: pair[0])][:count]
    if not picked:
        raise UserError(f"{tree.path} has no readable shape in its {tree.split} split")
    return picked
