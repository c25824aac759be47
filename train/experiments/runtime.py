"""How long does view-based sampling take, and how many of the points that it selects are hidden?

The paper gives one time and one share for clouds of 2048 and of 10 000 points, and no size of the map; here is a grid.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.spatial import Delaunay

from diffpoint import runtime_info, sample_view, splat_depth, visible_points
from diffpoint.visibility import Method
from train.data.families import FAMILIES
from train.data.render import Orbit
from train.experiments.frame import Experiment, Outcome
from train.experiments.hidden_points import EPSILON, VIEWS, Scene, embedded_scene, quality
from train.experiments.statistics import claim, claim_lines
from train.experiments.study import Study
from train.files import kept
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines

PAPER = {
    2048: {"hidden": 0.104, "zbuffer": 6.6, "triangulation": 209.8},
    10_000: {"hidden": 0.036, "zbuffer": 10.2, "triangulation": 1120.0},
}
"""The paper, by number of points: the hidden share; ms of its sampling on a GPU and of triangulating."""
COUNTS = tuple(PAPER)
SIDES = (28, 56, 112, 224)  # pixels
HEADLINES = (56, 28)
"""Sides of the maps in the text; the first is the released code's, and timed. The paper states none."""
EPSILONS = (EPSILON, 0.02)
_ROUNDS, _QUICK_ROUNDS = (31, 3), (3, 1)
"""Of sampling, and of triangulating, for each shape."""
_SEED = 0
_RATIO = "triangulation / z-buffer"
_COLOURS = ("#1f6f8b", "#c8553d")
_STYLES: dict[Method, tuple[str, str]] = {"zbuffer": ("z-buffer", "o-"), "horizon": ("horizon", "s--")}


def make(study: Study) -> Outcome:
    """Times view-based sampling and judges what it selects; trains nothing.

    The shapes are procedural ones, one of each family, up to `study.limit` of them; with `study.steps`, times are of a
    few repetitions. Shares are kept; times are measured at each call, since they depend on the machine at that moment.

    Returns:
        "time", in ms; "grid", a row for each epsilon, number of points, side of the map and method; "base", the hidden
        share of all points; "paper", its values.

    Raises:
        UserError: embree, which casts the rays, does not run here.
    """
    families = list(FAMILIES)[: study.limit]
    scenes = [embedded_scene(family, _SEED, COUNTS) for family in families]
    key = [families, _SEED, VIEWS, list(COUNTS), list(SIDES), list(_STYLES), list(EPSILONS)]
    found = kept(study.out / "runtime" / "hidden.json", key, lambda: _hidden(scenes))
    rounds = _ROUNDS if study.steps is None else _QUICK_ROUNDS
    times = [_times(scenes, count, rounds, progress=study.progress) for count in COUNTS]
    info = runtime_info()
    result = {
        "machine": {
            "processor": info.processor,
            "platform": platform.platform(),
            "cores": os.cpu_count(),
            "threads": info.threads,
        },
        "shapes": families,
        "views": VIEWS,
        "elevation_deg": list(Orbit().elevation_deg),
        "sides": list(SIDES),
        "timed": {"side": HEADLINES[0], "rounds": list(rounds)},
        "time": times,
        "claims": [_claim(row) for row in times],
        **found,
        "paper": [{"points": count, **_with_ratio(PAPER[count])} for count in COUNTS],
    }
    return Outcome(result, markdown(result), {"": _figure(result)})


runtime = Experiment(make)


