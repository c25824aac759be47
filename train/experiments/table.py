"""A table of the paper as a declaration: which systems, measured how, and what they are expected to show.

`make` trains what is missing, measures it, and writes NAME.json, NAME.md and NAME.png. Every claim ("a below b") gets a
paired bootstrap over shapes and trainings and a verdict in words.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from train.config import FitConfig, InferenceConfig, scaled
from train.evaluation.per_shape import ShapeMetrics, stack_seeds
from train.experiments.workbench import Change, Workbench, as_it_is, stage1_of
from train.show import figures

NAMES = {
    "gt_to_pred": "GT->pred",
    "pred_to_gt": "pred->GT",
    "cd": "CD",
    "fps_cd": "FPS-CD",
    "fps_pred_to_gt": "FPS pred->GT",
    "best_cd": "best view's CD",
    "emd": "EMD",
    "consistency": "consistency",
    "diversity": "diversity",
    "visible": "from what the image shows",
    "novelty": "to the nearest training shape",
    "critic": "below real shapes by the critic",
}
_OF_THE_CRITIC = (
    " By the critic: how much lower it scores answers than the true shapes, after it has learnt on training images to "
    "tell just these answers from real shapes by an auto-encoder's codes (whose scale it has; not x100)."
)
# The paper trains stage 1 for 40 000 steps on one category and for 100 000 on thirteen. The full profile's lengths are
# those for one, the cpu profile's are for all the families together.
_CPU_STEPS_FOR_ONE_CATEGORY = 0.5
_RESAMPLES = 4000
_SURE = 0.9

Measure = Callable[["Row", Workbench, FitConfig], ShapeMetrics]
"""(row, bench, its configuration with a seed) -> figure -> (M,) of every held-out shape."""


def reconstructions(row: Row, bench: Workbench, config: FitConfig) -> ShapeMetrics:
    """What a row's system makes of several images of each shape, beside the truth."""
    if row.answer in ("medoid", "nearest image"):
        return bench.trivial_scores(row.answer, config, views=row.views)
    settings = config.inference
    if row.codes == "searched":
        settings = dataclasses.replace(settings, steps=0)
    elif row.codes == "random":
        settings = InferenceConfig(groups=1, steps=0)
    elif row.codes == "agreed as in the paper":
        settings = InferenceConfig()
    if row.scored is not None:
        settings = dataclasses.replace(settings, scored=row.scored)
    return bench.scores(config, settings, stage=row.stage, views=row.views, split=row.split)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A system, or an answer without one, and how it is measured.

    Attributes:
        name: as the table shows it.
        change: how its training differs from the profile's.
        stage: whose best weights are measured.
        codes: "agreed" on by search and descent as the profile does it, or as the paper does it; "searched" only; or
            "random".
        views: how many.
        scored: see `InferenceConfig`; the system's own way if None.
        split: which shapes; a claim can compare rows of one split only.
        answer: "network", or what is answered instead of a trained one; "truth" needs a `measure` of its own.
        measure: takes the figures.
        judge: how a training differs from the profile's by whose auto-encoder a critic judges the answers.
        paper: the paper's figures.
    """

    name: str
    change: Change = as_it_is
    stage: Literal[1, 2] = 2
    codes: Literal["agreed", "agreed as in the paper", "searched", "random"] = "agreed"
    views: int = 8
    scored: Literal["joined", "each"] | None = None
    split: Literal["train", "test"] = "test"
    answer: Literal["network", "medoid", "nearest image", "truth"] = "network"
    measure: Measure = reconstructions
    judge: Change | None = None
    paper: Mapping[str, float] = dataclasses.field(default_factory=dict)


Rows = Mapping[str, Mapping[str, Any]]
"""Row -> figure -> its values (S, M); of the paper, a number."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """What the paper's table shows.

    Attributes:
        words: what is claimed.
        gain: of the rows' values; above 0 where the claim holds.
    """

    words: str
    gain: Callable[[Rows], Any]


def below(figure: str, lower: str, higher: str, *, times: float = 1.0) -> Claim:
    """The claim that a figure is lower in one row than in another, by a factor if one is given.

    Example:
        >>> below("cd", "a", "b").gain({"a": {"cd": 3.0}, "b": {"cd": 4.0}})
        1.0
    """
    least = "" if times == 1 else f"{times:g} x "
    return Claim(
        f"{NAMES[figure]}: {least}{lower} < {higher}",
        lambda rows: rows[higher][figure] - times * rows[lower][figure],
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """One table.

    Attributes:
        name: of its files.
        title: what it asks, in a line.
        rows: from top to bottom.
        claims: what the paper's table shows.
        category_claims: what it shows in every category; with any, the table has a line for each category.
        columns: figures of `NAMES`.
        of_one_category: train and score on the bench's category alone, at `cpu` for half as many steps.
    """

    name: str
    title: str
    rows: tuple[Row, ...]
    claims: tuple[Claim, ...] = ()
    category_claims: tuple[Claim, ...] = ()
    columns: tuple[str, ...] = ("gt_to_pred", "pred_to_gt", "cd", "fps_cd")
    of_one_category: bool = False

    def config(self, row: Row, bench: Workbench, *, seed: int) -> FitConfig:
        """How a row's system is trained."""
        config = bench.config(row.change, seed=seed)
        if not self.of_one_category:
            return config
        config = dataclasses.replace(config, categories=(bench.category,))
        if bench.profile == "cpu" and bench.steps is None:
            return scaled(config, _CPU_STEPS_FOR_ONE_CATEGORY)
        return config

    def configs(self, bench: Workbench) -> list[FitConfig]:
        """Every training that the table rests on, no longer than it needs it, seed by seed."""
        return [
            config
            for seed in range(bench.seeds)
            for row in self.rows
            for config in self._trainings(row, bench, seed)
        ]

    def missing(self, bench: Workbench) -> list[FitConfig]:
        """Those of `configs` whose scores are not kept."""

        def needed(row: Row, seed: int) -> bool:
            config = self.config(row, bench, seed=seed)
            return not bench.has(lambda asked: measured(asked, row, config))

        return [
            config
            for seed in range(bench.seeds)
            for row in self.rows
            if needed(row, seed)
            for config in self._trainings(row, bench, seed)
        ]

    def _trainings(self, row: Row, bench: Workbench, seed: int) -> list[FitConfig]:
        """What a row rests on: its network, up to the stage that is measured, and its judge."""
        found = []
        if row.answer == "network":
            config = self.config(row, bench, seed=seed)
            found.append(stage1_of(config) if row.stage == 1 else config)
        if row.judge is not None:
            found.append(bench.config(row.judge, seed=seed))
        return found


