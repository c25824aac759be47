"""How good a run is on shapes it has never seen, beside two answers that need no network.

All distances are un-squared and x100. `evaluation.json` keeps every figure with the configuration that made it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from models import Generator
from train.batches import LoadedSplit, load_split
from train.checkpoint import config_of, load_generator
from train.config import FitConfig
from train.errors import UserError
from train.files import write_text
from train.health import sensitivity
from train.inference import reconstruct
from train.metrics import cloud_errors, thin_out
from train.table import format_table
from train.trivial import medoid, nearest_by_image

VIEW_COUNTS = (1, 2, 4, 8)
_SHAPES_AT_ONCE = 16
_SENSITIVITY_IMAGES = 24


class ShapeScore(NamedTuple):
    """One test shape, one number of views, one seed; distances x100."""

    category: str
    views: int
    gt_to_pred: float
    pred_to_gt: float
    cd: float
    fps_cd: float
    consistency: float | None


def evaluate(
    run: Path,
    data: Path,
    *,
    split: Literal["train", "val", "test"] = "test",
    seeds: Sequence[int] = (0,),
    views: Sequence[int] = VIEW_COUNTS,
    limit: int | None = None,
    out: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Scores a run on a split and writes evaluation.json.

    Args:
        run: a run's directory, or a .safetensors file of one (then with its profile's default settings).
        data: root of a data tree; its train split gives the trivial answers.
        split: the split to score.
        seeds: each draws other codes and another choice of views; figures are means over them.
        views: numbers of views; those the data do not have are left out.
        limit: at most that many shapes of the split.
        out: where to write; RUN/evaluation.json by default.
        progress: show bars and print the table.

    Returns:
        What was written.
    """
    model = load_generator(run)
    config = config_of(run, model)
    test = _load(data, split, model, config, limit=limit, progress=progress)
    train = _load(data, "train", model, config, limit=None, progress=progress)
    counts = [n for n in views if n <= test.views]
    if not counts:
        raise UserError(f"{data} has {test.views} views per shape; none of {list(views)} can be evaluated")

    scores: list[ShapeScore] = []
    random_codes: list[ShapeScore] = []
    with tqdm(total=2 * len(seeds) * len(counts) * len(test), unit="shape", disable=not progress) as bar:
        for seed in seeds:
            for n in counts:
                bar.set_description(f"{n} views, seed {seed}")
                scores += _score(model, test, config, views=n, seed=seed, search=True, bar=bar)
                random_codes += _score(model, test, config, views=n, seed=seed, search=False, bar=bar)

    by_image = nearest_by_image(test, train, views=counts)
    found = sensitivity(model, _one_image_per_shape(test))
    result: dict[str, Any] = {
        "profile": config.profile,
        "config": dataclasses.asdict(config),
        "data": {"path": str(data), "split": split, "shapes": len(test), "fingerprint": test.fingerprint},
        "seeds": list(seeds),
        "medoid": _trivial_scores(train.points[medoid(train.points)].expand_as(test.points), test, model),
        "nearest_image": {
            str(n): _trivial_scores(train.points[index], test, model) for n, index in by_image.items()
        },
        "views": _by_views(scores),
        "random_codes": _by_views(random_codes),
        "categories": {
            category: {
                "shapes": test.categories.count(category),
                "views": _by_views([score for score in scores if score.category == category]),
            }
            for category in sorted(set(test.categories))
        },
        "sensitivity": {"image": found.image, "code": found.code},
    }
    write_text(
        out or (run if run.is_dir() else run.parent) / "evaluation.json", json.dumps(result, indent=2) + "\n"
    )
    if progress:
        print(format_table(result))
    return result


def _score(
    model: Generator, test: LoadedSplit, config: FitConfig, *, views: int, seed: int, search: bool, bar: tqdm
) -> list[ShapeScore]:
    """Scores every shape with `views` of its views, with or without search and descent."""
    scores = []
    order = _view_order(test, seed)
    inference = config.inference
    for start in range(0, len(test), _SHAPES_AT_ONCE):
        shapes = torch.arange(start, min(start + _SHAPES_AT_ONCE, len(test)))
        images = test.float_images(shapes, order[shapes, :views])
        found = reconstruct(
            model,
            images,
            groups=inference.groups if search else 1,
            steps=inference.steps if search else 0,
            seed=seed * 10_000 + start,
            step_size=inference.step_size,
        )
        errors = cloud_errors(found.points, test.points[shapes])
        thinned = cloud_errors(thin_out(found.points, model.points), test.points[shapes]).cd
        for row, shape in enumerate(shapes.tolist()):
            scores.append(
                ShapeScore(
                    category=test.categories[shape],
                    views=views,
                    gt_to_pred=errors.gt_to_pred[row].item(),
                    pred_to_gt=errors.pred_to_gt[row].item(),
                    cd=errors.cd[row].item(),
                    fps_cd=thinned[row].item(),
                    consistency=found.history[-1, row].item() if len(found.history) else None,
                )
            )
        bar.update(len(shapes))
    return scores


def _view_order(test: LoadedSplit, seed: int) -> Tensor:
    """(M, V): for each shape its views in this seed's order; fewer views are the first of more."""
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randperm(test.views, generator=generator) for _ in range(len(test))])


def _by_views(scores: list[ShapeScore]) -> dict[str, dict[str, float | None]]:
    """Means over shapes and seeds, for each number of views."""
    figures = ("gt_to_pred", "pred_to_gt", "cd", "fps_cd", "consistency")
    table: dict[str, dict[str, float | None]] = {}
    for n in sorted({score.views for score in scores}):
        rows = [score for score in scores if score.views == n]
        table[str(n)] = {name: _mean([getattr(row, name) for row in rows]) for name in figures}
    return table


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def _trivial_scores(clouds: Tensor, test: LoadedSplit, model: Generator) -> dict[str, float]:
    clouds = clouds.contiguous()
    errors = cloud_errors(clouds, test.points)
    thinned = cloud_errors(thin_out(clouds, model.points), test.points)
    return {"cd": errors.cd.mean().item(), "fps_cd": thinned.cd.mean().item()}


def _one_image_per_shape(test: LoadedSplit) -> Tensor:
    """Up to 24 images of as many shapes as there are; a lone shape shows two of its views."""
    numbers = torch.arange(max(2, min(_SENSITIVITY_IMAGES, len(test))))
    return test.float_images(numbers % len(test), (numbers // len(test))[:, None])[:, 0]


def _load(
    data: Path,
    split: Literal["train", "val", "test"],
    model: Generator,
    config: FitConfig,
    *,
    limit: int | None,
    progress: bool,
) -> LoadedSplit:
    return load_split(
        data,
        split,
        image_size=(model.config.image_height, model.config.image_width),
        map_size=config.map_size,
        gt_pool=config.gt_pool,
        categories=config.categories,
        limit=limit,
        progress=progress,
    )
