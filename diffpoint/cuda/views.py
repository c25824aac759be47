"""Gathering of visible points on CUDA tensors, and of their gradients."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from diffpoint import _checks
from diffpoint.cuda import errors
from diffpoint.cuda.launch import launch
from diffpoint.cuda.values import count_not_finite

_POINTS = 256  # of a program


@triton.jit
def _gather(points, visible, order, sampled, index, not_finite, views, count, largest, POINTS: tl.constexpr):
    """The visible points among some points of a view go to their places, which `order` (from 1) gives."""
    tiles = tl.cdiv(count, POINTS)
    view = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    seen = tl.load(visible + view * count + i, mask=i < count, other=0) != 0
    target = view * largest + tl.load(order + view * count + i, mask=seen, other=1) - 1
    source = points + view // views * count * 3 + i * 3
    x = tl.load(source, mask=seen, other=0.0)
    y = tl.load(source + 1, mask=seen, other=0.0)
    z = tl.load(source + 2, mask=seen, other=0.0)
    tl.store(sampled + target * 3, x, mask=seen)
    tl.store(sampled + target * 3 + 1, y, mask=seen)
    tl.store(sampled + target * 3 + 2, z, mask=seen)
    tl.store(index + target, i.to(tl.int64), mask=seen)
    count_not_finite(x, y, z, not_finite)


@triton.jit
def _to_points(slot, grad_sampled, grad_points, views, count, largest, POINTS: tl.constexpr):
    """Gradient to some points of a cloud: the sum over the views that see them, of what their slot received."""
    tiles = tl.cdiv(count, POINTS)
    cloud = (tl.program_id(0) // tiles).to(tl.int64)
    i = tl.program_id(0) % tiles * POINTS + tl.arange(0, POINTS)
    gx = tl.zeros((POINTS,), grad_points.dtype.element_ty)
    gy = tl.zeros((POINTS,), grad_points.dtype.element_ty)
    gz = tl.zeros((POINTS,), grad_points.dtype.element_ty)
    for of_cloud in range(views):
        view = cloud * views + of_cloud
        at = tl.load(slot + view * (count + 1) + i, mask=i < count, other=-1)
        seen = at >= 0
        source = grad_sampled + (view * largest + at) * 3
        gx += tl.load(source, mask=seen, other=0.0)
        gy += tl.load(source + 1, mask=seen, other=0.0)
        gz += tl.load(source + 2, mask=seen, other=0.0)
    target = grad_points + (cloud * count + i) * 3
    tl.store(target, gx, mask=i < count)
    tl.store(target + 1, gy, mask=i < count)
    tl.store(target + 2, gz, mask=i < count)


def sample_view(points: Tensor, visible: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As the operator. Waits for the GPU once, for the largest number of visible points."""
    batch, views, count = visible.shape
    order = visible.cumsum(-1)
    lengths = order[..., -1].clone() if count else order.sum(-1)
    largest = int(lengths.max()) if lengths.numel() else 0
    sampled = points.new_zeros((batch, views, largest, 3))
    index = torch.full((batch, views, largest), -1, dtype=torch.int64, device=points.device)
    if sampled.numel():
        not_finite = errors.counter(points, "sample_view", "points", "finite")
        inputs = points, visible.view(torch.uint8), order, sampled, index, not_finite
        programs = batch * views * triton.cdiv(count, _POINTS)
        launch(_gather, programs, *inputs, views, count, largest, _POINTS)

        def name_it() -> None:
            unseen = ~visible.any(1)
            _checks.check_finite("sample_view", "points", points.masked_fill(unseen[..., None], 0))

        errors.settle(points, name_it)
    return sampled, index, lengths


def sample_view_backward(index: Tensor, grad_sampled: Tensor, count: int) -> Tensor:
    """As the operator."""
    batch, views, largest = index.shape
    if not index.numel():
        return grad_sampled.new_zeros((batch, count, 3))
    grad_points = grad_sampled.new_empty((batch, count, 3))
    programs = batch * triton.cdiv(count, _POINTS)
    inputs = inverse(index, count), grad_sampled, grad_points
    launch(_to_points, programs, *inputs, views, count, largest, _POINTS)
    return grad_points


def inverse(index: Tensor, size: int) -> Tensor:
    """(..., size + 1) int64: where in `index` (..., M) each number below `size` stands; -1 where it does not.

    Numbers may stand there once, -1 any number of times; the last place is that of -1.
    """
    places = torch.arange(index.shape[-1], device=index.device).expand_as(index)
    found = index.new_full((*index.shape[:-1], size + 1), -1)
    return found.scatter_(-1, torch.where(index < 0, size, index), places)
