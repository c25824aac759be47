"""The paper's figures under names: un-squared distances, x100, each direction a mean over its own set."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import chamfer_distance, farthest_point_sample


class CloudErrors(NamedTuple):
    """Distances x100 between predictions and ground truth, one value per cloud."""

    gt_to_pred: Tensor
    pred_to_gt: Tensor

    @property
    def cd(self) -> Tensor:
        """Chamfer distance x100: the sum of both directions."""
        return self.gt_to_pred + self.pred_to_gt


def cloud_errors(predicted: Tensor, truth: Tensor) -> CloudErrors:
    """Compares clouds (*B, N, 3) with clouds (*B, M, 3)."""
    distance = chamfer_distance(predicted, truth, squared=False)
    return CloudErrors(gt_to_pred=100 * distance.b_to_a, pred_to_gt=100 * distance.a_to_b)


def thin_out(clouds: Tensor, count: int) -> Tensor:
    """(*B, N, 3) -> (*B, count, 3) by farthest point sampling, so that more views do not mean more points."""
    if clouds.shape[-2] <= count:
        return clouds
    index = farthest_point_sample(clouds, count)
    return torch.take_along_dim(clouds, index[..., None], dim=-2)
