"""The networks: one interface, published sizes, dependence on image and code; grids, silhouettes and fixed cameras."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from diffpoint import PinholeCamera, splat_depth
from models import CODE_DIM, PROFILES, GeneratorConfig, Predictor, build_generator, widen
from models.baselines import (
    Baseline,
    R2N2Config,
    build_lin,
    build_psgn,
    build_ptn,
    build_r2n2,
    cell_centres,
    fixed_cameras,
    silhouettes,
    surface_points,
)

_BUILDERS: list[Callable[..., Predictor]] = [build_generator, build_psgn, build_lin, build_r2n2, build_ptn]


def _chain(kernel: int, *channels: int, biases: bool = True) -> int:
    """Parameters of a chain of layers, each seeing `kernel` places."""
    pairs = itertools.pairwise(channels)
    return sum(inputs * outputs * kernel + biases * outputs for inputs, outputs in pairs)


def _lin() -> int:
    encoder = _chain(9, 3, 96, 128, 192, 256, biases=False) + _chain(1, 4096, 2048, 1024, biases=False)
    code = _chain(1, 1024, 512) + _chain(1, 512, 1024, 2048, 4096, biases=False)
    decoder = _chain(9, 256, 192, 128, 96, 64, 48, biases=False) + 48 * 32
    return encoder + code + decoder + 4 * 8 * 128 * 128


def _r2n2() -> int:
    first = _chain(49, 3, 96) + _chain(9, 96, 96)
    blocks = _chain(9, 96, 128, 128) + _chain(9, 128, 256, 256) + 3 * _chain(9, 256, 256, 256)
    skips = _chain(1, 96, 128) + _chain(1, 128, 256)
    encoder = first + blocks + skips + _chain(1, 3 * 3 * 256, 1024)
    memory = 3 * (1024 * 128 * 64 + _chain(27, 128, 128))
    decoder = 2 * _chain(27, 128, 128, 128) + _chain(27, 128, 64, 64) + _chain(1, 128, 64)
    return encoder + memory + decoder + _chain(27, 64, 32, 32) + _chain(27, 64, 32) + _chain(27, 32, 2)


def _ptn() -> int:
    encoder = _chain(25, 3, 64, 128, 256) + _chain(1, 8 * 8 * 256, 1024, 1024, 512)
    decoder = _chain(1, 512, 512 * 27) + _chain(64, 512, 256) + _chain(125, 256, 96) + _chain(216, 96, 1)
    return encoder + decoder


@pytest.mark.parametrize(
    ("build", "millions", "by_hand"),
    [
        (build_generator, 40.73, None),
        (build_psgn, 39.70, None),
        (build_lin, 24.18, _lin),
        (build_r2n2, 35.93, _r2n2),
        (build_ptn, 37.96, _ptn),
    ],
)
def test_full_sizes_have_the_published_layers(
    build: Callable[[str], torch.nn.Module], millions: float, by_hand: Callable[[], int] | None
) -> None:
    count = sum(p.numel() for p in build("full").parameters())
    assert count == pytest.approx(1e6 * millions, abs=5_001)
    assert by_hand is None or count == by_hand()
    assert f"{millions:.2f} million" in (build.__doc__ or "")


@pytest.mark.parametrize("profile", ["cpu", "smoke"])
@pytest.mark.parametrize("build", _BUILDERS)
def test_all_networks_have_one_interface(build: Callable[[str], Predictor], profile: str) -> None:
    torch.manual_seed(0)
    network = build(profile).train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    images = torch.rand(2, 3, 50, 70)
    codes = torch.randn(3, 2, network.code_dim)
    with torch.no_grad():
        clouds = network(images, codes)
    assert clouds.shape[:2] == (3, 2)
    assert clouds.shape[2] >= network.points
    assert clouds.isfinite().all()
    assert torch.equal(clouds, network.decode(network.encode(images), codes))
    assert torch.equal(clouds[0], clouds[1]) == (not network.takes_codes)
    by_view = network.predict_views(images[:, None], codes[0, :, None])[:, 0]
    torch.testing.assert_close(by_view, clouds[0], rtol=0, atol=1e-6)
    assert network.training
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert network.profile == profile == network.config.profile


@pytest.mark.parametrize("build", _BUILDERS)
def test_several_views_of_an_object(build: Callable[[str], Predictor]) -> None:
    torch.manual_seed(0)
    network, images = build("smoke"), torch.rand(2, 3, 3, 32, 32)
    codes = torch.randn(2, 3, network.code_dim)
    clouds = network.predict_views(images, codes)
    assert not clouds.requires_grad
    assert clouds.shape[:2] == ((2, 1) if network.reads_views_together else (2, 3))
    if not network.reads_views_together:
        second = network.predict_views(images[:, 1:2], codes[:, 1:2])[:, 0]
        torch.testing.assert_close(clouds[:, 1], second, rtol=0, atol=1e-5)
    if network.takes_codes:
        with pytest.raises(ValueError, match="'codes' must be given"):
            network.predict_views(images)
    else:
        assert torch.equal(network.predict_views(images), clouds)


@pytest.mark.parametrize("build", _BUILDERS)
def test_wrong_arguments_are_named(build: Callable[[str], Predictor]) -> None:
    with pytest.raises(ValueError, match=r"build_\w+: 'profile'"):
        build("huge")
    network = build("smoke")
    with pytest.raises(ValueError, match="'images'"):
        network.predict_views(torch.rand(2, 3, 32, 32))
    with pytest.raises(ValueError, match="'codes'"):
        network(torch.rand(2, 3, 32, 32), torch.zeros(1, 3, network.code_dim))


def test_dead_channels_are_those_that_are_zero_everywhere() -> None:
    network = build_generator("smoke")
    features = torch.rand(2, 8, 3, 4)
    features[:, :2] = 0.0
    features[0, 2] = 0.0  # alive in the other image
    assert network.dead_share(features) == 0.25
    assert build_r2n2("smoke").dead_share(features) == 0.0


# --- the generator


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
def test_a_fresh_network_depends_on_image_and_code(profile: str, seed: int) -> None:
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


def test_the_deterministic_generator_has_no_code_branch() -> None:
    torch.manual_seed(0)
    model = build_generator("smoke", deterministic=True)
    clouds = model(_blobs(2), torch.randn(1, 2, model.code_dim))
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


def test_group_norms_treat_each_image_and_code_by_itself() -> None:
    model = build_generator(config=dataclasses.replace(PROFILES["smoke"], group_norm=True))
    images, codes = torch.rand(3, 3, 48, 64), torch.randn(2, 3, CODE_DIM)
    together = model(images, codes)
    alone = torch.cat([model(images[i : i + 1], codes[:, i : i + 1]) for i in range(3)], 1)
    torch.testing.assert_close(together, alone, atol=1e-6, rtol=1e-4)
    brighter = torch.cat([images[:1], images[1:] / 2])
    torch.testing.assert_close(model(brighter, codes)[:, 0], together[:, 0], atol=1e-6, rtol=1e-4)
    assert sum(isinstance(part, torch.nn.GroupNorm) for part in model.modules()) > 20


def test_more_points_in_each_cell_are_more_points_of_both_branches() -> None:
    model = build_generator(config=dataclasses.replace(PROFILES["smoke"], points_per_cell=4))
    clouds = model(torch.rand(1, 3, 48, 64), torch.randn(2, 1, CODE_DIM))
    assert clouds.shape[2] == model.points == 2 * PROFILES["smoke"].points


@pytest.mark.parametrize("group_norm", [False, True])
def test_a_wider_network_starts_as_the_narrower_one_and_learns_more(group_norm: bool) -> None:
    torch.manual_seed(0)
    size = dataclasses.replace(PROFILES["smoke"], decoder_width=0.5, group_norm=group_norm)
    narrow, wide = (build_generator(config=dataclasses.replace(size, decoder_width=w)) for w in (0.5, 1.0))
    widen(wide, narrow)
    images, codes = torch.rand(2, 3, 48, 64), torch.randn(3, 2, CODE_DIM)
    torch.testing.assert_close(wide(images, codes), narrow(images, codes), atol=1e-6, rtol=1e-5)
    # The repeats of a channel get different gradients, even after Adam has made them as large.
    optimiser = torch.optim.Adam(wide.parameters(), lr=1e-3)
    wide(images, codes).square().sum().backward()
    optimiser.step()
    weight = wide.decoder.down5[0].weight
    first, second = weight.unflatten(0, (2, -1)).unbind()
    assert (first != second).float().mean() > 0.2


def test_only_multiples_can_be_widened() -> None:
    layers = [torch.nn.Linear(2, 4), torch.nn.Linear(2, 6), torch.nn.Conv1d(2, 4, 1), torch.nn.Linear(2, 2)]
    with pytest.raises(ValueError, match="no multiple"):
        widen(layers[1], layers[0])
    with pytest.raises(ValueError, match="other layers"):
        widen(layers[2], layers[0])
    with pytest.raises(ValueError, match="no multiple"):
        widen(layers[3], layers[0])


def test_wrong_sizes_are_named() -> None:
    with pytest.raises(ValueError, match="points_per_cell"):
        GeneratorConfig(points_per_cell=0)
    with pytest.raises(ValueError, match="multiples of 8"):
        GeneratorConfig(image_height=50)
    with pytest.raises(ValueError, match="'images'"):
        build_generator("smoke")(torch.rand(3, 64, 64), torch.randn(1, 1, CODE_DIM))


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


# --- the baselines


def _gradients_by_network() -> list[tuple[Callable[[str], Baseline], Callable[[Any, Tensor], Tensor]]]:
    return [
        (build_lin, lambda net, images: torch.cat([x.flatten() for x in net.structure(images[:, 0])]).norm()),
        (build_r2n2, lambda net, images: net.logits(images).square().sum()),
        (build_ptn, lambda net, images: net.occupancy(images[:, 0]).square().sum()),
    ]


@pytest.mark.parametrize(("build", "measure"), _gradients_by_network())
def test_gradient_reaches_every_parameter(
    build: Callable[[str], Baseline], measure: Callable[[Any, Tensor], Tensor]
) -> None:
    torch.manual_seed(0)
    network = build("smoke")
    measure(network, torch.rand(4, 2, 3, 32, 32)).backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert silent == []


def test_fixed_cameras_and_fused_maps_are_inverse() -> None:
    """A point drawn at its place and depth in every map comes back eight times."""
    torch.manual_seed(0)
    network = build_lin("smoke")
    points = torch.rand(2, 16**2, 3) - 0.5
    seen = fixed_cameras(points)
    structure = network.structure(torch.rand(2, 3, 32, 32))
    pixels = ((seen[..., :2] + 0.5) * 16).mT.unflatten(-1, (16, 16))
    fused = network.fuse(structure._replace(pixels=pixels, depth=seen[..., 2].unflatten(-1, (16, 16))))
    torch.testing.assert_close(fused.unflatten(1, (8, 256)), points[:, None].expand(2, 8, 256, 3))


def test_a_fresh_structure_is_eight_flat_maps() -> None:
    torch.manual_seed(0)
    structure = build_lin("smoke").structure(torch.rand(4, 3, 32, 32))
    centres = torch.arange(16) + 0.5
    assert (structure.pixels[:, :, 0] - centres).abs().max() < 0.5
    assert (structure.pixels[:, :, 1] - centres[:, None]).abs().max() < 0.5
    assert (structure.depth - 1).abs().max() < 0.5


def test_memory_reads_views_in_order_and_all_of_them() -> None:
    torch.manual_seed(0)
    network, images = build_r2n2("smoke"), torch.rand(1, 3, 3, 32, 32)
    logits = network.logits(images)
    for view in range(3):
        other = images.clone()
        other[:, view] = 0.0
        assert (network.logits(other) - logits).abs().max() > 1e-5


def test_blocks_of_the_decoder_convolve_the_unpooled_grid() -> None:
    """As published: each cell goes to one corner of eight, zeros to the others, then two convolutions beside it."""
    torch.manual_seed(0)
    network = build_r2n2(config=R2N2Config("odd", 32, 32, 128, (8, 16), (False, True), 64, 6, (6, 8, 4)))
    for block, channels in zip(network.decoder, (6, 6, 8), strict=True):
        x = torch.randn(2, channels, 4, 4, 4)
        before = x
        if isinstance(block.first, nn.ConvTranspose3d):
            before = torch.zeros(2, channels, 8, 8, 8)
            before[..., ::2, ::2, ::2] = x

        def convolved(conv: nn.Module, grid: Tensor) -> Tensor:
            assert isinstance(conv, (nn.Conv3d, nn.ConvTranspose3d))
            weight = conv.weight
            if isinstance(conv, nn.ConvTranspose3d):
                weight = weight.transpose(0, 1).flip(2, 3, 4)
            return F.conv3d(grid, weight, conv.bias, padding=weight.shape[-1] // 2)

        twice = F.leaky_relu(block.second(F.leaky_relu(convolved(block.first, before), 0.01)), 0.01)
        beside = convolved(block.skip, before) if list(block.skip.parameters()) else before
        torch.testing.assert_close(block(x), twice + beside)


def test_an_untrained_grid_is_nearly_empty() -> None:
    torch.manual_seed(0)
    with torch.no_grad():
        logits = build_r2n2("cpu").logits(torch.rand(2, 1, 3, 64, 64))
    assert 0.01 < logits.softmax(1)[:, 1].mean() < 0.15


def _ball(size: int, radius: float) -> Tensor:
    return (cell_centres(size).norm(dim=1) < radius).float().reshape(1, size, size, size)


def test_surface_points_lie_on_the_faces_between_occupied_and_empty() -> None:
    grid = _ball(16, 0.35)
    points = surface_points(grid, 2000, threshold=0.5)[0]
    on_a_face = ((points + 0.5) * 16 - ((points + 0.5) * 16).round()).abs().amin(1) < 1e-4
    assert on_a_face.all()
    assert (points.norm(dim=1) - 0.35).abs().max() < 3**0.5 / 16
    assert points.mean(0).abs().max() < 0.01
    # A face has two sides: a step to either, along its normal, finds an occupied and an empty cell.
    for axis in range(3):
        here = (points[:, axis] * 16 - (points[:, axis] * 16).round()).abs() < 1e-4
        both = []
        for step in (-0.03, 0.03):
            cell = points[here].clone()
            cell[:, axis] += step
            x, y, z = ((cell + 0.5) * 16).long().clamp(0, 15).unbind(1)
            both.append(grid[0, x, y, z] > 0.5)
        assert (both[0] != both[1]).float().mean() > 0.99


def test_every_face_gets_its_share_of_points() -> None:
    grid = torch.zeros(1, 8, 8, 8)
    grid[0, 3, 3, 3] = 1.0
    points = surface_points(grid, 600, threshold=0.5)[0] - (torch.tensor(3.5) / 8 - 0.5)
    for axis in range(3):
        for side in (-1, 1):
            face = points[(points[:, axis] * side - 1 / 16).abs() < 1e-5]
            assert len(face) == pytest.approx(100, abs=2)
            assert face.std(0).sort().values[1:].tolist() == pytest.approx([0.036, 0.036], abs=0.004)


def test_a_grid_without_occupied_cells_still_has_a_surface() -> None:
    grid = torch.rand(1, 8, 8, 8) * 0.1
    points = surface_points(grid, 50, threshold=0.5)
    assert points.shape == (1, 50, 3)
    assert points.isfinite().all()
    likeliest = grid.flatten().topk(8).indices
    assert torch.cdist(points[0], cell_centres(8)[likeliest]).amin(1).max() < 0.9 / 8


def test_silhouettes_are_those_of_the_splatted_cells() -> None:
    """Beside the dense points of a solid: an L, to see that no axis is turned or mirrored."""
    grid = torch.zeros(1, 32, 32, 32)
    grid[0, 8:24, 8:12, 10:20] = 1.0
    grid[0, 8:12, 8:28, 10:20] = 1.0
    solid = cell_centres(32)[grid.flatten() > 0]
    cloud = (solid[:, None] + (torch.rand(1, 60, 3) - 0.5) / 32).reshape(1, -1, 3)
    eyes = [(2.0, 0.5, 0.3), (-0.5, 0.4, -2.0), (0.3, 1.9, 0.2)]
    camera = PinholeCamera.look_at(torch.tensor([eyes]), focal_px=170.0, height=96, width=96)
    seen = silhouettes(grid, camera, samples=64) > 0.5
    drawn = splat_depth(cloud, camera).depth.isfinite()
    assert (seen & drawn).sum() / (seen | drawn).sum() > 0.9
