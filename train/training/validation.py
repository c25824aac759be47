"""Model selection: errors on the validation split with fixed random codes, without search or descent."""

from __future__ import annotations

import torch

from models import Autoencoder, Predictor
from train.data.batches import LoadedSplit
from train.device import SINGLE, World
from train.evaluation.metrics import cloud_errors, in_silhouette, thin_out, visible_error

METRICS = ("val_cd_1", "val_cd", "val_fps_cd", "val_visible", "val_inside")
_SHAPES_AT_ONCE = 8


@torch.no_grad()
def validate(model: Predictor, split: LoadedSplit, *, seed: int, world: World = SINGLE) -> dict[str, float]:
    """Mean errors x100 over a split, with the same codes at every call, so that checkpoints differ by weights alone.

    Against the whole shape: `val_cd_1`, the prediction from one view; `val_cd`, that from all views (joined, read
    together, or the mean over single views, see `Predictor`); `val_fps_cd`, the latter thinned to one prediction's
    size. Against the depth map of the one view: `val_visible`, the error x100 of the points that it sees, and
    `val_inside`, the share of all points inside its silhouette.

    Each process of a group measures its part of the shapes.
    """
    generator = torch.Generator().manual_seed(seed)
    codes = torch.randn(len(split), split.views, model.code_dim, generator=generator).to(model.device)
    split = split.to(model.device)
    sums = torch.zeros(len(METRICS), device=model.device)
    for shapes in torch.arange(world.rank, len(split), world.size).split(_SHAPES_AT_ONCE):
        views = torch.arange(split.views).expand(len(shapes), -1)
        images = split.float_images(shapes, views)
        clouds = model.predict_views(images, codes[shapes])
        first = clouds[:, :1].contiguous()
        if model.reads_views_together:
            first = model.predict_views(images[:, :1], codes[shapes, :1])
        if model.joins_views:
            clouds = clouds.flatten(1, 2)[:, None]
        target = split.points[shapes][:, None]
        seen = split.batch(shapes, views[:, :1])
        each_target = target.expand(-1, clouds.shape[1], -1, -1)
        sums += torch.stack(
            [
                cloud_errors(first, target).cd.sum(),
                cloud_errors(clouds, each_target).cd.mean(1).sum(),
                cloud_errors(thin_out(clouds, model.points), each_target).cd.mean(1).sum(),
                visible_error(first[:, 0], seen.camera, seen.depth).sum(),
                in_silhouette(first[:, 0], seen.camera, seen.depth).float().mean(-1).sum(),
            ]
        )
    means = (world.sum(sums) / len(split)).cpu().tolist()
    return dict(zip(METRICS, means, strict=True))


@torch.no_grad()
def validate_autoencoder(model: Autoencoder, split: LoadedSplit, *, seed: int) -> dict[str, float]:
    """Mean chamfer distance x100 between the split's clouds and their reconstructions by the auto-encoder.

    Its input is a random subset of the points, the same at every call and as large as its output; the reconstruction
    is compared with all points.
    """
    generator = torch.Generator().manual_seed(seed)
    some = torch.randperm(split.points.shape[1], generator=generator)[: model.config.points]
    clouds = split.points.to(next(model.parameters()).device)
    training = model.training
    model.eval()
    errors = [cloud_errors(model(target[:, some]), target).cd for target in clouds.split(_SHAPES_AT_ONCE)]
    model.train(training)
    return {"val_autoencoder_cd": torch.cat(errors).mean().item()}
