"""Evaluates a run on held-out shapes, beside two retrieval baselines, and writes evaluation.json.

All distances are un-squared and x100. The fields of `evaluation.json`:

    profile, config, data, seeds   what was evaluated, and how
    views                          number of views -> metrics (`per_shape.METRICS`), means over seeds and shapes
    spread                         the metrics' standard deviation over seeds
    class_average                  the metrics as unweighted means over categories
    categories                     category -> its number of shapes, and `views` of these
    random_codes                   as `views`, without search and descent; empty for a network without codes
    agreement                      number of views -> consistency loss with random codes, after the search and after
                                   the descent, and the share of reconstructions whose loss the descent lowered
    diversity                      mean chamfer distance between predictions from one image with 10 random codes
    sensitivity                    change of the prediction with the image and with the code (`sensitivity.py`)
    medoid, nearest_image          the retrieval baselines (`retrieval.py`)
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from models import Predictor
from train.config import FitConfig
from train.data.batches import LoadedSplit
from train.device import CPU
from train.errors import UserError
from train.evaluation.metrics import cloud_errors, thin_out
from train.evaluation.per_shape import (
    ShapeMetrics,
    average_rows,
    diversity,
    evaluate_split,
    mean_metrics,
    stack_seeds,
    std_over_seeds,
)
from train.evaluation.retrieval import medoid, nearest_by_image
from train.evaluation.runs import open_run
from train.evaluation.sensitivity import sensitivity
from train.files import require_writable, write_text
from train.processes import progress_bar
from train.show.summary import format_result

VIEW_COUNTS = (1, 2, 4, 8)
_DIVERSITY_CODES = 10
_SENSITIVITY_IMAGES = 24


def evaluate(
    run: str | Path,
    data: str | Path,
    *,
    split: Literal["train", "val", "test"] = "test",
    seeds: Sequence[int] = (0,),
    views: Sequence[int] = VIEW_COUNTS,
    limit: int | None = None,
    framed: bool = False,
    out: str | Path | None = None,
    progress: bool = True,
    device: torch.device = CPU,
) -> dict[str, Any]:
    """Evaluates a run on a split and writes evaluation.json.

    Args:
        run: a run's directory, a .safetensors file of one (then with its profile's default settings), or the word
            `pretrained`.
        data: root of a data tree; the retrieval baselines search its train split.
        split: the split to evaluate.
        seeds: each determines the random codes and the choice of views; metrics are means over seeds.
        views: numbers of input views; those larger than the data have are skipped.
        limit: evaluate at most this many shapes of the split.
        framed: show the network each object as photographs are framed, in the middle and as large as the frame allows.
        out: the file to write; RUN/evaluation.json by default.
        progress: show progress bars and print the table.
        device: where everything is computed.

    Returns:
        What was written.

    Raises:
        UserError: no such run or data, nothing to evaluate, numbers out of range, or a file that cannot be written.
    """
    begun = time.monotonic()
    _check(seeds, views, limit)
    opened = open_run(run, device=device)
    model, config, folder = opened
    if out is None:
        if folder is None:
            raise UserError(f"say where to write with --out FILE: {run} belongs to the repository")
        out = folder / "evaluation.json"
    require_writable(out)
    test = opened.load_split(data, split, limit=limit, progress=progress)
    train = opened.load_split(data, "train", progress=progress)
    if framed:
        test, train = test.framed(), train.framed()
    counts = sorted({n for n in views if n <= test.views})
    if not counts:
        raise UserError(f"{data} has {test.views} views per shape; none of {list(views)} can be evaluated")

    found, random_codes = _measure(model, test, config, counts=counts, seeds=seeds, progress=progress)
    result: dict[str, Any] = {
        "profile": config.profile,
        "config": dataclasses.asdict(config),
        "data": {
            "path": str(data),
            "split": split,
            "framed": framed,
            "shapes": len(test),
            "fingerprint": test.fingerprint,
            "train_shapes": len(train),
        },
        "seeds": list(seeds),
        **_network_metrics(model, test, found, random_codes, seeds=seeds),
        **_retrieval_metrics(test, train, views=counts, points=model.points),
    }
    write_text(Path(out), json.dumps(result, indent=2) + "\n")
    if progress:
        print(format_result(result))
        print(f"took {time.monotonic() - begun:.0f} s; wrote {out}")
    return result


def _check(seeds: Sequence[int], views: Sequence[int], limit: int | None) -> None:
    if not seeds or min(seeds) < 0:
        raise UserError(f"--seeds needs at least one number, none below 0; got {list(seeds)}")
    if not views or min(views) < 1:
        raise UserError(f"--views needs at least one number, none below 1; got {list(views)}")
    if limit is not None and limit < 1:
        raise UserError(f"--limit must be at least 1; got {limit}")


def _measure(
    model: Predictor,
    test: LoadedSplit,
    config: FitConfig,
    *,
    counts: Sequence[int],
    seeds: Sequence[int],
    progress: bool,
) -> tuple[dict[int, ShapeMetrics], dict[int, ShapeMetrics]]:
    """Number of views -> metrics (S, M) with search and descent; and the same with random codes, {} without codes."""
    ways = [config.inference]
    if model.takes_codes:
        ways.append(dataclasses.replace(config.inference, groups=1, steps=0))
    tables: list[dict[int, ShapeMetrics]] = [{} for _ in ways]
    # A step of descent over n views compares n (n - 1) pairs of clouds: the bar counts these, not shapes.
    work = {n: n * n for n in counts}
    total = len(seeds) * len(test) * sum(work.values())
    bar_format = "{l_bar}{bar}| {elapsed} < {remaining}"
    with progress_bar(
        title="evaluation", unit="pair", total=total, progress=progress, bar_format=bar_format
    ) as bar:
        for n in counts:
            bar.set_description(f"{n} view{'s' if n > 1 else ''}")
            for settings, table in zip(ways, tables, strict=True):
                if n == 1 and 1 in tables[0] and not config.inference.medoid:
                    table[1] = tables[0][1]  # with one view there is no search
                    continue
                step = work[n] if settings is config.inference else 0

                def done(shapes: int, step: int = step) -> None:
                    bar.update(shapes * step)

                table[n] = stack_seeds(
                    [evaluate_split(model, test, settings, views=n, seed=seed, done=done) for seed in seeds]
                )
    return tables[0], tables[1] if len(tables) > 1 else {}


def _network_metrics(
    model: Predictor,
    test: LoadedSplit,
    found: dict[int, ShapeMetrics],
    random_codes: dict[int, ShapeMetrics],
    *,
    seeds: Sequence[int],
) -> dict[str, Any]:
    members = {
        name: torch.tensor([i for i, category in enumerate(test.categories) if category == name])
        for name in sorted(set(test.categories))
    }
    categories = {
        name: {
            "shapes": len(shapes),
            "views": {str(n): mean_metrics(metrics, shapes) for n, metrics in found.items()},
        }
        for name, shapes in members.items()
    }
    moved = sensitivity(model, _one_image_per_shape(test))
    return {
        "views": {str(n): mean_metrics(metrics) for n, metrics in found.items()},
        "spread": {str(n): std_over_seeds(metrics) for n, metrics in found.items()},
        "class_average": {
            str(n): average_rows([entry["views"][str(n)] for entry in categories.values()]) for n in found
        },
        "categories": categories,
        "random_codes": {str(n): mean_metrics(metrics) for n, metrics in random_codes.items()},
        "agreement": {
            str(n): _agreement(metrics, random_codes[n])
            for n, metrics in found.items()
            if "searched" in metrics and n in random_codes
        },
        "diversity": _diversity(model, test, members, seeds=seeds) if model.takes_codes else None,
        "sensitivity": {"image": moved.image, "code": moved.code},
    }


def _agreement(found: ShapeMetrics, random_codes: ShapeMetrics) -> dict[str, float]:
    return {
        "random": random_codes["consistency"].mean().item(),
        "searched": found["searched"].mean().item(),
        "descended": found["consistency"].mean().item(),
        "lowered_share": (found["consistency"] < found["searched"]).double().mean().item(),
    }


def _diversity(
    model: Predictor, test: LoadedSplit, members: dict[str, Tensor], *, seeds: Sequence[int]
) -> dict[str, Any]:
    distance = torch.stack([diversity(model, test, codes=_DIVERSITY_CODES, seed=seed) for seed in seeds])
    return {
        "codes": _DIVERSITY_CODES,
        "mean": distance.mean().item(),
        "categories": {name: distance[:, shapes].mean().item() for name, shapes in members.items()},
    }


def _retrieval_metrics(
    test: LoadedSplit, train: LoadedSplit, *, views: Sequence[int], points: int
) -> dict[str, Any]:
    """Errors of the two retrieval baselines, measured like those of a prediction."""

    def mean_errors(clouds: Tensor) -> dict[str, float]:
        clouds = clouds.contiguous()
        errors = cloud_errors(clouds, test.points)
        thinned = cloud_errors(thin_out(clouds, points), test.points)
        return {"cd": errors.cd.mean().item(), "fps_cd": thinned.cd.mean().item()}

    by_image = nearest_by_image(test, train, views=views)
    return {
        "medoid": mean_errors(train.points[medoid(train.points)].expand_as(test.points)),
        "nearest_image": {str(n): mean_errors(train.points[index]) for n, index in by_image.items()},
    }


def _one_image_per_shape(test: LoadedSplit) -> Tensor:
    """(B, 3, H, W) images of up to 24 shapes, one of each; of a single shape two views."""
    numbers = torch.arange(max(2, min(_SENSITIVITY_IMAGES, len(test))))
    return test.float_images(numbers % len(test), (numbers // len(test))[:, None] % test.views)[:, 0]
