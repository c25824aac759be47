"""Per-shape metrics on disk, found by everything that they depend on.

    OUT/metrics/KEY.safetensors    one measurement each: processes that run at the same time never write the same file
    OUT/metrics.safetensors        the same, packed into one file by `experiment page`

KEY is the digest of a measurement's key, a list of plain JSON values. The key itself is stored beside the values, so
that the files say what they hold. Metrics outlive runs: where they are kept, a table is made again without training.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from train.files import replacing

Metrics = dict[str, Tensor]
"""Name of a metric -> one value per shape (M,); or another tensor that an experiment measured."""


class NotMeasured(Exception):
    """Metrics that are not kept, where nothing may be measured; its text is their KEY."""


def digest(value: object) -> str:
    """A short name of a plain JSON value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def kept(out: Path, key: Sequence[object], measure: Callable[[], Metrics] | None) -> Metrics:
    """The metrics under a key (plain JSON values: everything that they depend on), measured now if they are not kept.

    Raises:
        NotMeasured: they are not kept, and `measure` is None: nothing may be measured.
    """
    name = digest(key)
    # In this order: `pack` writes the packed file before it removes the single ones.
    try:
        return load_file(_single(out, name))
    except FileNotFoundError:
        found = _packed(out).get(name)
    if found is None:
        if measure is None:
            raise NotMeasured(name)
        found = measure()
        with replacing(_single(out, name)) as temporary:
            temporary.write_bytes(save(found, metadata={"key": json.dumps(key, sort_keys=True)}))
    return found


def keys(out: Path) -> dict[str, list[Any]]:
    """KEY -> key of everything in the packed file of a directory."""
    path = out / "metrics.safetensors"
    return {name: json.loads(text) for name, text in _metadata(path).items()} if path.exists() else {}


def pack(out: Path) -> None:
    """Moves all single measurements of a directory into its packed file. One process at a time may pack."""
    singles = sorted((out / "metrics").glob("*.safetensors"))
    if not singles:
        return
    target = out / "metrics.safetensors"
    measured, described = dict(_packed(out)), keys(out)
    for path in singles:
        measured[path.stem] = load_file(path)
        described[path.stem] = json.loads(_metadata(path)["key"])
    flat = {f"{name}/{metric}": each for name in sorted(measured) for metric, each in measured[name].items()}
    with replacing(target) as temporary:
        metadata = {name: json.dumps(key, sort_keys=True) for name, key in described.items()}
        temporary.write_bytes(save(flat, metadata=metadata))
    for path in singles:
        path.unlink()


def _single(out: Path, name: str) -> Path:
    return out / "metrics" / f"{name}.safetensors"


def _packed(out: Path) -> dict[str, Metrics]:
    """KEY -> metrics of the packed file; read again when it has changed."""
    path = out / "metrics.safetensors"
    try:
        found = path.stat()
    except FileNotFoundError:
        return {}
    return _read_packed(path, found.st_mtime_ns, found.st_size)


@functools.lru_cache(maxsize=4)
def _read_packed(path: Path, _modified_ns: int, _size: int) -> dict[str, Metrics]:
    found: dict[str, Metrics] = {}
    for name, values in load_file(path).items():
        key, metric = name.split("/", 1)
        found.setdefault(key, {})[metric] = values
    return found


def _metadata(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as opened:
        return opened.metadata()
