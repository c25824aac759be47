"""Metrics of several completions: what they measure, by hand and under changes that must not matter."""

import pytest
import torch

import diffpoint as dp
from diffpoint import completion


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5


def at(*places: float) -> torch.Tensor:
    """Clouds of one point each on the x axis (K, 1, 3)."""
    return torch.tensor(places, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0, 0])


@pytest.mark.parametrize("squared", [True, False])
def test_by_hand(squared):
    """Of single points, the chamfer distance is twice the distance, or its square."""
    power = 2 if squared else 1
    matched = dp.minimal_matching_distance(at(0, 3, 10), at(1, 9, 4.5), squared=squared, reduction="none")
    assert matched.tolist() == [2 * d**power for d in (1, 1, 1.5)]
    assert dp.minimal_matching_distance(at(0, 3, 10), at(1, 9, 4.5), squared=squared) == matched.mean()
    # Completion 0: mean of 1 and 3; completion 1: of 1 and 2; completion 3: of 3 and 2.
    expected = sum(2 * (a**power + b**power) / 2 for a, b in ((1, 3), (1, 2), (3, 2)))
    assert dp.total_mutual_difference(at(0, 1, 3), squared=squared).item() == pytest.approx(expected)


def test_fidelity_counts_what_is_lost_of_the_input_and_not_what_is_added():
    partial = torch.cat((at(0)[0], at(1)[0]))
    keeps, loses = torch.cat((partial, at(50)[0])), at(0)[0].expand(3, 3)
    assert dp.unidirectional_hausdorff_distance(partial, keeps[None]) == 0
    assert dp.unidirectional_hausdorff_distance(partial, torch.stack((keeps, loses))) == 0.5
    one = dp.unidirectional_hausdorff_distance(partial, loses[None], partial_lengths=torch.tensor(1))
    assert one == 0


@pytest.mark.parametrize("at_once", [1, 1000, 2**22])
def test_the_matching_does_not_depend_on_how_many_pairs_are_held(at_once, monkeypatch):
    samples, references = random(2, 5, 30, 3), random(2, 7, 40, 3, seed=1)
    pairs = [
        [[sum(dp.chamfer_distance(s, r, squared=True)).item() for s in of] for r in against]
        for of, against in zip(samples, references, strict=True)
    ]
    monkeypatch.setattr(completion, "_POINTS_AT_ONCE", at_once)
    matched = dp.minimal_matching_distance(samples, references, squared=True, reduction="none")
    assert torch.equal(matched, torch.tensor(pairs, dtype=torch.float64).amin(-1))


def test_identical_completions_do_not_differ_and_have_no_gradient():
    clouds = random(1, 30, 3).expand(4, 30, 3).contiguous().requires_grad_()
    difference = dp.total_mutual_difference(clouds, squared=False)
    difference.backward()
    assert difference == 0
    assert not clouds.grad.any()


def test_it_is_the_consistency_loss_times_the_number_of_completions():
    clouds = random(2, 5, 30, 3)
    difference = dp.total_mutual_difference(clouds, squared=False, reduction="none")
    assert torch.allclose(difference, 5 * dp.consistency_loss(clouds, reduction="none"))


def test_they_scale_as_lengths_and_forget_the_order_and_the_place_of_shapes():
    clouds, references, partial = random(4, 30, 3), random(6, 40, 3, seed=1), random(20, 3, seed=2)
    turned = torch.linalg.qr(random(3, 3, seed=3)).Q

    def metrics(change):
        shapes = change(clouds)
        return [
            dp.minimal_matching_distance(shapes, change(references), squared=False).item(),
            dp.total_mutual_difference(shapes, squared=False).item(),
            dp.unidirectional_hausdorff_distance(change(partial), shapes).item(),
        ]

    before = metrics(lambda x: x)
    assert metrics(lambda x: x @ turned.T + 3) == pytest.approx(before)
    assert metrics(lambda x: 2 * x) == pytest.approx([2 * value for value in before])
    assert metrics(lambda x: x.flip(0)) == pytest.approx(before)


def test_what_cannot_be_compared_is_refused():
    clouds = random(4, 30, 3)
    for call, message in (
        (lambda: dp.total_mutual_difference(clouds[:1], squared=True), "'clouds' must hold at least two"),
        (
            lambda: dp.minimal_matching_distance(clouds[:0], clouds, squared=True),
            "'samples' must hold at least one cloud",
        ),
        (
            lambda: dp.minimal_matching_distance(clouds, clouds[:0], squared=True),
            "'references' must hold at least one cloud",
        ),
        (
            lambda: dp.minimal_matching_distance(clouds, clouds[None], squared=True),
            r"'references' must have shape \(R, M, 3\)",
        ),
        (
            lambda: dp.unidirectional_hausdorff_distance(clouds[0], clouds[:0]),
            "'completions' must hold at least one cloud",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="squared"):
        dp.total_mutual_difference(clouds)
