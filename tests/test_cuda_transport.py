"""The earth mover's distance on CUDA tensors: on a GPU where there is one, else in Triton's interpreter.

Sizes are small because the interpreter takes tens of milliseconds for a bid.
"""

import re
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from test_operators import operator_arguments

import diffpoint as dp
from diffpoint import _auction

pytest.importorskip("triton", reason="triton has no wheel here")
import triton.language as tl
from cuda_launches import DEVICE, ON_GPU, WARNINGS, compile_launches, on_cpu, recorded_launches

from diffpoint.cuda import transport

pytestmark = pytest.mark.filterwarnings(*WARNINGS)
DTYPES = (torch.float32, torch.float64)
ROUNDING = {torch.float32: 1e-6, torch.float64: 1e-12}
LAUNCHES: dict[str, dict] = {}


@pytest.fixture(autouse=True)
def cuda_kernels() -> Iterator[None]:
    with recorded_launches(LAUNCHES):
        yield


@pytest.fixture
def small_tiles(monkeypatch) -> None:
    """Makes every loop over tiles one of several rounds; on a GPU `test_many_points` does."""
    if ON_GPU:
        return
    sizes = {"_PERSONS": 2, "_OBJECTS": 4, "_FEW": 2, "_CHAIN": 4, "_LINE": 4, "_MEASURED": 2}
    for name, size in sizes.items():
        monkeypatch.setattr(transport, name, tl.constexpr(size))


def random(*shape: int, seed: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    points = torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return points.to(DEVICE, dtype)


def optimum(a: torch.Tensor, b: torch.Tensor, *, squared: bool = False) -> float:
    a, b = a.double().cpu(), b.double().cpu()
    matrix = np.linalg.norm(a.numpy()[:, None] - b.numpy()[None], axis=-1)
    matrix = matrix**2 if squared else matrix
    rows, columns = linear_sum_assignment(matrix)
    return float(matrix[rows, columns].mean())


def assert_near_optimum(
    result: dp.Transport,
    a: torch.Tensor,
    b: torch.Tensor,
    lengths: list[tuple[int, int]],
    *,
    tolerance: float = 0.02,
    converged: bool = True,
    squared: bool = False,
) -> None:
    """One-to-one assignments whose cost and bound are right; within the tolerance if they should be."""
    rounding = ROUNDING[a.dtype]
    for pair, (n, m) in enumerate(lengths):
        x, y, assignment = a[pair, :n], b[pair, :m], result.assignment[pair]
        cost, bound = float(result.cost[pair]), float(result.bound[pair])
        matched = torch.nonzero(assignment >= 0)[:, 0]
        partners = assignment[matched]
        assert len(partners) == min(n, m) == len(partners.unique())
        assert (matched < n).all()
        assert (partners < m).all()
        apart = (x[matched] - y[partners]).norm(dim=-1)
        assert cost == pytest.approx(float((apart**2 if squared else apart).mean()), abs=rounding)
        assert -rounding <= cost - optimum(x, y, squared=squared) <= bound + rounding
        assert bool(result.converged[pair]) == converged
        if converged:
            assert bound <= tolerance * cost + rounding
        prices = result.prices[pair]
        assert prices[: max(n, m)].min() == 0
        assert not prices[max(n, m) :].any()


@pytest.mark.parametrize(
    ("dtype", "tolerance", "tiles", "squared"),
    [
        (torch.float32, 0.02, "small_tiles", False),
        (torch.float64, 1e-3, None, False),
        (torch.float32, 0.02, None, True),
        (torch.float64, 1e-3, "small_tiles", True),
    ],
)
def test_emd_is_within_its_bound_and_tolerance(dtype, tolerance, tiles, squared, request):
    if tiles:
        request.getfixturevalue(tiles)
    lengths = [(1, 6), (9, 9), (4, 10), (9, 3), (1, 1)]
    a, b = random(5, 9, 3, seed=1, dtype=dtype), random(5, 10, 3, seed=2, dtype=dtype)
    for pair, (n, m) in enumerate(lengths):
        a[pair, n:], b[pair, m:] = torch.nan, torch.nan  # must not be read
    la, lb = torch.tensor(lengths, device=DEVICE).T
    result = dp.earth_mover_distance(a, b, squared=squared, a_lengths=la, b_lengths=lb, tolerance=tolerance)
    assert_near_optimum(result, a, b, lengths, tolerance=tolerance, squared=squared)


def test_few_points_and_many():
    lengths = [(2100, 2), (5, 300)]
    a, b = random(2, 2100, 3, seed=1), random(2, 300, 3, seed=2)
    la, lb = torch.tensor(lengths, device=DEVICE).T
    assert_near_optimum(dp.earth_mover_distance(a, b, a_lengths=la, b_lengths=lb), a, b, lengths)


def test_the_same_bits_on_every_run():
    a, b = random(1, 6, 3, seed=1), random(1, 7, 3, seed=2)
    first, second = (dp.earth_mover_distance(a, b) for _ in range(2))
    assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))


