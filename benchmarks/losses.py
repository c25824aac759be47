"""Races of `front_constraint` and `projection_loss`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Contender, Race
from benchmarks.inputs import depth_maps, gradient, leaf, surfaces


def races() -> Iterator[Race]:
    for backward in (False, True):
        yield _front(80, 2048, 56, "chamfer", backward=backward)
        yield _front(80, 2048, 56, "emd", backward=backward)
        yield _projection(80, 2048, 56, backward=backward)


def _race(
    op: str, size: str, points: Tensor, ours: Callable, peers: dict[str, Callable], *, backward: bool
) -> Race:
    """Of losses (B) of clouds (B, N, 3), or of their gradients."""

    def prepared(loss: Callable) -> Callable[[], Tensor]:
        def descend() -> Tensor:
            x = leaf(points)
            loss(x).sum().backward()
            return gradient(x)

        return descend if backward else lambda: loss(points)

    return Race(
        op,
        size,
        Contender("diffpoint", prepared(ours), lambda r: r),
        [Contender(name, prepared(loss), lambda r: r) for name, loss in peers.items()],
        direction="forward + backward" if backward else "forward",
        units=len(points),
        tolerance=0.02,  # a point on the border of a pixel is seen by one of the two
        share=0.05,
    )


def _front(count: int, n: int, size: int, distance, *, backward: bool) -> Race:
    points = surfaces(count, n)
    depth, camera = depth_maps(count, size)

    def ours(x: Tensor) -> Tensor:
        return dp.front_constraint(x, camera, depth, distance=distance, reduction="none")[:, 0]

    def in_torch(x: Tensor) -> Tensor:
        with torch.no_grad():
            visible = torch_peers.splat(x, camera.projection[:, 0], size)[2]
            observed, observed_lengths = torch_peers.unproject(depth[:, 0], camera)
        seen, seen_lengths = torch_peers.sample(x, visible)
        observed = observed[:, : int(observed_lengths.max())]
        return torch_peers.chamfer_of_parts(seen, seen_lengths, observed, observed_lengths)

    peers = {"torch": in_torch} if distance == "chamfer" else {}
    return _race(
        f"front_constraint, {distance}", f"{count} x {n}, {size} x {size}", points, ours, peers,
        backward=backward,
    )  # fmt: skip


def _projection(count: int, n: int, size: int, *, backward: bool) -> Race:
    points = surfaces(count, n)
    depth, camera = depth_maps(count, size)

    def ours(x: Tensor) -> Tensor:
        return dp.projection_loss(x, camera, depth, reduction="none")[:, 0]

    def in_torch(x: Tensor) -> Tensor:
        rendered = torch_peers.splat(x, camera.projection[:, 0], size)[0]
        both = torch.isfinite(rendered) & torch.isfinite(depth[:, 0])
        difference = torch.where(both, rendered, 0.0) - torch.where(both, depth[:, 0], 0.0)
        return difference.abs().sum((1, 2)) / both.sum((1, 2)).clamp(min=1)

    size_text = f"{count} x {n}, {size} x {size}"
    return _race("projection_loss", size_text, points, ours, {"torch": in_torch}, backward=backward)
