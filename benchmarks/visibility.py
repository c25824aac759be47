"""`python -m benchmarks.visibility`: what each method of `visible_points` shows, against ray casting, and its time.

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
from benchmarks.harness import machine
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
MARK = {"hidden": 0.05, "recall": 0.75, "ratio": 3.0}
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
        "mark": MARK,
        "grid": grid,
        "curves": curves,
        "time": [row for count in COUNTS for row in times(scenes, count)],
        "single": [row for count in COUNTS for row in single_times(scenes, count)],
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


def times(scenes: Sequence[Scene], count: int, clouds: int = 10) -> list[dict[str, Any]]:
    """Processor milliseconds per cloud and view in a batch, and times the z-buffer; in turns, medians."""
    points = torch.stack([scene.clouds[count] for scene in scenes[:clouds]])
    camera = dp.PinholeCamera(
        torch.stack([scene.camera.K for scene in scenes[:clouds]]),
        torch.stack([scene.camera.cam_from_world for scene in scenes[:clouds]]),
        224,
        224,
    ).resize(HEADLINE, HEADLINE)
    views = points.shape[0] * camera.batch_shape[1]

    def run(method: Method) -> Callable[[], Any]:
        if method == "hpr":  # one cloud stands for all: it is slow, and not batched
            return lambda: dp.visible_points(points[:1], camera[0], method=method)
        return lambda: dp.visible_points(points, camera, method=method)

    milliseconds = medians({m: run(m) for m in METHODS}, rounds=15, clock=time.process_time)
    per_view = {m: ms / (camera.batch_shape[1] if m == "hpr" else views) for m, ms in milliseconds.items()}
    return [
        {"points": count, "method": m, "ms": ms, "ratio": ms / per_view["zbuffer"]}
        for m, ms in per_view.items()
    ]


def single_times(scenes: Sequence[Scene], count: int) -> list[dict[str, Any]]:
    """Milliseconds by the clock for one cloud in one view, as the paper gives them."""
    points, camera = scenes[0].clouds[count][None], scenes[0].camera[0].resize(HEADLINE, HEADLINE)

    def run(method: Method) -> Callable[[], Any]:
        return lambda: dp.visible_points(points, camera, method=method)

    milliseconds = medians({m: run(m) for m in METHODS}, rounds=31)
    return [{"points": count, "method": m, "ms": ms} for m, ms in milliseconds.items()]


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
        lines += [
            f"### {count} points",
            "",
            "| method | "
            + " | ".join(f"{s} x {s}" for s in SIZES)
            + " | ms per view (times z-buffer) | one cloud, ms |",
            "|---" * (len(SIZES) + 3) + "|",
        ]
        for method in METHODS:
            cells = []
            for size in SIZES:
                found = [
                    r
                    for r in result["grid"]
                    if (r["points"], r["size"], r["method"]) == (count, size, method)
                ]
                cells.append(
                    f"{100 * found[0]['hidden']:.1f} / {100 * found[0]['recall']:.1f}" if found else "same"
                )
            spent = next(r for r in result["time"] if (r["points"], r["method"]) == (count, method))
            single = next(r for r in result["single"] if (r["points"], r["method"]) == (count, method))
            cells += [f"{spent['ms']:.3f} ({spent['ratio']:.1f}x)", f"{single['ms']:.2f}"]
            lines.append(f"| {method} | " + " | ".join(cells) + " |")
        paper = PAPER[count]
        lines += [
            f"| the paper, on a GPU | {_percent(paper['hidden'])} hidden"
            + " |" * len(SIZES)
            + f" | {paper['zbuffer']} |",
            "",
        ]
    lines += [
        "### By category, 56 x 56, 2048 points",
        "",
        "| category | zbuffer | horizon | hpr |",
        "|---|---|---|---|",
    ]
    for name in dict.fromkeys(r["category"] for r in result["categories"]):
        row = [r for r in result["categories"] if r["category"] == name and r["points"] == COUNTS[0]]
        lines.append(
            f"| {name} | "
            + " | ".join(f"{100 * r['hidden']:.1f} / {100 * r['recall']:.1f}" for r in row)
            + " |"
        )
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
        spent = {r["method"]: r for r in result["time"] if r["points"] == count}
        for method in METHODS:
            rows = [r for r in result["curves"] if (r["points"], r["method"]) == (count, method)]
            if method == "zbuffer":
                rows = [r for r in result["grid"] if (r["points"], r["method"]) == (count, method)]
            times = f"{spent[method]['ms']:.2g} ms, {spent[method]['ratio']:.1f}x"
            label = {"zbuffer": f"zbuffer, {SIZES[0]} to {SIZES[-1]} px"}.get(method, method)
            hidden, recall = [100 * r["hidden"] for r in rows], [100 * r["recall"] for r in rows]
            style = "--s" if method == "zbuffer" else "-o"
            panel.plot(hidden, recall, style, color=colours[method], markersize=4, label=f"{label} ({times})")
            default = next(
                r
                for r in result["grid"]
                if (r["points"], r["method"], r["size"]) == (count, method, HEADLINE)
            )
            panel.plot(
                100 * default["hidden"], 100 * default["recall"], "o", color=colours[method], markersize=10
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
                [0, 100 * MARK["hidden"]], 100 * MARK["recall"], 100, color="#2ca02c", alpha=0.12
            )
            panel.annotate("the mark", (0.3, 96), fontsize=8, color="#2ca02c")
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
