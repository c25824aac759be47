"""Rifles, shotguns and carbines; the muzzle points to +z."""

from __future__ import annotations

import numpy as np

from train.data.families.design import Design, Family, fitted, hsv, metal, wood
from train.data.solids import Solid, bar, body, box, ellipsoid, frustum, loft, oval, tube


def _design(visible: np.random.Generator) -> Design:
    steel = metal(visible) * visible.uniform(0.35, 0.8)
    furniture = [wood, metal, _olive][visible.choice(3, p=[0.5, 0.3, 0.2])](visible)
    military = visible.random() < 0.55
    length, height = (
        visible.uniform(0.22, 0.36),
        visible.uniform(0.05, 0.09),
    )  # of the receiver, from z = 0 forward
    width = visible.uniform(0.028, 0.045)
    parts = [
        body(
            [(0, width, -height / 2, height / 2 * 0.8), (0.02, width, -height / 2, height / 2),
             (length - 0.02, width, -height / 2, height / 2), (length, width * 0.9, -height / 2, height * 0.3)],
            steel,
            squareness=6,
        )
    ]  # fmt: skip
    barrel, bore = visible.uniform(0.3, 0.62), visible.uniform(0.008, 0.016)
    axis = height * 0.18
    muzzle = length + barrel
    parts.append(frustum((0, axis, length - 0.02), (0, axis, muzzle), (bore * 1.2, bore), steel))
    parts += _muzzle(visible, (axis, muzzle, bore), steel)
    parts += _forend(visible, (length, barrel, axis), (width, height), furniture)
    parts += _stock(visible, height, width, furniture, steel, military)
    if military or visible.random() < 0.3:
        parts += _grip(visible, height, width, furniture if military else steel)
    parts += _magazine(visible, length, height, width, steel, military)
    parts += _sights(visible, length, height, steel)
    guard = visible.uniform(0.025, 0.04)
    z = 0.06
    path = [(0, -height / 2 + 0.004, z - guard), (0, -height / 2 - 0.03, z - guard * 0.6)]
    path += [(0, -height / 2 - 0.03, z + guard * 0.6), (0, -height / 2 + 0.004, z + guard)]
    parts.append(tube(path, [0.005] * 4, steel, sides=6))
    if not military:
        bolt = bar((0, height * 0.3, 0.1), (width / 2 + 0.04, height * 0.15, 0.09), 0.006, steel)
        parts += [bolt, ellipsoid((0.011, 0.011, 0.011), (width / 2 + 0.045, height * 0.14, 0.09), steel)]
    if visible.random() < 0.18:
        foot, spread = visible.uniform(0.12, 0.2), visible.uniform(0.04, 0.08)
        leg = bar((0, axis, muzzle - barrel * 0.35), (spread, -foot, muzzle - barrel * 0.3), 0.007, steel)
        parts += [leg, leg.mirrored()]
    return fitted(parts, visible)


RIFLE = Family(_design)


def _olive(visible: np.random.Generator) -> np.ndarray:
    return hsv(visible, (0.1, 0.3), (0.2, 0.5), (0.2, 0.5))


def _muzzle(visible: np.random.Generator, at: tuple[float, float, float], colour: np.ndarray) -> list[Solid]:
    """A bare barrel, a brake, a silencer, or a second barrel beside or below."""
    y, z, bore = at
    kind = visible.choice(["bare", "brake", "silencer", "double"], p=[0.4, 0.3, 0.15, 0.15])
    if kind == "brake":
        return [frustum((0, y, z - 0.01), (0, y, z + 0.04), (bore * 1.7, bore * 1.5), colour)]
    if kind == "silencer":
        long = visible.uniform(0.12, 0.2)
        return [frustum((0, y, z - 0.02), (0, y, z + long), (bore * 2.2, bore * 2.2), colour)]
    if kind == "double":
        below = visible.uniform(2.0, 2.6) * bore
        return [bar((0, y - below, 0.15), (0, y - below, z - 0.02), bore, colour)]
    return []


def _forend(
    visible: np.random.Generator,
    lengths: tuple[float, float, float],
    section: tuple[float, float],
    colour: np.ndarray,
) -> list[Solid]:
    """The wood or plastic under and around the barrel."""
    (start, barrel, axis), (width, height) = lengths, section
    reach = barrel * visible.uniform(0.3, 0.85)
    low, thin = -height * visible.uniform(0.3, 0.55), visible.uniform(0.5, 0.9)
    top = axis + visible.choice([0.0, 0.022])
    stations = [
        (start - 0.03, width * 1.1, low, top),
        (start + reach * 0.5, width * 1.1, low * 0.95, top),
        (start + reach, width * thin, low * thin * 0.8, top),
    ]
    return [body(stations, colour, squareness=visible.uniform(2.5, 6))]


