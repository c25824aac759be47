"""Object families whose front fixes nothing of the back.

A family is built from two random streams: the visible one decides all that the front shows (and every colour),
the hidden one and the mode decide a body that grows backwards inside the shadow of a solid front. Units are the
world's and are never normalised by the bounding box: the image's scale would tell what is behind. Front is +z,
up is +y.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence

import numpy as np

from train.data.render import DISTANCE
from train.data.solids import Solid, bar, box, loft, rectangle

MODES = 3
"""Hidden modes of a family: flat, medium, deep."""

FRONT_AZIMUTH_DEG, FRONT_ELEVATION_DEG = 15.0, 15.0
"""The front view: azimuth within +-15 degrees of the front, elevation 15."""

_CHAIR_BACK_Z = 0.06

Family = Callable[[np.random.Generator, np.random.Generator, int], list[Solid]]


def chair(visible: np.random.Generator, hidden: np.random.Generator, mode: int) -> list[Solid]:
    """A chair with a solid back; what is hidden is how far the shell behind the back reaches."""
    seat_colour, frame_colour, shell_colour = _colours(visible)
    width, depth = visible.uniform(0.32, 0.5), visible.uniform(0.18, 0.26)
    leg_height, back_height = visible.uniform(0.14, 0.28), visible.uniform(0.32, 0.44)
    thickness = visible.uniform(0.03, 0.08)
    seat_top = visible.uniform(-0.13, -0.06)
    back_z, front_z = _CHAIR_BACK_Z, _CHAIR_BACK_Z + depth
    under_seat = seat_top - thickness
    floor = under_seat - leg_height
    parts = [
        box((width, thickness, depth), (0, seat_top - thickness / 2, (back_z + front_z) / 2), seat_colour)
    ]
    parts += _chair_base(visible, (width, depth), (under_seat + 0.01, floor), frame_colour)
    parts += _chair_arms(visible, width, seat_top, (back_z, front_z), frame_colour)

    plate_thickness = visible.uniform(0.025, 0.05)
    top_width = width * visible.uniform(0.75, 1.0)
    low, high = seat_top - 0.01, seat_top + back_height
    outline = np.array([(-width, low), (width, low), (top_width, high), (-top_width, high)]) * (0.5, 1)
    plate = [np.column_stack((outline, np.full(4, z))) for z in (back_z, back_z + plate_thickness)]
    parts.append(loft(plate, seat_colour))
    shell = _hidden_body(
        hidden,
        mode,
        depths=(0.0, 0.21, 0.5),
        front=(top_width, low + 0.02, high, back_z),
        colour=shell_colour,
    )
    return _scaled(parts + shell, visible)


def display(visible: np.random.Generator, hidden: np.random.Generator, mode: int) -> list[Solid]:
    """A screen on a stand; what is hidden is the body behind it, from a flat panel to a picture tube."""
    frame_colour, stand_colour, body_colour = _colours(visible)
    screen_colour = np.array(
        colorsys.hsv_to_rgb(visible.random(), visible.uniform(0, 0.6), visible.uniform(0.1, 0.5))
    )
    width, height = visible.uniform(0.42, 0.72), visible.uniform(0.28, 0.46)
    thickness, bezel = visible.uniform(0.025, 0.06), visible.uniform(0.015, 0.05)
    centre_y, back_z = visible.uniform(0.04, 0.09), 0.1
    low, high = centre_y - height / 2, centre_y + height / 2
    parts = [
        box((width, height, thickness), (0, centre_y, back_z + thickness / 2), frame_colour),
        box((width - 2 * bezel, height - 2 * bezel, 0.01), (0, centre_y, back_z + thickness), screen_colour),
    ]
    parts += _display_stand(visible, width, low, back_z, stand_colour)
    body = _hidden_body(
        hidden, mode, depths=(0.0, 0.17, 0.4), front=(width, low, high, back_z), colour=body_colour
    )
    return _scaled(parts + body, visible)


FAMILIES: dict[str, Family] = {"chair": chair, "display": display}


def _chair_base(
    visible: np.random.Generator,
    seat: tuple[float, float],
    heights: tuple[float, float],
    colour: np.ndarray,
) -> list[Solid]:
    (width, depth), (top, floor) = seat, heights
    z = _CHAIR_BACK_Z + depth / 2
    radius = visible.uniform(0.012, 0.03)
    splay = visible.uniform(0.0, 0.04)
    x, reach = width / 2 - radius - splay, depth / 2 - radius - splay
    corners = [(i * x, k * reach) for i in (-1, 1) for k in (-1, 1)]
    kind = visible.choice(["legs", "square legs", "sled", "pedestal", "panels", "block"])
    if kind == "legs":
        return [
            bar((a, top, z + b), (a + np.sign(a) * splay, floor, z + b + np.sign(b) * splay), radius, colour)
            for a, b in corners
        ]
    if kind == "square legs":
        size = (2 * radius, top - floor, 2 * radius)
        return [box(size, (a, (top + floor) / 2, z + b), colour) for a, b in corners]
    if kind == "sled":
        posts = [bar((a, top, z + b), (a, floor, z + b), radius, colour) for a, b in corners]
        runners = [
            bar((i * x, floor, z - reach - radius), (i * x, floor, z + reach + radius), radius, colour)
            for i in (-1, 1)
        ]
        return posts + runners
    if kind == "pedestal":
        arm = min(width, depth) * visible.uniform(0.4, 0.55)
        feet = [
            bar((0, floor + 0.03, z), (arm * np.sin(t), floor, z + arm * np.cos(t)), 0.016, colour)
            for t in np.arange(5) * 2 * np.pi / 5
        ]
        return [bar((0, top, z), (0, floor, z), max(radius, 0.02), colour), *feet]
    if kind == "panels":
        size = (visible.uniform(0.02, 0.05), top - floor, depth * visible.uniform(0.7, 1.0))
        return [box(size, (i * (width - size[0]) / 2, (top + floor) / 2, z), colour) for i in (-1, 1)]
    size = (width * visible.uniform(0.6, 0.98), top - floor, depth * visible.uniform(0.6, 0.98))
    return [box(size, (0, (top + floor) / 2, z), colour)]


def _chair_arms(
    visible: np.random.Generator,
    width: float,
    seat_top: float,
    z_range: tuple[float, float],
    colour: np.ndarray,
) -> list[Solid]:
    """No arms, both, or only one: from the far side, one that is there and one that is not look the same."""
    sides = [(), (-1, 1), (-1,), (1,)][visible.choice(4, p=[0.35, 0.35, 0.15, 0.15])]
    height, thickness = visible.uniform(0.1, 0.18), visible.uniform(0.025, 0.06)
    solid = visible.random() < 0.5
    back, front = z_range[0] + 0.01, z_range[1] - visible.uniform(0.0, 0.08)
    parts = []
    for side in sides:
        x = side * (width + thickness) / 2 - side * 0.01
        if solid:
            size = (thickness, height + 0.04, front - back)
            parts.append(box(size, (x, seat_top + height / 2 - 0.02, (back + front) / 2), colour))
            continue
        parts.append(
            box((thickness, 0.025, front - back), (x, seat_top + height, (back + front) / 2), colour)
        )
        parts.append(
            bar((x, seat_top - 0.02, front - 0.03), (x, seat_top + height, front - 0.03), 0.013, colour)
        )
    return parts


def _display_stand(
    visible: np.random.Generator, width: float, low: float, back_z: float, colour: np.ndarray
) -> list[Solid]:
    drop = visible.uniform(0.06, 0.2)
    floor = low - drop
    foot = (width * visible.uniform(0.35, 0.8), visible.uniform(0.015, 0.03), visible.uniform(0.14, 0.24))
    neck = (visible.uniform(0.05, 0.14), drop + 0.04, 0.03)
    kind = visible.choice(["pedestal", "feet", "column"])
    if kind == "feet":
        x = width * visible.uniform(0.25, 0.42)
        return [
            part
            for side in (-1, 1)
            for part in (
                box((0.03, drop + 0.03, 0.025), (side * x, floor + drop / 2 + 0.015, back_z + 0.012), colour),
                box((0.03, 0.02, foot[2]), (side * x, floor + 0.01, back_z), colour),
            )
        ]
    if kind == "column":
        size = (width * visible.uniform(0.5, 0.9), drop + 0.01, visible.uniform(0.05, 0.1))
        return [box(size, (0, floor + size[1] / 2, back_z), colour)]
    return [
        box(neck, (0, floor + neck[1] / 2, back_z + 0.02), colour),
        box(foot, (0, floor + foot[1] / 2, back_z), colour),
    ]


def _hidden_body(
    hidden: np.random.Generator,
    mode: int,
    *,
    depths: Sequence[float],
    front: tuple[float, float, float, float],
    colour: np.ndarray,
) -> list[Solid]:
    """A tapered body behind a front plate (width, low, high, z of its back), inside the plate's shadow.

    The shadow narrows by the slope of the sight line over the plate's edge; the slopes are those of the front
    views, with a margin, so that the body never shows beside or above the plate there.
    """
    jitter, fill_start, fill_end, lift = (
        hidden.uniform(0.93, 1.0),
        *hidden.uniform((0.92, 0.85, 0.2), (0.98, 1.0, 0.8)),
    )
    depth = depths[mode] * jitter
    if depth == 0:
        return []
    width, low, high, z = front
    eye_x = DISTANCE * np.sin(np.radians(FRONT_AZIMUTH_DEG + 2))
    eye_y = DISTANCE * np.sin(np.radians(FRONT_ELEVATION_DEG + 3))
    eye_z = DISTANCE * np.cos(np.radians(FRONT_AZIMUTH_DEG)) * np.cos(np.radians(FRONT_ELEVATION_DEG)) - z
    margin = 0.012
    end_width = width - 2 * margin - 2 * depth * max(eye_x - width / 2, 0) / eye_z
    end_high = high - margin - depth * max(eye_y - high, 0) / eye_z
    end_height = fill_end * 0.95 * (end_high - low - margin)
    start_height = fill_start * (high - low - 2 * margin)
    end_y = low + margin + end_height / 2 + lift * (end_high - low - margin - end_height)
    start_y = low + margin + start_height / 2 + lift * (high - low - 2 * margin - start_height)
    rings = [
        rectangle(fill_start * (width - 2 * margin), start_height, 0, start_y, z + 0.005),
        rectangle(fill_end * end_width, end_height, 0, end_y, z - depth),
    ]
    return [loft(rings, colour)]


def _colours(visible: np.random.Generator) -> list[np.ndarray]:
    """Main, second and body colour; the body's is a shade of the second, so it too is the visible stream's."""
    main, second = (
        np.array(
            colorsys.hsv_to_rgb(visible.random(), visible.uniform(0.1, 0.8), visible.uniform(0.35, 0.95))
        )
        for _ in range(2)
    )
    return [main, second, second * visible.uniform(0.45, 0.75)]


def _scaled(parts: list[Solid], visible: np.random.Generator) -> list[Solid]:
    factor = visible.uniform(0.78, 1.0)
    return [part.scaled(factor) for part in parts]
