"""Telephones: mobile, folding, cordless and desk phones; the front looks to +z."""

from __future__ import annotations

import numpy as np

from train.data.families.design import Design, Family, fitted, hsv, metal
from train.data.solids import Solid, bar, box, frustum, loft, oval, revolved, tube


def _design(visible: np.random.Generator) -> Design:
    kind = visible.choice(
        ["slab", "keys", "folding", "desk", "dial", "handset"], p=[0.22, 0.18, 0.12, 0.24, 0.12, 0.12]
    )
    shell = hsv(visible, (0, 1), (0.0, 0.8), (0.12, 0.95))
    dark = metal(visible) * 0.4
    return fitted(_KINDS[kind](visible, shell, dark), visible)


TELEPHONE = Family(_design)


def _plate(
    size: tuple[float, float, float], colour: np.ndarray, *, squareness: float, bevel: float, y: float = 0.0
) -> Solid:
    """A slab with rounded corners and soft edges; its back is at z = 0."""
    width, height, depth = size
    inner = (1 - bevel / width, 1 - bevel / height)
    levels = ((0, inner), (0.3 * depth, (1, 1)), (0.7 * depth, (1, 1)), (depth, inner))
    return loft(
        [oval(width * s, height * t, (0, y, z), squareness=squareness, sides=24) for z, (s, t) in levels],
        colour,
    )


def _keys(
    visible: np.random.Generator, area: tuple[float, float, float, float], z: float, colour: np.ndarray
) -> list[Solid]:
    """A pad of keys in an area (left, right, low, high), standing out of z."""
    left, right, low, high = area
    rows, columns = int(visible.integers(4, 6)), 3
    dx, dy = (right - left) / columns, (high - low) / rows
    size = (dx * visible.uniform(0.6, 0.85), dy * visible.uniform(0.5, 0.8), 0.024)
    return [
        box(size, (left + (i + 0.5) * dx, low + (k + 0.5) * dy, z), colour)
        for i in range(columns)
        for k in range(rows)
    ]


