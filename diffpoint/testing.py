"""Helpers for tests of differentiable point rendering, also your own: inputs without ties, and comparisons.

Rendering assigns points to pixels by a step function. A gradient check, or a comparison of two renderers that round
differently, is only meaningful where no point lies on a step: `tie_free_clouds` makes such inputs, and
`boundary_points` finds the points for which two correct renderers may disagree.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint.camera import PinholeCamera, check_views

# Per dtype, relative to the size of the values; large enough for sums of a few thousand terms.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-11}


def tie_free_clouds(
    batch: int,
    count: int,
    camera: PinholeCamera,
    *,
    seed: int,
    dtype: torch.dtype = torch.float64,
    margin: float = 1e-3,
) -> Tensor:
    """Clouds (batch, count, 3) in [-0.5, 0.5]^3 with no point on a pixel's border in any view of `camera`.

    Depths within a cloud differ by at least `margin` / 100 in every view, so that rounding does not change a z-buffer.

    Raises:
        ValueError: `count` points with these margins were not found.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=30.0, height=16, width=16)
        >>> tie_free_clouds(2, 20, camera, seed=0).shape
        torch.Size([2, 20, 3])
    """
    generator = torch.Generator().manual_seed(seed)
    views = check_views(
        "tie_free_clouds", "camera", camera.to(torch.float64), torch.empty(batch, 0, 3, dtype=torch.float64)
    )
    cameras = views.camera.expand(*views.batch_shape)
    clouds = []
    for cloud in range(batch):
        points = torch.rand(8 * count, 3, dtype=torch.float64, generator=generator) - 0.5
        points = points.to(dtype).to(torch.float64)
        for view in range(views.batch_shape[1]):
            camera_here = cameras[cloud, view]
            points = points[~boundary_points(points[None], camera_here, margin=margin)[0, 0]]
            depth, order = (points @ camera_here.projection[2, :3]).sort()
            gap = depth.diff(prepend=depth[:1] - 1)
            points = points[order[gap > margin / 100].sort().values]
        if len(points) < count:
            raise ValueError(
                f"tie_free_clouds: only {len(points)} of {count} points found with margin {margin}; "
                "choose fewer points or a smaller margin."
            )
        clouds.append(points[:count])
    return torch.stack(clouds).to(dtype)


def boundary_points(points: Tensor, camera: PinholeCamera, *, margin: float = 1e-3) -> Tensor:
    """(B, V, N) bool: points within `margin` pixels of a pixel's border, or of the camera's plane.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> boundary_points(torch.tensor([[[0.0, 0.0, 0.0], [0.25, 0.25, 0.0]]]), camera).tolist()
        [[[True, False]]]
    """
    projection = check_views("boundary_points", "camera", camera, points).projection
    ones = torch.ones_like(points[..., :1])
    with _checks.full_precision(points):
        homogeneous = torch.cat((points, ones), -1)[:, None] @ projection.mT
    depth = homogeneous[..., 2]
    pixels = homogeneous[..., :2] / torch.where(depth == 0, 1.0, depth)[..., None]
    return ((pixels - pixels.round()).abs() < margin).any(-1) | (depth.abs() < margin)


def check_gradients(function: Callable, *inputs: Tensor) -> None:
    """Compare a function's gradients with finite differences in float64 (`torch.autograd.gradcheck`).

    It also compares an expanded output gradient (stride 0, as in `.sum().backward()`) with a contiguous one.

    Raises:
        AssertionError: from the comparison.

    Example:
        >>> check_gradients(lambda x: x.square(), torch.rand(3, dtype=torch.float64))
    """
    leaves = [x.detach().clone().requires_grad_(x.is_floating_point()) for x in inputs]
    assert torch.autograd.gradcheck(function, leaves)
    outputs = function(*leaves)
    outputs = [outputs] if isinstance(outputs, Tensor) else [o for o in outputs if o.requires_grad]
    differentiable = [x for x in leaves if x.requires_grad]
    expanded = [torch.ones((), dtype=o.dtype).expand(o.shape) for o in outputs]
    dense = [g.contiguous() for g in expanded]
    for x, y in zip(
        torch.autograd.grad(outputs, differentiable, expanded, retain_graph=True, allow_unused=True),
        torch.autograd.grad(outputs, differentiable, dense, allow_unused=True),
        strict=True,
    ):
        assert (x is None and y is None) or torch.equal(x, y)


def assert_close(actual: Tensor, expected: Tensor, *, scale: float = 1.0) -> None:
    """Equal up to `TOLERANCE` of the dtype times `scale`; infinities in the same places.

    Example:
        >>> assert_close(torch.tensor([1.0]), torch.tensor([1.0 + 1e-6]))
    """
    tolerance = TOLERANCE.get(expected.dtype, 0.0) * scale
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@contextlib.contextmanager
def cuda_kernels_interpreted() -> Iterator[None]:
    """Inside, ops on CPU tensors run the kernels for CUDA tensors in Triton's interpreter: slow, for tests without GPU.

    The environment must hold TRITON_INTERPRET=1 before triton is imported for the first time.

    Raises:
        RuntimeError: it does not.
        ImportError: triton is missing.

    Example:
        >>> with cuda_kernels_interpreted():  # doctest: +SKIP
        ...     check_gradients(lambda a: nearest(a, b).squared_distance, a)
    """
    if os.environ.get("TRITON_INTERPRET") != "1":
        raise RuntimeError(
            "cuda_kernels_interpreted: set the environment variable TRITON_INTERPRET=1 before triton is imported."
        )
    import triton  # noqa: F401

    before = _bridge.interpreted
    _bridge.interpreted = True
    try:
        yield
    finally:
        _bridge.interpreted = before
