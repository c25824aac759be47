"""A race: contenders that compute the same thing, timed in turns, so that a noisy machine is noisy for all of them."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import diffpoint


@dataclass(frozen=True)
class Contender:
    """One way to compute the result."""

    name: str
    run: Callable[[], Any]
    value: Callable[[Any], torch.Tensor] | None = None
    """What of the result is compared with ours; None where the peer gives nothing comparable."""
    remark: str = ""
    """Said in the table, e.g. that a peer approximates."""


@dataclass(frozen=True)
class Race:
    """Ours against peers, on one input."""

    op: str
    size: str
    ours: Contender
    peers: list[Contender] = field(default_factory=list)
    units: int = 1
    """Clouds or pairs in one run: times are given per unit."""
    tolerance: float = 1e-4
    """Relative difference between values up to which contenders agree."""


def run(race: Race, *, seconds: float) -> list[dict[str, Any]]:
    """Check that the contenders agree, time them in turns for about `seconds`; median milliseconds per unit."""
    contenders = [race.ours, *race.peers]
    results = [c.run() for c in contenders]  # also compiles and warms up
    agreement = {c.name: _difference(race, contenders, results, c) for c in contenders}
    durations: dict[str, list[float]] = {c.name: [] for c in contenders}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or min(map(len, durations.values())) < 3:
        for contender in contenders:
            start = time.perf_counter()
            contender.run()
            durations[contender.name].append(time.perf_counter() - start)
    ours = statistics.median(durations[race.ours.name])
    return [
        {
            "op": race.op,
            "size": race.size,
            "contender": c.name,
            "ms": 1e3 * statistics.median(durations[c.name]) / race.units,
            "times_ours": statistics.median(durations[c.name]) / ours,
            "runs": len(durations[c.name]),
            "difference": agreement[c.name],
            "remark": c.remark,
        }
        for c in contenders
    ]


def _difference(
    race: Race, contenders: list[Contender], results: list[Any], contender: Contender
) -> float | None:
    """Largest difference from our value relative to its size; an error where it should be small and is not."""
    if contender.value is None or race.ours.value is None:
        return None
    ours = race.ours.value(results[0]).double()
    theirs = contender.value(results[contenders.index(contender)]).double()
    difference = float((ours - theirs).abs().max() / ours.abs().max().clamp(min=1e-30))
    if difference > race.tolerance and not contender.remark:
        raise RuntimeError(
            f"{race.op} {race.size}: {contender.name} computes something else (relative difference {difference:.1e})"
        )
    return difference


def machine() -> dict[str, Any]:
    info = diffpoint.runtime_info()
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"{info.backend} {info.version}",
        "threads": info.threads,
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per race, ours first, then each peer with its factor."""
    lines = ["| op | size | diffpoint, ms | peers, ms (times ours) |", "|---|---|---|---|"]
    races = list(dict.fromkeys((r["op"], r["size"]) for r in rows))
    for op, size in races:
        ours, *peers = [r for r in rows if (r["op"], r["size"]) == (op, size)]
        peers.sort(key=lambda r: r["ms"])
        cells = [
            f"{p['contender']} {p['ms']:.3g} ({p['times_ours']:.1f}x{', ' + p['remark'] if p['remark'] else ''})"
            for p in peers
        ]
        lines.append(f"| {op} | {size} | {ours['ms']:.3g} | {'; '.join(cells)} |")
    return "\n".join(lines) + "\n"


def save(rows: list[dict[str, Any]], folder: Path) -> Path:
    """`<folder>/<machine>.json` and `.md`; the machine is named by its processor and cores."""
    here = machine()
    name = "".join(ch if ch.isalnum() else "-" for ch in f"{here['processor']} {here['cores']} cores").lower()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"machine": here, "rows": rows}, indent=2) + "\n")
    title = f"{here['processor']}, {here['cores']} cores, torch {here['torch']}, {here['backend']}"
    path.with_suffix(".md").write_text(f"{title}. Median milliseconds per cloud or pair.\n\n{table(rows)}")
    return path
