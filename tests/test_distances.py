"""Nearest neighbours, chamfer, earth mover's distance, farthest points: against twins, scipy and arithmetic."""

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment

import diffpoint as dp
from diffpoint import distances, reference, sampling
from diffpoint.testing import assert_close, check_gradients

DTYPES = (torch.float32, torch.float64)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return (
        torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype) - 0.5
    )


def leaf(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return random(*shape, seed=seed, dtype=dtype).requires_grad_()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 64), (64, 33), (31, 1), (100, 257), (700, 1025)])
def test_nearest_equals_its_twin(dtype, n, m):
    a, b = leaf(3, n, 3, seed=1, dtype=dtype), leaf(3, m, 3, seed=2, dtype=dtype)
    ours, theirs = dp.nearest(a, b), reference.nearest(a, b)
    assert torch.equal(ours.index, theirs[1])
    assert_close(ours.squared_distance, theirs[0])
    weights = random(3, n, seed=3, dtype=dtype)
    x = torch.autograd.grad((ours.squared_distance * weights).sum(), (a, b))
    y = torch.autograd.grad((theirs[0] * weights).sum(), (a, b))
    assert_close(x[0], y[0], scale=10)
    assert_close(x[1], y[1], scale=10)


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest_takes_uneven_and_empty_sets(dtype):
    a, b = leaf(4, 20, 3, seed=1, dtype=dtype), leaf(4, 40, 3, seed=2, dtype=dtype)
    lengths = {"a_lengths": torch.tensor([20, 7, 0, 5]), "b_lengths": torch.tensor([40, 33, 9, 0])}
    ours, theirs = dp.nearest(a, b, **lengths), reference.nearest(a, b, **lengths)
    assert torch.equal(ours.index, theirs[1])
    assert_close(ours.squared_distance, theirs[0])
    assert torch.isinf(ours.squared_distance[3, :5]).all()
    assert (ours.index[3] == -1).all()
    (gradient,) = torch.autograd.grad(ours.squared_distance[:3].sum(), a)
    assert (gradient[1, 7:] == 0).all()
    assert dp.nearest(a, b[:, :0]).index.eq(-1).all()
    assert dp.nearest(a[:, :0], b).index.shape == (4, 0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 70), (500, 3000), (3000, 500)])
