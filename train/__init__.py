"""The learning system: data, training, evaluation and inference; `python -m train` is its command line.

From Python:

    import train

    model = train.load_generator("pretrained")  # or a run's directory, or a .safetensors file
    found = train.reconstruct(model, images)  # (V, 3, H, W) in [0, 1] on white -> found.points (1, V*N, 3)
    shape = train.data.ShapeTree("data", "test")[0]
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from train import data
    from train.evaluation.inference import Reconstruction, reconstruct
    from train.evaluation.runs import load_generator

__all__ = ["Reconstruction", "data", "load_generator", "reconstruct"]

# Imported on first use: torch takes seconds to import, and `python -m train --help` does not need it.
_HOME = {
    "Reconstruction": "train.evaluation.inference",
    "reconstruct": "train.evaluation.inference",
    "load_generator": "train.evaluation.runs",
}


def __getattr__(name: str) -> Any:
    if name == "data":
        return importlib.import_module("train.data")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'train' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
