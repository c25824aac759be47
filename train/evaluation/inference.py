"""Several images of one object -> one shape: optimise the codes so that the single-view predictions agree.

Algorithm 1 of the paper. Cameras are not needed: all predictions are in the same world frame.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import chamfer_distance, consistency_loss
from models import Predictor
from train.config import InferenceConfig
from train.device import moved

# Predicted points of the objects that are processed together: 16 objects with 24 views at the cpu profile, 4 at the
# full one. This keeps the memory of a gradient step near a gigabyte.
_POINTS_AT_ONCE = 200_000


class Reconstruction(NamedTuple):
    """The joined prediction of V images for each of B shapes.

    Attributes:
        points: (B, V*N, 3) the concatenated clouds, world frame; (B, N, 3) from a network that reads views together.
        codes: (B, V, code_dim) their codes.
        history: (S + 1, B) consistency loss x100 before the first of S gradient steps and after each; it stays constant
            after a shape's descent has stopped. (0, B) for a single view or a network without codes.
        kept: (B,) int64, the step whose codes are returned: a row of `history`, or 0 where that is empty.
    """

    points: Tensor
    codes: Tensor
    history: Tensor
    kept: Tensor


def reconstruct(
    model: Predictor,
    images: Tensor,
    *,
    groups: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    step_size: float | None = None,
    settings: InferenceConfig | None = None,
) -> Reconstruction:
    """Draws groups of random codes, keeps each object's most consistent group, and minimises the loss over its codes.

    A single image has nothing to be consistent with: the result is the prediction of the first code, or with
    `settings.medoid` that nearest to those of all codes.

    Args:
        model: the network, on any device; its parameters are not changed. One without codes predicts once.
        images: (V, 3, H, W) of one object, or (B, V, 3, H, W) of B objects, in [0, 1] on white. The result is on their
            device; codes are drawn on the CPU, the same for every device.
        groups: number of groups of V random codes per object; by default that of `settings`, or 5.
        steps: gradient steps on the kept codes; by default those of `settings`, or 30.
        seed: of the random codes.
        step_size: factor on the gradient of each object's consistency loss (mean chamfer distance x100 over pairs of
            views); by default that of `settings`, or 0.5.
        settings: all of these and more: early stopping, keeping the best codes, regularisation towards N(0, 1).

    Raises:
        ValueError: images of another shape, or settings out of range.

    Source: CVPR 2019 paper, Algorithm 1.

    Example:
        >>> from models import build_generator
        >>> result = reconstruct(build_generator("smoke"), torch.rand(3, 3, 48, 64), groups=2, steps=1)
        >>> tuple(result.points.shape), tuple(result.history.shape)
        ((1, 384, 3), (2, 1))
    """
    if images.ndim == 4:
        images = images[None]
    if images.ndim != 5 or images.shape[2] != 3 or 0 in images.shape:
        got = tuple(images.shape)
        raise ValueError(f"reconstruct: 'images' must be (V, 3, H, W) or (B, V, 3, H, W); got {got}")
    settings = settings or InferenceConfig()
    given = {"groups": groups, "steps": steps, "step_size": step_size}
    settings = dataclasses.replace(settings, **{k: v for k, v in given.items() if v is not None})
    _check(settings)

    shapes, views = images.shape[:2]
    generator = torch.Generator().manual_seed(seed)
    candidates = torch.randn(settings.groups, shapes, views, model.code_dim, generator=generator)
    home, images, candidates = images.device, moved(images, model.device), moved(candidates, model.device)
    at_once = max(1, _POINTS_AT_ONCE // (views * model.points))
    parts = [
        _reconstruct(model, some_images, some_candidates, settings)
        for some_images, some_candidates in zip(
            images.split(at_once), candidates.split(at_once, dim=1), strict=True
        )
    ]
    points, codes, histories, kept = zip(*parts, strict=True)
    rows = max(len(history) for history in histories)
    history = torch.cat([_extend(history, rows) for history in histories], dim=1)
    return Reconstruction(
        *(of.to(home) for of in (torch.cat(points), torch.cat(codes), history, torch.cat(kept)))
    )


@torch.no_grad()
def predict_images(model: Predictor, images: Tensor, codes: Tensor) -> Tensor:
    """(R, B, N, 3) on the device of images (B, 3, H, W): a network's predictions with codes (R, B, D) on any device."""
    return model(moved(images, model.device), moved(codes, model.device)).to(images.device)


def predict(model: Predictor, image: Tensor, count: int, *, seed: int) -> Tensor:
    """(R, N, 3): a network's predictions for one image (3, H, W) with `count` random codes."""
    codes = torch.randn(count, 1, model.code_dim, generator=torch.Generator().manual_seed(seed))
    return predict_images(model, image[None], codes)[:, 0].contiguous()


