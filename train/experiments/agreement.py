"""Does agreement help? What search and descent on the codes do to the error, and why.

Every way of choosing codes is scored on the same shapes, views and first random codes. Beside them:

- the floor: the consistency loss between random samples of the TRUE shape, as large as one prediction. Predictions
  that all lay on the true surface would still disagree by about that much, because their points do not coincide;
  a descent that goes on makes points coincide, and the joined cloud covers less.
- the correlation of disagreement and error, over groups of random codes of one shape and over shapes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from diffpoint import consistency_loss
from train.config import InferenceConfig
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.per_shape import (
    ShapeMetrics,
    concatenate,
    evaluate_split,
    mean_metrics,
    stack_seeds,
    std_over_seeds,
)
from train.evaluation.runs import open_run
from train.experiments.correlation import pearson
from train.experiments.table import table_row
from train.experiments.workbench import Workbench
from train.show import figures

_RANDOM = "random codes"
WAYS: dict[str, InferenceConfig] = {
    _RANDOM: InferenceConfig(groups=1, steps=0),
    "best of 5 groups": InferenceConfig(groups=5, steps=0),
    "best of 20 groups": InferenceConfig(groups=20, steps=0),
    "descent alone, 30 x 0.1": InferenceConfig(groups=1, steps=30, step_size=0.1),
    "best of 5, 10 x 0.1": InferenceConfig(steps=10, step_size=0.1),
    "best of 5, 30 x 0.1": InferenceConfig(steps=30, step_size=0.1),
    "best of 5, 30 x 0.5 (the paper's)": InferenceConfig(steps=30, step_size=0.5),
    "best of 5, 30 x 1.0": InferenceConfig(steps=30, step_size=1.0),
    "30 x 0.5, codes of constant length": InferenceConfig(steps=30, step_size=0.5, keep_norm=True),
    "30 x 0.5, pulled to N(0, 1)": InferenceConfig(steps=30, step_size=0.5, prior=0.02),
}
_GROUPS = 20
_COLUMNS = {
    "consistency": "consistency",
    "gt_to_pred": "GT->pred",
    "pred_to_gt": "pred->GT",
    "cd": "CD",
    "fps_gt_to_pred": "FPS GT->pred",
    "fps_pred_to_gt": "FPS pred->GT",
    "fps_cd": "FPS-CD",
}


class _Asked(NamedTuple):
    """One measurement: a way of choosing codes, and what is drawn.

    Attributes:
        settings: the way.
        views: per shape.
        seed: draws the views, and the codes if nothing else does.
        code_seeds: each draws codes of its own.
    """

    settings: InferenceConfig
    views: int
    seed: int
    code_seeds: tuple[int | None, ...] = (None,)


def agreement(
    bench: Workbench, run: Path, *, views: int, ways: Mapping[str, InferenceConfig] = WAYS
) -> dict[str, Any]:
    """Scores every way of choosing codes; writes agreement.json, .md and .png.

    Args:
        bench: the first tree's test split is used; its seeds draw codes and views.
        run: a run whose network takes codes, as `train.runs.open_run` takes it.
        views: per shape, at least 2.
        ways: name -> settings; must hold "random codes".

    Returns:
        What agreement.json holds.

    Raises:
        UserError: no such run, one without codes, or numbers out of range.
    """
    opened = open_run(run)
    model, config = opened.model, opened.config
    if not model.takes_codes:
        raise UserError(f"{run} takes no codes: there is nothing to agree on by choosing them")
    test = bench.split(config, "test")
    if not 2 <= views <= test.views:
        raise UserError(
            f"--views must be between 2 and the {test.views} that {bench.scored_tree} has; got {views}"
        )
    if len(test) < 2:
        raise UserError(f"one test shape has no spread; {bench.scored_tree} must give at least 2")

    seeds = range(bench.seeds)
    of_ways = {name: [_Asked(settings, views, seed) for seed in seeds] for name, settings in ways.items()}
    of_groups = [
        _Asked(ways[_RANDOM], views, 0, tuple(range(first, first + _GROUPS)))
        for first in range(1, 1 + _GROUPS * len(seeds), _GROUPS)
    ]
    everything = [*itertools.chain(*of_ways.values()), *of_groups]
    bench.measure_all(_measured, [(run, asked) for asked in everything])
    # In one process nothing is kept yet: it is measured here.
    bar = tqdm(everything, desc="ways of choosing codes", unit="measurement", disable=not bench.progress)
    found = {asked: _measured(bench, run, asked) for asked in bar}
    scores = {name: concatenate([found[asked] for asked in each]) for name, each in of_ways.items()}
    groups = concatenate([found[asked] for asked in of_groups])

    result: dict[str, Any] = bench.about(config) | {
        "profile": config.profile,  # the run's, whatever the bench would train
        "run": str(run),
        "shapes": len(test),
        "fingerprint": test.fingerprint,
        "views": views,
        "floor": _floor(test, points=model.points, clouds=views),
        "ways": {
            name: {
                "settings": dataclasses.asdict(ways[name]),
                "mean": mean_metrics(found),
                "sd_over_seeds": std_over_seeds(found),
                "against_random": _against(found, scores[_RANDOM]),
                "lowered_share": _lowered(found) if ways[name].steps else None,
                "code_norm": found["code_norm"].mean().item(),
            }
            for name, found in scores.items()
        },
        "correlation": _correlation(groups),
    }
    bench.publish("agreement", result, _markdown(result), _figure(result, groups))
    return result


def _measured(bench: Workbench, run: Path, asked: _Asked) -> ShapeMetrics:
    """Figure -> (C, M) for each draw of codes and each shape, taken now or kept."""
    opened = open_run(run)
    test = bench.split(opened.config, "test")
    settings, views, seed, code_seeds = asked

    def take() -> ShapeMetrics:
        draws = [
            evaluate_split(opened.model, test, settings, views=views, seed=seed, code_seed=draw)
            for draw in code_seeds
        ]
        return {name: values.double() for name, values in stack_seeds(draws).items()}

    # A run's name would not do: any run can be asked about, and one that trains on gets other weights.
    weights = hashlib.sha256()
    for name, values in opened.model.state_dict().items():
        weights.update(name.encode() + values.numpy().tobytes())
    key = [
        "agreement",
        weights.hexdigest(),
        dataclasses.asdict(settings),
        views,
        seed,
        code_seeds,
        test.fingerprint,
    ]
    return bench.kept(key, take)


def _floor(test: LoadedSplit, *, points: int, clouds: int) -> float:
    """Mean consistency loss x100 of disjoint random samples of the true clouds; fewer if they run out of points."""
    generator = torch.Generator().manual_seed(0)
    clouds = min(clouds, test.points.shape[1] // points)
    if clouds < 2:
        raise UserError(
            f"the true clouds have {test.points.shape[1]} points, too few for two samples of {points}"
        )
    shuffled = torch.stack([cloud[torch.randperm(len(cloud), generator=generator)] for cloud in test.points])
    return 100 * consistency_loss(shuffled[:, : clouds * points].unflatten(1, (clouds, points))).item()


def _against(found: ShapeMetrics, random: ShapeMetrics) -> dict[str, dict[str, float]]:
    """Change against random codes: mean, and standard error over shapes."""
    changes = {name: (found[name] - random[name]).double().mean(0) for name in _COLUMNS}
    return {
        name: {"mean": change.mean().item(), "standard_error": (change.std() / len(change) ** 0.5).item()}
        for name, change in changes.items()
    }


def _lowered(found: ShapeMetrics) -> float:
    return (found["consistency"] < found["searched"]).double().mean().item()


def _correlation(groups: ShapeMetrics) -> dict[str, dict[str, float]]:
    """Pearson's r of the consistency loss with each error: over groups within a shape, and over shapes."""

    disagreement = groups["consistency"].double()
    found = {}
    for name in _COLUMNS:
        if name == "consistency":
            continue
        error = groups[name].double()
        found[name] = {
            "within_shapes": pearson(disagreement, error).mean().item(),
            "across_shapes": pearson(disagreement.mean(0), error.mean(0)).item(),
        }
    return found


