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
    coordinates and not features, and all vectors are left to Adam. Of matrices with more than 128 rows, blocks of 128
    rows are made orthogonal each for itself.

    Args:
        network: its parameters that are not frozen.
        output_layers: layers of the network whose weights Adam steps.
        momentum: decay of the mean over past gradients.
        weight_decay: as Adam's: added to the gradients, times the parameters.

    Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024), with Nesterov momentum; the
    scale is that of Liu et al., "Muon is scalable for LLM training" (2025), section 2.2; blocks as in Khaled et al.,
    "MuonBP: Faster Muon via block-periodic orthogonalization" (2025), without its steps of whole matrices.
    torch.optim.Muon takes no kernels of convolutions.

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
        weights = [weight for weight in group["params"] if weight.grad is not None]
        gradients = [self._outputs_first(weight, self._mean_gradient(weight, group)) for weight in weights]
        for weight, step in zip(weights, _orthogonal_steps(gradients), strict=True):
            self._outputs_first(weight, weight).sub_(step, alpha=group["lr"])

    def _mean_gradient(self, weight: Tensor, group: dict[str, Any]) -> Tensor:
        """Nesterov's mean over the past gradients of a weight, and the momentum brought up to date for it."""
        assert weight.grad is not None
        gradient = weight.grad.add(weight, alpha=group["weight_decay"])
        state = self.state[weight]
        if not state:
            state["momentum"] = torch.zeros_like(weight)
        momentum = state["momentum"].lerp_(gradient, 1 - group["momentum"])
        momentum.masked_fill_(momentum.abs() < _NOTHING, 0)
        return gradient.lerp(momentum, group["momentum"])

    def _outputs_first(self, weight: Tensor, value: Tensor) -> Tensor:
        """A value of a weight's shape, with output channels in the first dimension."""
        return value.transpose(0, 1) if weight in self._transposed else value


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
_ROWS = 128
"""Matrices with more rows are made orthogonal in blocks of so many. On two cores that takes 0.06 s a step for a decoder
of twice the width, for whole matrices 0.32. The network learns as fast: after 600 steps on the embedded shapes (one
seed, 146 validation shapes) CD with 1 and 8 views is 6.94 and 5.33, with blocks of 256 rows 7.06 and 5.41, with whole
matrices 6.99 and 5.33."""
# Where a unit is dead, its momentum decays to denormal numbers, with which processors are several times slower: a step
# of the shipped network took 1.0 s at first, and after 1700 steps 2.3. Products of several factors must not get there.
_NOTHING = 1e-30
_ROUNDING = 1e-7
_STEP_OF_ADAM = 0.2
"""Root mean square of the entries of a typical step of Adam, in units of its learning rate."""


def _orthogonal_steps(gradients: list[Tensor]) -> list[Tensor]:
    """For each matrix or kernel, its blocks made orthogonal, with entries of the size of a step of Adam."""
    matrices = [gradient.flatten(1) for gradient in gradients]
    wide = [matrix if len(matrix) <= matrix.shape[1] else matrix.T for matrix in matrices]
    blocks = [matrix.split(_ROWS) for matrix in wide]
    orthogonal = iter(_orthogonal([block for each in blocks for block in each]))
    steps = []
    for gradient, matrix, each in zip(gradients, matrices, blocks, strict=True):
        step = torch.cat([next(orthogonal) for _ in each])
        step = step if step.shape == matrix.shape else step.T
        steps.append(step.reshape(gradient.shape) * (_STEP_OF_ADAM * math.sqrt(max(matrix.shape))))
    return steps


def _orthogonal(matrices: list[Tensor]) -> list[Tensor]:
    """For each matrix with at most as many rows as columns, about the nearest one whose rows are orthonormal.

    A step of the iteration, X' = a X + b (X Xt) X + c (X Xt)^2 X, multiplies X by a polynomial in X Xt. So the small
    square matrices X Xt are iterated, all those of one size together, and X is multiplied by the product at the end.

    Source: the iteration of Jordan et al. (2024), reordered as in Zhang et al., "Gram Newton-Schulz" (2026), which in
    float32 needs none of their restarts: 5e-5 from the original order.
    """
    a, b, c = _POLYNOMIAL
    result = list(matrices)
    for rows in sorted({len(matrix) for matrix in matrices}):
        numbers = [number for number, matrix in enumerate(matrices) if len(matrix) == rows]
        # With this norm the largest singular value is at most one.
        xs = [matrices[number] / matrices[number].norm().clamp(min=1e-7) for number in numbers]
        xs = [nn.functional.hardshrink(x, _ROUNDING) for x in xs]
        gram = torch.stack([x @ x.T for x in xs])
        product = torch.eye(rows, dtype=gram.dtype, device=gram.device).expand_as(gram)
        for step in range(_TIMES):
            higher = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)  # the factor of this step is a + higher
            product = torch.baddbmm(product, higher, product, beta=a)
            if step == _TIMES - 1:
                break
            half = torch.baddbmm(gram, higher, gram, beta=a)
            gram = torch.baddbmm(half, higher, half, beta=a)
        for number, x, factor in zip(numbers, xs, product, strict=True):
            result[number] = factor @ x
    return result
