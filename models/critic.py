"""The critic of the WGAN-GP: a score for a latent code of a shape, high for real shapes.

The losses are those of Gulrajani et al., "Improved training of Wasserstein GANs" (NeurIPS 2017), on codes.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from models.autoencoder import LATENT_DIM


class Critic(nn.Module):
    """D(z): (*, LATENT_DIM) codes -> (*) scores, unbounded. No batch norm: the penalty is on single codes.

    Only differences of scores are meaningful: a constant added to all of them cancels in every loss, and drifts.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(LATENT_DIM, 128), nn.ReLU(), nn.Linear(128, 256), nn.ReLU(), nn.Linear(256, 1)
        )

    def forward(self, latents: Tensor) -> Tensor:
        """One score per code."""
        return self.layers(latents)[..., 0]


def critic_loss(real_scores: Tensor, fake_scores: Tensor) -> Tensor:
    """E[D(z_fake)] - E[D(z_real)], minimised by the critic: minus its estimate of the Wasserstein distance.

    Example:
        >>> critic_loss(real_scores=torch.tensor([3.0, 1.0]), fake_scores=torch.tensor([-1.0])).item()
        -3.0
    """
    return fake_scores.mean() - real_scores.mean()


def generator_loss(fake_scores: Tensor) -> Tensor:
    """-E[D(z_fake)], minimised by the generator."""
    return -fake_scores.mean()


def gradient_penalty(
    critic: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, *, mix: Tensor
) -> Tensor:
    """E[(|grad D(z)| - 1)^2] at z = z_real + u (z_fake - z_real), which keeps the norm of D's gradient near one.

    Args:
        critic: codes (*, D) -> scores (*).
        real: (*, D) codes of real shapes.
        fake: (*, D) codes of predictions.
        mix: (*) the u of each pair, from U(0, 1).

    Returns:
        A scalar, differentiable in the critic's parameters; `real` and `fake` get no gradient.

    Example:
        >>> unit = torch.tensor([0.6, 0.8])
        >>> real, fake, mix = torch.randn(5, 2), torch.randn(5, 2), torch.rand(5)
        >>> round(gradient_penalty(lambda z: 3 * (z @ unit), real, fake, mix=mix).item(), 5)
        4.0
    """
    between = torch.lerp(real.detach(), fake.detach(), mix[..., None]).requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    return (slope.norm(dim=-1) - 1).square().mean()
