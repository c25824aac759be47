"""Random changes of training images: what they may change, and what must stay."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from train.data.augment import augment
from train.data.batches import load_split
from train.data.cutout import FILL, LONGEST


@pytest.fixture(scope="module")
def images(tiny_data: Path) -> torch.Tensor:
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    shapes = torch.arange(min(8, len(split)))
    return split.float_images(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))[:, 0]


def _changed(images: torch.Tensor, strength: float, seed: int = 0) -> torch.Tensor:
    return augment(images, strength, 100 * seed + torch.arange(len(images)))


def test_without_strength_an_image_stays_what_it_was(images: torch.Tensor) -> None:
    # Pixels whiter than 0.98 become white.
    assert (_changed(images, 0.0) - images).abs().max() < 0.021


def test_changes_follow_the_seeds_and_the_strength(images: torch.Tensor) -> None:
    changed = _changed(images, 1.0)
    assert torch.equal(changed, _changed(images, 1.0))
    assert not torch.equal(changed, _changed(images, 1.0, seed=1))
    alone = augment(images[2:4], 1.0, torch.tensor([2, 3]))
    torch.testing.assert_close(alone, changed[2:4])
    assert changed.shape == images.shape
    assert 0 <= changed.min() <= changed.max() <= 1
    slight = (_changed(images, 0.1) - images).abs().mean()
    assert 0 < slight < (changed - images).abs().mean() / 2


def test_every_image_is_changed_in_its_own_way_and_shows_its_object_still(images: torch.Tensor) -> None:
    same = images[:1].expand(6, -1, -1, -1)
    changed = torch.cat([_changed(same, 1.0, seed) for seed in range(4)])
    apart = torch.cdist(changed.flatten(1), changed.flatten(1))
    assert apart[~torch.eye(len(changed), dtype=torch.bool)].min() > 0.5
    was_object, is_object = (each.amin(1) < 0.7 for each in (images[:1], changed))
    overlap = (was_object & is_object).sum((1, 2)) / (was_object | is_object).sum((1, 2))
    assert overlap.min() > 0.5


def test_white_comes_in_from_outside_where_the_object_moves(images: torch.Tensor) -> None:
    dark = torch.zeros_like(images)
    moved = torch.cat([_changed(dark, 1.0, seed) for seed in range(8)])
    assert (moved[:, :, 0, 0] > 0.5).any(), "no corner was moved into the picture"
    middle = moved[:, :, 20:28, 28:36]
    assert middle.mean() < 0.1, "the object in the middle should have stayed dark"


def test_framed_images_show_the_object_as_photographs_do(images: torch.Tensor) -> None:
    seeds = torch.arange(len(images))
    assert torch.equal(augment(images, 0.0, seeds, framing=0.0), augment(images, 0.0, seeds))
    height, width = images.shape[-2:]
    for framed in augment(images, 0.0, seeds, framing=1.0):
        rows, columns = (framed.amin(0).amin(dim).lt(0.9).nonzero() for dim in (1, 0))
        ends = torch.tensor(
            [
                [rows.min() / height, columns.min() / width],
                [(rows.max() + 1) / height, (columns.max() + 1) / width],
            ]
        )
        extent = ends[1] - ends[0]
        assert ends.mean(0) == pytest.approx([0.5, 0.5], abs=0.03)
        assert extent.max() == pytest.approx(LONGEST, abs=0.06) or extent.norm() == pytest.approx(
            FILL, abs=0.06
        )
    white = torch.ones_like(images)
    torch.testing.assert_close(augment(white, 0.0, seeds, framing=1.0), white)


def test_framing_changes_its_share_of_the_images(images: torch.Tensor) -> None:
    same = images[:1].expand(400, -1, -1, -1)
    changed = augment(same, 0.0, torch.arange(400), framing=0.3)
    share = ((changed - same).abs().amax((1, 2, 3)) > 0.1).float().mean()
    assert 0.2 < share < 0.4


def test_a_framed_split_has_framed_pictures(tiny_data: Path) -> None:
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    shapes, views = torch.arange(3), torch.tensor([[0, 2], [1, 0], [2, 1]])
    images = split.float_images(shapes, views).flatten(0, 1)
    expected = augment(images, 0.0, torch.arange(6), framing=1.0)
    found = split.framed().float_images(shapes, views).flatten(0, 1)
    torch.testing.assert_close(
        found, expected, atol=0.03, rtol=0
    )  # pixels whiter than 0.98 become white there
    assert (found - images).abs().amax((1, 2, 3)).max() > 0.5
    assert split.framed().images[0][:].shape == split.images[0].shape
