"""A table of the paper as a declaration: which methods, measured how, and what the numbers are claimed to show.

`make` trains what is missing, measures it per shape, and gives the table, a figure and a verdict on every claim.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from train.config import FitConfig, InferenceConfig, scaled
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.statistics import (
    claim,
    claim_lines,
    spread_text,
    spreads,
    stacked,
    trainings,
    transposed,
)
from train.experiments.store import Metrics
from train.experiments.study import Change, Split, Study, stage1_of, unchanged
from train.show import figures
from train.show.tables import markdown_lines

NAMES = {
    "gt_to_pred": "GT->pred",
    "pred_to_gt": "pred->GT",
    "cd": "CD",
    "fps_cd": "FPS-CD",
    "fps_gt_to_pred": "FPS GT->pred",
    "fps_pred_to_gt": "FPS pred->GT",
    "best_cd": "best view's CD",
    "emd": "EMD",
    "consistency": "consistency",
    "diversity": "diversity",
    "visible": "to the observed depth",
    "novelty": "to the nearest training shape",
    "critic": "below real shapes by the critic",
}
_ABOUT_THE_CRITIC = (
    " By the critic: its mean output for ground-truth shapes less that for predictions, after it was trained on "
    "training images to tell these predictions from real shapes by an auto-encoder's codes (in their unit; not x100)."
)
# The paper trains stage 1 for 40 000 steps on one category and for 100 000 on thirteen. The full profile's lengths are
# those for one, the cpu profile's are for all the families together.
_CPU_STEPS_FOR_ONE_CATEGORY = 0.5

Measure = Callable[["Row", Study, FitConfig], Metrics]
"""(row, study, its configuration with a seed) -> metric -> (M,) of every held-out shape."""


def reconstruction(row: Row, study: Study, config: FitConfig) -> Metrics:
    """Errors of a row's reconstructions from several images of each shape."""
    if row.source in ("medoid", "nearest image"):
        return study.retrieval_metrics(row.source, config, views=row.views)
    settings = {
        "agreed": config.inference,
        "agreed as in the paper": InferenceConfig(),
        "searched": dataclasses.replace(config.inference, steps=0),
        "random": InferenceConfig(groups=1, steps=0),
    }[row.codes]
    settings = dataclasses.replace(settings, scored=row.scored or settings.scored)
    return study.reconstruction_metrics(config, settings, stage=row.stage, views=row.views, split=row.split)


@dataclasses.dataclass(frozen=True)
class Row:
    """A method, or a baseline without training, and how it is measured."""

    name: str
    """As the table shows it."""
    _: dataclasses.KW_ONLY
    change: Change = unchanged
    """How its training differs from the profile's."""
    stage: Literal[1, 2] = 2
    """Whose best weights are measured."""
    codes: Literal["agreed", "agreed as in the paper", "searched", "random"] = "agreed"
    """"agreed": by search and descent, as the profile or as the paper has it; "searched" only; or "random"."""
    views: int = 8
    scored: Literal["joined", "each"] | None = None
    """See `InferenceConfig`; as the method has it if None."""
    split: Split = "test"
    """Which shapes; a claim can compare rows of one split only."""
    source: Literal["network", "medoid", "nearest image", "target"] = "network"
    """Of the clouds: a trained network, a retrieval baseline, or the ground truth (with a `measure` of its own)."""
    measure: Measure = reconstruction
    critic_of: Change | None = None
    """How the training differs from the profile's whose auto-encoder a critic uses."""
    paper: Mapping[str, float] = dataclasses.field(default_factory=dict)


