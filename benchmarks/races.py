"""All races: every op at the sizes of the paper's training step, and every installed peer."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks import distances, losses, matching, rendering
from benchmarks.harness import Race


def races() -> Iterator[Race]:
    for module in (distances, rendering, matching, losses):
        yield from module.races()
