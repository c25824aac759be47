"""Does the latent critic pay? A table, and what the critic thought while the generator learned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from train import figures
from train.experiments.paper import CRITIC, with_critic
from train.experiments.table import make, trainings
from train.experiments.workbench import Workbench
from train.files import write_text
from train.log import read_metrics

_PARTS = 10


def critic(bench: Workbench) -> dict[str, Any]:
    """Makes the table; adds what the critics thought, to critic.json and as critic-scores.png.

    Returns:
        What critic.json holds; "opinion" has for each training the mean scores of predictions and of real shapes in ten
        equal parts of its steps.
    """
    result = make(CRITIC, bench)
    runs = [bench.train(bench.config(with_critic, seed=seed)) for seed in range(bench.seeds)]
    result["opinion"] = [_opinion(run) for run in runs]
    write_text(bench.out / "critic.json", json.dumps(result, indent=2) + "\n")
    figures.save(_figure(runs), bench.out / "critic-scores.png")
    return result


def _judged(run: Path) -> dict[str, np.ndarray]:
    records = [record for record in read_metrics(run) if "fake_score" in record]
    return {
        name: np.array([record[name] for record in records])
        for name in ("step", "fake_score", "real_score", "stage")
    }


def _opinion(run: Path) -> dict[str, list[float]]:
    judged = _judged(run)
    return {
        name: [float(part.mean()) for part in np.array_split(judged[f"{name}_score"], _PARTS) if part.size]
        for name in ("fake", "real")
    }


def _figure(runs: list[Path]) -> Figure:
    """Left: scores of predictions and of real shapes; right: how far predictions are behind. A line a training."""
    figure = Figure(figsize=(12, 4.4), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    for number, run in enumerate(runs):
        judged = _judged(run)
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
    figure.suptitle(f"{trainings(len(runs))}, running means", fontsize=11)
    return figure
