"""Point clouds and 16-bit depth maps on disk, through trimesh and imageio (extra `[io]`). Not imported by default."""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from diffpoint import _checks

_EMPTY = 65535  # the code of empty pixels
_WRITABLE = (".ply", ".xyz", ".obj", ".glb")
"""Suffixes of the formats of trimesh that hold points without faces; of others it writes empty files, or fails."""


def encode_depth(depth: Tensor, *, max_depth: float = 10.0) -> np.ndarray:
    """Depth in [0, max_depth), +inf where empty, as uint16: round(depth / max_depth * 65535); 65535 is empty.

    Example:
        >>> encode_depth(torch.tensor([2.0, float("inf")])).tolist()
        [13107, 65535]
    """
    _checks.check_tensor("encode_depth", "depth", depth, ("*",))
    max_depth = _check_max_depth("encode_depth", max_depth)
    code = (depth.detach().double() * (_EMPTY / max_depth)).round().clamp(0, _EMPTY - 1)
    return torch.where(torch.isfinite(depth), code, _EMPTY).cpu().numpy().astype(np.uint16)


def decode_depth(code: np.ndarray, *, max_depth: float = 10.0) -> Tensor:
    """The float32 depth of `encode_depth`'s codes, +inf where empty; exact to max_depth / 131070.

    Example:
        >>> decode_depth(np.array([13107, 65535], np.uint16)).tolist()
        [2.0, inf]
    """
    if not isinstance(code, np.ndarray):
        raise TypeError(f"decode_depth: 'code' must be a numpy.ndarray; got {type(code).__name__}.")
    max_depth = _check_max_depth("decode_depth", max_depth)
    depth = code.astype(np.float64) * (max_depth / _EMPTY)
    return torch.from_numpy(np.where(code == _EMPTY, np.inf, depth).astype(np.float32))


def write_depth(path: str | os.PathLike[str], depth: Tensor, *, max_depth: float = 10.0) -> None:
    """Write a depth map (H, W) as a 16-bit PNG: z = value / 65535 * max_depth, 65535 where empty.

    Raises:
        ValueError: not one map, or depths that the code cannot hold.
        ImportError: imageio is not installed.

    Source: the released data of the CVPR 2019 paper (max_depth 10).
    """
    _checks.check_tensor("write_depth", "depth", depth, ("H", "W"))
    max_depth = _check_max_depth("write_depth", max_depth)
    encodable = ((depth >= 0) & (depth < max_depth)) | torch.isposinf(depth)
    if not bool(encodable.all()):
        where = tuple((~encodable).nonzero()[0].tolist())
        got = f"{float(depth[where])} at index {where}"
        raise _checks.fail("write_depth", "depth", f"lie in [0, {max_depth}), or be +inf where empty", got)
    _replace(Path(path), lambda file: _imageio().imwrite(file, encode_depth(depth, max_depth=max_depth)))


def read_depth(path: str | os.PathLike[str], *, max_depth: float = 10.0) -> Tensor:
    """Read a depth map (H, W) float32, +inf where empty, as `write_depth` wrote it.

    Raises:
        ValueError: the file is not a 16-bit image with one channel.
        OSError: it is missing or cannot be read.
    """
    code = _imageio().imread(path)
    if code.dtype not in (np.uint16, np.int32) or code.ndim != 2:  # some decoders widen the 16 bits
        got = f"{code.dtype} {code.shape}"
        raise _checks.fail("read_depth", "path", "name a 16-bit image with one channel", f"{path}: {got}")
    return decode_depth(code, max_depth=max_depth)


def _check_max_depth(function: str, max_depth: float) -> float:
    return _checks.check_number(
        function, "max_depth", max_depth, "be positive and finite", lambda x: 0 < x < math.inf
    )


def write_points(path: str | os.PathLike[str], points: Tensor) -> None:
    """Write a cloud (N, 3) as .ply, .xyz, .obj or .glb; the file appears whole or not at all.

    Raises:
        ValueError: not one cloud, no points, coordinates that are not finite, or another suffix.
        ImportError: trimesh is not installed.
    """
    _checks.check_tensor("write_points", "points", points, ("N", 3))
    _checks.check_filled("write_points", "points", points)
    path = Path(path)
    suffix = path.suffix.lower() or ".ply"
    if suffix not in _WRITABLE:
        raise _checks.fail("write_points", "path", f"end in one of {', '.join(_WRITABLE)}", repr(path.suffix))
    cloud = _trimesh().PointCloud(points.detach().to("cpu", torch.float32).numpy())
    content = cloud.export(file_type=suffix[1:])
    _replace(
        path, lambda file: file.write_bytes(content if isinstance(content, bytes) else str(content).encode())
    )


def read_points(path: str | os.PathLike[str]) -> Tensor:
    """Read the vertices (N, 3) float32 of a point cloud or mesh file, in the file's frame and unit.

    Raises:
        ValueError: the file holds no finite points, or is in a format that trimesh cannot read.
        OSError: it is missing.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"read_points: {path} does not exist.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of texture coordinates, where a vertex has none
            # Of an OBJ file trimesh would leave out some vertices and double others, in an order of its own.
            loaded = _trimesh().load(path, process=False, maintain_order=True)
        vertices = loaded.to_geometry().vertices if hasattr(loaded, "to_geometry") else loaded.vertices
    except Exception as error:  # every format has its own exceptions; all mean that the file is not a cloud
        raise _checks.fail("read_points", "path", "name a point cloud", f"{path}: {error}") from None
    points = torch.from_numpy(np.array(vertices, np.float32).reshape(-1, 3))
    if len(points) == 0 or not bool(torch.isfinite(points).all()):
        raise _checks.fail("read_points", "path", "hold finite points", f"{path}: {len(points)} points")
    return points


def _replace(path: Path, write) -> None:
    """Write a temporary file and rename it, so that a half-written file is never read."""
    scratch = path.with_name(f".{os.getpid()}-{path.name}")  # writers choose the format by the suffix
    try:
        write(scratch)
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def _trimesh() -> ModuleType:
    try:
        import trimesh
    except ImportError:
        raise ImportError("diffpoint.io: point files need trimesh: pip install 'diffpoint[io]'.") from None
    return trimesh


def _imageio() -> ModuleType:
    try:
        import imageio.v3
    except ImportError:
        raise ImportError("diffpoint.io: depth maps need imageio: pip install 'diffpoint[io]'.") from None
    return imageio.v3
