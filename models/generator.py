"""The conditional generator G(I, r): one image and one random code in, one point cloud out.

The network is the two-branch point set generator of the paper (PSGN's encoder and decoder, with the code
joined to the image features on a grid an eighth of the image's size). One rule sets every size: the grid
gives the number of points (a quarter from a fully connected branch, the rest two per grid cell), the two
width factors the channels.

That network, whose output head predicts points, is the one the authors released. The paper's text describes another
head: it predicts a latent code of an auto-encoder of shapes, whose frozen decoder computes the points:
`output_head="latent"`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.autoencoder import Autoencoder, ShapeDecoder
from models.parts import (
    CodeBranch,
    LatentDecoder,
    PointDecoder,
    image_trunk,
    initialise,
    precision,
    prepare_images,
)
from models.predictor import Predictor
from models.sizes import CODE_DIM, PROFILES, GeneratorConfig, OutputHead


def build_generator(
    profile: str = "cpu",
    deterministic: bool = False,
    *,
    output_head: OutputHead = "points",
    config: GeneratorConfig | None = None,
) -> Generator:
    """Builds a generator with freshly drawn weights (seed torch for reproducible ones).

    Args:
        profile: "full" (192 x 256 images, 2048 points, 40.73 million parameters), "cpu" (96 x 128, 512 points) or
            "smoke" (48 x 64, 128 points).
        deterministic: without the code branch; codes are accepted and ignored.
        output_head: "points" (the released network) or "latent" (see `GeneratorConfig`).
        config: sizes of your own; the other arguments are then ignored.

    Example:
        >>> model = build_generator("smoke")
        >>> model(torch.rand(2, 3, 56, 56), torch.randn(5, 2, model.code_dim)).shape
        torch.Size([5, 2, 128, 3])
    """
    if config is None:
        if profile not in PROFILES:
            raise ValueError(
                f"build_generator: 'profile' must be one of {', '.join(PROFILES)}; got {profile!r}"
            )
        config = dataclasses.replace(PROFILES[profile], deterministic=deterministic, output_head=output_head)
    return Generator(config)


_INITIAL_LOGIT = 1.0  # added to the occupancy logits, so that all points exist before training


class Prediction(NamedTuple):
    """The predictions for R codes and B images.

    Attributes:
        points: (R, B, N, 3) in the world frame.
        latents: (R, B, models.LATENT_DIM) the auto-encoder's codes that were decoded to the points, from a network with
            `output_head="latent"`; or None.
        logits: (R, B, N) occupancy logits, from a network with `occupancy_logits`: points above 0 exist; or None.
    """

    points: Tensor
    latents: Tensor | None
    logits: Tensor | None = None


class Generator(Predictor):
    """G(I, r) -> (N, 3) points in the world frame. Call it, or `encode` once and `decode` many times."""

    config: GeneratorConfig
    code_dim = CODE_DIM
    joins_views = True
    computes_in: torch.dtype = torch.float32
    """torch.bfloat16 computes all layers but the last in half precision: about twice as fast where the processor
    has instructions for it (avx512_bf16, amx, GPUs since Ampere), slower elsewhere. Weights and points stay float32."""
    tf32: bool = False
    """On an NVIDIA GPU, all layers but the last round the factors of their products to TF32; see `allow_tf32`."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__()
        self.config = config
        self.trunk = image_trunk(config)
        self.code_branch = None if config.deterministic else CodeBranch(config)
        self.decoder = LatentDecoder(config) if config.output_head == "latent" else PointDecoder(config)
        initialise(self)
        self.shape_decoder = (
            ShapeDecoder(config.points).requires_grad_(False) if self.predicts_latents else None
        )
        # On a CPU a quarter of the time of a training step; the values are the same.
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def takes_codes(self) -> bool:
        """Whether predictions depend on the random codes."""
        return not self.config.deterministic

    @property
    def predicts_latents(self) -> bool:
        """Whether the points come from an auto-encoder's decoder."""
        return self.config.output_head == "latent"

    def adopt_decoder(self, autoencoder: Autoencoder) -> None:
        """Copies the decoder of an auto-encoder with the same number of points; for `output_head="latent"`."""
        if self.shape_decoder is None:
            raise ValueError("Generator: only a network with output_head='latent' has a decoder to adopt")
        self.shape_decoder.load_state_dict(autoencoder.decode.state_dict())

    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        """Predicts R clouds for each of B images; the trunk sees every image once.

        Args:
            images: (B, 3, H, W) in [0, 1] on white, any H and W: resized inside, without keeping the aspect.
            codes: (R, B, code_dim), drawn from N(0, 1).

        Returns:
            (R, B, N, 3) points in the world frame. With `occupancy_logits`, non-existent points are replaced by repeats
            of existing ones.
        """
        return _existing(self.predict(images, codes))

    def predict(self, images: Tensor, codes: Tensor) -> Prediction:
        """As `forward`, with latent codes and occupancy logits; non-existent points are kept."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"Generator: 'images' must be (B, 3, H, W) in [0, 1]; got {tuple(images.shape)}")
        return self._decode(self.encode(images), codes)

    @torch.no_grad()
    def predict_views(self, images: Tensor, codes: Tensor | None = None) -> Tensor:
        """(B, V, 3, H, W) images and (B, V, code_dim) codes -> (B, V, N, 3) points, one cloud per view, no graph."""
        self.check_views(images)
        if codes is None and self.takes_codes:
            raise ValueError("Generator: 'codes' must be given: predictions depend on them")
        shape = images.shape[:2]
        codes = images.new_zeros(*shape, self.code_dim) if codes is None else codes
        return self(images.flatten(0, 1), codes.flatten(0, 1)[None])[0].unflatten(0, shape)

    def encode(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) images in [0, 1] -> (B, C, H/8, W/8) features, independent of the codes."""
        prepared = prepare_images(images, (self.config.image_height, self.config.image_width))
        with precision(images, self.computes_in, tf32=self.tf32):
            return self.trunk(prepared.contiguous(memory_format=torch.channels_last))

    def decode(self, features: Tensor, codes: Tensor) -> Tensor:
        """(B, C, h, w) features and (R, B, code_dim) codes -> (R, B, N, 3) points, as `forward`."""
        return _existing(self._decode(features, codes))

    @property
    def output_layers(self) -> list[nn.Module]:
        """The layers whose outputs are coordinates, or a latent code."""
        return self.decoder.output_layers

    def dead_share(self, features: Tensor) -> float:
        """Share of the trunk's output channels that are zero at every place of every image."""
        return (features.amax((0, 2, 3)) <= 0).float().mean().item()

    def _decode(self, features: Tensor, codes: Tensor) -> Prediction:
        self.check_codes(codes, len(features))
        repeats = len(codes)
        with precision(features, self.computes_in, tf32=self.tf32):
            if self.code_branch is None:
                made = self.decoder(features)[None]
            else:
                joined = self._join(features, self.code_branch(codes.flatten(0, 1)), repeats)
                made = self.decoder(joined).unflatten(0, codes.shape[:2])
        made = made.expand(repeats, *made.shape[1:])
        if self.config.occupancy_logits:
            return Prediction(made[..., :3], None, made[..., 3] + _INITIAL_LOGIT)
        if self.shape_decoder is None:
            return Prediction(made, None)
        return Prediction(self.shape_decoder(made.flatten(0, 1)).unflatten(0, made.shape[:2]), made)

    @staticmethod
    def _join(features: Tensor, code_features: Tensor, repeats: int) -> Tensor:
        tiled = features.expand(repeats, *features.shape).flatten(0, 1)
        joined = torch.cat([tiled, code_features], dim=1)
        return joined.contiguous(memory_format=torch.channels_last)


def _existing(predicted: Prediction) -> Tensor:
    """(R, B, N, 3): non-existent points are replaced by existing ones in turns; kept if no point exists."""
    points, logits = predicted.points, predicted.logits
    if logits is None:
        return points
    exists = (logits > 0) | (logits <= 0).all(-1, keepdim=True)
    order = exists.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)
    turns = torch.arange(points.shape[2], device=points.device) % exists.sum(-1, keepdim=True)
    return torch.take_along_dim(points, order.gather(-1, turns)[..., None], 2)
