"""Loudspeakers: a baffle with its drivers; what is hidden is the depth and the taper of the box behind it."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, hsv, metal, shadow_body, wood
from train.data.solids import Solid, bar, box, ellipsoid, frustum, loft, oval, revolved

_CONE = Cone(azimuth_deg=10, elevation_deg=10)
_DEPTHS = (0.05, 0.22, 0.5)
_BACK_Z = 0.16


def _design(visible: np.random.Generator) -> Design:
    baffle_colour = wood(visible) if visible.random() < 0.5 else hsv(visible, (0, 1), (0, 0.6), (0.15, 0.9))
    body_colour = wood(visible) if visible.random() < 0.5 else hsv(visible, (0, 1), (0, 0.6), (0.2, 0.9))
    width = visible.uniform(0.2, 0.42)
    height = width * visible.uniform(1.1, 2.6)
    height = min(height, 0.72)
    thickness = visible.uniform(0.02, 0.05)
    squareness = visible.choice([SHARP, 10.0, 4.0])
    centre_y = visible.uniform(0.0, 0.05)
    bevel = visible.uniform(0.85, 1.0)
    rings = [
        oval(width * s, height * s, (0, centre_y, _BACK_Z + z), squareness=squareness, sides=24)
        for z, s in ((0, 1), (thickness, 1), (thickness + 0.012, bevel))
    ]
    parts = [loft(rings, baffle_colour)]
    face_z = _BACK_Z + thickness + 0.012
    parts += _drivers(visible, width * bevel, height * bevel, centre_y, face_z)
    parts += _support(visible, width, centre_y - height / 2, thickness)
    plate = Plate(width, centre_y - height / 2, centre_y + height / 2, _BACK_Z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        return shadow_body(
            hidden,
            _DEPTHS[mode],
            plate,
            body_colour,
            squareness=squareness,
            sections=(2.3, 4.0, SHARP, SHARP),
        )

    return Design(parts, back, visible.uniform(0.8, 1.0))


LOUDSPEAKER = Family(_design, _CONE)


def _drivers(
    visible: np.random.Generator, width: float, height: float, centre_y: float, z: float
) -> list[Solid]:
    """Woofers below, tweeters above, down the middle of the baffle; or a grille over most of it."""
    ring_colour, cone_colour, cap_colour = (
        metal(visible),
        metal(visible) * 0.5,
        hsv(visible, (0, 1), (0, 0.7)),
    )
    count = visible.integers(1, 5)
    shares = np.sort(visible.uniform(0.4, 1.0, count))
    radii = shares * min(0.42 * width, 0.46 * height / shares.sum())
    gap = (height - 2 * radii.sum()) / (count + 1)
    parts, y = [], centre_y + height / 2
    protrusion = visible.uniform(0.006, 0.025)
    for radius in radii:
        y -= gap + radius
        rim = [(radius, -0.01), (radius, protrusion * 0.6), (radius * 0.88, protrusion)]
        parts.append(revolved(rim, (0, y, z), ring_colour, axis=(0, 0, 1), sides=24))
        disc = frustum((0, y, z), (0, y, z + protrusion + 0.001), (radius * 0.8, radius * 0.8), cone_colour)
        parts.append(disc)
        cap = radius * visible.uniform(0.25, 0.6)
        parts.append(ellipsoid((cap, cap, cap * 0.45), (0, y, z + protrusion), cap_colour))
        y -= radius
    if visible.random() < 0.3:  # bass ports
        r = visible.uniform(0.015, 0.03)
        for side in (-1, 1):
            at = np.array((side * (width / 2 - 1.4 * r), centre_y - height / 2 + 1.4 * r, z))
            parts.append(frustum(at - (0, 0, 0.01), at + (0, 0, 0.003), (r, r), cone_colour))
    return parts


def _support(visible: np.random.Generator, width: float, low: float, thickness: float) -> list[Solid]:
    """Nothing, spikes, a plinth, or a stand."""
    kind = visible.choice(["none", "spikes", "plinth", "stand", "tripod"])
    colour, z = metal(visible), _BACK_Z + thickness / 2
    if kind == "spikes":
        tall = visible.uniform(0.02, 0.05)
        return [
            frustum(
                (s * width * 0.36, low - tall, z), (s * width * 0.36, low + 0.01, z), (0.004, 0.018), colour
            )
            for s in (-1, 1)
        ]
    if kind == "plinth":
        size = (width * visible.uniform(0.9, 1.25), visible.uniform(0.02, 0.05), visible.uniform(0.08, 0.2))
        return [box(size, (0, low - size[1] / 2 + 0.002, z), colour)]
    drop = visible.uniform(0.08, max(0.09, 0.42 + low))
    floor = low - drop
    if kind == "stand":
        radius, foot = visible.uniform(0.012, 0.04), width * visible.uniform(0.4, 0.6)
        return [
            bar((0, low + 0.01, z), (0, floor, z), radius, colour),
            frustum((0, floor, z), (0, floor + 0.02, z), (foot, foot * 0.9), colour),
        ]
    if kind == "tripod":
        foot = visible.uniform(0.08, 0.16)
        return [
            bar((0, low + 0.02, z), (foot * np.sin(t), floor, z + foot * np.cos(t) * 0.7), 0.011, colour)
            for t in np.arange(3) * 2 * np.pi / 3
        ]
    return []
