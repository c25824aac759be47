"""A table of the paper as a declaration: which systems, scored how, and which of them should be better.

`make` trains what is missing, scores it, and writes NAME.json, NAME.md and NAME.png. Every expectation ("a below b")
gets a paired bootstrap over shapes and seeds and a verdict in words.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from train import figures
from train.config import FitConfig, InferenceConfig
from train.experiments.workbench import Change, Workbench, as_it_is
from train.files import write_text
from train.scoring import Scores

NAMES = {
    "gt_to_pred": "GT->pred",
    "pred_to_gt": "pred->GT",
    "cd": "CD",
    "fps_cd": "FPS-CD",
    "emd": "EMD",
    "consistency": "consistency",
}
_RESAMPLES = 4000
_SURE = 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A system, or an answer without one, and how it is scored.

    Attributes:
        name: as the table shows it.
        change: how its training differs from the profile's.
        stage: whose best weights are scored.
        codes: "agreed" on by search and descent as the profile does it, "searched" only, or "random".
        views: how many.
        answer: "network", or what is answered instead.
        paper: the paper's figures.
    """

    name: str
    change: Change = as_it_is
    stage: Literal[1, 2] = 2
    codes: Literal["agreed", "searched", "random"] = "agreed"
    views: int = 8
    answer: Literal["network", "medoid", "nearest image"] = "network"
    paper: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def scores(self, bench: Workbench, *, seed: int) -> Scores:
        """Figure -> (M,)."""
        config = bench.config(self.change, seed=seed)
        if self.answer != "network":
            return bench.trivial_scores(self.answer, config, views=self.views)
        settings = config.inference
        if self.codes == "searched":
            settings = dataclasses.replace(settings, steps=0)
        if self.codes == "random":
            settings = InferenceConfig(groups=1, steps=0)
        return bench.scores(config, settings, stage=self.stage, views=self.views)


@dataclasses.dataclass(frozen=True)
class Expectation:
    """The paper says: this figure is lower in one row than in another."""

    figure: str
    lower: str
    higher: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """One table.

    Attributes:
        name: of its files.
        title: what it asks, in a line.
        rows: from top to bottom.
        expectations: what the paper's table shows.
        columns: figures of `train.scoring.FIGURES`.
    """

    name: str
    title: str
    rows: tuple[Row, ...]
    expectations: tuple[Expectation, ...] = ()
    columns: tuple[str, ...] = ("gt_to_pred", "pred_to_gt", "cd", "fps_cd")

    def configs(self, bench: Workbench) -> list[FitConfig]:
        """Every training that the table needs, each once, seed by seed."""
        found: dict[Path, FitConfig] = {}
        for seed in range(bench.seeds):
            for row in self.rows:
                config = bench.config(row.change, seed=seed)
                found.setdefault(bench.run_of(config), config)
        return list(found.values())


def make(table: Table, bench: Workbench) -> dict[str, Any]:
    """Trains and scores what is missing, and writes the table into `bench.out`.

    Returns:
        What NAME.json holds.
    """
    bench.train_all(table.configs(bench))
    scores = {
        row.name: _stacked([row.scores(bench, seed=seed) for seed in range(bench.seeds)])
        for row in table.rows
    }
    config = bench.config(table.rows[0].change, seed=0)
    result: dict[str, Any] = {
        "title": table.title,
        "profile": bench.profile,
        "data": [str(root) for root in bench.data],
        "shapes": next(iter(scores.values()))["cd"].shape[1],
        "seeds": bench.seeds,
        "config": dataclasses.asdict(config),
        "rows": {row.name: _figures(row, scores[row.name], table.columns) for row in table.rows},
        "expectations": [_verdict(e, scores, table.rows) for e in table.expectations],
    }
    write_text(bench.out / f"{table.name}.json", json.dumps(result, indent=2) + "\n")
    write_text(bench.out / f"{table.name}.md", markdown(result, table.columns))
    figures.save(_figure(result, table.columns), bench.out / f"{table.name}.png")
    return result


def _stacked(by_seed: Sequence[Scores]) -> Scores:
    return {name: torch.stack([scores[name] for scores in by_seed]) for name in by_seed[0]}


def _figures(row: Row, scores: Scores, columns: Sequence[str]) -> dict[str, Any]:
    """A row's mean and standard deviation over trainings, and what the descent did to the consistency loss."""
    by_seed = {name: scores[name].mean(1) for name in columns if name in scores}
    found: dict[str, Any] = {
        "mean": {name: values.mean().item() for name, values in by_seed.items()},
        "by_seed": {name: values.tolist() for name, values in by_seed.items()},
        "paper": dict(row.paper),
    }
    found["sd"] = {name: values.std().item() if len(values) > 1 else None for name, values in by_seed.items()}
    if "searched" in scores and row.codes == "agreed":
        lowered = scores["consistency"] < scores["searched"]
        found["consistency"] = {
            "searched": scores["searched"].mean().item(),
            "descended": scores["consistency"].mean().item(),
            "lowered_share": lowered.double().mean().item(),
        }
    return found


