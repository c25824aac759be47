"""Losses that compare depth maps pixel by pixel: that of Lin et al., and one with a soft renderer.

They take the same arguments as the front constraint of `losses.py`, which is compared with them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import _checks
from diffpoint.camera import PinholeCamera, check_views
from diffpoint.distances import nearest
from diffpoint.losses import Reduction, check_maps, reduce_loss
from diffpoint.soft_splat import check_footprint, soft_splat
from diffpoint.splat import splat_depth

EMPTY_LOGIT = -1.0
"""Logit of a pixel that no point falls into, as in the released code of Lin et al."""
_POINT_COVERAGE = (
    2.0  # of a point, in pixels: with as many points as pixels in the silhouette, few stay empty
)
_LEAST_COVERAGE = 0.01  # added to every pixel: bounds the loss of an empty one, and its gradient


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
    """mean |rendered depth - true depth| over the foreground pixels that a point fell into, and a mask term.

    The front constraint is compared with this loss. Pixels are assigned by a step function, so its gradient moves
    points along the camera's z axis only; empty foreground pixels and points outside the silhouette get none.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        logits: (B, N) occupancy logits of the points. Points with a logit of 0 or less are not rendered. Without
            logits all points exist, with a logit of 1.
        mask_weight: of the mask term, the mean over all pixels of the binary cross entropy between the silhouette and
            the rendered logits. A pixel's logit is that of its nearest rendered point; if only points that are not
            rendered fall into it, that of the nearest of them; -1 if none does. 0 leaves the term out.
        upsample: render maps `upsample` times as large in both directions and keep the nearest of each block: points
            that share a pixel then hide each other less ("pseudo-rendering", where it is 5).
        reduction: "mean" over all views, or "none" for (B, V).

    Returns:
        The loss; its depth term in world units, and 0 for a view in which no foreground pixel is hit.

    Gradients: of the depth term to the contributing points, along the camera's z axis, and to the camera's extrinsics;
        of the mask term to `logits` only: it removes points or adds them again, but does not move them.

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
    mask_weight = _check("projection_loss", points, camera, depth, mask_weight=mask_weight)
    upsample = _checks.check_integer(
        "projection_loss", "upsample", upsample, "be a whole number of at least 1", 1
    )
    camera = check_views("projection_loss", "camera", camera, points, views=depth.shape[1]).camera
    if logits is None:
        rendered, index = _pseudo_render(points, camera, upsample=upsample)
        mask_logits = torch.where(index >= 0, 1.0, EMPTY_LOGIT).to(points)
    else:
        _check_logits(logits, points)
        rendered, mask_logits = _render_existing(points, logits, camera, upsample=upsample)
    foreground = torch.isfinite(depth)
    both = foreground & torch.isfinite(rendered)
    # Replaced before the subtraction, because inf - inf would make the gradient NaN.
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
    """Depth (B, V, H, W) and contributor (B, V, H, W) of a larger map, reduced to the nearest pixel of each block."""
    if upsample == 1:
        rendered, index, _ = splat_depth(points, camera, lengths=lengths)
        return rendered, index
    larger = camera.resize(camera.height * upsample, camera.width * upsample)
    rendered, index, _ = splat_depth(points, larger, lengths=lengths)
    blocks = [
        m.unflatten(3, (-1, upsample)).unflatten(2, (-1, upsample)).transpose(3, 4).flatten(4)
        for m in (rendered, index)
    ]
    closest = blocks[0].detach().argmin(-1, keepdim=True)
    return tuple(m.gather(-1, closest)[..., 0] for m in blocks)  # type: ignore[return-value]