@pytest.mark.parametrize("kind", ["random", "lattice", "one place", "line", "extreme", "beyond the format"])
def test_large_and_small_sets_are_searched_with_the_same_result(monkeypatch, dtype, n, m, kind):
    """The search that passes over boxes gives the bits of the one that tries every pair, ties included."""
    a, b = random(3, n, 3, seed=1, dtype=dtype), random(3, m, 3, seed=2, dtype=dtype)
    if kind == "lattice":
        a, b = (a * 4).round(), (b * 4).round()
    elif kind == "one place":
        a, b = torch.full_like(a, 0.3), torch.full_like(b, 0.3)
    elif kind == "line":
        a[..., 1:] = b[..., 1:] = 0
    elif kind == "extreme":
        a, b = a * 1e6, b * 1e-6
    elif kind == "beyond the format":  # some of the squares are infinite
        a, b = (x.double() * (1e20 if dtype == torch.float32 else 1e155) for x in (a, b))
        a, b = a.to(dtype), b.to(dtype)
    lengths = {"a_lengths": torch.tensor([n, n // 2, n]), "b_lengths": torch.tensor([m, m, m // 3])}
    every_pair = dp.nearest(a, b, **lengths)
    monkeypatch.setattr(distances, "_LARGE", 0)
    with_boxes = dp.nearest(a, b, **lengths)
    assert torch.equal(every_pair.index, with_boxes.index)
    assert torch.equal(every_pair.squared_distance, with_boxes.squared_distance)
    assert (with_boxes.index < torch.maximum(lengths["b_lengths"], torch.tensor(1))[:, None]).all()


@pytest.mark.parametrize("large", [False, True])
def test_distances_beyond_the_number_format_are_infinite(monkeypatch, large):
    if large:
        monkeypatch.setattr(distances, "_LARGE", 0)
    a = torch.tensor([[0.0, 0, 0], [2e19, 0, 0]], requires_grad=True)
    b = torch.tensor([[-1e19, 0, 0], [1e19, 1, 0]], requires_grad=True)
    result = dp.nearest(a[1:] * 2, b)
    assert result.squared_distance.tolist() == [torch.inf]
    assert result.index.tolist() == [-1]
    result = dp.nearest(a, b)
    assert torch.equal(result.index, torch.tensor([0, 1]))
    assert torch.isfinite(result.squared_distance).all()
    far = dp.chamfer_distance(a * 2, b, squared=False)
    assert far.a_to_b.item() == torch.inf
    gradients = torch.autograd.grad(far.a_to_b, (a, b))
    assert all(torch.isfinite(g).all() for g in gradients)


def test_chamfer_of_large_clouds_is_that_of_small_ones(monkeypatch):
    a, b = leaf(2, 700, 3, seed=1), leaf(2, 1100, 3, seed=2)
    lengths = {"a_lengths": torch.tensor([700, 40]), "b_lengths": torch.tensor([1100, 1000])}
    results = []
    for threshold in (2**40, 0):
        monkeypatch.setattr(distances, "_LARGE", threshold)
        chamfer = dp.chamfer_distance(a, b, squared=False, **lengths)
        gradients = torch.autograd.grad(chamfer.a_to_b.sum() + 2 * chamfer.b_to_a.sum(), (a, b))
        results.append((*chamfer, *gradients))
    assert all(torch.equal(x, y) for x, y in zip(*results, strict=True))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("squared", [True, False])
def test_chamfer_equals_its_twin(dtype, squared):
    a, b = leaf(2, 2, 30, 3, seed=1, dtype=dtype), leaf(2, 2, 50, 3, seed=2, dtype=dtype)
    lengths = {"a_lengths": torch.tensor([[30, 1], [7, 29]]), "b_lengths": torch.tensor([[50, 50], [1, 13]])}
    ours = dp.chamfer_distance(a, b, squared=squared, **lengths)
    theirs = reference.chamfer_distance(a, b, squared=squared, **lengths)
    for x, y in zip(ours, theirs, strict=True):
        assert x.shape == (2, 2)
        assert_close(x, y)
    x = torch.autograd.grad((2 * ours.a_to_b + ours.b_to_a).sum(), (a, b))
    y = torch.autograd.grad((2 * theirs[0] + theirs[1]).sum(), (a, b))
    assert_close(x[0], y[0], scale=10)
    assert_close(x[1], y[1], scale=10)


def test_distances_pass_gradcheck():
    a, b = random(2, 9, 3, seed=1), random(2, 12, 3, seed=2)
    lengths = {"a_lengths": torch.tensor([9, 4]), "b_lengths": torch.tensor([10, 12])}
    check_gradients(lambda a, b: dp.nearest(a, b, **lengths).squared_distance, a, b)
    for squared in (True, False):
        check_gradients(lambda a, b, s=squared: tuple(dp.chamfer_distance(a, b, squared=s, **lengths)), a, b)
    check_gradients(lambda a, b: dp.earth_mover_distance(a, b, tolerance=1e-6, **lengths).cost, a, b)


def test_chamfer_of_a_shifted_lattice_is_the_shift():
    lattice = torch.cartesian_prod(*(torch.arange(5.0),) * 3)
    shift = torch.tensor([0.1, 0.0, 0.0])
    chamfer = dp.chamfer_distance(lattice, lattice + shift, squared=False)
    assert_close(torch.stack(chamfer), torch.tensor([0.1, 0.1]), scale=10)
    squared = dp.chamfer_distance(lattice, lattice + shift, squared=True)
    assert_close(torch.stack(squared), torch.tensor([0.01, 0.01]), scale=10)


def test_chamfer_of_a_set_with_itself_is_zero_with_zero_gradient():
    a = leaf(2, 40, 3)
    total = sum(x.sum() for x in dp.chamfer_distance(a, a.detach().clone(), squared=False))
    assert total == 0
    (gradient,) = torch.autograd.grad(total, a)
    assert (gradient == 0).all()


def test_chamfer_scales_with_the_clouds_and_ignores_order_and_motion():
    a, b = random(1, 50, 3, seed=1), random(1, 70, 3, seed=2)
    before = torch.stack(dp.chamfer_distance(a, b, squared=False))
    order = torch.randperm(50, generator=torch.Generator().manual_seed(0))
    rotation = torch.linalg.qr(random(3, 3, seed=5)).Q
    assert_close(torch.stack(dp.chamfer_distance(3 * a, 3 * b, squared=False)), 3 * before, scale=10)
    moved = dp.chamfer_distance(a[:, order] @ rotation + 1, b @ rotation + 1, squared=False)
    assert_close(torch.stack(moved), before, scale=10)
    assert_close(torch.stack(dp.chamfer_distance(b, a, squared=False)), before.flip(0), scale=10)


def scipy_cost(a: torch.Tensor, b: torch.Tensor) -> float:
    matrix = np.linalg.norm(a.double().numpy()[:, None] - b.double().numpy()[None], axis=-1)
    rows, columns = linear_sum_assignment(matrix)
    return float(matrix[rows, columns].mean())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("n", "m"), [(1, 1), (2, 2), (1, 9), (9, 1), (16, 16), (40, 100), (100, 40), (300, 300), (257, 511)]
)
@pytest.mark.parametrize("tolerance", [0.05, 1e-3])
def test_emd_is_as_close_to_exact_as_it_says(dtype, n, m, tolerance):
    a, b = random(2, n, 3, seed=1, dtype=dtype), random(2, m, 3, seed=2, dtype=dtype)
    result = dp.earth_mover_distance(a, b, tolerance=tolerance)
    assert result.converged.all()
    for pair in range(2):
        exact = scipy_cost(a[pair], b[pair])
        excess = result.cost[pair].item() - exact
        rounding = 1e-6 if dtype == torch.float32 else 1e-12
        assert -rounding <= excess <= result.bound[pair].item() + rounding
        assert result.bound[pair] <= tolerance * result.cost[pair] + rounding
        partners = result.assignment[pair][result.assignment[pair] >= 0]
        assert len(partners) == min(n, m) == len(partners.unique())


def test_emd_equals_its_twin_in_value_and_gradient():
    lengths = {"a_lengths": torch.tensor([12, 30, 5]), "b_lengths": torch.tensor([25, 11, 5])}
    for dtype in DTYPES:
        a, b = leaf(3, 30, 3, seed=1, dtype=dtype), leaf(3, 25, 3, seed=2, dtype=dtype)
        ours = dp.earth_mover_distance(a, b, tolerance=1e-5, **lengths)
        cost, assignment = reference.earth_mover_distance(a, b, **lengths)
        assert torch.equal(ours.assignment, assignment)
        assert_close(ours.cost, cost)
        weights = torch.tensor([1.0, 2.0, 3.0], dtype=dtype)
        x = torch.autograd.grad((ours.cost * weights).sum(), (a, b))
        y = torch.autograd.grad((cost * weights).sum(), (a, b))
        assert_close(x[0], y[0])
        assert_close(x[1], y[1])


def test_the_reference_assignment_is_scipys():
    cost = random(17, 23, seed=4)
    columns = reference.assign(cost)
    assert columns.tolist() == linear_sum_assignment(cost.numpy())[1].tolist()


def test_emd_of_a_permuted_copy_is_zero_and_finds_the_permutation():
    a = random(1, 200, 3, seed=1)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    result = dp.earth_mover_distance(a[:, order], a)
    assert result.cost.item() == 0
    assert torch.equal(result.assignment[0], order)


def test_emd_of_a_small_shift_is_its_length():
    lattice = torch.cartesian_prod(*(torch.arange(6.0),) * 3)
    result = dp.earth_mover_distance(lattice, lattice + torch.tensor([0.0, 0.2, 0.0]), tolerance=1e-4)
    assert result.cost.item() == pytest.approx(0.2, rel=1e-4)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["one place", "line", "duplicates", "tiny", "huge"])
def test_emd_ends_on_degenerate_sets(dtype, kind):
    a, b = random(1, 64, 3, seed=1, dtype=dtype), random(1, 64, 3, seed=2, dtype=dtype)
    if kind == "one place":
        a, b = torch.zeros_like(a), torch.zeros_like(b)
    elif kind == "line":
        a[..., 1:] = b[..., 1:] = 0
    elif kind == "duplicates":
        a, b = a[:, torch.arange(64) % 4], b[:, torch.arange(64) % 3]
    else:
        factor = {"tiny": 1e-6, "huge": 1e6}[kind]
        a, b = a * factor, b * factor
    result = dp.earth_mover_distance(a, b)
    exact = scipy_cost(a[0], b[0])
    assert result.converged.all()
    assert result.cost.item() <= exact + result.bound.item() + 1e-6 * exact
    assert len(result.assignment[0].unique()) == 64


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (40, 40), (50, 20), (20, 50), (33, 17)])
def test_approxmatch_equals_its_twin(dtype, n, m):
    a, b = leaf(2, n, 3, seed=1, dtype=dtype), leaf(2, m, 3, seed=2, dtype=dtype)
    for lengths in ({}, {"a_lengths": torch.tensor([n, 1]), "b_lengths": torch.tensor([(m + 1) // 2, m])}):
        ours, theirs = dp.approxmatch(a, b, **lengths), reference.approxmatch(a, b, **lengths)
        assert_close(ours, theirs, scale=20)
        x, y = (torch.autograd.grad(cost.sum(), (a, b)) for cost in (ours, theirs))
        assert_close(x[0], y[0], scale=50)
        assert_close(x[1], y[1], scale=50)


def test_approxmatch_is_a_sum_a_little_above_the_optimum():
    a, b = random(1, 256, 3, seed=1), random(1, 256, 3, seed=2)
    ratio = dp.approxmatch(a, b) / (256 * dp.earth_mover_distance(a, b).cost)
    assert 1.05 < ratio.item() < 1.5
    assert dp.approxmatch(a, a).item() < 0.002 * 256
    shifted = dp.approxmatch(a, a + 1e-4, a_lengths=torch.tensor([200]), b_lengths=torch.tensor([150]))
    assert shifted.item() < 0.1 * 150


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "k"), [(1, 1), (15, 15), (16, 4), (17, 9), (500, 100)])
def test_farthest_points_equal_the_plain_algorithm(dtype, n, k):
    points = random(2, 2, n, 3, seed=n, dtype=dtype)
    for start in {0, n - 1}:
        ours = dp.farthest_point_sample(points, k, start=start)
        assert torch.equal(ours, reference.farthest_point_sample(points, k, start=start))
        assert (ours[..., 0] == start).all()
        assert all(len(row.unique()) == k for row in ours.view(-1, k))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 31, 32, 33, 700])
