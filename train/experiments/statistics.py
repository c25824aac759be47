"""What a number of trainings says: means with their spread, intervals by bootstrap, and verdicts on claims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from torch import Tensor

from train.evaluation.per_shape import stack_seeds
from train.experiments.store import Metrics
from train.show.tables import markdown_lines

LEVEL = 0.95
"""Of all intervals."""
_RESAMPLES = 4000

Verdict = Literal["holds", "does not hold", "undecided"]
CLAIM_COLUMNS = ("claim", f"gain [{LEVEL:.0%} interval]", "gain in the paper", "verdict")
CLAIM_ALIGNMENT = "lrrl"


def stacked(by_seed: Sequence[Metrics]) -> dict[str, np.ndarray]:
    """The metrics (M,) of several trainings as arrays (S, M) in float64."""
    return {name: values.double().numpy() for name, values in stack_seeds(by_seed).items()}


def spread(by_seed: Sequence[float] | np.ndarray | Tensor) -> dict[str, Any]:
    """Mean over trainings, standard deviation (None for a single one), and the value of each.

    Example:
        >>> spread([1.0, 2.0, 3.0])
        {'mean': 2.0, 'sd': 1.0, 'by_seed': [1.0, 2.0, 3.0]}
    """
    values = np.asarray(by_seed, np.float64)
    sd = float(values.std(ddof=1)) if len(values) > 1 else None
    return {"mean": float(values.mean()), "sd": sd, "by_seed": values.tolist()}


def spreads(metrics: Mapping[str, np.ndarray], shapes: Any = slice(None)) -> dict[str, dict[str, Any]]:
    """`spread` of the means over (some) shapes of every metric (S, M)."""
    return {name: spread(values[:, shapes].mean(1)) for name, values in metrics.items()}


def transposed(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Row -> column -> value as column -> row -> value.

    Example:
        >>> transposed({"cd": {"mean": 1.0, "sd": 0.1}})
        {'mean': {'cd': 1.0}, 'sd': {'cd': 0.1}}
    """
    return {column: {name: row[column] for name, row in rows.items()} for column in next(iter(rows.values()))}


def spread_text(found: Mapping[str, Any]) -> str:
    """Mean ± standard deviation over trainings, if there is one.

    Example:
        >>> spread_text({"mean": 1.0, "sd": 0.126})
        '1.00 ± 0.13'
        >>> spread_text({"mean": -0.001, "sd": None})
        '0.00'
    """
    mean = round(found["mean"], 2) + 0.0  # a zero without its sign
    return f"{mean:.2f}" + ("" if found["sd"] is None else f" ± {found['sd']:.2f}")


def percent_text(found: Mapping[str, Any]) -> str:
    """As `spread_text`, for shares.

    Example:
        >>> percent_text({"mean": 0.256, "sd": 0.05})
        '26% ± 5'
    """
    return f"{found['mean']:.0%}" + ("" if found["sd"] is None else f" ± {100 * found['sd']:.0f}")


def trainings(count: int, *, run: str | None = None) -> str:
    """So many trainings, or draws of codes for the network of a given run, in words.

    Example:
        >>> trainings(1)
        '1 training'
        >>> trainings(3, run="pretrained")
        'the run pretrained, codes drawn 3 times'
    """
    if run:
        return f"the run {run}, codes drawn {count} times"
    return f"{count} training{'s' if count > 1 else ''}"


def resampled_means(values: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """Means of bootstrap samples of values (S, M), in which trainings and shapes are resampled independently."""
    random = np.random.default_rng(seed)
    rows, columns = values.shape
    of_rows = random.multinomial(rows, np.full(rows, 1 / rows), size=_RESAMPLES)
    of_columns = random.multinomial(columns, np.full(columns, 1 / columns), size=_RESAMPLES)
    return ((of_rows @ values) * of_columns).sum(1) / values.size


def interval(means: np.ndarray) -> tuple[float, float]:
    """The percentile interval of bootstrap means."""
    low, high = np.quantile(means, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return float(low), float(high)


def claim(
    words: str, gain: np.ndarray, *, paper_gain: float | None = None, means: np.ndarray | None = None
) -> dict[str, Any]:
    """The test of the claim that a gain is above 0.

    Args:
        words: what is claimed.
        gain: (S, M) paired differences over trainings and shapes.
        paper_gain: the gain in the paper.
        means: bootstrap means, where the gain is not a mean over shapes.
    """
    low, high = interval(resampled_means(gain) if means is None else means)
    return {
        "words": words,
        "gain": float(gain.mean()),
        "interval": [low, high],
        "gain_by_seed": gain.mean(1).tolist(),
        "paper_gain": paper_gain,
        "verdict": verdict(low, high),
    }


def verdict(low: float, high: float) -> Verdict:
    """Whether an interval of the gain lies above 0, below it, or contains it."""
    return "holds" if low > 0 else "does not hold" if high < 0 else "undecided"


def claim_cells(found: Mapping[str, Any]) -> list[str]:
    """The cells of `CLAIM_COLUMNS`. A claim whose metrics per shape are not kept has no interval."""
    bounds = found["interval"]
    here = f"{found['gain']:+.2f}" + (f" [{bounds[0]:+.2f}, {bounds[1]:+.2f}]" if bounds else "")
    paper = found["paper_gain"]
    return [found["words"], here, "" if paper is None else f"{paper:+.2f}", found["verdict"]]


def claim_lines(claims: Iterable[Mapping[str, Any]]) -> list[str]:
    """A Markdown table of claims."""
    return markdown_lines(CLAIM_COLUMNS, map(claim_cells, claims), CLAIM_ALIGNMENT)


def counted(claims: Iterable[Mapping[str, Any]]) -> str:
    """How many claims are tested, and how they end.

    Example:
        >>> counted([{"verdict": "holds"}, {"verdict": "undecided"}])
        '2 claims are tested: 1 holds, 0 do not hold, 1 is undecided.'
    """
    counts = Counter(found["verdict"] for found in claims)
    words = {
        "holds": ("holds", "hold"),
        "does not hold": ("does not hold", "do not hold"),
        "undecided": ("is undecided", "are undecided"),
    }
    parts = [f"{counts[name]} {words[name][counts[name] != 1]}" for name in words]
    return f"{counts.total()} claims are tested: {', '.join(parts)}."
