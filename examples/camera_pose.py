"""Finding a camera by descending on its pose: three losses, one set of gradients to `cam_from_world`.

    python examples/camera_pose.py --out out/camera_pose

The shape is known, and so is what a camera saw of it; where the camera stood is not. From a guess that is wrong by
some degrees and some tenths of the shape's size, Adam moves the six numbers of a rigid motion (a twist of se(3)) down
one of three losses, each fed with another kind of observation:

* key points: 12 points of the shape and the pixels they were seen at; `diffpoint.project`;
* depth map, views: the depth map, and depth maps of three known cameras around it, which `diffpoint.reproject`
  carries over into the unknown camera to be compared there;
* depth map, cloud: the depth map and a cloud of the whole shape, without any correspondence: the points that
  `diffpoint.unproject` gives should lie on the shape. Exact only as far as the cloud is dense.

Writes camera_pose.png to --out and prints both errors of the pose every 50 iterations. Needs diffpoint and matplotlib.
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
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, chamfer_distance, project, reproject, splat_depth, unproject

SIZE = 56
FOCAL_PX = 105.0
REACH = 0.2  # depth differences beyond it say "another surface" rather than "not there yet"
PRINTED_EVERY = 50
COLOURS = {"key points": "#2a9d8f", "depth map, views": "#c8553d", "depth map, cloud": "#22577a"}

# A chair of boxes (x0, y0, z0, x1, y1, z1); y is up. Scaled to RADIUS, so that every view holds all of it.
RADIUS = 0.5
CHAIR = [
    (-0.25, -0.02, -0.25, 0.25, 0.04, 0.25), (-0.25, 0.04, -0.25, 0.25, 0.50, -0.19),
    (-0.25, -0.50, -0.25, -0.19, -0.02, -0.19), (0.19, -0.50, -0.25, 0.25, -0.02, -0.19),
    (-0.25, -0.50, 0.19, -0.19, -0.02, 0.25), (0.19, -0.50, 0.19, 0.25, -0.02, 0.25),
]  # fmt: skip


class Scene(NamedTuple):
    """What is known, and the camera that is sought."""

    camera: PinholeCamera
    """The true one, to judge by; its intrinsics are known."""
    depth: Tensor
    """(1, 1, H, W) what it saw."""
    key_points: Tensor
    """(1, 12, 3) in the world."""
    key_pixels: Tensor
    """(1, 1, 12, 2) where it saw them."""
    cloud: Tensor
    """(1, 4096, 3) the shape's surface."""
    known: PinholeCamera
    """(3,) cameras around the sought one."""
    known_depth: Tensor
    """(1, 3, H, W) what they saw."""
    start_from_world: Tensor
    """(4, 4) the guess to start from."""


class PoseError(NamedTuple):
    """How far a pose is from the true one."""

    angle_deg: float
    """Of the rotation between the two cameras."""
    distance: float
    """Between the two optical centres; the shape is 1 across."""


class Fit(NamedTuple):
    errors: list[PoseError]
    """Before every iteration, and after the last."""
    poses: dict[int, Tensor]
    """cam_from_world after some numbers of iterations."""
    seconds: float


