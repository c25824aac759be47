"""Results on free clouds: a summary, Markdown tables, figures and an animation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from train.evaluation.metrics import in_silhouette
from train.experiments.front_vs_projection.free_clouds import LOSSES, MEASURED_EVERY, Fit, fit_cloud
from train.experiments.front_vs_projection.shapes import Cameras, Scene, StudyShape
from train.files import replacing
from train.show import figures
from train.show.tables import markdown_lines

MEASURES = {
    "visible_cd": "visible part, chamfer x100",
    "inside": "share inside the silhouettes",
    "pred_to_gt": "cloud -> whole shape, x100",
    "gt_to_pred": "whole shape -> cloud, x100",
    "sideways": "share of gradient in the first camera's x, y",
    "ms_per_iteration": "ms per iteration",
}
INSIDE, OUTSIDE = "#2a9d8f", "#e76f51"
ONE, MANY = Cameras(1), Cameras(24, sphere=True)
DRAWN = ("projection", "lin", "soft", "front")


def summarise(
    fits: Sequence[Mapping[str, Any]],
    shapes: Sequence[StudyShape],
    *,
    iterations: int,
    rates: Mapping[str, float],
    seeds: int,
) -> dict[str, Any]:
    """Means and standard deviations over shapes and seeds, by cameras and loss; and the comparison for one view."""
    table: dict[str, dict[str, Any]] = {}
    values: Any = pd.DataFrame(fits)
    for (cameras, loss), cells in values.groupby(["cameras", "loss"], sort=False):
        columns = cells[[*MEASURES, "left"]]
        table.setdefault(str(cameras), {})[str(loss)] = {
            "fits": len(cells),
            **pd.DataFrame({"mean": columns.mean(), "sd": columns.std(ddof=0)}).to_dict("index"),
            "visible_cd_on_the_way": np.mean(cells["visible_cd_on_the_way"].tolist(), 0).round(4).tolist(),
        }
    return {
        "iterations": iterations,
        "seeds": seeds,
        "rates": dict(rates),
        "shapes": {shape.name: shape.source for shape in shapes},
        "table": table,
        "one_view": _one_view(values[values["cameras"] == ONE.name]),
        "fits": list(fits),
    }


def _one_view(fits: Any) -> dict[str, Any]:
    """For every loss: its error of the visible part over that of the front constraint, and its sideways gradient."""
    front = fits[fits["loss"] == "front"].set_index(["shape", "seed"])["visible_cd"].rename("front_cd")
    fits = fits.join(front, on=["shape", "seed"])
    fits["ratio"] = fits["visible_cd"] / fits["front_cd"]
    found: dict[str, Any] = {}
    for loss, cells in fits.groupby("loss", sort=False):
        ratios = cells.groupby("shape", sort=False)["ratio"].agg(["min", "max"])
        ratios.columns = ["least", "most"]
        found[str(loss)] = {
            "times_front": ratios.to_dict("index"),
            "largest_sideways_gradient": cells["largest_sideways"].max().item(),
        }
    return found


def markdown(found: Mapping[str, Any]) -> str:
    """Tables of everything."""
    names = ", ".join(f"{shape} ({source})" for shape, source in found["shapes"].items())
    seeds, shapes = _counted(found["seeds"], "seed"), _counted(len(found["shapes"]), "shape")
    rates = ", ".join(f"{LOSSES[loss].title} {rate:g}" for loss, rate in found["rates"].items())
    rows = [
        [
            cameras,
            LOSSES[loss].title,
            *(_value(name, cell[name]) for name in MEASURES),
            f"{cell['left']['mean']:.0%}",
        ]
        for cameras, by_loss in found["table"].items()
        for loss, cell in by_loss.items()
    ]
    head = ["cameras", "loss", *MEASURES.values(), "points left"]
    lines = [
        f"Free clouds of 1024 points, {found['iterations']} steps of Adam, {seeds} (start and turn of the cameras) of "
        f"each of {shapes}: {names}. Mean ± standard deviation over shapes and seeds; distances are un-squared, "
        "x100, of shapes about 1 across.",
        "",
        f"First step sizes, the best of three for each loss on another shape: {rates}.",
        "",
        *markdown_lines(head, rows, "ll" + "r" * (len(head) - 2)),
    ]
    if "front" in found["one_view"]:
        shape_names = list(found["shapes"])
        rows = []
        for loss, each in found["one_view"].items():
            if loss == "front":
                continue
            ratios, largest = each["times_front"], each["largest_sideways_gradient"]
            cells = [
                f"{ratios[s]['least']:.1f} to {ratios[s]['most']:.1f}" if s in ratios else ""
                for s in shape_names
            ]
            rows.append([LOSSES[loss].title, *cells, "0 exactly" if largest == 0 else f"{largest:.2g}"])
        lines += [
            "",
            "One view: error of the visible part, as a multiple of the front constraint's, smallest to largest over "
            "the seeds; and the largest gradient in the camera's x or y of any point at any step.",
            "",
            *markdown_lines(["loss", *shape_names, "largest gradient in x, y"], rows),
        ]
    return "\n".join([*lines, ""])


def _value(name: str, cell: Mapping[str, float]) -> str:
    digits = 1 if name == "ms_per_iteration" else 2
    return f"{cell['mean']:.{digits}f} ± {cell['sd']:.{digits}f}"


def draw(
    found: Mapping[str, Any], shape: StudyShape, out: Path, *, iterations: int, rates: Mapping[str, float]
) -> dict[str, Figure]:
    """The curves of all fits; with one view also the clouds of one shape, and an animation of them in `out`."""
    drawn = {"": curves(found)}
    if ONE.name not in found["table"]:
        return drawn
    kept = range(0, iterations + 1, max(1, iterations // 40))
    scenes = {c: shape.scene(c, seed=0) for c in (ONE, MANY) if c.name in found["table"]}
    fits = {
        (cameras, loss): fit_cloud(scene, LOSSES[loss], iterations=iterations, rate=rates[loss], kept=kept)
        for cameras, scene in scenes.items()
        if scene is not None
        for loss in DRAWN
    }
    seen = {cameras: scene for cameras, scene in scenes.items() if scene is not None}
    one = {loss: fit for (cameras, loss), fit in fits.items() if cameras == ONE}
    animate(seen[ONE], one, out / "front-vs-projection-clouds.gif")
    return drawn | {"-clouds": clouds(seen, fits, shape.name)}


def curves(found: Mapping[str, Any]) -> Figure:
    """Every measure over the cameras, and the visible error over the iterations of a single view."""
    figure = Figure(figsize=(14, 8.4), layout="constrained", dpi=110)
    count = f"{_counted(len(found['shapes']), 'shape')} x {_counted(found['seeds'], 'seed')}"
    figure.suptitle(
        f"Free clouds fitted to depth maps: {count}, mean and standard deviation",
        fontsize=14,
        fontweight="bold",
    )
    panels = list(np.asarray(figure.subplots(2, 3)).flat)
    cameras = list(found["table"])
    shown = [name for name in MEASURES if name != "gt_to_pred"]
    for axes, name in zip(panels, shown, strict=False):
        for offset, loss in enumerate(LOSSES):
            there = [c for c in cameras if loss in found["table"][c]]
            cells = [found["table"][c][loss][name] for c in there]
            axes.errorbar(
                [cameras.index(c) + 0.06 * (offset - 2) for c in there],
                [cell["mean"] for cell in cells],
                yerr=[cell["sd"] for cell in cells],
                color=LOSSES[loss].colour, marker="o", ms=4, lw=1.4, capsize=2, label=LOSSES[loss].title,
            )  # fmt: skip
        axes.set_xticks(range(len(cameras)), [_short(c) for c in cameras], fontsize=8)
        axes.set(xlabel="cameras: how many, and where", ylabel=MEASURES[name])
        if name in ("visible_cd", "pred_to_gt", "ms_per_iteration"):
            axes.set_yscale("log")
    last = panels[-1]
    for loss, cell in found["table"][cameras[0]].items():
        values = cell["visible_cd_on_the_way"]
        last.plot(
            np.arange(len(values)) * MEASURED_EVERY,
            values,
            color=LOSSES[loss].colour,
            label=LOSSES[loss].title,
        )
    last.set(xlabel="iteration", ylabel=f"{MEASURES['visible_cd']}, {cameras[0]}", yscale="log")
    last.legend(fontsize=8)
    for axes in figure.axes:
        figures.plain(axes)
    return figure


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _short(cameras: str) -> str:
    count, kind, _ = cameras.split(" ")
    return f"{count}\n{kind}"


def clouds(scenes: Mapping[Cameras, Scene], fits: Mapping[tuple[Cameras, str], Fit], shape: str) -> Figure:
    """A row for each loss: the cloud during the fit to one view, and after the fit to many."""
    one = scenes[ONE]
    steps = sorted(fits[ONE, DRAWN[0]].clouds)
    shown = [steps[round(share * (len(steps) - 1))] for share in (0, 0.1, 0.3, 1)]
    columns = len(shown) + (MANY in scenes) + 1
    figure = Figure(figsize=(2.5 * columns, 2.35 * len(DRAWN) + 0.9), layout="constrained", dpi=110)
    figure.suptitle(
        f"{shape}, 1 seed, seen from 70\N{DEGREE SIGN} beside the first camera, which looks from the left (arrow).\n"
        "Green: the point falls into the silhouette of every view. Red: it does not.",
        fontsize=11,
    )  # fmt: skip
    panels = np.asarray(figure.subplots(len(DRAWN), columns))
    for row, loss in zip(panels, DRAWN, strict=True):
        for axes, step in zip(row, shown, strict=False):
            draw_cloud(axes, one, fits[ONE, loss].clouds[step])
        if MANY in scenes:
            draw_cloud(row[len(shown)], scenes[MANY], fits[MANY, loss].clouds[steps[-1]])
        draw_cloud(row[-1], one, one.surface[0, ::3])
        row[0].set_ylabel(LOSSES[loss].title, fontsize=9, color=LOSSES[loss].colour, fontweight="bold")
        row[0].annotate("", (-0.5, 0), (-0.85, 0), arrowprops={"arrowstyle": "->", "lw": 1.5})
    titles = [f"{ONE.name}, step {step}" for step in shown]
    titles += [f"{MANY.name},\nstep {steps[-1]}"] if MANY in scenes else []
    for axes, title in zip(panels[0], [*titles, "the shape itself"], strict=True):
        axes.set_title(title, fontsize=10)
    return figure


def draw_cloud(axes: Axes, scene: Scene, cloud: Tensor) -> None:
    """A cloud (N, 3) from 70 degrees beside the first camera, around the middle of the scene."""
    angle = torch.deg2rad(torch.tensor(70.0))
    x, y, z = (cloud - scene.surface[0].mean(0)).unbind(-1)
    across, away = z * angle.sin() + x * angle.cos(), z * angle.cos() - x * angle.sin()
    inside = in_silhouette(cloud[None], scene.camera, scene.depth, margin=1)[0].all(0)
    order = away.argsort(descending=True)
    colours = [INSIDE if kept else OUTSIDE for kept in inside[order].tolist()]
    axes.scatter(across[order], -y[order], c=colours, s=4, linewidths=0)
    axes.set(xlim=(-0.85, 0.75), ylim=(-0.65, 0.65), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def animate(scene: Scene, fits: Mapping[str, Fit], path: Path) -> None:
    """A GIF: the clouds of all losses side by side, step after step; the end stays for a second and a half."""
    steps = sorted(next(iter(fits.values())).clouds)
    frames = []
    for step in steps:
        figure = Figure(figsize=(3 * len(fits), 2.9), dpi=75)
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.8, wspace=0.02)
        figure.suptitle(f"one view, from the left; step {step}", fontsize=11)
        for axes, (loss, fit) in zip(
            np.asarray(figure.subplots(1, len(fits))).flat, fits.items(), strict=True
        ):
            draw_cloud(axes, scene, fit.clouds[step])
            axes.set_title(LOSSES[loss].title, fontsize=10, color=LOSSES[loss].colour)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3])
    with replacing(path) as temporary:
        durations = [80] * (len(frames) - 1) + [1500]
        imageio.imwrite(temporary, np.stack(frames), extension=".gif", duration=durations, loop=0)
