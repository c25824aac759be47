"""Two ways to use one depth renderer: the front constraint against projection losses.

    python examples/front_vs_projection.py --out out/front_vs_projection

A free cloud of 1024 points is fitted to the depth maps of a chair, a table and a sofa, from one view and from eight:

* the projection loss compares depths pixel by pixel, and can move a point only along the camera's axis;
* Lin et al. add a mask term, which can delete points but not move them, and render at a higher resolution;
* the soft projection loss renders points as discs that fade to their edge, so that it sees a step to the side;
* the front constraint takes the points that the view sees and compares them in 3D with those of the depth map.

Writes table.md and clouds.png to --out. Needs diffpoint and matplotlib; takes about half a minute. The study on more
shapes, views and seeds, and the reasons: docs/front-vs-projection.md.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from shapes import SIZE, furniture, orbit, render_depth, sample_surface
from torch import Tensor

import diffpoint as dp

# Each takes a cloud (1, N, 3), occupancy logits (1, N), views, and the progress of the fit in [0, 1].
LOSSES = {
    "projection loss": lambda cloud, logits, views, t: dp.projection_loss(cloud, *views),
    "Lin et al.": lambda cloud, logits, views, t: dp.projection_loss(
        cloud, *views, logits=logits, mask_weight=1.0, upsample=2
    ),
    "soft projection loss": lambda cloud, logits, views, t: dp.soft_projection_loss(
        cloud, *views, radius=6 / 8 ** min(1, 2 * t)
    ),
    "front constraint": lambda cloud, logits, views, t: dp.front_constraint(cloud, *views),
}


class Scene(NamedTuple):
    """What a fit is given and judged by, in the frame of the first camera."""

    views: tuple[dp.PinholeCamera, Tensor]  # V cameras and their depth maps (1, V, H, W)
    surface: Tensor  # (1, 4096, 3) points of the whole shape
    start: Tensor  # (1, 1024, 3) uniform in a cube around it


def make_scene(kind: str, views: int) -> Scene:
    """A shape, seen by cameras on a circle."""
    random = torch.Generator().manual_seed(0)
    boxes = furniture(kind, random)
    camera = orbit(30 + torch.arange(views) * 360 / views)
    depth = render_depth(boxes, camera)[None]
    first = camera.cam_from_world[0]
    points = torch.cat((sample_surface(boxes, 4096, random), torch.rand(1024, 3, generator=random) - 0.5))
    surface, start = (points @ first[:3, :3].T + first[:3, 3])[None].split((4096, 1024), dim=1)
    cam_from_first = camera.cam_from_world @ torch.linalg.inv(first)
    cam_from_first[0] = torch.eye(4)  # without rounding: x and y of a gradient are exactly this camera's
    return Scene((dp.PinholeCamera(camera.K, cam_from_first, SIZE, SIZE), depth), surface, start)


def fit(scene: Scene, loss: str, *, iterations: int) -> tuple[dict[str, float], dict[int, Tensor]]:
    """Moves the cloud down one loss by Adam, with a step size that falls to 0 along a cosine.

    Returns:
        Measures of the fit, distances x100 of shapes that are about 1 across; and the existing points (M, 3) after 0,
        10 %, 30 % and all of the steps.
    """
    cloud = scene.start.clone().requires_grad_()
    logits = torch.full(cloud.shape[:2], 0.5, requires_grad=True)  # only the loss of Lin et al. changes them
    optimiser = torch.optim.Adam([cloud, logits], lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    losses, sideways, clouds, begun = [], 0.0, {0: scene.start[0]}, 0.0
    for step in range(iterations):
        if step == 1:
            begun = time.perf_counter()  # the first step compiles kernels
        optimiser.zero_grad()
        value = LOSSES[loss](cloud, logits, scene.views, step / iterations)
        value.backward()
        optimiser.step()
        schedule.step()
        losses.append(value.item())
        assert cloud.grad is not None
        sideways += (cloud.grad[..., :2].norm() / cloud.grad.norm().clamp(min=1e-30)).item() / iterations
        if step + 1 in (iterations // 10, 3 * iterations // 10, iterations):
            clouds[step + 1] = cloud.detach()[logits > 0]
    ms = 1000 * (time.perf_counter() - begun) / (iterations - 1)

    end = clouds[iterations][None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a view that sees no point is a result here
        visible = dp.front_constraint(end, *scene.views).item()
    to_shape, from_shape = dp.chamfer_distance(end, scene.surface, squared=False)
    measures = {
        "visible part": 100 * visible,
        "inside silhouettes": in_silhouettes(end, *scene.views).float().mean().item(),
        "cloud to shape": 100 * to_shape.item(),
        "shape to cloud": 100 * from_shape.item(),
        "points left": end.shape[1] / cloud.shape[1],
        "own loss, first": losses[0],
        "own loss, last": losses[-1],
        "gradient in the first camera's x, y": sideways,  # share of the gradient's norm, mean over the steps
        "ms a step": ms,
    }
    return measures, clouds


def in_silhouettes(cloud: Tensor, camera: dp.PinholeCamera, depth: Tensor) -> Tensor:
    """(1, V, N) bool: does the point project into a pixel where the view sees the shape?"""
    pixels = dp.project(cloud, camera).pixels
    u, v = pixels.clamp(0, SIZE - 1).long().unbind(-1)
    in_frame = (pixels == pixels.clamp(0, SIZE)).all(-1)
    return in_frame & torch.isfinite(depth).flatten(2).gather(2, v * SIZE + u)


def draw(scene: Scene, fits: dict[str, dict[int, Tensor]]) -> Figure:
    """A row for each loss: the cloud on its way, then the shape."""
    figure = Figure(figsize=(12.5, 10), layout="constrained", dpi=110)
    figure.suptitle(
        "One view, from the left (arrow), drawn from 70 degrees beside it.\n"
        "Green: the point projects into the silhouette. Red: it does not."
    )
    angle = torch.tensor(math.radians(70))
    for row, (loss, clouds) in zip(figure.subplots(len(fits), 5), fits.items(), strict=True):
        panels = {f"step {step}": cloud for step, cloud in clouds.items()}
        panels["the shape"] = scene.surface[0, ::3]
        for axes, (title, cloud) in zip(row, panels.items(), strict=True):
            inside = in_silhouettes(cloud[None], *scene.views)[0, 0]
            x, y, z = (cloud - scene.surface[0].mean(0)).unbind(-1)
            for part, colour in ((~inside, "#e76f51"), (inside, "#2a9d8f")):
                axes.scatter((z * angle.sin() + x * angle.cos())[part], -y[part], c=colour, s=4, linewidths=0)
            axes.set(xlim=(-0.85, 0.75), ylim=(-0.7, 0.7), aspect="equal", xticks=[], yticks=[])
            axes.set_title(title if loss == next(iter(fits)) else "")
            axes.spines[:].set_visible(False)
        row[0].set_ylabel(loss, fontsize=11)
        row[0].annotate("", (-0.5, 0), (-0.85, 0), arrowprops={"arrowstyle": "->", "lw": 1.5})
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, default=Path("out/front_vs_projection"), help="folder to write to (%(default)s)")
    add("--iterations", type=int, default=200, help="steps of Adam for each fit (%(default)s)")
    arguments = parser.parse_args(argv)
    if arguments.iterations < 20:
        parser.error("--iterations must be at least 20; 200 is what docs/gallery.md is made with")
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work

    rows: list[dict[str, str]] = []
    for kind, views in itertools.product(("chair", "table", "sofa"), (1, 8)):
        scene, clouds = make_scene(kind, views), {}
        for loss in LOSSES:
            measures, clouds[loss] = fit(scene, loss, iterations=arguments.iterations)
            row = {"shape": kind, "views": str(views), "loss": loss}
            rows.append(row | {name: f"{value:.3g}" for name, value in measures.items()})
            print(", ".join(row.values()), "- visible part", rows[-1]["visible part"], flush=True)
        if (kind, views) == ("chair", 1):
            draw(scene, clouds).savefig(arguments.out / "clouds.png")
    lines = [rows[0].keys(), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    table = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    (arguments.out / "table.md").write_text(table, encoding="utf-8")
    print(f"\n{table}")
    print(f"wrote table.md and clouds.png to {arguments.out}")


if __name__ == "__main__":
    main()
