"""Training with and without the latent critic: a table, and the critic's output during training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure

from train.config import FitConfig
from train.evaluation.runs import read_metrics
from train.experiments.frame import Experiment, Outcome
from train.experiments.paper import TABLES, with_critic
from train.experiments.statistics import trainings
from train.experiments.store import Metrics
from train.experiments.study import Study
from train.experiments.table import figure, markdown, tabulate
from train.show import figures

_PARTS = 10


def make(study: Study) -> Outcome:
    """The table, and in "critic_output" for each training the mean output for predictions ("fake") and for real shapes
    in ten equal parts of its steps."""
    configs = study.configs(with_critic)
    result = tabulate(TABLES["critic"], study)
    study.train_all([c for c in configs if study.first_missing(lambda s, c=c: _output(s, c))])
    outputs = [_output(study, config) for config in configs]
    result["critic_output"] = [
        {
            name: [part.mean().item() for part in output[f"{name}_score"].tensor_split(_PARTS) if len(part)]
            for name in ("fake", "real")
        }
        for output in outputs
    ]
    return Outcome(result, markdown(result), {"": figure(result), "-outputs": _outputs_figure(outputs)})


critic = Experiment(make, TABLES["critic"].trainings)


def _output(study: Study, config: FitConfig) -> Metrics:
    """A critic at every logged step, (K,): "step", "stage", its mean output for predictions and for real shapes."""

    def read() -> Metrics:
        records = [record for record in read_metrics(study.train(config)) if "fake_score" in record]
        names = ("step", "stage", "fake_score", "real_score")
        return {name: torch.tensor([record[name] for record in records]).double() for name in names}

    return study.kept(["critic output", *study.weights_key(config)], read)


def _outputs_figure(outputs: Sequence[Metrics]) -> Figure:
    """Left: output for predictions and for real shapes; right: their difference. A line for each training."""
    drawn = Figure(figsize=(12, 4.4), layout="constrained", dpi=110)
    left, right = drawn.subplots(1, 2)
    for number, output in enumerate(outputs):
        values = {name: each.double().numpy() for name, each in output.items()}
        smooth = {name: figures.running_mean(values[name], share=25) for name in ("fake_score", "real_score")}
        for name, label, colour in (
            ("real_score", "real shapes", "#a4562a"),
            ("fake_score", "predictions", "#1f6f8b"),
        ):
            left.plot(values["step"], smooth[name], color=colour, lw=1.3, label=None if number else label)
        right.plot(values["step"], smooth["fake_score"] - smooth["real_score"], color="#1f6f8b", lw=1.3)
        for axes in (left, right):
            for border in values["step"][1:][np.diff(values["stage"]) > 0]:
                axes.axvline(border, color=figures.MUTED, lw=0.8, ls="--")
    left.set(title="Output of the critic", xlabel="step (dashed: stage 2 begins)", ylabel="mean over a batch")
    left.legend(fontsize=9)
    right.axhline(0, color=figures.MUTED, lw=0.8)
    right.set(title="Difference", xlabel="step", ylabel="predictions - real shapes")
    for axes in (left, right):
        figures.plain(axes)
    drawn.suptitle(f"{trainings(len(outputs))}, running means", fontsize=11)
    return drawn
