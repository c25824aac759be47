"""Does the latent critic pay? A table, and what the critic thought while the generator learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from train.config import FitConfig
from train.evaluation.per_shape import ShapeMetrics
from train.evaluation.runs import read_metrics
from train.experiments.paper import CRITIC, with_critic
from train.experiments.table import figure, markdown, tabulate, trainings
from train.experiments.workbench import Workbench
from train.show import figures

_PARTS = 10


def critic(bench: Workbench) -> dict[str, Any]:
    """Makes the table, with what the critics thought in critic.json and as critic-scores.png.

    Returns:
        What critic.json holds; "opinion" has for each training the mean scores of predictions and of real shapes in ten
        equal parts of its steps.
    """
    configs = bench.configs(with_critic)
    result = tabulate(CRITIC, bench)
    bench.train_all([c for c in configs if not bench.has(lambda asked, c=c: _opinion(asked, c))])
    opinions = [_opinion(bench, config) for config in configs]
    result["opinion"] = [_in_parts(opinion) for opinion in opinions]
    bench.publish("critic", result, markdown(result), figure(result))
    figures.save(_scores_figure(opinions), bench.out / "critic-scores.png")
    return result


def _opinion(bench: Workbench, config: FitConfig) -> ShapeMetrics:
    """A critic at every logged step, (K,): "step", "stage", its mean scores of predictions and of real shapes."""

    def take() -> ShapeMetrics:
        records = [record for record in read_metrics(bench.train(config)) if "fake_score" in record]
        names = ("step", "stage", "fake_score", "real_score")
        return {name: torch.tensor([record[name] for record in records]).double() for name in names}

    return bench.kept(["the critic's opinion", bench.run_of(config).name], take)


def _in_parts(opinion: ShapeMetrics) -> dict[str, list[float]]:
    return {
        name: [part.mean().item() for part in opinion[f"{name}_score"].tensor_split(_PARTS) if len(part)]
        for name in ("fake", "real")
    }


def _scores_figure(opinions: Sequence[ShapeMetrics]) -> Figure:
    """Left: scores of predictions and of real shapes; right: how far predictions are behind. A line a training."""
    drawn = Figure(figsize=(12, 4.4), layout="constrained", dpi=110)
    left, right = drawn.subplots(1, 2)
    for number, opinion in enumerate(opinions):
        judged = {name: values.numpy() for name, values in opinion.items()}
        smooth = {name: figures.running_mean(judged[name], share=25) for name in ("fake_score", "real_score")}
        for name, label, colour in (
            ("real_score", "real shapes", "#a4562a"),
            ("fake_score", "predictions", "#1f6f8b"),
        ):
            left.plot(judged["step"], smooth[name], color=colour, lw=1.3, label=None if number else label)
        right.plot(judged["step"], smooth["fake_score"] - smooth["real_score"], color="#1f6f8b", lw=1.3)
        borders = judged["step"][1:][np.diff(judged["stage"]) > 0]
        for axes in (left, right):
            for border in borders:
                axes.axvline(border, color=figures.MUTED, lw=0.8, ls="--")
    left.set(title="What the critic gives", xlabel="step (dashed: stage 2 begins)", ylabel="mean score")
    left.legend(fontsize=9)
    right.axhline(0, color=figures.MUTED, lw=0.8)
    right.set(
        title="How far predictions are behind", xlabel="step", ylabel="their score - that of real shapes"
    )
    for axes in (left, right):
        figures.plain(axes)
    drawn.suptitle(f"{trainings(len(opinions))}, running means", fontsize=11)
    return drawn