def _markdown(result: dict[str, Any]) -> str:
    header = ["codes", *_COLUMNS.values(), "CD - random", "FPS-CD - random", "lowered"]
    lines = [table_row(header), table_row(["---", *["---:"] * (len(header) - 1)])]
    for name, way in result["ways"].items():
        cells = [f"{way['mean'][column]:.2f}" for column in _COLUMNS]
        for column in ("cd", "fps_cd"):
            change = way["against_random"][column]
            cells.append("" if name == _RANDOM else f"{change['mean']:+.3f} ± {change['standard_error']:.3f}")
        lowered = way["lowered_share"]
        lines.append(table_row([name, *cells, "" if lowered is None else f"{lowered:.1%}"]))
    correlations = [
        table_row(
            ["correlation of disagreement with", "over groups of codes, within a shape", "over shapes"]
        ),
        table_row(["---", "---:", "---:"]),
        *(
            table_row([_COLUMNS[name], f"{r['within_shapes']:+.2f}", f"{r['across_shapes']:+.2f}"])
            for name, r in result["correlation"].items()
        ),
    ]
    spread = max(way["sd_over_seeds"]["cd"] or 0.0 for way in result["ways"].values())
    head = (
        f"{result['shapes']} test shapes, {result['views']} views, codes and views drawn "
        f"{result['seeds']} times; un-squared distances x100. Changes against random codes with their standard error "
        f"over shapes; CD varies between draws by at most {spread:.3f} (sd). Lowered: share of "
        "reconstructions whose consistency loss the descent lowered. Samples of the true shape, as large as one "
        f"prediction, disagree by {result['floor']:.2f}."
    )
    return "\n".join([head, "", *lines, "", *correlations, ""])


def _figure(result: dict[str, Any], groups: ShapeMetrics) -> Figure:
    """Left: what each way does to the error and to the disagreement. Right: both over random groups of codes."""
    figure = Figure(figsize=(12, 4.8), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    ways = result["ways"]
    order = sorted(ways, key=lambda name: ways[name]["mean"]["consistency"])
    disagreement = [ways[name]["mean"]["consistency"] for name in order]
    for column, colour in (("cd", "#1f6f8b"), ("fps_cd", "#c8553d")):
        errors = [ways[name]["mean"][column] for name in order]
        left.plot(disagreement, errors, "o", color=colour, label=_COLUMNS[column])
    left.axvline(result["floor"], color=figures.MUTED, ls=":", label="samples of the true shape")
    left.set(
        xlabel="consistency loss x100", ylabel="chamfer distance x100", title="Every way of choosing codes"
    )
    left.legend(fontsize=9)

    def centred(name: str) -> Tensor:
        return (groups[name] - groups[name].mean(0)).flatten()

    for column, colour in (("cd", "#1f6f8b"), ("fps_cd", "#c8553d")):
        r = result["correlation"][column]["within_shapes"]
        right.plot(
            centred("consistency"), centred(column), ".", ms=3, alpha=0.4, color=colour,
            label=f"{_COLUMNS[column]}, r = {r:+.2f}",
        )  # fmt: skip
    right.set(
        xlabel="consistency loss, less the shape's mean",
        ylabel="error, less the shape's mean",
        title="Groups of random codes",
    )
    right.legend(fontsize=9)
    return figure
