"""Desks and counters; hidden behind panel and top: far legs, drawers with a shelf, or a deep lower work surface."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, hsv, metal, wood
from train.data.solids import Solid, bar, box, frustum, loft, oval, slab

_CONE = Cone(azimuth_deg=15, elevation_deg=15)
_SHIFT = 0.14  # of the top towards the front: leaves what is behind its room within the frame
_REACH = ((0.17, 0.22), (0.4, 0.46))  # of the work surface behind the top, medium and deep


def _design(visible: np.random.Generator) -> Design:
    top_colour = wood(visible) if visible.random() < 0.6 else hsv(visible, (0, 1), (0, 0.6), (0.3, 0.95))
    panel_colour = wood(visible) if visible.random() < 0.5 else top_colour * visible.uniform(0.7, 1.0)
    inner_colour, leg_colour = panel_colour * visible.uniform(0.6, 0.95), metal(visible)
    width, depth = visible.uniform(0.44, 0.74), visible.uniform(0.22, 0.36)
    height, thickness = visible.uniform(0.34, 0.5), visible.uniform(0.012, 0.04)
    top = height * visible.uniform(0.35, 0.5)
    under, floor = top - thickness, top - height
    front_z, rear_z = _SHIFT + depth / 2, _SHIFT - depth / 2
    parts = [_top(visible, (width, depth), (under, top), top_colour)]

    inset, panel_thick = visible.uniform(0.02, 0.09), visible.uniform(0.015, 0.035)
    panel_width = width * visible.uniform(0.84, 0.98)
    gap = visible.choice([0.0, visible.uniform(0.02, 0.06)])
    panel_z = front_z - inset - panel_thick
    taper = visible.uniform(0.94, 1.0)
    outline = np.array([(-taper, floor + gap), (taper, floor + gap), (1, under + 0.002), (-1, under + 0.002)])
    outline *= (panel_width / 2, 1)
    parts.append(
        loft(
            [np.column_stack((outline, np.full(4, panel_z + s * panel_thick))) for s in (0, 1)], panel_colour
        )
    )
    parts += _front_relief(
        visible, panel_width * taper, (floor + gap, under), panel_z + panel_thick, panel_colour
    )
    if gap:
        foot = (visible.uniform(0.03, 0.08), gap + 0.01, panel_thick + 0.02)
        at = (panel_width * taper / 2 - foot[0] / 2 - 0.01, floor + foot[1] / 2, panel_z + panel_thick / 2)
        parts.append(box(foot, at, leg_colour))
        parts.append(parts[-1].mirrored())
    if visible.random() < 0.2:  # a shelf or screen on top
        tall, wide = visible.uniform(0.05, 0.12), width * visible.uniform(0.6, 0.95)
        parts.append(box((wide, 0.018, 0.1), (0, top + tall, front_z - 0.09), top_colour))
        for side in (-1, 1):
            parts.append(
                box(
                    (0.02, tall, 0.08),
                    (side * (wide / 2 - 0.02), top + tall / 2, front_z - 0.09),
                    panel_colour,
                )
            )
    plate = Plate(panel_width * taper, floor + gap, under, panel_z, _CONE)
    reach = panel_z - rear_z - visible.uniform(0.015, 0.04)  # from the panel to the last leg
    room = _Room(plate, Plate(width, floor, under, rear_z, _CONE), floor, reach, gap)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        return (_legs, _drawers, _workplace)[mode](hidden, room, (leg_colour, inner_colour))

    return Design(parts, back, visible.uniform(0.85, 1.05))


TABLE = Family(_design, _CONE)


class _Room:
    """The space behind the panel: under the top, and lower down behind it.

    Args:
        panel, top: what hides it.
        floor: height of the ground.
        reach: how far behind the panel things may stand under the top.
        gap: between the ground and the panel's lower edge.
    """

    def __init__(self, panel: Plate, top: Plate, floor: float, reach: float, gap: float) -> None:
        self.panel, self.top, self.floor, self.reach = panel, top, floor, reach
        self.under = top.high
        # The sight line under the panel's edge has met the ground here.
        eye_y, eye_z = 2 * np.sin(np.radians(_CONE.elevation_deg)), _CONE.eye[2]
        self.first = -0.002 if gap == 0 else gap * (eye_z - panel.z) / (eye_y - panel.low) * 1.15 + 0.01

    def width(self, behind: float) -> float:
        """What the panel hides at a distance behind it."""
        return self.panel.shadow(behind)[0]

    def block(
        self,
        x: tuple[float, float],
        behind: tuple[float, float],
        heights: tuple[float, float],
        colour: np.ndarray,
    ) -> Solid:
        """A block between two distances behind the panel; `x` are shares of the half width there."""
        rings = []
        for distance in behind:
            left, right = (share * self.width(distance) / 2 for share in x)
            corners = [(left, heights[0]), (right, heights[0]), (right, heights[1]), (left, heights[1])]
            rings.append(np.column_stack((corners, np.full(4, self.panel.z - distance))))
        return loft(rings, colour)

    def work_height(self, beyond: float, share: float) -> float:
        """A height for what reaches `beyond` the top's rear edge; 1 is as high as the top hides."""
        return self.floor + share * (self.top.shadow(beyond)[2] - self.floor)