def make(table: Table, bench: Workbench) -> dict[str, Any]:
    """Trains and measures what is missing, and writes the table into `bench.out`.

    Returns:
        What NAME.json holds.
    """
    result = tabulate(table, bench)
    bench.publish(table.name, result, markdown(result), figure(result))
    return result


def tabulate(table: Table, bench: Workbench) -> dict[str, Any]:
    """Trains and measures what is missing; what NAME.json is to hold."""
    bench.train_all(table.missing(bench))
    configs = {
        row.name: [table.config(row, bench, seed=seed) for seed in range(bench.seeds)] for row in table.rows
    }
    bench.measure_all(measured, [(row, config) for row in table.rows for config in configs[row.name]])
    scores = {
        row.name: stack_seeds([measured(bench, row, config) for config in configs[row.name]])
        for row in table.rows
    }
    config = table.config(table.rows[0], bench, seed=0)
    paper = {row.name: row.paper for row in table.rows}
    kinds = bench.split(config, "test").categories
    result: dict[str, Any] = {
        "title": table.title,
        "profile": bench.profile,
        "data": [str(root) for root in bench.data],
        "category": bench.category if table.of_one_category else None,
        "shapes": len(kinds),
        "seeds": bench.seeds,
        "columns": list(table.columns),
        "config": dataclasses.asdict(config),
        "rows": {row.name: _figures(row, scores[row.name], table.columns) for row in table.rows},
        "claims": [_verdict(claim, scores, paper) for claim in table.claims],
    }
    if table.category_claims:
        result["categories"] = _categories(table, scores, kinds)
    return result


def measured(bench: Workbench, row: Row, config: FitConfig) -> ShapeMetrics:
    """A row's figures for one training, taken now or kept."""
    return row.measure(row, bench, config)


