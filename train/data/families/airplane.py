"""Airplanes: airliners, propeller craft, fighters and gliders; the nose points to +z."""

from __future__ import annotations

import dataclasses

import numpy as np

from train.data.families.design import Design, Family, fitted, hsv, metal
from train.data.solids import Point, Solid, body, box, ellipsoid, revolved, wing


@dataclasses.dataclass(frozen=True)
class _Kind:
    """Ranges that make a kind of airplane; lengths are shares of the fuselage's."""

    radius: tuple[float, float]
    half_span: tuple[float, float]
    sweep_deg: tuple[float, float]
    root_chord: tuple[float, float]
    taper: tuple[float, float]
    wing_z: tuple[float, float]
    engines: tuple[str, ...]
    nose: tuple[float, float]


_KINDS = {
    "airliner": _Kind((0.045, 0.07), (0.38, 0.56), (18, 36), (0.14, 0.22), (0.25, 0.45), (0.04, 0.12),
                      ("pods", "pods", "four pods", "tail"), (0.06, 0.12)),
    "propeller": _Kind((0.05, 0.085), (0.45, 0.68), (-2, 8), (0.14, 0.22), (0.5, 1.0), (0.08, 0.18),
                       ("nose", "nose", "wing propellers"), (0.08, 0.16)),
    "fighter": _Kind((0.04, 0.065), (0.22, 0.38), (35, 58), (0.3, 0.5), (0.1, 0.35), (-0.06, 0.04),
                     ("none", "twin"), (0.2, 0.34)),
    "glider": _Kind((0.03, 0.05), (0.65, 0.9), (-2, 4), (0.08, 0.12), (0.4, 0.7), (0.1, 0.2),
                    ("none",), (0.1, 0.16)),
}  # fmt: skip


def _design(visible: np.random.Generator) -> Design:
    name = visible.choice(list(_KINDS), p=[0.4, 0.28, 0.22, 0.1])
    kind = _KINDS[name]
    paint = hsv(visible, (0, 1), (0.0, 0.5), (0.55, 0.98))
    accent = hsv(visible, (0, 1), (0.3, 0.9), (0.3, 0.9))
    radius, nose = visible.uniform(*kind.radius), visible.uniform(*kind.nose)
    tall = visible.uniform(1.0, 1.25)  # the fuselage's height over its width
    parts = [_fuselage(visible, radius, nose, tall, paint), _canopy(visible, radius, nose, tall, name)]

    half_span, sweep = visible.uniform(*kind.half_span), np.radians(visible.uniform(*kind.sweep_deg))
    chord, taper = visible.uniform(*kind.root_chord), visible.uniform(*kind.taper)
    height = visible.choice([-0.7, 0.0, 0.85]) * radius * tall
    dihedral = np.tan(np.radians(visible.uniform(-3, 8)))
    root = np.array((0.0, height, visible.uniform(*kind.wing_z)))
    tip = root + (half_span, dihedral * half_span, -np.tan(sweep) * half_span)
    least = 0.012 * max(1.0, 2.2 * half_span)  # thinner ones would slip between the pixels of a small picture
    thickness = max(chord * visible.uniform(0.1, 0.16), 1.3 * least)
    panel = wing(
        root, tip, (chord, chord * taper), (thickness, max(thickness * taper * 0.8, least)), paint * 0.93
    )
    parts += [panel, panel.mirrored()]
    if visible.random() < 0.3 and name == "airliner":
        up = tip + (0.01, 0.05, -0.03)
        winglet = wing(tip, up, (chord * taper, chord * taper * 0.5), (0.012, 0.01), accent)
        parts += [winglet, winglet.mirrored()]
    parts += _tail(visible, radius, tall, paint, accent)
    engines = visible.choice(kind.engines)
    parts += _engines(visible, engines, radius, (root, tip, chord), accent)
    return fitted(parts, visible)


AIRPLANE = Family(_design)


def _fuselage(
    visible: np.random.Generator, radius: float, nose: float, tall: float, colour: np.ndarray
) -> Solid:
    """From the nose at z = 0.5 to the tail at -0.5, which is lifted."""
    tail, lift = visible.uniform(0.25, 0.45), visible.uniform(0.2, 0.9) * radius
    stations = []
    for share in (0.02, 0.2, 0.5, 0.8, 1.0):  # from the nose's tip to the full section
        size = radius * np.sqrt(1 - (1 - share) ** 2)
        stations.append((0.5 - nose * share, 2 * size, -size * tall * 0.95, size * tall * 0.85))
    for share in (0.0, 0.35, 0.7, 1.0):
        size = radius * (1 - 0.85 * share**1.4)
        middle = lift * share
        stations.append((-0.5 + tail * (1 - share), 2 * size, middle - size * tall, middle + size * tall))
    return body(stations, colour, squareness=visible.uniform(2.0, 2.8))


