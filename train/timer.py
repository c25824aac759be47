"""Where a training step's time goes."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import torch
from torch import Tensor

from train.device import CPU

_MOST_OPEN_MARKS = 1000


class Timer:
    """Adds up where the time of training steps goes: each mark assigns the time since the last one to a name.

    The backward pass runs through all parts of a step in one call; `mark_in_backward` puts marks into it.

    Args:
        device: of the step. A GPU works behind the program that feeds it: there marks are events in its queue, and the
            times are its own. Only reading them waits for it.
    """

    def __init__(self, device: torch.device = CPU) -> None:
        self._clock: _Clock = _GPUClock(device) if device.type == "cuda" else _Clock()
        self.reset()

    def reset(self) -> None:
        """Starts again from zero."""
        self._total: defaultdict[str, float] = defaultdict(float)
        self._recent: defaultdict[str, float] = defaultdict(float)
        self._open: list[tuple[str, Any, Any]] = []
        self._steps = self._recent_steps = 0
        self._last = self._clock.now()

    def mark(self, name: str) -> None:
        """Adds the time since the last mark to `name`."""
        now = self._clock.now()
        self._open.append((name, self._last, now))
        self._last = now

    def skip(self) -> None:
        """Drops the time since the last mark: validation, pictures and checkpoints are not part of a step."""
        self._last = self._clock.now()

    def mark_in_backward(self, tensor: Tensor, name: str) -> Tensor:
        """The same tensor; when the backward pass has computed its gradient, the time so far is added to `name`."""
        tensor = tensor.view_as(tensor)
        if tensor.requires_grad:
            tensor.register_hook(lambda _: self.mark(name))
        return tensor

    def end_step(self) -> None:
        """Counts a step."""
        self._recent_steps += 1
        if len(self._open) >= _MOST_OPEN_MARKS:  # nobody reads
            self._add_up()

    def read(self) -> dict[str, float]:
        """Since the last reading: seconds per step, in all and by name, and the share spent waiting for data."""
        self._add_up()
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

    def _add_up(self) -> None:
        for name, start, end in self._open:
            self._recent[name] += self._clock.seconds(start, end)
        self._open = []


class _Clock:
    """Of the program."""

    def now(self) -> Any:
        return time.perf_counter()

    def seconds(self, start: Any, end: Any) -> float:
        return end - start


class _GPUClock(_Clock):
    """Of a GPU's queue: a moment is an event that the GPU passes in its turn."""

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def now(self) -> Any:
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    def seconds(self, start: Any, end: Any) -> float:
        end.synchronize()
        return start.elapsed_time(end) / 1e3
