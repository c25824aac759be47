"""Poses and intrinsics in the conventions of other programs, as matrices."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffpoint import _checks

FLIP_YZ = (1.0, -1.0, -1.0)
"""Between OpenCV's axes (x right, y down, z forward) and OpenGL's (x right, y up, z backward)."""
FLIP_XY = (-1.0, -1.0, 1.0)
"""Between OpenCV's axes and PyTorch3D's (x left, y up, z forward)."""


class OpenGLCamera(NamedTuple):
    """A camera as `PinholeCamera.from_opengl` takes it."""

    K: Tensor
    """(..., 3, 3) intrinsics in pixels, as in OpenCV."""
    cam_from_world: Tensor
    """(..., 4, 4) view matrix: x right, y up, z backward."""


class PyTorch3DCamera(NamedTuple):
    """The arguments of PyTorch3D's `PerspectiveCameras` for N cameras."""

    R: Tensor
    """(N, 3, 3) X_view = X_world R + T, axes x left, y up, z forward."""
    T: Tensor
    """(N, 3)"""
    focal_length: Tensor
    """(N, 2) in pixels, or in NDC: over half the shorter side of the image."""
    principal_point: Tensor
    """(N, 2) in pixels, or in NDC: from the centre of the image, to the left and up."""
    image_size: Tensor
    """(N, 2) height and width."""


def flipped(matrix: Tensor, signs: tuple[float, float, float]) -> Tensor:
    """The axes of the camera changed: (..., 4, 4) cam_from_world or (..., 3, 3) with its rows times `signs`."""
    rows = matrix.new_tensor((*signs, 1.0)[: matrix.shape[-2]])
    return matrix * rows[:, None] + 0.0  # no -0.0


def rigid(function: str, R: Any, t: Any, names: tuple[str, str]) -> Tensor:
    """(..., 4, 4) of checked R (..., 3, 3) and t (..., 3), whose leading dimensions are broadcast."""
    _checks.check_tensor(function, names[0], R, ("*", 3, 3))
    _checks.check_tensor(function, names[1], t, ("*", 3))
    _checks.check_same_dtype(function, **dict(zip(names, (R, t), strict=True)))
    try:
        batch = torch.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    except RuntimeError:
        raise _checks.fail(
            function,
            names[1],
            f"have leading dimensions that fit those of '{names[0]}' {tuple(R.shape[:-2])}",
            str(tuple(t.shape[:-1])),
        ) from None
    top = torch.cat((R.expand(*batch, 3, 3), t.expand(*batch, 3)[..., None]), -1)
    last = top.new_tensor([0.0, 0, 0, 1]).expand(*batch, 1, 4)
    return torch.cat((top, last), -2)


def centred_intrinsics(focal_px: float, height: int, width: int, like: Tensor) -> Tensor:
    """(3, 3) with the principal point in the middle of the image."""
    return like.new_tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])


def focal_of(function: str, focal_px: Any, fov_y_deg: Any, height: int) -> float:
    """The focal length in pixels, which is given by one of the two."""
    if (focal_px is None) == (fov_y_deg is None):
        both = "None" if focal_px is None else repr(focal_px)
        raise _checks.fail(
            function,
            "focal_px",
            "be given, or else 'fov_y_deg'",
            f"{both} and {fov_y_deg!r}",
            "Pass one of them.",
        )
    if focal_px is not None:
        return _checks.check_number(
            function,
            "focal_px",
            focal_px,
            "be finite and not 0",
            lambda f: math.isfinite(f) and f != 0,
            "To differentiate with respect to a focal length, make the matrix yourself: PinholeCamera(K, ...).",
        )
    angle = _checks.check_number(
        function, "fov_y_deg", fov_y_deg, "lie between 0 and 180 degrees", lambda a: 0 < a < 180
    )
    return height / 2 / math.tan(math.radians(angle) / 2)


def to_pytorch3d(K: Tensor, cam_from_world: Tensor, height: int, width: int, in_ndc: bool) -> PyTorch3DCamera:
    """Of (N, 3, 3) and (N, 4, 4)."""
    if _checks.readable(K) and bool((K[:, 0, 1].abs() > 1e-6 * K[:, 0, 0].abs()).any()):
        raise _checks.fail(
            "PinholeCamera.to_pytorch3d",
            "K",
            "have no skew, which PyTorch3D's cameras lack",
            f"K[0, 1] = {K.detach()[:, 0, 1].tolist()}",
        )
    view = flipped(cam_from_world, FLIP_XY)
    focal_length, principal_point = K.diagonal(dim1=-2, dim2=-1)[:, :2], K[:, :2, 2]
    if in_ndc:
        half = min(height, width) / 2
        middle = K.new_tensor([width / 2, height / 2])
        focal_length, principal_point = focal_length / half, (middle - principal_point) / half
    size = K.new_tensor([height, width]).expand(len(K), 2)
    return PyTorch3DCamera(view[:, :3, :3].mT, view[:, :3, 3], focal_length, principal_point, size)
