"""Cars and vans; what is hidden is what follows the doors: how long the car is, and how its roof ends."""

from __future__ import annotations

import numpy as np

from train.data.families.design import Cone, Design, Family, Plate, hsv
from train.data.solids import Solid, bar, box, ellipsoid, frustum, loft, oval

_CONE = Cone(azimuth_deg=6, elevation_deg=6)
_TAILS = ((0.06, 0.1), (0.23, 0.28), (0.5, 0.56))  # how far the car reaches behind its middle, by mode
_NOSE_Z = 0.36
_TYRE = np.array((0.07, 0.07, 0.08))


def _design(visible: np.random.Generator) -> Design:
    paint = hsv(visible, (0, 1), (0.0, 0.9), (0.25, 0.95))
    glass = hsv(visible, (0.5, 0.65), (0.1, 0.4), (0.15, 0.4))
    trim = hsv(visible, (0, 1), (0, 0.1), (0.1, 0.6))
    panelled = visible.random() < 0.35  # a delivery van: the tail has no windows
    width = visible.uniform(0.27, 0.38)
    clearance, wheel = visible.uniform(0.025, 0.06), visible.uniform(0.05, 0.075)
    floor = visible.uniform(-0.16, -0.12)
    low = floor + clearance
    belt = max(low + visible.uniform(0.09, 0.16), floor + 2 * wheel + 0.012)
    roof = belt + visible.uniform(0.06, 0.2)
    hood = visible.uniform(0.03, 0.22)
    hood_drop = visible.uniform(0.0, 0.05) * (hood > 0.08)
    rake = visible.uniform(0.03, 0.16)
    lean = visible.uniform(0.8, 0.95)  # the roof's width, as a share of the belt's
    squareness = visible.uniform(4.5, 12)
    middle_z = _NOSE_Z - hood - rake - visible.uniform(0.06, 0.12)

    nose = visible.uniform(0.7, 0.95)  # roundness of the front seen from above
    stations = [
        (_NOSE_Z, width * nose, low + 0.02, belt - hood_drop - 0.03),
        (_NOSE_Z - 0.02, width * (nose + 1) / 2, low, belt - hood_drop - 0.01),
        (_NOSE_Z - 0.07, width, low, belt - hood_drop),
        (_NOSE_Z - max(hood, 0.08), width, low, belt),
        (middle_z, width, low, belt),
    ]
    parts = [_lower(stations, paint, squareness)]
    cabin_width = width * visible.uniform(0.9, 0.97)
    screen_z = _NOSE_Z - hood
    stations = [
        (screen_z, belt - 0.02, belt + 0.005),
        (screen_z - rake, belt - 0.02, roof),
        (middle_z, belt - 0.02, roof),
    ]
    parts.append(
        loft([_cabin(cabin_width, z, bottom, top, lean, roof) for z, bottom, top in stations], glass)
    )
    cap = roof - 0.012
    lid = [(screen_z - rake * 0.94, cap - 0.002, roof + 0.001), (middle_z, cap, roof + 0.003)]
    parts.append(
        loft(
            [oval(cabin_width * lean * 1.02, t - b, (0, (b + t) / 2, z), squareness=8) for z, b, t in lid],
            paint,
        )
    )
    parts += _face(visible, (width * nose, low, belt - hood_drop), trim)
    axle = _NOSE_Z - 0.05 - wheel * visible.uniform(1.0, 1.4)
    parts += _wheels(width / 2, floor, axle, wheel, trim)
    if visible.random() < 0.7:
        mirror = ellipsoid(
            (0.018, 0.014, 0.01), (width / 2 + 0.01, belt + 0.02, screen_z - rake * 0.6), paint
        )
        parts += [mirror, mirror.mirrored()]

    # The glass house hides the deck behind it, so that the deck need not sink.
    under = Plate(width, low, belt + 0.6 * (roof - belt), middle_z, _CONE)
    over = Plate(cabin_width * lean, belt, roof, middle_z, _CONE)

    def back(hidden: np.random.Generator, mode: int) -> list[Solid]:
        depth = hidden.uniform(*_TAILS[mode])
        reach = hidden.uniform(0.35, 1.0)  # where the roof ends, as a share of the tail
        slant = hidden.uniform(0.15, 0.6) * reach
        rings = []
        for share, fill in ((0, 1.0), (0.5, 1.0), (0.85, 0.98), (1, 0.9)):
            at_width, _, at_high = under.shadow(share * depth)
            z = middle_z + 0.004 - share * depth
            bottom = low + 0.035 * share**4
            high = min(belt, at_high) - 0.004
            rings.append((z, min(width, at_width + 0.02) * fill, bottom, high))
        tail = [_lower(rings, paint, squareness)]
        cabin = []
        for share in (0.0, reach - slant, reach):
            at_width, _, at_high = over.shadow(share * depth)
            top = at_high if share < reach else belt + 0.01
            cabin.append(
                _cabin(at_width / lean, middle_z + 0.004 - share * depth, belt - 0.05, top, lean, roof)
            )
        tail.append(loft(cabin, paint if panelled else glass))
        end_width = under.shadow(depth)[0] * 0.93
        hub = middle_z - depth + wheel * hidden.uniform(1.1, 1.5)
        return tail + _wheels(end_width / 2, floor, hub, wheel, trim)

    return Design(parts, back, visible.uniform(0.84, 1.0))


