"""Targets for speed and memory, and whether the rows of a run meet them."""

from __future__ import annotations

import statistics
from typing import Any, NamedTuple

from benchmarks.sweep import exponent

Rows = list[dict[str, Any]]


class Target(NamedTuple):
    """A target and the measured value."""

    name: str
    wanted: str
    measured: str
    met: bool | None
    """None if the peer or the row is missing."""


def targets(results: dict[str, Any]) -> list[Target]:
    """All targets for the results of a run."""
    rows = results.get("races", [])
    forward, backward = "forward", "forward + backward"
    splat, small = "splat_depth", "80 x 2048, 56 x 56"
    own = "earth_mover_distance 160 x 2048, forward, per pair", "earth_mover_distance", "160 x 2048"
    return [
        _faster(rows, "knn", "80 x 2048 x 2048, k = 8", forward, 3.0),
        _faster(rows, "chamfer_distance", "80 x 2048 x 2048", forward, 3.5),
        _faster(rows, "chamfer_distance", "80 x 2048 x 2048", backward, 15.0, peer="torch"),
        _faster(rows, "chamfer_distance", "8 x 16384 x 2048", forward, 4.0),
        # One pair of a batch that fills the cores, as in training, beside one pair of POT on one core.
        _at_least(
            own[0], 50, "POT", _ms(rows, "earth_mover_distance", "8 x 2048", "POT"), _ms(rows, *own[1:])
        ),
        _excess(rows),
        _milliseconds(rows, "earth_mover_distance", "160 x 2048", 160, 2000.0),
        _faster(rows, "farthest_point_sample", "2 x 16384 -> 2048", forward, 1.3, peer="fpsample"),
        _faster(rows, splat, small, forward, 4.0, peer="torch"),
        _faster(rows, splat, small, forward, 0.9, peer="numba"),
        _milliseconds(rows, splat, "80 x 2048, 224 x 224", 80, 4.0),
        _radius(rows, small),
        _faster(rows, "project", "80 x 2048", backward, 3.0, peer="torch"),
        _faster(rows, "reproject", "80 x 56 x 56", backward, 3.0, peer="torch"),
        _exponent(results.get("sweep", [])),
        _memory(results.get("memory", [])),
        *_training(results.get("train", [])),
    ]


def _ms(
    rows: Rows, op: str, size: str, contender: str = "diffpoint", direction: str = "forward"
) -> tuple[float, str] | None:
    """Milliseconds and name of the fastest contender whose name begins with `contender`; "": of the fastest peer."""
    found = [
        (r["ms"], r["contender"])
        for r in rows
        if (r["op"], r["size"], r["direction"]) == (op, size, direction)
        and r["contender"].startswith(contender)
        and (contender or r["contender"] != "diffpoint")
    ]
    return min(found, default=None)


def _at_least(
    name: str, wanted: float, peer: str, theirs: tuple[float, str] | None, ours: tuple[float, str] | None
) -> Target:
    goal = f"at least {wanted:g}x {peer}"
    if theirs is None or ours is None:
        return Target(name, goal, "-", None)
    ratio = theirs[0] / ours[0]
    return Target(name, goal, f"{ratio:.1f}x {theirs[1]}", ratio >= wanted)


def _faster(rows: Rows, op: str, size: str, direction: str, wanted: float, *, peer: str = "") -> Target:
    """How many times faster than the best peer whose name begins with `peer`."""
    theirs, ours = (_ms(rows, op, size, name, direction) for name in (peer, "diffpoint"))
    return _at_least(f"{op} {size}, {direction}", wanted, peer or "the best peer", theirs, ours)


def _excess(rows: Rows) -> Target:
    """Our remark in the table is how far our cost is above the optimum."""
    name, goal = "earth_mover_distance 8 x 2048, error", "at most 0.5 % above exact"
    remarks = [
        r["remark"]
        for r in rows
        if (r["op"], r["size"], r["contender"]) == ("earth_mover_distance", "8 x 2048", "diffpoint")
        and r["remark"].endswith("above exact")
        and not r["remark"].startswith("nan")
    ]
    if not remarks:
        return Target(name, goal, "-", None)
    return Target(name, goal, remarks[0], float(remarks[0].split("%")[0]) <= 0.5)


def _milliseconds(rows: Rows, op: str, size: str, units: int, wanted: float) -> Target:
    name, goal = f"{op} {size}, forward", f"at most {wanted:g} ms"
    ours = _ms(rows, op, size)
    if ours is None:
        return Target(name, goal, "-", None)
    return Target(name, goal, f"{ours[0] * units:.3g} ms", ours[0] * units <= wanted)


def _radius(rows: Rows, size: str) -> Target:
    name, goal = f"splat_depth {size}, radius 1 beside radius 0", "at most 3x"
    one, zero = _ms(rows, "splat_depth, radius 1", size), _ms(rows, "splat_depth", size)
    if one is None or zero is None:
        return Target(name, goal, "-", None)
    return Target(name, goal, f"{one[0] / zero[0]:.1f}x", one[0] / zero[0] <= 3)


def _exponent(rows: Rows) -> Target:
    slopes = {
        batch: exponent(rows, "nearest, both ways, N x N", batch)
        for batch in dict.fromkeys(r["batch"] for r in rows)
    }
    measured = {batch: slope for batch, slope in slopes.items() if slope is not None}
    name, goal = "nearest, exponent in N from 16k to 1M", "at most 1.2"
    if not measured:
        return Target(name, goal, "-", None)
    text = ", ".join(f"{slope:.2f} at B = {batch}" for batch, slope in measured.items())
    return Target(name, goal, text, measured[min(measured)] <= 1.2)  # the smallest batch has the largest N


def _memory(rows: Rows) -> Target:
    name, goal = "extra memory, four times the points and pixels", "at most 5x for every op"
    grown = {r["op"]: r["large_mb"] / r["small_mb"] for r in rows if r["large_mb"] > 0.1}  # less is noise
    if not grown:
        return Target(name, goal, "-", None)
    worst = max(grown, key=lambda op: grown[op])
    text = f"{statistics.median(grown.values()):.1f}x in the middle, {grown[worst]:.1f}x {worst}"
    return Target(name, goal, text, grown[worst] <= 5)


def _training(rows: Rows) -> list[Target]:
    found = []
    for row in rows:
        name = f"training step, {row['profile']}, stage {row['stage']}"
        if row["profile"] in ("full", "cpu"):
            share = row["layer_share"]
            found.append(Target(f"{name}: the layer's share", "at most 25 %", f"{share:.0%}", share <= 0.25))
        if row["profile"] == "cpu" and row.get("reference_ratio") is not None:
            ratio = row["reference_ratio"]
            goal = "at least 3x the step with diffpoint.reference"
            found.append(Target(f"{name}: speed", goal, f"{ratio:.1f}x", ratio >= 3))
    return found
