"""Collapse check: how much predictions change with the image and with the code, and how much of the trunk is dead.

The loss does not show a collapse: a generator whose image trunk has died fits the mean shape of the data, and its loss
still falls.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import chamfer_distance
from models import Predictor
from train.device import moved


class Sensitivity(NamedTuple):
    """Mean chamfer distance x100 (both directions) between pairs of predictions.

    Attributes:
        image: of different images and the same code.
        code: of the same image and different codes.
        dead_share: share of the trunk's output channels that are zero at every place of every image; see
            `Predictor.dead_share`.
    """

    image: float
    code: float
    dead_share: float


@torch.no_grad()
def sensitivity(model: Predictor, images: Tensor, *, seed: int = 0) -> Sensitivity:
    """Measures how much predictions change with the image and with the code.

    Args:
        model: the network.
        images: (B, 3, H, W) of B >= 2 different shapes, in [0, 1].
        seed: of the two codes.
    """
    if len(images) < 2:
        raise ValueError(f"sensitivity: needs at least 2 images, got {len(images)}")
    codes = torch.randn(2, 1, model.code_dim, generator=torch.Generator().manual_seed(seed))
    features = model.encode(moved(images, model.device))
    clouds = model.decode(features, moved(codes.expand(2, len(images), -1), model.device))
    return Sensitivity(
        image=_mean_cd100(clouds[0], clouds[0].roll(1, 0)),
        code=_mean_cd100(clouds[0], clouds[1]),
        dead_share=model.dead_share(features),
    )


def _mean_cd100(a: Tensor, b: Tensor) -> float:
    distance = chamfer_distance(a.contiguous(), b.contiguous(), squared=False)
    return 100 * distance.total.mean().item()
