"""Benches: seats of slats or slabs, with or without back and arms."""

from __future__ import annotations

import itertools

import numpy as np

from train.data.families.design import SHARP, Design, Family, fitted, hsv, metal, wood
from train.data.solids import Solid, bar, box, frustum, loft, oval, tube


def _design(visible: np.random.Generator) -> Design:
    seat_colour = wood(visible) if visible.random() < 0.7 else hsv(visible)
    frame_colour = metal(visible) if visible.random() < 0.6 else seat_colour * visible.uniform(0.6, 1.0)
    width, depth = visible.uniform(0.7, 1.3), visible.uniform(0.24, 0.42)
    height, thickness = visible.uniform(0.24, 0.4), visible.uniform(0.02, 0.07)
    bow = visible.choice([0.0, 0.0, visible.uniform(-0.12, 0.12)])  # the bench curves along its length
    slats = int(visible.choice([1, 1, 2, 3, 4, 5, 6]))
    dish = visible.uniform(0.0, 0.03)
    parts = []
    step = depth / slats
    for number in range(slats):
        z = -depth / 2 + (number + 0.5) * step
        y = height - thickness / 2 + dish * (2 * z / depth) ** 2
        parts.append(
            _board((width, thickness, step * (0.78 if slats > 1 else 1.0)), (0, y, z), bow, seat_colour)
        )
    rest = visible.random() < 0.7
    tall, lean = visible.uniform(0.22, 0.42), visible.uniform(0.0, 0.3)
    if rest:
        parts += _rest(visible, width, (height, tall, lean), -depth / 2, bow, seat_colour)
    parts += _frame(visible, (width, depth), (height, thickness), bow, frame_colour)
    if rest:
        for x in _posts(width):
            z = -depth / 2 + _bowed(x, width, bow)
            low, high = (x, height - thickness, z + 0.012), (x, height + tall, z - lean * tall - 0.012)
            parts.append(bar(low, high, 0.016, frame_colour))
    if visible.random() < 0.45:
        parts += _arms(visible, (width, depth), height, bow, frame_colour, rest)
    return fitted(parts, visible)


BENCH = Family(_design)


def _bowed(x: float, width: float, bow: float) -> float:
    return bow * (1 - (2 * x / width) ** 2)


def _posts(width: float) -> tuple[float, ...]:
    ends = (-0.44 * width, 0.44 * width)
    return (*ends, 0.0) if width > 1.05 else ends


def _board(
    size: tuple[float, float, float], centre: tuple[float, float, float], bow: float, colour: np.ndarray
) -> Solid:
    """A board along x that curves in z."""
    width, height, depth = size
    count = 2 if bow == 0 else 8
    rings = []
    for x in np.linspace(-width / 2, width / 2, count):
        ring = oval(depth, height, (0, 0, 0), squareness=SHARP, sides=8)[:, [2, 1, 0]]
        rings.append(ring + np.array(centre) + (x, 0, _bowed(x, width, bow)))
    return loft(rings, colour)


def _rest(
    visible: np.random.Generator,
    width: float,
    rise: tuple[float, float, float],
    back: float,
    bow: float,
    colour: np.ndarray,
) -> list[Solid]:
    """Boards along the back, upright slats between two rails, or one panel."""
    height, tall, lean = rise
    start = height + visible.uniform(0.03, 0.1)
    span = height + tall - start
    kind = visible.choice(["boards", "boards", "slats", "panel"])
    if kind == "slats" and bow == 0:
        count = int(visible.integers(5, 16))
        rails = [
            _board((width, 0.04, 0.025), (0, y, back - lean * (y - height)), 0.0, colour)
            for y in (start, height + tall)
        ]
        return rails + [
            bar(
                (x, start, back - lean * (start - height)),
                (x, height + tall, back - lean * tall),
                0.011,
                colour,
            )
            for x in np.linspace(-0.47, 0.47, count) * width
        ]
    count = 1 if kind == "panel" else int(visible.integers(1, 5))
    step = span / count
    return [
        _board(
            (width, step * (0.72 if count > 1 else 1), 0.024), (0, y, back - lean * (y - height)), bow, colour
        )
        for y in start + (np.arange(count) + 0.5) * step
    ]


def _frame(
    visible: np.random.Generator,
    seat: tuple[float, float],
    rise: tuple[float, float],
    bow: float,
    colour: np.ndarray,
) -> list[Solid]:
    (width, depth), (height, thickness) = seat, rise
    top, reach = height - thickness / 2, depth / 2 * visible.uniform(0.75, 0.98)
    radius, splay = visible.uniform(0.012, 0.032), visible.uniform(0.0, 0.06)
    kind = visible.choice(["legs", "frames", "blocks", "X", "arch"])
    low_width = visible.uniform(0.05, 0.16)
    parts = []
    for x in _posts(width):
        z = _bowed(x, width, bow)
        if kind == "legs":
            for side in (-1, 1):
                foot = (x + np.sign(x) * splay, 0, z + side * (reach + splay))
                parts.append(frustum((x, top, z + side * reach), foot, (radius, radius * 0.7), colour))
        elif kind == "frames":
            path = [(x, 0, z - reach), (x, top, z - reach), (x, top, z + reach), (x, 0, z + reach)]
            parts += [bar(a, b, radius, colour) for a, b in itertools.pairwise(path)]
        elif kind == "blocks":
            parts.append(box((low_width, top, 2 * reach), (x, top / 2, z), colour))
        elif kind == "X":
            parts += [bar((x, 0, z + s * reach), (x, top, z - s * reach), radius, colour) for s in (-1, 1)]
        else:
            angle = np.linspace(0, np.pi, 9)
            path = np.stack((np.full(9, x), top * np.sin(angle) ** 0.8, z + reach * np.cos(angle)), axis=1)
            parts.append(tube(path, [radius] * 9, colour))
    if kind in ("legs", "X") and visible.random() < 0.4:
        y = top * visible.uniform(0.25, 0.6)
        parts.append(bar((-0.44 * width, y, 0), (0.44 * width, y, 0), radius * 0.7, colour))
    return parts


def _arms(
    visible: np.random.Generator,
    seat: tuple[float, float],
    height: float,
    bow: float,
    colour: np.ndarray,
    rest: bool,
) -> list[Solid]:
    width, depth = seat
    rise, radius = visible.uniform(0.12, 0.2), visible.uniform(0.012, 0.022)
    parts = []
    for x in (-0.46 * width, 0.46 * width):
        z = _bowed(x, width, bow)
        back, front = z - depth / 2 - (0.02 if rest else 0.0), z + depth / 2 - 0.02
        path = [(x, height + rise, back), (x, height + rise, front - 0.05), (x, height + rise - 0.02, front)]
        path += [(x, height - 0.02, front + 0.005)]
        if not rest:
            path.insert(0, (x, height - 0.02, back - 0.005))
        parts.append(tube(path, [radius] * len(path), colour))
    return parts
