"""One step of both stages on one global batch, alone or as one of a group; test_train_parallel.py starts it."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import nn

from train.config import PROFILES, FitConfig, StageConfig
from train.data.batches import load_split
from train.distributed import World, gather
from train.training.state import Training

_SMOKE = PROFILES["smoke"]
_Gradients = dict[str, torch.Tensor]


def _shared(stage: StageConfig) -> StageConfig:
    return dataclasses.replace(
        stage, shapes=4, views=2, codes=2, diversity_images=4, ramp=(0, 1), n_critic=2, real_pool=1
    )


def one_step_each(data: Path, run: Path, world: World) -> dict[str, torch.Tensor]:
    """Losses and gradients of a step of each stage from fresh weights and `run`'s auto-encoder, by name."""
    config = FitConfig(_shared(_SMOKE.stage1), _shared(_SMOKE.stage2), profile="smoke")
    split = load_split(data, "train", image_size=(48, 64), map_size=16, progress=False)
    found: dict[str, torch.Tensor] = {}
    for name in ("stage1", "stage2"):
        training = Training(config, split, world)
        training.begin_phase("stage1", run)
        training._enter(name)
        training.step = 5
        learner = training.learner
        steps: list[_Gradients] = []
        learner.critic_optimiser.register_step_post_hook(_noting(steps, learner.critic))
        report = training.advance()
        # Scores themselves float: the biases that move all of them have no gradient but rounding, and Adam
        # makes steps of it. What counts, their difference, is in the critic's loss.
        del report["fake_score"], report["real_score"]
        found |= {f"{name} {key}": world.mean(value) for key, value in report.items()}
        found |= {f"{name} generator {key}": value for key, value in _gradients(learner.generator).items()}
        for number, step in enumerate(steps):
            found |= {f"{name} critic {number} {key}": value for key, value in step.items()}
    return found


def _noting(steps: list[_Gradients], network: nn.Module) -> Callable[..., None]:
    """Keeps a network's gradients whenever its optimiser makes a step."""
    return lambda *_: steps.append(_gradients(network))


def _gradients(network: nn.Module) -> _Gradients:
    return {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}


if __name__ == "__main__":
    data, run, out = map(Path, sys.argv[1:])
    world = gather()
    assert world.size == 2
    result = one_step_each(data, run, world)
    if world.writes:
        torch.save(result, out)
