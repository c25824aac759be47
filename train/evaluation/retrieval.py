"""Two retrieval baselines, which need no network: the medoid of the training shapes, and the nearest by image."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from diffpoint import chamfer_distance
from train.data.batches import LoadedSplit

_MEDOID_SHAPES = 1000
_MEDOID_POINTS = 256
_CHUNK_BYTES = 2**28  # of training images as float32 at a time; all of them can be tens of gigabytes


def medoid(points: Tensor) -> int:
    """Index of the cloud with the smallest mean chamfer distance to all others.

    Args:
        points: (M, P, 3). At most 1000 clouds, spread evenly, are compared, each by 256 of its points.
    """
    stride = max(1, points.shape[1] // _MEDOID_POINTS)
    index = torch.arange(len(points))
    if len(points) > _MEDOID_SHAPES:
        index = torch.linspace(0, len(points) - 1, _MEDOID_SHAPES).long()
    thin = points[index, ::stride].contiguous()
    totals = thin.new_zeros(len(index))
    for row in range(len(index)):
        distance = chamfer_distance(thin[row].expand_as(thin).contiguous(), thin, squared=False)
        totals[row] = distance.total.sum()
    return int(index[totals.argmin()])


def nearest_by_image(test: LoadedSplit, train: LoadedSplit, *, views: Sequence[int]) -> dict[int, Tensor]:
    """For each number of views n, the training shape whose images are nearest to those of each test shape.

    The distance of a test shape to a training shape is the sum over the test shape's first n images of the
    smallest L2 distance to any image of the training shape. Memory does not grow with the number of training shapes.

    Returns:
        For each n of `views`, (M_test,) indices of training shapes; of equally near ones the first.
    """
    device = train.device
    smallest = {n: torch.full((len(test),), torch.inf) for n in views}
    nearest = {n: torch.zeros(len(test), dtype=torch.int64) for n in views}
    chunk = max(1, _CHUNK_BYTES // (4 * math.prod(train.images[0].shape)))
    for first in range(0, len(train), chunk):
        shapes = range(first, min(first + chunk, len(train)))
        known = torch.cat([train.images[shape][:] for shape in shapes]).to(device).flatten(1).float() / 255
        known_squared = known.square().sum(1)
        for row, images in enumerate(test.images):
            seen = images[:].to(device).flatten(1).float() / 255
            squared = seen.square().sum(1)[:, None] + known_squared - 2 * seen @ known.T
            distance = squared.clamp(min=0).sqrt().unflatten(1, (len(shapes), -1)).amin(2)
            for n in views:
                least, which = (each.cpu() for each in distance[:n].sum(0).min(0))
                if least < smallest[n][row]:
                    smallest[n][row], nearest[n][row] = least, first + which
    return nearest
