"""Two answers without a network, which any trained one must beat: the medoid, and the nearest shape by
image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffpoint import chamfer_distance
from train.data.batches import LoadedSplit

_MEDOID_SHAPES = 1000
_MEDOID_POINTS = 256


def medoid(points: Tensor) -> int:
    """Number of the cloud with the smallest mean chamfer distance to all others.

    Args:
        points: (M, P, 3). At most 1000 clouds, spread evenly, are compared, each by 256 of its points.
    """
    stride = max(1, points.shape[1] // _MEDOID_POINTS)
    numbers = torch.arange(len(points))
    if len(points) > _MEDOID_SHAPES:
        numbers = torch.linspace(0, len(points) - 1, _MEDOID_SHAPES).long()
    thin = points[numbers, ::stride].contiguous()
    totals = torch.zeros(len(numbers))
    for row in range(len(numbers)):
        distance = chamfer_distance(thin[row].expand_as(thin).contiguous(), thin, squared=False)
        totals[row] = (distance.a_to_b + distance.b_to_a).sum()
    return int(numbers[totals.argmin()])


def nearest_by_image(test: LoadedSplit, train: LoadedSplit, *, views: Sequence[int]) -> dict[int, Tensor]:
    """For each number of views, the training shape whose renders look most like each test shape's images.

    The distance of a test shape to a training shape is the sum over the test shape's first n images of the
    smallest L2 distance to any image of the training shape.

    Returns:
        For each n of `views`, (M_test,) numbers of training shapes.
    """
    known = torch.stack(tuple(train.images)).flatten(2).flatten(0, 1).float() / 255
    known_squared = known.square().sum(1)
    smallest = []
    for images in test.images:
        seen = images.flatten(1).float() / 255
        squared = seen.square().sum(1)[:, None] + known_squared - 2 * seen @ known.T
        distance = squared.clamp(min=0).sqrt().unflatten(1, (len(train), train.views))
        smallest.append(distance.amin(2))
    by_view = torch.stack(smallest)
    return {n: by_view[:, :n].sum(1).argmin(1) for n in views}