def _check(settings: InferenceConfig) -> None:
    if settings.groups < 1 or settings.steps < 0 or settings.patience < 0:
        raise ValueError(
            "reconstruct: needs groups >= 1, steps >= 0 and patience >= 0; "
            f"got {settings.groups}, {settings.steps} and {settings.patience}"
        )


def _extend(history: Tensor, rows: int) -> Tensor:
    """Repeats the last row of a group of objects whose descent stopped before that of others."""
    return torch.cat([history, history[-1:].expand(rows - len(history), -1)]) if len(history) else history


def _reconstruct(
    model: Predictor, images: Tensor, candidates: Tensor, settings: InferenceConfig
) -> Reconstruction:
    """(B, V, 3, H, W) images and (G, B, V, D) candidate codes, all in memory at once."""
    shapes, views = images.shape[:2]
    device = images.device
    numbers = torch.arange(shapes, device=device)
    no_descent = torch.zeros(0, shapes, device=device), torch.zeros(shapes, dtype=torch.int64, device=device)
    chooses = model.takes_codes and (views > 1 or (settings.medoid and settings.groups > 1))
    if not chooses:
        points = model.predict_views(images, candidates[0]).flatten(1, 2)
        return Reconstruction(points, candidates[0], *no_descent)
    with torch.no_grad():
        features = model.encode(images.flatten(0, 1)).unflatten(0, (shapes, views))
        codes = candidates[0]
        if views == 1:
            clouds = torch.cat(
                [_decode(model, features, group) for group in candidates], dim=1
            )  # (B, G, N, 3)
            chosen = _medoid(clouds), numbers
            return Reconstruction(clouds.transpose(0, 1)[chosen], candidates[chosen], *no_descent)
        if settings.groups > 1:
            scores = [
                consistency_loss(_decode(model, features, group), reduction="none") for group in candidates
            ]
            codes = candidates[torch.stack(scores).argmin(0), numbers]
    return _descend(model, features, codes, settings)


def _medoid(clouds: Tensor) -> Tensor:
    """(B, G, N, 3) -> (B,) which of the G clouds of each shape has the least mean chamfer distance to the others."""
    by_number = clouds.transpose(0, 1).contiguous()
    distances = by_number.new_zeros(len(by_number), *by_number.shape[:2])
    for other in range(1, len(by_number)):
        among = by_number[:other]
        pair = chamfer_distance(among, by_number[other].expand_as(among), squared=False)
        distances[:other, other] = distances[other, :other] = pair.total
    return distances.sum(1).argmin(0)


def _decode(model: Predictor, features: Tensor, codes: Tensor) -> Tensor:
    """(B, V, C, h, w) features and (B, V, D) codes -> (B, V, N, 3)."""
    clouds = model.decode(features.flatten(0, 1), codes.flatten(0, 1)[None])[0]
    return clouds.unflatten(0, codes.shape[:2])


def _descend(model: Predictor, features: Tensor, codes: Tensor, settings: InferenceConfig) -> Reconstruction:
    """Gradient descent on (B, V, D) codes; every object has its own loss, so objects do not interact."""
    codes = codes.clone()
    norms = codes.norm(dim=-1, keepdim=True)
    shapes, views = codes.shape[:2]
    found = Reconstruction(
        points=codes.new_zeros(shapes, views, model.points, 3),
        codes=codes.clone(),
        history=codes.new_zeros(settings.steps + 1, shapes),
        kept=torch.zeros(shapes, dtype=torch.int64, device=codes.device),
    )
    lowest = codes.new_full((shapes,), torch.inf)
    waited = torch.zeros_like(found.kept)
    active = torch.arange(shapes, device=codes.device)  # shapes whose descent has not stopped
    for step in range(settings.steps + 1):
        last = step == settings.steps
        moving = codes[active].requires_grad_(not last)
        with torch.set_grad_enabled(not last):
            clouds = _decode(model, features[active], moving)
            loss = 100 * consistency_loss(clouds, reduction="none")
            total = loss.sum()
        loss = loss.detach()
        found.history[step:, active] = loss

        fell = loss < lowest[active] - settings.min_drop
        lowest[active] = torch.where(fell, loss, lowest[active])
        waited[active] = torch.where(fell, 0, waited[active] + 1)
        keep = fell if settings.keep_best else torch.ones_like(fell)
        found.points[active[keep]] = clouds.detach()[keep]
        found.codes[active[keep]] = codes[active[keep]]
        found.kept[active[keep]] = step
        if last:
            break

        (gradient,) = torch.autograd.grad(total, moving)
        moved = moving.detach() - settings.step_size * (gradient + settings.prior * moving.detach())
        if settings.keep_norm:
            moved *= norms[active] / moved.norm(dim=-1, keepdim=True)
        codes[active] = moved
        if settings.patience:
            active = active[waited[active] < settings.patience]
            if len(active) == 0:
                break
    return found._replace(points=found.points.flatten(1, 2), history=found.history[: step + 1])
