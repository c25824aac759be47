"""Nearest neighbours, chamfer, earth mover's distance, farthest points: closed forms, invariances, special cases."""

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import directed_hausdorff

import diffpoint as dp
from diffpoint import _auction, distances, neighbours, reference, sampling, transport
from diffpoint.testing import assert_close

DTYPES = (torch.float32, torch.float64)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return (
        torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype) - 0.5
    )


def leaf(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return random(*shape, seed=seed, dtype=dtype).requires_grad_()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 70), (500, 3000), (3000, 500)])
@pytest.mark.parametrize("kind", ["random", "lattice", "one place", "line", "extreme", "beyond the format"])
def test_large_and_small_sets_are_searched_with_the_same_result(monkeypatch, dtype, n, m, kind):
    """The search that skips boxes gives the same bits as the one that tries every pair, also with ties."""
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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 70), (500, 1300), (40, 2100)])
@pytest.mark.parametrize("kind", ["random", "lattice", "one place", "extreme", "beyond the format"])
@pytest.mark.parametrize("by_sorting", [False, True])
def test_neighbours_are_those_of_the_reference_to_the_bit(monkeypatch, dtype, n, m, kind, by_sorting):
    """Also in ties, where the lower index comes first; with fewer than k in reach; by either way of searching."""
    if by_sorting:
        monkeypatch.setattr(neighbours, "_LARGE_K", 0)
        monkeypatch.setattr(neighbours, "_SORTED_AT_ONCE", 30 * m)
    a, b = random(3, n, 3, seed=1, dtype=dtype), random(3, m, 3, seed=2, dtype=dtype)
    if kind == "lattice":
        a, b = (a * 4).round(), (b * 4).round()
    elif kind == "one place":
        a, b = torch.full_like(a, 0.3), torch.full_like(b, 0.3)
    elif kind == "extreme":
        a, b = a * 1e6, b * 1e-6
    elif kind == "beyond the format":  # some of the squares are infinite
        a, b = ((x.double() * (1e20 if dtype == torch.float32 else 1e155)).to(dtype) for x in (a, b))
    lengths = torch.tensor([n, n // 2, n])
    clouds = {"a_lengths": lengths, "b_lengths": torch.tensor([m, m, m // 3])}
    itself = {"a_lengths": lengths, "b_lengths": lengths, "exclude_self": True}
    for k in (1, 5, 20):
        for radius in (None, 0.3, 2.0):
            for second, options in ((b, clouds), (a, itself)):
                ours = dp.knn(a, second, k, radius=radius, **options)
                theirs = reference.knn(a, second, k, radius=radius, **options)
                assert torch.equal(ours.index, theirs[1])
                assert torch.equal(ours.squared_distance, theirs[0])


def test_more_neighbours_than_the_kernel_keeps():
    a, b = random(1, 40, 3, seed=1), random(1, 400, 3, seed=2)
    for k in (neighbours._LARGE_K, neighbours._LARGE_K + 1, 500):
        ours, theirs = dp.knn(a, b, k), reference.knn(a, b, k)
        assert torch.equal(ours.index, theirs[1])
        assert torch.equal(ours.squared_distance, theirs[0])


def test_the_nearest_neighbour_is_nearest():
    a, b = random(2, 300, 3, seed=1), random(2, 500, 3, seed=2)
    one, nearest = dp.knn(a, b, 1), dp.nearest(a, b)
    assert torch.equal(one.index[..., 0], nearest.index)
    assert torch.equal(one.squared_distance[..., 0], nearest.squared_distance)


def test_a_radius_counts_the_points_at_it():
    line = torch.arange(5.0)[:, None] * torch.tensor([1.0, 0, 0])
    found = dp.knn(line, line, 4, radius=1.0, exclude_self=True)
    assert found.index.tolist() == [
        [1, -1, -1, -1],
        [0, 2, -1, -1],
        [1, 3, -1, -1],
        [2, 4, -1, -1],
        [3, -1, -1, -1],
    ]
    assert found.squared_distance[0].tolist() == [1.0, torch.inf, torch.inf, torch.inf]
    assert dp.knn(line, line, 1, radius=0.0).index[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_only_a_cloud_itself_has_a_self_to_exclude():
    a = random(2, 9, 3)
    copy, padded = a.clone(), a.clone()
    padded[1, 8] = 9.0
    lengths = {"a_lengths": torch.tensor([9, 8]), "b_lengths": torch.tensor([9, 8])}
    for b, options in ((copy, {}), (padded, lengths)):
        ours, same = (dp.knn(a, x, 2, exclude_self=True, **options) for x in (b, a))
        assert torch.equal(ours.index, same.index)
    for b, options in ((padded, {}), (a.flip(1), {}), (a, {"a_lengths": torch.tensor([9, 8])})):
        with pytest.raises(ValueError, match="knn: 'b' must hold the points of 'a' with exclude_self=True"):
            dp.knn(a, b, 2, exclude_self=True, **options)
    with pytest.raises(
        ValueError, match=r"knn: 'b' must have shape \(2, 9, 3\).*pass the points of 'a' again"
    ):
        dp.knn(a, a[:, :5], 2, exclude_self=True)


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_in_a_plane_have_the_distances_of_points_in_space(dtype):
    a, b = leaf(2, 30, 2, seed=1, dtype=dtype), leaf(2, 40, 2, seed=2, dtype=dtype)
    a3, b3 = (torch.nn.functional.pad(x, (0, 1)) for x in (a, b))
    for op in (
        dp.nearest,
        lambda x, y: dp.knn(x, y, 3),
        lambda x, y: dp.chamfer_distance(x, y, squared=False),
        lambda x, y: dp.earth_mover_distance(x, y)[:2],
        lambda x, y: (dp.approxmatch(x, y),),
    ):
        plane, space = op(a, b), op(a3, b3)
        assert all(torch.equal(x, y) for x, y in zip(plane, space, strict=True))
        gradients = [torch.autograd.grad(result[0].sum(), (a, b)) for result in (plane, space)]
        assert gradients[0][0].shape == (2, 30, 2)
        assert all(torch.equal(x, y) for x, y in zip(*gradients, strict=True))
    assert torch.equal(dp.farthest_point_sample(a, 9), dp.farthest_point_sample(a3, 9))
    with pytest.raises(ValueError, match=r"'b' must have shape \(2, M, 2\) to match 'a'; got \(2, 40, 3\)"):
        dp.nearest(a, b3)
    with pytest.raises(ValueError, match="The last size must be 3, or 2 for points in a plane, not 4"):
        dp.nearest(torch.zeros(2, 5, 4), b3)


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
@pytest.mark.parametrize(("n", "m"), [(1, 1), (70, 30), (30, 70)])
def test_gradients_of_large_pairs_are_those_of_small_ones(monkeypatch, dtype, n, m):
    """Where each direction has sums of its own: with one target of many points, and padding on either side."""
    generator = torch.Generator().manual_seed(n)
    a, b = (torch.rand(3, k, 3, dtype=dtype, generator=generator) for k in (n, m))
    b[1] *= 0.01
    a_lengths, b_lengths = (torch.tensor([k, max(1, k - 7), max(1, k // 2)]) for k in (n, m))
    for points, lengths in ((a, a_lengths), (b, b_lengths)):
        points[torch.arange(points.shape[1]) >= lengths[:, None]] = torch.nan
    weights = torch.rand(2, 3, dtype=dtype, generator=generator)

    def gradients():
        leaves = [x.clone().requires_grad_() for x in (a, b)]
        distance = dp.chamfer_distance(*leaves, squared=True, a_lengths=a_lengths, b_lengths=b_lengths)
        return torch.autograd.grad(list(distance), leaves, list(weights))

    expected = gradients()
    monkeypatch.setattr("diffpoint._parts._SUMMED", 1)
    for gradient, other in zip(gradients(), expected, strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-5, atol=1e-6 if dtype == torch.float32 else 1e-14)


def test_chamfer_of_a_shifted_lattice_is_the_shift():
    lattice = torch.cartesian_prod(*(torch.arange(5.0),) * 3)
    shift = torch.tensor([0.1, 0.0, 0.0])
    chamfer = dp.chamfer_distance(lattice, lattice + shift, squared=False)
    assert_close(torch.stack(chamfer), torch.tensor([0.1, 0.1]), scale=10)
    squared = dp.chamfer_distance(lattice, lattice + shift, squared=True)
    assert_close(torch.stack(squared), torch.tensor([0.01, 0.01]), scale=10)


@pytest.mark.parametrize("squared", [False, True])
def test_reductions_of_the_distances_of_the_points(squared):
    a, b = random(2, 40, 3, seed=1), random(2, 30, 3, seed=2)
    lengths = {"a_lengths": torch.tensor([40, 7]), "b_lengths": torch.tensor([30, 11])}
    each = dp.chamfer_distance(a, b, squared=squared, reduction="none", **lengths)
    assert each.a_to_b.shape == (2, 40)
    assert each.b_to_a.shape == (2, 30)
    assert (each.a_to_b[1, 7:] == 0).all()
    for reduction in ("mean", "sum", "max"):
        reduced = dp.chamfer_distance(a, b, squared=squared, reduction=reduction, **lengths)
        for d, total, count in zip(each, reduced, lengths.values(), strict=True):
            expected = {"mean": d.sum(-1) / count, "sum": d.sum(-1), "max": d.amax(-1)}
            assert torch.equal(total, expected[reduction])
        assert torch.equal(reduced.total, reduced.a_to_b + reduced.b_to_a)
    default = dp.chamfer_distance(a, b, squared=squared, **lengths)
    assert torch.equal(default.a_to_b, each.a_to_b.sum(-1) / lengths["a_lengths"])


def test_the_largest_directed_distance_is_scipys_hausdorff_distance():
    a, b = random(70, 3, seed=1), random(50, 3, seed=2)
    directed = dp.chamfer_distance(a, b, squared=False, reduction="max")
    scipys = [directed_hausdorff(x, y)[0] for x, y in ((a, b), (b, a))]
    assert torch.stack(directed).tolist() == pytest.approx(scipys)
    assert dp.hausdorff_distance(a, b).item() == pytest.approx(max(scipys))
    assert torch.equal(dp.hausdorff_distance(b, a), dp.hausdorff_distance(a, b))
    plane = dp.hausdorff_distance(a[:, :2], b[:, :2], a_lengths=torch.tensor(40))
    scipys = [directed_hausdorff(x, y)[0] for x, y in ((a[:40, :2], b[:, :2]), (b[:, :2], a[:40, :2]))]
    assert plane.item() == pytest.approx(max(scipys))


def test_the_f_score_counts_points_within_the_threshold():
    target = torch.arange(10.0)[:, None] * torch.tensor([1.0, 0, 0])
    predicted = torch.cat((target[:4] + torch.tensor([0.0, 0.25, 0]), target[:2] + 50))
    score = dp.f_score(predicted, target, 0.25)
    assert score.precision.item() == pytest.approx(4 / 6)
    assert score.recall.item() == pytest.approx(4 / 10)
    assert score.f_score.item() == pytest.approx(2 * (4 / 6) * 0.4 / (4 / 6 + 0.4))
    assert [s.item() for s in dp.f_score(predicted, target, 0.24)] == [0, 0, 0]
    assert [s.item() for s in dp.f_score(target, target, 0.0)] == [1, 1, 1]
    padded = dp.f_score(predicted, target, 0.25, a_lengths=torch.tensor(4), b_lengths=torch.tensor(8))
    assert (padded.precision.item(), padded.recall.item()) == (1.0, 0.5)


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


def scipy_cost(a: torch.Tensor, b: torch.Tensor, *, squared: bool = False) -> float:
    matrix = np.linalg.norm(a.double().numpy()[:, None] - b.double().numpy()[None], axis=-1)
    matrix = matrix**2 if squared else matrix
    rows, columns = linear_sum_assignment(matrix)
    return float(matrix[rows, columns].mean())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(2, 2), (1, 9), (100, 40), (300, 300), (257, 511)])
@pytest.mark.parametrize("tolerance", [0.05, 1e-3])
@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("space", [2, 3])
def test_emd_is_within_its_bound_and_tolerance(dtype, n, m, tolerance, squared, space):
    a, b = random(2, n, space, seed=1, dtype=dtype), random(2, m, space, seed=2, dtype=dtype)
    result = dp.earth_mover_distance(a, b, tolerance=tolerance, squared=squared)
    assert result.converged.all()
    for pair in range(2):
        exact = scipy_cost(a[pair], b[pair], squared=squared)
        excess = result.cost[pair].item() - exact
        rounding = 1e-6 if dtype == torch.float32 else 1e-12
        assert -rounding <= excess <= result.bound[pair].item() + rounding
        assert result.bound[pair] <= tolerance * result.cost[pair] + rounding
        partners = result.assignment[pair][result.assignment[pair] >= 0]
        assert len(partners) == min(n, m) == len(partners.unique())


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


@pytest.mark.parametrize("dtype", DTYPES)
def test_squared_costs_choose_their_own_assignment(dtype):
    """Two steps of length 1 instead of one of length 2 and one of 0: the same sum, but half the sum of squares."""
    a = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=dtype, requires_grad=True)
    b = torch.tensor([[1.0, 0, 0], [2, 0.1, 0]], dtype=dtype, requires_grad=True)
    result = dp.earth_mover_distance(a, b, squared=True, tolerance=1e-6)
    assert result.assignment.tolist() == [0, 1]
    assert result.cost.item() == pytest.approx(1.005, rel=1e-6)
    for ours, exact in zip(
        torch.autograd.grad(result.cost, (a, b)), ((a - b).detach(), (b - a).detach()), strict=True
    ):
        assert_close(ours, exact)  # 2 (a - b) / 2


def test_the_padding_counts_for_nothing_in_squared_costs():
    lengths = {"a_lengths": torch.tensor([20, 7, 30]), "b_lengths": torch.tensor([40, 40, 11])}
    a, b = three_pairs(30, 40)
    for i in range(3):
        a[i, lengths["a_lengths"][i] :] = torch.nan
        b[i, lengths["b_lengths"][i] :] = torch.nan
    result = dp.earth_mover_distance(a, b, squared=True, tolerance=1e-5, **lengths)  # pyright: ignore
    exact = [
        scipy_cost(x[:n], y[:m], squared=True)
        for x, y, n, m in zip(a, b, *(v.tolist() for v in lengths.values()), strict=True)
    ]
    torch.testing.assert_close(result.cost, torch.tensor(exact, dtype=a.dtype), rtol=1e-5, atol=0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_squared_costs_of_any_unit(scale):
    a, b = random(1, 60, 3, seed=1) * scale, random(1, 70, 3, seed=2) * scale
    result = dp.earth_mover_distance(a, b, squared=True)
    exact = scipy_cost(a[0], b[0], squared=True)
    assert exact * (1 - 1e-5) <= result.cost.item() <= 1.02 * exact
    assert result.converged.all()


def test_a_start_and_enough_serve_squared_costs():
    a, b = three_pairs(40, 50)
    start = dp.earth_mover_distance(a, b, squared=True)
    moved = a + 1e-3 * torch.sin(torch.arange(40, dtype=a.dtype))[:, None]
    exact, _ = reference.earth_mover_distance(moved, b, squared=True)
    result = dp.earth_mover_distance(moved, b, squared=True, start=start, tolerance=1e-3)
    assert (result.cost >= exact - 1e-12).all()
    assert (result.cost <= exact * (1 + 1e-3)).all()
    enough = exact * torch.tensor([0.2, 0.9, 1.1], dtype=a.dtype)
    early = dp.earth_mover_distance(moved, b, squared=True, enough=enough)
    assert early.converged.all()
    assert (early.cost >= torch.minimum(enough, exact) - 1e-12).all()
    assert (early.cost <= exact + early.bound + 1e-12).all()


@pytest.mark.parametrize("squared", [False, True])
def test_near_matches_take_about_one_bid_a_point(monkeypatch, squared):
    a = random(2, 500, 3, seed=1, dtype=torch.float32)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    b = a[:, order] + 0.003 * random(2, 500, 3, seed=2, dtype=torch.float32)
    monkeypatch.setattr(_auction, "BIDS_PER_PERSON", 2)
    result = dp.earth_mover_distance(a, b, squared=squared)
    assert result.converged.all()
    for x, y, cost in zip(a, b, result.cost.tolist(), strict=True):
        assert cost <= 1.02 * scipy_cost(x, y, squared=squared)


@pytest.mark.parametrize("squared", [False, True])
def test_points_that_crowd_where_there_is_room_for_half_of_them_are_settled_soon(monkeypatch, squared):
    """Nearest neighbours suggest a cost of 0: the bid increment that this gives has to be raised."""
    a = torch.zeros(1, 64, 3)
    b = torch.zeros(1, 64, 3)
    b[:, ::2] = torch.tensor([1.0, 0, 0])
    monkeypatch.setattr(_auction, "BIDS_PER_PERSON", 400)
    result = dp.earth_mover_distance(a, b, squared=squared)
    assert result.converged.all()
    assert result.cost.item() == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (60, 60), (90, 70)])
def test_threads_that_help_a_pair_change_no_bit(monkeypatch, count, n, m):
    a, b = random(count, n, 3, seed=1, dtype=torch.float32), random(count, m, 3, seed=2, dtype=torch.float32)
    alone = dp.earth_mover_distance(a, b)
    monkeypatch.setattr(transport, "_SHARED", 0)
    for _ in range(5):
        together = dp.earth_mover_distance(a, b)
        assert all(torch.equal(x, y) for x, y in zip(alone, together, strict=True))


@pytest.mark.parametrize("size", [0, 4])
def test_emd_of_no_pairs_is_empty(size):
    result = dp.earth_mover_distance(torch.rand(0, size, 3), torch.rand(0, size, 3))
    assert [tuple(x.shape) for x in result] == [(0,), (0, size), (0,), (0,), (0, size)]


def test_emd_of_a_small_shift_is_its_length():
    lattice = torch.cartesian_prod(*(torch.arange(6.0),) * 3)
    result = dp.earth_mover_distance(lattice, lattice + torch.tensor([0.0, 0.2, 0.0]), tolerance=1e-4)
    assert result.cost.item() == pytest.approx(0.2, rel=1e-4)


def test_approxmatch_is_a_sum_a_little_above_the_optimum():
    a, b = random(1, 256, 3, seed=1), random(1, 256, 3, seed=2)
    ratio = dp.approxmatch(a, b) / (256 * dp.earth_mover_distance(a, b).cost)
    assert 1.05 < ratio.item() < 1.5
    assert dp.approxmatch(a, a).item() < 0.002 * 256
    shifted = dp.approxmatch(a, a + 1e-4, a_lengths=torch.tensor([200]), b_lengths=torch.tensor([150]))
    assert shifted.item() < 0.1 * 150


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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("steps", [1e6, 6])
def test_farthest_points_of_a_scan_come_in_the_plain_order(monkeypatch, dtype, steps):
    """Of more boxes than two vectors of groups; on a lattice most steps are ties."""
    points = (random(2, 36_000, 3, dtype=dtype) * steps).round()
    lengths = torch.tensor([36_000, 33_001])
    with_boxes = dp.farthest_point_sample(points, 400, start=7, lengths=lengths)
    monkeypatch.setattr(sampling, "_LARGE", 2**30)
    assert torch.equal(with_boxes, dp.farthest_point_sample(points, 400, start=7, lengths=lengths))


@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
def test_no_point_is_chosen_twice(monkeypatch, large, dtype):
    """Not even where all that remain lie on chosen ones; these come in order."""
    if large:
        monkeypatch.setattr(sampling, "_LARGE", 0)
    duplicates = random(2, 3, 3, dtype=dtype).repeat(1, 14, 1)
    for points in (duplicates, torch.full((2, 40, 3), 0.3, dtype=dtype), random(2, 40, 3, dtype=dtype)):
        size = points.shape[1]
        chosen = dp.farthest_point_sample(points, size, start=5)
        assert torch.equal(chosen, reference.farthest_point_sample(points, size, start=5))
        assert torch.equal(chosen.sort(-1).values, torch.arange(size).expand(2, -1))
    one_place = dp.farthest_point_sample(torch.zeros(8, 3, dtype=dtype), 8, start=2)
    assert one_place.tolist() == [2, 0, 1, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("large", [False, True])
def test_each_cloud_has_its_own_number_and_start(monkeypatch, large):
    if large:
        monkeypatch.setattr(sampling, "_LARGE", 0)
    points, lengths = random(2, 2, 50, 3), torch.tensor([[50, 20], [7, 0]])
    k, start = torch.tensor([[9, 20], [3, 0]]), torch.tensor([[49, 2], [6, 0]])
    chosen = dp.farthest_point_sample(points, k, start=start, lengths=lengths)
    assert chosen.shape == (2, 2, 20)
    assert torch.equal(chosen, reference.farthest_point_sample(points, k, start=start, lengths=lengths))
    for i, j in ((0, 0), (0, 1), (1, 0)):
        alone = dp.farthest_point_sample(points[i, j, : lengths[i, j]], int(k[i, j]), start=int(start[i, j]))
        assert torch.equal(chosen[i, j, : k[i, j]], alone)
        assert (chosen[i, j, k[i, j] :] == -1).all()
    assert (chosen[1, 1] == -1).all()
    with pytest.raises(ValueError, match=r"'k' must be at most 6; got 9 for cloud 1, .*allow_fewer"):
        dp.farthest_point_sample(points[:, 0], 9, lengths=torch.tensor([50, 6]))
    with pytest.raises(ValueError, match="'k' must be at least 0; got -2 for cloud 1"):
        dp.farthest_point_sample(points[0], torch.tensor([3, -2]))
    with pytest.raises(ValueError, match="'start' must be at most 19; got 20 for cloud 1"):
        dp.farthest_point_sample(points[0], 3, start=torch.tensor([3, 20]), lengths=lengths[0])
    with pytest.raises(ValueError, match=r"'k' must have shape \(2,\); got \(3,\)"):
        dp.farthest_point_sample(points[0], torch.tensor([3, 2, 1]))


def test_clouds_with_too_few_points_are_chosen_whole_on_request():
    points, lengths = random(3, 30, 3), torch.tensor([30, 4, 0])
    chosen = dp.farthest_point_sample(points, 10, lengths=lengths, allow_fewer=True)
    assert ((chosen >= 0).sum(-1) == torch.tensor([10, 4, 0])).all()
    assert chosen[1, :4].sort().values.tolist() == [0, 1, 2, 3]
    assert dp.farthest_point_sample(torch.zeros(2, 0, 3), 3, allow_fewer=True).tolist() == [[-1] * 3] * 2
    with pytest.raises(ValueError, match="allow_fewer"):
        dp.farthest_point_sample(torch.zeros(2, 0, 3), 3)


def test_random_starts_are_those_of_the_generator():
    points, lengths = random(200, 12, 3), torch.tensor([12, 3]).repeat(100)

    def starts(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return dp.farthest_point_sample(points, 2, start="random", lengths=lengths, generator=generator)

    first = starts(0)
    assert torch.equal(first, starts(0))
    assert not torch.equal(first, starts(1))
    assert first[::2, 0].unique().tolist() == [*range(12)]
    assert first[1::2, 0].unique().tolist() == [0, 1, 2]
    expected = reference.farthest_point_sample(points, 2, start=first[:, 0], lengths=lengths)
    assert torch.equal(first, expected)
    torch.manual_seed(0)
    again = dp.farthest_point_sample(points, 2, start="random", lengths=lengths)
    torch.manual_seed(0)
    assert torch.equal(again, dp.farthest_point_sample(points, 2, start="random", lengths=lengths))
    with pytest.raises(ValueError, match=r"'start' must be an integer.* or 'random'; got 'farthest'"):
        dp.farthest_point_sample(points, 2, start="farthest")
    with pytest.raises(ValueError, match="'generator' must be None without start='random'"):
        dp.farthest_point_sample(points, 2, generator=torch.Generator())


def test_farthest_points_cover_better_than_random_ones():
    points = random(1, 2000, 3)
    chosen = torch.take_along_dim(points, dp.farthest_point_sample(points, 64)[..., None], 1)
    scattered = points[:, torch.randperm(2000, generator=torch.Generator().manual_seed(1))[:64]]
    radius = [
        dp.nearest(points, subset).squared_distance.max().sqrt().item() for subset in (chosen, scattered)
    ]
    assert radius[0] < 0.7 * radius[1]


def three_pairs(n: int, m: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(n + m)
    a, b = (torch.rand(3, size, 3, generator=generator, dtype=torch.float64) for size in (n, m))
    return a.to(dtype), b.to(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (20, 33), (33, 20), (40, 40)])
@pytest.mark.parametrize("change", ["nothing", "a little", "everything", "scale"])
def test_tolerance_and_bound_hold_for_any_start(dtype, n, m, change):
    a, b = three_pairs(n, m, dtype)
    lengths = {
        "a_lengths": torch.tensor([n, max(n // 2, 1), n]),
        "b_lengths": torch.tensor([m, m, max(m // 3, 1)]),
    }
    start = dp.earth_mover_distance(a, b, **lengths)  # pyright: ignore
    if change == "a little":
        a = a + 0.01 * torch.sin(torch.arange(n, dtype=dtype))[:, None]
    elif change == "everything":
        a, b = 1 - a.flip(2), b.flip(1) + 3
        lengths = {name: value.flip(0) for name, value in lengths.items()}
    elif change == "scale":
        a, b = a * 1e-3, b * 1e-3
    result = dp.earth_mover_distance(a, b, start=start, tolerance=1e-3, **lengths)  # pyright: ignore
    exact, _ = reference.earth_mover_distance(a, b, **lengths)
    rounding = 1e-6 if dtype == torch.float32 else 1e-12
    assert result.converged.all()
    assert (result.cost >= exact - rounding).all()
    assert (result.cost <= exact + result.bound + rounding).all()
    assert (result.bound <= 1e-3 * result.cost + rounding).all()
    for i in range(3):
        partners = result.assignment[i][result.assignment[i] >= 0]
        assert (
            len(partners) == min(lengths["a_lengths"][i], lengths["b_lengths"][i]) == len(partners.unique())
        )
    assert result.prices.shape == (3, max(n, m))
    assert (result.prices >= 0).all()
    assert (result.prices.amin(1) == 0).all()


def test_the_auction_ends_with_extreme_start_prices():
    a, b = three_pairs(50, 50)
    start = dp.earth_mover_distance(a, b)
    generator = torch.Generator().manual_seed(0)
    scattered = torch.rand(3, 50, generator=generator, dtype=torch.float64)
    for prices in (1e12 * scattered, -1e300 * scattered, scattered - 1e300):
        result = dp.earth_mover_distance(a, b, start=start._replace(prices=prices))
        assert result.converged.all()
        assert (result.cost - result.bound <= start.cost).all()
        assert (start.cost - start.bound <= result.cost).all()


def test_prices_do_not_grow_from_start_to_start():
    a, b = three_pairs(30, 60)
    first = result = dp.earth_mover_distance(a, b)
    for _ in range(50):
        result = dp.earth_mover_distance(a, b, start=result)
    assert result.prices.max() <= first.prices.max() + (b - a.mean(1, keepdim=True)).norm(dim=-1).max()


def test_a_start_does_not_change_the_gradient():
    a, b = three_pairs(20, 20)
    start = dp.earth_mover_distance(a, b)
    a.requires_grad_()
    exact = [dp.earth_mover_distance(a, b, tolerance=1e-9, start=s) for s in (None, start)]
    assert torch.equal(exact[0].assignment, exact[1].assignment)
    gradients = [torch.autograd.grad(result.cost.sum(), a)[0] for result in exact]
    assert torch.equal(gradients[0], gradients[1])


def test_a_wrong_start_is_refused_by_name():
    a, b = three_pairs(10, 12)
    start = dp.earth_mover_distance(a, b)
    with pytest.raises(TypeError, match=r"earth_mover_distance: 'start' must be a Transport"):
        dp.earth_mover_distance(a, b, start=start.prices)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'start.prices' must have shape \(3, 13\)"):
        dp.earth_mover_distance(a, torch.cat((b, b[:, :1]), 1), start=start)
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'start.prices' must be finite"):
        dp.earth_mover_distance(a, b, start=start._replace(prices=start.prices / 0))
    with pytest.raises(TypeError, match=r"'start.prices' must have the dtype of 'a'"):
        dp.earth_mover_distance(a.float(), b.float(), start=start)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sets_that_span_too_much_are_refused_and_the_padding_is_ignored(dtype):
    a, b = three_pairs(5, 6, dtype)
    a[1, 4, 2] = 3e19
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'a' must span less than 1e18 .*3e\+19"):
        dp.earth_mover_distance(a, b)
    counted = dp.earth_mover_distance(a, b, a_lengths=torch.tensor([5, 4, 5]))
    assert counted.converged.all()
    a[1, 4, 2] = 3e9
    with pytest.raises(ValueError, match=r"'a' must span less than 1e9 .* squared distances; got 3e\+09"):
        dp.earth_mover_distance(a, b, squared=True)
    a[1, 4, 2] = 1e17
    wide = dp.earth_mover_distance(a, b)
    exact, _ = reference.earth_mover_distance(a, b)
    torch.testing.assert_close(wide.cost, exact, rtol=2e-2, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (20, 33), (33, 20), (40, 40)])
@pytest.mark.parametrize("started", [False, True])
def test_enough_ends_the_auction_once_the_bound_reaches_it_and_changes_nothing_else(dtype, n, m, started):
    a, b = three_pairs(n, m, dtype)
    start = dp.earth_mover_distance(a, b) if started else None
    usual = dp.earth_mover_distance(a, b, start=start)
    exact, _ = reference.earth_mover_distance(a, b)
    # Far below the optimum, a little below, and above.
    enough = exact * torch.tensor([0.2, 0.9, 1.1], dtype=dtype)
    result = dp.earth_mover_distance(a, b, start=start, enough=enough)
    rounding = 1e-6 if dtype == torch.float32 else 1e-12
    assert result.converged.all()
    assert (result.cost[:2] >= enough[:2] - rounding).all()
    assert (result.cost >= exact - rounding).all()
    assert (result.cost <= exact + result.bound + rounding).all()
    torch.testing.assert_close([v[2] for v in result], [v[2] for v in usual], rtol=0, atol=0)
    smaller = result.assignment if n <= m else None
    if smaller is not None:
        assert all(row.unique().numel() == n and int(row.min()) >= 0 for row in smaller)


def test_enough_for_clouds_far_apart_needs_no_bids():
    a, b = three_pairs(50, 50)
    far = b + 10
    result = dp.earth_mover_distance(a, far, enough=torch.full((3,), 5.0, dtype=torch.float64))
    assert torch.equal(result.assignment, torch.arange(50).expand(3, -1))
    assert not result.prices.any()


def test_enough_must_fit_the_three_pairs():
    a, b = three_pairs(5, 5)
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'enough' must have shape \(3,\)"):
        dp.earth_mover_distance(a, b, enough=torch.ones(2, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"earth_mover_distance: 'enough'"):
        dp.earth_mover_distance(a, b, enough=torch.ones(3))
