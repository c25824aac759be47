"""A depth map becomes a cloud, is warped to another view, and the other camera's pose is found through the warp.

    python examples/warp_depth.py --out out/warp_depth

Two cameras see a chair. `diffpoint.unproject` turns the depth map of the first into a cloud in the world, and
`diffpoint.splat_depth` renders that cloud from the second. If the second camera's pose is wrong, the warped depth map
does not lie on the one that this camera saw. From a first guess that is wrong by 20 degrees, Adam moves the six numbers
of a rigid motion (a twist of se(3)) down one of three losses, each differentiable with respect to `cam_from_world`:

* matched pixels: 12 points of the cloud and where the second camera saw them; `diffpoint.project`;
* warped depth: the first depth map, warped pixel by pixel, against the second; `diffpoint.reproject`;
* clouds: the chamfer distance between the clouds of both depth maps (as in ICP), without any correspondence. Parts that
  only one camera sees keep it from being exact.

Writes table.md and warp.png to --out. Needs diffpoint and matplotlib; takes a few seconds.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from shapes import SIZE, furniture, orbit, render_depth
from torch import Tensor
from torch.nn import functional as F

import diffpoint as dp

MAX_DIFFERENCE = 0.2  # a larger difference in depth is another surface: it is clamped and has no gradient


class Scene(NamedTuple):
    first: dp.PinholeCamera
    second: dp.PinholeCamera  # its true pose is used to judge by, and to make the matched pixels
    first_depth: Tensor  # (1, 1, H, W)
    second_depth: Tensor
    cloud: Tensor  # (1, N, 3) what the first camera sees, in the world
    matched: Tensor  # (12,) points of the cloud
    matched_pixels: Tensor  # (1, 1, 12, 2) where the second camera sees them


def make_scene() -> Scene:
    """A chair, seen by two cameras that are 40 degrees apart."""
    random = torch.Generator().manual_seed(0)
    boxes = furniture("chair", random)
    cameras = orbit(torch.tensor([35.0, 75.0]), elevation_deg=20.0)
    first_depth, second_depth = render_depth(boxes, cameras)[:, None, None]
    points, lengths = dp.unproject(first_depth, cameras[0])
    cloud = points[:, 0, : int(lengths)]
    matched = torch.randperm(cloud.shape[1], generator=random)[:12]
    pixels = dp.project(cloud[:, matched], cameras[1]).pixels
    return Scene(cameras[0], cameras[1], first_depth, second_depth, cloud, matched, pixels)


def matched_pixel_loss(scene: Scene, camera: dp.PinholeCamera) -> Tensor:
    """Mean distance in the image, in focal lengths."""
    pixels = dp.project(scene.cloud[:, scene.matched], camera).pixels
    return (pixels - scene.matched_pixels).norm(dim=-1).mean() / camera.K[0, 0]


def warped_depth_loss(scene: Scene, camera: dp.PinholeCamera) -> Tensor:
    """Mean |depth of the first camera's points in the second - depth that it saw at their pixels|."""
    warped = dp.reproject(scene.first_depth, scene.first, camera)
    foreground = torch.isfinite(scene.second_depth)
    seen = torch.cat((torch.where(foreground, scene.second_depth, 0.0), foreground.to(warped.depth)), 1)
    pixels = torch.where(warped.valid[..., None], warped.pixels, -SIZE)  # those outside go far outside
    grid = pixels / (SIZE / 2) - 1  # from [0, SIZE] to the [-1, 1] of grid_sample
    depth, covered = F.grid_sample(seen, grid[:, 0], align_corners=False).unbind(1)
    on_shape = covered > 0.99  # not interpolated between the shape and the background
    difference = torch.where(on_shape, warped.depth[:, 0] - depth, MAX_DIFFERENCE).abs()
    return difference.clamp(max=MAX_DIFFERENCE)[torch.isfinite(scene.first_depth[:, 0])].mean()


def cloud_loss(scene: Scene, camera: dp.PinholeCamera) -> Tensor:
    """Chamfer distance between the clouds of both depth maps; that of the second moves with its camera."""
    points, lengths = dp.unproject(scene.second_depth, camera)
    both = dp.chamfer_distance(scene.cloud, points[:, 0], squared=False, b_lengths=lengths[:, 0])
    return both.total.mean()


LOSSES = {"matched pixels": matched_pixel_loss, "warped depth": warped_depth_loss, "clouds": cloud_loss}


