"""The page and the figure of the experiment on chairs with one arm."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, project
from train.data.render import orbit_camera
from train.experiments.one_armed.chairs import SEED, make_chair
from train.experiments.statistics import claim_lines, spread_text, trainings
from train.experiments.store import Metrics
from train.show import figures
from train.show.tables import markdown_lines

ROWS = PLAIN, _, PSGN, _, CODED, TWO, TRUTH = (
    "deterministic, A",
    "deterministic, A and B",
    "PSGN, A",
    "PSGN, the better of A and B",
    "ours, A, random codes",
    "ours, A and B",
    "the true chair",
)
COLUMNS = {
    "missing": "the missing arm",
    "present": "the arm that is there",
    "both": "the missing arm's place, if the chair has both",
    "none": "and if it has none",
}
DRAWN = 0.5
"""An arm counts as predicted from this share of the points of a real arm."""
_RED = "#d1352b"


def markdown(result: Mapping[str, Any]) -> str:
    """What was measured, in words and tables."""
    codes, changed = result["codes"], result["changed"]
    head = (
        f"{result['chairs']} procedural chairs with one arm, which are in no data tree; profile "
        f"`{result['profile']}`, {trainings(result['seeds'])} of each. View A hides whether there is another arm (that "
        f"would change {changed['A']:.1%} of the chair's pixels, median), view B shows that there is none "
        f"({changed['B']:.1%}). Points in the box of an arm, as a share of those of a real arm: 0 is no arm, 1 a whole "
        "one; mean ± standard deviation over trainings."
    )
    rows = [[name, *(spread_text(row[column]) for column in COLUMNS)] for name, row in result["rows"].items()]
    single = (
        f"Of {codes['number']} random codes for view A, the one with the fewest points of the missing arm predicts "
        f"{codes['least']:.2f} of it, the one with the most {codes['most']:.2f} (means over chairs); "
        f"{codes['draw_it']:.0%} of the codes predict more than half of it."
    )
    last = "A network that predicts no arms predicts no missing ones either; the last two claims exclude that case."
    lines = [head, "", *markdown_lines(["", *COLUMNS.values()], rows)]
    for paragraph in (single, _weak_networks(result["rows"]), last):
        lines += ["", paragraph]
    return "\n".join([*lines, "", *claim_lines(result["claims"]), ""])


def _weak_networks(rows: Mapping[str, Any]) -> str:
    """Can these networks predict arms at all?"""
    weak = [name for name, row in rows.items() if row["present"]["mean"] - row["none"]["mean"] < DRAWN]
    if not weak:
        return "All of them predict the arm that is there, so that a missing arm that is not predicted is a result."
    words = "; ".join(
        f"{name} {rows[name]['present']['mean']:.2f} and {rows[name]['none']['mean']:.2f}" for name in weak
    )
    return (
        "Networks that hardly predict arms show little about missing ones. For these, an arm that is there and the "
        f"same place on a chair without arms differ by less than half an arm: {words}."
    )


def figure(
    result: Mapping[str, Any],
    size: int,
    chairs: Metrics,
    clouds: Mapping[str, Tensor],
    shares: Mapping[str, np.ndarray],
) -> Figure:
    """The first chairs with the predictions of the first training, seen from above the missing arm.

    Args:
        result: what one-armed.json holds.
        size: of the pictures, pixels.
        chairs: as `measure` keeps them.
        clouds: row -> (few, N, 3), one of each chair that is shown.
        shares: row -> (S, M, K, 4), of all of them.
    """
    columns = {
        PLAIN: "deterministic, A",
        PSGN: "PSGN, A",
        CODED: "ours, A, one code",
        TWO: "ours, A and B",
        TRUTH: "the true chair",
    }
    shown = range(len(clouds[TRUTH]))
    drawing, panels = figures.grid(rows=len(shown), columns=2 + len(columns))
    for number, line in zip(shown, panels, strict=True):
        side = int(chairs["side"][number])
        chair = make_chair((SEED, int(chairs["number"][number])), 1 if side > 0 else -1)
        assert chair is not None
        for axes, image in zip(line, chair.images(size), strict=False):
            figures.draw_image(axes, torch.from_numpy(image).permute(2, 0, 1).float() / 255)
        eye = orbit_camera(np.array([-20.0 * side]), np.array([35.0]), 128).to(dtype=torch.float32)
        boxes = chairs["boxes"][number].float()
        close = figures.narrowed(eye, torch.cat([chairs["one, truth"][number], boxes.flatten(0, 1)]))
        for axes, name in zip(line[2:], columns, strict=True):
            cloud = clouds[name][number]
            colours = figures.TRUE if name == TRUTH else figures.PREDICTED
            figures.draw_cloud(axes, cloud, close[0], colours=colours)
            _mark(axes, cloud, boxes[0], close[0])
            missing, present = shares[name][0, number, 0, :2].tolist()
            figures.caption(axes, f"missing arm {missing:.2f}, present {present:.2f}")
    figures.titles(panels, ["view A", "view B", *columns.values()])
    figures.headline(
        drawing,
        f"Chairs with one arm, profile {result['profile']}, seed 0; red: where the other arm would be; "
        "points there and at the present arm, as shares of a real arm's",
    )
    return drawing


def _mark(axes: Axes, cloud: Tensor, box: Tensor, camera: PinholeCamera) -> None:
    """Outlines a box (2, 3), and circles the points (N, 3) in it."""
    corners = torch.cartesian_prod(*box.T)
    pixels = project(corners[None], camera).pixels[0, 0]
    for start, end in itertools.combinations(range(8), 2):
        if int((corners[start] != corners[end]).sum()) == 1:  # they share an edge
            axes.plot(*pixels[[start, end]].T, color=_RED, lw=0.6, alpha=0.6)
    points = cloud[((cloud > box[0]) & (cloud < box[1])).all(-1)]
    if len(points):
        axes.scatter(*project(points[None], camera).pixels[0, 0].T, s=14, color=_RED, linewidths=0)
