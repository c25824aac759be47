"""The auto-encoder: what a code depends on, how it is frozen and reused, and the generator that ends in one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from train.methods.step import autoencoder_step
from train.training.state import Training

from models import PROFILES as SIZES
from models import Autoencoder, AutoencoderConfig, build_autoencoder, build_generator
from models.autoencoder import AUTOENCODER_PROFILES
from train.config import PROFILES
from train.data.batches import load_split
from train.errors import UserError
from train.evaluation.runs import best_weights, load_autoencoder, load_generator, read_metrics
from train.methods.weights import save_weights
from train.training.trainer import fit

_SMOKE = PROFILES["smoke"]


def _boxes(count: int, points: int = 128) -> torch.Tensor:
    """Surfaces of boxes of different sizes."""
    sides = 0.2 + 0.6 * torch.rand(count, 1, 3)
    clouds = torch.rand(count, points, 3) - 0.5
    on = torch.randint(3, (count, points, 1))
    return sides * clouds.scatter(2, on, torch.randint(2, (count, points, 1)) - 0.5)


def _settled(model: Autoencoder) -> Autoencoder:
    """A fresh network whose batch norms have seen clouds."""
    with torch.no_grad():
        for _ in range(40):
            model(_boxes(8))
    return model.freeze()


@pytest.mark.parametrize("profile", ["full", "cpu", "smoke"])
def test_sizes_fit_the_generators(profile: str) -> None:
    with torch.device("meta"):
        model = build_autoencoder(profile)
    assert model.config.points == SIZES[profile].points == AUTOENCODER_PROFILES[profile].points


def test_full_profile_has_the_papers_layers() -> None:
    with torch.device("meta"):
        model = build_autoencoder("full")
    shapes = [tuple(p.shape) for p in model.parameters() if p.ndim == 2]
    encoder, decoder = shapes[:5], shapes[5:]
    assert encoder == [(64, 3), (128, 64), (256, 128), (256, 256), (128, 256)]
    assert decoder == [(256, 128), (256, 256), (6144, 256)]
    norms = [module for module in model.modules() if isinstance(module, torch.nn.BatchNorm1d)]
    assert len(norms) == 5


def test_a_code_knows_no_order_and_no_repetition() -> None:
    torch.manual_seed(0)
    model = _settled(build_autoencoder("smoke"))
    clouds = _boxes(3)
    codes = model.encode(clouds)
    shuffled = clouds[:, torch.randperm(128)]
    torch.testing.assert_close(model.encode(torch.cat([shuffled, shuffled[:, :50]], 1)), codes)


def test_frozen_encoding_has_the_same_values_and_gradients() -> None:
    torch.manual_seed(0)
    model = _settled(build_autoencoder("smoke"))
    plain, quick = (_boxes(1).requires_grad_() for _ in range(2))
    quick.data.copy_(plain.data)
    weights = torch.randn(128)
    for clouds, encode in ((plain, model.encode), (quick, model.encode_frozen)):
        (encode(clouds) @ weights).sum().backward()
    torch.testing.assert_close(model.encode_frozen(quick), model.encode(plain))
    assert plain.grad is not None
    assert plain.grad.abs().sum() > 0
    torch.testing.assert_close(quick.grad, plain.grad)
    with pytest.raises(RuntimeError, match="freeze"):
        build_autoencoder("smoke").encode_frozen(plain)


def test_a_frozen_auto_encoder_keeps_its_running_statistics(tmp_path: Path) -> None:
    """The code of a cloud does not depend on its company, and is the trained network's, not a fresh norm's."""
    torch.manual_seed(0)
    model = _settled(build_autoencoder("smoke"))
    save_weights(model, tmp_path / "ae.safetensors")
    back = load_autoencoder(tmp_path / "ae.safetensors")
    assert not back.training
    assert not any(p.requires_grad for p in back.parameters())
    clouds = _boxes(4)
    torch.testing.assert_close(back.encode(clouds[:1]), model.encode(clouds)[:1])
    for module in back.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.reset_running_stats()
    assert (back.encode(clouds) - model.encode(clouds)).abs().mean() > 0.1


def test_it_learns_boxes() -> None:
    """200 steps on boxes: what comes out is nearer to what went in than to another box."""
    torch.manual_seed(0)
    model = build_autoencoder("smoke")
    optimiser = torch.optim.Adam(model.parameters())
    reports = [autoencoder_step(model, optimiser, _boxes(16), rate=1e-3) for _ in range(200)]
    assert reports[-1]["cd"] < 0.35 * reports[0]["cd"]
    model.freeze()
    clouds = _boxes(16)
    to_own, to_other = (
        torch.cdist(model(clouds), target).amin(2).mean() for target in (clouds, clouds.roll(1, 0))
    )
    assert to_own < 0.8 * to_other


def test_a_generator_can_end_in_the_decoder(tmp_path: Path) -> None:
    """The paper's written network: the points are the decoder's, which learns nothing; its file stands alone."""
    torch.manual_seed(0)
    autoencoder, model = build_autoencoder("smoke"), build_generator("smoke", output_head="latent")
    model.adopt_decoder(autoencoder)
    images, codes = torch.rand(2, 3, 48, 64), torch.randn(3, 2, model.code_dim)
    predicted = model.predict(images, codes)
    assert predicted.latents is not None
    assert predicted.latents.shape == (3, 2, 128)
    assert torch.equal(predicted.points.flatten(0, 1), autoencoder.decode(predicted.latents.flatten(0, 1)))
    predicted.points.square().sum().backward()
    without = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    assert without == {f"shape_decoder.{name}" for name, _ in autoencoder.decode.named_parameters()}
    save_weights(model, tmp_path / "latent.safetensors")
    back = load_generator(tmp_path / "latent.safetensors")
    assert torch.equal(back(images, codes), predicted.points)
    with pytest.raises(ValueError, match="output_head='latent'"):
        build_generator("smoke").adopt_decoder(autoencoder)
    with pytest.raises(ValueError, match="output_head must be"):
        dataclasses.replace(SIZES["smoke"], output_head="code")  # type: ignore[arg-type]


def test_a_run_with_a_latent_ending_reuses_an_auto_encoder(
    tiny_data: Path, smoke_run: Path, tmp_path: Path
) -> None:
    config = dataclasses.replace(
        _SMOKE,
        ending="latent",
        autoencoder=str(smoke_run),
        stage1=_SMOKE.stage1.lasting(3),
        stage2=_SMOKE.stage2.lasting(2),
    )
    assert fit(tiny_data, tmp_path / "run", config, progress=False)
    assert [r["stage"] for r in read_metrics(tmp_path / "run")] == [1, 1, 1, 2, 2]
    decoder = load_generator(tmp_path / "run").shape_decoder
    assert decoder is not None
    taken = load_autoencoder(best_weights(smoke_run, "autoencoder")).decode.state_dict()
    assert all(torch.equal(value, taken[name]) for name, value in decoder.state_dict().items())


def test_an_auto_encoder_of_another_size_cannot_end_a_generator(tiny_data: Path, tmp_path: Path) -> None:
    other = build_autoencoder(config=AutoencoderConfig("other", points=100, width=0.25))
    save_weights(other, best_weights(tmp_path, "autoencoder"))
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, limit=2, progress=False)
    training = Training(dataclasses.replace(_SMOKE, ending="latent"), split)
    with pytest.raises(UserError, match="makes 100 points, the generator that is to end in it 128"):
        training.begin_phase("stage1", tmp_path)
    Training(_SMOKE, split).begin_phase("stage1", tmp_path)  # the critic judges codes of any of them
