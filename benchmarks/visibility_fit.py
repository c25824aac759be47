"""`python -m benchmarks.visibility_fit`: fit the filters of the horizon test, and write diffpoint/_horizon.py.

The shapes are of other authors (and other seeds) than those that `benchmarks.visibility` measures on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.visibility_shapes import FITTED, FURNITURE, Scene, mesh_scenes, procedural_scenes
from diffpoint import reference
from diffpoint._horizon import REACH

COUNTS = {1024: 4, 2048: 8, 4096: 2}
"""Points of the clouds, and how many views of each shape are used at that number."""
FILTERS = 8
HIDDEN_WEIGHT = 6.0
"""A hidden point that is kept costs so many times a visible one that is lost: little of what is kept may be hidden."""
SIZE = 224  # of the frame: the horizons do not depend on it

TEMPLATE = '''"""The filters of the horizon test, as `python -m benchmarks.visibility_fit` fits them."""

from __future__ import annotations

REACH = {reach}
"""Radius of the horizons that the filters read, in spacings of the points."""
BIAS = {bias:.3f}
"""Score + BIAS is the logarithm of the odds that a point is hidden."""
FILTERS: tuple[tuple[float, ...], ...] = (
{rows}
)
"""Per filter: 8 weights, one for each sector; a bias; the weights of its mean and its maximum over 8 rotations."""
'''


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.visibility_fit", description=__doc__)
    parser.add_argument("--per-category", type=int, default=12, help="meshes of each category (default: 12)")
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "diffpoint/_horizon.py")
    arguments = parser.parse_args()

    torch.manual_seed(0)
    counts = tuple(COUNTS)
    scenes = list(
        mesh_scenes([FURNITURE / name for name in FITTED], counts, per_category=arguments.per_category)
    )
    scenes += procedural_scenes(range(100, 106), counts)
    samples = [
        sample(scene, count, view)
        for scene in scenes
        for count, views in COUNTS.items()
        for view in range(views)
    ]
    horizons, hidden = torch.cat([s[0] for s in samples]), torch.cat([s[1] for s in samples])
    share = hidden.float().mean()
    print(f"{len(scenes)} shapes, {len(samples)} views, {len(horizons)} points, {share:.3f} of them hidden")
    filters, bias = fit(horizons, hidden, arguments.steps)
    rows = "\n".join("    (" + ", ".join(f"{x:.3f}" for x in row) + ")," for row in filters.tolist())
    arguments.out.write_text(TEMPLATE.format(reach=REACH, bias=bias, rows=rows))
    print(f"Saved {arguments.out}")


def sample(scene: Scene, count: int, view: int) -> tuple[Tensor, Tensor]:
    """Horizons (m, 8) of the points that are not enclosed, and whether they are hidden (m,)."""
    camera = scene.camera[view]
    image, framed = reference.image_positions(
        scene.clouds[count], camera.K, camera.cam_from_world, (SIZE, SIZE)
    )
    chosen = framed.nonzero()[:, 0]
    spacing = reference.point_spacing(image[chosen], 1.0)
    horizon, kept = reference.horizons(image[chosen], 1.0, spacing, REACH)
    return horizon, scene.hidden[count][view][chosen[kept]]


def fit(horizons: Tensor, hidden: Tensor, steps: int) -> tuple[Tensor, float]:
    """Weighted logistic regression on the score of the filters, by Adam; mirrored every other step."""
    weights = torch.randn(FILTERS, 11) * torch.tensor([0.5] * 8 + [0.2] * 3)
    weights.requires_grad_()
    bias = torch.zeros((), requires_grad=True)
    optimiser = torch.optim.Adam([weights, bias], lr=0.03)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 0.03, steps)
    weight = torch.tensor(HIDDEN_WEIGHT)
    average = torch.zeros(())
    for step in range(steps):
        chosen = torch.randint(len(horizons), (2048,))
        horizon = horizons[chosen].flip(1) if step % 2 else horizons[chosen]
        horizon = torch.cat((horizon, unobstructed(64)))
        target = torch.cat((hidden[chosen], torch.zeros(64, dtype=torch.bool))).float()
        score = reference.horizon_score(horizon, weights) + bias
        loss = torch.nn.functional.binary_cross_entropy_with_logits(score, target, pos_weight=weight)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        average = torch.lerp(loss.detach(), average, 0.99)
        if (step + 1) % 1000 == 0:
            print(f"step {step + 1}: cross entropy {average:.4f}", flush=True)
    return weights.detach(), float(bias.detach() - weight.log())  # odds of the points as they are


def unobstructed(count: int) -> Tensor:
    """Horizons (count, 8) before which nothing rises, half of them of lone points: rare in clouds, and visible."""
    horizon = -torch.rand(count, 8)
    horizon[: count // 2] = -1
    return horizon


if __name__ == "__main__":
    main()
