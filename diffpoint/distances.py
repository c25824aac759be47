"""Nearest neighbours and the chamfer distance."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _bridge, _checks, _parts
from diffpoint._common import share_within
from diffpoint.blocks import Blocks, sort_into_blocks

# Number of pairs from which the search with boxes is faster than trying all pairs, for any clouds.
_LARGE = 2**23


class Nearest(NamedTuple):
    """For each point of the first set, its nearest point of the second."""

    squared_distance: Tensor
    """(*B, N); 0 in the padding of `a`; +inf where `b` is empty, or where the square overflows (in float32 from
    distances of 1.8e19 on)."""
    index: Tensor
    """(*B, N) int64 into `b`; -1 in the padding of `a` and where the distance is infinite."""


class Chamfer(NamedTuple):
    """Both directions of the chamfer distance, each reduced over its own set."""

    a_to_b: Tensor
    """(*B); (*B, N) with reduction "none", 0 in the padding."""
    b_to_a: Tensor
    """(*B); (*B, M) with reduction "none", 0 in the padding."""

    @property
    def total(self) -> Tensor:
        """a_to_b + b_to_a (*B); meant for means and sums. The larger direction is `torch.maximum(*chamfer)`."""
        return self.a_to_b + self.b_to_a


class FScore(NamedTuple):
    """How much of two clouds lies near the other one; values in [0, 1]."""

    f_score: Tensor
    """(*B) harmonic mean of precision and recall; 0 where both are 0."""
    precision: Tensor
    """(*B) share of the points of `a` that have a point of `b` within the threshold."""
    recall: Tensor
    """(*B) share of the points of `b` that have a point of `a` within the threshold."""


def nearest(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> Nearest:
    """d2_i = min_j |a_i - b_j|^2 and the j of the minimum (the lowest in a tie).

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Gradients: of `squared_distance` to `a` and `b`, with the assignment held fixed; zero in the padding.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, lengths out of range, NaN or infinite coordinates.

    Example:
        >>> a = torch.tensor([[0.0, 0, 0], [2, 0, 0]]); b = torch.tensor([[0.5, 0, 0]])
        >>> nearest(a, b).squared_distance.tolist()
        [0.25, 2.25]
    """
    a3, b3, la, lb, _ = paired_sets("nearest", a, b, a_lengths, b_lengths)
    squared_distance, index = _nearest(a3, b3, la, lb)
    return Nearest(squared_distance.reshape(a.shape[:-1]), index.reshape(a.shape[:-1]))


def chamfer_distance(
    a: Tensor,
    b: Tensor,
    *,
    squared: bool,
    reduction: str = "mean",
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> Chamfer:
    """mean_i min_j |a_i - b_j| and mean_j min_i |a_i - b_j|, or the same of squared distances.

    Papers differ in squares, sums and factors, so `squared` has no default and both directions are returned; `.total`
    is their sum.

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        squared: True for squared distances (unit^2), False for distances (unit).
        reduction: over the points of each cloud: "mean"; "sum"; "max", the directed Hausdorff distances, of which
            the larger is `hausdorff_distance`; or "none" for the distance of each point, for instance
            to weight them. There is none over the batch.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Gradients: to `a` and `b`, with the assignments held fixed; 0 for a pair at distance 0. With "max", to the points of
        the largest distance, in equal shares if there are several.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an empty set, NaN or infinite coordinates.

    Example:
        >>> a = torch.zeros(1, 1, 3); b = torch.tensor([[[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> [d.item() for d in chamfer_distance(a, b, squared=False)]
        [1.0, 3.0]
    """
    a3, b3, la, lb, batch = paired_sets("chamfer_distance", a, b, a_lengths, b_lengths)
    squared = _checks.check_flag("chamfer_distance", "squared", squared)
    _checks.check_choice("chamfer_distance", "reduction", reduction, ("mean", "sum", "max", "none"))
    from_a, _, from_b, _ = _nearest_both(a3, b3, la, lb)
    directions = []
    for squared_distance, lengths in ((from_a, la), (from_b, lb)):
        d = _reduced(squared_distance if squared else safe_sqrt(squared_distance), lengths, reduction)
        directions.append(d.reshape(batch + tuple(d.shape[1:])))
    return Chamfer(*directions)


def _reduced(distance: Tensor, lengths: Tensor, reduction: str) -> Tensor:
    """Over the last dimension, whose padding holds zeros."""
    if reduction == "none":
        return distance
    if reduction == "max":
        return distance.amax(-1) if distance.shape[-1] else distance.sum(-1)  # a batch of no clouds
    total = distance.sum(-1)
    return total / lengths if reduction == "mean" else total


def hausdorff_distance(
    a: Tensor, b: Tensor, *, a_lengths: Tensor | None = None, b_lengths: Tensor | None = None
) -> Tensor:
    """max(max_i min_j |a_i - b_j|, max_j min_i |a_i - b_j|): the farthest that a point of one set is from the other.

    One outlier decides it. `chamfer_distance` with the reduction "max" has both directions, the directed Hausdorff
    distances.

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, same unit, dtype and leading dimensions.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Returns:
        (*B), in the unit of the points.

    Gradients: to the pair of points that decides, in equal shares if there are several; 0 at distance 0.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an empty set, NaN or infinite coordinates.

    Example:
        >>> a = torch.zeros(1, 1, 3); b = torch.tensor([[[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]]])
        >>> hausdorff_distance(a, b).item()
        5.0
    """
    paired_sets("hausdorff_distance", a, b, a_lengths, b_lengths)  # errors are to name this function
    _checks.check_filled("hausdorff_distance", "a", a, a_lengths)
    _checks.check_filled("hausdorff_distance", "b", b, b_lengths)
    directed = chamfer_distance(
        a, b, squared=False, reduction="max", a_lengths=a_lengths, b_lengths=b_lengths
    )
    return torch.maximum(*directed)


def f_score(
    a: Tensor,
    b: Tensor,
    threshold: float,
    *,
    a_lengths: Tensor | None = None,
    b_lengths: Tensor | None = None,
) -> FScore:
    """2 P R / (P + R): P is the share of `a` within `threshold` of `b`, R that of `b` within `threshold` of `a`.

    Args:
        a: (*B, N, 3) or (*B, N, 2) points, usually a prediction, any unit.
        b: (*B, M, 3) or (*B, M, 2) points, usually the ground truth, same unit, dtype and leading dimensions.
        threshold: largest distance that counts, in the unit of the clouds, not squared. Some codes compare squared
            distances with it: pass the square root of their threshold.
        a_lengths: (*B) int64, how many of the N points count; default all.
        b_lengths: (*B) int64, how many of the M points count; default all.

    Gradients: none; the shares are step functions.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an empty set, NaN or infinite coordinates, or a
            threshold below 0.

    Source: Knapitsch et al., "Tanks and Temples" (2017); Tatarchenko et al., "What do single-view 3D reconstruction
    networks learn?" (CVPR 2019), with a threshold of 1 % of the object's size.

    Example:
        >>> target = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
        >>> score = f_score(torch.tensor([[0.0, 0.1, 0]]), target, 0.2)
        >>> score.precision.item(), score.recall.item()
        (1.0, 0.5)
    """
    a3, b3, la, lb, batch = paired_sets("f_score", a, b, a_lengths, b_lengths)
    threshold = _checks.check_number(
        "f_score", "threshold", threshold, "be a number of at least 0", lambda t: t >= 0
    )
    precision, recall = (
        share.reshape(batch) for share in _shares_within(a3.detach(), b3.detach(), la, lb, threshold)
    )
    either = precision + recall
    score = torch.where(either > 0, 2 * precision * recall / torch.where(either > 0, either, 1.0), 0.0)
    return FScore(score, precision, recall)


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt with gradient 0 instead of infinity at 0."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def paired_sets(
    function: str, a: Tensor, b: Tensor, a_lengths: Tensor | None, b_lengths: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[int, ...]]:
    """Checked sets with one leading dimension, lengths of all sets, and the leading dimensions for the results."""
    in_space = _checks.check_points(function, "a", a, "N"), _checks.check_points(function, "b", b, "M")
    batch = tuple(a.shape[:-2])
    if b.shape[:-2] != a.shape[:-2] or b.shape[-1] != a.shape[-1]:
        wanted = "(" + "".join(f"{s}, " for s in batch) + f"M, {a.shape[-1]}) to match 'a'"
        if b.shape[-1] != a.shape[-1]:
            hint = "A distance is in space or in the plane, not between."
        elif b.dim() != a.dim():
            hint = "Did you forget to batch?"
        else:
            hint = "Nothing is broadcast: expand the smaller batch, for instance b.expand(len(a), -1, -1)."
        raise _checks.fail(function, "b", f"have shape {wanted}", str(tuple(b.shape)), hint)
    _checks.check_same_dtype(function, a=a, b=b)
    la = _checks.check_lengths(function, "a_lengths", a_lengths, batch, a.shape[-2], a)
    lb = _checks.check_lengths(function, "b_lengths", b_lengths, batch, b.shape[-2], b)
    count = _bridge.count_of(batch)
    a3, b3 = (x.reshape(count, *x.shape[-2:]) for x in in_space)
    la = _bridge.full_lengths(la, count, a.shape[-2], a)
    lb = _bridge.full_lengths(lb, count, b.shape[-2], b)
    return a3, b3, la, lb, batch


def _nearest_fake(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor):
    return a.new_empty(a.shape[:2]), a.new_empty(a.shape[:2], dtype=torch.int64)


def nearest_setup(ctx, inputs, output) -> None:
    """Keeps two sets and the index of neighbours for the gradient of the squared distances."""
    a, b, *_ = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(a, b, output[1])


def _nearest_gradient(ctx, grad_squared_distance: Tensor | None, _grad_index):
    if grad_squared_distance is None:
        return (None,) * 4
    a, b, index = ctx.saved_tensors
    return *_nearest_backward(a, b, index, grad_squared_distance), None, None


@_bridge.register("nearest", fake=_nearest_fake, backward=_nearest_gradient, setup=nearest_setup)
def _nearest(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor) -> tuple[Tensor, Tensor]:
    _checks.check_sets("nearest", a, b, a_lengths, b_lengths, smallest=0)
    if _is_large(a, b):
        return _search_blocks(
            sort_into_blocks(a, a_lengths), sort_into_blocks(b, b_lengths), a_lengths, b_lengths
        )
    return _search(a, b, a_lengths, b_lengths)


@_bridge.register(
    "nearest_backward",
    fake=lambda a, b, index, grad_squared_distance: (a.new_empty(a.shape), b.new_empty(b.shape)),
)
def _nearest_backward(
    a: Tensor, b: Tensor, index: Tensor, grad_squared_distance: Tensor
) -> tuple[Tensor, Tensor]:
    grad_a, grad_b = a.new_zeros(a.shape), b.new_zeros(b.shape)
    add_nearest_gradients(a, b, index, grad_squared_distance, grad_a, grad_b)
    return grad_a, grad_b


def _both_fake(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor):
    return *_nearest_fake(a, b, a_lengths, b_lengths), *_nearest_fake(b, a, b_lengths, a_lengths)


def _both_setup(ctx, inputs, output) -> None:
    a, b, *_ = inputs
    _, from_a, _, from_b = output
    ctx.mark_non_differentiable(from_a, from_b)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(a, b, from_a, from_b)


def _both_gradient(ctx, grad_from_a: Tensor | None, _index_a, grad_from_b: Tensor | None, _index_b):
    a, b, from_a, from_b = ctx.saved_tensors
    grad_from_a = _bridge.or_zeros(grad_from_a, a, from_a.shape)
    grad_from_b = _bridge.or_zeros(grad_from_b, b, from_b.shape)
    return *_nearest_both_backward(a, b, from_a, from_b, grad_from_a, grad_from_b), None, None


@_bridge.register("nearest_both", fake=_both_fake, backward=_both_gradient, setup=_both_setup)
def _nearest_both(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`_nearest` from `a` to `b` and from `b` to `a`; each set is checked and sorted once."""
    _checks.check_sets("chamfer_distance", a, b, a_lengths, b_lengths, smallest=1)
    return _search_both(a, b, a_lengths, b_lengths)


@_bridge.register(
    "nearest_both_backward",
    fake=lambda a, b, from_a, from_b, grad_from_a, grad_from_b: (a.new_empty(a.shape), b.new_empty(b.shape)),
)
def _nearest_both_backward(
    a: Tensor, b: Tensor, from_a: Tensor, from_b: Tensor, grad_from_a: Tensor, grad_from_b: Tensor
) -> tuple[Tensor, Tensor]:
    if len(a) and _parts.summed_parts(a.shape[1] + b.shape[1]) > 1:
        grad_a, grad_b, sum_a, sum_b = (torch.empty_like(x) for x in (a, b, a, b))
        inputs = a, b, from_a, from_b, grad_from_a, grad_from_b
        arrays = (x.view(-1) for x in (*inputs, grad_a, grad_b, sum_a, sum_b))
        _bridge.launch("nearest", "backward_both", a.dtype, *arrays, a.shape[1], b.shape[1])
        return grad_a, grad_b
    grad_a, grad_b = a.new_zeros(a.shape), b.new_zeros(b.shape)
    add_nearest_gradients(a, b, from_a, grad_from_a, grad_a, grad_b)
    add_nearest_gradients(b, a, from_b, grad_from_b, grad_b, grad_a)
    return grad_a, grad_b


@_bridge.register(
    "shares_within",
    fake=lambda a, b, a_lengths, b_lengths, threshold: (a.new_empty(a.shape[0]), a.new_empty(a.shape[0])),
)
def _shares_within(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    """Share of the points of `a` with a point of `b` at a distance of at most `threshold`, and the other way round."""
    _checks.check_sets("f_score", a, b, a_lengths, b_lengths, smallest=1)
    from_a, _, from_b, _ = _search_both(a, b, a_lengths, b_lengths)
    return share_within(from_a, a_lengths, threshold), share_within(from_b, b_lengths, threshold)


def _search_both(
    a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared distances and indices from `a` to `b`, and from `b` to `a`."""
    if _is_large(a, b):
        x, y = sort_into_blocks(a, a_lengths), sort_into_blocks(b, b_lengths)
        return *_search_blocks(x, y, a_lengths, b_lengths), *_search_blocks(y, x, b_lengths, a_lengths)
    return *_search(a, b, a_lengths, b_lengths), *_search(b, a, b_lengths, a_lengths)


def _is_large(a: Tensor, b: Tensor) -> bool:
    return a.shape[0] > 0 and a.shape[1] > 0 and b.shape[1] > 0 and a.shape[1] * b.shape[1] >= _LARGE


def _search(a: Tensor, b: Tensor, a_lengths: Tensor, b_lengths: Tensor) -> tuple[Tensor, Tensor]:
    squared_distance = a.new_empty(a.shape[:2])
    index = a.new_empty(a.shape[:2], dtype=torch.int64)
    if b.shape[1] == 0:
        padding = torch.arange(a.shape[1]) >= a_lengths[:, None]
        squared_distance.fill_(torch.inf).masked_fill_(padding, 0)
        index.fill_(-1)
    elif a.numel():
        _bridge.launch("nearest", "forward", a.dtype, a, b, a_lengths, b_lengths, squared_distance, index)
    return squared_distance, index


def _search_blocks(a: Blocks, b: Blocks, a_lengths: Tensor, b_lengths: Tensor) -> tuple[Tensor, Tensor]:
    """As `_search`, of sorted clouds."""
    squared_distance = a.points.new_empty((len(a_lengths), a.size))
    index = torch.empty(squared_distance.shape, dtype=torch.int64)
    sets = a.points, a.order, b.points, b.order, b.boxes, b.box_lanes, b.groups, a_lengths, b_lengths
    _bridge.launch("nearest", "forward_blocks", a.points.dtype, *sets, squared_distance, index)
    return squared_distance, index


def add_nearest_gradients(
    a: Tensor, b: Tensor, index: Tensor, grad_squared_distance: Tensor, grad_a: Tensor, grad_b: Tensor
) -> None:
    """Adds the gradients of squared distances from each point of `a` to one or several neighbours, in order."""
    if a.numel() and b.numel():
        inputs = (x.reshape(-1) for x in (a, b, index, grad_squared_distance))
        outputs = grad_a.view(-1), grad_b.view(-1)
        _bridge.launch("nearest", "backward", a.dtype, *inputs, *outputs, a.shape[1], b.shape[1])
