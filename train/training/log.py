"""The record of a run: metrics.jsonl for programs, TensorBoard events for people, a bar for whoever waits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from train.evaluation.runs import complete_lines
from train.files import write_text


class RunLog:
    """Appends one JSON object per record to RUN/metrics.jsonl and the same numbers to TensorBoard events.

    Args:
        run: the run's directory.
        step: steps already done; later records, from before a kill, are dropped.
        writes: False for all but one of a group of processes: everything is dropped.
    """

    def __init__(self, run: Path, *, step: int, writes: bool = True) -> None:
        self._path = run / "metrics.jsonl"
        self._events = None
        if not writes:
            return
        write_text(self._path, "".join(line for line in complete_lines(self._path) if _step_of(line) <= step))
        self._events = SummaryWriter(str(run / "events"), purge_step=step + 1)

    def write(self, step: int, values: dict[str, Any]) -> None:
        """Records values at a step (counted over all stages)."""
        if self._events is None:
            return
        with self._path.open("a") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            if isinstance(value, (int, float)):
                self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Flushes the events."""
        if self._events is not None:
            self._events.close()


def _step_of(line: str) -> int:
    return int(json.loads(line)["step"])
