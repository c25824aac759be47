"""The paper's thirteen ShapeNet categories and their WordNet synsets."""

from __future__ import annotations

import re

SYNSET_OF = {
    "airplane": "02691156",
    "bench": "02828884",
    "cabinet": "02933112",
    "car": "02958343",
    "chair": "03001627",
    "display": "03211117",
    "lamp": "03636649",
    "loudspeaker": "03691459",
    "rifle": "04090263",
    "sofa": "04256520",
    "table": "04379243",
    "telephone": "04401088",
    "watercraft": "04530566",
}
CATEGORY_OF = {synset: category for category, synset in SYNSET_OF.items()}
UNKNOWN = "unknown"


def synset_of(category: str) -> str:
    """The folder name of a category: its synset, or for other categories their name in safe characters."""
    return SYNSET_OF.get(category) or re.sub(r"[^A-Za-z0-9-]+", "_", category).strip("_") or UNKNOWN


def category_of(synset: str) -> str:
    """The category of a folder name; a name that is no synset is its own category."""
    return CATEGORY_OF.get(synset, synset)
