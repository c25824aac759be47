"""Races of `front_constraint` and `projection_loss`."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import torch_peers
from benchmarks.harness import Race, Way, both_directions
from benchmarks.inputs import depth_maps, surfaces


def races() -> Iterator[Race]:
    count, n, size = 80, 2048, 56
    points = surfaces(count, n)
    depth, camera = depth_maps(count, size)
    projection = camera.projection[:, 0]

    def front_in_torch(x: Tensor) -> Tensor:
        with torch.no_grad():
            visible = torch_peers.splat(x, projection, size)[2]
            observed, observed_lengths = torch_peers.unproject(depth[:, 0], camera)
        seen, seen_lengths = torch_peers.sample(x, visible)
        observed = observed[:, : int(observed_lengths.max())]
        return torch_peers.chamfer_of_parts(seen, seen_lengths, observed, observed_lengths)

    def projection_in_torch(x: Tensor) -> Tensor:
        rendered = torch_peers.splat(x, projection, size)[0]
        both = torch.isfinite(rendered) & torch.isfinite(depth[:, 0])
        difference = torch.where(both, rendered, 0.0) - torch.where(both, depth[:, 0], 0.0)
        return difference.abs().sum((1, 2)) / both.sum((1, 2)).clamp(min=1)

    def way(name: str, loss: Callable[[Tensor], Tensor]) -> Way:
        """Of a loss (B) or (B, 1) of clouds (B, N, 3)."""
        return Way(name, loss, torch.flatten, torch.sum)

    def front(distance) -> Callable[[Tensor], Tensor]:
        return lambda x: dp.front_constraint(x, camera, depth, distance=distance, reduction="none")

    for op, ours, peers in (
        ("front_constraint, chamfer", front("chamfer"), [way("torch", front_in_torch)]),
        ("front_constraint, emd", front("emd"), []),
        (
            "projection_loss",
            lambda x: dp.projection_loss(x, camera, depth, reduction="none"),
            [way("torch", projection_in_torch)],
        ),
    ):
        yield from both_directions(
            op,
            f"{count} x {n}, {size} x {size}",
            (points,),
            way("diffpoint", ours),
            peers,
            units=count,
            tolerance=0.02,  # a point on the border of a pixel is seen by one of the two
            share=0.05,
        )
