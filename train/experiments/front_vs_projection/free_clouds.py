"""Free clouds: points without a network, moved by the gradient of a loss on depth maps; from one view to 24.

OUT/free-clouds/*.json holds one fit each: a stopped study continues there.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import chamfer_distance, front_constraint, projection_loss, soft_projection_loss
from train.errors import UserError
from train.evaluation.metrics import in_silhouette, visible_error
from train.experiments.front_vs_projection import scenes
from train.experiments.front_vs_projection.scenes import Cameras, Scene, StudyShape
from train.experiments.study import Study
from train.files import kept, replacing
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines

ONE, MANY = Cameras(1), Cameras(24, sphere=True)
SETTINGS = (ONE, Cameras(2), Cameras(4), Cameras(8), Cameras(8, sphere=True), MANY)
RATES = (0.003, 0.01, 0.03)
_TUNED_ON = (ONE, Cameras(8, sphere=True))
_ITERATIONS, _LEAST_ITERATIONS, _MEASURED_EVERY = 200, 20, 10
_SHAPES = 2
MEASURES = {
    "visible_cd": "visible part, chamfer x100",
    "inside": "share inside the silhouettes",
    "pred_to_gt": "cloud -> whole shape, x100",
    "gt_to_pred": "whole shape -> cloud, x100",
    "sideways": "share of gradient in the first camera's x, y",
    "ms_per_iteration": "ms per iteration",
}
_DRAWN = ("projection", "lin", "soft", "front")
_INSIDE, _OUTSIDE = "#2a9d8f", "#e76f51"


class Loss(NamedTuple):
    """One way to compare a cloud with depth maps."""

    title: str
    colour: str
    value: Callable[[Tensor, Tensor, Scene, float], Tensor]
    """(cloud (1, N, 3), occupancy logits of its points (1, N), scene, progress in [0, 1]) -> a scalar."""


def _radius(progress: float) -> float:
    """Of soft footprints, in pixels: large ones reach far, small ones are sharp."""
    return 6.0 * (0.75 / 6.0) ** min(1.0, 2 * progress)


LOSSES = {
    "front": Loss("front constraint", "#22577a", lambda x, _, s, __: front_constraint(x, s.camera, s.depth)),
    "front_emd": Loss(
        "front constraint, EMD",
        "#57a0c9",
        lambda x, _, s, __: front_constraint(x, s.camera, s.depth, distance="emd", tolerance=0.05),
    ),
    "projection": Loss(
        "projection loss, depth alone", "#c8553d", lambda x, _, s, __: projection_loss(x, s.camera, s.depth)
    ),
    "lin": Loss(
        "projection loss of Lin et al.",
        "#e59866",
        lambda x, e, s, __: projection_loss(x, s.camera, s.depth, logits=e, mask_weight=1.0, upsample=2),
    ),
    "soft": Loss(
        "soft projection loss",
        "#6a994e",
        lambda x, _, s, t: soft_projection_loss(x, s.camera, s.depth, radius=_radius(t)),
    ),
}


def fit_cloud(
    scene: Scene, loss: str, *, iterations: int, rate: float
) -> tuple[dict[str, Any], list[Tensor]]:
    """Minimises one of `LOSSES` by Adam, with a step size that falls from `rate` (world units) to 0 along a cosine.

    Returns:
        Errors of the last cloud: "visible_cd", the chamfer distance x100 between the visible part of the cloud and of
        the shape, mean over the views; "inside", the share of points in the silhouettes; "pred_to_gt" and "gt_to_pred",
        mean distances x100 to the whole shape and back; "left", the share of points that were not removed. Of the
        gradient: "sideways", its share in the first camera's x and y, mean over iterations; "largest_sideways", of any
        point at any iteration. And the clouds (N, 3) before every iteration and after the last.

    Example:
        >>> from train.experiments.front_vs_projection.scenes import Cameras, embedded_shape
        >>> scene = embedded_shape("chair").scene(Cameras(1), seed=0, points=64)
        >>> fit_cloud(scene, "projection", iterations=3, rate=0.01)[0]["largest_sideways"]
        0.0
    """
    cloud = scene.start.clone().requires_grad_()
    logits = torch.full(cloud.shape[:2], 0.5).requires_grad_()  # most losses have no gradient for them
    optimiser = torch.optim.Adam([cloud, logits], lr=rate)
    clouds, losses, sideways, largest, seconds = [_existing(cloud, logits)], [], [], 0.0, 0.0
    with warnings.catch_warnings():  # of a view that sees no point: here that is a result
        warnings.filterwarnings("ignore", message="front_constraint: in ", category=RuntimeWarning)
        for iteration in range(iterations):
            begun = time.perf_counter()
            optimiser.param_groups[0]["lr"] = rate * (1 + math.cos(math.pi * iteration / iterations)) / 2
            optimiser.zero_grad()
            value = LOSSES[loss].value(cloud, logits, scene, iteration / iterations)
            value.backward()
            optimiser.step()
            seconds += time.perf_counter() - begun
            assert cloud.grad is not None
            across, whole = cloud.grad[..., :2], cloud.grad.norm()
            losses.append(value.item())
            sideways.append((across.norm() / whole).item() if whole > 0 else 0.0)
            largest = max(largest, across.abs().max().item())
            clouds.append(_existing(cloud, logits))
    whole = chamfer_distance(clouds[-1], scene.surface, squared=False)
    visible = [
        visible_error(each, scene.camera, scene.depth).mean().item()
        for each in (*clouds[:-1:_MEASURED_EVERY], clouds[-1])
    ]
    measured = {
        "visible_cd": visible[-1],
        "inside": in_silhouette(clouds[-1], scene.camera, scene.depth).float().mean().item(),
        "pred_to_gt": 100 * whole.a_to_b.item(),
        "gt_to_pred": 100 * whole.b_to_a.item(),
        "left": clouds[-1].shape[1] / scene.start.shape[1],
        "sideways": sum(sideways) / iterations,
    }
    record = {name: round(number, 6) for name, number in measured.items()} | {
        "largest_sideways": largest,
        "ms_per_iteration": round(1000 * seconds / iterations, 3),
        "first_loss": losses[0],
        "last_loss": losses[-1],
        "visible_cd_on_the_way": [round(error, 4) for error in visible],
    }
    return record, [each[0] for each in clouds]


def _existing(cloud: Tensor, logits: Tensor) -> Tensor:
    """(1, M, 3) the points that are not removed; all of them if none is left."""
    exists = logits[0] > 0
    return cloud.detach()[:, exists if exists.any() else slice(None)].clone()


def free_clouds(study: Study) -> tuple[dict[str, Any], dict[str, Figure]]:
    """Fits every cloud that has not been fitted yet; writes the animation.

    The shapes are procedural ones and those of the study's data, see `scenes.shapes_of`. Seeds draw start clouds and
    turns of the cameras.

    Returns:
        All numbers, and figures by the ending of their files.

    Raises:
        UserError: unusable data, or numbers out of range.
    """
    limit, iterations = study.limit or _SHAPES, study.steps or _ITERATIONS
    if iterations < _LEAST_ITERATIONS:
        raise UserError(f"a fit needs at least --steps {_LEAST_ITERATIONS}; got {iterations}")
    if limit > len(scenes.EMBEDDED):
        raise UserError(f"--limit must be at most {len(scenes.EMBEDDED)}; got {limit}")
    shapes = [scenes.embedded_shape(category) for category in scenes.EMBEDDED[:limit]]
    shapes += scenes.shapes_of(study.data, limit=limit)
    names = [shape.name for shape in shapes]
    if doubles := {name for name in names if names.count(name) > 1}:
        raise UserError(f"two shapes of --data are called {', '.join(sorted(doubles))}; leave one source out")
    with _one_thread():
        rates = {
            loss: _best_rate(study, loss)
            for loss in progress_bar(LOSSES, title="step sizes", unit="loss", progress=study.progress)
        }
        cells = [
            cell
            for cell in itertools.product(range(study.seeds), shapes, SETTINGS, LOSSES)
            if takes_part(cell[3], cell[2])
        ]
        bar = progress_bar(cells, title="free clouds", unit="fit", progress=study.progress)
        fits = [_fit(study, *cell[1:], seed=cell[0], rate=rates[cell[3]]) for cell in bar]
        found = {
            "iterations": iterations,
            "seeds": study.seeds,
            "rates": rates,
            "shapes": {shape.name: shape.source for shape in shapes},
            **summarise([fit for fit in fits if fit is not None]),
        }
        return found, draw(found, shapes[0], study.out)


@contextmanager
def _one_thread() -> Iterator[None]:
    """The tensors are so small that torch's threads would wait more than they work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def takes_part(loss: str, cameras: Cameras) -> bool:
    """Is a loss measured with these cameras? An assignment far from its target takes most of a second per view."""
    return loss != "front_emd" or cameras == ONE


