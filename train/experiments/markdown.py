"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

_RULES = {"l": "---", "r": "---:"}


def table_lines(
    head: Sequence[str], rows: Iterable[Sequence[str]], alignment: str | None = None
) -> list[str]:
    """The lines of a table.

    Args:
        head: titles of the columns.
        rows: cells.
        alignment: "l" or "r" for every column; if not given, the first is left-aligned, the others are numbers.

    Example:
        >>> table_lines(["", "CD"], [["ours", "5.34"]])
        ['|  | CD |', '| --- | ---: |', '| ours | 5.34 |']
    """
    alignment = alignment or "l".ljust(len(head), "r")
    lines = [head, [_RULES[side] for side in alignment], *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
