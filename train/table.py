"""The evaluation as a table for the terminal."""

from __future__ import annotations

from typing import Any

_COLUMNS = {"gt_to_pred": "GT->pred", "pred_to_gt": "pred->GT", "cd": "CD", "fps_cd": "FPS-CD"}


def format_table(result: dict[str, Any]) -> str:
    """Lays out what `evaluate` returns: the network by number of views, then the answers without one."""
    data, moved = result["data"], result["sensitivity"]
    rows = [("", {**_COLUMNS, "consistency": "consistency"})]
    rows += [(_views(n), scores) for n, scores in result["views"].items()]
    rows += [(f"{_views(n)}, random codes", row) for n, row in result["random_codes"].items() if n != "1"]
    rows += [("medoid of train", result["medoid"])]
    rows += [(f"nearest image, {_views(n)}", scores) for n, scores in result["nearest_image"].items()]
    return "\n".join(
        [
            f"{data['shapes']} shapes of the {data['split']} split, profile {result['profile']}; "
            "un-squared distances x100",
            *(_line(name, scores) for name, scores in rows),
            f"predictions move by {moved['image']:.2f} with the image and by {moved['code']:.2f} with the code",
        ]
    )


def _views(n: str) -> str:
    return f"{n} view" if n == "1" else f"{n} views"


def _line(name: str, cells: dict[str, Any]) -> str:
    def show(cell: Any) -> str:
        if cell is None:
            return "-"
        return cell if isinstance(cell, str) else f"{cell:.2f}"

    return f"{name:24}" + "".join(f"{show(cells.get(column)):>13}" for column in [*_COLUMNS, "consistency"])