def _verdict(expected: Expectation, scores: Mapping[str, Scores], rows: Sequence[Row]) -> dict[str, Any]:
    gain = scores[expected.higher][expected.figure] - scores[expected.lower][expected.figure]
    sure = confidence(gain)
    paper = {row.name: row.paper for row in rows}
    theirs = None
    if expected.figure in paper[expected.higher] and expected.figure in paper[expected.lower]:
        theirs = paper[expected.higher][expected.figure] - paper[expected.lower][expected.figure]
    return {
        **dataclasses.asdict(expected),
        "gain": gain.mean().item(),
        "gain_by_seed": gain.mean(1).tolist(),
        "paper_gain": theirs,
        "confidence": sure,
        "verdict": "holds" if sure >= _SURE else "does not hold" if sure <= 1 - _SURE else "undecided",
    }


def confidence(gain: Tensor, *, seed: int = 0) -> float:
    """Share of paired bootstrap samples, over trainings and over shapes, in which a gain (S, M) is above 0."""
    random = np.random.default_rng(seed)
    trainings, shapes = gain.shape
    of_trainings = random.multinomial(trainings, np.full(trainings, 1 / trainings), size=_RESAMPLES)
    of_shapes = random.multinomial(shapes, np.full(shapes, 1 / shapes), size=_RESAMPLES)
    sums = ((of_trainings @ gain.numpy()) * of_shapes).sum(1)
    return float((sums > 0).mean())


def markdown(result: Mapping[str, Any], columns: Sequence[str]) -> str:
    """The table, and what became of each expectation."""
    seeds = result["seeds"]
    plural = "trainings" if seeds > 1 else "training"
    head = (
        f"{result['title']} {result['shapes']} held-out shapes, profile `{result['profile']}`, {seeds} {plural} of "
        "each; un-squared distances x100, mean ± standard deviation over trainings. In brackets: the paper."
    )
    lines = [
        head,
        "",
        table_row(["", *(NAMES[c] for c in columns)]),
        table_row(["---", *["---:"] * len(columns)]),
    ]
    for name, row in result["rows"].items():
        lines.append(table_row([name, *(_cell(row, column) for column in columns)]))
    if result["expectations"]:
        lines += ["", table_row(["expected", "gain", "paper's", "confidence", ""])]
        lines.append(table_row(["---", "---:", "---:", "---:", "---"]))
    for e in result["expectations"]:
        claim = f"{NAMES[e['figure']]}: {e['lower']} < {e['higher']}"
        paper = "" if e["paper_gain"] is None else f"{e['paper_gain']:+.2f}"
        lines.append(table_row([claim, f"{e['gain']:+.2f}", paper, f"{e['confidence']:.1%}", e["verdict"]]))
    agreed = {name: row["consistency"] for name, row in result["rows"].items() if "consistency" in row}
    if agreed:
        lines += [
            "",
            "Consistency loss before and after the descent, and the share of shapes that it lowered:",
        ]
        lines += [
            f"- {name}: {found['searched']:.2f}, {found['descended']:.2f}, {found['lowered_share']:.1%}"
            for name, found in agreed.items()
        ]
    return "\n".join([*lines, ""])


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column not in row["mean"]:
        return ""
    sd, paper = row["sd"][column], row["paper"].get(column)
    text = f"{row['mean'][column]:.2f}" + ("" if sd is None else f" ± {sd:.2f}")
    return text if paper is None else f"{text} ({paper:.2f})"


def table_row(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def table_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table; the first column is words, the others are figures."""
    ruler = ["---", *["---:"] * (len(head) - 1)]
    return [table_row(cells) for cells in (head, ruler, *rows)]


def _figure(result: Mapping[str, Any], columns: Sequence[str]) -> Figure:
    """A panel for each column: a dot for each training, a bar for their mean."""
    rows = list(result["rows"])
    figure = Figure(figsize=(3.2 * len(columns) + 2, 0.42 * len(rows) + 1.4), layout="constrained", dpi=110)
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        for height, name in enumerate(rows):
            values = result["rows"][name]["by_seed"].get(column)
            if values is None:
                continue
            axes.barh(height, result["rows"][name]["mean"][column], color="#cfe8e0", height=0.6)
            axes.plot(values, [height] * len(values), "o", color="#1f6f8b", ms=5)
        axes.set(xlabel=f"{NAMES[column]} x100", xlim=(0, None))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, axis="x")
    panels[0].set_yticks(range(len(rows)), rows)
    panels[0].invert_yaxis()
    trainings = f"{result['seeds']} training{'s' if result['seeds'] > 1 else ''} of each"
    figure.suptitle(f"{result['title']} {result['shapes']} shapes, {trainings}", fontsize=11)
    return figure
