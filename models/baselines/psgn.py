"""PSGN: one image -> one cloud, by the two-branch network on which the conditional generator is based.

It is that generator without its code branch, layer by layer; the difference lies in the training, which uses the whole
ground-truth clouds. The first published version took the object's mask as a fourth channel and predicted 256 + 768
points; this one takes the same images as all other networks here and predicts 512 + 1536.

Source: Fan, Su, Guibas, "A point set generation network for 3D object reconstruction from a single image" (CVPR 2017),
with the sizes of the CVPR 2019 paper.
"""

from __future__ import annotations

from models.generator import Generator, build_generator


def build_psgn(profile: str = "cpu") -> Generator:
    """Builds PSGN with freshly drawn weights.

    Args:
        profile: "full" (192 x 256 images, 2048 points, 39.70 million parameters), "cpu" or "smoke".

    Example:
        >>> import torch
        >>> model = build_psgn("smoke")
        >>> model(torch.rand(2, 3, 56, 56), torch.zeros(1, 2, model.code_dim)).shape
        torch.Size([1, 2, 128, 3])
    """
    return build_generator(profile, deterministic=True)
