"""Pinhole cameras in the OpenCV convention."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from diffpoint import _checks

_FLIP_YZ = ((1.0, 0, 0, 0), (0, -1.0, 0, 0), (0, 0, -1.0, 0), (0, 0, 0, 1.0))
_FLIP_XY = ((-1.0, 0, 0, 0), (0, -1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))


@dataclasses.dataclass(frozen=True, eq=False)
class PinholeCamera:
    """Cameras with intrinsics `K` (pixels) and extrinsics `cam_from_world`, for maps of height x width pixels.

    Camera axes are OpenCV's: x right, y down, z forward; depth is z in this frame. Image coordinates are
    continuous in [0, width] x [0, height]; pixel p covers [p, p + 1) and its centre is p + 0.5.

    Attributes:
        K: (..., 3, 3), last row (0, 0, 1), in pixels.
        cam_from_world: (..., 4, 4), last row (0, 0, 0, 1), metric units of the world.
        height: rows of the map.
        width: columns of the map.

    Gradients: every method is differentiable with respect to `K` and `cam_from_world`.

    Raises:
        ValueError: shapes, last rows or sizes that do not describe a pinhole camera.
        TypeError: not a tensor, or not float32 or float64.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), (0, 0, 0), focal_px=420.0, height=224, width=224)
        >>> camera.position.tolist()
        [0.0, 0.0, -2.0]
        >>> camera.resize(56, 56).K[0, 0].item()
        105.0
    """

    K: Tensor
    cam_from_world: Tensor
    height: int
    width: int

    def __post_init__(self) -> None:
        _checks.check_tensor("PinholeCamera", "K", self.K, ("*", 3, 3))
        _checks.check_tensor("PinholeCamera", "cam_from_world", self.cam_from_world, ("*", 4, 4))
        _checks.check_same_dtype("PinholeCamera", K=self.K, cam_from_world=self.cam_from_world)
        for name in ("height", "width"):
            size = _checks.check_integer(
                "PinholeCamera", name, getattr(self, name), "be a positive integer", 1
            )
            if size is not getattr(self, name):  # a number of numpy
                object.__setattr__(self, name, size)
        try:
            torch.broadcast_shapes(self.K.shape[:-2], self.cam_from_world.shape[:-2])
        except RuntimeError:
            raise _checks.fail(
                "PinholeCamera",
                "cam_from_world",
                f"have leading dimensions that fit those of 'K' {tuple(self.K.shape[:-2])}",
                str(tuple(self.cam_from_world.shape[:-2])),
            ) from None
        self._check_last_rows()

    def _check_last_rows(self) -> None:
        for name, value in (("K", self.K), ("cam_from_world", self.cam_from_world)):
            value = value.detach()
            if not _checks.readable(value):
                continue
            _checks.check_finite("PinholeCamera", name, value)
            row = value[..., -1, :]
            wanted = _last_row(row.shape[-1], value.dtype, value.device)
            wrong = ~((row - wanted).abs() <= 1e-5)
            if _checks.deferred(wrong, "PinholeCamera", name, "last row"):
                continue
            if bool(wrong.any()):
                got = row.reshape(-1, row.shape[-1])[0].tolist()
                hint = "Divide the matrix by its last entry, or transpose it." if got[-1] else ""
                raise _checks.fail("PinholeCamera", name, f"end in the row {wanted.tolist()}", str(got), hint)

    @classmethod
    def look_at(
        cls,
        eye: Tensor | tuple[float, float, float],
        target: Tensor | tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        focal_px: float,
        height: int,
        width: int,
        up: Tensor | tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> PinholeCamera:
        """Cameras at `eye` (..., 3) that look at `target`, `up` pointing up in the image; centre in the middle.

        Example:
            >>> PinholeCamera.look_at((2.0, 0, 0), focal_px=100.0, height=8, width=8).cam_from_world[2].tolist()
            [-1.0, 0.0, 0.0, 2.0]
        """
        focal_px = _checks.check_number(
            "PinholeCamera.look_at",
            "focal_px",
            focal_px,
            "be finite and not 0",
            lambda f: math.isfinite(f) and f != 0,
            "To differentiate with respect to a focal length, make the matrix yourself: PinholeCamera(K, ...).",
        )
        at = _vector("eye", eye)
        at, towards, upward = torch.broadcast_tensors(
            at, _vector("target", target, at), _vector("up", up, at)
        )
        forward = towards - at
        right = torch.linalg.cross(forward, upward)
        if _checks.readable(forward, right) and (
            bool((forward.norm(dim=-1) == 0).any()) or bool((right.norm(dim=-1) < 1e-9).any())
        ):
            raise _checks.fail(
                "PinholeCamera.look_at",
                "up",
                "differ in direction from target - eye, and eye from target",
                f"eye {at.reshape(-1, 3)[0].tolist()}, target {towards.reshape(-1, 3)[0].tolist()}",
                "Choose another 'up', for instance (0, 0, 1) for a view from above.",
            )
        forward = forward / forward.norm(dim=-1, keepdim=True)
        right = right / right.norm(dim=-1, keepdim=True)
        down = torch.linalg.cross(forward, right)
        rotation = torch.stack((right, down, forward), dim=-2)
        cam_from_world = at.new_zeros((*at.shape[:-1], 4, 4))
        cam_from_world[..., :3, :3] = rotation
        with _checks.full_precision(at):
            cam_from_world[..., :3, 3] = -(rotation @ at[..., None])[..., 0]
        cam_from_world[..., 3, 3] = 1
        K = at.new_tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]]).expand(
            *at.shape[:-1], 3, 3
        )
        return cls(K, cam_from_world, height, width)

    @classmethod
    def from_opengl(cls, K: Tensor, cam_from_world: Tensor, height: int, width: int) -> PinholeCamera:
        """From an OpenGL or Blender view matrix (x right, y up, z backward). `K` as in OpenCV.

        Example:
            >>> gl = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]])  # eye at z = 2
            >>> PinholeCamera.from_opengl(torch.eye(3), gl, 4, 4).position.tolist()
            [0.0, 0.0, 2.0]
        """
        _checks.check_tensor("PinholeCamera.from_opengl", "cam_from_world", cam_from_world, ("*", 4, 4))
        with _checks.full_precision(cam_from_world):
            flipped = cam_from_world.new_tensor(_FLIP_YZ) @ cam_from_world
        return cls(K, flipped, height, width)

    @classmethod
    def from_pytorch3d(cls, R: Tensor, T: Tensor, K: Tensor, height: int, width: int) -> PinholeCamera:
        """From PyTorch3D's `R` (..., 3, 3), `T` (..., 3): X_view = X_world R + T, x left, y up, z forward.

        `K` is the OpenCV matrix in pixels (PyTorch3D's `cameras_from_opencv_projection` is the inverse).

        Example:
            >>> R, T, K = torch.eye(3), torch.tensor([0.0, 0.0, 2.0]), torch.eye(3)
            >>> PinholeCamera.from_pytorch3d(R, T, K, 4, 4).position.tolist()
            [0.0, 0.0, -2.0]
        """
        _checks.check_tensor("PinholeCamera.from_pytorch3d", "R", R, ("*", 3, 3))
        _checks.check_tensor("PinholeCamera.from_pytorch3d", "T", T, ("*", 3))
        view_from_world = R.new_zeros((*R.shape[:-2], 4, 4))
        view_from_world[..., :3, :3] = R.transpose(-1, -2)
        view_from_world[..., :3, 3] = T
        view_from_world[..., 3, 3] = 1
        with _checks.full_precision(R):
            flipped = R.new_tensor(_FLIP_XY) @ view_from_world
        return cls(K, flipped, height, width)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions of the cameras: (), (V,) or (B, V)."""
        own, other = self.K.shape[:-2], self.cam_from_world.shape[:-2]
        if own == other:  # saves 10 us of broadcasting
            return tuple(own)
        return tuple(torch.broadcast_shapes(own, other))

    @property
    def dtype(self) -> torch.dtype:
        return self.K.dtype

    @property
    def position(self) -> Tensor:
        """Optical centres in the world, (..., 3)."""
        return _inverse("cam_from_world", self.cam_from_world)[..., :3, 3] + 0.0  # no -0.0

    @property
    def projection(self) -> Tensor:
        """(..., 3, 4): (u d, v d, d) = projection @ (x, y, z, 1), with depth d, for world points."""
        with _checks.full_precision(self.K):
            return self.K @ self.cam_from_world[..., :3, :]

    @property
    def back_projection(self) -> Tensor:
        """(..., 3, 4): world point = d * (M[:, :3] @ (u, v, 1)) + M[:, 3] for the pixel position (u, v) at depth d."""
        world_from_cam = _inverse("cam_from_world", self.cam_from_world)
        with _checks.full_precision(self.K):
            rays = world_from_cam[..., :3, :3] @ _inverse("K", self.K)
        origin = world_from_cam[..., :3, 3:].expand(*rays.shape[:-1], 1)
        return torch.cat((rays, origin), dim=-1)

    def resize(self, height: int, width: int) -> PinholeCamera:
        """The same view on a map of another size: K's rows are scaled by the ratio of the sizes."""
        scale = self.K.new_tensor([width / self.width, height / self.height, 1.0])
        return PinholeCamera(self.K * scale[:, None], self.cam_from_world, height, width)

    def to(self, *args, **kwargs) -> PinholeCamera:
        """As `torch.Tensor.to`, on both matrices."""
        return dataclasses.replace(
            self, K=self.K.to(*args, **kwargs), cam_from_world=self.cam_from_world.to(*args, **kwargs)
        )

    def expand(self, *batch_shape: int) -> PinholeCamera:
        """The same cameras with leading dimensions broadcast to `batch_shape`, without copying."""
        return dataclasses.replace(
            self,
            K=self.K.expand(*batch_shape, 3, 3),
            cam_from_world=self.cam_from_world.expand(*batch_shape, 4, 4),
        )

    def __getitem__(self, item) -> PinholeCamera:
        """Index the leading dimensions; `camera[:, None]` makes one view for each cloud of N cameras.

        Example:
            >>> cameras = PinholeCamera(torch.eye(3), torch.eye(4).expand(5, 4, 4), 8, 8)
            >>> cameras[2].batch_shape, cameras[1:].batch_shape, cameras[:, None].batch_shape
            ((), (4,), (5, 1))
        """
        shape = self.batch_shape
        if not shape:
            raise IndexError("PinholeCamera: a single camera has no leading dimension to index.")
        whole = self.expand(*shape)
        return dataclasses.replace(self, K=whole.K[item], cam_from_world=whole.cam_from_world[item])


@functools.cache
def _last_row(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    row = torch.zeros(size, dtype=dtype, device=device)
    row[-1] = 1
    return row


def _inverse(name: str, matrix: Tensor) -> Tensor:
    inverse, singular = torch.linalg.inv_ex(matrix)
    deferred = _checks.deferred(singular > 0, "PinholeCamera", name, "invertible")
    if not deferred and _checks.readable(singular) and bool(singular.any()):
        got = matrix.detach()[singular > 0][0].tolist() if matrix.dim() > 2 else matrix.tolist()
        raise _checks.fail("PinholeCamera", name, "be invertible", str(got), "Is a focal length 0?")
    return inverse


def _vector(name: str, value, like: Tensor | None = None) -> Tensor:
    if not isinstance(value, Tensor):
        value = torch.tensor(value, dtype=torch.float32) if like is None else like.new_tensor(value)
    value = _checks.check_tensor("PinholeCamera.look_at", name, value, ("*", 3))
    return value if like is None else value.to(like)


class Views(NamedTuple):
    """A camera broadcast to batch shape (B, V). Matrices are computed before they are broadcast."""

    camera: PinholeCamera
    batch_shape: tuple[int, int]

    @property
    def projection(self) -> Tensor:
        """(B, V, 3, 4), see `PinholeCamera.projection`."""
        return self.camera.projection.expand(*self.batch_shape, 3, 4)

    @property
    def back_projection(self) -> Tensor:
        """(B, V, 3, 4), see `PinholeCamera.back_projection`."""
        return self.camera.back_projection.expand(*self.batch_shape, 3, 4)


def check_views(
    function: str, name: str, camera: PinholeCamera, like: Tensor, *, views: int | None = None
) -> Views:
    """The camera as (B, V) views, B being the first dimension of `like`; batch shapes () and (V,) are shared by all B.

    `views`: the number of depth maps per item; the camera must have as many views, or one.
    """
    if not isinstance(camera, PinholeCamera):
        raise TypeError(f"{function}: '{name}' must be a PinholeCamera; got {type(camera).__name__}.")
    if camera.dtype != like.dtype:
        raise TypeError(
            f"{function}: '{name}' must have the dtype of the points ({like.dtype}); got {camera.dtype}. "
            f"Convert it with {name}.to({like.dtype})."
        )
    _checks.check_device(function, name, camera.K, like)
    batch, shape = like.shape[0], camera.batch_shape
    if len(shape) > 2 or (len(shape) == 2 and shape[0] not in (1, batch)):
        raise _checks.fail(
            function,
            name,
            f"have batch shape (), (V,), (1, V) or ({batch}, V)",
            str(tuple(shape)),
            "One row of cameras per cloud.",
        )
    own = shape[-1] if shape else 1
    if views is not None and own not in (1, views):
        hint = (
            f"For one camera for each of the {batch} clouds pass {name}[:, None]."
            if shape == (batch,)
            else ""
        )
        raise _checks.fail(function, name, f"have {views} views to match 'depth'", str(own), hint)
    return Views(camera, (batch, own if views is None else views))


class Projection(NamedTuple):
    """Image positions and depths of points."""

    pixels: Tensor
    """(B, V, N, 2) continuous image coordinates (u, v)."""
    depth: Tensor
    """(B, V, N) z in the camera frame; negative behind the camera."""


class PointSets(NamedTuple):
    """Point sets of different sizes, padded with zeros."""

    points: Tensor
    """(B, V, N, 3) world frame."""
    lengths: Tensor
    """(B, V) int64: how many of the N entries are points."""