@pytest.mark.skipif(not ON_GPU, reason="the interpreter would take hours")
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(2048, 2048), (1500, 2048), (3000, 700)])
def test_many_points(dtype, n, m):
    a, b = random(2, n, 3, seed=1, dtype=dtype), random(2, m, 3, seed=2, dtype=dtype)
    results = [dp.earth_mover_distance(a, b) for _ in range(3)]
    assert_near_optimum(results[0], a, b, [(n, m)] * 2)
    assert all(torch.equal(x, y) for other in results for x, y in zip(results[0], other, strict=True))


def test_emd_of_a_permuted_copy_is_zero_and_finds_the_permutation():
    a = random(1, 12, 3, seed=1)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    result = dp.earth_mover_distance(a[:, order], a)
    assert result.cost.item() == 0
    assert torch.equal(result.assignment[0], order)


@pytest.mark.usefixtures("small_tiles")
def test_points_in_one_place():
    a = random(1, 1, 3, seed=1).expand(1, 5, 3)
    b = random(1, 6, 3, seed=2)
    b[:, 4:] = b[:, :1]  # duplicates
    assert_near_optimum(dp.earth_mover_distance(a, a), a, a, [(5, 5)])
    assert_near_optimum(dp.earth_mover_distance(a, b), a, b, [(5, 6)])
    assert_near_optimum(dp.earth_mover_distance(b, a[:, :4]), b, a, [(6, 4)])


@pytest.mark.parametrize(("dtype", "n", "m"), [(torch.float32, 4, 7), (torch.float64, 6, 6)])
def test_any_start(dtype, n, m):
    a, b = random(1, n, 3, seed=3, dtype=dtype), random(1, m, 3, seed=4, dtype=dtype)
    start = dp.earth_mover_distance(a, b)
    moved = a + 0.01 * torch.sin(torch.arange(n, device=DEVICE, dtype=dtype))[:, None]
    scattered = random(1, max(n, m), seed=5, dtype=dtype)
    large = 1e12 if dtype == torch.float64 else 3e38
    starts = [start, start._replace(prices=large * (scattered - 0.5)), start._replace(cost=1e9 * start.cost)]
    for wild in starts:
        result = dp.earth_mover_distance(moved, b, start=wild, tolerance=1e-3)
        assert_near_optimum(result, moved, b, [(n, m)], tolerance=1e-3)


def test_a_start_saves_bids(monkeypatch):
    """The result of the same pair is a start from which one phase is enough."""
    a, b = random(1, 8, 3, seed=3), random(1, 8, 3, seed=4)
    start = dp.earth_mover_distance(a, b)
    monkeypatch.setattr(_auction, "BIDS_PER_PERSON", 3)
    assert not dp.earth_mover_distance(a, b).converged
    assert dp.earth_mover_distance(a, b, start=start).converged


