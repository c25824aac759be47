"""Boats and ships: sailing, motor, rowing, cargo and war; the bow points to +z."""

from __future__ import annotations

import numpy as np

from train.data.families.design import Design, Family, fitted, hsv, metal, wood
from train.data.families.hull import Hull
from train.data.solids import Solid, bar, box, ellipsoid, frustum, loft, revolved, sheet, tube


def _design(visible: np.random.Generator) -> Design:
    kind = visible.choice(
        ["sail", "motor", "cargo", "war", "rowing", "catamaran"], p=[0.28, 0.24, 0.18, 0.12, 0.1, 0.08]
    )
    paint = wood(visible) if visible.random() < 0.25 else hsv(visible, (0, 1), (0.0, 0.8), (0.3, 0.95))
    house = hsv(visible, (0, 1), (0.0, 0.25), (0.6, 0.98))
    return fitted(_KINDS[kind](visible, paint, house), visible)


WATERCRAFT = Family(_design)


def _sail(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    hull = Hull(visible, beam=(0.2, 0.34), draught=(0.08, 0.15), transom=(0.3, 0.9))
    cloth, spar = hsv(visible, (0, 1), (0.0, 0.5), (0.75, 0.98)), wood(visible)
    parts = [hull.solid(paint), *hull.stripe(spar)]
    masts = (visible.uniform(0.0, 0.14),) if visible.random() < 0.75 else (0.2, visible.uniform(-0.2, -0.1))
    heading = visible.uniform(-0.12, 0.12)
    for number, z in enumerate(masts):
        tall = visible.uniform(0.75, 1.25) * (1 if number == 0 else 0.75)
        deck = hull.deck(z)
        parts.append(frustum((0, deck - 0.02, z), (0, deck + tall, z), (0.014, 0.007), spar))
        boom = deck + visible.uniform(0.08, 0.13)
        run = min(visible.uniform(0.32, 0.48), z + 0.52) if len(masts) == 1 else 0.28
        parts.append(bar((0, boom, z), (heading, boom, z - run), 0.009, spar))
        parts.append(
            sheet(
                (0, boom + 0.01, z - 0.01),
                (heading, boom + 0.01, z - run),
                (0, deck + tall * 0.97, z - 0.01),
                heading * 0.6,
                cloth,
            )
        )
    top = hull.deck(masts[0]) + visible.uniform(0.6, 0.75)
    if visible.random() < 0.8:  # a jib
        parts.append(
            sheet(
                (heading * 0.7, hull.deck(0) + 0.08, masts[0] + 0.04),
                (0, hull.deck(0.48) + 0.02, 0.48),
                (0, top, masts[0] + 0.02),
                heading * 0.5,
                cloth,
            )
        )
    if visible.random() < 0.6:
        parts.append(hull.house((-0.15, 0.12), visible.uniform(0.03, 0.07), house, share=0.6, slant=0.04))
    if visible.random() < 0.6:
        deep, chord = visible.uniform(0.08, 0.18), visible.uniform(0.08, 0.2)
        keel = hull.draught
        parts.append(box((0.02, deep + 0.03, chord), (0, -keel - deep / 2 + 0.015, 0.0), paint * 0.7))
        parts.append(box((0.014, deep * 0.7 + 0.06, 0.05), (0, -keel * 0.7 - deep * 0.3, -0.46), paint * 0.7))
    return parts


def _motor(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    hull = Hull(visible, beam=(0.26, 0.42), draught=(0.1, 0.18), transom=(0.75, 1.0))
    glass = hsv(visible, (0.5, 0.65), (0.2, 0.5), (0.15, 0.4))
    parts = [hull.solid(paint), *hull.stripe(house)]
    front, rear = visible.uniform(0.08, 0.28), visible.uniform(-0.38, -0.1)
    rise, slant = visible.uniform(0.06, 0.16), visible.uniform(0.02, 0.12)
    share = visible.uniform(0.6, 0.85)
    parts.append(hull.house((rear, front), rise, house, share=share, slant=slant))
    if rise > 0.09:
        parts.append(
            hull.house(
                (rear + 0.03, front - slant * 0.3),
                rise * 0.55,
                glass,
                share=share * 0.99,
                base=rise * 0.35,
                slant=slant,
            )
        )
    if visible.random() < 0.5:  # a flying bridge
        parts.append(
            hull.house(
                (rear + 0.05, front - slant - 0.08),
                visible.uniform(0.05, 0.1),
                house,
                share=share * 0.75,
                base=rise,
                slant=0.05,
            )
        )
    if visible.random() < 0.5:
        y = hull.deck(0) + rise
        parts.append(
            bar(
                (0, y - 0.02, rear + 0.12),
                (0, y + visible.uniform(0.1, 0.25), rear + 0.08),
                0.008,
                metal(visible),
            )
        )
    if visible.random() < 0.4:
        parts.append(box((0.07, 0.16, 0.07), (0, -0.02, -0.53), metal(visible)))
        parts.append(bar((0, -0.05, -0.53), (0, -hull.draught - 0.04, -0.53), 0.014, metal(visible)))
    return parts


def _cargo(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    hull = Hull(visible, beam=(0.14, 0.22), draught=(0.08, 0.14), transom=(0.8, 1.0))
    hull.fullness = visible.uniform(4, 9)
    parts = [hull.solid(paint)]
    aft = visible.uniform(-0.46, -0.36) if visible.random() < 0.75 else visible.uniform(-0.05, 0.28)
    tall = visible.uniform(0.08, 0.2)
    parts.append(hull.house((aft, aft + visible.uniform(0.06, 0.12)), tall, house, share=0.9))
    parts.append(hull.house((aft + 0.01, aft + 0.05), 0.03, house * 0.9, share=1.02, base=tall - 0.02))
    funnel = np.array((0, hull.deck(aft) + tall * 0.6, aft - 0.03 if aft < -0.3 else aft + 0.03))
    parts.append(
        frustum(funnel, funnel + (0, visible.uniform(0.08, 0.16), -0.01), (0.028, 0.022), hsv(visible))
    )
    spots = [z for z in np.arange(-0.44, 0.4, 0.095) if not aft - 0.05 < z < aft + 0.17]
    if visible.random() < 0.6:
        for z in spots:
            rows = visible.integers(0, 5)
            if rows:
                size = (1.75 * hull.half_beam(z + 0.045), 0.035 * rows, 0.085)
                parts.append(
                    box(
                        size,
                        (0, hull.deck(z) + size[1] / 2 - 0.012, z),
                        hsv(visible, (0, 1), (0.2, 0.8), (0.3, 0.8)),
                    )
                )
    else:
        for z in spots[::2]:
            deck, mast = hull.deck(z), visible.uniform(0.12, 0.2)
            parts.append(box((1.3 * hull.half_beam(z), 0.03, 0.1), (0, deck + 0.005, z), paint * 0.6))
            parts.append(bar((0, deck, z + 0.06), (0, deck + mast, z + 0.06), 0.009, house))
            parts.append(
                bar(
                    (0, deck + 0.03, z + 0.06),
                    (visible.uniform(-0.1, 0.1), deck + mast * 0.9, z - 0.05),
                    0.006,
                    house,
                )
            )
    return parts


def _war(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    grey = hsv(visible, (0.5, 0.65), (0.03, 0.2), (0.35, 0.7))
    hull = Hull(visible, beam=(0.1, 0.17), draught=(0.06, 0.1), transom=(0.6, 0.9))
    parts = [hull.solid(grey)]
    base, spans = 0.0, [(visible.uniform(-0.25, -0.1), visible.uniform(0.1, 0.2))]
    spans.append((spans[0][0] + 0.12, spans[0][1] - 0.03))
    for span, share in zip(spans, (0.8, 0.6), strict=True):
        rise = visible.uniform(0.04, 0.07)
        parts.append(hull.house(span, rise, grey * 0.95, share=share, base=base, slant=0.02))
        base += rise
    y = hull.deck(0) + base
    tall = visible.uniform(0.1, 0.22)
    parts += [
        frustum((0, y - 0.02, 0.04), (0, y + tall, 0.02), (0.016, 0.006), grey),
        bar((-0.05, y + tall * 0.7, 0.03), (0.05, y + tall * 0.7, 0.03), 0.006, grey),
    ]
    for z in (visible.uniform(-0.1, -0.03),) if visible.random() < 0.5 else (-0.04, -0.13):
        parts.append(frustum((0, y - 0.06, z), (0, y + 0.05, z - 0.012), (0.025, 0.021), grey * 0.7))
    for z, way in ((0.27, 1), (0.36, 1), (-0.36, -1))[visible.integers(0, 2) :]:
        deck, size = hull.deck(z), visible.uniform(0.022, 0.034)
        parts.append(
            revolved(
                [(size * 1.3, -0.01), (size * 1.2, 0.025), (size * 0.8, 0.035)],
                (0, deck, z),
                grey * 0.85,
                sides=8,
            )
        )
        guns = [
            bar((x, deck + 0.018, z), (x, deck + 0.035, z + way * 0.1), 0.005, grey * 0.6)
            for x in (-0.009, 0.009)
        ]
        parts += guns[: visible.integers(1, 3)]
    return parts


def _rowing(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    """An open boat: the inside is a darker deck below the rails; thwarts, sometimes oars."""
    hull = Hull(visible, beam=(0.2, 0.4), draught=(0.1, 0.18), transom=(0.05, 0.8))
    parts = [hull.solid(paint * 0.8)]
    z = np.linspace(-0.5, 0.47, 12)
    path = [(hull.half_beam(at), hull.deck(at) + 0.012, at) for at in z]
    rail = tube(path, [0.02] * len(z), paint, sides=8)
    parts += [rail, rail.mirrored()]
    for at in np.linspace(-0.32, 0.24, int(visible.integers(2, 5))):
        parts.append(
            box((1.9 * hull.half_beam(at), 0.016, 0.07), (0, hull.deck(at) + 0.018, at), wood(visible))
        )
    if visible.random() < 0.6:
        reach, lift = visible.uniform(0.2, 0.4), visible.uniform(-0.08, 0.1)
        at = visible.uniform(-0.1, 0.1)
        x, y = hull.half_beam(at), hull.deck(at) + 0.03
        blade = (x + reach, y + lift, at - 0.12)
        oar = [
            bar((x - 0.1, y, at + 0.03), blade, 0.009, house),
            ellipsoid((0.06, 0.012, 0.03), blade, house),
        ]
        parts += oar + [part.mirrored() for part in oar]
    return parts


def _catamaran(visible: np.random.Generator, paint: np.ndarray, house: np.ndarray) -> list[Solid]:
    hull = Hull(visible, beam=(0.09, 0.13), draught=(0.08, 0.13), transom=(0.6, 1.0))
    apart, solid = visible.uniform(0.14, 0.22), hull.solid(paint)
    deck = box((2 * apart, 0.03, visible.uniform(0.4, 0.62)), (0, 0.0, -0.08), house * 0.9)
    cabin = loft(
        [
            np.array(
                [(x * apart * w, y, z) for x, z in ((-1, -0.3), (1, -0.3), (1, 0.14 - cut), (-1, 0.14 - cut))]
            )
            for y, w, cut in ((0, 0.9, 0), (visible.uniform(0.06, 0.12), 0.75, 0.12))
        ],
        house,
    )
    parts = [solid.moved((-apart, 0, 0)), solid.moved((apart, 0, 0)), deck, cabin]
    if visible.random() < 0.65:
        tall, lean = visible.uniform(0.7, 1.1), visible.uniform(-0.1, 0.1)
        cloth = hsv(visible, (0, 1), (0.0, 0.4), (0.8, 0.98))
        parts.append(frustum((0, 0, 0.1), (0, tall, 0.1), (0.014, 0.008), metal(visible)))
        parts.append(sheet((0, 0.16, 0.09), (lean, 0.16, -0.35), (0, tall * 0.97, 0.09), lean * 0.6, cloth))
        parts.append(bar((0, 0.15, 0.1), (lean, 0.15, -0.35), 0.009, metal(visible)))
        parts.append(
            sheet((lean * 0.6, 0.1, 0.14), (0, 0.04, 0.46), (0, tall * 0.75, 0.12), lean * 0.5, cloth)
        )
    return parts


_KINDS = {
    "sail": _sail,
    "motor": _motor,
    "cargo": _cargo,
    "war": _war,
    "rowing": _rowing,
    "catamaran": _catamaran,
}