def make_scene(*, angle_deg: float = 20.0, distance: float = 0.15) -> Scene:
    """A chair, four exact depth maps, and a first guess that is `angle_deg` and `distance` off."""
    corners = torch.tensor(CHAIR)
    corners = corners * RADIUS / corners.unflatten(-1, (2, 3)).norm(dim=-1).max()
    azimuth = torch.deg2rad(35 + torch.tensor([0.0, -40.0, 10.0, 45.0]))
    elevation = torch.deg2rad(torch.tensor([20.0, 15.0, 40.0, 25.0]))
    around = torch.stack((azimuth.sin(), elevation.tan(), azimuth.cos()), -1)
    cameras = PinholeCamera.look_at(
        2 * around / around.norm(dim=-1, keepdim=True), focal_px=FOCAL_PX, height=SIZE, width=SIZE
    )
    depth = box_depth(corners, cameras)[None]
    random = torch.Generator().manual_seed(0)
    cloud = sample_boxes(corners, 4096, random)[None]
    key_points = cloud[:, :12]
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]), dim=0)
    shift = torch.nn.functional.normalize(torch.tensor([-1.0, 0.5, 1.0]), dim=0)
    wrong = rigid_motion(torch.cat((torch.deg2rad(torch.tensor(angle_deg)) * axis, distance * shift)))
    return Scene(
        camera=cameras[0],
        depth=depth[:, :1],
        key_points=key_points,
        key_pixels=project(key_points, cameras[0]).pixels,
        cloud=cloud,
        known=cameras[1:],
        known_depth=depth[:, 1:],
        start_from_world=cameras[0].cam_from_world @ wrong,
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


def rigid_motion(twist: Tensor) -> Tensor:
    """exp: se(3) -> SE(3). (6,) axis times angle in radians, then velocity; -> (4, 4)."""
    x, y, z, *velocity = twist.unbind()
    zero = torch.zeros_like(x)
    rows = ((zero, -z, y, velocity[0]), (z, zero, -x, velocity[1]), (-y, x, zero, velocity[2]), (zero,) * 4)
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def key_point_loss(scene: Scene, camera: PinholeCamera) -> Tensor:
    """Mean distance in the image, as a tangent of the angle between the rays."""
    pixels = project(scene.key_points, camera).pixels
    return (pixels - scene.key_pixels).norm(dim=-1).mean() / FOCAL_PX


def reprojection_loss(scene: Scene, camera: PinholeCamera) -> Tensor:
    """Mean |depth of the known views' points - depth seen where they fall|, at most REACH for each."""
    carried = reproject(scene.known_depth, scene.known, camera)
    foreground = torch.isfinite(scene.depth)
    seen = torch.cat((torch.where(foreground, scene.depth, 0.0), foreground.to(scene.depth.dtype)), 1)
    count = scene.known_depth.shape[1]
    grid = torch.where(carried.valid[..., None], carried.pixels, -SIZE) / (SIZE / 2) - 1
    depth, covered = torch.nn.functional.grid_sample(
        seen[0].expand(count, -1, -1, -1), grid[0], align_corners=False
    ).unbind(1)
    on_shape = covered > 0.99  # between pixels of the shape, not between it and nothing
    difference = torch.where(on_shape, carried.depth[0] - depth, REACH).abs().clamp(max=REACH)
    return difference[torch.isfinite(scene.known_depth[0])].mean()


def cloud_loss(scene: Scene, camera: PinholeCamera) -> Tensor:
    """Mean distance from what was seen to the shape (not back: the shape has sides that were not seen)."""
    seen = unproject(scene.depth, camera)
    return chamfer_distance(
        seen.points[:, 0], scene.cloud, squared=False, a_lengths=seen.lengths[:, 0]
    ).a_to_b


LOSSES: dict[str, Callable[[Scene, PinholeCamera], Tensor]] = {
    "key points": key_point_loss,
    "depth map, views": reprojection_loss,
    "depth map, cloud": cloud_loss,
}


def fit_pose(scene: Scene, loss: str, *, iterations: int, kept: tuple[int, ...] = ()) -> Fit:
    """Descends on a rigid motion of the world before the first guess; keeps the poses after `kept` iterations."""
    twist = torch.zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([twist], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, eta_min=1e-4)
    errors: list[PoseError] = []
    poses: dict[int, Tensor] = {}
    begun = time.perf_counter()
    for iteration in range(iterations + 1):
        # The motion turns the world about the shape: about the camera, a turn and a shift would look alike.
        cam_from_world = scene.start_from_world @ rigid_motion(twist)
        error = pose_error(cam_from_world.detach(), scene.camera)
        errors.append(error)
        if iteration in kept:
            poses[iteration] = cam_from_world.detach()
        if iteration % PRINTED_EVERY == 0 or iteration == iterations:
            print(f"  {iteration:4d}  {error.angle_deg:7.3f} degrees  {error.distance:.4f} away", flush=True)
        if iteration < iterations:
            optimiser.zero_grad()
            LOSSES[loss](scene, PinholeCamera(scene.camera.K, cam_from_world, SIZE, SIZE)).backward()
            optimiser.step()
            schedule.step()
    return Fit(errors, poses, time.perf_counter() - begun)


def pose_error(cam_from_world: Tensor, truth: PinholeCamera) -> PoseError:
    """Angle and distance, in float64: the arc cosine of a number near 1 needs the digits."""
    estimate, true = cam_from_world.double(), truth.cam_from_world.double()
    between = estimate[:3, :3] @ true[:3, :3].T
    sine = (between - between.T)[[2, 0, 1], [1, 2, 0]].norm() / 2
    angle = torch.atan2(sine, (between.trace() - 1) / 2)
    apart = torch.linalg.inv(estimate)[:3, 3] - torch.linalg.inv(true)[:3, 3]
    return PoseError(torch.rad2deg(angle).item(), apart.norm().item())


def draw_view(axes: Axes, scene: Scene, cam_from_world: Tensor) -> None:
    """What the camera saw, and the cloud as the estimated pose would see it."""
    camera = PinholeCamera(scene.camera.K, cam_from_world, SIZE, SIZE)
    rendered = torch.isfinite(splat_depth(scene.cloud, camera, radius=0.7).depth[0, 0])
    observed = torch.isfinite(scene.depth[0, 0])
    image = np.ones((SIZE, SIZE, 3))
    for mask, colour in (
        (observed & ~rendered, (0.16, 0.62, 0.56)),
        (rendered & ~observed, (0.91, 0.44, 0.32)),
        (observed & rendered, (0.55, 0.57, 0.6)),
    ):
        image[mask.numpy()] = colour
    axes.imshow(image)
    axes.set(xticks=[], yticks=[])


def draw(scene: Scene, fits: dict[str, Fit]) -> Figure:
    """The pictures over the iterations, and both errors of the pose."""
    kept = sorted(next(iter(fits.values())).poses)
    figure = Figure(figsize=(12, 11.5), layout="constrained", dpi=110)
    figure.suptitle("A camera found by descending on its pose", fontsize=17, fontweight="bold")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(2.1, 1)))
    top.suptitle(
        "Grey: seen, and rendered from the estimated pose. Green: seen only. Red: rendered only.", fontsize=11
    )
    for row, (loss, fit) in zip(top.subplots(len(fits), len(kept)), fits.items(), strict=True):
        for axes, iteration in zip(row, kept, strict=True):
            draw_view(axes, scene, fit.poses[iteration])
            axes.set_xlabel(f"{fit.errors[iteration].angle_deg:.2f}\N{DEGREE SIGN}", fontsize=10)
        row[0].set_ylabel(loss, fontsize=12, color=COLOURS[loss], fontweight="bold")
        if loss == next(iter(fits)):
            for axes, iteration in zip(row, kept, strict=True):
                axes.set_title(f"iteration {iteration}", fontsize=12)
    angle, distance = np.asarray(bottom.subplots(1, 2))
    for loss, fit in fits.items():
        style = {"color": COLOURS[loss], "lw": 1.6, "label": f"{loss} ({fit.seconds:.1f} s)"}
        angle.plot([e.angle_deg for e in fit.errors], **style)
        distance.plot([e.distance for e in fit.errors], **style)
    angle.set(ylabel="rotation error (degrees)", yscale="log", xlabel="iteration")
    distance.set(ylabel="distance of the camera (shape: 1 across)", yscale="log", xlabel="iteration")
    for axes in (angle, distance):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    angle.legend(fontsize=9)
    return figure


