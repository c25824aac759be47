"""What changes while a run goes on: weights, optimiser, random states, and whether the network still
listens."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models import Generator, build_generator
from train.batches import Batch, LoadedSplit, Sampler
from train.checkpoint import best_weights, save_weights
from train.config import FitConfig, StageConfig
from train.errors import UserError
from train.health import sensitivity
from train.validation import validate

_DEAF_CHECKS = 3


class Training:
    """Everything that changes while a run goes on, and can be kept and put back."""

    def __init__(self, config: FitConfig, train: LoadedSplit) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.model = build_generator(config.profile, config.deterministic)
        self.sampler = Sampler(len(train), train.views, seed=config.seed)
        self.total_steps = 0
        self._codes = torch.Generator().manual_seed(config.seed)
        self._fingerprint = train.fingerprint
        self.begin_stage(0, None)

    @property
    def stage(self) -> StageConfig:
        """Settings of the current stage."""
        return self.config.stages[self.stage_index]

    def begin_stage(self, index: int, weights: Generator | None) -> None:
        """A fresh optimiser, from the current weights or from others."""
        if weights is not None:
            self.model.load_state_dict(weights.state_dict())
        self.stage_index, self.step = index, 0
        self.best, self._deaf_checks = math.inf, 0
        rate = self.config.stages[index].learning_rate
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=rate, fused=True)

    def draw_codes(self, batch: Batch) -> Tensor:
        """(R, B*V, code_dim): every image and slot gets its own."""
        images = batch.images.shape[0] * batch.images.shape[1]
        return torch.randn(self.stage.codes, images, self.model.code_dim, generator=self._codes)

    def state(self) -> dict[str, Any]:
        """Everything but the weights that decides how training continues."""
        return {
            "stage_index": self.stage_index,
            "step": self.step,
            "total_steps": self.total_steps,
            "best": self.best,
            "deaf_checks": self._deaf_checks,
            "optimiser": self.optimiser.state_dict(),
            "sampler": self.sampler.state(),
            "codes": self._codes.get_state(),
            "torch": torch.get_rng_state(),
            "fingerprint": self._fingerprint,
        }

    def restore(self, state: dict[str, Any], *, where: Path) -> None:
        """Puts back what `state` returned; `where` it was kept, for the error."""
        if state["fingerprint"] != self._fingerprint:
            raise UserError(
                f"{where} was trained on other data (their shapes or points differ); resume with those"
            )
        self.begin_stage(state["stage_index"], None)
        self.step, self.total_steps = state["step"], state["total_steps"]
        self.best, self._deaf_checks = state["best"], state["deaf_checks"]
        self.optimiser.load_state_dict(state["optimiser"])
        self.sampler.restore(state["sampler"])
        self._codes.set_state(state["codes"])
        torch.set_rng_state(state["torch"])

    def check_health(self, images: Tensor) -> dict[str, float]:
        """Measures what image and code do; ends a run whose image has stopped to matter."""
        found = sensitivity(self.model, images, seed=self.config.seed)
        warm = self.stage_index > 0 or self.step >= self.config.health_patience
        deaf = warm and found.image < self.config.min_image_sensitivity
        self._deaf_checks = self._deaf_checks + 1 if deaf else 0
        if self._deaf_checks >= _DEAF_CHECKS:
            raise UserError(
                f"stopped at step {self.total_steps}: predictions of different images differ by only "
                f"{found.image:.3f} (chamfer x100), so the network no longer looks at its image "
                f"({found.dead_share:.0%} of its trunk is silent); lower the learning rate, lengthen "
                "--stage1.ramp or --stage1.warmup, or try another --seed"
            )
        return {
            "image_sensitivity": found.image,
            "code_sensitivity": found.code,
            "dead_share": found.dead_share,
        }

    def validate_and_keep_best(self, val: LoadedSplit, out: Path) -> dict[str, float]:
        """Validates, and writes the weights if they are the stage's best so far."""
        figures = validate(self.model, val, seed=self.config.seed)
        figure = figures[f"val_{self.stage.select}"]
        if figure < self.best:
            self.best = figure
            save_weights(self.model, best_weights(out, self.stage_index + 1))
        return figures