def _legs(hidden: np.random.Generator, room: _Room, paint: tuple[np.ndarray, np.ndarray]) -> list[Solid]:
    """Two far legs, and perhaps a rail between them."""
    radius, taper = hidden.uniform(0.01, 0.024), hidden.uniform(0.5, 1.0)
    depth = room.reach - radius
    x, z = room.width(room.reach) / 2 - radius, room.panel.z - depth
    leg = frustum((x, room.floor, z), (x, room.under + 0.002, z), (radius * taper, radius), paint[0])
    parts = [leg, leg.mirrored()]
    if hidden.random() < 0.5 and depth > room.first:
        y = room.floor + hidden.uniform(0.1, 0.8) * (room.under - room.floor)
        parts.append(bar((-x, y, z), (x, y, z), radius * 0.6, paint[0]))
    return parts


def _drawers(hidden: np.random.Generator, room: _Room, paint: tuple[np.ndarray, np.ndarray]) -> list[Solid]:
    """Drawers under the top, on both sides or on one, and a low cupboard behind them."""
    low, inner = room.floor + hidden.uniform(0.0, 0.03), hidden.uniform(0.15, 0.45)
    behind, heights = (room.first, room.reach), (low, room.under + 0.002)
    left = room.block((-1, -inner), behind, heights, paint[1])
    right = room.block((inner, 1), behind, heights, paint[1])
    beyond = hidden.uniform(*_REACH[0])
    height = room.work_height(beyond, hidden.uniform(0.75, 0.95))
    cupboard = room.block((-1, 1), (room.reach - 0.01, room.reach + beyond), (low, height), paint[1])
    return [cupboard, *((left, right), (left,), (right,))[hidden.choice(3, p=[0.5, 0.25, 0.25])]]


def _workplace(hidden: np.random.Generator, room: _Room, paint: tuple[np.ndarray, np.ndarray]) -> list[Solid]:
    """A counter's lower work surface, far out behind; it stands on a body, or on panels at its sides."""
    low, beyond = room.floor + hidden.uniform(0.0, 0.03), hidden.uniform(*_REACH[1])
    height = room.work_height(beyond, hidden.uniform(0.8, 0.98))
    closed = room.block((-1, 1), (room.first, room.reach), (low, room.under + 0.002), paint[1])
    behind = (room.reach - 0.01, room.reach + beyond)
    if hidden.random() < 0.6:
        return [closed, room.block((-1, 1), behind, (low, height), paint[1])]
    sides = room.block((0.82, 1), behind, (room.floor, height - 0.02), paint[1])
    return [closed, room.block((-1, 1), behind, (height - 0.03, height), paint[1]), sides, sides.mirrored()]


def _top(
    visible: np.random.Generator, size: tuple[float, float], heights: tuple[float, float], colour: np.ndarray
) -> Solid:
    """Rectangular, rounded, or narrower in front; never narrower than what it hides."""
    ring = oval(*size, (0, 0, 0), squareness=visible.choice([SHARP, 14.0, 7.0]), sides=24)[:, :2]
    bow = visible.uniform(0.0, 0.12)  # the front edge curves out
    ring[:, 1] += np.where(ring[:, 1] > 0, bow * size[1] * np.cos(np.pi * ring[:, 0] / size[0]), 0)
    return slab(ring + (0, _SHIFT), *heights, colour)


def _front_relief(
    visible: np.random.Generator,
    width: float,
    heights: tuple[float, float],
    z: float,
    colour: np.ndarray,
) -> list[Solid]:
    """What is applied to the panel: boards, a plinth, posts at its ends, or nothing."""
    (low, high), kind = heights, visible.choice(["none", "boards", "plinth", "posts", "fields"])
    if kind == "boards":
        count = int(visible.integers(2, 6))
        step = (high - low) / count
        return [
            box((width * 0.97, step * 0.8, 0.014), (0, low + (k + 0.5) * step, z), colour * 0.85)
            for k in range(count)
        ]
    if kind == "plinth":
        tall = visible.uniform(0.03, 0.08)
        return [box((width, tall, 0.03), (0, low + tall / 2, z), colour * 0.7)]
    if kind == "posts":
        radius = visible.uniform(0.012, 0.03)
        post = bar((width / 2 - radius, low, z), (width / 2 - radius, high, z), radius, colour * 0.8)
        return [post, post.mirrored()]
    if kind == "fields":
        count = int(visible.integers(1, 5))
        step = width / count
        size = (step * 0.8, (high - low) * 0.75, 0.016)
        return [
            box(size, (-width / 2 + (k + 0.5) * step, (low + high) / 2, z), colour * 0.85)
            for k in range(count)
        ]
    return []
