"""Two ways to use one depth renderer: the front constraint against the projection loss.

    python examples/front_vs_projection.py --out out/front_vs_projection

A free cloud of 1024 points is fitted to the depth maps of a chair, a table and a sofa, from one view and from
eight, once with each loss. Both losses render the cloud with the same `diffpoint.splat_depth`:

* the projection loss compares depths pixel by pixel, and can move a point only along the camera's axis;
* the front constraint takes the points that the view sees and compares them in 3D with those of the depth map,
  and so moves them in all directions, into the silhouette and onto its empty pixels.

With eight views the projection loss can push points sideways, but then out of the silhouettes as gladly as into
them: it charges nothing there.

Writes front_vs_projection.png and table.md to --out. Needs diffpoint and matplotlib.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from torch import Tensor

from diffpoint import PinholeCamera, chamfer_distance, front_constraint, project, projection_loss

LOSSES: dict[str, Callable[..., Tensor]] = {"projection": projection_loss, "front": front_constraint}
NAMES = {"projection": "projection loss", "front": "front constraint"}
COLOURS = {"projection": "#c8553d", "front": "#22577a"}
INSIDE, OUTSIDE = "#2a9d8f", "#e76f51"
VIEWS = (1, 8)
MEASURED_EVERY = 5

# Boxes as (x0, y0, z0, x1, y1, z1); y is up. Scaled to RADIUS, so that every view holds the whole shape.
RADIUS = 0.5
SHAPES = {
    "chair": [
        (-0.25, -0.02, -0.25, 0.25, 0.04, 0.25), (-0.25, 0.04, -0.25, 0.25, 0.50, -0.19),
        (-0.25, -0.50, -0.25, -0.19, -0.02, -0.19), (0.19, -0.50, -0.25, 0.25, -0.02, -0.19),
        (-0.25, -0.50, 0.19, -0.19, -0.02, 0.25), (0.19, -0.50, 0.19, 0.25, -0.02, 0.25),
    ],
    "table": [
        (-0.50, 0.22, -0.30, 0.50, 0.28, 0.30),
        (-0.46, -0.28, -0.26, -0.38, 0.22, -0.18), (0.38, -0.28, -0.26, 0.46, 0.22, -0.18),
        (-0.46, -0.28, 0.18, -0.38, 0.22, 0.26), (0.38, -0.28, 0.18, 0.46, 0.22, 0.26),
    ],
    "sofa": [
        (-0.50, -0.22, -0.22, 0.50, 0.00, 0.22), (-0.50, 0.00, -0.22, 0.50, 0.24, -0.10),
        (-0.50, 0.00, -0.10, -0.38, 0.12, 0.22), (0.38, 0.00, -0.10, 0.50, 0.12, 0.22),
    ],
}  # fmt: skip


class Scene(NamedTuple):
    """What a fit is given, and what it is judged by; all in the frame of the first camera."""

    camera: PinholeCamera
    """V views."""
    depth: Tensor
    """(1, V, H, W) true depth maps, +inf where empty."""
    surface: Tensor
    """(1, 4096, 3) points of the whole shape, seen or not."""
    start: Tensor
    """(1, N, 3) the cloud that every fit starts from: uniform in the shape's unit cube."""


class Measures(NamedTuple):
    """How good a cloud is, whatever loss made it."""

    visible_cd: float
    """Chamfer distance x100 between what the views see of the cloud and what they see of the shape."""
    inside: float
    """Share of the points that project into the silhouette, over all views."""
    pred_to_gt: float
    """Mean distance x100 from the cloud to the whole shape."""
    gt_to_pred: float
    """Mean distance x100 from the whole shape to the cloud."""


class Fit(NamedTuple):
    """One fitted cloud and its history."""

    clouds: dict[int, Tensor]
    """The cloud after some numbers of iterations, (1, N, 3)."""
    losses: list[float]
    """The fit's own loss, at every iteration."""
    sideways: list[float]
    """|gradient in the first camera's x and y| / |gradient|, at every iteration."""
    visible_cd: dict[int, float]
    """`Measures.visible_cd` after some numbers of iterations."""
    measures: Measures
    seconds: float


