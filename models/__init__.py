"""Networks: images and random codes in, point clouds out. They know nothing of files, data or losses."""

from models.generator import CODE_DIM, PROFILES, Generator, GeneratorConfig, build_generator

__all__ = ["CODE_DIM", "PROFILES", "Generator", "GeneratorConfig", "build_generator"]
