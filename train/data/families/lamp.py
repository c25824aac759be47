"""Lamps: on a floor, on a table, over a desk, in an arc, or hanging from the ceiling."""

from __future__ import annotations

import numpy as np

from train.data.families.design import Design, Family, fitted, hsv, metal, wood
from train.data.solids import Point, Solid, bar, box, ellipsoid, frustum, revolved, tube


def _design(visible: np.random.Generator) -> Design:
    kind = visible.choice(
        ["table", "floor", "desk", "arc", "pendant", "chandelier"], p=[0.25, 0.2, 0.2, 0.1, 0.15, 0.1]
    )
    shade_colour = hsv(visible, (0, 1), (0.05, 0.7), (0.55, 0.98))
    frame_colour = metal(visible) if visible.random() < 0.6 else wood(visible)
    return fitted(_KINDS[kind](visible, shade_colour, frame_colour), visible)


LAMP = Family(_design)


def _shade(visible: np.random.Generator, at: Point, size: float, colour: np.ndarray) -> list[Solid]:
    """A shade whose middle hangs at `at`, `size` across."""
    radius, kind = size / 2, visible.choice(["cone", "drum", "bell", "dome", "globe", "lantern", "tulip"])
    tall = size * visible.uniform(0.45, 0.95)
    base = np.asarray(at, float) - (0, tall / 2, 0)
    top = visible.uniform(0.3, 0.7)
    if kind == "globe":
        return [ellipsoid((radius, tall * 0.6, radius), at, colour)]
    if kind == "lantern":
        sides = int(visible.choice([4, 5, 6, 8]))
        return [revolved([(radius, 0), (radius * top, tall)], base, colour, sides=sides)]
    share = np.linspace(0, 1, 6)
    curve = {
        "cone": 1 - (1 - top) * share,
        "drum": np.full(6, 1.0) - 0.1 * share,
        "bell": top + (1 - top) * (1 - share) ** 2.2,
        "dome": np.sqrt(np.maximum(1 - (0.97 * share) ** 2, 0)),
        "tulip": 0.55 + 0.45 * np.sin(np.pi * (0.15 + 0.75 * share)),
    }[kind]
    return [revolved([(radius * r, tall * s) for r, s in zip(curve, share, strict=True)], base, colour)]


def _foot(visible: np.random.Generator, radius: float, colour: np.ndarray) -> list[Solid]:
    """A disc, a dome, a square plate or three toes, standing on y = 0."""
    kind = visible.choice(["disc", "dome", "plate", "toes"])
    tall = radius * visible.uniform(0.12, 0.35)
    if kind == "disc":
        return [frustum((0, 0, 0), (0, tall, 0), (radius, radius * 0.92), colour)]
    if kind == "dome":
        return [
            revolved(
                [(radius, 0), (radius * 0.9, tall * 0.5), (radius * 0.5, tall), (0.02, tall * 1.4)],
                (0, 0, 0),
                colour,
            )
        ]
    if kind == "plate":
        return [box((2 * radius, tall, 2 * radius), (0, tall / 2, 0), colour)]
    phase = visible.uniform(0, 120)
    thick = 0.08 * radius + 0.006
    return [
        bar((0, radius * 0.5, 0), (radius * np.sin(t), thick * 0.7, radius * np.cos(t)), thick, colour)
        for t in np.radians(phase + 120 * np.arange(3))
    ]


