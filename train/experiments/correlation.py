"""Does disagreement tell the error? Consistency loss and chamfer distance, over shapes and over groups of codes.

Over shapes: is a shape whose predictions disagree reconstructed worse? Within a shape: among random groups of codes
for the same images, does the group that disagrees less come closer to the truth? A search relies on the second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import rankdata
from torch import Tensor

from train.config import InferenceConfig
from train.evaluation.per_shape import ShapeMetrics, stack_seeds
from train.experiments.table import NAMES, table_lines, trainings, verdict
from train.experiments.workbench import Workbench, as_it_is
from train.show import figures

VIEWS = 8
GROUPS = 20
LEAST_OVER_SHAPES = 0.3
"""The correlation over shapes that is asked for; within shapes it is any above 0."""
_RESAMPLES = 2000
_ERRORS = ("cd", "fps_cd", "gt_to_pred", "pred_to_gt")
_SHOWN_WITHIN = 6


def correlation(bench: Workbench) -> dict[str, Any]:
    """Correlates disagreement with error for our system's networks; writes correlation.json, .md and .png.

    Over shapes, the codes are agreed on as the profile does it, and once more random (the mean over all groups). Within
    shapes: 20 groups of random codes for each shape, the same images.

    Returns:
        What correlation.json holds; for each figure "pearson" and "spearman" with their value by seed, mean, standard
        deviation over seeds, a 90 % interval of the mean by bootstrap over shapes, and the bootstrap's share above what
        is asked for.
    """
    config = bench.config(as_it_is, seed=0)
    bench.train_all(bench.configs(as_it_is))
    views = min(VIEWS, bench.split(config, "test").views)
    seeds = range(bench.seeds)
    bench.measure_all(_measured, [(seed, views, group) for seed in seeds for group in (None, *range(GROUPS))])
    agreed = [_measured(bench, seed, views, None) for seed in seeds]
    groups = [
        stack_seeds([_measured(bench, seed, views, group) for group in range(GROUPS)]) for seed in seeds
    ]
    result = bench.about(bench.config(as_it_is, seed=0)) | {
        "shapes": agreed[0]["cd"].shape[0],
        "views": views,
        "groups": GROUPS,
        "over_shapes": _correlations(agreed, over_shapes, least=LEAST_OVER_SHAPES),
        "over_shapes_random": _correlations(
            [{name: values.mean(0) for name, values in found.items()} for found in groups],
            over_shapes,
            least=LEAST_OVER_SHAPES,
        ),
        "within_shapes": _correlations(groups, within_shapes, least=0.0),
    }
    result["claims"] = _claims(result)
    bench.publish("correlation", result, _markdown(result), _figure(result, agreed[0], groups[0]))
    return result


def _measured(bench: Workbench, seed: int, views: int, group: int | None) -> ShapeMetrics:
    """A training's figures with a group of random codes, or, without a number, with the codes that are agreed on."""
    config = bench.config(as_it_is, seed=seed)
    if group is None:
        return bench.scores(config, config.inference, views=views)
    random = InferenceConfig(groups=1, steps=0)
    return bench.scores(config, random, views=views, code_seed=1 + group)


