"""The commands `reconstruct` and `explore`: images in, a point cloud (PLY) and HTML pages out."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from diffpoint.io import write_points
from train.data.cutout import cut_out
from train.data.images import PICTURE_SUFFIXES, is_cut_out, read_images, read_rgba
from train.data.layouts import pictures_of
from train.data.photos import is_mask, mask_of, masks_in
from train.device import CPU
from train.errors import UserError
from train.evaluation.explore import explore, not_explorable
from train.evaluation.inference import reconstruct
from train.evaluation.runs import open_run
from train.files import remove, replacing, require_writable
from train.show.explorer import write_explorer

MOST_IMAGES = 24


def reconstruct_to_files(
    run: str | Path,
    images: Sequence[str | Path],
    out: str | Path,
    *,
    groups: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: torch.device = CPU,
) -> None:
    """Reconstructs one object and writes reconstruction.ply, reconstruction.html and explore.html into `out`.

    Nothing is written before everything is computed. There is no explore.html if predictions do not depend on codes.

    Args:
        run: a run's directory, a .safetensors file of one, or "pretrained".
        images: 1 to 24 images of the object, or folders of them.
        out: directory to write to.
        groups: groups of random codes in the search; by default the run's setting.
        steps: gradient steps on the codes; by default the run's setting.
        seed: of the random codes.
        device: where the predictions are computed.

    Raises:
        UserError: not a run, not an image, a number out of range, or a place that cannot be written.
    """
    from train.show.pages import write_reconstruction_page

    out = Path(out)
    images = _object_files(images, command="reconstruct")
    for file in ("reconstruction.ply", "reconstruction.html", "explore.html"):
        require_writable(out / file)
    if (groups is not None and groups < 1) or (steps is not None and steps < 0):
        raise UserError(f"--groups must be at least 1 and --steps at least 0; got {groups} and {steps}")
    pictures = read_pictures(images)
    model, config, _ = open_run(run, device=device)
    found = reconstruct(model, pictures, groups=groups, steps=steps, seed=seed, settings=config.inference)
    points = found.points[0]
    planes = None if not_explorable(model) else explore(model, pictures, found.codes[0], seed=seed)
    made = f"{len(points)} points from {_count(images)}"
    if len(found.history):
        before, after = found.history[0, 0].item(), found.history[found.kept[0], 0].item()
        made += f"; the views' disagreement (chamfer x100) fell from {before:.2f} to {after:.2f}"

    written = [out / "reconstruction.ply", out / "reconstruction.html"]
    with replacing(out / "reconstruction.html") as page:
        write_reconstruction_page(page, pictures, points, title="Reconstruction", subtitle=made)
        write_points(out / "reconstruction.ply", points)
        if planes:
            write_explorer(out / "explore.html", planes)
            written.append(out / "explore.html")
        else:
            remove(out / "explore.html")  # of an earlier reconstruction
    print(f"wrote {', '.join(map(str, written))}: {made}")


def explore_to_file(
    run: str | Path,
    images: Sequence[str | Path],
    out: str | Path,
    *,
    seed: int = 0,
    device: torch.device = CPU,
) -> None:
    """Writes a page on which one drags through the codes of each image of an object; see `train.show.explorer`.

    Args:
        run: a run's directory, a .safetensors file of one, or "pretrained".
        images: 1 to 24 images of the object, or folders of them.
        out: the .html file.
        seed: of the random codes.
        device: where the predictions are computed.

    Raises:
        UserError: not a run, one whose predictions do not depend on a code, not an image, or `out` cannot be written.
    """
    out = Path(out)
    images = _object_files(images, command="explore")
    require_writable(out)
    pictures = read_pictures(images)
    model, config, _ = open_run(run, device=device)
    obstacle = not_explorable(model)
    if obstacle:
        raise UserError(f"{run} cannot be explored: {obstacle}")
    codes = reconstruct(model, pictures, seed=seed, settings=config.inference).codes[0]
    write_explorer(out, explore(model, pictures, codes, seed=seed))
    print(f"wrote {out}: {_count(images)}, {out.stat().st_size // 1000} kB; open it in a browser")


def _count(images: Sequence[Path]) -> str:
    return f"{len(images)} image{'s' if len(images) > 1 else ''}"


def _object_files(images: Sequence[str | Path], *, command: str) -> list[Path]:
    files = image_files(images)
    if not 1 <= len(files) <= MOST_IMAGES:
        raise UserError(f"{command} takes 1 to {MOST_IMAGES} images; got {len(files)}")
    return files


def image_files(paths: Sequence[str | Path]) -> list[Path]:
    """The given image files; a folder is replaced by the images in it, a model of Choy's renderings by its views.

    Of a folder, masks of photographs and hidden files, such as macOS writes beside each picture, are left out.

    Raises:
        UserError: a folder without images.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir():
            found.append(path)
            continue
        inside = pictures_of(path) or sorted(
            each
            for each in path.iterdir()
            if each.suffix.lower() in PICTURE_SUFFIXES and each.name[0] != "." and not is_mask(each)
        )
        if not inside:
            raise UserError(
                f"{path} is a folder without pictures; name pictures, or a folder that holds some"
            )
        found += inside
    return found


def read_pictures(paths: Sequence[str | Path]) -> Tensor:
    """(V, 3, 224, 224) in [0, 1]: objects on white; photographs with a mask or a plain background are cut out.

    An image with transparency or a purely white border counts as cut out already; its scale is kept. A mask is a file
    beside the photograph, as for `data photos`.

    Raises:
        UserError: not an image, or a mask that does not fit its photograph.
    """
    pictures, masks_beside = [], functools.cache(masks_in)
    for path in map(Path, paths):
        rgba = read_rgba(path)
        picture = read_images([path])
        if not is_cut_out(rgba):
            mask = mask_of(path, masks_beside(path.parent))
            try:
                made = cut_out(rgba, size=picture.shape[-1], given=mask and read_rgba(mask))
            except UserError as error:
                if mask:
                    raise UserError(f"{path}: {error}") from None
                print(f"note: {path}: used whole: {error}", file=sys.stderr)
            else:
                print(f"note: {path}: cut out: {made.found}", file=sys.stderr)
                picture = torch.from_numpy(made.picture).permute(2, 0, 1)[None] / 255
        pictures.append(picture)
    return torch.cat(pictures)
