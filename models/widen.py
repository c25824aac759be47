"""A wider network that predicts what a narrower one does: training goes on with more capacity (Net2Net)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_SPREAD = 0.5
"""Standard deviation of a repeat's share of a weight, over its mean: with equal shares repeats would stay equal."""


@torch.no_grad()
def widen(wide: nn.Module, narrow: nn.Module) -> None:
    """Copies the weights of a network into one whose layers have a whole multiple of its channels.

    Every channel is repeated, and each weight of the layers that read it is divided among the repeats in random shares
    (from torch's global generator), so that the repeats learn different things. The function stays the same, with group
    norms too if their groups keep their size.

    Args:
        wide: the network to fill; the same layers in the same order, of convolutions, linear layers and group norms.
        narrow: the trained network.

    Raises:
        ValueError: other layers, or channels that are no whole multiple.

    Source: Chen et al., "Net2Net: Accelerating Learning via Knowledge Transfer" (ICLR 2016), section 2.2.

    Example:
        >>> narrow, wide = (nn.Sequential(nn.Linear(2, n), nn.ReLU(), nn.Linear(n, 1)) for n in (8, 16))
        >>> widen(wide, narrow)
        >>> x = torch.rand(5, 2)
        >>> bool((wide(x) - narrow(x)).abs().max() < 1e-5)
        True
    """
    layers = [[layer for layer in of.modules() if not list(layer.children())] for of in (wide, narrow)]
    if [type(layer) for layer in layers[0]] != [type(layer) for layer in layers[1]]:
        raise ValueError("widen: the networks have other layers")
    for into, layer in zip(*layers, strict=True):
        input_dim = 0 if isinstance(layer, nn.ConvTranspose2d) else 1
        for (name, value), old in zip(into.named_parameters(), layer.parameters(), strict=True):
            if old.ndim != value.ndim:
                raise ValueError("widen: the networks have other layers")
            repeats = [new // was for new, was in zip(value.shape, old.shape, strict=True)]
            if any(r * was != new for r, new, was in zip(repeats, value.shape, old.shape, strict=True)):
                raise ValueError(
                    f"widen: {type(layer).__name__} of {tuple(value.shape)} is no multiple of {tuple(old.shape)}"
                )
            value.copy_(old.repeat(repeats))
            if name == "weight" and old.ndim > 1 and repeats[input_dim] > 1:
                _share_among_repeats(value, repeats[input_dim], input_dim)


def _share_among_repeats(weight: Tensor, repeats: int, input_dim: int) -> None:
    """Divides the weights of an input unequally among its repeats, in place; their sum stays."""
    by_repeat = weight.unflatten(input_dim, (repeats, -1))
    shares = 1 + _SPREAD * torch.randn_like(by_repeat.cpu()).to(by_repeat.device)  # the same on every device
    by_repeat *= (1 + shares - shares.mean(input_dim, keepdim=True)) / repeats