Rows = Mapping[str, Mapping[str, Any]]
"""Row -> metric -> its values (S, M) over trainings and shapes; of the paper, a number."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """What the paper's table shows, in words and as a gain of the rows' values: above 0 where the claim holds."""

    words: str
    gain: Callable[[Rows], Any]


def below(metric: str, lower: str, higher: str, *, times: float = 1.0) -> Claim:
    """The claim that a metric is lower in one row than in another, by a factor if one is given.

    Example:
        >>> below("cd", "a", "b").gain({"a": {"cd": 3.0}, "b": {"cd": 4.0}})
        1.0
    """
    factor = "" if times == 1 else f"{times:g} x "
    return Claim(
        f"{NAMES[metric]}: {factor}{lower} < {higher}",
        lambda rows: rows[higher][metric] - times * rows[lower][metric],
    )


def rising(metric: str, *names: str) -> list[Claim]:
    """The claims that a metric is lower in each row than in the next."""
    return [below(metric, lower, higher) for lower, higher in itertools.pairwise(names)]


def falls_more(words: str, metric: str, first: tuple[str, str], second: tuple[str, str]) -> Claim:
    """The claim that a metric falls more from one row to another than between two others."""

    def fall(rows: Rows, start: str, end: str) -> Any:
        return rows[start][metric] - rows[end][metric]

    return Claim(words, lambda rows: fall(rows, *first) - fall(rows, *second))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """One table."""

    title: str
    """What it compares, in a line."""
    rows: tuple[Row, ...]
    """From top to bottom."""
    claims: tuple[Claim, ...] = ()
    """What the paper's table shows."""
    category_claims: tuple[Claim, ...] = ()
    """What it shows in every category; with any, the table has a line for each category."""
    columns: tuple[str, ...] = ("gt_to_pred", "pred_to_gt", "cd", "fps_cd")
    """Metrics, of `NAMES`."""
    of_one_category: bool = False
    """Train and measure on the study's category alone, at `cpu` for half as many steps."""

    @property
    def experiment(self) -> Experiment:
        """The experiment that makes this table."""
        return Experiment(functools.partial(make, self), self.trainings)

    def config(self, row: Row, study: Study, *, seed: int) -> FitConfig:
        """How a row's method is trained."""
        config = study.config(row.change, seed=seed)
        if self.of_one_category:
            config = dataclasses.replace(config, categories=(study.category,))
            if study.profile == "cpu" and study.steps is None:
                config = scaled(config, _CPU_STEPS_FOR_ONE_CATEGORY)
        return config

    def cells(self, study: Study) -> Iterator[tuple[Row, FitConfig]]:
        """Every row with every seed, seed by seed."""
        for seed in range(study.seeds):
            for row in self.rows:
                yield row, self.config(row, study, seed=seed)

    def trainings(self, study: Study, *, only_missing: bool = False) -> list[FitConfig]:
        """Every training that the table needs, no longer than it needs it; or only those whose metrics are not kept."""
        found = []
        for row, config in self.cells(study):
            if only_missing and not study.first_missing(functools.partial(measured, row=row, config=config)):
                continue
            if row.source == "network":
                found.append(stage1_of(config) if row.stage == 1 else config)
            if row.critic_of is not None:  # whose auto-encoder is used
                found.append(study.config(row.critic_of, seed=config.seed))
        return found


def measured(study: Study, row: Row, config: FitConfig) -> Metrics:
    """A row's metrics for one training, measured now or kept."""
    return row.measure(row, study, config)


def make(table: Table, study: Study) -> Outcome:
    """`tabulate`, with the page and the figure."""
    result = tabulate(table, study)
    return Outcome(result, markdown(result), {"": figure(result)})


def tabulate(table: Table, study: Study) -> dict[str, Any]:
    """Trains and measures what is missing; what NAME.json is to hold."""
    study.train_all(table.trainings(study, only_missing=True))
    study.measure_all(measured, list(table.cells(study)))
    by_row: dict[str, list[Metrics]] = {}
    for row, config in table.cells(study):
        by_row.setdefault(row.name, []).append(measured(study, row, config))
    per_shape = {name: stacked(metrics) for name, metrics in by_row.items()}
    config = table.config(table.rows[0], study, seed=0)
    categories = np.array(study.split(config, "test").categories)
    result: dict[str, Any] = study.about(config) | {
        "title": table.title,
        "category": study.category if table.of_one_category else None,
        "shapes": len(categories),
        "columns": list(table.columns),
        "rows": {row.name: _summary(row, per_shape[row.name], table.columns) for row in table.rows},
        "claims": _verdicts(table.claims, per_shape, {row.name: row.paper for row in table.rows}),
    }
    if table.category_claims:
        names = dict.fromkeys(categories.tolist())
        result["categories"] = {name: _of_category(table, per_shape, categories == name) for name in names}
    return result


def _summary(row: Row, metrics: Mapping[str, np.ndarray], columns: Sequence[str]) -> dict[str, Any]:
    """A row's means and standard deviations over trainings, and how the descent changed the consistency loss."""
    found = transposed(spreads({name: metrics[name] for name in columns if name in metrics}))
    found["paper"] = dict(row.paper)
    if "searched" in metrics and row.codes.startswith("agreed"):
        searched, descended = metrics["searched"], metrics["consistency"]
        found["consistency"] = {
            "searched": float(searched.mean()),
            "descended": float(descended.mean()),
            "lowered_share": float((descended < searched).mean()),
        }
    return found


