"""The marks this library set itself, and whether a run's rows meet them."""

from __future__ import annotations

import statistics
from typing import Any, NamedTuple

from benchmarks.sweep import exponent

Rows = list[dict[str, Any]]


class Mark(NamedTuple):
    """A mark, and what was measured."""

    name: str
    wanted: str
    measured: str
    met: bool | None
    """None where the peer or the row is missing."""


def marks(results: dict[str, Any]) -> list[Mark]:
    """All marks of a run's results; those of parts that were not run are unknown."""
    rows = results.get("races", [])
    forward, backward = "forward", "forward + backward"
    found = [
        _ratio(rows, "chamfer_distance", "80 x 2048 x 2048", forward, 3.5),
        _ratio(rows, "chamfer_distance", "80 x 2048 x 2048", backward, 15.0, only="torch"),
        _ratio(rows, "chamfer_distance", "8 x 16384 x 2048", forward, 4.0),
        _assignment(rows),
        _excess(rows),
        _milliseconds(rows, "earth_mover_distance", "160 x 2048", 160, 2000.0),
        _ratio(rows, "farthest_point_sample", "2 x 16384 -> 2048", forward, 1.3, only="fpsample"),
        _ratio(rows, "splat_depth", "80 x 2048, 56 x 56", forward, 4.0, only="torch"),
        _ratio(rows, "splat_depth", "80 x 2048, 56 x 56", forward, 0.9, only="numba"),
        _milliseconds(rows, "splat_depth", "80 x 2048, 224 x 224", 80, 4.0),
        _radius(rows, "80 x 2048, 56 x 56"),
        _ratio(rows, "project", "80 x 2048", backward, 3.0, only="torch"),
        _ratio(rows, "reproject", "80 x 56 x 56", backward, 3.0, only="torch"),
        *_exponents(results.get("sweep", [])),
        _memory(results.get("memory", [])),
    ]
    return found + _training(results.get("train", []))


def _find(rows: Rows, op: str, size: str, direction: str) -> Rows:
    return [r for r in rows if (r["op"], r["size"], r["direction"]) == (op, size, direction)]


def _ratio(rows: Rows, op: str, size: str, direction: str, wanted: float, *, only: str = "") -> Mark:
    """Times faster than the best peer whose name begins with `only`."""
    peers = [
        r
        for r in _find(rows, op, size, direction)
        if r["contender"] != "diffpoint" and r["contender"].startswith(only)
    ]
    name, goal = f"{op} {size}, {direction}", f"at least {wanted:g}x {only or 'the best peer'}"
    if not peers:
        return Mark(name, goal, "-", None)
    best = min(peers, key=lambda r: r["ms"])
    measured = f"{best['times_ours']:.1f}x {best['contender']}"
    return Mark(name, goal, measured, best["times_ours"] >= wanted)


def _assignment(rows: Rows) -> Mark:
    """A pair in a batch that fills the cores, as training has it, beside POT's one pair on one core."""
    ours = _find(rows, "earth_mover_distance", "160 x 2048", "forward")
    peers = _find(rows, "earth_mover_distance", "8 x 2048", "forward")
    peers = [r for r in peers if r["contender"].startswith("POT")]
    name, goal = "earth_mover_distance 160 x 2048, forward, per pair", "at least 50x POT"
    if not ours or not peers:
        return Mark(name, goal, "-", None)
    ratio = peers[0]["ms"] / ours[0]["ms"]
    return Mark(name, goal, f"{ratio:.1f}x {peers[0]['contender']}", ratio >= 50)


def _excess(rows: Rows) -> Mark:
    """Our remark says by how much our cost exceeds the exact one."""
    ours = [
        r for r in _find(rows, "earth_mover_distance", "8 x 2048", "forward") if r["remark"].endswith("exact")
    ]
    ours = [r for r in ours if r["contender"] == "diffpoint"]
    goal = "at most 0.5 % above exact"
    if not ours or ours[0]["remark"].startswith("nan"):
        return Mark("earth_mover_distance 8 x 2048, error", goal, "-", None)
    remark = ours[0]["remark"]
    return Mark("earth_mover_distance 8 x 2048, error", goal, remark, float(remark.split("%")[0]) <= 0.5)


def _milliseconds(rows: Rows, op: str, size: str, units: int, wanted: float) -> Mark:
    ours = [r for r in _find(rows, op, size, "forward") if r["contender"] == "diffpoint"]
    name, goal = f"{op} {size}, forward", f"at most {wanted:g} ms"
    if not ours:
        return Mark(name, goal, "-", None)
    total = ours[0]["ms"] * units
    return Mark(name, goal, f"{total:.3g} ms", total <= wanted)


def _radius(rows: Rows, size: str) -> Mark:
    times = [
        [r["ms"] for r in _find(rows, op, size, "forward") if r["contender"] == "diffpoint"]
        for op in ("splat_depth", "splat_depth, radius 1")
    ]
    name, goal = f"splat_depth {size}, radius 1 beside radius 0", "at most 3x"
    if not all(times):
        return Mark(name, goal, "-", None)
    ratio = times[1][0] / times[0][0]
    return Mark(name, goal, f"{ratio:.1f}x", ratio <= 3)


def _exponents(rows: Rows) -> list[Mark]:
    op = "nearest, both ways, N x N"
    slopes = {batch: exponent(rows, op, batch) for batch in dict.fromkeys(r["batch"] for r in rows)}
    known = {batch: slope for batch, slope in slopes.items() if slope is not None}
    name, goal = "nearest, exponent in N from 16k to 1M", "at most 1.2"
    if not known:
        return [Mark(name, goal, "-", None)]
    measured = ", ".join(f"{slope:.2f} at B = {batch}" for batch, slope in known.items())
    first = known[min(known)]  # the smallest batch goes to the largest N
    return [Mark(name, goal, measured, first <= 1.2)]


def _memory(rows: Rows) -> Mark:
    name, goal = "extra memory, four times the points and pixels", "at most 5x for every op"
    grown = {
        r["op"]: r["large_mb"] / r["small_mb"]
        for r in rows
        if r["large_mb"] > 0.1  # below: noise
    }
    if not grown:
        return Mark(name, goal, "-", None)
    worst = max(grown, key=lambda op: grown[op])
    measured = f"{statistics.median(grown.values()):.1f}x in the middle, {grown[worst]:.1f}x {worst}"
    return Mark(name, goal, measured, grown[worst] <= 5)


def _training(rows: Rows) -> list[Mark]:
    found = []
    for row in rows:
        name = f"training step, {row['profile']}, stage {row['stage']}"
        if row["profile"] in ("full", "cpu"):
            share = row["layer_share"]
            found.append(Mark(f"{name}: the layer's share", "at most 25 %", f"{share:.0%}", share <= 0.25))
        if row["profile"] == "cpu" and row.get("twins_ratio") is not None:
            ratio = row["twins_ratio"]
            goal = "at least 3x the step with the torch twins"
            found.append(Mark(f"{name}: speed", goal, f"{ratio:.1f}x", ratio >= 3))
    return found
