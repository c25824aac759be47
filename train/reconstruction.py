"""The `reconstruct` command: pictures in, a point cloud and a page to look at out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from diffpoint.io import write_points
from train.checkpoint import config_of, load_generator
from train.errors import UserError
from train.files import replacing
from train.images import read_images
from train.inference import reconstruct

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
    model = load_generator(run)
    inference = config_of(run, model).inference
    groups = inference.groups if groups is None else groups
    steps = inference.steps if steps is None else steps
    if groups < 1 or steps < 0:
        raise UserError(f"--groups must be at least 1 and --steps at least 0; got {groups} and {steps}")
    pictures = read_images(images)
    found = reconstruct(model, pictures, groups=groups, steps=steps, seed=seed, step_size=inference.step_size)
    points = found.points[0]
    made = f"{len(points)} points from {len(images)} image{'s' if len(images) > 1 else ''}"
    if len(found.history):
        before, after = found.history[0, 0].item(), found.history[-1, 0].item()
        made += f"; the views' disagreement (chamfer x100) fell from {before:.2f} to {after:.2f}"

    with replacing(out / "reconstruction.html") as page:
        write_reconstruction_page(page, pictures, points, title="Reconstruction", subtitle=made)
        write_points(out / "reconstruction.ply", points)
    print(f"wrote {out}/reconstruction.ply and {out}/reconstruction.html: {made}")