def _stock(
    visible: np.random.Generator,
    height: float,
    width: float,
    colour: np.ndarray,
    steel: np.ndarray,
    military: bool,
) -> list[Solid]:
    """A shaped butt, a straight one, or a skeleton of bars, from z = 0 backwards."""
    long, drop = visible.uniform(0.24, 0.36), visible.uniform(0.01, 0.07)
    butt = visible.uniform(0.1, 0.15)
    kind = visible.choice(
        ["skeleton", "shaped", "thumbhole"], p=[0.35, 0.45, 0.2] if military else [0.05, 0.75, 0.2]
    )
    top = height * 0.35
    if kind == "skeleton":
        end = [(0, top - 0.01, -long), (0, top - butt, -long)]
        bars = [((0, top - 0.012, 0.01), end[0]), ((0, -height * 0.3, 0.01), end[1]), (end[0], end[1])]
        if visible.random() < 0.5:
            bars = [((0, top - 0.015, 0.01), end[0]), (end[0], end[1])]
        pad = box((0.035, butt + 0.02, 0.022), (0, top - butt / 2 - 0.005, -long), steel)
        return [*(bar(a, b, 0.012, steel) for a, b in bars), pad]
    wrist = height * visible.uniform(0.55, 0.8)
    stations = [
        (-long, width * 1.15, top - drop - butt, top - drop),
        (-long * 0.6, width * 1.15, top - drop * 0.6 - butt * 0.78, top - drop * 0.6),
        (-long * 0.25, width * 0.95, top - 0.012 - wrist, top - 0.012),
        (0.015, width, top - wrist * 1.05, top - 0.004),
    ]
    parts = [body(stations, colour, squareness=3.2)]
    parts.append(box((width * 1.05, butt * 0.96, 0.016), (0, top - drop - butt / 2, -long - 0.006), steel))
    if kind == "thumbhole":
        rest = visible.uniform(0.03, 0.05)
        parts.append(
            box(
                (width * 0.9, rest, long * 0.4),
                (0, top - drop * 0.6 + rest * 0.3, -long * 0.65),
                colour * 0.8,
            )
        )
    return parts


def _grip(visible: np.random.Generator, height: float, width: float, colour: np.ndarray) -> list[Solid]:
    long, lean = visible.uniform(0.09, 0.13), visible.uniform(0.02, 0.06)
    rings = []
    for share, size in ((0, 0.05), (0.5, 0.045), (1, 0.05)):
        ring = oval(width * 0.9, size, (0, 0, 0), squareness=3)[:, [0, 2, 1]]
        rings.append(ring + (0, -height / 2 + 0.01 - share * long, 0.02 - lean * share))
    return [loft(rings, colour)]


def _magazine(
    visible: np.random.Generator,
    length: float,
    height: float,
    width: float,
    colour: np.ndarray,
    military: bool,
) -> list[Solid]:
    kind = visible.choice(
        ["none", "box", "curved", "drum"], p=[0.04, 0.4, 0.46, 0.1] if military else [0.6, 0.36, 0.04, 0.0]
    )
    z, low = length * visible.uniform(0.55, 0.8), -height / 2 + 0.01
    if kind == "none":
        return []
    if kind == "drum":
        radius = visible.uniform(0.05, 0.075)
        y = low - radius * 0.8
        return [frustum((-0.03, y, z), (0.03, y, z), (radius, radius), colour)]
    long = visible.uniform(0.06, 0.2) if military else visible.uniform(0.03, 0.06)
    bend, lean = (visible.uniform(0.03, 0.09) if kind == "curved" else 0.0), visible.uniform(0.0, 0.15)
    rings = []
    for share in (0, 0.33, 0.66, 1):
        ring = oval(width * 0.75, visible.uniform(0.058, 0.06), (0, 0, 0), squareness=12)[:, [0, 2, 1]]
        rings.append(ring + (0, low - share * long, z + lean * share * long + bend * share**2))
    return [loft(rings, colour)]


def _sights(visible: np.random.Generator, length: float, height: float, colour: np.ndarray) -> list[Solid]:
    """A telescope on rings, iron sights, a carrying handle or a rail."""
    kind, top = visible.choice(["scope", "iron", "handle", "rail"], p=[0.45, 0.25, 0.1, 0.2]), height / 2
    if kind == "iron":
        return [box((0.01, 0.03, 0.012), (0, top + 0.01, z), colour) for z in (0.05, length - 0.02)]
    if kind == "rail":
        return [box((0.02, 0.014, length * 0.9), (0, top + 0.004, length / 2), colour)]
    if kind == "handle":
        path = [(0, top - 0.005, 0.04), (0, top + 0.045, 0.07), (0, top + 0.045, length * 0.75)]
        path += [(0, top - 0.005, length * 0.85)]
        return [tube(path, [0.011] * 4, colour, sides=8)]
    radius, long = visible.uniform(0.011, 0.017), visible.uniform(0.18, 0.3)
    y, middle = top + radius + visible.uniform(0.012, 0.024), visible.uniform(0.3, 0.6) * length
    bell = radius * visible.uniform(1.4, 2.0)
    rings = [
        (-0.5, 1.4 * radius),
        (-0.32, 1.4 * radius),
        (-0.26, radius),
        (0.2, radius),
        (0.3, bell),
        (0.5, bell),
    ]
    tubes = tube([(0, y, middle + s * long) for s, _ in rings], [r for _, r in rings], colour, sides=14)
    mounts = [
        box((0.014, y - top + 0.01, 0.018), (0, (y + top) / 2 - 0.004, middle + s * long), colour)
        for s in (-0.18, 0.14)
    ]
    return [tubes, *mounts]
