"""How an image's prediction changes with the code: a plane of codes along which it changes most."""

from __future__ import annotations

import torch
from torch import Tensor

from models import Predictor
from train.processes import progress_bar
from train.show.explorer import CodePlane

_CODES = 256
_NODES = 11
"""Codes along a side of the grid. A point that is blended between them is 0.001 world units (rms) away from where the
network puts it; with 7 along a side, two to three times as much."""
_REACH = 2.5
"""Half the side of the plane: a random code's coordinates are within it with a probability of 98 %."""
_POINTS_AT_ONCE = 200_000


def not_explorable(model: Predictor) -> str | None:
    """Why there is nothing to explore in a network's predictions; None if there is."""
    if model.reads_views_together:
        return "its network makes one prediction of all images together, without a code for each"
    if not model.takes_codes:
        return "its network makes one prediction of an image, whatever the code"
    if getattr(model.config, "occupancy_logits", False):
        return "its network leaves points out, so that the points of two predictions do not correspond"
    return None


@torch.no_grad()
def explore(
    model: Predictor, images: Tensor, codes: Tensor, *, seed: int = 0, progress: bool = True
) -> list[CodePlane]:
    """Predictions of each image on a grid of codes, in the plane along which they change most.

    The plane passes through the image's given code. Its two directions are orthonormal and found by regression of the
    two principal components of the predictions on random codes.

    Args:
        model: a network for which `not_explorable` is None.
        images: (V, 3, H, W) in [0, 1], on the CPU as the codes and the result are.
        codes: (V, D) a typical code for each, for example those on which `reconstruct` found the images to agree.
        seed: of the random codes.
        progress: show a progress bar.
    """
    drawn = torch.randn(_CODES, model.code_dim, generator=torch.Generator().manual_seed(seed))
    ticks = torch.linspace(-1, 1, _NODES)
    grid = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), dim=-1).flatten(0, 1)
    found = []
    pairs = list(zip(images, codes, strict=True))
    for image, code in progress_bar(pairs, title="plane of codes", unit="image", progress=progress):
        features = model.encode(image[None].to(model.device))
        clouds = _decode(model, features, drawn)
        directions = directions_of_change(drawn, clouds)
        start = directions @ code
        reach = max(_REACH, 1.1 * start.abs().max().item())
        nodes = code - start @ directions + reach * grid @ directions
        found.append(
            CodePlane(
                image=image,
                clouds=_decode(model, features, nodes),
                spread=(clouds - clouds.mean(0)).square().sum(-1).mean(0).sqrt(),
                start=start / reach,
                reach=reach,
            )
        )
    return found


def directions_of_change(codes: Tensor, clouds: Tensor) -> Tensor:
    """(2, D) orthonormal directions of code space along which clouds (R, N, 3) of codes (R, D) change most."""
    changes = (clouds - clouds.mean(0)).flatten(1)
    left, strength, _ = torch.linalg.svd(changes, full_matrices=False)
    components = left[:, :2] * strength[:2]
    slopes = torch.linalg.lstsq(codes - codes.mean(0), components).solution
    return torch.linalg.qr(slopes).Q.T


def _decode(model: Predictor, features: Tensor, codes: Tensor) -> Tensor:
    """Features of one image and (R, D) codes on the CPU -> (R, N, 3), there too."""
    at_once = max(1, _POINTS_AT_ONCE // model.points)
    codes = codes.to(features.device)
    return torch.cat([model.decode(features, some[:, None])[:, 0] for some in codes.split(at_once)]).cpu()
