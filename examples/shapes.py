"""Furniture made of boxes, for the examples: random shapes, points on their surface, exact depth maps.

A shape is a tensor (K, 6) of axis-aligned boxes (x0, y0, z0, x1, y1, z1) that touch but do not overlap. y points up
and the front faces +z; the shape is centred and fits in a sphere of radius 0.5.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffpoint import PinholeCamera

KINDS = ("chair", "table", "sofa", "lamp", "shelf")
SIZE = 56  # pixels of a side of the depth maps
_TOUCHING = 1e-4  # closer than this, two faces touch and hide each other


def furniture(kind: str, random: torch.Generator) -> Tensor:
    """(K, 6) the boxes of a random piece of furniture; `kind` is one of `KINDS`."""

    def draw(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=random).item()

    def block(width: float, y0: float, y1: float, z0: float, z1: float, x: float = 0.0) -> tuple[float, ...]:
        return (x - width / 2, y0, z0, x + width / 2, y1, z1)

    def legs(thick: float, height: float) -> list[tuple[float, ...]]:
        x, z = (width - thick) / 2, (depth - thick) / 2
        corners = [(i * x, k * z) for i in (-1, 1) for k in (-1, 1)]
        return [block(thick, 0, height, at - thick / 2, at + thick / 2, side) for side, at in corners]

    width, depth = draw(0.45, 0.65), draw(0.4, 0.6)
    back, front = -depth / 2, depth / 2
    if kind == "chair":
        seat, thick, top = draw(0.35, 0.5), draw(0.05, 0.1), draw(0.9, 1.2)
        boxes = [
            *legs(draw(0.05, 0.09), seat),
            block(width, seat, seat + thick, back, front),
            block(width, seat + thick, top, back, back + draw(0.05, 0.1)),
        ]
    elif kind == "table":
        width, height = width * draw(1.5, 2.2), draw(0.4, 0.8)
        boxes = [*legs(draw(0.05, 0.12), height), block(width, height, height + draw(0.04, 0.1), back, front)]
    elif kind == "sofa":
        width, arm, seat = width * draw(2.0, 2.6), draw(0.08, 0.16), draw(0.18, 0.26)
        behind = back + draw(0.1, 0.2)
        boxes = [
            block(width - 2 * arm, 0, seat, behind, front),
            block(width - 2 * arm, 0, seat + draw(0.18, 0.3), back, behind),
        ]
        height = seat + draw(0.05, 0.15)
        boxes += [block(arm, 0, height, back, front, i * (width - arm) / 2) for i in (-1, 1)]
    elif kind == "lamp":
        foot, shade, top, pole = draw(0.2, 0.45), draw(0.3, 0.6), draw(0.9, 1.5), draw(0.03, 0.06)
        under = top - draw(0.25, 0.4)
        boxes = [
            block(foot, 0, 0.06, -foot / 2, foot / 2),
            block(pole, 0.06, under, -pole / 2, pole / 2),
            block(shade, under, top, -shade / 2, shade / 2),
        ]
    elif kind == "shelf":
        width, depth, top, thick = width * draw(1.0, 1.6), 0.7 * depth, draw(0.8, 1.4), 0.05
        boards = int(draw(3, 6))
        boxes = [block(thick, 0, top, -depth / 2, depth / 2, i * (width - thick) / 2) for i in (-1, 1)]
        for board in range(boards):
            y = (top - thick) * board / (boards - 1)
            boxes.append(block(width - 2 * thick, y, y + thick, -depth / 2, depth / 2))
    else:
        raise ValueError(f"furniture: 'kind' must be one of {', '.join(KINDS)}; got {kind!r}.")
    corners = torch.tensor(boxes).view(-1, 2, 3)
    corners = corners - (corners.amin((0, 1)) + corners.amax((0, 1))) / 2
    return (corners * 0.5 / corners.norm(dim=-1).max()).view(-1, 6)


def sample_surface(boxes: Tensor, count: int, random: torch.Generator) -> Tensor:
    """(count, 3) points distributed uniformly over the outer surface of boxes (K, 6)."""
    low, high = boxes.view(-1, 2, 3).unbind(1)
    extent = high - low
    areas = extent.prod(-1, keepdim=True) / extent  # of the faces across x, y and z
    face = torch.multinomial(areas.flatten(), 4 * count, replacement=True, generator=random)
    box, axis = face // 3, face % 3
    at = torch.rand(4 * count, 3, generator=random)
    at.scatter_(1, axis[:, None], at.gather(1, axis[:, None]).round())  # onto one of the two faces
    points = low[box] + at * extent[box]
    inside = ((points[:, None] > low - _TOUCHING) & (points[:, None] < high + _TOUCHING)).all(-1)
    hidden = inside.scatter(1, box[:, None], False).any(-1)  # within a box other than its own
    return points[~hidden][:count]


def render_depth(boxes: Tensor, camera: PinholeCamera) -> Tensor:
    """(V, H, W) exact depth of boxes (K, 6) at the pixels' centres, +inf where empty, by ray-box intersection."""
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack((u + 0.5, v + 0.5, torch.ones_like(u)), -1)
    rays = torch.einsum("vij,hwj->vhwi", camera.back_projection[..., :3], pixels)[..., None, :]
    origins = camera.position[:, None, None, None]
    planes = torch.stack(((boxes[:, :3] - origins) / rays, (boxes[:, 3:] - origins) / rays))
    enter, leave = planes.amin(0).amax(-1), planes.amax(0).amin(-1)
    return torch.where(enter <= leave, enter, torch.inf).amin(-1)


def orbit(azimuth_deg: Tensor, elevation_deg: float = 15.0) -> PinholeCamera:
    """(V,) cameras at distance 2 that look at the origin; azimuth 0 looks at the front of the furniture."""
    azimuth, elevation = torch.deg2rad(azimuth_deg), torch.deg2rad(torch.tensor(elevation_deg))
    around = (
        azimuth.sin() * elevation.cos(),
        elevation.sin().expand_as(azimuth),
        azimuth.cos() * elevation.cos(),
    )
    return PinholeCamera.look_at(2 * torch.stack(around, -1), focal_px=105.0, height=SIZE, width=SIZE)
