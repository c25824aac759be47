"""Correlation of the consistency loss with the error, over shapes and over groups of codes.

Over shapes: do shapes whose predictions disagree have larger errors? Within a shape: of several groups of random codes
for the same images, is the group with the smaller loss closer to the ground truth? The search for codes relies on the
second.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import rankdata

from train.config import InferenceConfig
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.statistics import LEVEL, claim, interval, resampled_means, spread, stacked, trainings
from train.experiments.store import Metrics
from train.experiments.study import Study, unchanged
from train.experiments.table import NAMES
from train.show import figures
from train.show.tables import markdown_lines

VIEWS = 8
GROUPS = 20
_RESAMPLES = 2000
_ERRORS = ("cd", "fps_cd", "gt_to_pred", "pred_to_gt")
_COLOURED = 6
_WORDS = {
    "over_shapes": "over shapes, agreed codes",
    "over_shapes_random": "over shapes, random codes",
    "within_shapes": "within a shape, over groups of random codes",
}
_LEAST = {"over_shapes": ("over shapes", 0.3), "within_shapes": ("over groups of codes of a shape", 0)}
"""Claimed: Spearman's rho of CD and consistency loss is above this."""

Arrays = Mapping[str, np.ndarray]


def make(study: Study) -> Outcome:
    """For each of `_WORDS`, error and coefficient: mean and spread over trainings, and an interval by bootstrap.

    Over shapes, the codes are agreed on as the profile does it, or random (the mean over all groups). Within shapes: 20
    groups of random codes for each shape, with the same images.
    """
    configs = study.configs(unchanged)
    study.train_all(configs)
    views = min(VIEWS, study.split(configs[0], "test").views)
    seeds = range(study.seeds)
    study.measure_all(_measured, [(seed, views, group) for seed in seeds for group in (None, *range(GROUPS))])
    agreed = stacked([_measured(study, seed, views, None) for seed in seeds])
    groups = [stacked([_measured(study, seed, views, group) for group in range(GROUPS)]) for seed in seeds]
    together = {name: np.stack([each[name].T for each in groups]) for name in groups[0]}  # each (S, M, G)
    values = {
        "over_shapes": agreed,
        "over_shapes_random": {name: each.mean(2) for name, each in together.items()},
        "within_shapes": together,
    }
    found = {level: {error: {} for error in _ERRORS} for level in _WORDS}
    claims = []
    for (level, arrays), error in itertools.product(values.items(), _ERRORS):
        for name, coefficient in COEFFICIENTS.items():
            by_seed, means = correlate(arrays["consistency"], arrays[error], coefficient)
            found[level][error][name] = spread(by_seed) | {"interval": interval(means)}
            if level in _LEAST and (error, name) == ("cd", "spearman"):
                words, least = _LEAST[level]
                words = f"CD and consistency loss, {words}: rank correlation above {least}"
                claims.append(claim(words, by_seed[:, None] - least, means=means - least))
    result = study.about(configs[0]) | {
        "shapes": agreed["cd"].shape[1],
        "views": views,
        "groups": GROUPS,
        "level": LEVEL,
        **found,
        "claims": claims,
    }
    return Outcome(result, markdown(result), {"": _figure(result, agreed, groups[0])})


correlation = Experiment(make, lambda study: study.configs(unchanged))


def _measured(study: Study, seed: int, views: int, group: int | None) -> Metrics:
    """The metrics of a training with a group of random codes, or, without a number, with agreed codes."""
    config = study.config(unchanged, seed=seed)
    if group is None:
        return study.reconstruction_metrics(config, config.inference, views=views)
    random = InferenceConfig(groups=1, steps=0)
    return study.reconstruction_metrics(config, random, views=views, code_seed=1 + group)