def medians(
    functions: Mapping[Any, Callable[[], Any]], *, rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[Any, float]:
    """Median milliseconds of several functions, called in turns, so that other load on the machine affects all of
    them."""
    durations = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(rounds):
        for name, function in functions.items():
            start = clock()
            function()
            durations[name].append(1e3 * (clock() - start))
    return {name: float(np.median(each)) for name, each in durations.items()}


def _times(scenes: Sequence[Scene], count: int, rounds: tuple[int, int], *, progress: bool) -> dict[str, Any]:
    """Milliseconds of one cloud in one view: the median over shapes, and each."""
    found = []
    for scene in progress_bar(scenes, title=f"times, {count} points", unit="shape", progress=progress):
        cloud, camera = scene.clouds[count][None], scene.camera[0].resize(HEADLINES[0], HEADLINES[0])
        sampling = {
            "zbuffer": lambda c=cloud, k=camera: sample_view(c, splat_depth(c, k)),
            "horizon": lambda c=cloud, k=camera: sample_view(c, visible_points(c, k, method="horizon")),
        }
        triangulation = {"triangulation": functools.partial(Delaunay, cloud[0].double().numpy())}
        # In turns by shape only: what is called right after a triangulation finds cold caches, and takes twice its
        # time. And in the thread's time: on a busy machine, wall-clock time would include other load in long calls and
        # not in short ones.
        times = medians(sampling, rounds=rounds[0])
        found.append(times | medians(triangulation, rounds=rounds[1], clock=time.thread_time))
    by_shape = pd.DataFrame(found)
    return {"points": count, **_with_ratio(by_shape.median().to_dict()), "by_shape": by_shape.to_dict("list")}


def _claim(times: Mapping[str, Any]) -> dict[str, Any]:
    """Is sampling ten times faster than triangulating? Over shapes."""
    paper = PAPER[times["points"]]
    z_buffer, triangulation = (np.array([times["by_shape"][name]]) for name in ("zbuffer", "triangulation"))
    return claim(
        f"ms, {times['points']} points: 10 x z-buffer sampling < triangulation",
        triangulation - 10 * z_buffer,
        paper_gain=paper["triangulation"] - 10 * paper["zbuffer"],
    )


def _with_ratio(times: Mapping[str, float]) -> dict[str, float]:
    return {**times, _RATIO: times["triangulation"] / times["zbuffer"]}


def _hidden(scenes: Sequence[Scene]) -> dict[str, Any]:
    base, grid = [], []
    for epsilon, count in itertools.product(EPSILONS, COUNTS):
        judged = [dataclasses.replace(scene, epsilon=epsilon) for scene in scenes]
        row = {"epsilon": epsilon, "points": count}
        of_all = torch.stack([scene.hidden[count] for scene in judged]).double().mean().item()
        base.append(row | {"hidden": of_all})
        for side, method in itertools.product(SIDES, _STYLES):
            grid.append(row | {"side": side, "method": method, **quality(judged, count, side, method)})
    return {"base": base, "grid": grid}


def markdown(result: Mapping[str, Any]) -> str:
    """Times, claims, shares, and a summary in words."""
    (low, high), machine, timed = result["elevation_deg"], result["machine"], result["timed"]
    head = (
        f"{_about(result)}, procedural families, elevations between {low:g} and {high:g} degrees. A point is hidden if "
        "the ray from the camera to it meets the mesh more than eps (world units) before it. Selected: by the paper's "
        "z-buffer, or by this library's `horizon`, which does not depend on the size of the map."
    )
    how = (
        f"Milliseconds for one cloud in one view: `splat_depth` ({timed['side']} x {timed['side']}) or `horizon`, and "
        "`sample_view`; besides, triangulation of the cloud by `scipy.spatial.Delaunay` in 3D, which alone does not "
        f"yet determine what is hidden. Medians over shapes of medians of {timed['rounds'][0]} calls in wall-clock "
        f"time, and of {timed['rounds'][1]} triangulations in processor time. {machine['processor']}, "
        f"{machine['cores']} cores; the paper: a GPU."
    )
    times, shares = [], []
    for ours, paper in zip(result["time"], result["paper"], strict=True):
        ours_ms = (f"{ours[name]:.2f}" for name in ("zbuffer", "horizon", "triangulation"))
        times.append([_points(ours), *ours_ms, f"{ours[_RATIO]:.0f}"])
        theirs_ms = (f"{paper['zbuffer']:.1f}", "", f"{paper['triangulation']:.1f}", f"{paper[_RATIO]:.0f}")
        times.append([f"{_points(paper)}, the paper", *theirs_ms])
    grid: Any = _grid(result)
    hidden = {row["points"]: f"{row['hidden']:.1%}" for row in result["paper"]}
    for base, (method, (name, _)) in itertools.product(result["base"], _STYLES.items()):
        rows = grid.loc[method, base["epsilon"], :, base["points"]]
        cells = [f"{row.hidden:.1%} / {row.recall:.1%}" for row in rows.itertuples()]
        paper = hidden[base["points"]] if method == "zbuffer" else ""
        title = f"{name}, {_points(base)}, eps {base['epsilon']}"
        shares.append([title, *cells, f"{base['hidden']:.1%}", paper])
    sides = [f"{side} x {side}" for side in result["sides"]]
    parts = [
        [head],
        [how],
        markdown_lines(["", "z-buffer", "horizon", "triangulation", _RATIO], times),
        claim_lines(result["claims"]),
        ["Share of hidden points among the selected / share of selected points among the visible:"],
        markdown_lines(["", *sides, "hidden of all", "paper, hidden"], shares),
        [_summary(result)],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _grid(result: Mapping[str, Any]) -> pd.DataFrame:
    """The shares "hidden" and "recall" by method, epsilon, side of the map and number of points."""
    return pd.DataFrame(result["grid"]).set_index(["method", "epsilon", "side", "points"]).sort_index()


def _summary(result: Mapping[str, Any]) -> str:
    """The tables in words; each pair of numbers is of the two numbers of points."""
    grid: Any = _grid(result)
    epsilon, z_buffer = result["base"][0]["epsilon"], grid.loc["zbuffer"]
    first, second = (z_buffer.loc[epsilon, side] for side in HEADLINES)
    horizon = grid.loc["horizon", epsilon, HEADLINES[0]]
    paper = pd.DataFrame(result["paper"]).set_index("points")
    difference = (z_buffer["hidden"].unstack() - paper["hidden"]).abs().max(axis=1)
    best_epsilon, best = difference.idxmin()
    nearest = z_buffer.loc[best_epsilon, best]
    return (
        f"For {' and '.join(map(_points, result['paper']))}, view-based sampling is "
        f"{_pair(pd.DataFrame(result['time']), _RATIO, '.0f')} times as fast as the triangulation (the paper: "
        f"{_pair(paper, _RATIO, '.0f')}). At eps {epsilon}, {_pair(first, 'hidden')} of what the z-buffer selects is "
        f"hidden with maps of {HEADLINES[0]} x {HEADLINES[0]}, {_pair(second, 'hidden')} with {HEADLINES[1]} x "
        f"{HEADLINES[1]}; of all maps and eps, {best} x {best} at {best_epsilon} comes nearest to the paper's "
        f"{_pair(paper, 'hidden')}, with {_pair(nearest, 'hidden')}: at most {100 * difference.min():.1f} percentage "
        f"points of difference. `horizon` finds {_pair(horizon, 'recall')} of the visible points, and "
        f"{_pair(horizon, 'hidden')} of what it selects is hidden; the z-buffer of {HEADLINES[0]} x {HEADLINES[0]} "
        f"finds {_pair(first, 'recall')}."
    )


def _pair(rows: Any, name: str, form: str = ".1%") -> str:
    return " and ".join(format(value, form) for value in rows[name])


def _about(result: Mapping[str, Any]) -> str:
    return f"{len(result['shapes'])} shapes, {result['views']} views of each"


def _points(row: Mapping[str, Any]) -> str:
    return f"{row['points']} points"


def _figure(result: Mapping[str, Any]) -> Figure:
    """Both shares against the side of the map, for the first epsilon."""
    epsilon, grid = result["base"][0]["epsilon"], _grid(result)
    figure = Figure(figsize=(11.5, 4.8), layout="constrained", dpi=110)
    panels = figure.subplots(1, 2)
    for paper, colour in zip(result["paper"], _COLOURS, strict=True):
        for method, (name, style) in _STYLES.items():
            rows: Any = 100 * grid.loc[method, epsilon, :, paper["points"]]
            for axes, share in zip(panels, ("hidden", "recall"), strict=True):
                label = f"{name}, {_points(paper)}"
                axes.plot(result["sides"], rows[share], style, color=colour, ms=4.5, label=label)
        label = f"the paper, {_points(paper)}: {paper['hidden']:.1%}"
        panels[0].axhline(100 * paper["hidden"], color=colour, ls=":", lw=1.2, label=label)
    for axes, chosen, of in zip(panels, ("Hidden", "Visible"), ("selected", "visible"), strict=True):
        axes.set(title=f"{chosen} points that are selected", ylabel=f"share of the {of} points, %")
        axes.set_xscale("log", base=2)
        axes.set_xticks(result["sides"], [str(side) for side in result["sides"]])
        axes.set(xlabel="side of the map, pixels", ylim=(0, None))
        figures.plain(axes)
        axes.legend(fontsize=8, frameon=False)
    figure.suptitle(f"Points selected by view-based sampling: {_about(result)}, eps = {epsilon}", fontsize=11)
    return figure
