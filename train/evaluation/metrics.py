"""The paper's metrics: un-squared distances x100, each direction a mean over its own set."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import (
    PinholeCamera,
    earth_mover_distance,
    farthest_point_sample,
    front_constraint,
    nearest,
    project,
)

FSCORE_DISTANCE = 0.01
"""Threshold of the F-score in world units: 1 % of an object's size."""
_EMD_TOLERANCE = 0.02


class CloudErrors(NamedTuple):
    """Errors of predictions against ground truth, one value per cloud; distances x100.

    Attributes:
        gt_to_pred: (*B) mean distance from a true point to the prediction.
        pred_to_gt: (*B) mean distance from a predicted point to the target.
        fscore: (*B) harmonic mean of precision and recall in [0, 1]: the shares of predicted and of true points within
            `FSCORE_DISTANCE` of the other cloud. Two samplings of one surface reach 1 only if both are dense enough.
    """

    gt_to_pred: Tensor
    pred_to_gt: Tensor
    fscore: Tensor

    @property
    def cd(self) -> Tensor:
        """Chamfer distance x100: the sum of both directions."""
        return self.gt_to_pred + self.pred_to_gt


def cloud_errors(predicted: Tensor, target: Tensor) -> CloudErrors:
    """Compares clouds (*B, N, 3) with clouds (*B, M, 3)."""
    to_target = nearest(predicted, target).squared_distance.sqrt()
    to_prediction = nearest(target, predicted).squared_distance.sqrt()
    precision, recall = ((d <= FSCORE_DISTANCE).to(d.dtype).mean(-1) for d in (to_target, to_prediction))
    return CloudErrors(
        gt_to_pred=100 * to_prediction.mean(-1),
        pred_to_gt=100 * to_target.mean(-1),
        fscore=2 * precision * recall / (precision + recall).clamp(min=1e-12),
    )


def transport_error(predicted: Tensor, target: Tensor, *, points: int) -> Tensor:
    """(*B) mean earth mover's distance x100 between both clouds thinned to equal size, at most 2 % above the optimum.

    Args:
        predicted: (*B, N, 3).
        target: (*B, M, 3).
        points: number of points, at most, to which both clouds are thinned by farthest point sampling.
    """
    points = min(points, predicted.shape[-2], target.shape[-2])
    pair = thin_out(predicted, points), thin_out(target, points)
    return 100 * earth_mover_distance(*pair, tolerance=_EMD_TOLERANCE).cost


def thin_out(clouds: Tensor, count: int) -> Tensor:
    """(*B, N, 3) -> (*B, count, 3) by farthest point sampling, for comparisons at an equal number of points."""
    if clouds.shape[-2] <= count:
        return clouds
    index = farthest_point_sample(clouds, count)
    return torch.take_along_dim(clouds, index[..., None], dim=-2)


def visible_error(points: Tensor, camera: PinholeCamera, depth: Tensor) -> Tensor:
    """(B, V) chamfer distance x100 between the points visible in each view and its depth map: the front constraint.

    Where no point is visible in a view, the whole cloud is compared.

    Args:
        points: (B, N, 3) in the world.
        camera: (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="front_constraint: in ", category=RuntimeWarning)
        return 100 * front_constraint(points, camera, depth, reduction="none")


def in_silhouette(points: Tensor, camera: PinholeCamera, depth: Tensor, *, margin: int = 0) -> Tensor:
    """(B, V, N) bool: whether a point projects into the shape's silhouette, dilated by `margin` pixels.

    Args: as `visible_error`.
    """
    silhouette = F.max_pool2d(torch.isfinite(depth).float(), 2 * margin + 1, 1, margin) > 0
    pixels = project(points, camera).pixels
    size = torch.tensor([camera.width, camera.height], device=pixels.device)
    inside = ((pixels >= 0) & (pixels < size)).all(-1)
    u, v = pixels.long().clamp(torch.zeros_like(size), size - 1).unbind(-1)
    return inside & silhouette.flatten(2).gather(2, v * camera.width + u)
