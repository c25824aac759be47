"""What a run keeps: weights, and beside them the state from which training continues to the same bits.

RUN/checkpoints/step-00000500/{weights,autoencoder,critic}.safetensors, state.pt   the newest, for --resume
RUN/checkpoints/best-{autoencoder,stage1,stage2}.safetensors   each phase's, chosen on the validation split
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from train.errors import UserError
from train.evaluation.runs import checkpoints
from train.files import remove, replacing
from train.methods.weights import OtherVersionError, read_weights, save_weights, space_for


def save_checkpoint(
    run: Path, step: int, networks: Mapping[str, nn.Module], state: dict[str, Any], *, keep: int = 2
) -> None:
    """Writes one resumable checkpoint, atomically, then drops all but the newest. It can be read on any device.

    Args:
        run: the run's directory.
        step: steps done, over all phases.
        networks: by the names of their files.
        state: everything else, as tensors, numbers, strings, lists and dicts.
        keep: how many checkpoints to keep.

    Raises:
        UserError: it cannot be written; the checkpoints before it are untouched.
    """
    target = run / "checkpoints" / f"step-{step:08d}"
    remove(target)
    with space_for(target), replacing(target) as directory:
        directory.mkdir()
        for name, network in networks.items():
            save_weights(network, directory / f"{name}.safetensors")
        buffer = io.BytesIO()  # torch's own writer hides the reason when a disk is full
        torch.save(_on_cpu(state), buffer)
        (directory / "state.pt").write_bytes(buffer.getbuffer())
    for old in checkpoints(run)[:-keep]:
        remove(old)


def load_networks(directory: Path, networks: Mapping[str, nn.Module]) -> None:
    """Puts a checkpoint's weights into networks of the same sizes.

    Raises:
        UserError: a part of it is missing or cannot be read.
    """
    for name, network in networks.items():
        with _unreadable(directory, f"{name}.safetensors"):
            network.load_state_dict(
                read_weights(directory / f"{name}.safetensors", type(network)).state_dict()
            )


def load_state(directory: Path) -> dict[str, Any]:
    """A checkpoint's state.

    Raises:
        UserError: it is missing or cannot be read.
    """
    with _unreadable(directory, "state.pt"):
        return torch.load(directory / "state.pt", map_location="cpu", weights_only=True)


def _on_cpu(value: Any) -> Any:
    """The same tensors, numbers, strings, lists and dicts, tensors on the CPU."""
    if isinstance(value, torch.Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {key: _on_cpu(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_on_cpu, value))
    return value


@contextmanager
def _unreadable(directory: Path, name: str) -> Iterator[None]:
    """Says what to do about a damaged part of a checkpoint."""
    try:
        yield
    except OtherVersionError:  # not damaged; the checkpoint before it is no better
        raise
    except Exception as error:  # a damaged pickle fails in every way there is
        reason = str(error) if isinstance(error, UserError) else type(error).__name__
        raise UserError(
            f"{directory / name} cannot be read ({reason}); delete {directory} to resume from the checkpoint "
            "before it"
        ) from None
