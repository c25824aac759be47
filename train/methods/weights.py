"""Files of weights: a network's parameters, with its configuration in the header. A file can be used on its own."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from models import Autoencoder, AutoencoderConfig, Critic, Predictor
from train.errors import UserError
from train.files import replacing
from train.methods import METHODS, get_method
from train.methods.base import Method

_Network = TypeVar("_Network", bound=nn.Module)

# Names of a network's settings in the headers of earlier versions.
OLD_NAMES = {"ending": "output_head", "existence": "occupancy_logits"}


class OtherVersionError(UserError):
    """The file is intact, but this version of diffpoint builds its network differently."""


class _Kind(NamedTuple):
    """A class of networks in files."""

    header: str
    """Name under which a file keeps the network's configuration, as JSON."""
    build: Callable[[dict[str, Any]], nn.Module]


def _kinds() -> dict[type[nn.Module], _Kind]:
    """The networks of all methods, and the two that train beside them."""
    kinds: dict[type[nn.Module], _Kind] = {
        Autoencoder: _Kind("diffpoint.autoencoder", lambda c: Autoencoder(AutoencoderConfig(**c))),
        Critic: _Kind("diffpoint.critic", lambda c: Critic(**c)),
    }
    for method in map(get_method, METHODS):
        network, size = method.network_class, type(method.sizes["cpu"])
        build = lambda c, network=network, size=size: network(size(**c))  # noqa: E731
        kinds.setdefault(network, _Kind(f"diffpoint.{method.weights_key}", build))
    return kinds


def predictor_classes() -> tuple[type[Predictor], ...]:
    """The classes of networks that predict shapes, those of all methods."""
    return tuple(dict.fromkeys(get_method(name).network_class for name in METHODS))


def method_of(network: Predictor) -> Method:
    """The method of a network without a configuration: the first one in `METHODS` with networks of this class."""
    return next(method for method in map(get_method, METHODS) if type(network) is method.network_class)


def save_weights(model: nn.Module, path: Path, *, half: bool = False) -> None:
    """Writes a network's weights and configuration, atomically; with `half` in float16, read back as float32."""
    name = _kinds()[type(model)].header
    tensors = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    if half:
        tensors = {name: v.half() if v.is_floating_point() else v for name, v in tensors.items()}
    config = getattr(model, "config", None)
    header = {name: json.dumps(dataclasses.asdict(config) if config else {})}
    with space_for(path), replacing(path) as temporary:
        # Not save_file: it makes the file readable by its owner alone, and hides the message about a full disk.
        temporary.write_bytes(save(tensors, metadata=header))


def read_weights(path: Path, *kinds: type[_Network]) -> _Network:
    """The network in a file, whose class must be one of `kinds`."""
    if not path.exists():
        raise UserError(f"{path} does not exist; name a run that `fit` wrote, or a .safetensors file of one")
    try:
        with safe_open(path, framework="pt") as file:
            headers = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        known = _kinds()
        found = [known[kind] for kind in kinds if known[kind].header in headers]
        if not found:
            raise ValueError(f"it has no {known[kinds[0]].header} header")
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
    return cast(_Network, model)


def _settings(header: dict[str, Any]) -> dict[str, Any]:
    """A header's settings under today's names; JSON has lists in place of tuples."""
    return {
        OLD_NAMES.get(name, name): tuple(value) if isinstance(value, list) else value
        for name, value in header.items()
    }


@contextmanager
def space_for(target: Path) -> Iterator[None]:
    """Turns a failed write into an error that says what to do."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{target} cannot be written ({error}); what was saved before is untouched: make room and continue "
            "with --resume"
        ) from error


def weights_digest(network: nn.Module) -> str:
    """Changes when the weights of a network change; the name of a run is the same when it trains on."""
    digest = hashlib.sha256()
    for name, values in network.state_dict().items():
        digest.update(name.encode() + values.cpu().numpy().tobytes())
    return digest.hexdigest()
