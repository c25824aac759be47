"""How good a run is on shapes it has never seen, beside answers that need no network.

All distances are un-squared and x100. `evaluation.json` keeps every figure with the configuration that made it:

    profile, config, data, seeds   what was scored, and how
    views                          number of views -> figures (`train.scoring.FIGURES`): mean over seeds and shapes
    spread                         the same figures' standard deviation over seeds
    class_average                  the same figures, every category counting once
    categories                     category -> its number of shapes and its views
    random_codes                   as views, without search and descent; empty for a network without codes
    agreement                      number of views -> consistency loss at random codes, after search, after descent,
                                   and the share of reconstructions whose loss the descent lowered
    diversity                      mean chamfer distance between predictions of one image, 10 random codes each
    sensitivity                    how far predictions move with the image and with the code
    medoid, nearest_image          the most typical training shape; the one whose pictures look most alike
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
from tqdm import tqdm

from models import Predictor
from train.config import FitConfig
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.metrics import cloud_errors, thin_out
from train.evaluation.per_shape import Scores, average, diversity, means, score, spreads, stacked
from train.evaluation.retrieval import medoid, nearest_by_image
from train.evaluation.runs import open_run
from train.evaluation.sensitivity import sensitivity
from train.files import write_text
from train.show.table import format_table

VIEW_COUNTS = (1, 2, 4, 8)
_DIVERSITY_CODES = 10
_SENSITIVITY_IMAGES = 24


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
        run: a run's directory, a .safetensors file of one (then with its profile's default settings), or the word
            `pretrained`.
        data: root of a data tree; its train split gives the trivial answers.
        split: the split to score.
        seeds: each draws other codes and another choice of views; figures are means over them.
        views: numbers of views; those the data do not have are left out.
        limit: at most that many shapes of the split.
        out: where to write; RUN/evaluation.json by default.
        progress: show bars and print the table.

    Returns:
        What was written.

    Raises:
        UserError: no such run or data, nothing to score, or numbers out of range.
    """
    begun = time.monotonic()
    _check(seeds, views, limit)
    opened = open_run(run)
    model, config, folder = opened
    if out is None:
        if folder is None:
            raise UserError(f"say where to write with --out FILE: {run} belongs to the repository")
        out = folder / "evaluation.json"
    test = opened.load_split(data, split, limit=limit, progress=progress)
    train = opened.load_split(data, "train", progress=progress)
    counts = sorted({n for n in views if n <= test.views})
    if not counts:
        raise UserError(f"{data} has {test.views} views per shape; none of {list(views)} can be evaluated")

    found, random_codes = _score(model, test, config, counts=counts, seeds=seeds, progress=progress)
    result: dict[str, Any] = {
        "profile": config.profile,
        "config": dataclasses.asdict(config),
        "data": {
            "path": str(data),
            "split": split,
            "shapes": len(test),
            "fingerprint": test.fingerprint,
            "train_shapes": len(train),
        },
        "seeds": list(seeds),
        **_network_figures(model, test, found, random_codes, seeds=seeds),
        **_trivial_figures(test, train, views=counts, points=model.points),
    }
    write_text(out, json.dumps(result, indent=2) + "\n")
    if progress:
        print(format_table(result))
        print(f"took {time.monotonic() - begun:.0f} s; wrote {out}")
    return result


def _check(seeds: Sequence[int], views: Sequence[int], limit: int | None) -> None:
    if not seeds or min(seeds) < 0:
        raise UserError(f"--seeds needs at least one number, none below 0; got {list(seeds)}")
    if not views or min(views) < 1:
        raise UserError(f"--views needs at least one number, none below 1; got {list(views)}")
    if limit is not None and limit < 1:
        raise UserError(f"--limit must be at least 1; got {limit}")


