"""A race: contenders that compute the same thing, timed in turns, so that a noisy machine is noisy for all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.saved import machine

__all__ = ["Contender", "Disagreement", "Race", "machine", "run"]

Direction = Literal["forward", "forward + backward"]

_ROUNDS = 3  # of every contender that takes less than
_LONG = 1.0  # seconds; others run twice, the warm-up included
_FAR_BEHIND = 6  # times our time: further rounds of such a contender would tell nothing more


class Disagreement(RuntimeError):
    """A contender computes something else than we do, and nobody said so."""


@dataclass(frozen=True)
class Contender:
    """One way to compute the result."""

    name: str
    run: Callable[[], Any]
    value: Callable[[Any], Tensor] | None = None
    """What of the result is compared with ours; None where the peer gives nothing comparable."""
    remark: str = ""
    """Said in the table, e.g. that a peer approximates; a peer with a remark may differ."""
    units: int | None = None
    """Clouds or pairs in one run, where not as many as the race's; the first ones of the same input."""


@dataclass(frozen=True)
class Race:
    """Ours against peers, on one input."""

    op: str
    size: str
    ours: Contender
    peers: list[Contender] = field(default_factory=list)
    direction: Direction = "forward"
    units: int = 1
    """Clouds or pairs in one run: times are given per unit."""
    tolerance: float = 1e-4
    """Values differ if they are further apart than this, relative to the largest."""
    share: float = 0.0
    """How much of the result may differ: the step functions of rendering, and equally near neighbours."""


def run(race: Race, *, seconds: float) -> list[dict[str, Any]]:
    """Check that the contenders agree, time them in turns for about `seconds`; median milliseconds per unit.

    A peer that fails is left out, with a printed line.

    Raises:
        Disagreement: a peer without a remark computes something else.
    """
    value = _value(race.ours, race.ours.run())
    agreement: dict[str, float | None] = {race.ours.name: None}
    contenders = [race.ours]
    for peer in race.peers:
        try:
            theirs = _value(peer, peer.run())  # compiles and warms up, too
        except Exception as error:
            reason = str(error).strip().splitlines()
            print(
                f"  {peer.name} left out of {race.op}: {type(error).__name__}: {reason[0] if reason else ''}"
            )
            continue
        agreement[peer.name] = _differing_share(race, peer, value, theirs)
        contenders.append(peer)
    durations = _time_in_turns(race, contenders, seconds)
    per_unit = {c.name: statistics.median(durations[c.name]) / (c.units or race.units) for c in contenders}
    return [
        {
            "op": race.op,
            "size": race.size,
            "direction": race.direction,
            "contender": c.name,
            "ms": 1e3 * per_unit[c.name],
            "times_ours": per_unit[c.name] / per_unit[race.ours.name],
            "runs": len(durations[c.name]),
            "differing_share": agreement[c.name],
            "remark": c.remark,
        }
        for c in contenders
    ]


def _time_in_turns(race: Race, contenders: list[Contender], seconds: float) -> dict[str, list[float]]:
    """Seconds of each run of each contender."""
    durations: dict[str, list[float]] = {c.name: [] for c in contenders}
    ours = durations[race.ours.name]
    end = time.perf_counter() + seconds
    racing = contenders
    while racing:
        for contender in racing:
            start = time.perf_counter()
            contender.run()
            durations[contender.name].append(time.perf_counter() - start)
        late = time.perf_counter() > end
        racing = [c for c in contenders if _another_round(durations[c.name], ours, late)]
    return durations


def _another_round(runs: list[float], ours: list[float], late: bool) -> bool:
    if len(runs) < (1 if runs[0] > _LONG else _ROUNDS):
        return True
    return not late and statistics.median(runs) <= _FAR_BEHIND * statistics.median(ours)


def _value(contender: Contender, result: Any) -> Tensor | None:
    return None if contender.value is None else contender.value(result).detach().double()


def _differing_share(race: Race, peer: Contender, ours: Tensor | None, theirs: Tensor | None) -> float | None:
    """Share of the values that differ; an error where more do than may."""
    if ours is None or theirs is None:
        return None
    ours = ours[: len(theirs)]  # a slow peer may do the first units only
    if ours.shape != theirs.shape:
        raise Disagreement(
            f"{race.op} {race.size}: {peer.name} gives {tuple(theirs.shape)}, we {tuple(ours.shape)}"
        )
    finite = torch.isfinite(ours)
    scale = float(ours[finite].abs().max()) if finite.any() else 1.0
    differs = (ours != theirs) & ~((ours - theirs).abs() <= race.tolerance * scale)
    share = float(differs.double().mean()) if differs.numel() else 0.0
    if share > race.share and not peer.remark:
        raise Disagreement(
            f"{race.op} {race.size} {race.direction}: {share:.2%} of {peer.name}'s values differ from ours"
        )
    return share
