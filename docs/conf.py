"""Sphinx: the guides as they are, the reference from the docstrings."""

from __future__ import annotations

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import diffpoint

project = "diffpoint"
author = "the diffpoint authors"
release = diffpoint.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "results"]  # results.md is made of what stands in there
html_theme = "furo"
html_title = "diffpoint"
nitpicky = False

default_role = "code"  # docstrings quote names as `name`
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
myst_heading_anchors = 3

_NOTE = re.compile(r"^(Gradients|Source): ")
_ROW = re.compile(r"^\s*\|(.*)\|\s*$")
_OUTSIDE_QUOTES = re.compile(r"(`[^`]*`)")


def _escape(line: str) -> str:
    """Stars and bars are arithmetic here, not markup; names between backticks stay as they are."""
    parts = _OUTSIDE_QUOTES.split(line)
    return "".join(p if p.startswith("`") else p.replace("*", r"\*").replace("|", r"\|") for p in parts)


def _to_rst(app, what, name, obj, options, lines: list[str]) -> None:
    """Docstrings are written to be read as text; formulas, notes and tables are translated here, before napoleon."""
    translated: list[str] = []
    in_note = in_table = in_example = False
    for line in lines:
        in_example = line.startswith("Example:") or (in_example and (line[:1] in ("", " ")))
        row = None if in_example else _ROW.match(line)
        if in_example:
            translated.append(line)
        elif row:
            if not in_table:
                translated += [".. list-table::", "   :header-rows: 1", ""]
            if set(row[1]) - set("-|: "):
                cells = [_escape(cell.strip()) for cell in row[1].split("|")]
                translated += [f"   {'* -' if i == 0 else '  -'} {cell}" for i, cell in enumerate(cells)]
        else:
            in_note = bool(_NOTE.match(line)) or (in_note and bool(line.strip()))
            text = _escape(line.strip() if in_note else line)
            translated.append(_NOTE.sub(r"**\1**: ", text))
        in_table = bool(row)
    lines[:] = translated


def setup(app) -> None:
    app.connect("autodoc-process-docstring", _to_rst, priority=100)
