"""Nearest neighbours, chamfer, earth mover's distance, soft matching, farthest points: against the reference."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

import diffpoint as dp
from diffpoint import reference
from diffpoint._auction import RESOLUTION
from properties import strategies
from properties.compare import (
    AGREED,
    REFUSED,
    assert_finite_gradients,
    assert_within,
    eps,
    magnitude,
    refuse_or_run,
)


def check_nearest(recipes: tuple[strategies.Recipe, strategies.Recipe]) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.nearest(a.points, b.points, **lengths), a.poisoned or b.poisoned, "nearest"
    )
    if result is None:
        return REFUSED
    x, y = a.clean, b.clean
    squared, _ = reference.nearest(x, y, **lengths)
    assert_within(result.squared_distance, squared, 16 * eps(x.dtype) * squared)
    real = result.index >= 0
    inside = torch.arange(x.shape[-2]) < a.counts[..., None]
    assert torch.equal(real, inside & (b.counts > 0)[..., None])
    assert (result.index < b.counts[..., None]).all()
    if y.shape[-2]:
        chosen = torch.take_along_dim(y, result.index.clamp(min=0)[..., None], -2)
        attained = (x - chosen).double().square().sum(-1)
        assert_within(attained[real], squared[real].double(), 16 * eps(x.dtype) * squared[real])
        equal = (chosen[..., :, None, :] == y[..., None, :, :]).all(-1)
        assert torch.equal(equal.to(torch.uint8).argmax(-1)[real], result.index[real]), "the lowest of equals"
        gradient, _ = assert_finite_gradients(result.squared_distance, a.points, b.points)
        expected = torch.where(real[..., None], 2 * (x - chosen), 0.0)
        assert_within(gradient, expected, 8 * eps(x.dtype) * expected.abs())
    return AGREED


def check_knn(
    recipes: tuple[strategies.Recipe, strategies.Recipe], k: int, radius: float | None, exclude_self: bool
) -> str:
    a, b = (r.make() for r in recipes)
    if exclude_self:
        b = a
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.knn(a.points, b.points, k, radius=radius, exclude_self=exclude_self, **lengths),
        a.poisoned or b.poisoned,
        "knn",
    )
    if result is None:
        return REFUSED
    x, y = a.clean, b.clean
    every, _ = reference.knn(x, y, k, exclude_self=exclude_self, **lengths)
    inside = (torch.arange(x.shape[-2]) < a.counts[..., None])[..., None]
    real = result.index >= 0
    if radius is None:
        assert_within(result.squared_distance, every, 16 * eps(x.dtype) * every)
        available = (b.counts - int(exclude_self)).clamp(0, k)[..., None]
        assert torch.equal(real.sum(-1), torch.where(inside[..., 0], available, 0))
    else:
        surely, perhaps = (every <= radius**2 * (1 + sign * 16 * eps(x.dtype)) for sign in (-1, 1))
        assert (real >= surely & inside).all()
        assert (real <= perhaps & inside).all()
        assert_within(result.squared_distance[real], every[real], 16 * eps(x.dtype) * every[real])
        assert (result.squared_distance[~real & inside.expand(real.shape)] == torch.inf).all()
    assert (result.squared_distance.diff(dim=-1)[real[..., 1:]] >= 0).all()
    assert (result.index < b.counts[..., None, None]).all()
    if real.any():
        chosen = y.unsqueeze(-3).expand(*x.shape[:-1], *y.shape[-2:])
        chosen = torch.take_along_dim(chosen, result.index.clamp(min=0)[..., None], -2)
        attained = (x[..., None, :] - chosen).double().square().sum(-1)
        assert_within(attained[real], every[real].double(), 16 * eps(x.dtype) * every[real])
        equal = (chosen[..., 1:, :] == chosen[..., :-1, :]).all(-1) & real[..., 1:]
        assert (result.index.diff(dim=-1)[equal] > 0).all(), "the lowest of equals first"
        if exclude_self:
            assert (result.index != torch.arange(x.shape[-2])[:, None])[real].all()
        assert_finite_gradients(result.squared_distance, *{a.points, b.points})
    return AGREED


def _empty(*clouds: strategies.Cloud) -> bool:
    """Whether one of them has a set without points. A batch of no sets has none."""
    return any(bool((c.counts == 0).any()) for c in clouds)


def check_chamfer_distance(recipes: tuple[strategies.Recipe, strategies.Recipe]) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    refuse = a.poisoned or b.poisoned or _empty(a, b)
    for squared in (True, False):
        result = refuse_or_run(
            lambda s=squared: dp.chamfer_distance(a.points, b.points, squared=s, **lengths),
            refuse,
            "chamfer_distance",
        )
        if result is None:
            return REFUSED
        expected = reference.chamfer_distance(a.clean, b.clean, squared=squared, **lengths)
        for ours, theirs in zip(result, expected, strict=True):
            assert_within(ours, theirs, 100 * eps(ours.dtype) * theirs)
        assert_finite_gradients(torch.stack(result), a.points, b.points)
    return AGREED


def check_hausdorff_distance(recipes: tuple[strategies.Recipe, strategies.Recipe]) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.hausdorff_distance(a.points, b.points, **lengths),
        a.poisoned or b.poisoned or _empty(a, b),
        *("hausdorff_distance", "chamfer_distance"),
    )
    if result is None:
        return REFUSED
    expected = reference.hausdorff_distance(a.clean, b.clean, **lengths)
    assert_within(result, expected, 100 * eps(result.dtype) * expected)
    assert_finite_gradients(result, a.points, b.points)
    return AGREED


def check_f_score(recipes: tuple[strategies.Recipe, strategies.Recipe], threshold: float) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.f_score(a.points, b.points, threshold, **lengths),
        a.poisoned or b.poisoned or _empty(a, b),
        "f_score",
    )
    if result is None:
        return REFUSED
    # Rounding decides for distances at the threshold.
    fewest, most = (
        reference.f_score(a.clean, b.clean, threshold * (1 + sign * 16 * eps(a.clean.dtype)), **lengths)
        for sign in (-1, 1)
    )
    for low, value, high in zip(fewest, result, most, strict=True):
        assert (low <= value * (1 + 8 * eps(value.dtype))).all()
        assert (value <= high * (1 + 8 * eps(value.dtype))).all()
    return AGREED


def check_earth_mover_distance(recipes: tuple[strategies.Recipe, strategies.Recipe]) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.earth_mover_distance(a.points, b.points, **lengths),
        a.poisoned or b.poisoned or _empty(a, b),
        "earth_mover_distance",
    )
    if result is None:
        return REFUSED
    assert_finite_gradients(result.cost, a.points, b.points)
    x, y, cost, assignment, bound, converged, _ = (
        t.detach().reshape(a.counts.numel(), *t.shape[a.counts.dim() :]) for t in (a.clean, b.clean, *result)
    )
    for i, (n, m) in enumerate(zip(a.counts.flatten().tolist(), b.counts.flatten().tolist(), strict=True)):
        p, q = x[i, :n], y[i, :m]
        slack = 1e3 * eps(p.dtype) * magnitude(p, q)
        matched = (assignment[i] >= 0).nonzero()[:, 0]
        partners = assignment[i, matched]
        assert len(partners) == min(n, m) == len(partners.unique())
        assert (matched < n).all()
        assert (partners < m).all()
        assert_within(cost[i], (p[matched] - q[partners]).norm(dim=-1).mean(), slack)
        excess = float(cost[i]) - _least_mean_cost(p, q)
        assert -slack <= excess <= float(bound[i]) + slack
        # The resolution of the dtype also counts as converged: for a cost of 0 no tolerance of 2 % can be reached.
        both = torch.cat((p, q))
        resolved = 10 * RESOLUTION[p.dtype.itemsize] * float((both.amax(0) - both.amin(0)).norm())
        assert not converged[i] or bound[i] <= max(0.02 * cost[i], resolved) + slack
    return AGREED


def _least_mean_cost(p: Tensor, q: Tensor) -> float:
    """By the reference; by scipy where that would take seconds."""
    if len(p) * len(q) <= 400:
        return float(reference.earth_mover_distance(p.double(), q.double())[0])
    matrix = reference.pairwise_squared_distance(p.double(), q.double()).sqrt().numpy()
    return float(matrix[linear_sum_assignment(matrix)].mean())


def check_approxmatch(recipes: tuple[strategies.Recipe, strategies.Recipe]) -> str:
    a, b = (r.make() for r in recipes)
    lengths = {"a_lengths": a.lengths, "b_lengths": b.lengths}
    result = refuse_or_run(
        lambda: dp.approxmatch(a.points, b.points, **lengths),
        a.poisoned or b.poisoned or _empty(a, b),
        "approxmatch",
    )
    if result is None:
        return REFUSED
    if result.numel():
        expected = reference.approxmatch(a.clean, b.clean, **lengths)
        mass = torch.maximum(a.counts, b.counts)
        # Masses of 1 are moved over ten rounds, each a quotient of sums; what is left of them is a difference.
        assert_within(result, expected, 2e4 * eps(result.dtype) * mass * 2 * magnitude(a.clean, b.clean))
    assert_finite_gradients(result, a.points, b.points)
    return AGREED


def check_farthest_point_sample(recipe: strategies.Recipe, k: int, start: int, allow_fewer: bool) -> str:
    cloud = recipe.make()
    smallest = int(cloud.counts.min()) if cloud.counts.numel() else 0
    too_many = k > smallest and not allow_fewer
    refuse = cloud.counts.numel() > 0 and (cloud.poisoned or too_many or start > max(smallest - 1, 0))
    chosen = refuse_or_run(
        lambda: dp.farthest_point_sample(
            cloud.points, k, start=start, lengths=cloud.lengths, allow_fewer=allow_fewer
        ),
        refuse,
        "farthest_point_sample",
    )
    if chosen is None:
        return REFUSED
    assert chosen.shape == (*recipe.batch, k)
    if recipe.family in ("lattice", "one point") and chosen.numel():  # arithmetic is exact: so are the ties
        expected = reference.farthest_point_sample(cloud.clean, k, start=start, lengths=cloud.lengths)
        assert torch.equal(chosen, expected)
    batch = cloud.counts.numel()
    points, rows = cloud.clean.reshape(batch, recipe.count, 3), chosen.reshape(batch, k)
    for whole, n, row in zip(points, cloud.counts.flatten().tolist(), rows, strict=True):
        real = whole[:n]
        assert (row[n:] == -1).all()
        row = row[:n]
        assert len(row.unique()) == len(row) == min(k, n)
        distance = torch.full((n,), torch.inf, dtype=torch.float64)
        for step, i in enumerate(row.tolist()):
            assert i == start if step == 0 else distance[i] >= distance.max() * (1 - 16 * eps(recipe.dtype))
            if step:
                assert not (real[:i] == real[i]).all(-1).any() or distance[i] == 0, "the lowest of equals"
            distance = torch.minimum(distance, (real - real[i]).double().square().sum(-1))
            distance[i] = -1  # none is chosen twice
    return AGREED