def make_scene(boxes: list[tuple[float, ...]], *, views: int, points: int = 1024, size: int = 56) -> Scene:
    """Cameras in a ring around the boxes, the depth maps they see, and a cloud to start from."""
    corners = torch.tensor(boxes)
    corners = corners * RADIUS / corners.unflatten(-1, (2, 3)).norm(dim=-1).max()
    azimuth = torch.deg2rad(35 + torch.arange(views) * 360 / views)
    elevation = torch.deg2rad(torch.tensor(15.0))
    around = torch.stack((azimuth.sin(), elevation.tan().expand(views), azimuth.cos()), -1)
    eyes = 2 * around / around.norm(dim=-1, keepdim=True)
    camera = PinholeCamera.look_at(eyes, focal_px=105 * size / 56, height=size, width=size)
    depth = box_depth(corners, camera)
    random = torch.Generator().manual_seed(0)
    surface = sample_boxes(corners, 4096, random)
    start = torch.rand(points, 3, generator=random) - 0.5

    # In the first camera's own frame the x and y of a gradient are that camera's, without a rotation's rounding.
    first_from_world = camera.cam_from_world[0]
    cam_from_first = camera.cam_from_world @ torch.linalg.inv(first_from_world)
    cam_from_first[0] = torch.eye(4)
    rotation, translation = first_from_world[:3, :3], first_from_world[:3, 3]
    return Scene(
        PinholeCamera(camera.K, cam_from_first, size, size),
        depth[None],
        (surface @ rotation.T + translation)[None],
        (start @ rotation.T + translation)[None],
    )


