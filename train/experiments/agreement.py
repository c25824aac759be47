"""Search and descent on the codes in detail: how each setting changes the error, and why.

Every setting is measured on the same shapes, views and first random codes. Beside them:

- the lower bound: the consistency loss between random samples of the GROUND TRUTH, as large as one prediction.
  Predictions that all lay on the true surface would still disagree by about that much, because their points do not
  coincide; a descent that goes on makes points coincide, and the joined cloud covers less.
- the correlation of consistency loss and error, over groups of random codes of one shape and over shapes.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import sem

from diffpoint import consistency_loss
from train.config import FitConfig, InferenceConfig, changed_settings
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.per_shape import METRICS, concatenate, evaluate_split, stack_seeds
from train.evaluation.runs import open_run
from train.experiments.correlation import pearson
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.statistics import spreads, transposed
from train.experiments.store import Metrics
from train.experiments.study import Study, unchanged
from train.experiments.table import NAMES
from train.methods.weights import weights_digest
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines

_RANDOM = "random codes"
SETTINGS: dict[str, InferenceConfig] = {
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
GROUPS = 20
_COLUMNS = ("consistency", "gt_to_pred", "pred_to_gt", "cd", "fps_gt_to_pred", "fps_pred_to_gt", "fps_cd")
_COLOURS = {"cd": "#1f6f8b", "fps_cd": "#c8553d"}


class _Measurement(NamedTuple):
    """How codes are chosen, views per shape, the seed of views and codes, and seeds that draw other codes."""

    settings: InferenceConfig
    views: int
    seed: int
    code_seeds: tuple[int | None, ...] = (None,)


def _config(study: Study) -> FitConfig:
    return study.config(unchanged, seed=0)


def make(study: Study) -> Outcome:
    """Errors with every setting, on `study.run`, or on our method's network, trained with the first seed.

    Raises:
        UserError: no such run, one without codes, or numbers out of range.
    """
    run = study.train(_config(study)) if study.run is None else study.run
    opened = open_run(run)
    model, config, views = opened.model, opened.config, study.views
    if not model.takes_codes:
        raise UserError(f"{run} takes no codes: there are none to search for")
    test = study.split(config, "test")
    if not 2 <= views <= test.views:
        raise UserError(
            f"--views must be between 2 and the {test.views} that {study.test_tree} has; got {views}"
        )
    if len(test) < 2:
        raise UserError(f"one test shape has no spread; {study.test_tree} must give at least 2")

    wanted = {
        name: [_Measurement(each, views, seed) for seed in range(study.seeds)]
        for name, each in SETTINGS.items()
    }
    code_seeds = [tuple(range(first, first + GROUPS)) for first in range(1, 1 + GROUPS * study.seeds, GROUPS)]
    wanted["groups"] = [_Measurement(SETTINGS[_RANDOM], views, 0, seeds) for seeds in code_seeds]
    everything = list(itertools.chain(*wanted.values()))
    study.measure_all(_measured, [(run, each) for each in everything])
    bar = progress_bar(everything, title="settings", unit="measurement", progress=study.progress)
    found = {each: _measured(study, run, each) for each in bar}
    arrays = {
        name: {
            metric: each.double().numpy() for metric, each in concatenate([found[e] for e in every]).items()
        }
        for name, every in wanted.items()
    }
    groups = arrays.pop("groups")
    result: dict[str, Any] = (
        study.about(config)
        | {
            "profile": config.profile,  # of the run, whatever the study would train
            "run": str(run),
            "shapes": len(test),
            "fingerprint": test.fingerprint,
            "views": views,
            "floor": _floor(test, points=model.points, clouds=views),
            "ways": {name: _summary(each, arrays[_RANDOM], SETTINGS[name]) for name, each in arrays.items()},
            "correlation": {name: _correlation(groups["consistency"], groups[name]) for name in _COLUMNS[1:]},
        }
    )
    return Outcome(result, markdown(result), {"": _figure(result, groups)})


agreement = Experiment(
    make,
    lambda study: [_config(study)] if study.run is None else [],
    lambda study: [] if (study.run, study.views) == (None, 8) else [str(study.run), str(study.views)],
)


def _measured(study: Study, run: Path, what: _Measurement) -> Metrics:
    """Metric -> (C, M) for each draw of codes and each shape, measured now or kept."""
    opened = open_run(run, device=study.device)
    test = study.split(opened.config, "test")
    settings, views, seed, code_seeds = what

    def measure() -> Metrics:
        evaluate = functools.partial(
            evaluate_split, opened.model, study.on_device(test), settings, views=views, seed=seed
        )
        return stack_seeds([evaluate(code_seed=draw) for draw in code_seeds])

    # The name of a run is not enough: any run can be given, and one that trains on gets other weights.
    parts = [changed_settings(settings), views, seed, code_seeds, test.fingerprint]
    return study.kept(["agreement", weights_digest(opened.model), *parts], measure)


def _floor(test: LoadedSplit, *, points: int, clouds: int) -> float:
    """Mean consistency loss x100 of disjoint random samples of the ground truth; fewer if it has too few points."""
    generator = torch.Generator().manual_seed(0)
    clouds = min(clouds, test.points.shape[1] // points)
    if clouds < 2:
        raise UserError(
            f"the ground-truth clouds have {test.points.shape[1]} points, too few for two samples of {points}"
        )
    shuffled = torch.stack([cloud[torch.randperm(len(cloud), generator=generator)] for cloud in test.points])
    return 100 * consistency_loss(shuffled[:, : clouds * points].unflatten(1, (clouds, points))).item()


def _summary(
    found: Mapping[str, np.ndarray], random: Mapping[str, np.ndarray], settings: InferenceConfig
) -> dict:
    """A setting's means, their spread over draws, and the change against random codes with its standard error."""
    by_draw = transposed(spreads({name: found[name] for name in METRICS if name in found}))
    changes = {name: (found[name] - random[name]).mean(0) for name in _COLUMNS}
    return {
        "settings": dataclasses.asdict(settings),
        "mean": by_draw["mean"],
        "sd_over_seeds": by_draw["sd"],
        "against_random": {
            name: {"mean": float(change.mean()), "standard_error": float(sem(change))}
            for name, change in changes.items()
        },
        "lowered_share": (found["consistency"] < found["searched"]).mean().item() if settings.steps else None,
        "code_norm": found["code_norm"].mean().item(),
    }


