"""The collapse check: ends a run whose network ignores its image.

The loss does not show it: a generator whose image encoder has collapsed fits the mean shape of the data, and its loss
still falls.
"""

from __future__ import annotations

import dataclasses

from torch import Tensor

from models import Predictor
from train.config import FitConfig
from train.errors import UserError
from train.evaluation.sensitivity import sensitivity

_FAILED_CHECKS = 3


@dataclasses.dataclass
class CollapseCheck:
    """Measures how predictions change with image and code, and counts failed checks in a row."""

    config: FitConfig
    failed: int = 0
    """Failed checks in a row; a checkpoint keeps it."""

    def __call__(
        self, network: Predictor, images: Tensor, *, may_fail: bool, total_steps: int
    ) -> dict[str, float]:
        """One check.

        Args:
            network: the network in training.
            images: (B, 3, H, W) of different shapes.
            may_fail: False while the network is given time to learn to use the image.
            total_steps: steps of the run so far, for the error.

        Returns:
            Figures for the log.

        Raises:
            UserError: three checks in a row have failed.
        """
        found = sensitivity(network, images, seed=self.config.seed)
        collapsed = may_fail and found.image < self.config.min_image_sensitivity
        self.failed = self.failed + 1 if collapsed else 0
        if self.failed >= _FAILED_CHECKS:
            raise UserError(
                f"stopped at step {total_steps}: predictions of different images differ by only "
                f"{found.image:.3f} (chamfer x100), so the network ignores its image "
                f"({found.dead_share:.0%} of its encoder channels are zero); lower the learning rate, lengthen "
                "--stage1.ramp or --stage1.warmup, or try another --seed"
            )
        return {
            "image_sensitivity": found.image,
            "code_sensitivity": found.code,
            "dead_share": found.dead_share,
        }
