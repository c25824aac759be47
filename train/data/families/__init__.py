"""The thirteen procedural families, under the paper's category names."""

from __future__ import annotations

from train.data.families.airplane import AIRPLANE
from train.data.families.bench import BENCH
from train.data.families.cabinet import CABINET
from train.data.families.car import CAR
from train.data.families.chair import CHAIR
from train.data.families.design import MODES, Cone, Design, Family
from train.data.families.display import DISPLAY
from train.data.families.lamp import LAMP
from train.data.families.loudspeaker import LOUDSPEAKER
from train.data.families.rifle import RIFLE
from train.data.families.sofa import SOFA
from train.data.families.table import TABLE
from train.data.families.telephone import TELEPHONE
from train.data.families.watercraft import WATERCRAFT

FAMILIES: dict[str, Family] = {
    "chair": CHAIR,
    "display": DISPLAY,
    "loudspeaker": LOUDSPEAKER,
    "cabinet": CABINET,
    "sofa": SOFA,
    "table": TABLE,
    "car": CAR,
    "airplane": AIRPLANE,
    "bench": BENCH,
    "lamp": LAMP,
    "rifle": RIFLE,
    "telephone": TELEPHONE,
    "watercraft": WATERCRAFT,
}
"""In the order in which they were added: the random stream of an object is seeded with its family's number."""

AMBIGUOUS = tuple(name for name, family in FAMILIES.items() if family.cone)
"""The families whose front hides one of several backs."""

__all__ = ["AMBIGUOUS", "FAMILIES", "MODES", "Cone", "Design", "Family"]
