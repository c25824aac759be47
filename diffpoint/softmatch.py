"""The approximate earth mover's distance of the paper's released code, to compare with its numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint.distances import paired_sets
from diffpoint.sampling import lanes


def approxmatch(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> Tensor:
    """sum_ij match_ij |a_i - b_j|: the soft matching of the released code, a SUM over matched mass.

    Masses are matched over ten growing length scales. The result is 13 to 36 % above the earth mover's distance
    times the number of points; use `earth_mover_distance` unless you need the paper's numbers.

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit (the length scales are absolute: meant for shapes about 1 across).
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Returns:
        (*B) cost. With n >= m points of `a` have mass 1 and those of `b` floor(n / m); else the reverse.

    Gradients: to `a` and `b`, with the match held fixed, as in the released code.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an empty set, NaN or infinite coordinates.

    Source: the approxmatch operator of Fan, Su, Guibas, "A point set generation network" (CVPR 2017), as the released
    code of the CVPR 2019 paper calls it.

    Example:
        >>> a = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
        >>> round(approxmatch(a, a + torch.tensor([0.0, 0.25, 0])).item(), 3)
        0.5
    """
    name = "approxmatch"
    a3, b3, la, lb, batch = paired_sets(name, a, b, a_lengths, b_lengths)
    return _approxmatch(a3, b3, la, lb, _checks.differentiated(a, b))[0].reshape(batch)


def _fake(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, with_gradient: bool):
    return a.new_empty(a.shape[0]), a.new_empty(a.shape), b.new_empty(b.shape)


def _setup(ctx, inputs, output) -> None:
    ctx.mark_non_differentiable(*output[1:])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*output[1:])


def _gradient(ctx, grad_cost: Tensor | None, *_grads):
    if grad_cost is None:
        return (None,) * 5
    unit_a, unit_b = ctx.saved_tensors
    return grad_cost[:, None, None] * unit_a, grad_cost[:, None, None] * unit_b, None, None, None


@_bridge.register("approxmatch", fake=_fake, backward=_gradient, setup=_setup)
def _approxmatch(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, with_gradient: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The cost, and its gradients to `a` and `b` for a unit gradient (zeros unless `with_gradient`)."""
    _checks.check_sets("approxmatch", a, b, a_lengths, b_lengths, smallest=1)
    count, n, m = a.shape[0], a.shape[1], b.shape[1]
    cost = torch.zeros(count, dtype=torch.float64)
    if count == 0:
        return cost.to(a.dtype), a.new_zeros(a.shape), b.new_zeros(b.shape)
    a, b = _without_padding(a, a_lengths), _without_padding(b, b_lengths)
    a_lanes, b_lanes = torch.stack(lanes(a)), torch.stack(lanes(b))
    supply = _masses(a_lanes, a_lengths, (b_lengths // a_lengths).clamp(min=1))
    demand = _masses(b_lanes, b_lengths, (a_lengths // b_lengths).clamp(min=1))
    offer, request = torch.empty_like(supply), torch.empty_like(demand)
    grad_a, grad_b = torch.zeros_like(a_lanes), torch.zeros_like(b_lanes)
    _bridge.launch(
        "softmatch",
        "match",
        a.dtype,
        a,
        b,
        a_lanes,
        b_lanes,
        supply,
        demand,
        demand.view(count, -1),
        offer,
        offer.view(count, -1),
        request,
        request.view(count, -1),
        torch.empty_like(supply),
        torch.empty_like(supply),
        cost,
        torch.empty_like(grad_a),
        torch.empty_like(grad_b),
        grad_a,
        grad_b,
        int(with_gradient),
    )
    _checks.check_cost("approxmatch", cost)
    unit_a = grad_a.view(3, count, -1)[..., :n].movedim(0, -1).contiguous()
    unit_b = grad_b.view(3, count, -1)[..., :m].movedim(0, -1).contiguous()
    return cost.to(a.dtype), unit_a, unit_b


def _without_padding(points: Tensor, lengths: Tensor) -> Tensor:
    """Zeros in the padding: its mass is 0, but 0 times NaN would be NaN."""
    padding = torch.arange(points.shape[1]) >= lengths[:, None]
    return points.masked_fill(padding[..., None], 0)


def _masses(like: Tensor, lengths: Tensor, mass: Tensor) -> Tensor:
    """(B, tiles, lanes): each point's mass, 0 in the padding."""
    _, count, tiles, width = like.shape
    inside = torch.arange(tiles * width) < lengths[:, None]
    return torch.where(inside, mass[:, None], 0).to(like.dtype).view(count, tiles, width)