def _figures(row: Row, scores: ShapeMetrics, columns: Sequence[str]) -> dict[str, Any]:
    """A row's mean and standard deviation over trainings, and what the descent did to the consistency loss."""
    by_seed = {name: scores[name].mean(1) for name in columns if name in scores}
    found: dict[str, Any] = {
        "mean": {name: values.mean().item() for name, values in by_seed.items()},
        "by_seed": {name: values.tolist() for name, values in by_seed.items()},
        "paper": dict(row.paper),
    }
    found["sd"] = {name: values.std().item() if len(values) > 1 else None for name, values in by_seed.items()}
    if "searched" in scores and row.codes.startswith("agreed"):
        lowered = scores["consistency"] < scores["searched"]
        found["consistency"] = {
            "searched": scores["searched"].mean().item(),
            "descended": scores["consistency"].mean().item(),
            "lowered_share": lowered.double().mean().item(),
        }
    return found


def _categories(table: Table, scores: Mapping[str, ShapeMetrics], kinds: Sequence[str]) -> dict[str, Any]:
    """Each category's figures and verdicts, and the averages of shapes and of categories."""
    found: dict[str, Any] = {}
    for kind in dict.fromkeys(kinds):
        mine = torch.tensor([k == kind for k in kinds])
        part = {row: {name: values[:, mine] for name, values in s.items()} for row, s in scores.items()}
        found[kind] = {
            "shapes": int(mine.sum()),
            "rows": {
                row: {c: s[c].mean().item() for c in table.columns if c in s} for row, s in part.items()
            },
            "claims": [_verdict(claim, part, {}) for claim in table.category_claims],
        }
    return found


def _verdict(claim: Claim, rows: Mapping[str, ShapeMetrics], paper: Rows) -> dict[str, Any]:
    try:
        theirs = claim.gain(paper)
    except KeyError:  # the paper has no figure for one of the rows
        theirs = None
    return judged(claim.words, claim.gain(rows), paper_gain=theirs)


def judged(words: str, gain: Tensor, *, paper_gain: float | None = None) -> dict[str, Any]:
    """What became of the claim that a gain (S, M), over trainings and shapes, is above 0."""
    sure = confidence(gain)
    return {
        "words": words,
        "gain": gain.mean().item(),
        "gain_by_seed": gain.mean(1).tolist(),
        "paper_gain": paper_gain,
        "confidence": sure,
        "verdict": verdict(sure),
    }


def verdict(sure: float) -> Literal["holds", "undecided", "does not hold"]:
    """In words, what a share of bootstrap samples (`confidence`) says of a claim."""
    return "holds" if sure >= _SURE else "does not hold" if sure <= 1 - _SURE else "undecided"


def confidence(gain: Tensor, *, seed: int = 0) -> float:
    """Share of paired bootstrap samples, over trainings and over shapes, in which a gain (S, M) is above 0."""
    random = np.random.default_rng(seed)
    trainings, shapes = gain.shape
    of_trainings = random.multinomial(trainings, np.full(trainings, 1 / trainings), size=_RESAMPLES)
    of_shapes = random.multinomial(shapes, np.full(shapes, 1 / shapes), size=_RESAMPLES)
    sums = ((of_trainings @ gain.numpy()) * of_shapes).sum(1)
    return float((sums > 0).mean())


def markdown(result: Mapping[str, Any]) -> str:
    """The table, and what became of each claim."""
    columns = result["columns"]
    lines = [_head(result), ""]
    rows = [[name, *(_cell(row, column) for column in columns)] for name, row in result["rows"].items()]
    lines += table_lines(["", *(NAMES[c] for c in columns)], rows)
    if "categories" in result:
        lines += ["", *_category_lines(result)]
    if result["claims"]:
        lines += ["", *claim_lines(result["claims"])]
    agreed = {name: row["consistency"] for name, row in result["rows"].items() if "consistency" in row}
    if agreed:
        lines += [
            "",
            "Consistency loss before and after the descent, and the share of shapes that it lowered:",
            "",
        ]
        lines += [
            f"- {name}: {found['searched']:.2f}, {found['descended']:.2f}, {found['lowered_share']:.1%}"
            for name, found in agreed.items()
        ]
    return "\n".join([*lines, ""])


def _head(result: Mapping[str, Any]) -> str:
    of = f" of the category {result['category']}" if result["category"] else ""
    return (
        f"{result['title']} {result['shapes']} held-out shapes{of}, profile `{result['profile']}`, "
        f"{trainings(result['seeds'])} of each; un-squared distances x100, mean ± standard deviation over trainings. "
        "In brackets: the paper." + (_OF_THE_CRITIC if "critic" in result["columns"] else "")
    )


