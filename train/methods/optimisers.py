"""The optimisers: Adam, and Muon for the matrices of a network."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn


def adam(network: nn.Module, *, weight_decay: float = 0.0) -> torch.optim.Adam:
    """Adam over the parameters that are not frozen; its step size is set at every step."""
    return torch.optim.Adam(trainable(network), fused=True, weight_decay=weight_decay)


class Muon(torch.optim.Optimizer):
    """Steps whose singular values are all about one for matrices, Adam for all other parameters.

    The step of a matrix is its momentum made orthogonal, so that directions with small gradients are learnt as fast as
    those with large ones. It is scaled to the size of a typical step of Adam, so that both take the same learning rate.
    A convolution's kernel is a matrix with one row per output channel. The layers in `output_layers`, whose rows are
    coordinates and not features, and all vectors are left to Adam.

    Args:
        network: its parameters that are not frozen.
        output_layers: layers of the network whose weights Adam steps.
        momentum: decay of the mean over past gradients.
        weight_decay: as Adam's: added to the gradients, times the parameters.

    Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024), with Nesterov momentum; the
    scale is that of Liu et al., "Muon is scalable for LLM training" (2025), section 2.2. torch.optim.Muon takes no
    kernels of convolutions.

    Example:
        >>> network = nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 1))
        >>> optimiser = Muon(network, output_layers=[network[2]])
        >>> network(torch.rand(16, 4)).square().mean().backward()
        >>> optimiser.step()
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        output_layers: list[nn.Module],
        momentum: float = 0.95,
        weight_decay: float = 0.0,
    ) -> None:
        self._transposed = {
            layer.weight for layer in network.modules() if isinstance(layer, nn.ConvTranspose2d)
        }
        left_out = {layer.weight for layer in output_layers}
        parameters = trainable(network)
        matrices = [each for each in parameters if each.ndim > 1 and each not in left_out]
        others = [each for each in parameters if each.ndim < 2 or each in left_out]
        self._adam = torch.optim.Adam(others, fused=True, weight_decay=weight_decay)
        super().__init__(
            [{"params": matrices, "momentum": momentum, "weight_decay": weight_decay}], {"lr": 1e-3}
        )
        self.param_groups += self._adam.param_groups
        self._share()

    def _share(self) -> None:
        """Adam works on the state and the parameter groups of this optimiser, which saves and loads them."""
        self._adam.state = self.state
        self._adam.param_groups = self.param_groups[1:]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._share()

    @torch.no_grad()
    def step(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step of all parameters that have a gradient."""
        self._adam.step()
        group = self.param_groups[0]
        for weight in group["params"]:
            if weight.grad is None:
                continue
            gradient = weight.grad.add(weight, alpha=group["weight_decay"])
            state = self.state[weight]
            if not state:
                state["momentum"] = torch.zeros_like(weight)
            mean = state["momentum"].lerp_(gradient, 1 - group["momentum"])
            mean.masked_fill_(mean.abs() < _NOTHING, 0)
            step = gradient.lerp(mean, group["momentum"])
            if weight in self._transposed:
                weight.sub_(_orthogonal_step(step.transpose(0, 1)).transpose(0, 1), alpha=group["lr"])
            else:
                weight.sub_(_orthogonal_step(step), alpha=group["lr"])


def trainable(network: nn.Module) -> list[nn.Parameter]:
    """The parameters that are not frozen."""
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def set_learning_rate(optimiser: torch.optim.Optimizer, learning_rate: float) -> None:
    """Sets the step size of all of an optimiser's parameters."""
    for group in optimiser.param_groups:
        group["lr"] = learning_rate


# A polynomial that moves singular values from (0, 1] to about one when it is applied several times.
_POLYNOMIAL = 3.4445, -4.7750, 2.0315
_TIMES = 5
# Where a unit is dead, its momentum decays to denormal numbers, with which processors are several times slower: a step
# of the shipped network took 1.0 s at first, and after 1700 steps 2.3. Products of five factors must not get there.
_NOTHING = 1e-30
_ROUNDING = 1e-7
_STEP_OF_ADAM = 0.2
"""Root mean square of the entries of a typical step of Adam, in units of its learning rate."""


def _orthogonal_step(step: Tensor) -> Tensor:
    """The nearest matrix whose singular values are one, about, scaled to the size of a step of Adam."""
    matrix = step.flatten(1)
    x = matrix.T if len(matrix) > matrix.shape[1] else matrix
    x = x / x.norm().clamp(min=1e-7)  # the largest singular value is at most one
    x = nn.functional.hardshrink(x, _ROUNDING)
    a, b, c = _POLYNOMIAL
    for _ in range(_TIMES):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    x = x.T if len(matrix) > matrix.shape[1] else x
    return x.reshape(step.shape) * (_STEP_OF_ADAM * math.sqrt(max(matrix.shape)))
