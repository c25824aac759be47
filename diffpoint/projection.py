"""Losses that compare depth maps pixel by pixel: Lin's, and one whose renderer is soft.

Beside the front constraint of `losses.py`: the same arguments, the same renderer, another way to use it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import _checks
from diffpoint.camera import PinholeCamera, check_views
from diffpoint.losses import Reduction, check_maps, reduce_loss
from diffpoint.reproject import check_depth
from diffpoint.soft_splat import soft_splat
from diffpoint.splat import splat_depth

EMPTY_LOGIT = -1.0
"""Of a pixel that nothing falls into, as in the released code of Lin et al."""


def projection_loss(
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    *,
    logits: Tensor | None = None,
    mask_weight: float = 0.0,
    upsample: int = 1,
    reduction: Reduction = "mean",
) -> Tensor:
    """mean |rendered depth - true depth| over the foreground pixels that a point fell into, and a term on the mask.

    The loss the front constraint is compared with. Pixels are assigned by a step function, so its gradient moves
    points along the camera's z axis only; empty foreground pixels and points outside the silhouette get none.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        logits: (B, N) of the points' existence. Points with a logit of 0 or less are not rendered. Without logits all
            points exist, with a logit of 1.
        mask_weight: of the mask term, the mean over all pixels of the binary cross entropy between the silhouette and
            the rendered logits: that of the contributor; where only points that do not exist fall, that of the nearest
            of them; -1 where none falls. 0 leaves the term out.
        upsample: render maps `upsample` times as large in both directions and keep the nearest of each block: points
            that share a pixel then hide each other less ("pseudo-rendering", where it is 5).
        reduction: "mean" over all views, or "none" for (B, V).

    Returns:
        The loss; its depth term in world units, and 0 for a view in which no foreground pixel is hit.

    Gradients: of the depth term to the contributing points, along the camera's z axis, and to the camera's extrinsics;
        of the mask term to `logits` only: it can delete points and bring them back, but not move them.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, NaN or infinite coordinates or logits, an `upsample`
            below 1, a negative `mask_weight`.

    Source: Lin, Kong, Lucey, "Learning efficient point cloud generation for dense 3D object reconstruction" (AAAI
        2018), with a z-buffer where the released code sums the points of a cell and leaves out the cells of several.
        That code sums both terms over pixels: `mask_weight` = H W / hit pixels, for its weights of 1 and 1.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
        >>> cloud = torch.rand(1, 50, 3) - 0.5
        >>> projection_loss(cloud, camera, splat_depth(cloud, camera).depth).item()
        0.0
    """
    _check("projection_loss", points, camera, depth, mask_weight=mask_weight)
    if not isinstance(upsample, int) or isinstance(upsample, bool) or upsample < 1:
        raise _checks.fail("projection_loss", "upsample", "be a whole number of at least 1", repr(upsample))
    camera = check_views("projection_loss", "camera", camera, points, views=depth.shape[1]).camera
    if logits is None:
        rendered, index = _pseudo_render(points, camera, upsample=upsample)
        mask_logits = torch.where(index >= 0, 1.0, EMPTY_LOGIT).to(points)
    else:
        _check_logits(logits, points)
        rendered, mask_logits = _render_existing(points, logits, camera, upsample=upsample)
    foreground = torch.isfinite(depth)
    both = foreground & torch.isfinite(rendered)
    # Where not both are finite the difference is replaced before it is taken: inf - inf would poison the gradient.
    difference = torch.where(both, rendered, 0.0) - torch.where(both, depth, 0.0)
    loss = difference.abs().sum((-2, -1)) / both.sum((-2, -1)).clamp(min=1)
    if mask_weight:
        wrong = F.binary_cross_entropy_with_logits(
            mask_logits.expand(depth.shape), foreground.to(points), reduction="none"
        )
        loss = loss + mask_weight * wrong.mean((-2, -1))
    return reduce_loss("projection_loss", loss, reduction)


def _pseudo_render(
    points: Tensor, camera: PinholeCamera, *, upsample: int, lengths: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Depth (B, V, H, W) and contributor (B, V, H, W) of a larger map, of whose blocks the nearest pixel is kept."""
    if upsample == 1:
        rendered, index, _ = splat_depth(points, camera, lengths=lengths)
        return rendered, index
    larger = camera.resize(camera.height * upsample, camera.width * upsample)
    rendered, index, _ = splat_depth(points, larger, lengths=lengths)
    blocks = [
        m.unflatten(3, (-1, upsample)).unflatten(2, (-1, upsample)).transpose(3, 4).flatten(4)
        for m in (rendered, index)
    ]
    nearest = blocks[0].detach().argmin(-1, keepdim=True)
    return tuple(torch.take_along_dim(m, nearest, -1)[..., 0] for m in blocks)  # type: ignore[return-value]


