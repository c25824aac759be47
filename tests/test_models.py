"""The generator: sizes, the one pass of the trunk, what image and code do to a fresh network's output."""

import dataclasses

import pytest
import torch

from models import PROFILES, GeneratorConfig, build_generator


def _blobs(count: int) -> torch.Tensor:
    """White images, each with one dark rectangle somewhere else."""
    images = torch.ones(count, 3, 64, 64)
    for index in range(count):
        images[index, index % 3, 8 + 4 * index : 30 + 4 * index, 10:40] = 0.2
    return images


@pytest.mark.parametrize(("profile", "points"), [("full", 2048), ("cpu", 512), ("smoke", 128)])
def test_every_profile_has_its_number_of_points(profile: str, points: int) -> None:
    config = PROFILES[profile]
    assert config.points == points
    assert config.fc_points * 3 == config.conv_points


def test_full_profile_has_the_papers_parameter_count() -> None:
    with torch.device("meta"):
        model = build_generator("full")
    assert sum(p.numel() for p in model.parameters()) == pytest.approx(40.73e6, rel=1e-3)


@pytest.mark.parametrize("size", [(48, 64), (56, 56), (131, 97)])
def test_any_image_size_is_accepted(size: tuple[int, int]) -> None:
    model = build_generator("smoke")
    clouds = model(torch.rand(2, 3, *size), torch.randn(3, 2, model.code_dim))
    assert clouds.shape == (3, 2, 128, 3)


def test_one_pass_of_the_trunk_equals_one_pass_per_code() -> None:
    torch.manual_seed(0)
    model = build_generator("smoke")
    images, codes = _blobs(2), torch.randn(3, 2, model.code_dim)
    passes = []
    model.trunk.register_forward_hook(lambda *_: passes.append(1))
    together = model(images, codes)
    assert len(passes) == 1
    apart = torch.stack([model(images, codes[r : r + 1])[0] for r in range(3)])
    torch.testing.assert_close(together, apart)


def test_codes_and_images_keep_their_places() -> None:
    """Row (r, b) depends on code (r, b) and image b alone."""
    torch.manual_seed(0)
    model = build_generator("smoke")
    images, codes = _blobs(3), torch.randn(2, 3, model.code_dim)
    before = model(images, codes)
    codes[1, 2] += 1.0
    images[0] *= 0.5
    changed = (model(images, codes) - before).abs().amax((2, 3)) > 1e-6
    assert changed.tolist() == [[True, False, False], [True, False, True]]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("profile", ["cpu", "smoke"])
def test_a_fresh_network_listens_to_image_and_code(profile: str, seed: int) -> None:
    """The signal of the image must not fade on its way through the trunk."""
    torch.manual_seed(seed)
    model = build_generator(profile)
    codes = torch.randn(2, 1, model.code_dim).expand(2, 4, -1)
    with torch.no_grad():
        clouds = model(_blobs(4), codes)
        alive = model.encode(_blobs(4)).amax((0, 2, 3)) > 0
    by_image = (clouds[0, 1:] - clouds[0, :-1]).abs().mean()
    by_code = (clouds[0] - clouds[1]).abs().mean()
    assert alive.float().mean() > 0.8
    assert 0.01 < clouds.std() < 0.3
    assert by_image > 0.03 * clouds.std()
    assert by_code > 0.03 * clouds.std()


def test_the_deterministic_counterpart_ignores_codes_and_has_no_branch_for_them() -> None:
    torch.manual_seed(0)
    model = build_generator("smoke", deterministic=True)
    clouds = model(_blobs(2), torch.randn(3, 2, model.code_dim))
    assert clouds.shape == (3, 2, 128, 3)
    assert torch.equal(clouds[0], clouds[1])
    assert not any("code_branch" in name for name, _ in model.named_parameters())
    assert not torch.equal(clouds[0, 0], clouds[0, 1])


def test_gradient_reaches_every_parameter_and_the_codes() -> None:
    torch.manual_seed(0)
    model = build_generator("smoke")
    codes = torch.randn(1, 2, model.code_dim, requires_grad=True)
    model(_blobs(2), codes).pow(2).sum().backward()
    assert codes.grad is not None
    assert codes.grad.abs().sum() > 0
    silent = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert silent == []


def test_sizes_of_ones_own() -> None:
    config = dataclasses.replace(PROFILES["smoke"], image_height=64, image_width=64)
    model = build_generator(config=config)
    clouds = model(torch.rand(1, 3, 20, 20), torch.randn(1, 1, model.code_dim))
    assert clouds.shape[2] == model.points == 128 + 42


def test_wrong_arguments_are_named() -> None:
    model = build_generator("smoke")
    with pytest.raises(ValueError, match="profile"):
        build_generator("huge")
    with pytest.raises(ValueError, match="multiples of 8"):
        GeneratorConfig(image_height=50)
    with pytest.raises(ValueError, match="'images'"):
        model(torch.rand(3, 64, 64), torch.randn(1, 1, model.code_dim))
    with pytest.raises(ValueError, match="'codes'"):
        model(torch.rand(2, 3, 64, 64), torch.randn(1, 3, model.code_dim))


@pytest.mark.parametrize("output_head", ["points", "latent"])
def test_bfloat16_predicts_nearly_the_same_points_in_full_resolution(output_head):
    torch.manual_seed(0)
    model = build_generator("smoke", output_head=output_head)
    with torch.no_grad():
        for parameter in model.parameters():  # clouds as large as objects
            parameter.mul_(1.2)
    images, codes = torch.rand(2, 3, 48, 64), torch.randn(3, 2, model.code_dim)
    exact = model(images, codes)
    model.computes_in = torch.bfloat16
    rough = model(images, codes)
    assert rough.dtype == torch.float32
    assert not torch.equal(rough, rough.bfloat16().float())
    assert 0 < (rough - exact).abs().mean() < 0.02 * exact.std()
    rough.square().sum().backward()
    trunk = next(model.trunk.parameters())
    assert trunk.grad is not None and trunk.grad.dtype == torch.float32
    assert trunk.grad.abs().sum() > 0
