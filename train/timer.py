"""Where a training step's time goes."""

from __future__ import annotations

import time
from collections import defaultdict

from torch import Tensor


class Laps:
    """A stopwatch that books the time since its last stop under a name.

    The backward pass runs through all parts of a step in one call; `on_the_way_back` puts stops into it.
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forgets everything."""
        self._total: defaultdict[str, float] = defaultdict(float)
        self._recent: defaultdict[str, float] = defaultdict(float)
        self._steps = self._recent_steps = 0
        self._last = time.perf_counter()

    def stop(self, name: str) -> None:
        """Books the time since the last stop under `name`."""
        now = time.perf_counter()
        self._recent[name] += now - self._last
        self._last = now

    def skip(self) -> None:
        """Forgets the time since the last stop: validation, pictures and checkpoints belong to no step."""
        self._last = time.perf_counter()

    def on_the_way_back(self, tensor: Tensor, name: str) -> Tensor:
        """The same tensor; when its gradient is known, the backward pass up to there is booked under `name`."""
        tensor = tensor.view_as(tensor)
        if tensor.requires_grad:
            tensor.register_hook(lambda _: self.stop(name))
        return tensor

    def end_step(self) -> None:
        """Counts a step."""
        self._recent_steps += 1

    def read(self) -> dict[str, float]:
        """Since the last reading: seconds per step, the same by name, and the share spent waiting for data."""
        steps, total = max(1, self._recent_steps), max(sum(self._recent.values()), 1e-9)
        values = {"seconds_per_step": total / steps, "data_wait_share": self._recent["data"] / total}
        values |= {f"{name}_seconds": value / steps for name, value in self._recent.items()}
        for name, value in self._recent.items():
            self._total[name] += value
        self._steps += self._recent_steps
        self._recent, self._recent_steps = defaultdict(float), 0
        return values

    def summary(self) -> str:
        """Seconds per step and their breakdown since the beginning."""
        self.read()
        steps = max(1, self._steps)
        longest_first = sorted(self._total.items(), key=lambda item: -item[1])
        parts = ", ".join(f"{name} {value / steps:.3f}" for name, value in longest_first)
        return f"{self._steps} steps here, {sum(self._total.values()) / steps:.3f} s each ({parts})"