def _score(
    model: Predictor,
    test: LoadedSplit,
    config: FitConfig,
    *,
    counts: Sequence[int],
    seeds: Sequence[int],
    progress: bool,
) -> tuple[dict[int, Scores], dict[int, Scores]]:
    """Number of views -> scores of all seeds, with search and descent; and, if there are codes, without."""
    ways = [config.inference]
    if model.takes_codes:
        ways.append(dataclasses.replace(config.inference, groups=1, steps=0))
    tables: list[dict[int, Scores]] = [{} for _ in ways]
    # A descent over n views compares n (n - 1) pairs again and again: the bar counts work, not shapes.
    work = {n: n * n for n in counts}
    total = len(seeds) * len(test) * sum(work.values())
    with tqdm(total=total, disable=not progress, bar_format="{l_bar}{bar}| {elapsed} < {remaining}") as bar:
        for n in counts:
            bar.set_description(f"{n} view{'s' if n > 1 else ''}")
            for settings, table in zip(ways, tables, strict=True):
                if n == 1 and 1 in tables[0]:
                    table[1] = tables[0][1]  # one view has nothing to search for
                    continue
                step = work[n] if settings is config.inference else 0

                def done(shapes: int, step: int = step) -> None:
                    bar.update(shapes * step)

                table[n] = stacked(
                    [score(model, test, settings, views=n, seed=seed, done=done) for seed in seeds]
                )
    return tables[0], tables[1] if len(tables) > 1 else {}


def _network_figures(
    model: Predictor,
    test: LoadedSplit,
    found: dict[int, Scores],
    random_codes: dict[int, Scores],
    *,
    seeds: Sequence[int],
) -> dict[str, Any]:
    members = {
        name: torch.tensor([i for i, category in enumerate(test.categories) if category == name])
        for name in sorted(set(test.categories))
    }
    categories = {
        name: {"shapes": len(shapes), "views": {str(n): means(scores, shapes) for n, scores in found.items()}}
        for name, shapes in members.items()
    }
    moved = sensitivity(model, _one_image_per_shape(test))
    return {
        "views": {str(n): means(scores) for n, scores in found.items()},
        "spread": {str(n): spreads(scores) for n, scores in found.items()},
        "class_average": {
            str(n): average([entry["views"][str(n)] for entry in categories.values()]) for n in found
        },
        "categories": categories,
        "random_codes": {str(n): means(scores) for n, scores in random_codes.items()},
        "agreement": {
            str(n): _agreement(scores, random_codes[n])
            for n, scores in found.items()
            if "searched" in scores and n in random_codes
        },
        "diversity": _diversity(model, test, members, seeds=seeds) if model.takes_codes else None,
        "sensitivity": {"image": moved.image, "code": moved.code},
    }


def _agreement(found: Scores, random_codes: Scores) -> dict[str, float]:
    return {
        "random": random_codes["consistency"].mean().item(),
        "searched": found["searched"].mean().item(),
        "descended": found["consistency"].mean().item(),
        "lowered_share": (found["consistency"] < found["searched"]).double().mean().item(),
    }


def _diversity(
    model: Predictor, test: LoadedSplit, members: dict[str, Tensor], *, seeds: Sequence[int]
) -> dict[str, Any]:
    apart = torch.stack([diversity(model, test, codes=_DIVERSITY_CODES, seed=seed) for seed in seeds])
    return {
        "codes": _DIVERSITY_CODES,
        "mean": apart.mean().item(),
        "categories": {name: apart[:, shapes].mean().item() for name, shapes in members.items()},
    }


def _trivial_figures(
    test: LoadedSplit, train: LoadedSplit, *, views: Sequence[int], points: int
) -> dict[str, Any]:
    """The two answers without a network, compared like a prediction."""

    def scores(clouds: Tensor) -> dict[str, float]:
        clouds = clouds.contiguous()
        errors, thinned = (
            cloud_errors(clouds, test.points),
            cloud_errors(thin_out(clouds, points), test.points),
        )
        return {"cd": errors.cd.mean().item(), "fps_cd": thinned.cd.mean().item()}

    by_image = nearest_by_image(test, train, views=views)
    return {
        "medoid": scores(train.points[medoid(train.points)].expand_as(test.points)),
        "nearest_image": {str(n): scores(train.points[index]) for n, index in by_image.items()},
    }


def _one_image_per_shape(test: LoadedSplit) -> Tensor:
    """Up to 24 images of as many shapes as there are; a lone shape shows two of its views."""
    numbers = torch.arange(max(2, min(_SENSITIVITY_IMAGES, len(test))))
    return test.float_images(numbers % len(test), (numbers // len(test))[:, None] % test.views)[:, 0]
