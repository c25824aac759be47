"""Earth mover's distance by auction, with a bound on its distance from the optimum."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffpoint import _auction, _bridge, _checks
from diffpoint.blocks import LANES
from diffpoint.distances import paired_sets
from diffpoint.sampling import lanes

_ROUND = 64  # persons for whom all objects are scanned at the same prices; at most 64
# Pairs whose sizes have at least this product are each shared out among HELPERS more threads, if there are no more
# pairs than that. Which threads there are changes only the time.
_SHARED = 2**20


class Transport(NamedTuple):
    """An assignment between two sets, its cost, and a bound on its distance from the optimum."""

    cost: Tensor
    """(*B) mean distance |a_i - b_j| over the matched pairs, in the clouds' unit; squared if asked for."""
    assignment: Tensor
    """(*B, N) int64: the point of `b` matched to each point of `a`; -1 where `a` is the larger set, or padding."""
    bound: Tensor
    """(*B) `cost` is at most this much above the optimum."""
    converged: Tensor
    """(*B) bool: the tolerance or the resolution of the dtype was reached, or the optimum is at least `enough`."""
    prices: Tensor
    """(*B, max(N, M)) dual variables of the points of the larger set, at least 0, in the unit of `cost`; used by
    `start`."""


def earth_mover_distance(
    a: Tensor,
    b: Tensor,
    *,
    squared: bool = False,
    tolerance: float = 0.02,
    start: Transport | None = None,
    enough: Tensor | None = None,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> Transport:
    """min over injections phi of mean_i |a_i - b_phi(i)|, or of the squares, i over the smaller set.

    Every point of the smaller set is matched to its own point of the larger one. An auction with a decreasing bid
    increment stops when the duality gap is at most `tolerance` (the cost is usually much closer to the optimum).

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        squared: True for squared distances (unit^2): the cost is then the square of the 2-Wasserstein distance. False
            for distances (unit).
        tolerance: how far above the optimum the cost may be, relative to it.
        start: the result for the same sets before a small motion, as in the previous step of a descent: `squared`,
            sizes and order of the points must be the same. Its prices make the auction two to five times faster.
            Tolerance and bound hold for any prices.
        enough: (*B) the auction stops once a lower bound of the optimum reaches this, in the unit of the cost; the cost
            is then an upper bound on the optimum. For a hinge loss that is 0 from there on. It saves most where the
            clouds are far apart.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Returns:
        `Transport`; its `bound` holds even if `converged` is False. The sum in papers is `cost` times the size of the
        smaller set.

    Gradients: of `cost` to `a` and `b` with the assignment held fixed: unit vectors between matched points over
    their number, or twice their differences over it if `squared`; 0 for matched points that coincide.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an empty set, NaN or infinite coordinates, or a pair
            of sets that spans 1e18 or more, 1e9 if `squared`.

    Source: Bertsekas, "The auction algorithm" (1988); CVPR 2019 paper, equation of the EMD, with un-squared
    distances as in its released code.

    Example:
        >>> a = torch.tensor([[0.0, 0, 0], [1, 0, 0]]); b = torch.tensor([[1.0, 0, 0], [0, 2, 0], [9, 9, 9]])
        >>> result = earth_mover_distance(a, b)
        >>> result.cost.item(), result.assignment.tolist()
        (1.0, [1, 0])
    """
    name = "earth_mover_distance"
    a3, b3, la, lb, batch = paired_sets(name, a, b, a_lengths, b_lengths)
    tolerance = _checks.check_number(name, "tolerance", tolerance, "lie between 0 and 1", lambda x: 0 < x < 1)
    squared = _checks.check_flag(name, "squared", squared)
    prices, known_cost = _start(name, start, a, b)
    if enough is None:
        limit = a.new_full((a3.shape[0],), torch.inf)
    else:
        _checks.check_tensor(name, "enough", enough, batch)
        _checks.check_same_dtype(name, a=a, enough=enough)
        limit = enough.detach().reshape(-1)
    cost, assignment, bound, converged, prices = _transport(
        a3, b3, la, lb, prices, known_cost, limit, tolerance, squared
    )
    return Transport(
        cost.reshape(batch),
        assignment.reshape(a.shape[:-1]),
        bound.reshape(batch),
        converged.reshape(batch),
        prices.reshape(*batch, prices.shape[-1]),
    )


def _start(name: str, start: Transport | None, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Prices (B, size) and mean costs (B,) to start from; zeros and -1 without `start`."""
    batch, size = tuple(a.shape[:-2]), max(a.shape[-2], b.shape[-2])
    count = _bridge.count_of(batch)
    if start is None:
        return a.new_zeros((count, size)), a.new_full((count,), -1)
    if not isinstance(start, Transport):
        raise TypeError(f"{name}: 'start' must be a Transport or None; got {type(start).__name__}.")
    _checks.check_tensor(name, "start.prices", start.prices, (*batch, size))
    _checks.check_tensor(name, "start.cost", start.cost, batch)
    _checks.check_same_dtype(name, a=a, **{"start.prices": start.prices, "start.cost": start.cost})
    return start.prices.detach().reshape(count, size), start.cost.detach().reshape(count)


def _transport_fake(
    a: Tensor,
    b: Tensor,
    a_lengths: Tensor,
    b_lengths: Tensor,
    prices: Tensor,
    known_cost: Tensor,
    enough: Tensor,
    tolerance: float,
    squared: bool,
):
    count = a.shape[0]
    return (
        a.new_empty(count),
        a.new_empty(a.shape[:2], dtype=torch.int64),
        a.new_empty(count),
        a.new_empty(count, dtype=torch.bool),
        a.new_empty((count, max(a.shape[1], b.shape[1]))),
    )


def _transport_setup(ctx, inputs, output) -> None:
    a, b, a_lengths, b_lengths, *_, ctx.squared = inputs
    ctx.mark_non_differentiable(*output[1:])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(a, b, output[1], torch.minimum(a_lengths, b_lengths))


def _transport_gradient(ctx, grad_cost: Tensor | None, *_grads):
    if grad_cost is None:
        return (None,) * 9
    a, b, assignment, matched = ctx.saved_tensors
    return *_transport_backward(a, b, assignment, grad_cost / matched, ctx.squared), *(None,) * 7


@_bridge.register(
    "earth_mover_distance", fake=_transport_fake, backward=_transport_gradient, setup=_transport_setup
)
def _transport(
    a: Tensor,
    b: Tensor,
    a_lengths: Tensor,
    b_lengths: Tensor,
    prices: Tensor,
    known_cost: Tensor,
    enough: Tensor,
    tolerance: float,
    squared: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    largest_cost = _checks.check_transport(a, b, a_lengths, b_lengths, prices, known_cost, squared)
    count, n, m = a.shape[0], a.shape[1], b.shape[1]
    bound = torch.zeros(count, dtype=torch.float64)
    finished = torch.ones(count, dtype=torch.uint8)
    if count == 0:
        return (
            a.new_empty(0),
            torch.empty((0, n), dtype=torch.int64),
            a.new_empty(0),
            finished.view(torch.bool),
            torch.empty_like(prices),
        )

    # In the auction the points of the smaller set are the bidders ("persons"), those of the larger set the objects.
    size = max(n, m)
    swap = a_lengths > b_lengths
    a_wide = pad(a.detach(), (0, 0, 0, size - n))
    b_wide = pad(b.detach(), (0, 0, 0, size - m))
    persons = torch.where(swap[:, None, None], b_wide, a_wide)
    objects = torch.where(swap[:, None, None], a_wide, b_wide)
    person_counts, object_counts = torch.minimum(a_lengths, b_lengths), torch.maximum(a_lengths, b_lengths)

    axes = lanes(objects)
    # Only differences between prices matter; without this they would grow from start to start.
    prices = prices - prices.amin(1, keepdim=True)
    price_lanes = pad(prices, (0, axes[0][0].numel() - size)).view(axes[0].shape)
    object_of, person_of, queue = (torch.empty((count, size), dtype=torch.int32) for _ in range(3))
    helpers = _auction.HELPERS if count <= _auction.HELPERS and n * m >= _SHARED else 0
    lists = size + helpers * _ROUND
    # Of every person the objects that it may bid for next without a look at all others.
    offers = torch.zeros((count, lists, LANES), dtype=torch.int32), a.new_zeros((count, lists, LANES))
    seconds = a.new_empty((count, 1 + helpers, LANES))
    _bridge.launch(
        "transport",
        "auction_of_squares" if squared else "auction",
        a.dtype,
        persons,
        objects,
        *axes,
        price_lanes,
        price_lanes.view(count, -1),
        person_counts,
        object_counts,
        largest_cost,
        known_cost,
        enough,
        object_of,
        person_of,
        queue,
        torch.zeros((count, _ROUND), dtype=torch.int32),
        *offers,
        *(x.view(count, -1) for x in offers),
        a.new_empty((count, lists)),
        seconds,
        seconds.view(count, -1),
        a.new_empty((count, size)),
        torch.zeros((count, 64), dtype=torch.int32),
        torch.zeros((count, _ROUND), dtype=torch.int32),
        bound,
        finished,
        float(tolerance),
        _auction.RESOLUTION[a.dtype.itemsize],
        _auction.BIDS_PER_PERSON,
        _ROUND,
        helpers,
    )
    # Indexed by the points of `a`; partners beyond the number of persons are dummy persons.
    partner = torch.where(swap[:, None], person_of, object_of)[:, :n].to(torch.int64)
    real = (torch.arange(n) < a_lengths[:, None]) & (partner >= 0) & (partner < b_lengths[:, None])
    assignment = torch.where(real, partner, -1)
    matched = torch.take_along_dim(b, assignment.clamp(min=0)[..., None], dim=1)
    offset = a - matched
    distance = offset.square().sum(-1) if squared else offset.norm(dim=-1)
    cost = torch.where(real, distance, 0.0).sum(-1) / person_counts
    prices = price_lanes.view(count, -1)[:, :size]
    is_object = torch.arange(size) < object_counts[:, None]
    prices = torch.where(is_object, prices - prices.amin(1, keepdim=True), 0)
    return cost, assignment, bound.to(a.dtype), finished.view(torch.bool), prices


@_bridge.register(
    "earth_mover_distance_backward",
    fake=lambda a, b, assignment, grad_mean, squared: (a.new_empty(a.shape), b.new_empty(b.shape)),
)
def _transport_backward(
    a: Tensor, b: Tensor, assignment: Tensor, grad_mean: Tensor, squared: bool
) -> tuple[Tensor, Tensor]:
    grad_a, grad_b = a.new_zeros(a.shape), b.new_zeros(b.shape)
    if a.numel() and b.numel():
        _bridge.launch(
            "transport", "backward", a.dtype, a, b, assignment, grad_mean, grad_a, grad_b, int(squared)
        )
    return grad_a, grad_b
