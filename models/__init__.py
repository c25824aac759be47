"""Networks: images and random codes in, point clouds out. They do not depend on files, data or losses."""

from models.autoencoder import LATENT_DIM, Autoencoder, AutoencoderConfig, build_autoencoder
from models.critic import Critic, critic_loss, generator_loss, gradient_penalty
from models.generator import Generator, Prediction, build_generator
from models.parts import allow_tf32
from models.predictor import Predictor
from models.sizes import CODE_DIM, PROFILES, GeneratorConfig
from models.widen import widen

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
    "allow_tf32",
    "build_autoencoder",
    "build_generator",
    "critic_loss",
    "generator_loss",
    "gradient_penalty",
    "widen",
]
