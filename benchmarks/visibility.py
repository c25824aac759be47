"""`python -m benchmarks.visibility`: accuracy of the methods of `visible_points`, against ray casting, and their times.

Hidden share = hidden points among those kept; recall = kept points among the visible ones; both are means over views.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported

import torch

import diffpoint as dp
from benchmarks.saved import machine
from benchmarks.tables import markdown
from benchmarks.visibility_shapes import (
    FURNITURE,
    MEASURED,
    Scene,
    mesh_scenes,
    procedural_scenes,
)
from diffpoint.visibility import METHODS, Method
from train.experiments.hidden_points import quality
from train.experiments.runtime import COUNTS, PAPER, medians

SIZES = (28, 32, 40, 56, 112, 224)
HEADLINE = 56
TARGET = {"hidden": 0.05, "recall": 0.75, "ratio": 3.0}
SWEEPS: dict[Method, tuple[str, tuple[float, ...]]] = {
    "horizon": ("tolerance", (0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5, 0.7)),
    "hpr": ("radius", (1.0, 1.25, 1.5, 1.75, 2.0, 2.5)),
}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.visibility", description=__doc__)
    parser.add_argument(
        "--meshes", type=Path, help="folder or archive of meshes instead of the installed furniture"
    )
    parser.add_argument("--per-category", type=int, default=6, help="meshes of each category (default: 6)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    arguments = parser.parse_args()

    scenes = gather(arguments.meshes, arguments.per_category)
    print(f"{len(scenes)} shapes x {len(scenes[0].camera.position)} views", flush=True)
    grid = [
        {"size": size, "points": count, "method": method, **quality(scenes, count, size, method)}
        for count in COUNTS
        for size in SIZES
        for method in METHODS
        if method != "hpr" or size == HEADLINE  # independent of the size, and slow
    ]
    curves = [
        {
            "points": count,
            "method": method,
            name: value,
            **quality(scenes, count, HEADLINE, method, **{name: value}),
        }
        for count in COUNTS
        for method, (name, values) in SWEEPS.items()
        for value in values
    ]
    result = {
        "machine": machine(),
        "shapes": [f"{scene.category}: {scene.name}" for scene in scenes],
        "base_hidden": {n: float(torch.cat([s.hidden[n] for s in scenes]).float().mean()) for n in COUNTS},
        "paper": PAPER,
        "target": TARGET,
        "grid": grid,
        "curves": curves,
        "time": [row for count in COUNTS for row in times(scenes, count, clouds=10)],
        "single": [row for count in COUNTS for row in times(scenes, count, clouds=1)],
        "categories": categories(scenes),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "visibility.json"
    path.write_text(json.dumps(result, indent=1) + "\n")
    page = report(result)
    path.with_suffix(".md").write_text(page)
    figure(result, path.with_suffix(".png"))
    print(page)
    print(f"Saved {path}, .md and .png beside it")


def gather(meshes: Path | None, per_category: int) -> list[Scene]:
    sources = [meshes] if meshes is not None else [FURNITURE / name for name in MEASURED]
    scenes = []
    if all(source.exists() for source in sources):
        scenes += mesh_scenes(sources, COUNTS, per_category=per_category)
    elif meshes is not None:
        sys.exit(f"no such file or folder: {meshes}")
    else:
        print(f"No {FURNITURE} (package sweethome3d-furniture): procedural shapes only.")
    return scenes + list(procedural_scenes(range(5), COUNTS))


def categories(scenes: Sequence[Scene]) -> list[dict[str, Any]]:
    """The headline row for each category."""
    return [
        {"category": name, "points": count, "method": method, **quality(chosen, count, HEADLINE, method)}
        for count in COUNTS
        for name in dict.fromkeys(s.category for s in scenes)
        for chosen in [[s for s in scenes if s.category == name]]
        for method in ("zbuffer", "horizon", "hpr")
    ]


def times(scenes: Sequence[Scene], count: int, *, clouds: int) -> list[dict[str, Any]]:
    """Milliseconds per cloud and view, and relative to the z-buffer; in turns, medians.

    With `clouds` > 1 processor time in a batch of them before all of their cameras, else wall-clock time of one view.
    """
    points = torch.stack([scene.clouds[count] for scene in scenes[:clouds]])
    K, cam_from_world = (
        torch.stack([getattr(scene.camera, name) for scene in scenes[:clouds]])
        for name in ("K", "cam_from_world")
    )
    camera = dp.PinholeCamera(K, cam_from_world, 224, 224).resize(HEADLINE, HEADLINE)
    if clouds == 1:
        camera = camera[:, :1]

    def run(method: Method) -> Callable[[], Any]:
        own = 1 if method == "hpr" else clouds  # it is slow, and not batched
        return lambda: dp.visible_points(points[:own], camera[:own], method=method)

    milliseconds = (
        medians({m: run(m) for m in METHODS}, rounds=31)
        if clouds == 1
        else medians({m: run(m) for m in METHODS}, rounds=15, clock=time.process_time)
    )
    views = camera.batch_shape[1]
    per_view = {m: ms / (views if m == "hpr" else views * len(points)) for m, ms in milliseconds.items()}
    return [
        {"points": count, "method": m, "ms": ms, "ratio": ms / per_view["zbuffer"]}
        for m, ms in per_view.items()
    ]


def _row(rows: list[dict[str, Any]], **key: Any) -> dict[str, Any]:
    """The first row with these values; empty if there is none."""
    return next((row for row in rows if key.items() <= row.items()), {})


def _shares(row: dict[str, Any]) -> str:
    return f"{100 * row['hidden']:.1f} / {100 * row['recall']:.1f}" if row else "same"


def report(result: dict[str, Any]) -> str:
    """Markdown: the headline, the grid, and the categories."""
    here = result["machine"]
    lines = [
        f"{len(result['shapes'])} shapes, 8 views each; a point is hidden if a ray meets the surface more than 0.002 "
        "of the diagonal before it.",
        f"Of all points {_percent(result['base_hidden'][2048])} are hidden. {here['processor']}, {here['cores']} "
        f"cores. Each cell: hidden share / recall, in %.",
        "",
    ]
    for count in COUNTS:
        header = ["method", *(f"{s} x {s}" for s in SIZES), "ms per view (times z-buffer)", "one cloud, ms"]
        table = []
        for method in METHODS:
            key = {"points": count, "method": method}
            spent, single = _row(result["time"], **key), _row(result["single"], **key)
            cells = [_shares(_row(result["grid"], size=size, **key)) for size in SIZES]
            table.append(
                [method, *cells, f"{spent['ms']:.3f} ({spent['ratio']:.1f}x)", f"{single['ms']:.2f}"]
            )
        paper = PAPER[count]
        last = f"| the paper, on a GPU | {_percent(paper['hidden'])} hidden{' |' * len(SIZES)} | {paper['zbuffer']} |"
        lines += [f"### {count} points", "", markdown(header, table), last, ""]
    compared = ("zbuffer", "horizon", "hpr")
    table = [
        [name, *(_shares(_row(result["categories"], category=name, points=2048, method=m)) for m in compared)]
        for name in dict.fromkeys(r["category"] for r in result["categories"])
    ]
    lines += ["### By category, 56 x 56, 2048 points", "", markdown(["category", *compared], table)]
    return "\n".join(lines) + "\n"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def figure(result: dict[str, Any], path: Path) -> None:
    """Hidden share against recall, one panel for each number of points."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    colours = {"zbuffer": "#777777", "horizon": "#d55e00", "hpr": "#0072b2"}
    figure, panels = pyplot.subplots(1, len(COUNTS), figsize=(12, 5.2), sharey=True)
    for panel, count in zip(panels, COUNTS, strict=True):
        for method in METHODS:
            key = {"points": count, "method": method}
            source = result["grid" if method == "zbuffer" else "curves"]
            rows = [r for r in source if key.items() <= r.items()]
            spent, default = _row(result["time"], **key), _row(result["grid"], size=HEADLINE, **key)
            name = f"zbuffer, {SIZES[0]} to {SIZES[-1]} px" if method == "zbuffer" else method
            label = f"{name} ({spent['ms']:.2g} ms, {spent['ratio']:.1f}x)"
            for points, style, size in (
                (rows, "--s" if method == "zbuffer" else "-o", 4),
                ([default], "o", 10),
            ):
                hidden, recall = ([100 * r[share] for r in points] for share in ("hidden", "recall"))
                panel.plot(
                    hidden,
                    recall,
                    style,
                    color=colours[method],
                    markersize=size,
                    label=label if size == 4 else None,
                )
        panel.axvline(100 * PAPER[count]["hidden"], color="#aaaaaa", linestyle=":", linewidth=1)
        panel.annotate(
            f"the paper: {_percent(PAPER[count]['hidden'])}",
            (100 * PAPER[count]["hidden"], 2),
            fontsize=8,
            color="#777777",
        )
        if count == COUNTS[0]:
            panel.fill_between(
                [0, 100 * TARGET["hidden"]], 100 * TARGET["recall"], 100, color="#2ca02c", alpha=0.12
            )
            panel.annotate("target", (0.3, 96), fontsize=8, color="#2ca02c")
        panel.set(
            title=f"{count} points, {HEADLINE} x {HEADLINE} map", xlabel="hidden share of what is kept, %"
        )
        panel.set(xlim=(0, 45), ylim=(0, 100))
        panel.grid(alpha=0.3)
        panel.legend(
            fontsize=8, loc="lower right", title="processor time per view, times z-buffer", title_fontsize=8
        )
    panels[0].set_ylabel("recall of the visible points, %")
    figure.suptitle("Which points does a camera see? Large dots: defaults")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
