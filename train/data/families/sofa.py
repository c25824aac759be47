"""Sofas: what is hidden is what stands behind the back rest, from nothing to a deep bed box or console."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, hsv, metal, shadow_body, wood
from train.data.solids import Solid, bar, box, frustum, loft, oval

_CONE = Cone(azimuth_deg=15, elevation_deg=15)
_DEPTHS = (0.0, 0.2, 0.5)
_BACK_Z = 0.03  # of the back rest's rear face


def _design(visible: np.random.Generator) -> Design:
    fabric = hsv(visible, (0, 1), (0.05, 0.75), (0.25, 0.95))
    cushion = fabric * visible.uniform(0.8, 1.0) if visible.random() < 0.7 else hsv(visible)
    body_colour = fabric * visible.uniform(0.55, 0.95)
    width = visible.uniform(0.42, 0.78)
    depth = visible.uniform(0.24, 0.36)
    leg, base_height = visible.uniform(0.0, 0.08), visible.uniform(0.07, 0.16)
    floor = visible.uniform(-0.26, -0.2)
    base_low, seat_top = floor + leg, floor + leg + base_height
    front_z = _BACK_Z + depth
    nose = visible.uniform(0.005, 0.4) * base_height
    seat = _soft((width, base_height, depth), (0, (base_low + seat_top) / 2, _BACK_Z + depth / 2), nose)
    parts = [loft(seat, fabric)]
    back_height, back_thick = visible.uniform(0.14, 0.3), visible.uniform(0.05, 0.1)
    high = seat_top + back_height
    squareness = visible.choice([SHARP, 8.0, 5.0])
    camel = visible.uniform(0.0, 0.25)  # the back's middle is higher by this share
    rest = [
        _arched(
            oval(width, high - base_low, (0, (base_low + high) / 2, z), squareness=squareness, sides=24),
            seat_top,
            camel,
            width,
        )
        for z in (_BACK_Z, _BACK_Z + back_thick)
    ]
    parts.append(loft(rest, fabric))
    parts += _cushions(visible, (width, depth), (seat_top, high), back_thick, cushion)
    parts += _arms(visible, (width, depth), (base_low, seat_top), back_height, fabric)
    feet = metal(visible) if visible.random() < 0.5 else wood(visible)
    if leg > 0.015:
        radius = visible.uniform(0.01, 0.024)
        for x in (-1, 1):
            for z in (front_z - 0.03, _BACK_Z + 0.05):
                foot = np.array((x * (width / 2 - 0.03), floor, z))
                parts.append(frustum(foot, foot + (0, leg + 0.01, 0), (radius * 0.7, radius), feet))
    plate = Plate(width, base_low, high, _BACK_Z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        sections, depth = (5.0, 10.0, SHARP), _DEPTHS[mode]
        tall = hidden.choice([1.0, hidden.uniform(0.45, 0.7)])  # low ones are a second seat, back to back
        return shadow_body(
            hidden,
            depth,
            plate,
            body_colour,
            squareness=squareness,
            sections=sections,
            stands=True,
            tall=tall,
        )

    return Design(parts, back, visible.uniform(0.85, 1.0))


SOFA = Family(_design, _CONE)


def _soft(
    size: tuple[float, float, float], centre: tuple[float, float, float], nose: float
) -> list[np.ndarray]:
    """Rings of a cushion-like box along z; its front edge is rounded over the length `nose`."""
    width, height, depth = size
    x, y, z = centre
    stations = [(-depth / 2, 1.0), (depth / 2 - nose, 1.0), (depth / 2 - nose * 0.3, 0.93), (depth / 2, 0.75)]
    return [oval(width * (0.5 + s / 2), height * s, (x, y, z + at), squareness=14.0) for at, s in stations]


def _arched(ring: np.ndarray, above: float, camel: float, width: float) -> np.ndarray:
    """The ring with its upper half bent up towards the middle."""
    lift = np.maximum(ring[:, 1] - above, 0) * camel * np.cos(np.pi * ring[:, 0] / width)
    return ring + np.stack((np.zeros(len(ring)), lift, np.zeros(len(ring))), axis=1)


def _cushions(
    visible: np.random.Generator,
    seat: tuple[float, float],
    heights: tuple[float, float],
    back_thick: float,
    colour: np.ndarray,
) -> list[Solid]:
    """A row of seat cushions and a row against the back; either may be missing."""
    (width, depth), (seat_top, high) = seat, heights
    count = int(visible.integers(1, 5)) if width > 0.55 else int(visible.integers(1, 3))
    usable = width * 0.97
    step, squareness = usable / count, visible.choice([4.0, 7.0, 20.0])
    thickness, overhang = visible.uniform(0.025, 0.06), visible.uniform(-0.02, 0.015)
    parts = []
    for number in range(count):
        x = -usable / 2 + (number + 0.5) * step
        if visible.random() < 0.95:
            run = depth - back_thick + overhang
            y, z = seat_top + thickness / 2 - 0.005, _BACK_Z + back_thick
            rings = [
                oval(step * s * 0.98, thickness * s, (x, y, z + at), squareness=squareness)
                for at, s in ((0, 0.9), (0.03, 1.0), (run - 0.03, 1.0), (run, 0.75))
            ]
            parts.append(loft(rings, colour))
    if visible.random() < 0.65:
        tall, lean = (high - seat_top - thickness) * visible.uniform(0.75, 1.1), visible.uniform(0.03, 0.07)
        for number in range(count):
            x, y = -usable / 2 + (number + 0.5) * step, seat_top + thickness + tall / 2 - 0.01
            rings = [
                oval(step * s * 0.96, tall * s, (x, y, _BACK_Z + back_thick + z), squareness=squareness)
                for z, s in ((-0.01, 0.95), (lean * 0.6, 1.0), (lean, 0.8))
            ]
            parts.append(loft(rings, colour))
    return parts


def _arms(
    visible: np.random.Generator,
    seat: tuple[float, float],
    heights: tuple[float, float],
    back_height: float,
    colour: np.ndarray,
) -> list[Solid]:
    """Arms on both sides, on one, or on none: from the far side an arm is hidden, or missing."""
    (width, depth), (low, seat_top) = seat, heights
    sides = [(-1, 1), (-1,), (1,), ()][visible.choice(4, p=[0.64, 0.13, 0.13, 0.1])]
    kind = visible.choice(["block", "rolled", "slant", "rail"])
    thick = visible.uniform(0.03, 0.1)
    high = seat_top + visible.uniform(0.3, 0.75) * back_height
    flare = visible.uniform(0.0, 0.04)
    run = depth * visible.uniform(0.85, 1.02)
    parts = []
    for side in sides:
        x = side * (width + thick) / 2 - side * 0.012
        if kind == "rail":
            radius = 0.014
            top = bar((x, high, _BACK_Z + 0.02), (x, high, _BACK_Z + run), radius, colour)
            posts = [
                bar((x, low, z), (x, high, z), radius, colour) for z in (_BACK_Z + 0.03, _BACK_Z + run - 0.02)
            ]
            parts += [
                top,
                *posts,
                box((abs(x) - width / 2 + 0.03, 0.02, 0.03), (x - side * 0.01, low + 0.02, 0.15), colour),
            ]
            continue
        drop = 0.0 if kind != "slant" else visible.uniform(0.2, 0.6) * (high - seat_top)
        rings = []
        for at, top in ((0.005, high), (run * 0.5, high - drop * 0.35), (run, high - drop)):
            middle, tall = (low + top) / 2, top - low
            rings.append(oval(thick, tall, (x + side * flare * at, middle, _BACK_Z + at), squareness=12.0))
        parts.append(loft(rings, colour))
        if kind == "rolled":
            radius = thick * visible.uniform(0.5, 0.75)
            at = (x + side * radius * 0.3, high - radius * 0.3)
            parts.append(
                frustum((*at, _BACK_Z + 0.005), (*at, _BACK_Z + run + 0.012), (radius, radius), colour)
            )
    return parts
