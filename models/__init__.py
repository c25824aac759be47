"""Networks: images and random codes in, point clouds out. They know nothing of files, data or losses."""

from models.autoencoder import LATENT_DIM, Autoencoder, AutoencoderConfig, build_autoencoder
from models.baselines.base import Baseline
from models.critic import Critic, critic_loss, generator_loss, gradient_penalty
from models.generator import Generator, Prediction, build_generator
from models.sizes import CODE_DIM, PROFILES, GeneratorConfig

Predictor = Generator | Baseline
"""What can be called with images and codes and gives clouds: our own network, or another method's."""

__all__ = [
    "CODE_DIM",
    "LATENT_DIM",
    "PROFILES",
    "Autoencoder",
    "AutoencoderConfig",
    "Critic",
    "Generator",
    "GeneratorConfig",
    "Prediction",
    "Predictor",
    "build_autoencoder",
    "build_generator",
    "critic_loss",
    "generator_loss",
    "gradient_penalty",
]
