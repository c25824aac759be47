"""Several images of one object -> one shape: find the codes on which the single-view predictions agree.

Algorithm 1 of the paper. No camera is needed: every prediction lives in the same world frame.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import consistency_loss
from models import Generator


class Reconstruction(NamedTuple):
    """The joined prediction of V images for each of B shapes.

    Attributes:
        points: (B, V*N, 3) the concatenated clouds, world frame.
        codes: (B, V, code_dim) the codes that made them.
        history: (steps + 1, B) consistency loss x100 before every gradient step and after the last; (0, B) when
            there was nothing to agree on (one view) or nothing to choose (a deterministic network).
    """

    points: Tensor
    codes: Tensor
    history: Tensor


def reconstruct(
    model: Generator,
    images: Tensor,
    *,
    groups: int = 5,
    steps: int = 30,
    seed: int = 0,
    step_size: float = 0.5,
) -> Reconstruction:
    """Searches `groups` random groups of codes, keeps the most consistent, descends on its codes.

    Args:
        model: a generator; its parameters are left alone.
        images: (V, 3, H, W) of one object, or (B, V, 3, H, W) of B objects, in [0, 1] on white.
        groups: groups of V codes tried per object.
        steps: plain gradient steps on the kept codes.
        seed: draws the codes.
        step_size: factor on the gradient of each object's own loss (mean pair chamfer distance x100).

    Example:
        >>> from models import build_generator
        >>> result = reconstruct(build_generator("smoke"), torch.rand(3, 3, 48, 64), groups=2, steps=1)
        >>> tuple(result.points.shape), tuple(result.history.shape)
        ((1, 384, 3), (2, 1))
    """
    if images.ndim == 4:
        images = images[None]
    if images.ndim != 5 or images.shape[2] != 3:
        got = tuple(images.shape)
        raise ValueError(f"reconstruct: 'images' must be (V, 3, H, W) or (B, V, 3, H, W); got {got}")
    if groups < 1 or steps < 0:
        raise ValueError(f"reconstruct: needs groups >= 1 and steps >= 0; got {groups} and {steps}")
    shapes, views = images.shape[:2]
    generator = torch.Generator().manual_seed(seed)
    candidates = torch.randn(groups, shapes, views, model.code_dim, generator=generator)
    with torch.no_grad():
        features = model.encode(images.flatten(0, 1))

    if views == 1 or model.config.deterministic:
        with torch.no_grad():
            clouds = _decode(model, features, candidates[0])
        return Reconstruction(clouds.flatten(1, 2), candidates[0], torch.zeros(0, shapes))

    codes = _most_consistent(model, features, candidates)
    codes, history = _descend(model, features, codes, steps=steps, step_size=step_size)
    with torch.no_grad():
        clouds = _decode(model, features, codes)
        final = consistency_loss(clouds, reduction="none")
    return Reconstruction(clouds.flatten(1, 2), codes, 100 * torch.stack([*history, final]))


def _decode(model: Generator, features: Tensor, codes: Tensor) -> Tensor:
    """(B*V, ...) features and (B, V, D) codes -> (B, V, N, 3)."""
    return model.decode(features, codes.flatten(0, 1)[None])[0].unflatten(0, codes.shape[:2])


@torch.no_grad()
def _most_consistent(model: Generator, features: Tensor, candidates: Tensor) -> Tensor:
    """(G, B, V, D) candidates -> (B, V, D): for each object the group with the lowest consistency loss."""
    scores = torch.stack(
        [consistency_loss(_decode(model, features, codes), reduction="none") for codes in candidates]
    )
    best = scores.argmin(0)
    return candidates[best, torch.arange(candidates.shape[1])]


def _descend(
    model: Generator, features: Tensor, codes: Tensor, *, steps: int, step_size: float
) -> tuple[Tensor, list[Tensor]]:
    """Plain gradient descent on (B, V, D) codes; every object has its own loss, so objects do not interact."""
    history = []
    for _ in range(steps):
        codes = codes.detach().requires_grad_()
        with torch.enable_grad():
            loss = consistency_loss(_decode(model, features, codes), reduction="none")
            (gradient,) = torch.autograd.grad(100 * loss.sum(), codes)
        history.append(loss.detach())
        codes = codes - step_size * gradient
    return codes.detach(), history
