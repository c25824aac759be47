"""Images and depth maps of one shape, compressed view by view: a batch decompresses the views that it draws."""

from __future__ import annotations

import dataclasses
import math
import zlib

import numpy as np
import torch
from torch import Tensor

from diffpoint.camera import PinholeCamera
from train.data.shape import Shape
from train.errors import UserError


@dataclasses.dataclass(frozen=True, eq=False)
class PackedViews:
    """V arrays of the same shape and dtype; indexed along the first dimension as the (V, ...) tensor is, bit for bit.

    Each view is a zlib stream of its own, with zlib's checksum.

    Attributes:
        data: (N,) uint8, the streams one after the other.
        ends: (V,) int64, where in `data` each stream ends.
        view_shape: of one view.
        dtype: of the views.
        origin: the file or shape that an error message names.

    Example:
        >>> packed = PackedViews.pack(torch.tensor([[1.0, torch.inf], [2.0, 3.0]]), "chair/1")
        >>> packed[1], packed[torch.tensor([0])], packed.shape
        (tensor([2., 3.]), tensor([[1., inf]]), (2, 2))
    """

    data: Tensor
    ends: Tensor
    view_shape: tuple[int, ...]
    dtype: torch.dtype
    origin: str

    @classmethod
    def pack(cls, views: Tensor, origin: str) -> PackedViews:
        """Compresses a tensor (V, ...) on the CPU."""
        streams = [zlib.compress(view.tobytes()) for view in views.numpy()]
        data = np.frombuffer(bytearray().join(streams), np.uint8)
        ends = np.cumsum([len(stream) for stream in streams], dtype=np.int64)
        return cls(
            torch.from_numpy(data), torch.from_numpy(ends), tuple(views.shape[1:]), views.dtype, origin
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the tensor: (V, ...)."""
        return len(self), *self.view_shape

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, index: int | slice | Tensor) -> Tensor:
        """The tensor at `index`, decompressed.

        Raises:
            UserError: a stream is damaged.
        """
        numbers = torch.arange(len(self))[index]
        size = math.prod(self.view_shape) * self.dtype.itemsize
        content = bytearray().join(self._view(view, size) for view in numbers.flatten().tolist())
        values = torch.from_numpy(np.frombuffer(content, np.uint8)).view(self.dtype)
        return values.reshape((*numbers.shape, *self.view_shape))

    def _view(self, view: int, size: int) -> bytes:
        start = int(self.ends[view - 1]) if view else 0
        try:
            content = zlib.decompress(self.data[start : int(self.ends[view])].numpy().data, bufsize=size)
        except zlib.error as error:
            content, reason = b"", str(error)
        else:
            reason = f"{len(content)} bytes instead of {size}"
        if len(content) != size:
            raise UserError(
                f"{self.origin}: view {view} cannot be decompressed ({reason}): the file was damaged after it had "
                "been written. Delete it and run the command again (fit: with --resume); it is made again. "
                "`python -m train data check` finds other damaged files"
            )
        return content


@dataclasses.dataclass(frozen=True, eq=False)
class PackedShape:
    """A `Shape` at the sizes of training, whose views are compressed.

    Attributes:
        images: of (V, 3, h, w) uint8 at the network's input size.
        depth: of (V, S, S) float32, as in `Shape`.
        camera: PinholeCamera (V,), of the depth maps.
        points: (P, 3) float32 on the surface, world frame.
        id: "synset/model".
        category: for instance "chair".
    """

    images: PackedViews
    depth: PackedViews
    camera: PinholeCamera
    points: Tensor
    id: str
    category: str

    @classmethod
    def pack(cls, small: Shape) -> PackedShape:
        """Compresses the views of a shape that `shrink` has returned."""
        images, depth = (PackedViews.pack(views, small.id) for views in (small.images, small.depth))
        return cls(images, depth, small.camera, small.points, small.id, small.category)