@pytest.mark.parametrize("kind", ["random", "lattice", "one place", "line"])
def test_farthest_points_of_large_and_small_clouds_come_in_the_same_order(monkeypatch, dtype, n, kind):
    points = random(3, n, 3, seed=n, dtype=dtype)
    if kind == "lattice":
        points = (points * 4).round()
    elif kind == "one place":
        points = torch.full_like(points, 0.3)
    elif kind == "line":
        points[..., 1:] = 0
    lengths = torch.tensor([n, max(n // 2, 1), n])
    k = max(1, n // 2)
    for start in {0, max(n // 2, 1) - 1}:
        every_distance = dp.farthest_point_sample(points, k, start=start, lengths=lengths)
        with monkeypatch.context() as patch:
            patch.setattr(sampling, "_LARGE", 0)
            with_boxes = dp.farthest_point_sample(points, k, start=start, lengths=lengths)
        assert torch.equal(every_distance, with_boxes)


def test_farthest_points_stay_within_the_lengths():
    points = random(3, 50, 3)
    lengths = torch.tensor([50, 20, 33])
    ours = dp.farthest_point_sample(points, 20, lengths=lengths)
    assert torch.equal(ours, reference.farthest_point_sample(points, 20, lengths=lengths))
    assert sorted(ours[1].tolist()) == list(range(20))


def test_farthest_points_cover_better_than_random_ones():
    points = random(1, 2000, 3)
    chosen = torch.take_along_dim(points, dp.farthest_point_sample(points, 64)[..., None], 1)
    scattered = points[:, torch.randperm(2000, generator=torch.Generator().manual_seed(1))[:64]]
    radius = [
        dp.nearest(points, subset).squared_distance.max().sqrt().item() for subset in (chosen, scattered)
    ]
    assert radius[0] < 0.7 * radius[1]


def test_non_contiguous_sets_and_expanded_gradients():
    a, b = random(3, 2, 40, seed=1).permute(1, 2, 0), random(2, 90, 3, seed=2)[:, ::2]
    assert not a.is_contiguous()
    assert not b.is_contiguous()
    grads = []
    for x, y in ((a, b), (a.contiguous(), b.contiguous())):
        x, y = x.detach().requires_grad_(), y.detach().requires_grad_()
        dp.nearest(x, y).squared_distance.sum().backward()
        dp.earth_mover_distance(x, y).cost.sum().backward()
        grads.append((x.grad, y.grad))
    assert torch.equal(grads[0][0], grads[1][0])
    assert torch.equal(grads[0][1], grads[1][1])
