"""Model selection: the validation split's errors with fixed random codes, without search or descent."""

from __future__ import annotations

import torch

from models import Generator
from train.batches import LoadedSplit
from train.metrics import cloud_errors, thin_out

_SHAPES_AT_ONCE = 8


@torch.no_grad()
def validate(model: Generator, split: LoadedSplit, *, seed: int) -> dict[str, float]:
    """Mean errors x100 over a split: one view (`val_cd_1`), all views joined (`val_cd`), and thinned
    (`val_fps_cd`).

    The codes are the same at every call, so that two checkpoints differ by their weights alone.
    """
    codes = torch.randn(
        1, len(split), split.views, model.code_dim, generator=torch.Generator().manual_seed(seed)
    )
    sums = torch.zeros(3)
    for start in range(0, len(split), _SHAPES_AT_ONCE):
        shapes = torch.arange(start, min(start + _SHAPES_AT_ONCE, len(split)))
        views = torch.arange(split.views).expand(len(shapes), -1)
        images = split.float_images(shapes, views).flatten(0, 1)
        clouds = model(images, codes[:, shapes].flatten(1, 2))[0].unflatten(0, views.shape)
        joined, truth = clouds.flatten(1, 2), split.points[shapes]
        sums += torch.stack(
            [
                cloud_errors(clouds[:, 0].contiguous(), truth).cd.sum(),
                cloud_errors(joined, truth).cd.sum(),
                cloud_errors(thin_out(joined, model.points), truth).cd.sum(),
            ]
        )
    means = (sums / len(split)).tolist()
    return dict(zip(("val_cd_1", "val_cd", "val_fps_cd"), means, strict=True))