def _best_rate(study: Study, loss: str) -> float:
    """The best step size, on a shape that is not in the study, by the geometric mean of errors of the visible part."""
    shape = scenes.embedded_shape("bench", seed=1)

    def error(rate: float) -> float:
        prefix, views = f"tuning_{rate:g}_", [cameras for cameras in _TUNED_ON if takes_part(loss, cameras)]
        fits = (_fit(study, shape, cameras, loss, seed=0, rate=rate, prefix=prefix) for cameras in views)
        return sum(math.log(fit["visible_cd"]) for fit in fits if fit is not None)

    return min(RATES, key=error)


def _fit(
    study: Study, shape: StudyShape, cameras: Cameras, loss: str, *, seed: int, rate: float, prefix: str = ""
) -> dict[str, Any] | None:
    """The record of a fit, made now or kept from the same scene and settings; None if the shape has no such views."""
    scene, iterations = shape.scene(cameras, seed=seed), study.steps or _ITERATIONS
    if scene is None:
        return None
    parts = (scene.depth, scene.camera.cam_from_world, scene.surface, scene.start)
    digest = hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in parts)).hexdigest()[:16]
    key = {"iterations": iterations, "rate": rate, "scene": digest}
    name = f"{prefix}{shape.name}-{cameras.name.replace(' ', '-')}-{loss}-seed{seed}.json"
    path = study.out / "free-clouds" / name
    record = kept(path, key, lambda: fit_cloud(scene, loss, iterations=iterations, rate=rate)[0])
    return {"shape": shape.name, "cameras": cameras.name, "loss": loss, "seed": seed, **record}