def _render_existing(
    points: Tensor, logits: Tensor, camera: PinholeCamera, *, upsample: int
) -> tuple[Tensor, Tensor]:
    """Depth of the points with a positive logit, and the logit of every pixel, (B, V, H, W)."""
    exists = logits > 0
    depth, pixel_logits = None, points.new_full((), EMPTY_LOGIT)
    for chosen in (~exists, exists):  # existing points come last and overwrite the logits of the others
        order = chosen.to(torch.uint8).argsort(dim=1, descending=True, stable=True)
        sorted_points = points.gather(1, order[..., None].expand(points.shape))
        depth, index = _pseudo_render(sorted_points, camera, upsample=upsample, lengths=chosen.sum(1))
        if points.shape[1]:
            own = logits.gather(1, order)[:, None].expand(-1, index.shape[1], -1)
            own = own.gather(2, index.clamp(min=0).flatten(2)).view(index.shape)
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
    """The projection loss with `soft_splat`, which has gradients to x and y as well.

    Per view, in sums over pixels divided by the number of foreground pixels:

    - on the foreground, mask * |soft depth - true depth|;
    - on the foreground, -log(mask), times `mask_weight`: large at empty pixels, near 0 at covered ones;
    - on the background, coverage * distance to the silhouette in pixels, times `mask_weight`. The binary cross entropy
      would be the coverage alone, whose gradient is 0 for a point whose whole footprint lies on the background.

    The coverage of a point sums up to two pixels, whatever the size of its footprint. The map is rendered with a margin
    of half its side, which counts as background, so that moving out of the frame does not reduce the loss.

    Args:
        points: (B, N, 3) predicted clouds in the world.
        camera: batch shape (), (V,) or (B, V), of the depth maps' size.
        depth: (B, V, H, W) true depth maps, +inf where empty.
        radius: of the footprints in pixels: how far away a point still gets a gradient from an empty foreground pixel.
            Start with 6 or 8 and reduce it to 1.
        softness: of the depth order, in world units.
        mask_weight: of the terms on the mask, in world units.
        reduction: "mean" over all views, or "none" for (B, V).

    Returns:
        The loss in world units.

    Gradients: to x, y and z of the points whose footprint touches the map or its margin, and to the camera's matrices;
        none to `depth` through the shape of the silhouette.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, NaN or infinite coordinates, a radius or softness that
            is not positive and finite, a negative `mask_weight`.

    Source: see `soft_splat`. The distance on the background is the affinity term of CAPNet (Navaneet et al., AAAI
        2019), the rest the depth and mask terms of `projection_loss`.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8)
        >>> depth = torch.full((1, 1, 8, 8), float("inf")); depth[..., 3:5, 3:5] = 2.0
        >>> cloud = torch.tensor([[[-0.45, 0.0, 0.0]]], requires_grad=True)
        >>> soft_projection_loss(cloud, camera, depth).backward()
        >>> bool(cloud.grad[0, 0, 0] < 0)  # the point lies beside the silhouette: descent moves it in
        True
    """
    mask_weight = _check("soft_projection_loss", points, camera, depth, mask_weight=mask_weight)
    radius, softness = check_footprint("soft_projection_loss", radius, softness)
    camera = check_views("soft_projection_loss", "camera", camera, points, views=depth.shape[1]).camera
    margin = max(camera.height, camera.width) // 2
    distance = _distance_to(torch.isfinite(depth), margin).to(points)
    depth = F.pad(depth, (margin,) * 4, value=math.inf)
    soft = soft_splat(points, _with_margin(camera, margin), radius=radius, softness=softness)
    foreground = torch.isfinite(depth)
    count = foreground.sum((-2, -1)).clamp(min=1)
    volume = math.pi / 3 * radius**2  # of a footprint
    coverage = _POINT_COVERAGE / volume * soft.coverage
    both = foreground & torch.isfinite(soft.depth)
    difference = torch.where(both, soft.depth, 0.0) - torch.where(both, depth, 0.0)
    loss = (-torch.expm1(-coverage) * difference.abs()).sum((-2, -1)) / count
    if mask_weight:
        missing = -torch.log(-torch.expm1(-(coverage + _LEAST_COVERAGE)))
        wrong = torch.where(foreground, missing, distance * coverage)
        loss = loss + mask_weight * wrong.sum((-2, -1)) / count
    return reduce_loss("soft_projection_loss", loss, reduction)


def _with_margin(camera: PinholeCamera, margin: int) -> PinholeCamera:
    """The same view on a map with `margin` more pixels on every side."""
    shift = torch.zeros_like(camera.K)
    shift[..., :2, 2] = margin
    return PinholeCamera(
        camera.K + shift, camera.cam_from_world, camera.height + 2 * margin, camera.width + 2 * margin
    )


def _distance_to(foreground: Tensor, margin: int) -> Tensor:
    """Distance in pixels of each pixel to the nearest of the foreground; 1 where there is none.

    On a map with `margin` more pixels on every side than `foreground` (B, V, H, W); there, the distance to the frame is
    added.
    """
    height, width = foreground.shape[-2:]
    steps = (torch.arange(size, device=foreground.device) for size in (height, width))
    rows, columns = torch.meshgrid(*steps, indexing="ij")
    pixels = torch.stack((columns, rows, torch.zeros_like(rows)), -1).reshape(-1, 3).to(torch.float32)
    flat = foreground.reshape(-1, height * width)
    counts = flat.sum(1)
    longest = int(counts.max()) if flat.shape[0] and _checks.readable(counts) else height * width
    first = flat.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :longest]
    squared = nearest(pixels.expand(flat.shape[0], -1, -1), pixels[first], b_lengths=counts).squared_distance
    distance = torch.where(torch.isfinite(squared), squared, 1.0).sqrt().view(foreground.shape)
    (row, down), (column, across) = (_nearest_in_frame(size, margin, distance) for size in (height, width))
    return distance[..., row, :][..., column] + torch.hypot(across, down[:, None])


def _nearest_in_frame(size: int, margin: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """For each of size + 2 margin pixels: the nearest one in the frame, and its distance."""
    at = torch.arange(-margin, size + margin, device=like.device)
    framed = at.clamp(0, size - 1)
    return framed, (at - framed).abs().to(like)


def _check(
    function: str, points: Tensor, camera: PinholeCamera, depth: Tensor, *, mask_weight: float
) -> float:
    """Checks arguments that both losses have; returns `mask_weight` as a float."""
    check_maps(function, points, camera, depth)
    _checks.check_depth(function, "depth", depth.detach())
    expected = "be a finite number of at least 0"
    return _checks.check_number(function, "mask_weight", mask_weight, expected, lambda x: 0 <= x < math.inf)


def _check_logits(logits: Tensor, points: Tensor) -> None:
    _checks.check_tensor("projection_loss", "logits", logits, (points.shape[0], points.shape[1]))
    _checks.check_same_dtype("projection_loss", points=points, logits=logits)
    _checks.check_finite("projection_loss", "logits", logits.detach())
