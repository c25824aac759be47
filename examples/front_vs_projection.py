"""Two ways to use one depth renderer: the front constraint against projection losses.

    python examples/front_vs_projection.py --out out/front_vs_projection

A free cloud of 1024 points is fitted to the depth maps of a chair, a table and a sofa, from one view and from eight:

* the projection loss compares depths pixel by pixel, and can move a point only along the camera's axis;
* Lin et al. add a mask term, which can delete points but not move them, and render at a higher resolution;
* the soft projection loss renders points as discs that fade to their edge, so that it sees a step to the side;
* the front constraint takes the points that the view sees and compares them in 3D with those of the depth map.

Writes clouds.png and table.md to --out. The whole study, on more shapes, views and seeds:
`python -m train experiment front-vs-projection`. Needs what training needs (`pip install -e .[train]`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from train.experiments.front_vs_projection.free_clouds import LOSSES, Fit, fit_cloud
from train.experiments.front_vs_projection.page import DRAWN, ONE, clouds
from train.experiments.front_vs_projection.shapes import Cameras, embedded_shape
from train.show.figures import save

SHAPES = ("chair", "table", "sofa")
CAMERAS = (ONE, Cameras(8))
RATE = 0.03


def run(out: Path, *, iterations: int) -> dict[tuple[str, str, str], Fit]:
    """All 24 fits, the table and the figure; by shape, cameras and loss."""
    kept = sorted({0, iterations // 10, 3 * iterations // 10, iterations})
    fits: dict[tuple[str, str, str], Fit] = {}
    scenes = {}
    for category in SHAPES:
        shape = embedded_shape(category)
        for cameras in CAMERAS:
            scene = scenes[category, cameras] = shape.scene(cameras, seed=0)
            assert scene is not None
            fit_cloud(
                scene, LOSSES["front"], iterations=1, rate=RATE
            )  # kernels are compiled before time is taken
            for loss in DRAWN:
                print(f"{category}, {cameras.name}, {LOSSES[loss].title} ...", flush=True)
                fits[category, cameras.name, loss] = fit_cloud(
                    scene, LOSSES[loss], iterations=iterations, rate=RATE, kept=kept
                )
    table = write_table(fits)
    print(f"\n{table}")
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.md").write_text(table, encoding="utf-8")
    first = SHAPES[0]
    drawn = {(ONE, loss): fits[first, ONE.name, loss] for loss in DRAWN}
    save(clouds({ONE: scenes[first, ONE]}, drawn, first), out / "clouds.png")
    print(f"wrote {out / 'clouds.png'} and {out / 'table.md'}")
    return fits


def write_table(fits: dict[tuple[str, str, str], Fit]) -> str:
    """A Markdown table with a line per fit; distances x100, of shapes about 1 across."""
    lines = [
        "| shape | views | loss | visible part | inside silhouette | cloud -> shape | shape -> cloud | points left "
        "| own loss, first -> last | gradient across the first view's axis | ms a step |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (shape, cameras, loss), fit in fits.items():
        m = fit.measures
        lines.append(
            f"| {shape} | {cameras} | {LOSSES[loss].title} | {m.visible_cd:.2f} | {m.inside:.2f} | {m.pred_to_gt:.2f} "
            f"| {m.gt_to_pred:.2f} | {m.left:.0%} | {fit.losses[0]:.3f} -> {fit.losses[-1]:.3f} | {fit.sideways:.3f} "
            f"| {fit.ms_per_iteration:.1f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/front_vs_projection"), help="folder (%(default)s)"
    )
    parser.add_argument(
        "--iterations", type=int, default=200, help="steps of Adam for each fit (%(default)s)"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work
    if arguments.iterations < 20:
        parser.error("--iterations must be at least 20; 200 is what the table is made with")
    run(arguments.out, iterations=arguments.iterations)


if __name__ == "__main__":
    main()