def pearson(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pearson's r along the last dimension; 0 where one of both does not vary.

    Example:
        >>> float(pearson(np.array([1.0, 2, 3]), np.array([2.0, 4, 6])).round(6))
        1.0
    """
    a, b = a - a.mean(-1, keepdims=True), b - b.mean(-1, keepdims=True)
    product = np.sqrt((a * a).sum(-1) * (b * b).sum(-1))
    return np.clip((a * b).sum(-1) / np.maximum(product, 1e-12), -1, 1)


def spearman(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Spearman's rho along the last dimension: Pearson's r of the ranks, of which ties share the mean.

    Example:
        >>> float(spearman(np.array([1.0, 2, 3]), np.array([1.0, 10, 1000])).round(6))
        1.0
    """
    return pearson(rankdata(a, axis=-1), rankdata(b, axis=-1))


COEFFICIENTS = {"pearson": pearson, "spearman": spearman}


def correlate(
    a: np.ndarray, b: np.ndarray, coefficient: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The coefficient of two metrics by training, and bootstrap means of it over trainings and shapes.

    Args:
        a: (S, M) over trainings and shapes; or (S, M, G) over groups of codes, within each shape.
        b: the other metric.
        coefficient: `pearson` or `spearman`.

    Returns:
        (S,) over the shapes, or within shapes and then the mean over shapes; and (R,) bootstrap means.
    """
    if a.ndim == 3:  # the coefficient of a shape does not depend on the others
        within = coefficient(a, b)
        return within.mean(1), resampled_means(within)
    random = np.random.default_rng(0)
    trainings, shapes = a.shape
    columns = random.integers(shapes, size=(_RESAMPLES, shapes))
    drawn = np.stack([coefficient(x[columns], y[columns]) for x, y in zip(a, b, strict=True)])
    picked = random.integers(trainings, size=drawn.shape)
    return coefficient(a, b), np.take_along_axis(drawn, picked, axis=0).mean(0)


def markdown(result: Mapping[str, Any]) -> str:
    """A table of all coefficients."""
    head = (
        f"Consistency loss and error of {result['shapes']} held-out shapes from {result['views']} views, profile "
        f"`{result['profile']}`, {trainings(result['seeds'])}; {result['groups']} groups of random codes. Mean ± "
        f"standard deviation over trainings; in brackets the {result['level']:.0%} interval by bootstrap over "
        "trainings and shapes."
    )
    rows = [
        [f"{NAMES[error]}, {words}", *(_cell(result[level][error][name]) for name in COEFFICIENTS)]
        for level, words in _WORDS.items()
        for error in _ERRORS
    ]
    return markdown_page(head, markdown_lines(["", "Pearson", "Spearman"], rows))


def _cell(found: Mapping[str, Any]) -> str:
    sd = "" if found["sd"] is None else f" ± {found['sd']:.2f}"
    low, high = found["interval"]
    return f"{found['mean']:+.2f}{sd} [{low:+.2f}, {high:+.2f}]"


def _figure(result: Mapping[str, Any], agreed: Arrays, groups: Arrays) -> Figure:
    """The first training: every shape; and the groups of every shape, of which a few are coloured."""
    figure = Figure(figsize=(12.5, 5.2), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    r, rho = (result["over_shapes"]["cd"][name]["by_seed"][0] for name in COEFFICIENTS)
    left.plot(agreed["consistency"][0], agreed["cd"][0], "o", ms=4.5, alpha=0.6, mew=0, color="#1f6f8b")
    left.set(
        title=f"Every shape, agreed codes\nr = {r:+.2f}, rho = {rho:+.2f}",
        xlabel="consistency loss x100", ylabel="chamfer distance to the ground truth x100",
    )  # fmt: skip
    x, y = (groups[name] - groups[name].mean(0) for name in ("consistency", "cd"))
    r, rho = (result["within_shapes"]["cd"][name]["by_seed"][0] for name in COEFFICIENTS)
    right.plot(x.flatten(), y.flatten(), ".", ms=3.5, alpha=0.25, mew=0, color="#1f6f8b")
    colours = ("#c8553d", "#8a6d9e", "#dd9f63", "#5a9367", "#3d1f0c", "#0b2545")
    for shape, colour in zip(x.std(0).argsort()[::-1][:_COLOURED], colours, strict=False):
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
    words = (
        f"Consistency loss and error: {result['shapes']} held-out shapes, {result['views']} views{several}"
    )
    figure.suptitle(words, fontsize=11)
    return figure