def _slab(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """A phone that is all screen."""
    height, depth = 1.0, visible.uniform(0.05, 0.12)
    width, squareness = visible.uniform(0.42, 0.62), visible.uniform(6, 16)
    parts = [_plate((width, height, depth), shell, squareness=squareness, bevel=visible.uniform(0.01, 0.06))]
    margin, chin = visible.uniform(0.02, 0.05), visible.choice([0.0, visible.uniform(0.05, 0.14)])
    screen = (width - 2 * margin, height - 2 * margin - 2 * chin, 0.012)
    parts.append(box(screen, (0, 0, depth), hsv(visible, (0, 1), (0.1, 0.7), (0.1, 0.7))))
    if chin:
        y = -height / 2 + margin + chin / 2
        parts.append(frustum((0, y, depth - 0.01), (0, y, depth + 0.008), (chin * 0.35, chin * 0.35), dark))
    bump = (visible.uniform(0.1, 0.3), visible.uniform(0.1, 0.3), visible.uniform(0.02, 0.05))
    x, y = (width - bump[0]) / 2 - 0.04, (height - bump[1]) / 2 - 0.04
    parts.append(box(bump, (x * visible.choice([0, 1]), y, 0), shell * 0.7))
    key = box((0.02, 0.12, depth * 0.4), (width / 2 - 0.002, visible.uniform(0.05, 0.3), depth / 2), dark)
    return [*parts, key]


def _key_phone(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """A mobile or cordless phone with keys, perhaps an aerial, perhaps in its charging cradle."""
    width, depth = visible.uniform(0.3, 0.46), visible.uniform(0.1, 0.2)
    split = visible.uniform(0.0, 0.2)
    squareness = visible.uniform(3.5, 10)
    bend, waist = visible.uniform(-0.06, 0.06), visible.uniform(0.8, 1.0)
    rings = []
    for share in np.linspace(0, 1, 7):
        narrow = 1 - (1 - waist) * np.sin(np.pi * share)
        ring = oval(width * narrow, depth, (0, 0, 0), squareness=squareness)[:, [0, 2, 1]]
        rings.append(ring + (0, share - 0.5, depth / 2 - bend * (2 * share - 1) ** 2))
    parts = [loft(rings, shell)]
    half = width * waist * 0.4
    screen_low = split
    parts.append(
        box(
            (2 * half, 0.42 - screen_low, 0.02),
            (0, (0.42 + screen_low) / 2, depth - bend * 0.2),
            hsv(visible, (0.2, 0.6), (0.1, 0.5), (0.3, 0.8)),
        )
    )
    parts += _keys(visible, (-half, half, -0.44, screen_low - 0.06), depth - bend * 0.2, dark)
    if visible.random() < 0.5:
        x, long, r = width * 0.32, visible.uniform(0.08, 0.35), visible.uniform(0.018, 0.035)
        parts.append(frustum((x, 0.46, depth / 2), (x, 0.5 + long, depth / 2), (r, r * 0.7), dark))
    if visible.random() < 0.3:
        cradle = visible.uniform(0.1, 0.2)
        sections = [(0.0, 1.7), (cradle * 0.6, 1.5), (cradle, 1.2)]
        parts.append(loft([
            oval(width * s, depth * s * 1.6, (0, 0, 0), squareness=4)[:, [0, 2, 1]] + (0, -0.56 + y, depth / 2)
            for y, s in sections
        ], shell * 0.75))  # fmt: skip
    return parts


def _folding(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """Two halves on a hinge."""
    width, depth = visible.uniform(0.42, 0.6), visible.uniform(0.06, 0.12)
    lower, upper = visible.uniform(0.44, 0.56), visible.uniform(0.44, 0.56)
    opening = visible.uniform(5, 75)
    squareness = visible.uniform(4, 10)
    keys = _keys(visible, (-width * 0.4, width * 0.4, -lower * 0.92, -lower * 0.25), depth, dark)
    base = [_plate((width, lower, depth), shell, squareness=squareness, bevel=0.04, y=-lower / 2), *keys]
    glass = hsv(visible, (0, 1), (0.1, 0.6), (0.1, 0.6))
    lid = [
        _plate((width, upper, depth * 0.8), shell, squareness=squareness, bevel=0.04, y=upper / 2),
        box((width * 0.76, upper * 0.68, 0.014), (0, upper * 0.52, depth * 0.8), glass),
    ]
    hinge = bar((-width * 0.42, 0, depth / 2), (width * 0.42, 0, depth / 2), depth * 0.55, dark)
    turned = [part.turned("x", opening, (0, 0, depth / 2)) for part in lid]
    lean = visible.uniform(-60, 0)
    return [part.turned("x", lean) for part in (*base, hinge, *turned)]


def _receiver(visible: np.random.Generator, long: float, colour: np.ndarray) -> list[Solid]:
    """A handset along x: a bowed grip with an ear and a mouth piece that look down."""
    arch, thick = visible.uniform(0.04, 0.16), visible.uniform(0.05, 0.085)
    share = np.linspace(-1, 1, 11)
    path = np.stack((share * long / 2, arch * (1 - share**2), np.zeros(11)), axis=1)
    radii = thick * (0.75 + 0.35 * np.abs(share) ** 3)
    cup = visible.uniform(0.09, 0.13)
    tall = visible.uniform(0.06, 0.12)
    ends = [
        revolved(
            [(cup, 0), (cup * 0.95, tall * 0.6), (cup * 0.5, tall * 1.2)],
            (s * (long / 2 - cup * 0.5), -tall, 0),
            colour,
        )
        for s in (-1, 1)
    ]
    return [tube(path, radii, colour), *ends]


def _desk(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """A wedge with keys and a display; the handset lies across it or along its left side."""
    width, depth = visible.uniform(0.6, 0.95), visible.uniform(0.6, 0.85)
    front, rear = visible.uniform(0.05, 0.14), visible.uniform(0.18, 0.42)
    rings = []
    for x, inset in ((-1, 0.02), (-0.94, 0), (0.94, 0), (1, 0.02)):
        z = depth / 2 - inset
        outline = [
            (0, z),
            (front - inset, z),
            (rear - inset, -z * visible.uniform(0.5, 0.55)),
            (rear - inset, -z),
            (0, -z),
        ]
        rings.append(np.array([(x * width / 2, y, at) for y, at in outline]))
    parts = [loft(rings, shell)]
    slope = np.degrees(np.arctan2(rear - front, depth * 0.76))
    centre = np.array((0, (front + rear) / 2, depth * 0.12))
    along = visible.random() < 0.55
    handset = _receiver(
        visible,
        visible.uniform(0.66, 0.85) * (1.05 if along else 1.0),
        shell if visible.random() < 0.6 else dark,
    )
    pad_x = width * 0.14 if along else 0.0
    half = width * 0.2
    keys = [
        key.turned("x", -90) for key in _keys(visible, (-half, half, -depth * 0.18, depth * 0.2), 0.0, dark)
    ]
    glass = box(
        (2 * half, 0.02, depth * 0.16),
        (0, 0.0, -depth * 0.3),
        hsv(visible, (0.2, 0.6), (0.1, 0.5), (0.3, 0.8)),
    )
    tops = [part.moved((pad_x, 0.006, depth * 0.06)) for part in ([*keys, glass] if along else keys)]
    parts += [part.turned("x", slope).moved(centre) for part in tops]
    if along:
        at = (-width / 2 + 0.14, rear * 0.62 + front * 0.38 + 0.12, 0)
        parts += [part.turned("y", 90).turned("x", slope).moved(at) for part in handset]
    else:
        parts += [part.moved((0, rear + 0.09, -depth * 0.36)) for part in handset]
        parts += [
            box((0.07, 0.1, 0.12), (s * width * 0.2, rear + 0.02, -depth * 0.36), shell) for s in (-1, 1)
        ]
    return parts


def _dial(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """A rotary phone: a sloping body, a dial with holes, the handset on a fork."""
    width, depth, rear = visible.uniform(0.6, 0.8), visible.uniform(0.55, 0.75), visible.uniform(0.28, 0.42)
    rings = []
    for share in (0, 0.25, 0.6, 1):
        y = share * rear
        wide, deep = width * (1 - 0.45 * share**1.5), depth * (1 - 0.55 * share)
        ring = oval(wide, deep, (0, 0, 0), squareness=5, sides=24)[:, [0, 2, 1]]
        rings.append(ring + (0, y, -0.22 * depth * share))
    parts = [loft(rings, shell)]
    out = np.array((0, np.cos(0.75), np.sin(0.75)))
    centre, radius = np.array((0, rear * 0.52, depth * 0.24)), visible.uniform(0.15, 0.2)
    parts.append(
        revolved([(radius, -0.06), (radius, 0.03), (radius * 0.95, 0.04)], centre, metal(visible), axis=out)
    )
    across = np.cross(out, (1, 0, 0))
    for angle in np.radians(np.linspace(-30, 240, 10)):
        hole = centre + 0.72 * radius * (np.cos(angle) * np.array((1.0, 0, 0)) + np.sin(angle) * across)
        parts.append(frustum(hole, hole + out * 0.048, (radius * 0.15, radius * 0.15), dark))
    z = -0.22 * depth
    parts += [box((0.06, 0.12, 0.16), (s * width * 0.2, rear + 0.03, z), shell) for s in (-1, 1)]
    handset = _receiver(visible, visible.uniform(0.68, 0.82), shell)
    return parts + [part.moved((0, rear + 0.13, z)) for part in handset]


def _handset(visible: np.random.Generator, shell: np.ndarray, dark: np.ndarray) -> list[Solid]:
    """A receiver alone: lying with its cord, or without one and tilted or upright."""
    receiver = _receiver(visible, visible.uniform(0.75, 0.95), shell)
    turns, long = int(visible.integers(6, 12)), visible.uniform(0.3, 0.6)
    share = np.linspace(0, 1, turns * 8 + 1)
    angle = share * turns * 2 * np.pi
    cord = np.stack((0.045 * np.cos(angle) - 0.38, -0.12 - long * share, 0.045 * np.sin(angle)), axis=1)
    tilt = visible.choice([0.0, 90.0, visible.uniform(20, 70)])
    if tilt == 0:
        return [*receiver, tube(cord, [0.014] * len(cord), dark, sides=6)]
    return [part.turned("z", tilt) for part in receiver]


_KINDS = {
    "slab": _slab,
    "keys": _key_phone,
    "folding": _folding,
    "desk": _desk,
    "dial": _dial,
    "handset": _handset,
}
