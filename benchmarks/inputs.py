"""Inputs of the benchmarks: clouds on surfaces, pairs as in the middle of a training, cameras on a circle."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import diffpoint as dp


def surfaces(count: int, points: int, *, seed: int = 0) -> Tensor:
    """Clouds (count, points, 3) on the surfaces of four random boxes each, with a little noise."""
    generator = torch.Generator().manual_seed(seed)
    centre = (torch.rand(count, 4, 3, generator=generator) - 0.5) * 0.5
    half = torch.rand(count, 4, 3, generator=generator) * 0.25 + 0.03
    box = torch.randint(0, 4, (count, points, 1), generator=generator).expand(-1, -1, 3)
    inside = torch.rand(count, points, 3, generator=generator) * 2 - 1
    axis = torch.randint(0, 3, (count, points, 1), generator=generator)
    on_face = inside.scatter(2, axis, inside.gather(2, axis).sign())
    noise = 0.005 * torch.randn(count, points, 3, generator=generator)
    return centre.gather(1, box) + on_face * half.gather(1, box) + noise


def pairs(count: int, n: int, m: int) -> tuple[Tensor, Tensor]:
    """Noisy predictions (count, n, 3) and their targets (count, m, 3), as in the middle of a training."""
    both = surfaces(count, n + m)
    noise = 0.03 * torch.randn(count, n, 3, generator=torch.Generator().manual_seed(1))
    return (both[:, :n] + noise).contiguous(), both[:, n:].contiguous()


def circle_of_cameras(count: int, size: int) -> dp.PinholeCamera:
    """(count, 1) cameras around the y axis, one for each cloud, maps of size x size."""
    azimuth = torch.linspace(0, 2 * math.pi, count + 1)[:-1]
    eyes = 2 * torch.stack((azimuth.cos() * 0.95, torch.full_like(azimuth, 0.3), azimuth.sin() * 0.95), -1)
    return dp.PinholeCamera.look_at(eyes, focal_px=420 * size / 224, height=size, width=size)[:, None]


def depth_maps(count: int, size: int) -> tuple[Tensor, dp.PinholeCamera]:
    """Maps (count, 1, size, size) of dense clouds, and their cameras."""
    camera = circle_of_cameras(count, size)
    return dp.splat_depth(surfaces(count, 4096, seed=2), camera, radius=1.0).depth, camera


def leaf(tensor: Tensor) -> Tensor:
    """A copy that gets a gradient."""
    return tensor.detach().clone().requires_grad_()


def leaf_camera(camera: dp.PinholeCamera) -> dp.PinholeCamera:
    """A copy whose matrices get gradients."""
    return dp.PinholeCamera(leaf(camera.K), leaf(camera.cam_from_world), camera.height, camera.width)