def _table(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    """A turned base under a wide shade."""
    height, size = visible.uniform(0.35, 0.6), visible.uniform(0.32, 0.6)
    if visible.random() < 0.65:
        widths = visible.uniform(0.025, 0.15, 7)
        widths[0], widths[-1] = visible.uniform(0.08, 0.16), visible.uniform(0.02, 0.04)
        widths = np.convolve(np.pad(widths, 1, mode="edge"), (0.2, 0.6, 0.2), mode="valid")
        dense = np.interp(np.linspace(0, 6, 16), np.arange(7), widths)
        stem = [revolved(list(zip(dense, np.linspace(0, height, 16), strict=True)), (0, 0, 0), frame)]
    else:
        stem = [
            *_foot(visible, visible.uniform(0.09, 0.18), frame),
            bar((0, 0.01, 0), (0, height, 0), 0.018, frame),
        ]
    return [
        *stem,
        bar((0, height - 0.05, 0), (0, height + 0.14, 0), 0.012, frame),
        *_shade(visible, (0, height + 0.16, 0), size, shade),
    ]


def _floor(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    height, size = visible.uniform(1.0, 1.5), visible.uniform(0.28, 0.5)
    pole = visible.uniform(0.012, 0.028)
    parts = _foot(visible, visible.uniform(0.13, 0.24), frame)
    if visible.random() < 0.3:  # a tripod of long legs
        spread = visible.uniform(0.2, 0.34)
        parts = [
            frustum(
                (0, height - 0.05, 0), (spread * np.sin(t), 0, spread * np.cos(t)), (pole, pole * 0.7), frame
            )
            for t in np.radians(visible.uniform(0, 120) + 120 * np.arange(3))
        ]
    else:
        parts.append(bar((0, 0, 0), (0, height, 0), pole, frame))
    return [*parts, *_shade(visible, (0, height, 0), size, shade)]


def _desk(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    """Two arms with joints and a reflector that looks down."""
    radius, lower, upper = visible.uniform(0.12, 0.2), visible.uniform(0.3, 0.48), visible.uniform(0.28, 0.46)
    first, second = np.radians(visible.uniform(-25, 30)), np.radians(visible.uniform(30, 95))
    heading = visible.uniform(-25, 25)
    elbow = np.array((0, lower * np.cos(first), -lower * np.sin(first)))
    head = elbow + (0, upper * np.cos(second), upper * np.sin(second))
    tilt = np.radians(visible.uniform(100, 165))
    out = np.array((0, np.cos(tilt), np.sin(tilt)))
    size, long, thick = visible.uniform(0.09, 0.16), visible.uniform(0.14, 0.26), visible.uniform(0.012, 0.02)
    profile = [(size * 0.25, 0), (size * 0.45, long * 0.3), (size, long)]
    arms = [
        bar((0, 0, 0), elbow, thick, frame),
        bar(elbow, head, thick, frame),
        ellipsoid((thick * 2, thick * 2, thick * 2), elbow, frame),
        ellipsoid((thick * 2, thick * 2, thick * 2), head, frame),
        revolved(profile, head - out * 0.04, shade, axis=out),
    ]
    return _foot(visible, radius, frame) + [part.turned("y", heading) for part in arms]


def _arc(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    """A bow from a heavy foot to a shade that hangs far out."""
    height, reach = visible.uniform(0.9, 1.3), visible.uniform(0.5, 0.9)
    angle = np.linspace(np.pi, visible.uniform(0.12, 0.4) * np.pi, 14)
    path = np.stack((np.zeros(14), height * np.sin(angle) ** 0.8, reach / 2 * (1 + np.cos(angle))), axis=1)
    heading, end = visible.uniform(-60, 60), path[-1]
    drop, size = visible.uniform(0.04, 0.16), visible.uniform(0.24, 0.4)
    moving = [
        tube(path, np.linspace(0.02, 0.012, 14), frame),
        bar(end, end - (0, drop, 0), 0.008, frame),
        *_shade(visible, end - (0, drop + size * 0.2, 0), size, shade),
    ]
    return _foot(visible, visible.uniform(0.14, 0.22), frame) + [part.turned("y", heading) for part in moving]


def _pendant(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    """A rose at the ceiling, a cord, a shade; sometimes several on a beam."""
    count = int(visible.choice([1, 1, 1, 2, 3]))
    cord, size = (
        visible.uniform(0.15, 0.6),
        visible.uniform(0.3, 0.5) if count == 1 else visible.uniform(0.2, 0.3),
    )
    style = visible.integers(2**31)
    parts = []
    for x in (np.arange(count) - (count - 1) / 2) * size * 1.3:
        parts.append(bar((x, 0, 0), (x, -cord, 0), 0.009, frame))
        parts += _shade(np.random.default_rng(style), (x, -cord - size * 0.2, 0), size, shade)
    if count == 1:
        radius = visible.uniform(0.05, 0.1)
        return [*parts, frustum((0, -0.03, 0), (0, 0.01, 0), (radius * 0.7, radius), frame)]
    return [*parts, box((count * size * 1.1, 0.03, 0.06), (0, 0.005, 0), frame)]


def _chandelier(visible: np.random.Generator, shade: np.ndarray, frame: np.ndarray) -> list[Solid]:
    arms, reach = int(visible.integers(3, 9)), visible.uniform(0.25, 0.42)
    drop, rise = visible.uniform(0.25, 0.5), visible.uniform(0.02, 0.14)
    size, style = visible.uniform(0.1, 0.17), visible.integers(2**31)
    hub = np.array((0, -drop, 0))
    parts = [bar((0, 0, 0), hub, 0.012, frame), frustum((0, -0.03, 0), (0, 0.01, 0), (0.05, 0.07), frame)]
    parts.append(ellipsoid((0.045, 0.07, 0.045), hub, frame))
    share = np.linspace(0, 1, 7)
    for turn in np.arange(arms) * 360 / arms:
        sag = -0.3 * reach * np.sin(np.pi * share) + rise * share
        path = np.stack((np.zeros(7), sag, reach * share), axis=1)
        arm = [tube(path, [0.012] * 7, frame)]
        arm += _shade(np.random.default_rng(style), path[-1] + (0, size * 0.35, 0), size, shade)
        parts += [part.turned("y", turn).moved(hub) for part in arm]
    return parts


_KINDS = {
    "table": _table,
    "floor": _floor,
    "desk": _desk,
    "arc": _arc,
    "pendant": _pendant,
    "chandelier": _chandelier,
}
