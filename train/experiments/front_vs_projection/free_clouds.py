"""Free clouds: points without a network, moved by the gradient of a loss on depth maps."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import chamfer_distance, front_constraint, projection_loss, soft_projection_loss
from train.evaluation.metrics import in_silhouette, visible_error
from train.experiments.front_vs_projection.shapes import Scene

MEASURED_EVERY = 10


class Loss(NamedTuple):
    """One way to compare a cloud with depth maps."""

    title: str
    value: Callable[[Tensor, Tensor | None, Scene, float], Tensor]
    """(cloud (1, N, 3), occupancy logits of its points, scene, progress in [0, 1]) -> a scalar."""
    colour: str
    deletes: bool = False
    """Whether it takes occupancy logits: it may remove points."""


class Measures(NamedTuple):
    """Errors of a cloud, the same for every loss."""

    visible_cd: float
    """Chamfer distance x100 between the visible part of the cloud and of the shape, over all views."""
    inside: float
    """Share of the points that project into the silhouette, over all views."""
    pred_to_gt: float
    """Mean distance x100 from the cloud to the whole shape."""
    gt_to_pred: float
    """Mean distance x100 from the whole shape to the cloud."""
    left: float
    """Share of the points that were not removed."""


class Fit(NamedTuple):
    """A fitted cloud and its history."""

    measures: Measures
    sideways: float
    """|gradient in the first camera's x and y| / |gradient|, mean over the iterations."""
    largest_sideways: float
    """The largest |gradient in the first camera's x or y| of any point at any iteration."""
    losses: list[float]
    """The loss at every iteration."""
    visible_cd: list[float]
    """`Measures.visible_cd` every `MEASURED_EVERY` iterations."""
    clouds: dict[int, Tensor]
    """The cloud (N, 3) after some numbers of iterations."""
    ms_per_iteration: float


def _radius(progress: float) -> float:
    """Of soft footprints, in pixels: large ones reach far, small ones are sharp."""
    return 6.0 * (0.75 / 6.0) ** min(1.0, 2 * progress)


LOSSES: dict[str, Loss] = {
    "front": Loss("front constraint", lambda x, _, s, __: front_constraint(x, s.camera, s.depth), "#22577a"),
    "front_emd": Loss(
        "front constraint, EMD",
        lambda x, _, s, __: front_constraint(x, s.camera, s.depth, distance="emd", tolerance=0.05),
        "#57a0c9",
    ),
    "projection": Loss(
        "projection loss, depth alone", lambda x, _, s, __: projection_loss(x, s.camera, s.depth), "#c8553d"
    ),
    "lin": Loss(
        "projection loss of Lin et al.",
        lambda x, e, s, __: projection_loss(x, s.camera, s.depth, logits=e, mask_weight=1.0, upsample=2),
        "#e59866",
        deletes=True,
    ),
    "soft": Loss(
        "soft projection loss",
        lambda x, _, s, t: soft_projection_loss(x, s.camera, s.depth, radius=_radius(t)),
        "#6a994e",
    ),
}


def fit_cloud(scene: Scene, loss: Loss, *, iterations: int, rate: float, kept: Sequence[int] = ()) -> Fit:
    """Minimises one loss by Adam from the start cloud, with a step size that falls from `rate` to 0 along a cosine.

    Args:
        scene: the views of a shape.
        loss: what is minimised.
        iterations: steps.
        rate: first step size, in world units (of logits, in theirs).
        kept: numbers of iterations after which copies of the cloud are kept.

    Example:
        >>> from train.experiments.front_vs_projection.shapes import Cameras, embedded_shape
        >>> scene = embedded_shape("chair").scene(Cameras(1), seed=0, points=64)
        >>> fit_cloud(scene, LOSSES["projection"], iterations=3, rate=0.01).largest_sideways
        0.0
    """
    cloud = scene.start.clone().requires_grad_()
    logits = torch.full(cloud.shape[:2], 0.5).requires_grad_() if loss.deletes else None
    optimiser = torch.optim.Adam([cloud] if logits is None else [cloud, logits], lr=rate)
    clouds: dict[int, Tensor] = {}
    losses: list[float] = []
    sideways: list[float] = []
    visible_cd: list[float] = []
    largest, seconds = 0.0, 0.0
    for iteration in range(iterations):
        existing = _existing(cloud, logits)
        if iteration in kept:
            clouds[iteration] = existing[0]
        if iteration % MEASURED_EVERY == 0:
            visible_cd.append(_visible_cd(scene, existing))
        begun = time.perf_counter()
        for group in optimiser.param_groups:
            group["lr"] = rate * (1 + math.cos(math.pi * iteration / iterations)) / 2
        optimiser.zero_grad()
        value = _quietly(lambda at=iteration: loss.value(cloud, logits, scene, at / iterations))
        value.backward()
        optimiser.step()
        seconds += time.perf_counter() - begun
        losses.append(value.item())
        assert cloud.grad is not None
        whole = cloud.grad.norm()
        sideways.append((cloud.grad[..., :2].norm() / whole).item() if whole > 0 else 0.0)
        largest = max(largest, cloud.grad[..., :2].abs().max().item())
    existing = _existing(cloud, logits)
    if iterations in kept:
        clouds[iterations] = existing[0]
    return Fit(
        measure(scene, existing),
        sum(sideways) / len(sideways),
        largest,
        losses,
        [*visible_cd, _visible_cd(scene, existing)],
        clouds,
        1000 * seconds / iterations,
    )


def _existing(cloud: Tensor, logits: Tensor | None) -> Tensor:
    """(1, M, 3) the points that are not removed; all of them if none is left."""
    cloud = cloud.detach().clone()
    if logits is None or not bool((logits > 0).any()):
        return cloud
    return cloud[:, logits[0] > 0]


def _visible_cd(scene: Scene, cloud: Tensor) -> float:
    return visible_error(cloud, scene.camera, scene.depth).mean().item()


def measure(scene: Scene, cloud: Tensor) -> Measures:
    """All measures of a cloud (1, M, 3)."""
    whole = chamfer_distance(cloud, scene.surface, squared=False)
    return Measures(
        visible_cd=_visible_cd(scene, cloud),
        inside=in_silhouette(cloud, scene.camera, scene.depth).float().mean().item(),
        pred_to_gt=100 * whole.a_to_b.item(),
        gt_to_pred=100 * whole.b_to_a.item(),
        left=cloud.shape[1] / scene.start.shape[1],
    )


def _quietly(value: Callable[[], Tensor]) -> Tensor:
    """Without the front constraint's warning that a view sees no point: here that is a result."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="front_constraint: in ", category=RuntimeWarning)
        return value()
