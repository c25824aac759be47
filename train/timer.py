"""Where a training step's time goes."""

from __future__ import annotations

import time
from collections import defaultdict

from torch import Tensor


class Timer:
    """Adds up where the time of training steps goes: each mark assigns the time since the last one to a name.

    The backward pass runs through all parts of a step in one call; `mark_in_backward` puts marks into it.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Starts again from zero."""
        self._total: defaultdict[str, float] = defaultdict(float)
        self._recent: defaultdict[str, float] = defaultdict(float)
        self._steps = self._recent_steps = 0
        self._last = time.perf_counter()

    def mark(self, name: str) -> None:
        """Adds the time since the last mark to `name`."""
        now = time.perf_counter()
        self._recent[name] += now - self._last
        self._last = now

    def skip(self) -> None:
        """Drops the time since the last mark: validation, pictures and checkpoints are not part of a step."""
        self._last = time.perf_counter()

    def mark_in_backward(self, tensor: Tensor, name: str) -> Tensor:
        """The same tensor; when the backward pass has computed its gradient, the time so far is added to `name`."""
        tensor = tensor.view_as(tensor)
        if tensor.requires_grad:
            tensor.register_hook(lambda _: self.mark(name))
        return tensor

    def end_step(self) -> None:
        """Counts a step."""
        self._recent_steps += 1

    def read(self) -> dict[str, float]:
        """Since the last reading: seconds per step, in all and by name, and the share spent waiting for data."""
        steps, total = max(1, self._recent_steps), max(sum(self._recent.values()), 1e-9)
        values = {"seconds_per_step": total / steps, "data_wait_share": self._recent["data"] / total}
        values |= {f"{name}_seconds": value / steps for name, value in self._recent.items()}
        for name, value in self._recent.items():
            self._total[name] += value
        self._steps += self._recent_steps
        self._recent, self._recent_steps = defaultdict(float), 0
        return values

    def summary(self) -> str:
        """Seconds per step and their breakdown since the last `reset`."""
        self.read()
        steps = max(1, self._steps)
        longest_first = sorted(self._total.items(), key=lambda item: -item[1])
        parts = ", ".join(f"{name} {value / steps:.3f}" for name, value in longest_first)
        return f"{self._steps} steps, {sum(self._total.values()) / steps:.3f} s each ({parts})"
