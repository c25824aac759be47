"""The auction started from an earlier result: the same promises, whatever the prices; and errors named."""

import pytest
import torch

import diffpoint as dp
from diffpoint import reference

DTYPES = (torch.float32, torch.float64)


def clouds(n: int, m: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(n + m)
    a, b = (torch.rand(3, size, 3, generator=generator, dtype=torch.float64) for size in (n, m))
    return a.to(dtype), b.to(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (20, 33), (33, 20), (40, 40)])
@pytest.mark.parametrize("change", ["nothing", "a little", "everything", "scale"])
def test_a_start_keeps_every_promise(dtype, n, m, change):
    a, b = clouds(n, m, dtype)
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


def test_a_start_from_extreme_prices_ends():
    a, b = clouds(50, 50)
    start = dp.earth_mover_distance(a, b)
    generator = torch.Generator().manual_seed(0)
    scattered = torch.rand(3, 50, generator=generator, dtype=torch.float64)
    for prices in (1e12 * scattered, -1e300 * scattered, scattered - 1e300):
        result = dp.earth_mover_distance(a, b, start=start._replace(prices=prices))
        assert result.converged.all()
        assert (result.cost - result.bound <= start.cost).all()
        assert (start.cost - start.bound <= result.cost).all()


def test_prices_do_not_grow_from_start_to_start():
    a, b = clouds(30, 60)
    first = result = dp.earth_mover_distance(a, b)
    for _ in range(50):
        result = dp.earth_mover_distance(a, b, start=result)
    assert result.prices.max() <= first.prices.max() + (b - a.mean(1, keepdim=True)).norm(dim=-1).max()


def test_a_start_changes_no_gradient_formula():
    a, b = clouds(20, 20)
    start = dp.earth_mover_distance(a, b)
    a.requires_grad_()
    exact = [dp.earth_mover_distance(a, b, tolerance=1e-9, start=s) for s in (None, start)]
    assert torch.equal(exact[0].assignment, exact[1].assignment)
    gradients = [torch.autograd.grad(result.cost.sum(), a)[0] for result in exact]
    assert torch.equal(gradients[0], gradients[1])


def test_a_wrong_start_is_refused_by_name():
    a, b = clouds(10, 12)
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
def test_sets_that_span_too_much_are_refused_and_the_padding_is_not_looked_at(dtype):
    a, b = clouds(5, 6, dtype)
    a[1, 4, 2] = 3e19
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'a' must span less than 1e18 .*3e\+19"):
        dp.earth_mover_distance(a, b)
    counted = dp.earth_mover_distance(a, b, a_lengths=torch.tensor([5, 4, 5]))
    assert counted.converged.all()
    a[1, 4, 2] = 1e17
    wide = dp.earth_mover_distance(a, b)
    exact, _ = reference.earth_mover_distance(a, b)
    torch.testing.assert_close(wide.cost, exact, rtol=2e-2, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (20, 33), (33, 20), (40, 40)])
@pytest.mark.parametrize("started", [False, True])
def test_enough_ends_the_auction_where_it_is_proven_and_changes_nothing_elsewhere(dtype, n, m, started):
    a, b = clouds(n, m, dtype)
    start = dp.earth_mover_distance(a, b) if started else None
    usual = dp.earth_mover_distance(a, b, start=start)
    exact, _ = reference.earth_mover_distance(a, b)
    # Below what there is; a little below; above.
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


def test_enough_of_clouds_far_apart_is_proven_without_a_bid():
    a, b = clouds(50, 50)
    far = b + 10
    result = dp.earth_mover_distance(a, far, enough=torch.full((3,), 5.0, dtype=torch.float64))
    assert torch.equal(result.assignment, torch.arange(50).expand(3, -1))
    assert not result.prices.any()


def test_enough_must_fit_the_clouds():
    a, b = clouds(5, 5)
    with pytest.raises(ValueError, match=r"earth_mover_distance: 'enough' must have shape \(3,\)"):
        dp.earth_mover_distance(a, b, enough=torch.ones(2, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"earth_mover_distance: 'enough'"):
        dp.earth_mover_distance(a, b, enough=torch.ones(3))