@pytest.mark.parametrize("started", [False, True])
def test_enough_ends_the_auction_once_the_bound_reaches_it(started):
    a, b = random(3, 5, 3, seed=3, dtype=torch.float64), random(3, 7, 3, seed=4, dtype=torch.float64)
    start = dp.earth_mover_distance(a, b) if started else None
    usual = dp.earth_mover_distance(a[2:], b[2:], start=start and dp.Transport(*(x[2:] for x in start)))
    exact = torch.tensor([optimum(x, y) for x, y in zip(a, b, strict=True)], dtype=a.dtype, device=DEVICE)
    # Far below the optimum, a little below, and above.
    enough = exact * torch.tensor([0.2, 0.9, 1.1]).to(a)
    result = dp.earth_mover_distance(a, b, start=start, enough=enough)
    assert result.converged.all()
    assert (result.cost >= torch.maximum(exact, enough * (exact > enough)) - 1e-12).all()
    assert (result.cost <= exact + result.bound + 1e-12).all()
    assert all(len(row.unique()) == 5 and row.min() >= 0 for row in result.assignment)
    for value, expected in zip(result, usual, strict=True):
        torch.testing.assert_close(value[2:], expected, rtol=0, atol=0)


def test_enough_for_clouds_far_apart_needs_no_bids():
    a, b = random(1, 10, 3, seed=3), random(1, 10, 3, seed=4)
    result = dp.earth_mover_distance(a, b + 10, enough=torch.full((1,), 5.0, device=DEVICE))
    assert torch.equal(result.assignment, torch.arange(10, device=DEVICE)[None])
    assert not result.prices.any()
    assert result.converged
    assert_near_optimum(result._replace(converged=torch.zeros(1)), a, b + 10, [(10, 10)], converged=False)


@pytest.mark.usefixtures("small_tiles")
@pytest.mark.parametrize("bids", [0, 1, 3])
def test_without_bids_left_the_rest_is_matched_in_order(monkeypatch, bids):
    monkeypatch.setattr(_auction, "BIDS_PER_PERSON", bids)
    lengths = [(8, 8), (5, 9), (9, 6)]
    a, b = random(3, 9, 3, seed=3), random(3, 9, 3, seed=4)
    la, lb = torch.tensor(lengths, device=DEVICE).T
    result = dp.earth_mover_distance(a, b, a_lengths=la, b_lengths=lb, tolerance=1e-5)
    assert_near_optimum(result, a, b, lengths, converged=False)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("squared", [False, True])
def test_the_gradient_is_that_of_the_cpu_for_the_same_assignment(dtype, squared):
    lengths = torch.tensor([[9, 5], [4, 7]], device=DEVICE)
    a, b = random(2, 9, 3, seed=1, dtype=dtype), random(2, 7, 3, seed=2, dtype=dtype)
    b[0, 2] = a[0, 3]  # no direction where matched points coincide
    a.requires_grad_()
    b.requires_grad_()
    result = dp.earth_mover_distance(a, b, squared=squared, a_lengths=lengths[:, 0], b_lengths=lengths[:, 1])
    weights = torch.tensor([1.0, -3.0], dtype=dtype, device=DEVICE)
    found = torch.autograd.grad((result.cost * weights).sum(), (a, b))
    backward = torch.ops.diffpoint.earth_mover_distance_backward
    arguments = a.detach(), b.detach(), result.assignment, weights / lengths.amin(1)
    expected = on_cpu(lambda: backward(*(x.cpu() for x in arguments), squared))
    for here, there in zip(found, expected, strict=True):
        torch.testing.assert_close(here.cpu(), there, rtol=0, atol=ROUNDING[dtype])
    assert not found[1][0, 2].any()
    if not squared:
        assert (found[0][1, :4].norm(dim=-1) - 0.75).abs().max() < 1e-6
    assert not found[0][1, 4:].any()


def test_the_operator_passes_opcheck():
    arguments = on_cpu(operator_arguments)["earth_mover_distance"]
    moved = [
        x.detach().to(DEVICE).requires_grad_(x.requires_grad) if torch.is_tensor(x) else x for x in arguments
    ]
    torch.library.opcheck(torch.ops.diffpoint.earth_mover_distance.default, tuple(moved))


