"""Pictures of a generator's predictions for validation shapes, drawn during training."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from models import Predictor
from train.data.batches import LoadedSplit
from train.evaluation.inference import predict_images

_SHAPES = 3
_CODES = 3
_PIXELS = 128


@torch.no_grad()
def draw_predictions(model: Predictor, val: LoadedSplit, path: str | Path, *, seed: int) -> None:
    """Writes a PNG of a few shapes: predictions from one image and several codes, all views joined, ground truth.

    Shapes and codes are the same at every call with the same seed.
    """
    from train.show import figures  # matplotlib takes a second to import

    generator = torch.Generator().manual_seed(seed)
    examples = []
    for shape in torch.linspace(0, len(val) - 1, min(_SHAPES, len(val))).long():
        views = torch.arange(val.views)
        batch = val.batch(shape[None], views[None])
        codes = torch.randn(_CODES, val.views, model.code_dim, generator=generator)
        clouds = predict_images(model, batch.images[0], codes).cpu()
        pictures, cameras, target = batch.images[0].cpu(), batch.camera[0].to("cpu"), val.points[shape].cpu()
        images, camera = figures.close_up(_square(pictures), cameras.resize(_PIXELS, _PIXELS), target)
        joined = clouds[0].flatten(0, 1)
        examples.append(figures.Example(images, camera, 0, clouds[:, 0], joined, target))
    figures.save(figures.overview_figure(examples), path)


def _square(images: Tensor) -> Tensor:
    """(V, 3, h, w) network inputs, whose aspect is changed -> (V, 3, _PIXELS, _PIXELS)."""
    return F.interpolate(images, size=(_PIXELS, _PIXELS), mode="bilinear", align_corners=False)