def _claims(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The paper's figure in words: disagreement and error go together, over shapes and within them."""
    words = {
        "over_shapes": f"CD and disagreement, over shapes: rank correlation above {LEAST_OVER_SHAPES}",
        "within_shapes": "CD and disagreement, over groups of codes of a shape: rank correlation above 0",
    }
    return [
        {
            "words": text,
            "gain": result[question]["cd"]["spearman"]["mean"] - result[question]["cd"]["spearman"]["asked"],
            "confidence": result[question]["cd"]["spearman"]["confidence"],
            "verdict": verdict(result[question]["cd"]["spearman"]["confidence"]),
        }
        for question, text in words.items()
    ]


def pearson(a: Tensor, b: Tensor) -> Tensor:
    """Pearson's r along the first dimension; 0 where one of both does not vary.

    Example:
        >>> pearson(torch.tensor([1.0, 2, 3]), torch.tensor([2.0, 4, 6])).item()
        1.0
    """
    a, b = a - a.mean(0), b - b.mean(0)
    return ((a * b).sum(0) / (a.square().sum(0) * b.square().sum(0)).sqrt().clamp(min=1e-12)).clamp(-1, 1)


def spearman(a: Tensor, b: Tensor) -> Tensor:
    """Spearman's rho along the first dimension: Pearson's r of the ranks, of which ties share the mean.

    Example:
        >>> spearman(torch.tensor([1.0, 2, 3]), torch.tensor([1.0, 10, 1000])).item()
        1.0
    """
    ranks = (torch.from_numpy(np.asarray(rankdata(x.numpy(), axis=0), np.float64)) for x in (a, b))
    return pearson(*ranks)


Measure = Callable[[Tensor, Tensor], Tensor]
_COEFFICIENTS: dict[str, Measure] = {"pearson": pearson, "spearman": spearman}


def over_shapes(coefficient: Measure, disagreement: Tensor, error: Tensor) -> float:
    """The coefficient over shapes (M,)."""
    return coefficient(disagreement, error).item()


def within_shapes(coefficient: Measure, disagreement: Tensor, error: Tensor) -> float:
    """The coefficient over groups (G, M), mean over shapes."""
    return coefficient(disagreement, error).mean().item()


def _correlations(
    by_seed: list[ShapeMetrics], measured: Callable[[Measure, Tensor, Tensor], float], *, least: float
) -> dict[str, dict[str, Any]]:
    """Error -> coefficient -> figures; shapes are the last dimension of all scores."""
    found: dict[str, dict[str, Any]] = {}
    for error in _ERRORS:
        found[error] = {}
        for name, coefficient in _COEFFICIENTS.items():
            values = [measured(coefficient, s["consistency"].double(), s[error].double()) for s in by_seed]
            drawn = _bootstrap(by_seed, error, coefficient, measured)
            found[error][name] = {
                "by_seed": values,
                "mean": float(np.mean(values)),
                "sd": float(np.std(values, ddof=1)) if len(values) > 1 else None,
                "interval": [float(q) for q in np.quantile(drawn, (0.05, 0.95))],
                "asked": least,
                "confidence": float((drawn > least).mean()),
            }
    return found


def _bootstrap(
    by_seed: list[ShapeMetrics],
    error: str,
    coefficient: Measure,
    measured: Callable[[Measure, Tensor, Tensor], float],
) -> np.ndarray:
    """Means over drawn trainings of the coefficient over drawn shapes."""
    random = np.random.default_rng(0)
    disagreement = [scores["consistency"].double() for scores in by_seed]
    errors = [scores[error].double() for scores in by_seed]
    shapes = errors[0].shape[-1]
    if measured is within_shapes:  # a shape's own coefficient does not depend on the others
        each = torch.stack([coefficient(a, b) for a, b in zip(disagreement, errors, strict=True)]).numpy()
        return np.array([
            each[random.integers(len(each), size=len(each))][:, random.integers(shapes, size=shapes)].mean()
            for _ in range(_RESAMPLES)
        ])  # fmt: skip
    drawn = np.empty((_RESAMPLES, len(by_seed)))
    columns = torch.from_numpy(random.integers(shapes, size=(shapes, _RESAMPLES)))
    for seed, (a, b) in enumerate(zip(disagreement, errors, strict=True)):
        drawn[:, seed] = coefficient(a[columns], b[columns]).numpy()
    picked = random.integers(len(by_seed), size=drawn.shape)
    return np.take_along_axis(drawn, picked, axis=1).mean(1)


_QUESTIONS = {
    "over_shapes": "over shapes, agreed codes",
    "over_shapes_random": "over shapes, random codes",
    "within_shapes": "within a shape, over groups of random codes",
}


def _markdown(result: Mapping[str, Any]) -> str:
    head = (
        f"Consistency loss and error of {result['shapes']} held-out shapes from {result['views']} views, profile "
        f"`{result['profile']}`, {trainings(result['seeds'])}; {result['groups']} groups of random "
        "codes. Mean ± standard deviation over trainings; "
        "in brackets the 90 % interval by bootstrap over trainings and shapes, and its share above "
        f"what is asked for: {LEAST_OVER_SHAPES} over shapes, 0 within shapes."
    )
    rows = []
    for question, words in _QUESTIONS.items():
        for error in _ERRORS:
            found = result[question][error]
            rows.append([f"{NAMES[error]}, {words}", *(_cell(found[name]) for name in _COEFFICIENTS)])
    return "\n".join([head, "", *table_lines(["", "Pearson", "Spearman"], rows), ""])


def _cell(found: Mapping[str, Any]) -> str:
    spread = "" if found["sd"] is None else f" ± {found['sd']:.2f}"
    low, high = found["interval"]
    return f"{found['mean']:+.2f}{spread} ({low:+.2f} to {high:+.2f}; {found['confidence']:.0%})"


def _figure(result: Mapping[str, Any], agreed: ShapeMetrics, groups: ShapeMetrics) -> Figure:
    """The first training's scatter: every shape; and the groups of every shape, of which a few are coloured."""
    figure = Figure(figsize=(12.5, 5.2), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    r, rho = (result["over_shapes"]["cd"][name]["by_seed"][0] for name in _COEFFICIENTS)
    left.plot(agreed["consistency"], agreed["cd"], "o", ms=4.5, alpha=0.6, mew=0, color="#1f6f8b")
    left.set(
        title=f"Every shape, agreed codes\nr = {r:+.2f}, rho = {rho:+.2f}",
        xlabel="consistency loss x100", ylabel="chamfer distance to the truth x100",
    )  # fmt: skip
    x, y = ((groups[name] - groups[name].mean(0)).double() for name in ("consistency", "cd"))
    r, rho = (result["within_shapes"]["cd"][name]["by_seed"][0] for name in _COEFFICIENTS)
    right.plot(x.flatten(), y.flatten(), ".", ms=3.5, alpha=0.25, mew=0, color="#1f6f8b")
    colours = ("#c8553d", "#8a6d9e", "#dd9f63", "#5a9367", "#3d1f0c", "#0b2545")
    shown = x.std(0).argsort(descending=True)[:_SHOWN_WITHIN]
    for shape, colour in zip(shown.tolist(), colours, strict=False):
        right.plot(x[:, shape], y[:, shape], "o", ms=4.5, color=colour, mew=0)
    right.axhline(0, color=figures.MUTED, lw=0.6)
    right.axvline(0, color=figures.MUTED, lw=0.6)
    right.set(
        title=f"{result['groups']} groups of random codes of each shape\nmean r = {r:+.2f}, rho = {rho:+.2f}",
        xlabel="consistency loss x100, less the shape's mean\n(coloured: the shapes whose groups differ most)",
        ylabel="chamfer distance x100, less the shape's mean",
    )  # fmt: skip
    for axes in (left, right):
        figures.plain(axes)
    several = f"; shown: seed 0 of {result['seeds']}" if result["seeds"] > 1 else ", seed 0"
    figure.suptitle(
        f"Does disagreement tell the error? {result['shapes']} held-out shapes, {result['views']} views{several}",
        fontsize=11,
    )
    return figure
