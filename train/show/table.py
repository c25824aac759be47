"""The evaluation as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
_NAME_WIDTH = 24


def format_table(result: Mapping[str, Any]) -> str:
    """Lays out what `evaluate` returns: the network by number of views, then the answers without one."""
    data, seeds = result["data"], len(result["seeds"])
    head = (
        f"{data['shapes']} shapes of the {data['split']} split, profile {result['profile']}, "
        f"{seeds} seed{'s' if seeds > 1 else ''}; un-squared distances x100; FPS: thinned to one prediction's size"
    )
    lines = [head, _line("", _COLUMNS)]
    for n, scores in result["views"].items():
        lines.append(_line(_views(n), scores))
        if seeds > 1:
            lines.append(_line("  sd over seeds", result["spread"][n], digits=3))
    rows = [(f"{_views(n)}, random codes", row) for n, row in result["random_codes"].items() if n != "1"]
    rows += [("medoid of train", result["medoid"])]
    rows += [(f"nearest image, {_views(n)}", scores) for n, scores in result["nearest_image"].items()]
    lines += [_line(name, scores) for name, scores in rows]
    if len(result["categories"]) > 1:
        lines += ["", *_by_category(result)]
    return "\n".join([*lines, "", *_remarks(result)])


def _by_category(result: Mapping[str, Any]) -> list[str]:
    most = max(result["views"], key=int)
    rows = [
        (f"{name} ({entry['shapes']})", entry["views"][most]) for name, entry in result["categories"].items()
    ]
    rows += [
        ("mean over shapes", result["views"][most]),
        ("mean over categories", result["class_average"][most]),
    ]
    return [f"by category, {_views(most)}", *(_line(name, scores) for name, scores in rows)]


def _remarks(result: Mapping[str, Any]) -> list[str]:
    moved, apart = result["sensitivity"], result["diversity"]
    lines = []
    for n, agreed in result["agreement"].items():
        lines.append(
            f"{_views(n)}: consistency {agreed['random']:.2f} with random codes, {agreed['searched']:.2f} after the "
            f"search, {agreed['descended']:.2f} after the descent, which lowered it for {agreed['lowered_share']:.1%}"
        )
    if apart is None:
        return [f"no codes; predictions move by {moved['image']:.2f} with the image"]
    return [
        *lines,
        f"predictions move by {moved['image']:.2f} with the image and by {moved['code']:.2f} with the code; "
        f"{apart['codes']} predictions of one image are {apart['mean']:.2f} apart",
    ]


def _views(n: str) -> str:
    return f"{n} view" if n == "1" else f"{n} views"


def _line(name: str, cells: Mapping[str, Any], *, digits: int = 2) -> str:
    def show(column: str) -> str:
        cell = cells.get(column)
        if cell is None:
            return "-"
        if isinstance(cell, str):
            return cell
        return f"{cell:.{3 if column == 'fscore_01' else digits}f}"

    return f"{name:{_NAME_WIDTH}}" + "".join(f"{show(column):>10}" for column in _COLUMNS)
