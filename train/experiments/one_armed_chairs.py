"""Procedural chairs with one arm removed, and two views of each: only the second shows that it is missing.

A chair is drawn with two arms and one is removed; the rest is a chair as the family draws it with one arm. View A shows
the arm that stays, with the place of the other hidden behind it or behind the back; view B is from the front, on the
other side. (Of the family's chairs that have an arm on one side, seven in ten have the other arm too.)
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, get_args

import numpy as np

from diffpoint import PinholeCamera
from train.data.families import MODES
from train.data.procedural import variants_of
from train.data.render import Renderer, Views, orbit_camera
from train.data.solids import Solid, sample_union, surface_of

Side = Literal[-1, 1]
"""Of the seat, along x."""
Arms = Literal["one", "both", "none"]

SEED = 20_190_616
"""First number of these chairs' seeds. Trees are made with `--seed`, which is 0, 1, ...: none holds one of them."""
HIDDEN, SHOWN = 0.001, 0.03
"""Share of the object's pixels that change when an arm is taken away: at most, where it counts as hidden, and at least,
where it counts as shown."""
LEAST_SHARE = 0.02
"""An arm has at least this share of the chair's points in its box: with less, 512 points are too few to measure it."""
_MARGIN, _GAP, _INWARD = 0.05, 0.02, 0.6  # world units, and a share: see `arm_box`
RULES = (HIDDEN, SHOWN, LEAST_SHARE, _MARGIN, _GAP, _INWARD)
"""All constants that decide which chairs these are, and where their arms are counted."""
_RISE = 0.05  # world units above the seat: less than any arm, more than what else stands beside the middle
_A_DEG = range(60, 141, 10), (-15, -5, 5, 15, 25)  # azimuths and elevations that A and B are chosen from
_B_DEG = range(30, 61, 10), (15, 25)
_PICTURE = 80  # pixels of a side, for finding views
_VISIBLE = 8  # steps of 255
_DENSE = 16_384


@dataclasses.dataclass(frozen=True)
class OneArmedChair:
    """A chair with one arm, and the same with both and with none.

    Attributes:
        seed: as `variants_of` takes it.
        side: of the arm that stays.
        solids: of the chair with one arm, with both, and with none.
        boxes: (2, 2, 3), where the missing and the present arm would be counted: lowest and highest corner.
        shares: (2,) of the points on the chair with two arms in the box of the missing arm; of those on the chair with
            one in the box of the present one.
        view_deg: (2, 2) azimuths and elevations of views A and B.
        changed: (2,) share of the object's pixels in A and B that change when the arm is taken away.
    """

    seed: tuple[int, int]
    side: Side
    solids: Mapping[Arms, Sequence[Solid]]
    boxes: np.ndarray
    shares: np.ndarray
    view_deg: np.ndarray
    changed: np.ndarray

    def cameras(self, size: int) -> PinholeCamera:
        """Of views A and B (2,), for pictures of `size` pixels a side."""
        return orbit_camera(self.view_deg[0], self.view_deg[1], size)

    def images(self, size: int, arms: Arms = "one") -> np.ndarray:
        """Views A and B (2, size, size, 3) uint8."""
        return Renderer(surface_of(self.solids[arms])).render(self.cameras(size)).images

    def samples(self, count: int, arms: Arms = "one") -> np.ndarray:
        """(count, 3) points on the surface."""
        return sample_union(self.solids[arms], count, np.random.default_rng([*self.seed, 1]))


def one_armed_chairs() -> Iterator[OneArmedChair]:
    """Chair after chair, the same ones every time; the arm that stays is on the right and on the left in turns."""
    found = 0
    for number in itertools.count():
        chair = make_chair((SEED, number), 1 if found % 2 else -1)
        if chair is not None:
            found += 1
            yield chair


def make_chair(seed: tuple[int, int], side: Side) -> OneArmedChair | None:
    """The chair of a seed without its arm opposite to `side`.

    None if it has not both arms, or too little of an arm in its box, or if no view hides the arm and shows the other.
    """
    both = variants_of("chair", seed)[seed[1] % MODES]
    present, missing = arm_of(both, side), arm_of(both, -side)
    if not present or not missing:
        return None
    solids: dict[Arms, list[Solid]] = {
        "one": without(both, missing),
        "both": both,
        "none": without(both, [*present, *missing]),
    }
    boxes = np.stack([arm_box(arm, solids["none"]) for arm in (missing, present)])
    rng = np.random.default_rng(seed)
    samples = [sample_union(solids[arms], _DENSE, rng) for arms in ("both", "one")]
    shares = np.array([inside(points, box).mean() for points, box in zip(samples, boxes, strict=True)])
    if shares.min() < LEAST_SHARE:
        return None
    views = _find_views(solids, side)
    return views and OneArmedChair(seed, side, solids, boxes, shares, *views)


