"""`Family`, a kind of procedural object: a front drawn from one random stream, and backs drawn from another.

World units, y up, the front at +z. Nothing is scaled by the extent of hidden parts: the image's scale would reveal it.
"""

from __future__ import annotations

import colorsys
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from train.data.render import DISTANCE
from train.data.solids import Solid, loft, oval

MODES = 3
"""Hidden modes of a family with designed ambiguity: flat, medium, deep."""


@dataclasses.dataclass(frozen=True)
class Cone:
    """The front views: azimuth within +-`azimuth_deg` of the front, at `elevation_deg`."""

    azimuth_deg: float
    elevation_deg: float

    @property
    def eye(self) -> tuple[float, float, float]:
        """A camera position slightly outside of the cone, for a margin."""
        azimuth, elevation = np.radians(self.azimuth_deg), np.radians(self.elevation_deg)
        return (
            DISTANCE * np.sin(azimuth + np.radians(2)),
            DISTANCE * np.sin(elevation + np.radians(3)),
            DISTANCE * np.cos(azimuth) * np.cos(elevation),
        )


@dataclasses.dataclass(frozen=True)
class Design:
    """One object, as the visible stream has drawn it.

    Attributes:
        parts: everything that is visible from the front.
        back: draws the parts behind, from the hidden stream and the mode; None for families without designed ambiguity.
        scale: of the whole, about the origin.
    """

    parts: list[Solid]
    back: Callable[[np.random.Generator, int], list[Solid]] | None = None
    scale: float = 1.0

    def solids(self, hidden: np.random.Generator, mode: int) -> list[Solid]:
        """The object with one of its backs."""
        behind = self.back(hidden, mode) if self.back else []
        return [part.scaled(self.scale) for part in (*self.parts, *behind)]


@dataclasses.dataclass(frozen=True)
class Family:
    """A category: draws designs from the visible stream.

    Attributes:
        design: one object from a random generator, which also decides every colour.
        cone: the views from which the front hides the back; None for families without designed ambiguity.
    """

    design: Callable[[np.random.Generator], Design]
    cone: Cone | None = None

    @property
    def modes(self) -> int:
        """How many backs belong to one front."""
        return MODES if self.cone else 1


@dataclasses.dataclass(frozen=True)
class Plate:
    """A solid front, and the region behind it that it hides from all cameras of a cone (its "shadow").

    Attributes:
        width: along x, centred at x = 0.
        low, high: along y.
        z: of its back.
        cone: the positions of the cameras.
    """

    width: float
    low: float
    high: float
    z: float
    cone: Cone

    margin = 0.012

    def shadow(self, depth: float) -> tuple[float, float, float]:
        """Width, low and high of the hidden region at `depth` behind the plate.

        It narrows by the slope of the sight line over the plate's edge.
        """
        eye_x, eye_y, eye_z = self.cone.eye
        reach = depth / (eye_z - self.z)
        width = self.width - 2 * self.margin - 2 * reach * max(eye_x - self.width / 2, 0)
        return width, self.low + self.margin, self.high - self.margin - reach * max(eye_y - self.high, 0)


SHARP = 60.0
"""The squareness of a section that looks like a rectangle."""


def shadow_body(
    hidden: np.random.Generator,
    depth: float,
    plate: Plate,
    colour: np.ndarray,
    *,
    squareness: float = SHARP,
    sections: Sequence[float] = (2.3, 3.5, 6.0, SHARP),
    stands: bool = False,
    tall: float = 1.0,
) -> list[Solid]:
    """A tapered body behind a plate and hidden by it; no body if the depth is 0.

    Args:
        hidden: draws size and taper.
        depth: its length, at most.
        plate: the front that hides it.
        colour: of the body.
        squareness: of the plate's outline, which the body must not exceed.
        sections: squareness of the body, one of these.
        stands: the body stands at the height of the plate's lower edge.
        tall: the body's height, as a share of the shadow's.
    """
    if depth == 0:
        return []
    depth *= hidden.uniform(0.93, 1.0)
    fill_start, fill_end, lift = hidden.uniform((0.92, 0.85, 0.2), (0.98, 1.0, 0.8))
    bulge = hidden.uniform(0.0, 1.0)  # 0 tapers straight, 1 keeps its width for longer
    section = min(squareness, hidden.choice(sections))
    rings = []
    for share in (0.0, 0.35, 0.7, 1.0):
        at = share * depth
        width, low, high = plate.shadow(at)
        taper = share ** (1 + 2 * bulge)
        fill_x = fill_start + (fill_end - fill_start) * taper
        fill_y = fill_start + (0.95 * fill_end - fill_start) * taper
        height = tall * fill_y * (high - low)
        middle = low + height / 2 + (0 if stands else lift) * (high - low - height)
        z = plate.z + 0.005 if share == 0 else plate.z - at
        rings.append(oval(fill_x * width, height, (0, middle, z), squareness=section))
    return [loft(rings, colour)]


def colours(visible: np.random.Generator) -> list[np.ndarray]:
    """Main, second and body colour; the body's is a shade of the second, so the hidden stream draws no colour."""
    main, second = (
        np.array(
            colorsys.hsv_to_rgb(visible.random(), visible.uniform(0.1, 0.8), visible.uniform(0.35, 0.95))
        )
        for _ in range(2)
    )
    return [main, second, second * visible.uniform(0.45, 0.75)]


def hsv(
    visible: np.random.Generator,
    hue: tuple[float, float] = (0, 1),
    saturation: tuple[float, float] = (0.1, 0.8),
    value: tuple[float, float] = (0.35, 0.95),
) -> np.ndarray:
    """A colour within the given ranges."""
    return np.array(colorsys.hsv_to_rgb(*(visible.uniform(*each) for each in (hue, saturation, value))))


def wood(visible: np.random.Generator) -> np.ndarray:
    """A brown between beech and wenge."""
    return hsv(visible, (0.05, 0.11), (0.3, 0.75), (0.25, 0.85))


def metal(visible: np.random.Generator) -> np.ndarray:
    """A grey, from black steel to chrome."""
    return hsv(visible, (0.55, 0.65), (0.0, 0.12), (0.12, 0.85))


def fitted(parts: Sequence[Solid], visible: np.random.Generator) -> Design:
    """A design without hidden parts: centred, its bounding box's diagonal just below 1."""
    vertices = np.concatenate([part.vertices for part in parts])
    low, high = vertices.min(0), vertices.max(0)
    scale = visible.uniform(0.85, 1.0) / np.linalg.norm(high - low)
    return Design([part.moved(-(low + high) / 2) for part in parts], scale=scale)
