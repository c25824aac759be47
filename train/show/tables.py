"""Tables of text cells: in Markdown, in HTML, and aligned for the terminal."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

_RULES = {"l": "---", "r": "---:"}


def markdown_lines(
    head: Sequence[str], rows: Iterable[Sequence[str]], alignment: str | None = None
) -> list[str]:
    """The lines of a Markdown table.

    Args:
        head: titles of the columns.
        rows: cells.
        alignment: "l" or "r" for every column; by default the first is left-aligned, the others are right-aligned.

    Example:
        >>> markdown_lines(["", "CD"], [["ours", "5.34"]])
        ['|  | CD |', '| --- | ---: |', '| ours | 5.34 |']
    """
    alignment = alignment or "l".ljust(len(head), "r")
    lines = [head, [_RULES[side] for side in alignment], *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """An HTML table; special characters in cells are escaped.

    Example:
        >>> html_table(["", "a<b"], [["ours", "5.34"]])
        '<table><tr><th></th><th>a&lt;b</th></tr><tr><td>ours</td><td>5.34</td></tr></table>'
    """

    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(cells, 'td') for cells in rows)}</table>"


def text_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table for the terminal: the first column left-aligned, the others right-aligned.

    Example:
        >>> text_lines(["", "CD"], [["ours", "5.34"]])
        ['        CD', 'ours  5.34']
    """
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join([cells[0].ljust(widths[0]), *map(str.rjust, cells[1:], widths[1:])]) for cells in lines]