def summarise(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means and standard deviations over shapes and seeds.

    Returns:
        "table", by cameras and loss; "one_view", by loss and shape the error of the visible part over that of the front
        constraint, and the largest sideways gradient; "fits", the records.
    """
    fits: Any = pd.DataFrame(records)
    table: dict[str, dict[str, Any]] = {}
    for (cameras, loss), cells in fits.groupby(["cameras", "loss"], sort=False):
        columns = cells[[*MEASURES, "left"]]
        table.setdefault(cameras, {})[loss] = {
            "fits": len(cells),
            **pd.DataFrame({"mean": columns.mean(), "sd": columns.std(ddof=0)}).to_dict("index"),
            "visible_cd_on_the_way": np.mean(cells["visible_cd_on_the_way"].tolist(), 0).round(4).tolist(),
        }
    one = fits[fits["cameras"] == ONE.name]
    errors = one.pivot(index=["shape", "seed"], columns="loss", values="visible_cd")
    ratios = errors.div(errors["front"], axis=0).groupby("shape").agg(["min", "max"])
    ratios = ratios.rename(columns={"min": "least", "max": "most"})
    largest = one.groupby("loss")["largest_sideways"].max()
    one_view = {
        loss: {
            "times_front": ratios[loss].to_dict("index"),
            "largest_sideways_gradient": float(largest[loss]),
        }
        for loss in LOSSES
    }
    return {"table": table, "one_view": one_view, "fits": list(records)}


def markdown(found: Mapping[str, Any]) -> str:
    """Tables of everything."""
    rates = ", ".join(f"{LOSSES[loss].title} {rate:g}" for loss, rate in found["rates"].items())
    rows = [
        [
            cameras,
            LOSSES[loss].title,
            *(f"{cell[name]['mean']:.2f} ± {cell[name]['sd']:.2f}" for name in list(MEASURES)[:-1]),
            f"{cell['ms_per_iteration']['mean']:.1f} ± {cell['ms_per_iteration']['sd']:.1f}",
            f"{cell['left']['mean']:.0%}",
        ]
        for cameras, by_loss in found["table"].items()
        for loss, cell in by_loss.items()
    ]
    ratios = []
    for loss, each in found["one_view"].items():
        by_shape = [each["times_front"].get(shape) for shape in found["shapes"]]
        cells = [
            "" if ratio is None else f"{ratio['least']:.1f} to {ratio['most']:.1f}" for ratio in by_shape
        ]
        largest = each["largest_sideways_gradient"]
        if loss != "front":
            ratios.append([LOSSES[loss].title, *cells, "0 exactly" if largest == 0 else f"{largest:.2g}"])
    head = ["cameras", "loss", *MEASURES.values(), "points left"]
    seeds, shapes = _counted(found["seeds"], "seed"), _counted(len(found["shapes"]), "shape")
    names = ", ".join(f"{shape} ({source})" for shape, source in found["shapes"].items())
    lines = [
        f"Free clouds of {scenes.POINTS} points, {found['iterations']} steps of Adam, {seeds} (start and turn of the "
        f"cameras) of each of {shapes}: {names}. Mean ± standard deviation over shapes and seeds; distances are "
        "un-squared, x100, of shapes about 1 across.",
        "",
        f"First step sizes, the best of three for each loss on another shape: {rates}.",
        "",
        *markdown_lines(head, rows, "ll".ljust(len(head), "r")),
        "",
        "One view: error of the visible part, as a multiple of the front constraint's, smallest to largest over "
        "the seeds; and the largest gradient in the camera's x or y of any point at any step.",
        "",
        *markdown_lines(["loss", *found["shapes"], "largest gradient in x, y"], ratios),
    ]
    return "\n".join([*lines, ""])


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def draw(found: Mapping[str, Any], shape: StudyShape, out: Path) -> dict[str, Figure]:
    """The curves of all fits, and clouds of one shape during the fit; an animation of these in `out`."""
    iterations = found["iterations"]
    one, many = (shape.scene(cameras, seed=0) for cameras in (ONE, MANY))
    assert one is not None and many is not None

    def clouds(scene: Scene) -> dict[str, list[Tensor]]:
        return {
            loss: fit_cloud(scene, loss, iterations=iterations, rate=found["rates"][loss])[1]
            for loss in _DRAWN
        }

    of_one, of_many = clouds(one), clouds(many)
    steps = range(0, iterations + 1, max(1, iterations // 40))
    animate(one, of_one, steps, out / "front-vs-projection-clouds.gif")
    shown = [steps[round(share * (len(steps) - 1))] for share in (0, 0.1, 0.3, 1)]
    figure, panels = figures.grid(rows=len(_DRAWN), columns=len(shown) + 2)
    for row, loss in zip(panels, _DRAWN, strict=True):
        for axes, step in zip(row, shown, strict=False):
            _draw_cloud(axes, one, of_one[loss][step])
        _draw_cloud(row[-2], many, of_many[loss][steps[-1]])
        _draw_cloud(row[-1], one, one.surface[0, ::3])
        name = {"rotation": 90, "va": "center", "color": LOSSES[loss].colour, "fontweight": "bold"}
        row[0].text(-0.85, 0, LOSSES[loss].title, fontsize=8, **name)
        row[0].annotate("", (-0.5, 0), (-0.75, 0), arrowprops={"arrowstyle": "->", "lw": 1.5})
    names = [f"{ONE.name}, step {step}" for step in shown]
    names += [f"{MANY.name}, step {steps[-1]}", "the shape itself"]
    for axes, name in zip(panels[0], names, strict=True):
        axes.set_title(name, fontsize=9)
    figures.headline(
        figure,
        f"{shape.name}, 1 seed, from 70\N{DEGREE SIGN} beside the first camera (arrow); green: points in the "
        "silhouette of every view; red: others",
    )
    return {"": curves(found), "-clouds": figure}


def curves(found: Mapping[str, Any]) -> Figure:
    """Every measure over the cameras, and the visible error over the iterations of a single view."""
    figure = Figure(figsize=(14, 8.4), layout="constrained", dpi=110)
    count = f"{_counted(len(found['shapes']), 'shape')} x {_counted(found['seeds'], 'seed')}"
    figure.suptitle(f"Free clouds fitted to depth maps: {count}, mean and standard deviation", fontsize=14)
    *panels, last = np.asarray(figure.subplots(2, 3)).flat
    cameras = list(found["table"])
    for number, (loss, (title, colour, _)) in enumerate(LOSSES.items()):
        cells = {
            place: by_loss[loss] for place, by_loss in enumerate(found["table"].values()) if loss in by_loss
        }
        at = np.array(list(cells)) + 0.06 * (number - 2)
        style = {"color": colour, "lw": 1.4, "label": title}
        for axes, name in zip(panels, (name for name in MEASURES if name != "gt_to_pred"), strict=True):
            mean, sd = ([cell[name][each] for cell in cells.values()] for each in ("mean", "sd"))
            axes.errorbar(at, mean, yerr=sd, marker="o", ms=4, capsize=2, **style)
            axes.set(xlabel="cameras: how many, and where", ylabel=MEASURES[name])
            axes.set_xticks(range(len(cameras)), ["\n".join(c.split()[:2]) for c in cameras], fontsize=8)
            if name in ("visible_cd", "pred_to_gt", "ms_per_iteration"):
                axes.set_yscale("log")
        values = cells[0]["visible_cd_on_the_way"]
        last.plot(np.arange(len(values)) * _MEASURED_EVERY, values, **style)
    last.set(xlabel="iteration", ylabel=f"{MEASURES['visible_cd']}, {cameras[0]}", yscale="log")
    last.legend(fontsize=8)
    for axes in figure.axes:
        figures.plain(axes)
    return figure


def _draw_cloud(axes: Axes, scene: Scene, cloud: Tensor) -> None:
    """A cloud (N, 3) from 70 degrees beside the first camera, around the middle of the scene."""
    angle = torch.deg2rad(torch.tensor(70.0))
    x, y, z = (cloud - scene.surface[0].mean(0)).unbind(-1)
    across, away = z * angle.sin() + x * angle.cos(), z * angle.cos() - x * angle.sin()
    inside = in_silhouette(cloud[None], scene.camera, scene.depth, margin=1)[0].all(0)
    order = away.argsort(descending=True)
    colours = np.where(inside[order], _INSIDE, _OUTSIDE)
    axes.scatter(across[order], -y[order], c=colours, s=4, linewidths=0)
    axes.set(xlim=(-0.85, 0.75), ylim=(-0.65, 0.65), aspect="equal")
    figures.bare(axes)


def animate(scene: Scene, fits: Mapping[str, Sequence[Tensor]], steps: Sequence[int], path: Path) -> None:
    """A GIF: the clouds of all losses side by side, step after step; the end stays for a second and a half."""
    frames = []
    for step in steps:
        figure, panels = figures.grid(rows=1, columns=len(fits))
        for axes, (loss, clouds) in zip(panels[0], fits.items(), strict=True):
            _draw_cloud(axes, scene, clouds[step])
            axes.set_title(LOSSES[loss].title, fontsize=9, color=LOSSES[loss].colour)
        figures.headline(figure, f"one view, from the left; step {step}")
        figure.set_dpi(75)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3])
    with replacing(path) as temporary:
        durations = [80] * (len(frames) - 1) + [1500]
        imageio.imwrite(temporary, np.stack(frames), extension=".gif", duration=durations, loop=0)
