"""A race times implementations of one op in turns, so that other load on the machine slows all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from benchmarks.inputs import leaf, leaf_camera
from benchmarks.saved import machine
from diffpoint import PinholeCamera

__all__ = ["Contender", "Disagreement", "Race", "Way", "both_directions", "machine", "run"]

Direction = Literal["forward", "forward + backward"]

_ROUNDS = 3  # at least, of a contender that takes less than _LONG; others run twice, including the warm-up
_LONG = 1.0  # seconds
_FAR_BEHIND = 6  # times our time; such a contender gets no further rounds


class Disagreement(RuntimeError):
    """A contender without a remark computes something else than we do."""


@dataclass(frozen=True)
class Contender:
    """One implementation."""

    name: str
    run: Callable[[], Any]
    value: Callable[[Any], Tensor] | None = None
    """The part of the result that is compared with ours; None if nothing is comparable."""
    remark: str = ""
    """For the table, e.g. that a peer approximates; the result of a peer with a remark may differ from ours."""
    units: int | None = None
    """Number of clouds or pairs in one run, if less than in the race; the first ones of the same input."""


@dataclass(frozen=True)
class Race:
    """Our implementation and those of peers on one input."""

    op: str
    size: str
    ours: Contender
    peers: list[Contender] = field(default_factory=list)
    direction: Direction = "forward"
    units: int = 1
    """Number of clouds or pairs in one run; times are per unit."""
    tolerance: float = 1e-4
    """Values differ if they are further apart than this, relative to the largest."""
    share: float = 0.0
    """Share of the values that may differ, because of step functions in rendering and ties between neighbours."""


@dataclass(frozen=True)
class Way:
    """An implementation as a function of its inputs, from which `both_directions` makes contenders.

    Attributes:
        name: of the contender.
        function: of points, depth maps and cameras.
        value: the part of its result to compare.
        loss: a scalar of its result to differentiate; None: leave the implementation out of the backward race.
        units: if less than in the race, the number of clouds that it gets.
    """

    name: str
    function: Callable[..., Any]
    value: Callable[[Any], Tensor]
    loss: Callable[[Any], Tensor] | None = None
    remark: str = ""
    units: int | None = None


def both_directions(
    op: str,
    size: str,
    inputs: tuple[Tensor | PinholeCamera, ...],
    ours: Way,
    peers: list[Way],
    *,
    directions: tuple[Direction, ...] = ("forward", "forward + backward"),
    **options: Any,
) -> Iterator[Race]:
    """The races of an op, forward and with gradients to all of its inputs."""
    for direction in directions:
        backward = direction != "forward"

        def contender(way: Way, backward: bool = backward) -> Contender:
            own = inputs if way.units is None else tuple(x[: way.units] for x in inputs)
            if not backward:
                return Contender(way.name, lambda: way.function(*own), way.value, way.remark, way.units)
            return Contender(way.name, lambda: _descend(way, own), _gradients, way.remark, way.units)

        raced = [contender(peer) for peer in peers if peer.loss or not backward]
        yield Race(op, size, contender(ours), raced, direction, **options)


def _descend(way: Way, inputs: tuple[Tensor | PinholeCamera, ...]) -> tuple[list[Tensor], list[Tensor]]:
    """Copies of all inputs, and their gradients."""
    assert way.loss is not None
    leaves = [leaf(x) if isinstance(x, Tensor) else leaf_camera(x) for x in inputs]
    way.loss(way.function(*leaves)).backward()
    tensors = [t for x in leaves for t in ((x,) if isinstance(x, Tensor) else (x.K, x.cam_from_world))]
    return tensors, [t.grad for t in tensors if t.grad is not None]


def _gradients(result: tuple[list[Tensor], list[Tensor]]) -> Tensor:
    """(B, ...) all gradients, each relative to its largest value."""
    return torch.cat([g.flatten(1) / g.abs().max().clamp(min=1e-30) for g in result[1]], 1)


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
            theirs = _value(peer, peer.run())  # also compiles and warms up
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
    """Share of the values that differ; an error if it is more than `race.share`."""
    if ours is None or theirs is None:
        return None
    ours = ours[: len(theirs)]  # a slow peer computes only the first units
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