def box_depth(corners: Tensor, camera: PinholeCamera) -> Tensor:
    """(V, H, W) exact depth of boxes (K, 6) at the pixels' centres, by intersecting rays with slabs."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack((u + 0.5, v + 0.5, torch.ones_like(u)), -1)
    rays = torch.einsum("vij,hwj->vhwi", camera.back_projection[..., :3], pixels)[..., None, :]
    origins = camera.position[:, None, None, None]
    planes = torch.stack(((corners[:, :3] - origins) / rays, (corners[:, 3:] - origins) / rays))
    enter, leave = planes.amin(0).amax(-1), planes.amax(0).amin(-1)
    return torch.where(enter <= leave, enter, torch.inf).amin(-1)


def sample_boxes(corners: Tensor, count: int, random: torch.Generator) -> Tensor:
    """(count, 3) points spread evenly over the outside of boxes (K, 6)."""
    low, high = corners[:, :3], corners[:, 3:]
    extent = high - low
    areas = extent.prod(-1, keepdim=True) / extent  # of the faces across x, y and z
    face = torch.multinomial(areas.flatten(), 4 * count, replacement=True, generator=random)
    box, axis = face // 3, face % 3
    at = torch.rand(4 * count, 3, generator=random)
    at[torch.arange(4 * count), axis] = at[torch.arange(4 * count), axis].round()
    points = low[box] + at * extent[box]
    buried = ((points[:, None] > low) & (points[:, None] < high)).all(-1).any(-1)
    return points[~buried][:count]


def fit_cloud(scene: Scene, loss: str, *, iterations: int, kept: tuple[int, ...] = ()) -> Fit:
    """Moves the start cloud by Adam down one loss; keeps copies after `kept` iterations."""
    cloud = scene.start.clone().requires_grad_()
    optimiser = torch.optim.Adam([cloud], lr=0.01)
    clouds: dict[int, Tensor] = {}
    losses: list[float] = []
    sideways: list[float] = []
    visible_cd: dict[int, float] = {}
    seconds = 0.0
    for iteration in range(iterations + 1):
        if iteration in kept:
            clouds[iteration] = cloud.detach().clone()
        if iteration % MEASURED_EVERY == 0:
            visible_cd[iteration] = visible_chamfer(scene, cloud.detach())
        begun = time.perf_counter()
        optimiser.zero_grad()
        value = LOSSES[loss](cloud, scene.camera, scene.depth)
        value.backward()
        losses.append(value.item())
        assert cloud.grad is not None
        sideways.append((cloud.grad[..., :2].norm() / cloud.grad.norm()).item())
        if iteration < iterations:
            optimiser.step()
            seconds += time.perf_counter() - begun
    return Fit(clouds, losses, sideways, visible_cd, measure(scene, cloud.detach()), seconds)


def visible_chamfer(scene: Scene, cloud: Tensor) -> float:
    """`Measures.visible_cd`: the value of the front constraint, x100, for a cloud of whatever origin."""
    return 100 * front_constraint(cloud, scene.camera, scene.depth).item()


def in_silhouette(scene: Scene, cloud: Tensor, *, margin: int = 0) -> Tensor:
    """(V, N): does the point project into a pixel where the shape is, or `margin` pixels beside one?"""
    silhouette = torch.isfinite(scene.depth[0]).float()
    silhouette = torch.nn.functional.max_pool2d(silhouette, 2 * margin + 1, 1, margin) > 0
    pixels = project(cloud, scene.camera).pixels[0].floor().long()
    inside = ((pixels >= 0) & (pixels < scene.camera.width)).all(-1)
    u, v = pixels.clamp(0, scene.camera.width - 1).unbind(-1)
    view = torch.arange(len(pixels))[:, None]
    return inside & silhouette[view, v, u]


def measure(scene: Scene, cloud: Tensor) -> Measures:
    """All measures of a cloud (1, N, 3)."""
    whole = chamfer_distance(cloud, scene.surface, squared=False)
    return Measures(
        visible_cd=visible_chamfer(scene, cloud),
        inside=in_silhouette(scene, cloud).float().mean().item(),
        pred_to_gt=100 * whole.a_to_b.item(),
        gt_to_pred=100 * whole.b_to_a.item(),
    )


def write_table(fits: dict[tuple[str, int, str], Fit]) -> str:
    """A Markdown table with a line per shape, number of views and loss."""
    lines = [
        "| shape | views | loss | visible part CDx100 | inside silhouette | pred->GT x100 | GT->pred x100 "
        "| own loss, first -> last | gradient across the first view's axis, mean share | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (shape, views, loss), fit in fits.items():
        m = fit.measures
        lines.append(
            f"| {shape} | {views} | {NAMES[loss]} | {m.visible_cd:.2f} | {m.inside:.2f} | {m.pred_to_gt:.2f} "
            f"| {m.gt_to_pred:.2f} | {fit.losses[0]:.3f} -> {fit.losses[-1]:.3f} "
            f"| {sum(fit.sideways) / len(fit.sideways):.3f} | {fit.seconds:.1f} |"
        )
    return "\n".join(lines) + "\n"


def draw_cloud(axes: Axes, scene: Scene, cloud: Tensor) -> None:
    """The cloud from 70 degrees beside the first camera, which looks at it from the left."""
    angle = torch.deg2rad(torch.tensor(70.0))
    x, y, z = (cloud[0] - scene.start[0].mean(0)).unbind(-1)
    across, away = z * angle.sin() + x * angle.cos(), z * angle.cos() - x * angle.sin()
    inside = in_silhouette(scene, cloud, margin=1).all(0)
    order = away.argsort(descending=True)
    colours = [INSIDE if kept else OUTSIDE for kept in inside[order].tolist()]
    axes.scatter(across[order], -y[order], c=colours, s=5, linewidths=0)
    axes.set(xlim=(-0.85, 0.75), ylim=(-0.65, 0.65), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def draw(fits: dict[tuple[str, int, str], Fit], scenes: dict[tuple[str, int], Scene], shape: str) -> Figure:
    """Clouds of one shape over the iterations, and the curves of all shapes."""
    kept = sorted(fits[shape, 1, "front"].clouds)
    figure = Figure(figsize=(13.5, 13), layout="constrained", dpi=110)
    figure.suptitle(
        "One renderer, two losses: fitting a free cloud to depth maps", fontsize=17, fontweight="bold"
    )
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(2.6, 1)))
    top.suptitle(
        f"The cloud of the {shape}, seen from 70\N{DEGREE SIGN} beside the first camera. "
        "Green: the point falls into the silhouette of every view. Red: it does not.",
        fontsize=11,
    )
    panels = top.subplots(4, len(kept) + 1)
    for row, (views, loss) in zip(panels, [(v, loss) for v in VIEWS for loss in LOSSES], strict=True):
        scene, fit = scenes[shape, views], fits[shape, views, loss]
        for axes, iteration in zip(row, kept, strict=False):
            draw_cloud(axes, scene, fit.clouds[iteration])
        draw_cloud(row[-1], scene, scene.surface[:, ::2])
        row[0].set_ylabel(
            f"{NAMES[loss]}\n{plural(views)}", fontsize=12, color=COLOURS[loss], fontweight="bold"
        )
        row[0].annotate("", (-0.5, 0), (-0.85, 0), arrowprops={"arrowstyle": "->", "lw": 1.5})
        row[0].text(-0.85, 0.04, "camera", fontsize=8)
    for axes, title in zip(panels[0], [f"iteration {i}" for i in kept] + ["the shape itself"], strict=True):
        axes.set_title(title, fontsize=12)
    draw_curves(bottom, fits)
    return figure


def draw_curves(figure: SubFigure, fits: dict[tuple[str, int, str], Fit]) -> None:
    """Own losses, distance of the visible part and share of the sideways gradient; a line for each shape."""
    own, visible, sideways = np.asarray(figure.subplots(1, 3))
    for (shape, views, loss), fit in fits.items():
        label = f"{NAMES[loss]}, {plural(views)}" if shape == next(iter(SHAPES)) else None
        style = {"color": COLOURS[loss], "ls": "-" if views == 1 else ":", "lw": 1.3, "label": label}
        own.plot(fit.losses, **style)
        visible.plot(list(fit.visible_cd), list(fit.visible_cd.values()), **style)
        if views == 1:
            sideways.plot(fit.sideways, **style)
    own.set_title("Both losses fall ...", fontsize=12)
    own.set(ylabel="the loss itself (shapes are 1 unit across)", yscale="log")
    visible.set_title("... one of them finds the shape", fontsize=12)
    visible.set(ylabel="error of the visible part (chamfer x100)", yscale="log")
    sideways.set_title("Gradient across the viewing axis", fontsize=12)
    sideways.set(ylabel="|gradient in camera x, y| / |gradient|", ylim=(-0.05, 1.05))
    sideways.text(
        0, 0.03, "exactly 0: points move only along the axis", fontsize=9, color=COLOURS["projection"]
    )
    for axes in (own, visible, sideways):
        axes.set_xlabel("iteration (three lines of a kind: three shapes)")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    own.legend(fontsize=8, loc="upper right")


def plural(views: int) -> str:
    return "1 view" if views == 1 else f"{views} views"


def run(out: Path, *, iterations: int) -> dict[tuple[str, int, str], Fit]:
    """All twelve fits, the table and the figure."""
    kept = tuple(sorted({0, iterations // 20, iterations // 5, iterations}))
    scenes = {
        (shape, views): make_scene(boxes, views=views) for shape, boxes in SHAPES.items() for views in VIEWS
    }
    # Kernels are compiled before time is taken.
    fit_cloud(scenes[next(iter(scenes))], "front", iterations=1)
    fits: dict[tuple[str, int, str], Fit] = {}
    for (shape, views), scene in scenes.items():
        for loss in LOSSES:
            print(f"{shape}, {plural(views)}, {NAMES[loss]} ...", flush=True)
            fits[shape, views, loss] = fit_cloud(scene, loss, iterations=iterations, kept=kept)
    table = write_table(fits)
    print(f"\n{table}")
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.md").write_text(table)
    draw(fits, scenes, next(iter(SHAPES))).savefig(out / "front_vs_projection.png")
    print(f"wrote {out / 'front_vs_projection.png'} and {out / 'table.md'}")
    return fits


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/front_vs_projection"), help="folder to write to (%(default)s)"
    )
    parser.add_argument(
        "--iterations", type=int, default=300, help="steps of Adam for each fit (%(default)s)"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work
    if arguments.iterations < 20:
        parser.error("--iterations must be at least 20; 300 is what the table is made with")
    run(arguments.out, iterations=arguments.iterations)


if __name__ == "__main__":
    main()
