"""Model selection: the validation split's errors with fixed random codes, without search or descent."""

from __future__ import annotations

import torch

from models import Autoencoder, Generator, Predictor
from train.data.batches import LoadedSplit
from train.distributed import SINGLE, World
from train.evaluation.metrics import cloud_errors, in_silhouette, thin_out, visible_error

FIGURES = ("val_cd_1", "val_cd", "val_fps_cd", "val_visible", "val_inside")
_SHAPES_AT_ONCE = 8


@torch.no_grad()
def validate(model: Predictor, split: LoadedSplit, *, seed: int, world: World = SINGLE) -> dict[str, float]:
    """Mean errors x100 over a split: one view (`val_cd_1`), all views joined (`val_cd`), and thinned
    (`val_fps_cd`). Of another method's network all views are scored as it answers: together, or one by one.

    Beside the truth, what a view saw of it: `val_visible`, the error x100 of what it sees of its own prediction, and
    `val_inside`, the share of that prediction in its silhouette.

    The codes are the same at every call, so that two checkpoints differ by their weights alone. A group of processes
    shares the shapes.
    """
    codes = torch.randn(
        1, len(split), split.views, model.code_dim, generator=torch.Generator().manual_seed(seed)
    )
    sums = torch.zeros(len(FIGURES))
    for shapes in torch.arange(world.rank, len(split), world.size).split(_SHAPES_AT_ONCE):
        views = torch.arange(split.views).expand(len(shapes), -1)
        images = split.float_images(shapes, views).flatten(0, 1)
        if isinstance(model, Generator):
            clouds = model(images, codes[:, shapes].flatten(1, 2))[0].unflatten(0, views.shape)
            first, answers = clouds[:, :1].contiguous(), clouds.flatten(1, 2)[:, None]
        else:
            images = images.unflatten(0, views.shape)
            first, answers = model.answers(images[:, :1]), model.answers(images)
        truth = split.points[shapes][:, None]
        seen = split.batch(shapes, views[:, :1])
        each_truth = truth.expand(-1, answers.shape[1], -1, -1)
        sums += torch.stack(
            [
                cloud_errors(first, truth).cd.sum(),
                cloud_errors(answers, each_truth).cd.mean(1).sum(),
                cloud_errors(thin_out(answers, model.points), each_truth).cd.mean(1).sum(),
                visible_error(first[:, 0], seen.camera, seen.depth).sum(),
                in_silhouette(first[:, 0], seen.camera, seen.depth).float().mean(-1).sum(),
            ]
        )
    means = (world.sum(sums) / len(split)).tolist()
    return dict(zip(FIGURES, means, strict=True))


@torch.no_grad()
def validate_autoencoder(model: Autoencoder, split: LoadedSplit, *, seed: int) -> dict[str, float]:
    """Mean chamfer distance x100 between clouds of the split and what the auto-encoder makes of them.

    It reads as many points as it writes, the same at every call, and is measured against all.
    """
    generator = torch.Generator().manual_seed(seed)
    some = torch.randperm(split.points.shape[1], generator=generator)[: model.config.points]
    training = model.training
    model.eval()
    errors = [cloud_errors(model(truth[:, some]), truth).cd for truth in split.points.split(_SHAPES_AT_ONCE)]
    model.train(training)
    return {"val_autoencoder_cd": torch.cat(errors).mean().item()}
