"""Muon: the steps of matrices and of everything else."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from models import build_generator
from train.methods.optimisers import Muon, set_learning_rate


def _network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(3, 8, 3, padding=1),
        nn.ReLU(),
        nn.ConvTranspose2d(8, 5, 4),
        nn.Flatten(),
        nn.Linear(5 * 49, 6),
    )


def _with_gradients(network: nn.Sequential) -> nn.Sequential:
    network(torch.rand(7, 3, 4, 4, generator=torch.Generator().manual_seed(1))).square().sum().backward()
    return network


def test_singular_values_of_a_step_are_about_one() -> None:
    """Rows are output channels, also of a transposed convolution, whose kernels have the inputs first."""
    network = _with_gradients(_network())
    before = copy.deepcopy(network)
    optimiser = Muon(network, output_layers=[network[4]])
    set_learning_rate(optimiser, 0.01)
    optimiser.step()
    for at, rows in ((0, 8), (2, 5)):
        change = before[at].weight - network[at].weight
        matrix = (change.transpose(0, 1) if at == 2 else change).detach().flatten(1)
        assert len(matrix) == rows
        values = torch.linalg.svdvals(matrix) / (0.01 * 0.2 * max(matrix.shape) ** 0.5)
        assert values.min() > 0.6 and values.max() < 1.3


def test_large_matrices_are_made_orthogonal_in_blocks_of_128_rows() -> None:
    """Of the shorter side, and together with other matrices of as many rows."""
    torch.manual_seed(3)
    layers = [nn.Linear(columns, rows) for rows, columns in ((150, 400), (400, 150), (128, 500))]
    before = [layer.weight.detach().clone() for layer in layers]
    for layer in layers:
        rows, columns = layer.weight.shape
        layer.weight.grad = torch.randn(rows, 30) @ torch.randn(30, columns) + torch.randn(rows, columns)
        layer.weight.grad[:5] = 0.0  # dead units
    optimiser = Muon(nn.ModuleList(layers), output_layers=[])
    set_learning_rate(optimiser, 0.01)
    optimiser.step()
    for layer, start, sizes in zip(layers, before, ([128, 22], [128, 22], [128]), strict=True):
        change = (start - layer.weight.detach()) / (0.01 * 0.2)
        assert (change[:5] == 0).all()
        wide = change if len(change) <= change.shape[1] else change.T
        for block in wide.split(sizes):
            values = torch.linalg.svdvals(block[block.abs().amax(1) > 0]) / wide.shape[1] ** 0.5
            assert values.min() > 0.6 and values.max() < 1.3


def test_vectors_and_output_layers_are_adams() -> None:
    network, other = _with_gradients(_network()), _with_gradients(_network())
    optimiser = Muon(network, output_layers=[network[4]], weight_decay=0.1)
    adam = torch.optim.Adam(other.parameters(), lr=0.01, weight_decay=0.1, fused=True)
    set_learning_rate(optimiser, 0.01)
    for _ in range(2):
        optimiser.step()
        adam.step()
    for name, value in network.named_parameters():
        assert torch.equal(value, other.get_parameter(name)) == (name not in ("0.weight", "2.weight")), name


def test_matrices_step_as_torchs_muon_does() -> None:
    if not hasattr(torch.optim, "Muon"):
        pytest.skip("this torch has no Muon")
    torch.manual_seed(2)
    network = nn.Linear(40, 24)
    other = copy.deepcopy(network)
    optimiser = Muon(network, output_layers=[])
    reference = torch.optim.Muon([other.weight], lr=1e-3, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    start = network.weight.detach().clone()
    for _ in range(5):
        gradient = torch.randn(24, 40)
        for layer, steps in ((network, optimiser), (other, reference)):
            layer.weight.grad = gradient.clone()
            steps.step()
    ours, theirs = network.weight.detach() - start, other.weight.detach() - start
    assert (ours - theirs).norm() < 0.03 * theirs.norm()  # torch's computes in bfloat16


def test_a_saved_state_continues_to_the_same_bits() -> None:
    whole, first = _network(), _network()
    optimisers = [Muon(network, output_layers=[network[4]]) for network in (whole, first)]
    for network, optimiser in zip((whole, first), optimisers, strict=True):
        _with_gradients(network)
        optimiser.step()
    second = copy.deepcopy(first)
    resumed = Muon(second, output_layers=[second[4]])
    resumed.load_state_dict(optimisers[1].state_dict())
    for network, optimiser in ((whole, optimisers[0]), (second, resumed)):
        optimiser.zero_grad()
        _with_gradients(network)
        optimiser.step()
    assert all(map(torch.equal, whole.parameters(), second.parameters()))


def test_parameters_without_gradient_stay() -> None:
    network = _network()
    before = copy.deepcopy(network)
    Muon(network, output_layers=[]).step()
    assert all(map(torch.equal, network.parameters(), before.parameters()))


@pytest.mark.parametrize("output_head", ["points", "latent"])
def test_the_generators_output_layers_make_its_outputs(output_head: str) -> None:
    generator = build_generator("smoke", output_head=output_head)
    with torch.no_grad():
        for layer in generator.output_layers:
            layer.weight.zero_()
            layer.bias.fill_(0.25)
    predicted = generator.predict(torch.rand(1, 3, 48, 64), torch.randn(1, 1, generator.code_dim))
    outputs = predicted.points if predicted.latents is None else predicted.latents
    assert (outputs == 0.25).all()


def test_the_momentum_of_dead_units_does_not_become_denormal() -> None:
    """Processors are slow with denormal numbers, and half of a network may be dead."""
    layer = nn.Linear(6, 4)
    optimiser = Muon(layer, output_layers=[])
    for step in range(2000):
        layer.weight.grad = torch.ones(4, 6)
        layer.weight.grad[:2] *= float(step == 0)
        optimiser.step()
    momentum = optimiser.state[layer.weight]["momentum"]
    assert (momentum[:2] == 0).all() and (momentum[2:] > 0.9).all()