def _correlation(loss: np.ndarray, error: np.ndarray) -> dict[str, float]:
    """Pearson's r of consistency loss and error (draws, M): over groups of codes within a shape, and over shapes."""
    return {
        "within_shapes": pearson(loss.T, error.T).mean().item(),
        "across_shapes": pearson(loss.mean(0), error.mean(0)).item(),
    }


def markdown(result: Mapping[str, Any]) -> str:
    """A line for every setting; correlations."""
    sd = max(each["sd_over_seeds"]["cd"] or 0.0 for each in result["ways"].values())
    head = (
        f"{result['shapes']} test shapes, {result['views']} views, codes and views drawn "
        f"{result['seeds']} times; un-squared distances x100. Changes against random codes with their standard error "
        f"over shapes; CD varies between draws by at most {sd:.3f} (sd). Lowered: share of "
        "reconstructions whose consistency loss the descent lowered. Samples of the ground truth, as large as one "
        f"prediction, have a consistency loss of {result['floor']:.2f}."
    )
    rows = []
    for name, each in result["ways"].items():
        cells = [f"{each['mean'][column]:.2f}" for column in _COLUMNS]
        for column in ("cd", "fps_cd"):
            change = each["against_random"][column]
            cells.append("" if name == _RANDOM else f"{change['mean']:+.3f} ± {change['standard_error']:.3f}")
        lowered = each["lowered_share"]
        rows.append([name, *cells, "" if lowered is None else f"{lowered:.1%}"])
    titles = ["codes", *(NAMES[name] for name in _COLUMNS), "CD - random", "FPS-CD - random", "lowered"]
    correlations = [
        [NAMES[name], f"{r['within_shapes']:+.2f}", f"{r['across_shapes']:+.2f}"]
        for name, r in result["correlation"].items()
    ]
    heads = ["correlation of consistency loss with", "over groups of codes, within a shape", "over shapes"]
    return markdown_page(head, markdown_lines(titles, rows), markdown_lines(heads, correlations))


def _figure(result: Mapping[str, Any], groups: Mapping[str, np.ndarray]) -> Figure:
    """Left: error against consistency loss of each setting. Right: both over random groups of codes."""
    figure = Figure(figsize=(12, 4.8), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    means = transposed({name: each["mean"] for name, each in result["ways"].items()})
    centred = {name: (values - values.mean(0)).flatten() for name, values in groups.items()}
    for column, colour in _COLOURS.items():
        x, y = (list(means[name].values()) for name in ("consistency", column))
        left.plot(x, y, "o", color=colour, label=NAMES[column])
        words = f"{NAMES[column]}, r = {result['correlation'][column]['within_shapes']:+.2f}"
        x, y = centred["consistency"], centred[column]
        right.plot(x, y, ".", ms=3, alpha=0.4, color=colour, label=words)
    left.axvline(result["floor"], color=figures.MUTED, ls=":", label="samples of the ground truth")
    left.set(xlabel="consistency loss x100", ylabel="chamfer distance x100", title="Every setting")
    loss, error = "consistency loss, less the shape's mean", "error, less the shape's mean"
    right.set(xlabel=loss, ylabel=error, title="Groups of random codes")
    for axes in (left, right):
        axes.legend(fontsize=9)
    return figure