def _render_existing(
    points: Tensor, logits: Tensor, camera: PinholeCamera, *, upsample: int
) -> tuple[Tensor, Tensor]:
    """Depth of the points that exist, and the logit of every pixel, (B, V, H, W)."""
    exists = logits > 0
    depth, pixel_logits = None, points.new_full((), EMPTY_LOGIT)
    for chosen in (~exists, exists):  # what exists comes last and replaces what does not
        order = chosen.to(torch.uint8).argsort(dim=1, descending=True, stable=True)
        sorted_points = torch.take_along_dim(points, order[..., None], 1)
        depth, index = _pseudo_render(sorted_points, camera, upsample=upsample, lengths=chosen.sum(1))
        if points.shape[1]:
            own = torch.take_along_dim(logits, order, 1)[:, None]
            own = torch.take_along_dim(own, index.clamp(min=0).flatten(2), 2).view(index.shape)
            pixel_logits = torch.where(index >= 0, own, pixel_logits)
    assert depth is not None
    return depth, pixel_logits


def soft_projection_loss(
    points: Tensor,
    camera: PinholeCamera,
    depth: Tensor,
    *,
    radius: float = 2.0,
    softness: float = 0.02,
    mask_weight: float = 0.1,
    reduction: Reduction = "mean",
) -> Tensor:
    """The projection loss through `soft_splat`, whose depth and mask follow a point that moves sideways.

    Per view: the mean over foreground pixels of mask * |soft depth - true depth|, plus `mask_weight` times the mean
    over all pixels of the binary cross entropy between soft mask and silhouette. Outside the silhouette that is the
    coverage itself; on an empty foreground pixel it is bounded by a coverage of 0.01 that every pixel has for free.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        radius: of the footprints in pixels: how far a pixel, empty or wrongly covered, pulls or pushes a point.
        softness: of the depth order, in world units.
        mask_weight: of the mask term, in world units.
        reduction: "mean" over all views, or "none" for (B, V).

    Returns:
        The loss in world units.

    Gradients: to x, y and z of the points that cover a pixel, and to the camera's matrices. A point further than
        `radius` from the silhouette and from every pixel of other coverage is not told where to go.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, NaN or infinite coordinates, a radius or softness that
            is not positive and finite, a negative `mask_weight`.

    Source: see `soft_splat`; depth and mask terms as in `projection_loss`.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
        >>> depth = torch.full((1, 1, 8, 8), float("inf")); depth[..., 2:6, 2:6] = 2.0
        >>> cloud = torch.tensor([[[0.45, 0.0, 0.0]]], requires_grad=True)
        >>> soft_projection_loss(cloud, camera, depth).backward()
        >>> bool(cloud.grad[0, 0, 0] > 0)  # the point lies beside the silhouette: descent moves it in
        True
    """
    _check("soft_projection_loss", points, camera, depth, mask_weight=mask_weight)
    camera = check_views("soft_projection_loss", "camera", camera, points, views=depth.shape[1]).camera
    soft = soft_splat(points, camera, radius=radius, softness=softness)
    foreground = torch.isfinite(depth)
    both = foreground & torch.isfinite(soft.depth)
    difference = torch.where(both, soft.depth, 0.0) - torch.where(both, depth, 0.0)
    loss = (soft.mask * difference.abs()).sum((-2, -1)) / foreground.sum((-2, -1)).clamp(min=1)
    if mask_weight:
        missing = -torch.log(-torch.expm1(-(soft.coverage + _FREE)))
        loss = loss + mask_weight * torch.where(foreground, missing, soft.coverage).mean((-2, -1))
    return reduce_loss("soft_projection_loss", loss, reduction)


_FREE = 0.01  # coverage of every pixel: bounds the loss of an empty one, and the pull on the first point to touch it


def _check(
    function: str, points: Tensor, camera: PinholeCamera, depth: Tensor, *, mask_weight: float
) -> None:
    check_maps(function, points, camera, depth)
    if not 0 <= mask_weight < float("inf"):
        raise _checks.fail(function, "mask_weight", "be a finite number of at least 0", repr(mask_weight))
    if not torch.compiler.is_compiling():
        check_depth(function, "depth", depth.detach())


def _check_logits(logits: Tensor, points: Tensor) -> None:
    _checks.check_tensor("projection_loss", "logits", logits, (points.shape[0], points.shape[1]))
    _checks.check_same_dtype("projection_loss", points=points, logits=logits)
    if not torch.compiler.is_compiling():
        _checks.check_finite("projection_loss", "logits", logits.detach())