def _canopy(visible: np.random.Generator, radius: float, nose: float, tall: float, kind: str) -> Solid:
    glass = hsv(visible, (0.5, 0.65), (0.2, 0.6), (0.15, 0.45))
    if kind == "airliner":
        return ellipsoid(
            (radius * 0.75, radius * 0.35, nose * 0.3), (0, radius * tall * 0.5, 0.5 - nose * 0.6), glass
        )
    long = visible.uniform(0.07, 0.13)
    return ellipsoid(
        (radius * 0.65, radius * 0.75, long), (0, radius * tall * 0.75, 0.5 - nose - long * 0.7), glass
    )


def _tail(
    visible: np.random.Generator, radius: float, tall: float, paint: np.ndarray, accent: np.ndarray
) -> list[Solid]:
    """A fin with the tailplane at its foot or on its top, or two fins leaning out."""
    chord, height = visible.uniform(0.09, 0.16), visible.uniform(0.1, 0.19)
    slant = height * np.tan(np.radians(visible.uniform(10, 50)))
    top = radius * tall * 0.5
    span, back = visible.uniform(0.12, 0.22), visible.uniform(0.02, 0.12)
    kind = visible.choice(["low", "low", "T", "V"])
    if kind == "V":
        root, tip = (
            np.array((radius * 0.3, top, -0.4)),
            np.array((span * 0.7, top + height * 0.8, -0.4 - slant)),
        )
        fin = wing(root, tip, (chord, chord * 0.5), (0.017, 0.012), accent)
        return [fin, fin.mirrored()]
    root = np.array((0, top, -0.4))
    tip = root + (0, height, -slant)
    fin = wing(root, tip, (chord, chord * 0.55), (0.018, 0.012), accent)
    at = tip - (0, 0.008, 0) if kind == "T" else np.array((0, top, -0.44))
    plane = wing(at, at + (span, 0.01, -back), (chord * 0.75, chord * 0.4), (0.017, 0.012), paint * 0.93)
    return [fin, plane, plane.mirrored()]


def _engines(
    visible: np.random.Generator,
    kind: str,
    radius: float,
    surfaces: tuple[np.ndarray, np.ndarray, float],
    colour: np.ndarray,
) -> list[Solid]:
    root, tip, chord = surfaces
    size, long = radius * visible.uniform(0.45, 0.7), visible.uniform(0.1, 0.17)
    dark = metal(visible)
    if kind == "none":
        return []
    if kind == "nose":
        return _propeller(visible, np.array((0, 0, 0.5)), radius, dark)
    if kind == "twin":
        pod = _nacelle((radius * 0.75, -radius * 0.2, -0.36), size, 0.24, dark)
        return [pod, pod.mirrored()]
    if kind == "tail":
        pod = _nacelle((radius * 1.0 + size, radius * 0.5, -0.26), size, long, colour)
        pylon = box((size + radius, 0.012, long * 0.5), ((size + radius) / 2, radius * 0.5, -0.27), dark)
        return [pod, pylon, pod.mirrored(), pylon.mirrored()]
    parts = []
    for share in {"four pods": (0.3, 0.6)}.get(kind, (visible.uniform(0.28, 0.42),)):
        at = root + share * (tip - root)
        if kind == "wing propellers":
            pod = _nacelle(at + (0, 0, chord * 0.2), size * 0.7, long * 1.3, colour)
            blades = _propeller(visible, at + (0, 0, chord * 0.2 + long * 0.65), size * 0.5, dark)
            parts += [pod, pod.mirrored(), *blades, *(blade.mirrored() for blade in blades)]
            continue
        hung = at + (0, -size * 1.25, chord * 0.35)
        pod = _nacelle(hung, size, long, colour)
        pylon = box((0.012, size * 1.2, long * 0.6), hung + (0, size * 0.7, -long * 0.2), dark)
        parts += [pod, pod.mirrored(), pylon, pylon.mirrored()]
    return parts


def _nacelle(centre: Point, radius: float, long: float, colour: np.ndarray) -> Solid:
    profile = [(0.62, -0.5), (0.9, -0.25), (1.0, 0.1), (0.98, 0.4), (0.85, 0.5)]
    scaled = [(r * radius, z * long) for r, z in profile]
    return revolved(scaled, centre, colour, axis=(0, 0, 1), sides=14)


def _propeller(
    visible: np.random.Generator, hub: np.ndarray, radius: float, colour: np.ndarray
) -> list[Solid]:
    """A spinner and its blades."""
    cone = revolved([(radius * 0.5, -0.02), (radius * 0.4, 0.02), (0.004, 0.06)], hub, colour, axis=(0, 0, 1))
    count, long = int(visible.integers(2, 5)), max(radius, 0.04) * visible.uniform(1.6, 2.4)
    blade = box((0.022, 2 * long if count % 2 == 0 else long, 0.012), (0, 0, 0.012), colour)
    if count % 2:
        blade = blade.moved((0, long / 2, 0))
    turns = count // 2 if count % 2 == 0 else count
    step = 180 / turns if count % 2 == 0 else 360 / turns
    phase = visible.uniform(0, 180)
    return [cone] + [blade.turned("z", phase + k * step).moved(hub) for k in range(turns)]