def run(out: Path, *, iterations: int, angle_deg: float = 20.0, distance: float = 0.15) -> dict[str, Fit]:
    """All fits, and the figure."""
    scene = make_scene(angle_deg=angle_deg, distance=distance)
    kept = tuple(sorted({0, iterations // 15, iterations // 5, iterations}))
    fits: dict[str, Fit] = {}
    for loss in LOSSES:
        print(f"{loss}:", flush=True)
        fits[loss] = fit_pose(scene, loss, iterations=iterations, kept=kept)
    out.mkdir(parents=True, exist_ok=True)
    draw(scene, fits).savefig(out / "camera_pose.png")
    print(f"wrote {out / 'camera_pose.png'}")
    return fits


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/camera_pose"), help="folder to write to (%(default)s)"
    )
    parser.add_argument(
        "--iterations", type=int, default=300, help="steps of Adam for each loss (%(default)s)"
    )
    parser.add_argument(
        "--angle-deg", type=float, default=20.0, help="rotation error of the first guess (%(default)s)"
    )
    parser.add_argument(
        "--distance", type=float, default=0.15, help="its shift; the shape is 1 across (%(default)s)"
    )
    arguments = parser.parse_args()
    if arguments.iterations < 20:
        parser.error("--iterations must be at least 20; 300 is what the figure is made with")
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work
    run(
        arguments.out,
        iterations=arguments.iterations,
        angle_deg=arguments.angle_deg,
        distance=arguments.distance,
    )


if __name__ == "__main__":
    main()
