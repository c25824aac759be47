"""Cabinets: a front of doors and drawers; what is hidden is how deep the body behind it is."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, hsv, metal, shadow_body, wood
from train.data.solids import Solid, bar, box, ellipsoid, frustum, loft, oval

_CONE = Cone(azimuth_deg=12, elevation_deg=12)
_DEPTHS = (0.07, 0.24, 0.5)
_BACK_Z = 0.15
_THICKNESS = 0.03  # of the face frame


def _design(visible: np.random.Generator) -> Design:
    painted = visible.random() < 0.4
    frame_colour = hsv(visible, (0, 1), (0, 0.6), (0.3, 0.95)) if painted else wood(visible)
    door_colour = frame_colour * visible.uniform(0.75, 1.0) if visible.random() < 0.6 else wood(visible)
    body_colour = frame_colour * visible.uniform(0.6, 1.0)
    width, height = visible.uniform(0.26, 0.74), visible.uniform(0.3, 0.74)
    leg = visible.choice([0.0, visible.uniform(0.03, 0.08)])
    low, high = leg / 2 - height / 2, leg / 2 + height / 2
    squareness = visible.choice([SHARP, SHARP, 14.0])
    face_z = _BACK_Z + _THICKNESS
    frame = [oval(width, height, (0, leg / 2, z), squareness=squareness, sides=24) for z in (_BACK_Z, face_z)]
    parts = [loft(frame, frame_colour)]
    parts += _doors(visible, (width, low, high), door_colour)
    parts += _trim(visible, (width, low, high), frame_colour)
    legs = _Legs(visible, width, low, leg, frame_colour)
    parts += legs.pair(width, face_z - 0.015)
    plate = Plate(width, low, high, _BACK_Z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        depth = _DEPTHS[mode]
        sections = (10.0, SHARP, SHARP)
        body = shadow_body(
            hidden, depth, plate, body_colour, squareness=squareness, sections=sections, stands=True
        )
        if mode == 0 or leg == 0:
            return body
        # Hind legs: deep enough for the front's lower edge to hide them from above.
        end_width, _, _ = plate.shadow(depth)
        return body + legs.pair(end_width * 0.8, plate.z - 0.8 * depth, longer=0.02)

    return Design(parts, back, visible.uniform(0.8, 1.0))


CABINET = Family(_design, _CONE)


class _Legs:
    """Pairs of one kind of leg."""

    def __init__(
        self, visible: np.random.Generator, width: float, low: float, length: float, colour: np.ndarray
    ) -> None:
        self.low, self.length = low, length
        self.radius, self.taper = visible.uniform(0.012, 0.03), visible.uniform(0.4, 1.0)
        self.round = visible.random() < 0.5
        self.colour = colour if visible.random() < 0.6 else metal(visible)

    def pair(self, width: float, z: float, *, longer: float = 0.0) -> list[Solid]:
        """Two legs at the ends of a width; they reach `longer` up into what they carry."""
        if self.length == 0:
            return []
        x, floor, top = width / 2 - self.radius - 0.01, self.low - self.length, self.low + 0.01 + longer
        if self.round:
            radii = (self.radius * self.taper, self.radius)
            leg = frustum((x, floor, z), (x, top, z), radii, self.colour)
        else:
            leg = box((2 * self.radius, top - floor, 2 * self.radius), (x, (floor + top) / 2, z), self.colour)
        return [leg, leg.mirrored()]


def _doors(
    visible: np.random.Generator, front: tuple[float, float, float], colour: np.ndarray
) -> list[Solid]:
    """Columns of the front, each a door or a stack of drawers, with a handle on every leaf."""
    width, low, high = front
    handle_colour = metal(visible)
    margin, gap, thickness = (
        visible.uniform(0.012, 0.04),
        visible.uniform(0.006, 0.016),
        visible.uniform(0.01, 0.025),
    )
    columns = int(np.clip(round(width / visible.uniform(0.16, 0.4)), 1, 4))
    shares = visible.uniform(0.8, 1.25, columns) if visible.random() < 0.5 else np.ones(columns)
    edges = (
        -width / 2 + margin + np.concatenate(([0], np.cumsum(shares / shares.sum()))) * (width - 2 * margin)
    )
    handle = visible.choice(["knob", "bar", "cup"])
    panelled = visible.random() < 0.5
    parts = []
    for column in range(columns):
        rows = int(visible.choice([1, 1, 2, 3, 4, 5]))
        heights = visible.uniform(0.8, 1.3, rows)
        levels = (
            low
            + margin
            + np.concatenate(([0], np.cumsum(heights / heights.sum()))) * (high - low - 2 * margin)
        )
        x, size_x = (edges[column] + edges[column + 1]) / 2, edges[column + 1] - edges[column] - gap
        for row in range(rows):
            y, size_y = (levels[row] + levels[row + 1]) / 2, levels[row + 1] - levels[row] - gap
            z = _BACK_Z + _THICKNESS + thickness / 2
            parts.append(box((size_x, size_y, thickness), (x, y, z), colour))
            z += thickness / 2
            if panelled and min(size_x, size_y) > 0.08:
                inner = (size_x - 0.04, size_y - 0.04, 0.008)
                parts.append(box(inner, (x, y, z), colour * 0.88))
                z += 0.004
            tall = size_y > 1.2 * size_x
            inner_side = 1 if column < columns / 2 else -1
            at = np.array((x + inner_side * size_x * 0.4 if tall else x, y, z))
            parts.append(_handle(handle, at, min(size_x, size_y) * 0.4, tall, handle_colour))
    return parts


def _handle(kind: str, at: np.ndarray, length: float, tall: bool, colour: np.ndarray) -> Solid:
    if kind == "knob":
        return ellipsoid((0.011, 0.011, 0.014), at, colour)
    along = np.array((0, 1, 0) if tall else (1, 0, 0)) * length / 2
    if kind == "bar":
        return bar(at - along, at + along, 0.007, colour)
    return ellipsoid(np.abs(along) + 0.009, at, colour)


def _trim(visible: np.random.Generator, front: tuple[float, float, float], colour: np.ndarray) -> list[Solid]:
    """A cornice, a board on top, a splash back, or nothing."""
    width, _, high = front
    kind = visible.choice(["none", "cornice", "gable", "board"])
    z = _BACK_Z + _THICKNESS / 2 + 0.01
    if kind == "cornice":
        tall, out = visible.uniform(0.015, 0.05), visible.uniform(0.01, 0.04)
        low_ring, high_ring = (
            np.array([(-x, -d), (x, -d), (x, d), (-x, d)]) + (0, z)
            for x, d in ((width / 2, 0.025), (width / 2 + out, 0.025 + out / 2))
        )
        rings = [np.insert(low_ring, 1, high - 0.01, axis=1), np.insert(high_ring, 1, high + tall, axis=1)]
        return [loft(rings, colour)]
    if kind == "board":
        size = (width * visible.uniform(1.02, 1.1), 0.02, 0.07)
        return [box(size, (0, high + 0.008, z), colour)]
    if kind == "gable":
        x, tall = width * visible.uniform(0.3, 0.48), visible.uniform(0.03, 0.09)
        outline = np.array(
            [(-x, high - 0.01), (x, high - 0.01), (x * 0.5, high + tall), (-x * 0.5, high + tall)]
        )
        return [loft([np.insert(outline, 2, z + s * 0.012, axis=1) for s in (-1, 1)], colour)]
    return []
