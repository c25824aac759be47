"""Results on networks: tables, validation curves, and predictions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera
from train.data.batches import Batch
from train.experiments.front_vs_projection.networks import TRAININGS
from train.experiments.statistics import spread_text, trainings
from train.show import figures
from train.show.tables import markdown_lines

_FLOOR = "points of the true surface"
_SINGLE = {
    "visible": "visible part",
    "inside": "inside",
    "pred_to_gt": "cloud to shape",
    "gt_to_pred": "shape to cloud",
    "cd": "8 views joined, CD",
    "fps_cd": "FPS-CD",
}
_EVENNESS = {"front_density": "density in front", "imbalance": "imbalance"}
_PANELS = {
    "visible": "visible part, chamfer x100",
    "inside": "share inside the silhouette",
    "cd_1": "one view against the whole shape, CD x100",
}


def markdown(found: Mapping[str, Any]) -> str:
    """Tables of everything."""
    single, many, floor = found["single"], found["many"], found["floor"]
    stage1, stage2 = single["front"]["steps"]
    evenness = [
        [each.name, f"stage {stage}", *(spread_text(single[name][f"stage{stage}"][m]) for m in _EVENNESS)]
        for name, each in TRAININGS.items()
        for stage in (1, 2)
    ]
    evenness.append([_FLOOR, "", *(f"{floor[metric]:.2f}" for metric in _EVENNESS)])
    lines = [
        f"Networks of the profile `{found['profile']}`, {found['seeds']} trainings of each, {found['shapes']} held-out "
        "shapes, one random code for each image. Mean ± standard deviation over trainings; distances un-squared, x100.",
        "",
        f"Stage 1 on single views, {stage1} steps. Converged, by the last validation: the error of the visible part "
        "below 30 % of the fresh network's; not converged: above 80 %, or less than half of the points in the "
        "silhouette. The last row is for as many points of the true surface, a lower bound.",
        "",
        *_table(single, "stage1", converged=True, floor=floor),
        "",
        f"The same networks after stage 2 on joined views, {stage2} more steps with the same loss:",
        "",
        *_table(single, "stage2"),
        "",
        f"Joined views from the first step, no stage 1, {many['front']['steps'][0]} steps:",
        "",
        *_table(many, "stage2", converged=True),
        "",
        "How evenly predictions for single views lie on the surface. Density in front: 1 is as dense as behind. "
        "Imbalance: share of the points that would have to move for 32 parts of the surface to be as dense.",
        "",
        *markdown_lines(["loss", "after", *_EVENNESS.values()], evenness, "llrr"),
    ]
    return "\n".join([*lines, ""])


def _table(
    rows: Mapping[str, Any], stage: str, *, converged: bool = False, floor: Mapping[str, float] | None = None
) -> list[str]:
    head = ["loss", *_SINGLE.values(), *(["error left", "converged?"] if converged else [])]
    lines = []
    for name, row in rows.items():
        cells = [TRAININGS[name].name, *(spread_text(row[stage][metric]) for metric in _SINGLE)]
        if converged:
            left = [curve["left"] for curve in row["curves"]]
            cells += [_between(left), _counted(curve["verdict"] for curve in row["curves"])]
        lines.append(cells)
    if floor:
        lines.append([_FLOOR, *(f"{floor[m]:.2f}" if m in floor else "" for m in _SINGLE), "", ""])
    return markdown_lines(head, lines)


def _between(shares: Sequence[float]) -> str:
    low, high = f"{min(shares):.0%}", f"{max(shares):.0%}"
    return low if low == high else f"{low} to {high}"


def _counted(verdicts: Any) -> str:
    counts = Counter(verdicts)
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items())


def curves(found: Mapping[str, Any]) -> Figure:
    """Validations during training: a line for each loss, a band from the lowest to the highest training."""
    figure = Figure(figsize=(14, 8), layout="constrained", dpi=110)
    figure.suptitle(
        f"Networks trained with each loss: {trainings(found['seeds'])} of each; mean, lowest and highest, validation "
        "shapes",
        fontsize=14,
        fontweight="bold",
    )
    rows = np.asarray(figure.subplots(2, len(_PANELS)))
    titles = {"single": "stage 1, single views", "many": "joined views from the start"}
    for line, (part, title) in zip(rows, titles.items(), strict=True):
        for axes, (name, label) in zip(line, _PANELS.items(), strict=True):
            for loss, row in found[part].items():
                _draw_band(axes, row["curves"], name, TRAININGS[loss].colour, TRAININGS[loss].name)
            axes.axhline(found["floor"][name], color=figures.MUTED, lw=1, ls="--", label=_FLOOR)
            if name != "inside":  # one that runs away would press the others flat
                start = max(training[name][0] for row in found[part].values() for training in row["curves"])
                axes.set_ylim(0, 1.6 * start)
            axes.set(title=title, xlabel="step", ylabel=label)
            if name == "inside":
                axes.set_ylim(0, 1)
            figures.plain(axes)
    rows[0, 0].legend(fontsize=8)
    return figure


def _draw_band(
    axes: Axes, trainings: Sequence[Mapping[str, Any]], name: str, colour: str, label: str
) -> None:
    values = np.array([training[name] for training in trainings])
    steps = trainings[0]["step"]
    axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
    axes.plot(steps, values.mean(0), color=colour, lw=1.6, label=label)


def predictions(seen: Batch, true: Tensor, clouds: Mapping[str, Tensor]) -> Figure:
    """What `networks.examples` gives, from the image's side and a quarter turn away."""
    images = seen.images[:, 0]
    columns = {"ground truth": true} | {TRAININGS[name].name: made for name, made in clouds.items()}
    figure = Figure(
        figsize=(1.9 * (len(columns) + 1), 3.6 * len(images) + 0.9), layout="constrained", dpi=110
    )
    figure.suptitle(
        "Held-out shapes after stage 1 on single views, 1 training of each. Above: from the image's side; "
        "below: after a quarter turn",
        fontsize=11,
    )
    panels = np.asarray(figure.subplots(2 * len(images), len(columns) + 1, squeeze=False))
    for shape in range(len(images)):
        upper, lower = panels[2 * shape], panels[2 * shape + 1]
        figures.draw_image(upper[0], images[shape])
        lower[0].axis("off")
        for place, (title, made) in enumerate(columns.items(), start=1):
            colours = figures.TRUE if place == 1 else figures.PREDICTED
            camera = seen.camera[shape][0]
            for axes, eye in zip((upper, lower), (camera, _beside(camera)), strict=True):
                figures.draw_cloud(axes[place], made[shape], eye, colours=colours)
            if shape == 0:
                upper[place].set_title("\n".join(title.split(", ")), fontsize=8)
    return figure


def _beside(camera: PinholeCamera) -> PinholeCamera:
    """The camera after a quarter turn around the world's vertical axis."""
    turn = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    return PinholeCamera(camera.K, camera.cam_from_world @ turn, camera.height, camera.width)