def trainings(count: int) -> str:
    """So many trainings, in words.

    Example:
        >>> trainings(1)
        '1 training'
    """
    return f"{count} training{'s' if count > 1 else ''}"


def claim_lines(claims: Sequence[Mapping[str, Any]]) -> list[str]:
    """A Markdown table of verdicts."""
    lines = [table_row(["claim", "gain", "paper's", "confidence", ""]), "| --- | ---: | ---: | ---: | --- |"]
    return [*lines, *(table_row(claim_cells(claim)) for claim in claims)]


def claim_cells(claim: Mapping[str, Any]) -> list[str]:
    """A claim, its gain here and in the paper, the bootstrap's confidence, the verdict."""
    paper = claim.get("paper_gain")
    theirs = "" if paper is None else f"{paper:+.2f}"
    return [claim["words"], f"{claim['gain']:+.2f}", theirs, f"{claim['confidence']:.1%}", claim["verdict"]]


def _category_lines(result: Mapping[str, Any]) -> list[str]:
    """CD and FPS-CD of every category and row; the averages of shapes and of categories below."""
    names, found = list(result["rows"]), result["categories"]

    def cells(rows: Mapping[str, Mapping[str, float]]) -> list[str]:
        return [f"{rows[name]['cd']:.2f} ({rows[name]['fps_cd']:.2f})" for name in names]

    lines = [
        [kind, str(each["shapes"]), *cells(each["rows"]), ", ".join(c["verdict"] for c in each["claims"])]
        for kind, each in found.items()
    ]
    every = [each["rows"] for each in found.values()]
    of_shapes = {name: row["mean"] for name, row in result["rows"].items()}
    of_categories = {
        name: {c: float(np.mean([rows[name][c] for rows in every])) for c in ("cd", "fps_cd")}
        for name in names
    }
    lines.append(["mean of shapes", str(result["shapes"]), *cells(of_shapes), ""])
    lines.append(["mean of categories", "", *cells(of_categories), ""])
    words = "; ".join(claim["words"] for claim in next(iter(found.values()))["claims"])
    return [
        f"CD (FPS-CD) by category, and whether it holds there that {words}:",
        "",
        *table_lines(["", "shapes", *names, "verdicts"], lines),
    ]


def _cell(row: Mapping[str, Any], column: str) -> str:
    if column not in row["mean"]:
        return ""
    paper = row["paper"].get(column)
    text = mean_and_spread({"mean": row["mean"][column], "sd": row["sd"][column]})
    return text if paper is None else f"{text} ({paper:.2f})"


def mean_and_spread(found: Mapping[str, Any]) -> str:
    """A figure's mean and its standard deviation over trainings, if there is one.

    Example:
        >>> mean_and_spread({"mean": 1.0, "sd": 0.126})
        '1.00 ± 0.13'
        >>> mean_and_spread({"mean": -0.001, "sd": None})
        '0.00'
    """
    mean = round(found["mean"], 2) + 0.0  # a zero without its sign
    return f"{mean:.2f}" + ("" if found["sd"] is None else f" ± {found['sd']:.2f}")


def table_row(cells: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def table_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table; the first column is words, the others are figures."""
    ruler = ["---", *["---:"] * (len(head) - 1)]
    return [table_row(cells) for cells in (head, ruler, *rows)]


def figure(result: Mapping[str, Any]) -> Figure:
    """A panel for each column: a dot for each training, a bar for their mean."""
    rows, columns = list(result["rows"]), result["columns"]
    drawn = Figure(figsize=(3.2 * len(columns) + 2, 0.42 * len(rows) + 1.4), layout="constrained", dpi=110)
    panels = drawn.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        for height, name in enumerate(rows):
            values = result["rows"][name]["by_seed"].get(column)
            if values is None:
                continue
            axes.barh(height, result["rows"][name]["mean"][column], color="#cfe8e0", height=0.6)
            axes.plot(values, [height] * len(values), "o", color="#1f6f8b", ms=5)
        axes.set(xlabel=NAMES[column] + (" x100" if column != "critic" else ""))
        axes.set_xlim(min(0, axes.get_xlim()[0]), None)
        figures.plain(axes)
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(range(len(rows)), rows)
    panels[0].invert_yaxis()
    of = f"{result['shapes']} shapes, {trainings(result['seeds'])} of each"
    drawn.suptitle(f"{result['title']} {of}", fontsize=11)
    return drawn
