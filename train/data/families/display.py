"""Screens on a stand; what is hidden is the body behind, from a flat panel to a picture tube."""

from __future__ import annotations

import numpy as np

from train.data.families.design import SHARP, Cone, Design, Family, Plate, colours, hsv, shadow_body
from train.data.solids import Solid, bar, box, frustum, loft, oval, tube

_CONE = Cone(azimuth_deg=15, elevation_deg=15)
_DEPTHS = (0.0, 0.17, 0.4)
_BACK_Z = 0.1


def _design(visible: np.random.Generator) -> Design:
    frame_colour, stand_colour, body_colour = colours(visible)
    screen_colour = hsv(visible, (0, 1), (0, 0.6), (0.1, 0.5))
    width, height = visible.uniform(0.42, 0.72), visible.uniform(0.26, 0.46)
    thickness, bezel, chin = (
        visible.uniform(0.025, 0.06),
        visible.uniform(0.012, 0.05),
        visible.uniform(0, 0.05),
    )
    centre_y = visible.uniform(0.04, 0.09)
    low, high = centre_y - height / 2, centre_y + height / 2
    squareness = visible.choice([SHARP, 12.0])
    frame = [
        oval(width * s, height * s, (0, centre_y, _BACK_Z + z), squareness=squareness, sides=24)
        for z, s in ((0, 1), (thickness - 0.006, 1), (thickness, 0.985))
    ]
    glass = (width - 2 * bezel, height - 2 * bezel - chin)
    glass_y = centre_y + chin / 2
    bulge = visible.choice([0.004, 0.02, 0.035])  # a tube's glass bulges
    screen = [
        oval(glass[0] * s, glass[1] * s, (0, glass_y, _BACK_Z + z), squareness=20, sides=24)
        for z, s in ((thickness - 0.01, 1), (thickness + 0.002, 1), (thickness + 0.002 + bulge, 0.75))
    ]
    parts = [loft(frame, frame_colour), loft(screen, screen_colour)]
    parts += _stand(visible, width, low, stand_colour)
    if visible.random() < 0.25:  # loudspeakers at the sides
        size = (visible.uniform(0.03, 0.07), height * visible.uniform(0.6, 1.0), thickness)
        x = (width + size[0]) / 2 - 0.002
        parts += [box(size, (side * x, centre_y, _BACK_Z + thickness / 2), stand_colour) for side in (-1, 1)]
    plate = Plate(width, low, high, _BACK_Z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        return shadow_body(hidden, _DEPTHS[mode], plate, body_colour, squareness=squareness)

    return Design(parts, back, visible.uniform(0.78, 1.0))


DISPLAY = Family(_design, _CONE)


def _stand(visible: np.random.Generator, width: float, low: float, colour: np.ndarray) -> list[Solid]:
    drop = visible.uniform(0.05, 0.2)
    floor = low - drop
    foot = (width * visible.uniform(0.35, 0.8), visible.uniform(0.015, 0.03), visible.uniform(0.14, 0.24))
    neck = (visible.uniform(0.04, 0.14), drop + 0.04, 0.03)
    kind = visible.choice(["pedestal", "round", "feet", "column", "easel"])
    if kind == "feet":
        x = width * visible.uniform(0.25, 0.42)
        return [
            part
            for side in (-1, 1)
            for part in (
                box(
                    (0.03, drop + 0.03, 0.025), (side * x, floor + drop / 2 + 0.015, _BACK_Z + 0.012), colour
                ),
                box((0.03, 0.02, foot[2]), (side * x, floor + 0.01, _BACK_Z), colour),
            )
        ]
    if kind == "easel":
        x, spread = width * visible.uniform(0.1, 0.35), visible.uniform(0.0, 0.08)
        leg = bar((x, low + 0.02, _BACK_Z + 0.012), (x + spread, floor, _BACK_Z + foot[2] / 2), 0.014, colour)
        path = [(-x - spread, floor, _BACK_Z + foot[2] / 2), (x + spread, floor, _BACK_Z + foot[2] / 2)]
        return [leg, leg.mirrored(), tube(path, [0.014, 0.014], colour)]
    if kind == "column":
        size = (width * visible.uniform(0.5, 0.9), drop + 0.01, visible.uniform(0.05, 0.1))
        return [box(size, (0, floor + size[1] / 2, _BACK_Z), colour)]
    column = box(neck, (0, floor + neck[1] / 2, _BACK_Z + 0.02), colour)
    if kind == "round":
        radius = foot[2] / 2
        disc = frustum((0, floor, _BACK_Z), (0, floor + foot[1], _BACK_Z), (radius, radius * 0.9), colour)
        return [column, disc]
    return [column, box(foot, (0, floor + foot[1] / 2, _BACK_Z), colour)]