def arm_of(solids: Sequence[Solid], side: Side) -> list[Solid]:
    """The solids of a chair's arm: beside the middle, and rising above the seat, which is the chair's first part.

    Back, shell and cushion stand across the middle; legs, panels and runners end at the seat.
    """
    seat = solids[0].vertices[:, 1].max()
    return [
        solid
        for solid in solids
        if (side * solid.vertices[:, 0]).min() > 0 and solid.vertices[:, 1].max() > seat + _RISE
    ]


def without(solids: Sequence[Solid], left_out: Sequence[Solid]) -> list[Solid]:
    """The solids but for some of them."""
    gone = set(map(id, left_out))
    return [solid for solid in solids if id(solid) not in gone]


def arm_box(arm: Sequence[Solid], rest: Sequence[Solid]) -> np.ndarray:
    """(2, 3) lowest and highest corner of the box in which points count for an arm.

    It is the arm's bounding box with a margin of 0.05 for inaccurate points. Towards the middle it reaches farther, to
    0.6 of the arm's distance, because predicted chairs are often too narrow. It ends 0.02 above seat and cushion
    and 0.02 in front of the back: a chair without this arm has nothing there.

    Args:
        arm: its solids, on one side of the middle.
        rest: those of the chair without arms.
    """
    vertices = np.concatenate([solid.vertices for solid in arm])
    low, high = vertices.min(0) - _MARGIN, vertices.max(0) + _MARGIN
    if vertices[0, 0] > 0:
        low[0] = _INWARD * vertices[:, 0].min()
    else:
        high[0] = _INWARD * vertices[:, 0].max()
    middle = (rest[0].vertices[:, 1].max() + vertices[:, 1].max()) / 2
    tops = [solid.vertices[:, 1].max() for solid in rest]
    low[1] = max(top for top in tops if top < middle) + _GAP
    low[2] = max(s.vertices[:, 2].max() for s, top in zip(rest, tops, strict=True) if top >= middle) + _GAP
    return np.stack((low, high))


def inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(..., N) bool: which points (..., N, 3) are in a box (2, 3)."""
    return ((points > box[0]) & (points < box[1])).all(-1)


def _find_views(solids: Mapping[Arms, Sequence[Solid]], side: Side) -> tuple[np.ndarray, np.ndarray] | None:
    """Azimuths and elevations of A and B (2, 2), and changed shares (2,); None if nothing hides the arm and shows the
    other.

    Of the views that are suitable as A, the one farthest from the side, from where the width cannot be seen.
    """
    from_side = np.array(list(itertools.product(*_A_DEG))).T * ((side,), (1,))
    from_front = np.array(list(itertools.product(*_B_DEG))).T * ((-side,), (1,))
    one, both, none = (_render(solids[arms], from_side) for arms in get_args(Arms))
    hidden, shown = _changed(both, one), _changed(one, none)
    revealed = _changed(*(_render(solids[arms], from_front) for arms in ("both", "one")))
    usable = (hidden <= HIDDEN) & (shown >= SHOWN)
    if not usable.any() or revealed.max() < SHOWN:
        return None
    oblique = np.abs(np.cos(np.radians(from_side[0]))).round(6)
    usable &= oblique == oblique[usable].max()
    a, b = int(np.where(usable, shown, 0).argmax()), int(revealed.argmax())
    view_deg = np.stack((from_side[:, a], from_front[:, b]), 1).astype(float)
    return view_deg, np.array([hidden[a], revealed[b]])


def _render(solids: Sequence[Solid], view_deg: np.ndarray) -> Views:
    return Renderer(surface_of(solids)).render(orbit_camera(view_deg[0], view_deg[1], _PICTURE))


def _changed(a: Views, b: Views) -> np.ndarray:
    """(V,) share of the pixels covered by either object where the pictures visibly differ."""
    seen = np.isfinite(a.depth) | np.isfinite(b.depth)
    differs = np.abs(a.images.astype(int) - b.images).max(-1) > _VISIBLE
    return (differs & seen).sum((1, 2)) / seen.sum((1, 2))