POINTS = random(2, 6, 3, seed=6)
THIRD = torch.tensor([3], device=DEVICE)
BAD, INFINITE, WIDE = (POINTS.index_fill(1, THIRD, value) for value in (torch.nan, torch.inf, 3e19))
BAD_CALLS = {
    "a": (lambda: dp.earth_mover_distance(BAD, POINTS), "'a' must be finite; got nan at index (0, 3, 0)"),
    "b": (lambda: dp.earth_mover_distance(POINTS, INFINITE), "'b' must be finite; got inf at index (0, 3, 0)"),
    "too many": (
        lambda: dp.earth_mover_distance(POINTS, POINTS, a_lengths=torch.tensor([6, 7], device=DEVICE)),
        "'a_lengths' must lie in [1, 6]; got 7 at flat index 1",
    ),
    "none": (
        lambda: dp.earth_mover_distance(POINTS, POINTS, b_lengths=torch.tensor([-2, 0], device=DEVICE)),
        "'b_lengths' must lie in [1, 6]; got -2 at flat index 0",
    ),
    "empty": (lambda: dp.earth_mover_distance(POINTS, POINTS[:, :0]), "'b' must hold at least one point"),
    "extent": (lambda: dp.earth_mover_distance(WIDE, POINTS), "'a' must span less than 1e18 together with 'b'"),
    "extent of squares": (
        lambda: dp.earth_mover_distance(WIDE / 1e9, POINTS, squared=True),
        "'a' must span less than 1e9 together with 'b' for squared distances",
    ),
    "prices": (lambda: from_start(prices=POINTS[..., 0] / 0), "'start.prices' must be finite"),
    "cost": (lambda: from_start(cost=POINTS[:, 0, 0] / 0), "'start.cost' must be finite"),
}  # fmt: skip


def from_start(**changes: torch.Tensor) -> dp.Transport:
    start = dp.Transport(*(x.to(DEVICE) for x in on_cpu(dp.earth_mover_distance, POINTS, POINTS.flip(2))))
    return dp.earth_mover_distance(POINTS, POINTS.flip(2), start=start._replace(**changes))


@pytest.mark.parametrize("case", BAD_CALLS)
@pytest.mark.skipif(ON_GPU, reason="on a GPU errors arrive later")
def test_values_that_are_not_allowed_are_named(case):
    call, message = BAD_CALLS[case]
    with pytest.raises(ValueError, match=re.escape(f"earth_mover_distance: {message}")):
        call()


@pytest.mark.parametrize("case", sorted(set(BAD_CALLS) - {"empty"}))
def test_the_auction_ends_with_values_that_are_not_allowed(case, monkeypatch):
    from diffpoint._runtime import RUNTIME

    monkeypatch.setattr(RUNTIME, "checks", "off")
    result = BAD_CALLS[case][0]()
    unusable = {"a": [0, 1], "b": [0, 1], "none": [0, 1], "extent": [0, 1], "extent of squares": [0, 1]}.get(
        case, []
    )
    for pair in range(2):
        if pair in unusable:
            assert result.cost[pair].isnan()
            assert result.bound[pair].isnan()
            assert not result.converged[pair]
            assert (result.assignment[pair] == -1).all()
            assert not result.prices[pair].any()
        else:
            assert result.converged[pair]
            assert result.assignment[pair].sort().values.tolist() == list(range(6))


@pytest.mark.parametrize("size", [0, 4])
def test_no_pairs(size):
    empty = torch.rand(0, size, 3, device=DEVICE)
    result = dp.earth_mover_distance(empty, empty)
    assert [tuple(x.shape) for x in result] == [(0,), (0, size), (0,), (0,), (0, size)]


# The last test: it compiles what the others have launched.
@pytest.mark.skipif(ON_GPU, reason="they have been compiled to run")
def test_kernels_compile_without_a_gpu(tmp_path):
    compile_launches(LAUNCHES, tmp_path)
