"""The result of an evaluation, the content of evaluation.json, as rows of metrics and as text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from train.show.tables import text_lines

_COLUMNS = {
    "gt_to_pred": "GT->pred",
    "pred_to_gt": "pred->GT",
    "cd": "CD",
    "fps_gt_to_pred": "FPS GT->p",
    "fps_pred_to_gt": "FPS p->GT",
    "fps_cd": "FPS-CD",
    "emd": "EMD",
    "fscore_01": "F at 1%",
    "consistency": "consist.",
}
Row = tuple[str, Mapping[str, Any]]
"""A name and its metrics."""


def result_rows(result: Mapping[str, Any]) -> list[Row]:
    """The generator by number of views, then with random codes, then the two retrieval baselines."""
    return [
        *((f"generator, {views_of(n)}", metrics) for n, metrics in result["views"].items()),
        *((f"random codes, {views_of(n)}", row) for n, row in result["random_codes"].items() if n != "1"),
        *((f"nearest by image, {views_of(n)}", row) for n, row in result["nearest_image"].items()),
        ("medoid of train", result["medoid"]),
    ]


def views_of(n: str) -> str:
    """A number of views with its noun.

    Example:
        >>> views_of("1"), views_of("2")
        ('1 view', '2 views')
    """
    return f"{n} view" if n == "1" else f"{n} views"


def format_result(result: Mapping[str, Any]) -> str:
    """Tables of the metrics by number of views and by category, and remarks on search, sensitivity and diversity."""
    data, seeds = result["data"], len(result["seeds"])
    head = (
        f"{data['shapes']} shapes of the {data['split']} split, profile {result['profile']}, "
        f"{seeds} seed{'s' if seeds > 1 else ''}; un-squared distances x100; FPS: thinned to one prediction's size"
    )
    lines = [head, *_table("", result_rows(result))]
    if seeds > 1:
        spread = [(views_of(n), metrics) for n, metrics in result["spread"].items()]
        lines += ["", *_table("standard deviation over seeds", spread, digits=3)]
    if len(result["categories"]) > 1:
        most = max(result["views"], key=int)
        by_category = [
            (f"{name} ({row['shapes']})", row["views"][most]) for name, row in result["categories"].items()
        ]
        by_category += [
            ("mean over shapes", result["views"][most]),
            ("mean over categories", result["class_average"][most]),
        ]
        lines += ["", *_table(f"by category, {views_of(most)}", by_category)]
    return "\n".join([*lines, "", *_remarks(result)])


def _table(title: str, rows: Sequence[Row], *, digits: int = 2) -> list[str]:
    digits_of = {column: 3 if column == "fscore_01" else digits for column in _COLUMNS}
    cells = [
        [name, *(format_metric(metrics.get(column), digits_of[column]) for column in _COLUMNS)]
        for name, metrics in rows
    ]
    return text_lines([title, *_COLUMNS.values()], cells)


def format_metric(value: float | None, digits: int = 2) -> str:
    """A table cell; "-" for a metric that is not defined."""
    return "-" if value is None else f"{value:.{digits}f}"


def _remarks(result: Mapping[str, Any]) -> list[str]:
    change, diversity = result["sensitivity"], result["diversity"]
    if diversity is None:
        return [f"no codes; predictions change by {change['image']:.2f} with the image"]
    return [
        *(
            f"{views_of(n)}: consistency {loss['random']:.2f} with random codes, {loss['searched']:.2f} after the "
            f"search, {loss['descended']:.2f} after the descent, which lowered it for {loss['lowered_share']:.1%}"
            for n, loss in result["agreement"].items()
        ),
        f"predictions change by {change['image']:.2f} with the image and by {change['code']:.2f} with the code; the "
        f"distance between {diversity['codes']} predictions from one image is {diversity['mean']:.2f}",
    ]
