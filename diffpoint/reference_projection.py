"""Reference implementations of the projection losses and the soft splat in plain torch; see `reference.py`."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from diffpoint.reference import project, splat_depth


def soft_splat(
    points: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    size: tuple[int, int],
    *,
    radius: float,
    softness: float,
    lengths: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Depth and coverage (B, V, H, W); evaluates every point at every pixel."""
    pixels, z = project(points, K, cam_from_world)
    rows = torch.arange(size[0])[:, None] + 0.5
    columns = torch.arange(size[1])[None, :] + 0.5
    counts = z > 0
    if lengths is not None:
        counts = counts & (torch.arange(points.shape[1]) < lengths[:, None])[:, None]
    u, v = torch.where(counts[..., None], pixels, 0.0)[..., None, None, :].unbind(-1)
    fade = 1 - ((columns - u) / radius).square() - ((rows - v) / radius).square()
    rounding = 32 * torch.finfo(points.dtype).eps * (1 + max(size) / radius)  # of the fade
    covers = counts[..., None, None] & (fade > rounding)
    footprint = torch.where(covers, fade, 0.0).square()
    coverage = footprint.sum(2)
    if points.shape[1] == 0:
        return torch.full_like(coverage, torch.inf), coverage
    z = z[..., None, None]
    nearest = torch.where(covers, z, torch.inf).detach().min(2, keepdim=True).values
    order = torch.where(covers, (nearest - z) / softness, -torch.inf).exp()
    weight = footprint * order
    hit = coverage > 0
    depth = (weight * z).sum(2) / torch.where(hit, weight.sum(2), 1.0)
    return torch.where(hit, depth, torch.inf), coverage


def projection_loss(
    points: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    depth: Tensor,
    *,
    logits: Tensor | None = None,
    mask_weight: float = 0.0,
    upsample: int = 1,
) -> Tensor:
    """(B, V), view by view and pixel by pixel."""
    height, width = depth.shape[-2:]
    size = height * upsample, width * upsample
    larger = K * K.new_tensor([upsample, upsample, 1.0])[:, None]
    losses = []
    for b, v in itertools.product(*map(range, depth.shape[:2])):
        own = points.new_ones(points.shape[1]) if logits is None else logits[b]
        errors, wrong = [], points.new_zeros(())
        maps = {}
        for exists in (True, False):
            chosen = ((own > 0) == exists).nonzero()[:, 0]
            z, index, _ = splat_depth(
                points[b : b + 1, chosen],
                larger[b : b + 1, v : v + 1],
                cam_from_world[b : b + 1, v : v + 1],
                *size,
            )
            maps[exists] = z[0, 0], index[0, 0], chosen
        for row, column in itertools.product(range(height), range(width)):
            block = (
                slice(row * upsample, (row + 1) * upsample),
                slice(column * upsample, (column + 1) * upsample),
            )
            logit = points.new_full((), -1.0)
            seen = bool(torch.isfinite(depth[b, v, row, column]))
            for exists in (False, True):
                z, index, chosen = maps[exists]
                here = z[block].flatten()
                if bool(torch.isfinite(here).any()):
                    first = int(here.argmin())
                    logit = own[chosen[index[block].flatten()[first]]]
                    if exists and seen:
                        errors.append((here[first] - depth[b, v, row, column]).abs())
            probability = logit.sigmoid()
            wrong = wrong - (probability if seen else 1 - probability).log()
        loss = torch.stack(errors).mean() if errors else points.new_zeros(())
        losses.append(loss + mask_weight * wrong / (height * width))
    return torch.stack(losses).view(depth.shape[:2])


def soft_projection_loss(
    points: Tensor,
    K: Tensor,
    cam_from_world: Tensor,
    depth: Tensor,
    *,
    radius: float,
    softness: float,
    mask_weight: float,
) -> Tensor:
    """(B, V), on maps with the margin, view by view and background pixel by background pixel."""
    height, width = depth.shape[-2:]
    margin = max(height, width) // 2
    size = height + 2 * margin, width + 2 * margin
    shifted = K.clone()
    shifted[..., :2, 2] += margin
    rendered, coverage = soft_splat(points, shifted, cam_from_world, size, radius=radius, softness=softness)
    coverage = 2 * coverage / (math.pi * radius**2 / 3)
    inner = slice(margin, margin + height), slice(margin, margin + width)
    losses = []
    for b, v in itertools.product(*map(range, depth.shape[:2])):
        target = depth.new_full(size, torch.inf)
        target[inner] = depth[b, v]
        foreground = torch.isfinite(target)
        covered = coverage[b, v]
        both = foreground & torch.isfinite(rendered[b, v])
        error = ((1 - torch.exp(-covered[both])) * (rendered[b, v][both] - target[both]).abs()).sum()
        wrong = -(1 - torch.exp(-covered[foreground] - 0.01)).log().sum()
        silhouette = foreground.nonzero().to(points)
        for row, column in (~foreground).nonzero().tolist():
            at = silhouette.new_tensor([row, column])
            framed = at.clamp(min=margin).minimum(at.new_tensor([margin + height - 1, margin + width - 1]))
            away = (silhouette - framed).norm(dim=1).min() if len(silhouette) else 1.0
            wrong = wrong + covered[row, column] * (away + (at - framed).norm())
        losses.append((error + mask_weight * wrong) / max(int(foreground.sum()), 1))
    return torch.stack(losses).view(depth.shape[:2])
