"""One step of both stages on one global batch, alone or as one of a group; test_training.py starts it."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import torch
from torch import nn

from train.data.batches import load_split
from train.device import World, connect
from train.methods import recipe
from train.training.trainer import Trainer

_Gradients = dict[str, torch.Tensor]


def one_step_each(data: Path, run: Path, world: World) -> dict[str, torch.Tensor]:
    """Losses and gradients of a step of each stage, with every loss, from fresh weights and `run`'s auto-encoder."""
    smoke = recipe("ours", "smoke")
    split = load_split(data, "train", image_size=(48, 64), map_size=16, progress=False)
    found: dict[str, torch.Tensor] = {}
    for name, stage in (("stage1", smoke.stage1), ("stage2", smoke.stage2)):
        stage = dataclasses.replace(
            stage, shapes=4, views=2, codes=2, diversity_images=4, ramp=(0, 1), n_critic=2, real_pool=1
        )
        stage = dataclasses.replace(stage, shape_weight=1.0, shape_relaxation=0.1)
        trainer = Trainer(dataclasses.replace(smoke, stage1=stage, augmentation=1.0), split, world)
        trainer.begin_phase("stage1", run)
        trainer.step = 5
        state, critic_steps = trainer.state, []
        critic, optimiser = state.critic, state.critic_optimiser
        assert critic is not None
        assert optimiser is not None
        optimiser.register_step_post_hook(lambda *_, c=critic, s=critic_steps: s.append(_gradients(c)))
        report = trainer.train_step()
        # Scores themselves float: the biases that move all of them have no gradient but rounding, and Adam makes
        # steps of it. Their difference, which is what counts, is in the critic's loss.
        del report["fake_score"], report["real_score"]
        found |= {f"{name} {key}": world.mean(value) for key, value in report.items()}
        found |= {f"{name} network {key}": value for key, value in _gradients(state.network).items()}
        for number, gradients in enumerate(critic_steps):
            found |= {f"{name} critic {number} {key}": value for key, value in gradients.items()}
    return found


def _gradients(network: nn.Module) -> _Gradients:
    return {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}


if __name__ == "__main__":
    data, run, out = map(Path, sys.argv[1:])
    world = connect()
    assert world.size == 2
    result = one_step_each(data, run, world)
    if world.is_main:
        torch.save(result, out)
