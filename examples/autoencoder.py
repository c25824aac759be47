"""An auto-encoder of point clouds, trained with the chamfer distance and with the earth mover's distance (EMD).

    python examples/autoencoder.py --out out/autoencoder

The encoder is a small PointNet (the same layers for every point, then the maximum over the points), the decoder an MLP
that gives all points at once. Both networks start from the same weights and see the same batches of random furniture.

The chamfer distance compares each point with its nearest neighbour only, so that many points may share one neighbour:
clouds trained with it are crowded in some places and sparse in others. The EMD matches the points one to one, so that
each part of the surface gets its share of them. Three measures on held-out shapes show it:

* chamfer, EMD: distances x100 to another sample of the true surface; the shapes are about 1 across;
* crowding: to each of 2048 true points belongs its nearest predicted one; standard deviation over mean of how many
  belong to one. 0 is even; the last row of the table has the value of a uniform random sample.

Writes table.md and clouds.png to --out. Needs diffpoint and matplotlib; takes less than two minutes on two cores.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: its idle threads would slow the kernels

import torch
from matplotlib.figure import Figure
from shapes import KINDS, furniture, sample_surface
from torch import Tensor, nn

import diffpoint as dp

BATCH = 16
SAMPLES = 2048  # points that are drawn from each surface, of which every step takes some


class AutoEncoder(nn.Module):
    """(B, N, 3) -> code (B, code) -> (B, points, 3)."""

    def __init__(self, points: int, code: int = 64) -> None:
        super().__init__()
        self.each_point = nn.Sequential(
            nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 128), nn.ReLU(), nn.Linear(128, 256)
        )
        self.to_code = nn.Linear(256, code)
        self.decode = nn.Sequential(
            nn.Linear(code, 256), nn.ReLU(), nn.Linear(256, 512), nn.ReLU(), nn.Linear(512, 3 * points)
        )

    def forward(self, clouds: Tensor) -> Tensor:
        codes = self.to_code(self.each_point(clouds).amax(1).relu())
        return self.decode(codes).unflatten(-1, (-1, 3))


def chamfer(predicted: Tensor, target: Tensor) -> Tensor:
    to_target, to_predicted = dp.chamfer_distance(predicted, target, squared=False)
    return (to_target + to_predicted).mean()


def emd(predicted: Tensor, target: Tensor, tolerance: float = 0.05) -> Tensor:
    return dp.earth_mover_distance(predicted, target, tolerance=tolerance).cost.mean()


def crowding(predicted: Tensor, target: Tensor) -> float:
    nearest = dp.nearest(target, predicted).index
    counts = torch.zeros(predicted.shape[:2]).scatter_add(1, nearest, torch.ones(nearest.shape))
    return (counts.std(1) / counts.mean(1)).mean().item()


LOSSES = {"chamfer": chamfer, "EMD": emd}


def make_clouds(count: int, seed: int) -> Tensor:
    """(count, SAMPLES, 3) surfaces of random chairs, tables, sofas, lamps and shelves, in turns."""
    random = torch.Generator().manual_seed(seed)
    return torch.stack(
        [sample_surface(furniture(KINDS[i % len(KINDS)], random), SAMPLES, random) for i in range(count)]
    )


def train(clouds: Tensor, loss: str, *, points: int, steps: int, seed: int) -> AutoEncoder:
    torch.manual_seed(seed)
    model = AutoEncoder(points)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step in range(steps):
        batch = clouds[torch.randint(len(clouds), (BATCH,)), :][:, torch.randperm(SAMPLES)[:points]]
        value = LOSSES[loss](model(batch), batch)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        schedule.step()
        if step % 100 == 0:
            print(f"  {loss}, step {step}: {100 * value.item():.2f}", flush=True)
    return model


def draw(clouds: dict[str, Tensor]) -> Figure:
    """A row for each of the titled clouds (S, N, 3), a column for each shape, seen from a little above."""
    figure = Figure(figsize=(2.6 * len(KINDS), 2.7 * len(clouds)), layout="constrained", dpi=110)
    figure.suptitle("Held-out shapes and their reconstructions")
    to_screen = torch.tensor([[0.8, 0.0, -0.6], [-0.25, 0.91, -0.33]])
    for row, (title, some) in zip(figure.subplots(len(clouds), len(KINDS)), clouds.items(), strict=True):
        for axes, cloud in zip(row, some, strict=True):
            axes.scatter(*(to_screen @ cloud.T), s=4, c="#22577a", linewidths=0)
            axes.set(xlim=(-0.55, 0.55), ylim=(-0.55, 0.55), aspect="equal", xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        row[0].set_ylabel(title, fontsize=11)
    return figure


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, default=Path("out/autoencoder"), help="folder to write to (%(default)s)")
    add("--steps", type=int, default=600, help="steps of Adam with each loss (%(default)s)")
    add("--shapes", type=int, default=500, help="training shapes (%(default)s)")
    add("--points", type=int, default=512, help="points of a cloud (%(default)s)")
    add("--seed", type=int, default=0, help="of the shapes, the weights and the batches (%(default)s)")
    arguments = parser.parse_args(argv)
    if arguments.steps < 1 or arguments.shapes < 1 or not 1 <= arguments.points <= SAMPLES // 2:
        parser.error(f"--steps and --shapes must be at least 1, --points between 1 and {SAMPLES // 2}")
    arguments.out.mkdir(parents=True, exist_ok=True)

    clouds = make_clouds(arguments.shapes, 2 * arguments.seed)
    held_out = make_clouds(100, 2 * arguments.seed + 1)
    seen, target = held_out.split(arguments.points, dim=1)[:2]  # two samples of the same surfaces
    rows, drawn = {}, {"ground truth": seen[: len(KINDS)]}
    for loss in LOSSES:
        begun = time.perf_counter()
        model = train(clouds, loss, points=arguments.points, steps=arguments.steps, seed=arguments.seed)
        print(f"  {loss}: {time.perf_counter() - begun:.0f} seconds")
        with torch.no_grad():
            rows[loss] = model(seen)
        drawn[f"trained with {loss}"] = rows[loss][: len(KINDS)]
    rows["(a sample of the ground truth)"] = seen

    table = ["| trained with | chamfer | EMD | crowding |", "|---|---:|---:|---:|"]
    for name, predicted in rows.items():
        distances = 100 * chamfer(predicted, target), 100 * emd(predicted, target, tolerance=0.01)
        table.append(
            f"| {name} | {distances[0]:.2f} | {distances[1]:.2f} | {crowding(predicted, held_out):.2f} |"
        )
    print("", *table, sep="\n")
    (arguments.out / "table.md").write_text("\n".join(table) + "\n", encoding="utf-8")
    draw(drawn).savefig(arguments.out / "clouds.png")
    print(f"wrote table.md and clouds.png to {arguments.out}")


if __name__ == "__main__":
    main()