def rigid_motion(twist: Tensor) -> Tensor:
    """exp: se(3) -> SE(3). (6,) rotation axis times angle in radians, then velocity; -> (4, 4)."""
    x, y, z, *velocity = twist.unbind()
    zero = torch.zeros_like(x)
    rows = ((zero, -z, y, velocity[0]), (z, zero, -x, velocity[1]), (-y, x, zero, velocity[2]), (zero,) * 4)
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def find_pose(scene: Scene, loss: str, start: Tensor, *, iterations: int) -> tuple[list[Tensor], float]:
    """cam_from_world (4, 4) of the second camera before each step and after the last; and milliseconds a step."""
    twist = torch.zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([twist], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, eta_min=1e-4)
    poses, begun = [start], 0.0
    for step in range(iterations):
        if step == 1:
            begun = time.perf_counter()  # the first step compiles kernels
        # The motion turns the world about the shape: about the camera, a rotation and a shift would look alike.
        cam_from_world = start @ rigid_motion(twist)
        optimiser.zero_grad()
        LOSSES[loss](scene, dp.PinholeCamera(scene.second.K, cam_from_world, SIZE, SIZE)).backward()
        optimiser.step()
        schedule.step()
        poses.append(start @ rigid_motion(twist.detach()))
    return poses, 1000 * (time.perf_counter() - begun) / (iterations - 1)


def pose_error(estimate: Tensor, true: Tensor) -> tuple[float, float]:
    """Rotation in degrees, and distance between the optical centres; the shape is about 1 across."""
    estimate, true = estimate.double(), true.double()  # near 0 the angle needs the digits
    between = estimate[:3, :3] @ true[:3, :3].T
    sine = (between - between.T)[[2, 0, 1], [1, 2, 0]].norm() / 2
    apart = torch.linalg.inv(estimate)[:3, 3] - torch.linalg.inv(true)[:3, 3]
    return math.degrees(torch.atan2(sine, (between.trace() - 1) / 2)), apart.norm().item()


def draw(scene: Scene, poses: dict[str, list[Tensor]]) -> Figure:
    """Both depth maps and the errors on the left; the warped depth map on its way, a row for each loss."""
    figure = Figure(figsize=(13, 8.2), layout="constrained", dpi=110)
    figure.suptitle(
        "First depth map, warped to the second view with the estimated pose, minus the second depth map.\n"
        "Red: behind, or seen by the second camera only. Blue: in front, or nothing is seen there. White: equal."
    )
    grid = figure.subplots(3, 5)
    for axes, depth, name in (
        (grid[0, 0], scene.first_depth, "first"),
        (grid[1, 0], scene.second_depth, "second"),
    ):
        axes.imshow(depth[0, 0].numpy())
        axes.set(title=f"{name} depth map", xticks=[], yticks=[])
    for row, (loss, found) in zip(grid, poses.items(), strict=True):
        errors = [pose_error(pose, scene.second.cam_from_world)[0] for pose in found]
        grid[2, 0].plot(errors, label=loss, lw=1.3)
        last = len(found) - 1
        for axes, step in zip(row[1:], (0, last // 15, last // 5, last), strict=True):
            camera = dp.PinholeCamera(scene.second.K, found[step], SIZE, SIZE)
            warped = dp.splat_depth(scene.cloud, camera, radius=0.8).depth
            axes.imshow((warped - scene.second_depth)[0, 0].clamp(-0.1, 0.1).numpy(), cmap="coolwarm")
            axes.set(title=f"step {step}: {errors[step]:.2f}\N{DEGREE SIGN}", xticks=[], yticks=[])
        row[1].set_ylabel(loss, fontsize=12)
    grid[2, 0].set(yscale="log", title="rotation error (degrees)", xlabel="step")
    grid[2, 0].legend(fontsize=8)
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, default=Path("out/warp_depth"), help="folder to write to (%(default)s)")
    add("--iterations", type=int, default=200, help="steps of Adam for each loss (%(default)s)")
    add("--angle-deg", type=float, default=20.0, help="rotation error of the first guess (%(default)s)")
    add("--shift", type=float, default=0.15, help="its shift; the shape is about 1 across (%(default)s)")
    arguments = parser.parse_args(argv)
    if arguments.iterations < 20:
        parser.error("--iterations must be at least 20; 200 is what docs/gallery.md is made with")
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work

    scene = make_scene()
    axis, shift = F.normalize(torch.tensor([[1.0, 2.0, -0.5], [-1.0, 0.5, 1.0]]), dim=-1)
    wrong = torch.cat((math.radians(arguments.angle_deg) * axis, arguments.shift * shift))
    start = scene.second.cam_from_world @ rigid_motion(wrong)
    table = ["| loss | rotation error, degrees | distance | ms a step |", "|---|---:|---:|---:|"]
    poses: dict[str, list[Tensor]] = {}
    for loss in ("(first guess)", *LOSSES):
        pose, time_taken = start, ""
        if loss in LOSSES:
            poses[loss], ms = find_pose(scene, loss, start, iterations=arguments.iterations)
            pose, time_taken = poses[loss][-1], f"{ms:.1f}"
        angle, distance = pose_error(pose, scene.second.cam_from_world)
        table.append(f"| {loss} | {angle:.3f} | {distance:.4f} | {time_taken} |")
    print(*table, sep="\n")
    (arguments.out / "table.md").write_text("\n".join(table) + "\n", encoding="utf-8")
    draw(scene, poses).savefig(arguments.out / "warp.png")
    print(f"wrote table.md and warp.png to {arguments.out}")


if __name__ == "__main__":
    main()
