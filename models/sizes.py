"""The sizes of the generator: everything that fixes the shape of its network, and the three profiles."""

from __future__ import annotations

import dataclasses
from typing import Literal

CODE_DIM = 128

Ending = Literal["points", "latent"]


@dataclasses.dataclass(frozen=True)
class GeneratorConfig:
    """Everything that fixes the network's shape.

    Attributes:
        profile: name of the size, for the record.
        image_height: height to which every image is resized, a multiple of 8.
        image_width: width to which every image is resized, a multiple of 8.
        trunk_width: factor on the channels of the image trunk and the code branch; 1 is the paper's.
        decoder_width: factor on the channels behind the point where image and code meet; 1 is the paper's.
        deterministic: leave the code branch out; codes are accepted and ignored.
        ending: "points": a fully connected and a convolutional branch make the points (the released network).
            "latent": the network ends in an auto-encoder's code, and that one's decoder makes the points; it is
            given by `adopt_decoder` and never trained here (the network of the paper's text).
        existence: give every point a logit of its existence too, for losses that may delete points.
    """

    profile: str = "cpu"
    image_height: int = 96
    image_width: int = 128
    trunk_width: float = 0.5
    decoder_width: float = 0.25
    deterministic: bool = False
    ending: Ending = "points"
    existence: bool = False

    def __post_init__(self) -> None:
        if self.image_height % 8 or self.image_width % 8 or min(self.image_height, self.image_width) < 8:
            raise ValueError(
                "GeneratorConfig: image_height and image_width must be positive multiples of 8; "
                f"got {self.image_height} x {self.image_width}"
            )
        if self.ending not in ("points", "latent"):
            raise ValueError(f"GeneratorConfig: ending must be 'points' or 'latent'; got {self.ending!r}")
        if self.existence and self.ending == "latent":
            raise ValueError(
                "GeneratorConfig: existence needs ending='points': a decoder of shapes gives no logits"
            )

    @property
    def values_per_point(self) -> int:
        """x, y, z, and the logit of existence if points have one."""
        return 4 if self.existence else 3

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the grid on which image and code meet."""
        return self.image_height // 8, self.image_width // 8

    @property
    def conv_points(self) -> int:
        """Points of the convolutional branch: two per grid cell."""
        return 2 * self.grid[0] * self.grid[1]

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
