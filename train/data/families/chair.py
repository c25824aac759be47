"""Chairs with a solid back; what is hidden is how far the shell behind the back reaches."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, colours, shadow_body
from train.data.solids import Solid, bar, box, frustum, loft, oval, slab, tube

_CONE = Cone(azimuth_deg=15, elevation_deg=15)
_DEPTHS = (0.0, 0.19, 0.5)
_BACK_Z = 0.06  # of the back's rear face: leaves the deep shell its room within the frame


def _design(visible: np.random.Generator) -> Design:
    seat_colour, frame_colour, shell_colour = colours(visible)
    width, depth = visible.uniform(0.3, 0.5), visible.uniform(0.18, 0.27)
    leg_height, back_height = visible.uniform(0.12, 0.28), visible.uniform(0.3, 0.44)
    thickness = visible.uniform(0.025, 0.09)
    seat_top = visible.uniform(-0.13, -0.06)
    front_z, under_seat = _BACK_Z + depth, seat_top - thickness
    floor = under_seat - leg_height

    roundness = visible.choice([SHARP, 6.0, 3.5])
    outline = _seat_outline(visible, width, depth, roundness)
    parts = [slab(outline, under_seat, seat_top, seat_colour)]
    if visible.random() < 0.4:  # a cushion
        parts.append(slab(outline * (0.9, 1), seat_top, seat_top + 0.025, frame_colour))
    parts += _base(visible, (width, depth), (under_seat + 0.01, floor), frame_colour)
    parts += _arms(visible, width, seat_top, (_BACK_Z, front_z), frame_colour)

    plate_thickness = visible.uniform(0.025, 0.06)
    low, high = seat_top - 0.01, seat_top + back_height
    top_width = width * visible.uniform(0.7, 1.0)
    squareness = visible.choice([SHARP, 8.0, 4.0])
    if squareness == SHARP:
        corners = np.array([(-width, low), (width, low), (top_width, high), (-top_width, high)]) * (0.5, 1)
        rings = [np.column_stack((corners, np.full(4, z))) for z in (_BACK_Z, _BACK_Z + plate_thickness)]
    else:
        centre = (low + high) / 2
        rings = [
            oval(top_width * bulge, high - low, (0, centre, _BACK_Z + z), squareness=squareness, sides=24)
            for z, bulge in ((0, 1), (plate_thickness, 1), (plate_thickness + 0.012, 0.85))
        ]
    parts.append(loft(rings, seat_colour))
    plate = Plate(top_width, low + 0.02, high, _BACK_Z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        return shadow_body(hidden, _DEPTHS[mode], plate, shell_colour, squareness=squareness)

    return Design(parts, back, visible.uniform(0.78, 1.0))


CHAIR = Family(_design, _CONE)


def _seat_outline(visible: np.random.Generator, width: float, depth: float, roundness: float) -> np.ndarray:
    """(n, 2) in x and z: wider in front or behind, with corners more or less round."""
    flare = visible.uniform(-0.12, 0.12)
    ring = oval(width, depth, (0, _BACK_Z + depth / 2, 0), squareness=roundness)[:, :2]
    ring[:, 0] *= 1 + flare * (ring[:, 1] - _BACK_Z - depth / 2) / depth
    return ring


def _base(
    visible: np.random.Generator, seat: tuple[float, float], heights: tuple[float, float], colour: np.ndarray
) -> list[Solid]:
    (width, depth), (top, floor) = seat, heights
    z = _BACK_Z + depth / 2
    radius = visible.uniform(0.01, 0.03)
    splay, slant = visible.uniform(0.0, 0.05, 2)
    x, reach = width / 2 - radius - splay, depth / 2 - radius - slant
    taper = visible.uniform(0.5, 1.0)
    corners = [(i * x, k * reach) for i in (-1, 1) for k in (-1, 1)]
    kind = visible.choice(["legs", "square legs", "sled", "pedestal", "panels", "block", "cantilever"])
    if kind == "legs":
        legs = [
            frustum(
                (a, top, z + b),
                (a + np.sign(a) * splay, floor, z + b + np.sign(b) * slant),
                (radius, radius * taper),
                colour,
            )
            for a, b in corners
        ]
        return legs + _stretchers(visible, (x, reach), (top, floor), z, radius, colour)
    if kind == "square legs":
        size = (2 * radius, top - floor, 2 * radius)
        legs = [box(size, (a, (top + floor) / 2, z + b), colour) for a, b in corners]
        return legs + _stretchers(visible, (x, reach), (top, floor), z, radius, colour)
    if kind == "sled":
        posts = [bar((a, top, z + b), (a, floor, z + b), radius, colour) for a, b in corners]
        runners = [
            bar((i * x, floor, z - reach - radius), (i * x, floor, z + reach + radius), radius, colour)
            for i in (-1, 1)
        ]
        return posts + runners
    if kind == "cantilever":
        path = [(x, top, z - reach), (x, top, z + reach * 0.7), (x, top - 0.02, z + reach)]
        path += [(x, floor + 0.02, z + reach), (x, floor, z + reach * 0.7), (x, floor, z - reach)]
        loop = tube(path, [radius] * len(path), colour)
        return [loop, loop.mirrored(), bar((-x, floor, z - reach), (x, floor, z - reach), radius, colour)]
    if kind == "pedestal":
        arm = min(width, depth) * visible.uniform(0.4, 0.55)
        column = bar((0, top, z), (0, floor, z), max(radius, 0.02), colour)
        if visible.random() < 0.4:
            return [column, frustum((0, floor, z), (0, floor + 0.03, z), (arm, arm * 0.5), colour)]
        toes = visible.integers(3, 6)
        return [column] + [
            bar((0, floor + 0.03, z), (arm * np.sin(t), floor, z + arm * np.cos(t)), 0.016, colour)
            for t in np.arange(toes) * 2 * np.pi / toes
        ]
    if kind == "panels":
        size = (visible.uniform(0.02, 0.05), top - floor, depth * visible.uniform(0.7, 1.0))
        return [box(size, (i * (width - size[0]) / 2, (top + floor) / 2, z), colour) for i in (-1, 1)]
    size = (width * visible.uniform(0.6, 0.98), top - floor, depth * visible.uniform(0.6, 0.98))
    return [box(size, (0, (top + floor) / 2, z), colour)]


def _stretchers(
    visible: np.random.Generator,
    reach: tuple[float, float],
    heights: tuple[float, float],
    z: float,
    radius: float,
    colour: np.ndarray,
) -> list[Solid]:
    """Rails between the legs, or none."""
    (x, depth), (top, floor) = reach, heights
    y = floor + visible.uniform(0.25, 0.6) * (top - floor)
    if visible.random() < 0.6:
        return []
    sides = [bar((i * x, y, z - depth), (i * x, y, z + depth), radius * 0.6, colour) for i in (-1, 1)]
    return [*sides, bar((-x, y, z), (x, y, z), radius * 0.6, colour)]


def _arms(
    visible: np.random.Generator,
    width: float,
    seat_top: float,
    z_range: tuple[float, float],
    colour: np.ndarray,
) -> list[Solid]:
    """No arms, both, or only one: from the far side, one that is there and one that is not look the same."""
    sides = [(), (-1, 1), (-1,), (1,)][visible.choice(4, p=[0.35, 0.35, 0.15, 0.15])]
    height, thickness = visible.uniform(0.1, 0.2), visible.uniform(0.025, 0.06)
    kind = visible.choice(["solid", "rail", "bow"])
    back, front = z_range[0] + 0.01, z_range[1] - visible.uniform(0.0, 0.08)
    parts = []
    for side in sides:
        x = side * (width + thickness) / 2 - side * 0.01
        if kind == "solid":
            size = (thickness, height + 0.04, front - back)
            parts.append(box(size, (x, seat_top + height / 2 - 0.02, (back + front) / 2), colour))
        elif kind == "rail":
            rail = (thickness, 0.025, front - back)
            parts.append(box(rail, (x, seat_top + height, (back + front) / 2), colour))
            parts.append(
                bar((x, seat_top - 0.02, front - 0.03), (x, seat_top + height, front - 0.03), 0.013, colour)
            )
        else:
            low, high = seat_top - 0.02, seat_top + height
            path = [(x, high, back), (x, high, front - 0.04), (x, high - 0.02, front - 0.01)]
            path += [(x, (low + high) / 2, front), (x, low, front - 0.03)]
            parts.append(tube(path, [thickness / 2] * 5, colour))
    return parts