def _of_category(table: Table, per_shape: Rows, mine: np.ndarray) -> dict[str, Any]:
    """Number, means and verdicts of the shapes of a category."""
    part, means = {}, {}
    for row, metrics in per_shape.items():
        part[row] = {name: metrics[name][:, mine] for name in table.columns if name in metrics}
        means[row] = {name: float(values.mean()) for name, values in part[row].items()}
    return {"shapes": int(mine.sum()), "rows": means, "claims": _verdicts(table.category_claims, part, {})}


def _verdicts(claims: Sequence[Claim], rows: Rows, paper: Rows) -> list[dict[str, Any]]:
    found = []
    for each in claims:
        try:
            theirs = each.gain(paper)
        except KeyError:  # the paper has no value for one of the rows
            theirs = None
        found.append(claim(each.words, each.gain(rows), paper_gain=theirs))
    return found


def markdown(result: Mapping[str, Any]) -> str:
    """The table, and the verdicts."""
    columns = result["columns"]
    of = f" of the category {result['category']}" if result["category"] else ""
    head = (
        f"{result['title']} {result['shapes']} held-out shapes{of}, profile `{result['profile']}`, "
        f"{trainings(result['seeds'])} of each; un-squared distances x100, mean ± standard deviation over trainings. "
        f"In brackets: the paper.{_ABOUT_THE_CRITIC if 'critic' in columns else ''}"
    )
    rows = [[name, *(_cell(row, column) for column in columns)] for name, row in result["rows"].items()]
    blocks: list[str | list[str]] = [head, markdown_lines(["", *(NAMES[name] for name in columns)], rows)]
    if "categories" in result:
        blocks += _category_blocks(result)
    if result["claims"]:
        blocks.append(claim_lines(result["claims"]))
    agreed = {name: row["consistency"] for name, row in result["rows"].items() if "consistency" in row}
    if agreed:
        words = "Consistency loss before and after the descent, and the share of shapes for which it fell:"
        shares = (
            f"- {name}: {found['searched']:.2f}, {found['descended']:.2f}, {found['lowered_share']:.1%}"
            for name, found in agreed.items()
        )
        blocks += [words, [*shares]]
    return markdown_page(*blocks)


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column not in row["mean"]:
        return ""
    text = spread_text({"mean": row["mean"][column], "sd": row["sd"][column]})
    return f"{text} ({row['paper'][column]:.2f})" if column in row["paper"] else text


def _category_blocks(result: Mapping[str, Any]) -> list[str | list[str]]:
    """CD and FPS-CD of every category and row; the means over shapes and over categories below."""
    names, found = list(result["rows"]), result["categories"].values()

    def cells(rows: Mapping[str, Any]) -> list[str]:
        return [f"{rows[name]['cd']:.2f} ({rows[name]['fps_cd']:.2f})" for name in names]

    lines = [
        [kind, str(each["shapes"]), *cells(each["rows"]), ", ".join(c["verdict"] for c in each["claims"])]
        for kind, each in result["categories"].items()
    ]
    over_shapes = {name: row["mean"] for name, row in result["rows"].items()}
    over_categories = {name: pd.DataFrame([each["rows"][name] for each in found]).mean() for name in names}
    lines.append(["mean over shapes", str(result["shapes"]), *cells(over_shapes), ""])
    lines.append(["mean over categories", "", *cells(over_categories), ""])
    words = "; ".join(claim["words"] for claim in next(iter(found))["claims"])
    return [
        f"CD (FPS-CD) by category, and the verdicts on these claims there: {words}.",
        markdown_lines(["", "shapes", *names, "verdicts"], lines, "lr" + "r" * len(names) + "l"),
    ]


def figure(result: Mapping[str, Any]) -> Figure:
    """A panel for each column: a dot for each training, a bar for their mean."""
    rows, columns = list(result["rows"]), result["columns"]
    drawn = Figure(figsize=(3.2 * len(columns) + 2, 0.42 * len(rows) + 1.4), layout="constrained", dpi=110)
    panels = drawn.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        for height, row in enumerate(result["rows"].values()):
            if column in row["mean"]:
                axes.barh(height, row["mean"][column], color="#cfe8e0", height=0.6)
                axes.plot(row["by_seed"][column], [height] * result["seeds"], "o", color="#1f6f8b", ms=5)
        axes.set(xlabel=NAMES[column] + (" x100" if column != "critic" else ""))
        axes.set_xlim(min(0, axes.get_xlim()[0]), None)
        figures.plain(axes)
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(range(len(rows)), rows)
    panels[0].invert_yaxis()
    of = f"{result['shapes']} shapes, {trainings(result['seeds'])} of each"
    drawn.suptitle(f"{result['title']} {of}", fontsize=11)
    return drawn
