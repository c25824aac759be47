"""Files of weights: a network's parameters, with its configuration in the header. A file can be used on its own."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from models import (
    Autoencoder,
    AutoencoderConfig,
    Critic,
    Generator,
    GeneratorConfig,
    Predictor,
    build_autoencoder,
    build_generator,
)
from models.baselines import (
    LinConfig,
    PTNConfig,
    R2N2Config,
    RecurrentReconstruction,
    SilhouetteReconstruction,
    StructureGenerator,
    build_lin,
    build_ptn,
    build_r2n2,
)
from train.errors import UserError
from train.files import replacing

_Network = TypeVar("_Network", bound=nn.Module)


class OtherVersionError(UserError):
    """Sound weights, of a network that this version of diffpoint builds otherwise."""


# Under which name a file's header keeps a network's configuration, and how the network is made from it.
_KINDS = {
    Generator: ("diffpoint.generator", lambda c: build_generator(config=GeneratorConfig(**c))),
    Autoencoder: ("diffpoint.autoencoder", lambda c: build_autoencoder(config=AutoencoderConfig(**c))),
    Critic: ("diffpoint.critic", lambda c: Critic(**c)),
    StructureGenerator: ("diffpoint.lin", lambda c: build_lin(config=LinConfig(**c))),
    RecurrentReconstruction: ("diffpoint.r2n2", lambda c: build_r2n2(config=R2N2Config(**c))),
    SilhouetteReconstruction: ("diffpoint.ptn", lambda c: build_ptn(config=PTNConfig(**c))),
}
PREDICTORS: tuple[type[Predictor], ...] = (
    Generator,
    StructureGenerator,
    RecurrentReconstruction,
    SilhouetteReconstruction,
)
# Names of a network's settings in the headers of earlier versions.
OLD_NAMES = {"ending": "output_head", "existence": "occupancy_logits"}


def save_weights(model: nn.Module, path: Path) -> None:
    """Writes a network's weights and configuration, atomically."""
    name, _ = _KINDS[type(model)]
    tensors = {name: value.detach().contiguous() for name, value in model.state_dict().items()}
    config = getattr(model, "config", None)
    header = {name: json.dumps(dataclasses.asdict(config) if config else {})}
    with space_for(path), replacing(path) as temporary:
        # Not save_file: it gives the file to its owner alone, and wraps the system's words about a full disk.
        temporary.write_bytes(save(tensors, metadata=header))


def read_weights(path: Path, *kinds: type[_Network]) -> _Network:
    """The network in a file, which is one of these kinds."""
    if not path.exists():
        raise UserError(f"{path} does not exist; name a run that `fit` wrote, or a .safetensors file of one")
    try:
        with safe_open(path, framework="pt") as file:
            headers = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        found = [_KINDS[kind] for kind in kinds if _KINDS[kind][0] in headers]
        if not found:
            raise ValueError(f"it has no {_KINDS[kinds[0]][0]} header")
        name, build = found[0]
        model = build(_settings(json.loads(headers[name])))
        theirs, ours = (
            {key: value.shape for key, value in of.items()} for of in (tensors, model.state_dict())
        )
        if theirs != ours:
            odd = sorted({key for key, _ in theirs.items() ^ ours.items()})
            raise OtherVersionError(
                f"{path} was written by another version of diffpoint: its {type(model).__name__} has other weights "
                f"({len(odd)} of them, {odd[0]} first); train it anew, or read it with that version"
            )
        model.load_state_dict(tensors)
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(f"{path} holds no {kinds[0].__name__.lower()}'s weights ({reason})") from None
    return model


def _settings(header: dict[str, Any]) -> dict[str, Any]:
    """A header's settings under today's names; JSON has lists in place of tuples."""
    return {
        OLD_NAMES.get(name, name): tuple(value) if isinstance(value, list) else value
        for name, value in header.items()
    }


@contextmanager
def space_for(target: Path) -> Iterator[None]:
    """Turns a failed write into words; those inside are left as they are."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{target} cannot be written ({error}); what was saved before is untouched: make room and continue "
            "with --resume"
        ) from error
