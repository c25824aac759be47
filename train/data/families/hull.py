"""The hull of a boat, its deck, and what stands on it."""

from __future__ import annotations

import numpy as np

from train.data.solids import Solid, loft, tube


class Hull:
    """A hull from z = -0.5 to 0.5 with its deck near y = 0.

    Args:
        visible: decides the lines within the ranges.
        beam: range of the width.
        draught: range of the depth below the deck.
        transom: range of the stern's width, as a share of the beam.
    """

    def __init__(
        self,
        visible: np.random.Generator,
        *,
        beam: tuple[float, float],
        draught: tuple[float, float],
        transom: tuple[float, float] = (0.5, 0.9),
    ) -> None:
        self.beam, self.draught = visible.uniform(*beam), visible.uniform(*draught)
        self.transom, self.fullness = visible.uniform(*transom), visible.uniform(1.6, 3.2)
        self.sheer, self.rake = visible.uniform(0.1, 0.6) * self.draught, visible.uniform(0.0, 0.12)
        self.flat = visible.uniform(0.15, 0.6)  # of the bottom, as a share of the beam

    def half_beam(self, z: float) -> float:
        """Half the deck's width at z."""
        ahead = max(z, 0.0) / 0.5
        behind = max(-z, 0.0) / 0.5
        return self.beam / 2 * (1 - ahead**self.fullness) * (1 - (1 - self.transom) * behind**2)

    def deck(self, z: float) -> float:
        """Height of the deck at z: it rises towards the bow."""
        return self.sheer * max(z + 0.1, 0.0) ** 2 / 0.36 + 0.15 * self.sheer * max(-z - 0.2, 0) / 0.3

    def solid(self, colour: np.ndarray) -> Solid:
        rings = []
        for z in np.concatenate((np.linspace(-0.5, 0.3, 7), (0.38, 0.44, 0.48, 0.5))):
            half, top = max(self.half_beam(z), 0.003), self.deck(z)
            ahead = max(z, 0.0) / 0.5
            keel = -self.draught * (1 - 0.75 * ahead**4)
            sections = (
                (1.0, top),
                (0.94, top + 0.4 * (keel - top)),
                (self.flat + 0.25, top + 0.8 * (keel - top)),
                (self.flat * 0.5, keel),
            )
            right = np.array(
                [
                    (half * min(s, 1.0), y, z + self.rake * ahead**3 * (y - keel) / self.draught)
                    for s, y in sections
                ]
            )
            rings.append(np.concatenate((right, right[::-1] * (-1, 1, 1))))
        return loft(rings, colour)

    def stripe(self, colour: np.ndarray) -> list[Solid]:
        """A rubbing strake along both sides of the deck."""
        z = np.linspace(-0.5, 0.46, 12)
        path = [(self.half_beam(at), self.deck(at) - 0.006, at) for at in z]
        rail = tube(path, [0.009] * len(z), colour, sides=6)
        return [rail, rail.mirrored()]

    def house(
        self,
        z: tuple[float, float],
        rise: float,
        colour: np.ndarray,
        *,
        share: float = 0.7,
        base: float = 0.0,
        slant: float = 0.0,
    ) -> Solid:
        """A deckhouse between two z, as wide as a share of the deck, its ends slanted."""
        rear, front = z
        low = min(self.deck(rear), self.deck(front)) - 0.02 + base
        high = max(self.deck(rear), self.deck(front)) + base + rise
        wide = [2 * share * self.half_beam(at) for at in z]
        corners = np.array([(-1, rear, 0), (1, rear, 0), (1, front, 1), (-1, front, 1)])
        rings = []
        for y, cut, narrow in ((low, 0.0, 1.0), (high, slant, 0.92)):
            rings.append(
                np.array([
                    (side * wide[int(end)] / 2 * narrow, y, at + (cut * 0.4 if end == 0 else -cut))
                    for side, at, end in corners
                ])
            )  # fmt: skip
        return loft(rings, colour)
