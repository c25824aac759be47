"""The `reconstruct` command: pictures in, a point cloud and a page to look at out."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from diffpoint.io import write_points
from train.errors import UserError
from train.files import replacing
from train.images import on_dark, read_images
from train.inference import reconstruct
from train.runs import open_run

MOST_IMAGES = 24


def reconstruct_to_files(
    run: Path,
    images: Sequence[Path],
    out: Path,
    *,
    groups: int | None = None,
    steps: int | None = None,
    seed: int = 0,
) -> None:
    """Reconstructs one object and writes reconstruction.ply and reconstruction.html into `out`.

    Everything is read and computed before anything is written. `groups` and `steps` are the run's if not given.

    Raises:
        UserError: a run that is no run, an image that is no image, or a wrong number of either.
    """
    from train.pages import write_reconstruction_page

    if not 1 <= len(images) <= MOST_IMAGES:
        raise UserError(f"reconstruct takes 1 to {MOST_IMAGES} images; got {len(images)}")
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; --out names a directory")
    if (groups is not None and groups < 1) or (steps is not None and steps < 0):
        raise UserError(f"--groups must be at least 1 and --steps at least 0; got {groups} and {steps}")
    pictures = read_images(images)
    if dark := on_dark(pictures):
        names = ", ".join(str(images[i]) for i in dark)
        print(
            f"note: {names}: the border is not white; the network expects the object alone, on white or transparent",
            file=sys.stderr,
        )
    model, config, _ = open_run(run)
    found = reconstruct(model, pictures, groups=groups, steps=steps, seed=seed, settings=config.inference)
    points = found.points[0]
    made = f"{len(points)} points from {len(images)} image{'s' if len(images) > 1 else ''}"
    if len(found.history):
        before, after = found.history[0, 0].item(), found.history[found.kept[0], 0].item()
        made += f"; the views' disagreement (chamfer x100) fell from {before:.2f} to {after:.2f}"

    with replacing(out / "reconstruction.html") as page:
        write_reconstruction_page(page, pictures, points, title="Reconstruction", subtitle=made)
        write_points(out / "reconstruction.ply", points)
    print(f"wrote {out}/reconstruction.ply and {out}/reconstruction.html: {made}")
