"""Search and descent on the codes: agreement grows, the network stays as it is, objects do not meet."""

from __future__ import annotations

import pytest
import torch

from diffpoint import consistency_loss
from models import Generator, build_generator
from train.inference import reconstruct


@pytest.fixture(scope="module")
def model() -> Generator:
    torch.manual_seed(0)
    return build_generator("smoke").eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """(2, 3, 3, 48, 64): two objects in three views each."""
    generator = torch.Generator().manual_seed(1)
    images = torch.ones(2, 3, 3, 48, 64)
    images[..., 10:40, 12:50] = torch.rand(2, 3, 3, 30, 38, generator=generator)
    return images


def test_search_and_descent_bring_agreement(model: Generator, images: torch.Tensor) -> None:
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    found = reconstruct(model, images, groups=3, steps=8, step_size=2.0)
    assert found.points.shape == (2, 3 * model.points, 3)
    assert found.history.shape == (9, 2)
    assert (found.history[-1] < found.history[0]).all()
    one_by_one = found.points.unflatten(1, (3, model.points))
    torch.testing.assert_close(found.history[-1], 100 * consistency_loss(one_by_one, reduction="none"))
    torch.testing.assert_close(
        one_by_one.flatten(0, 1), model(images.flatten(0, 1), found.codes.flatten(0, 1)[None])[0].detach()
    )
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())


def test_the_descent_starts_from_the_most_consistent_group(model: Generator, images: torch.Tensor) -> None:
    starts = [reconstruct(model, images, groups=groups, steps=0).history[0] for groups in (1, 2, 5)]
    assert (starts[1] <= starts[0]).all()
    assert (starts[2] <= starts[1]).all()
    assert (starts[2] < starts[0]).any()


def test_the_codes_move_only_by_the_descent(model: Generator, images: torch.Tensor) -> None:
    searched = reconstruct(model, images, groups=2, steps=0).codes
    descended = reconstruct(model, images, groups=2, steps=2).codes
    moved = (descended - searched).norm(dim=-1)
    assert (moved > 0).all()
    assert torch.equal(searched, reconstruct(model, images, groups=2, steps=2, step_size=0.0).codes)


def test_objects_do_not_interact(model: Generator, images: torch.Tensor) -> None:
    together = reconstruct(model, images, groups=2, steps=3)
    other = images.clone()
    other[1] = other[1].flip(-1) * 0.5
    beside_another = reconstruct(model, other, groups=2, steps=3)
    torch.testing.assert_close(together.points[0], beside_another.points[0])
    assert not torch.allclose(together.points[1], beside_another.points[1])


def test_the_seed_decides(model: Generator, images: torch.Tensor) -> None:
    first, again, other = (reconstruct(model, images, groups=2, steps=1, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.codes, other.codes)


def test_one_object_needs_no_batch_dimension(model: Generator, images: torch.Tensor) -> None:
    assert torch.equal(
        reconstruct(model, images[0], groups=2, steps=1).points,
        reconstruct(model, images[:1], groups=2, steps=1).points,
    )


def test_one_view_has_nothing_to_agree_with(model: Generator, images: torch.Tensor) -> None:
    found = reconstruct(model, images[:, :1], groups=2, steps=5)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, model.points, 3)


def test_a_deterministic_network_has_nothing_to_choose(images: torch.Tensor) -> None:
    plain = build_generator("smoke", deterministic=True)
    found = reconstruct(plain, images)
    assert found.history.shape == (0, 2)
    assert found.points.shape == (2, 3 * plain.points, 3)


def test_wrong_arguments_are_named(model: Generator) -> None:
    with pytest.raises(ValueError, match=r"'images' must be .* got \(3, 48, 64\)"):
        reconstruct(model, torch.ones(3, 48, 64))
    with pytest.raises(ValueError, match="groups >= 1"):
        reconstruct(model, torch.ones(2, 3, 48, 64), groups=0)