CAR = Family(_design, _CONE)


def _lower(stations: list[tuple[float, float, float, float]], colour: np.ndarray, squareness: float) -> Solid:
    return loft(
        [
            oval(wide, high - low, (0, (low + high) / 2, z), squareness=squareness)
            for z, wide, low, high in stations
        ],
        colour,
    )


def _cabin(width: float, z: float, low: float, top: float, lean: float, roof: float) -> np.ndarray:
    """A section of the glass house: its sides lean in towards the roof."""
    upper = width * (1 - (1 - lean) * min(1.0, (top - low) / (roof - low)))
    soft = min(0.02, (top - low) / 3)
    right = np.array([(width / 2, low), (upper / 2, top - soft), (upper / 2 - soft, top)])
    outline = np.concatenate((right, right[::-1] * (-1, 1)))
    return np.column_stack((outline, np.full(6, z)))


def _wheels(x: float, floor: float, z: float, radius: float, hub: np.ndarray) -> list[Solid]:
    """Two wheels whose outer faces are at +-x."""
    thick, y = 0.045, floor + radius
    tyre = frustum((x - thick, y, z), (x + 0.004, y, z), (radius, radius), _TYRE)
    disc = frustum((x, y, z), (x + 0.008, y, z), (radius * 0.6, radius * 0.5), hub)
    return [tyre, tyre.mirrored(), disc, disc.mirrored()]


def _face(visible: np.random.Generator, front: tuple[float, float, float], trim: np.ndarray) -> list[Solid]:
    """Lamps, a grille and a bumper."""
    width, low, high = front
    lamp_colour = hsv(visible, (0.1, 0.17), (0.0, 0.4), (0.8, 1.0))
    y = low + (high - low) * visible.uniform(0.5, 0.7)
    size = (visible.uniform(0.018, 0.04), visible.uniform(0.012, 0.025), 0.02)
    lamp = ellipsoid(size, (width / 2 - size[0], y, _NOSE_Z - 0.008), lamp_colour)
    grille = (width * visible.uniform(0.3, 0.6), (high - low) * visible.uniform(0.15, 0.4), 0.02)
    bumper = visible.uniform(0.01, 0.02)
    beam = bar(
        (-width / 2, low + 0.03, _NOSE_Z - 0.005), (width / 2, low + 0.03, _NOSE_Z - 0.005), bumper, trim
    )
    return [lamp, lamp.mirrored(), box(grille, (0, y - 0.01, _NOSE_Z - 0.004), trim * 0.5), beam]
