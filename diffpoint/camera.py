"""Pinhole cameras in the OpenCV convention."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from diffpoint import _checks, _conversions
from diffpoint._conversions import OpenGLCamera, PyTorch3DCamera


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
        for name, size in _sizes("PinholeCamera", self.height, self.width).items():
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
        height: int,
        width: int,
        focal_px: float | None = None,
        fov_y_deg: float | None = None,
        up: Tensor | tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> PinholeCamera:
        """Cameras at `eye` (..., 3) that look at `target`, `up` pointing up in the image; centre in the middle.

        The focal length is given in pixels, or by the vertical field of view in degrees. The dtype is that of `eye`;
        where it holds numbers only, torch's default.

        Example:
            >>> PinholeCamera.look_at((2.0, 0, 0), focal_px=100.0, height=8, width=8).cam_from_world[2].tolist()
            [-1.0, 0.0, 0.0, 2.0]
        """
        name = "PinholeCamera.look_at"
        sizes = _sizes(name, height, width)
        focal_px = _conversions.focal_of(name, focal_px, fov_y_deg, sizes["height"])
        at = _vector("eye", eye)
        given = at, _vector("target", target, at), _vector("up", up, at)
        for argument, vectors in zip(("eye", "target", "up"), given, strict=True):
            _checks.check_finite(name, argument, vectors.detach())
        try:
            at, towards, upward = torch.broadcast_tensors(*given)
        except RuntimeError:
            shapes = ", ".join(str(tuple(each.shape)) for each in given)
            raise _checks.fail(name, "eye", "fit 'target' and 'up' in shape", shapes) from None
        forward, upward = _in_range(towards - at), _in_range(upward)
        right = torch.linalg.cross(forward, upward)
        sine = right.norm(dim=-1) / (forward.norm(dim=-1) * upward.norm(dim=-1))
        if _checks.readable(sine) and not bool((sine >= 4 * torch.finfo(at.dtype).eps).all()):
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
        K = _conversions.centred_intrinsics(focal_px, **sizes, like=at)
        return cls(K.expand(*at.shape[:-1], 3, 3), cam_from_world, **sizes)

    @classmethod
    def from_fov(cls, cam_from_world: Tensor, fov_y_deg: float, height: int, width: int) -> PinholeCamera:
        """From the vertical field of view in degrees: square pixels, the principal point in the middle.

        Example:
            >>> PinholeCamera.from_fov(torch.eye(4), 90.0, height=48, width=64).K[0].tolist()
            [24.0, 0.0, 32.0]
        """
        name = "PinholeCamera.from_fov"
        _checks.check_tensor(name, "cam_from_world", cam_from_world, ("*", 4, 4))
        sizes = _sizes(name, height, width)
        focal_px = _conversions.focal_of(name, None, fov_y_deg, sizes["height"])
        K = _conversions.centred_intrinsics(focal_px, **sizes, like=cam_from_world)
        return cls(K.expand(*cam_from_world.shape[:-2], 3, 3), cam_from_world, **sizes)

    @classmethod
    def from_opencv(
        cls, K: Tensor, R: Tensor, t: Tensor, height: int, width: int, *, pixel_centres: str = "integer"
    ) -> PinholeCamera:
        """From X_cam = R X_world + t, with R (..., 3, 3), t (..., 3) and K (..., 3, 3) in pixels, without distortion.

        `pixel_centres` says what K means by the image position (0, 0): "integer", as in OpenCV and Open3D, the centre
        of the upper left pixel; "half", as in COLMAP and here, its corner. The former is moved by half a pixel.

        Example:
            >>> K = torch.tensor([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])  # centred, in OpenCV's pixels
            >>> PinholeCamera.from_opencv(K, torch.eye(3), torch.zeros(3), 48, 64).K[:2, 2].tolist()
            [32.0, 24.0]
        """
        name = "PinholeCamera.from_opencv"
        _checks.check_tensor(name, "K", K, ("*", 3, 3))
        _checks.check_choice(name, "pixel_centres", pixel_centres, ("integer", "half"))
        if pixel_centres == "integer":
            K = K + K.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        return cls(K, _conversions.rigid(name, R, t, ("R", "t")), height, width)

    @classmethod
    def from_opengl(cls, K: Tensor, cam_from_world: Tensor, height: int, width: int) -> PinholeCamera:
        """From an OpenGL or Blender view matrix (x right, y up, z backward). `K` as in OpenCV.

        Example:
            >>> gl = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]])  # eye at z = 2
            >>> PinholeCamera.from_opengl(torch.eye(3), gl, 4, 4).position.tolist()
            [0.0, 0.0, 2.0]
        """
        _checks.check_tensor("PinholeCamera.from_opengl", "cam_from_world", cam_from_world, ("*", 4, 4))
        return cls(K, _conversions.flipped(cam_from_world, _conversions.FLIP_YZ), height, width)

    @classmethod
    def from_pytorch3d(cls, R: Tensor, T: Tensor, K: Tensor, height: int, width: int) -> PinholeCamera:
        """From PyTorch3D's `R` (..., 3, 3), `T` (..., 3): X_view = X_world R + T, x left, y up, z forward.

        `K` is the matrix in pixels as here; `to_pytorch3d` is the inverse. Leading dimensions are broadcast.

        Example:
            >>> R, T, K = torch.eye(3), torch.tensor([0.0, 0.0, 2.0]), torch.eye(3)
            >>> PinholeCamera.from_pytorch3d(R, T, K, 4, 4).position.tolist()
            [0.0, 0.0, -2.0]
        """
        name = "PinholeCamera.from_pytorch3d"
        _checks.check_tensor(name, "R", R, ("*", 3, 3))
        view_from_world = _conversions.rigid(name, R.mT, T, ("R", "T"))
        return cls(K, _conversions.flipped(view_from_world, _conversions.FLIP_XY), height, width)

    def to_opengl(self) -> OpenGLCamera:
        """The view matrix in OpenGL's axes, and K; the inverse of `from_opengl`.

        Example:
            >>> camera = PinholeCamera.look_at((0, 0, 2.0), fov_y_deg=60.0, height=4, width=4)
            >>> camera.to_opengl().cam_from_world[:3, 3].tolist()
            [0.0, 0.0, -2.0]
        """
        return OpenGLCamera(self.K, _conversions.flipped(self.cam_from_world, _conversions.FLIP_YZ))

    def to_pytorch3d(self, *, in_ndc: bool = False) -> PyTorch3DCamera:
        """The arguments of PyTorch3D's `PerspectiveCameras`; all leading dimensions become its one, N.

        Pass them as `PerspectiveCameras(**camera.to_pytorch3d()._asdict(), in_ndc=False)`: focal lengths and principal
        points in pixels (its screen space); or in its normalised device coordinates with `in_ndc=True` in both calls.

        Example:
            >>> camera = PinholeCamera.look_at((0, 0, -2.0), focal_px=100.0, height=40, width=80)
            >>> camera.to_pytorch3d().principal_point.tolist(), camera.to_pytorch3d(in_ndc=True).focal_length.tolist()
            ([[40.0, 20.0]], [[5.0, 5.0]])
        """
        in_ndc = _checks.check_flag("PinholeCamera.to_pytorch3d", "in_ndc", in_ndc)
        whole = self.expand(*self.batch_shape)
        K, cam_from_world = whole.K.reshape(-1, 3, 3), whole.cam_from_world.reshape(-1, 4, 4)
        return _conversions.to_pytorch3d(K, cam_from_world, self.height, self.width, in_ndc)

    @classmethod
    def stack(cls, cameras: Sequence[PinholeCamera], dim: int = 0) -> PinholeCamera:
        """Cameras of one image size and batch shape along a new leading dimension.

        Example:
            >>> one = PinholeCamera.look_at((0, 0, -2.0), focal_px=9.0, height=4, width=4)
            >>> PinholeCamera.stack([one, one, one]).batch_shape
            (3,)
        """
        name = "PinholeCamera.stack"
        cameras = list(cameras)
        if not cameras:
            raise _checks.fail(name, "cameras", "hold at least one camera", "none")
        for i, camera in enumerate(cameras):
            if not isinstance(camera, PinholeCamera):
                raise TypeError(
                    f"{name}: 'cameras[{i}]' must be a PinholeCamera; got {type(camera).__name__}."
                )
            for what, convert in _ALIKE.items():
                own, first = (getattr(c, what) for c in (camera, cameras[0]))
                if own != first:
                    raise _checks.fail(
                        name, f"cameras[{i}]", f"have the {what} of the first, {first}", str(own), convert
                    )
            _checks.check_device(name, f"cameras[{i}]", camera.K, cameras[0].K)
        shape = cameras[0].batch_shape
        if not -len(shape) - 1 <= dim <= len(shape):
            raise _checks.fail(name, "dim", f"lie in [{-len(shape) - 1}, {len(shape)}]", repr(dim))
        dim = dim % (len(shape) + 1)
        whole = [c.expand(*shape) for c in cameras]
        return dataclasses.replace(
            cameras[0],
            K=torch.stack([c.K for c in whole], dim),
            cam_from_world=torch.stack([c.cam_from_world for c in whole], dim),
        )

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
        sizes = _sizes("PinholeCamera.resize", height, width)
        scale = self.K.new_tensor([sizes["width"] / self.width, sizes["height"] / self.height, 1.0])
        return PinholeCamera(self.K * scale[:, None], self.cam_from_world, **sizes)

    def to(self, *args, **kwargs) -> PinholeCamera:
        """As `torch.Tensor.to`, on both matrices."""
        return dataclasses.replace(
            self, K=self.K.to(*args, **kwargs), cam_from_world=self.cam_from_world.to(*args, **kwargs)
        )

    def expand(self, *batch_shape: int | tuple[int, ...]) -> PinholeCamera:
        """The same cameras with leading dimensions broadcast to `batch_shape`, without copying.

        As of `torch.Tensor.expand`, the sizes may be a tuple, and -1 keeps one.
        """
        sizes: Any = batch_shape
        if len(sizes) == 1 and isinstance(sizes[0], tuple):
            sizes = sizes[0]
        return dataclasses.replace(
            self,
            K=self.K.expand(*sizes, 3, 3),
            cam_from_world=self.cam_from_world.expand(*sizes, 4, 4),
        )

    def __getitem__(self, item) -> PinholeCamera:
        """Index the leading dimensions; `camera[:, None]` makes one view for each cloud of N cameras.

        Example:
            >>> cameras = PinholeCamera(torch.eye(3), torch.eye(4).expand(5, 4, 4), 8, 8)
            >>> cameras[2].batch_shape, cameras[1:].batch_shape, cameras[:, None].batch_shape
            ((), (4,), (5, 1))
            >>> cameras[2][None].batch_shape  # one camera as a batch of one
            (1,)
        """
        shape = self.batch_shape
        whole = self.expand(*shape)
        where = item if isinstance(item, tuple) else (item,)
        if not any(each is Ellipsis for each in where):
            where = (*where, ...)
        where = (*where, slice(None), slice(None))  # without these an index could reach into the matrices
        try:
            K, cam_from_world = whole.K[where], whole.cam_from_world[where]
        except IndexError as error:
            if not shape:
                raise IndexError(
                    "PinholeCamera: a single camera has no leading dimension to index."
                ) from None
            raise IndexError(
                f"PinholeCamera: cameras of batch shape {shape} have no such index: {error}"
            ) from None
        return dataclasses.replace(self, K=K, cam_from_world=cam_from_world)

    def __len__(self) -> int:
        """The first leading dimension."""
        if not self.batch_shape:
            raise TypeError("PinholeCamera: a single camera has no length; camera[None] is a batch of one.")
        return self.batch_shape[0]

    def __bool__(self) -> bool:
        """True, also of a single camera, which has no length, and of a batch of none."""
        return True

    def __iter__(self) -> Iterator[PinholeCamera]:
        """The cameras along the first leading dimension."""
        return iter([self[i] for i in range(len(self))])


_ALIKE = {
    "height": "Resize it with .resize(height, width).",
    "width": "Resize it with .resize(height, width).",
    "dtype": "Convert it with .to(dtype).",
    "batch_shape": "Expand it with .expand(...).",
}
"""What stacked cameras must share, and how to achieve it."""


def _collate(batch: Sequence[PinholeCamera], *, collate_fn_map=None) -> PinholeCamera:
    return PinholeCamera.stack(batch)


# So that samples of a data set may hold cameras, and files that torch.load reads with weights_only=True.
default_collate_fn_map[PinholeCamera] = _collate
torch.serialization.add_safe_globals([PinholeCamera])


def _sizes(function: str, height: object, width: object) -> dict[str, int]:
    return {
        name: _checks.check_integer(function, name, size, "be a positive integer", 1)
        for name, size in (("height", height), ("width", width))
    }


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


def _in_range(vectors: Tensor) -> Tensor:
    """Vectors with the same directions, of which the squares of no components overflow or vanish."""
    largest = vectors.detach().abs().amax(-1, keepdim=True)
    usual = (largest == 0) | ((largest > 1e-12) & (largest < 1e12))
    return vectors / torch.where(usual, 1, largest)


def _vector(name: str, value, like: Tensor | None = None) -> Tensor:
    dtype = torch.get_default_dtype()
    dtype = dtype if dtype in _checks.FLOATS else torch.float32
    inside = [each for each in value if isinstance(each, Tensor)] if isinstance(value, (list, tuple)) else []
    if inside:
        dtype = next((each.dtype for each in inside if each.dtype in _checks.FLOATS), dtype)
        # torch.tensor would cut them off from their gradients.
        value = torch.stack([torch.as_tensor(each, dtype=dtype, device=inside[0].device) for each in value])
    if not isinstance(value, Tensor):
        try:
            value = torch.tensor(value, dtype=dtype) if like is None else like.new_tensor(value)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(
                f"PinholeCamera.look_at: '{name}' must be three numbers or a tensor (..., 3); got {value!r}."
            ) from None
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


def check_camera(function: str, name: str, camera: object) -> None:
    if not isinstance(camera, PinholeCamera):
        raise TypeError(f"{function}: '{name}' must be a PinholeCamera; got {type(camera).__name__}.")


def check_views(
    function: str, name: str, camera: PinholeCamera, like: Tensor, *, views: int | None = None
) -> Views:
    """The camera as (B, V) views, B being the first dimension of `like`; batch shapes () and (V,) are shared by all B.

    `views`: the number of depth maps per item; the camera must have as many views, or one.
    """
    check_camera(function, name, camera)
    if camera.dtype != like.dtype:
        raise TypeError(
            f"{function}: '{name}' must have the dtype of the points ({like.dtype}); got {camera.dtype}. "
            f"Convert it with {name}.to({like.dtype})."
        )
    _checks.check_device(function, name, camera.K, like)
    batch, shape = like.shape[0], camera.batch_shape
    if len(shape) > 2 or (len(shape) == 2 and shape[0] != 1 and shape[0] != batch):
        raise _checks.fail(
            function,
            name,
            f"have batch shape (), (V,), (1, V) or ({batch}, V)",
            str(tuple(shape)),
            "One row of cameras per cloud.",
        )
    own = shape[-1] if shape else 1
    if views is not None and own != 1 and own != views:
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
