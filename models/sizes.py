"""The sizes of the generator: everything that fixes the shape of its network, and the three profiles."""

from __future__ import annotations

import dataclasses
from typing import Literal

CODE_DIM = 128

OutputHead = Literal["points", "latent"]


@dataclasses.dataclass(frozen=True)
class GeneratorConfig:
    """Everything that fixes the network's shape.

    Attributes:
        profile: name of the size, for the record.
        image_height: height to which every image is resized, a multiple of 8.
        image_width: width to which every image is resized, a multiple of 8.
        trunk_width: factor on the channels of the image trunk and the code branch; 1 is the paper's.
        decoder_width: factor on the channels after the joining of image and code; 1 is the paper's.
        deterministic: without the code branch; codes are accepted and ignored.
        output_head: "points": a fully connected and a convolutional branch predict the points (the released network).
            "latent": the network predicts a latent code of the auto-encoder of shapes, whose frozen decoder, set by
            `adopt_decoder`, computes the points (the network of the paper's text).
        occupancy_logits: also predict an occupancy logit for every point, for losses that may delete points.
        group_norm: normalise the channels of an image in groups of eight before each ReLU; the paper has no such layer.
        points_per_cell: points that the convolutional branch predicts in each grid cell; the paper's has two.
    """

    profile: str = "cpu"
    image_height: int = 96
    image_width: int = 128
    trunk_width: float = 0.5
    decoder_width: float = 0.25
    deterministic: bool = False
    output_head: OutputHead = "points"
    occupancy_logits: bool = False
    group_norm: bool = False
    points_per_cell: int = 2

    def __post_init__(self) -> None:
        if self.image_height % 8 or self.image_width % 8 or min(self.image_height, self.image_width) < 8:
            raise ValueError(
                "GeneratorConfig: image_height and image_width must be positive multiples of 8; "
                f"got {self.image_height} x {self.image_width}"
            )
        if self.output_head not in ("points", "latent"):
            raise ValueError(
                f"GeneratorConfig: output_head must be 'points' or 'latent'; got {self.output_head!r}"
            )
        if self.points_per_cell < 1:
            raise ValueError(
                f"GeneratorConfig: points_per_cell must be at least 1; got {self.points_per_cell}"
            )
        if self.occupancy_logits and self.output_head == "latent":
            raise ValueError(
                "GeneratorConfig: occupancy_logits needs output_head='points': the auto-encoder's decoder has no logits"
            )

    @property
    def values_per_point(self) -> int:
        """x, y, z, and the occupancy logit if there is one."""
        return 4 if self.occupancy_logits else 3

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the feature grid on which image and code are joined."""
        return self.image_height // 8, self.image_width // 8

    @property
    def conv_points(self) -> int:
        """Points of the convolutional branch."""
        return self.points_per_cell * self.grid[0] * self.grid[1]

    @property
    def fc_points(self) -> int:
        """Points of the fully connected branch: a quarter of all."""
        return self.conv_points // 3

    @property
    def points(self) -> int:
        """Points per cloud."""
        return self.conv_points + self.fc_points


PROFILES = {
    "full": GeneratorConfig("full", 192, 256, 1.0, 1.0),
    "cpu": GeneratorConfig("cpu", 96, 128, 0.5, 0.25),
    "smoke": GeneratorConfig("smoke", 48, 64, 0.5, 0.125),
}
