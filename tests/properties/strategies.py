"""Inputs of the property tests: degenerate clouds, layouts, lengths and cameras, drawn by hypothesis.

Hypothesis draws a small recipe (so that a failure prints as one line and shrinks); the tensors are made from it with
a seeded generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from hypothesis import strategies as st
from torch import Tensor

import diffpoint as dp

FAMILIES = (
    "uniform", "duplicates", "collapsed", "one point", "collinear", "coplanar", "lattice", "magnitudes", "huge", "tiny",
    "far",
)  # fmt: skip
LAYOUTS = ("plain", "batch last", "axes first", "every second", "expanded")


class Cloud(NamedTuple):
    """A batch of clouds as passed to an op."""

    points: Tensor
    lengths: Tensor | None
    poisoned: bool
    """A point outside the padding is not finite."""

    @property
    def clean(self) -> Tensor:
        """For the reference: contiguous, and zeros in the padding."""
        points = self.points.detach().clone()
        if self.lengths is not None:
            padding = torch.arange(points.shape[-2]) >= self.lengths[..., None]
            points = points.masked_fill(padding[..., None], 0)
        return points

    @property
    def counts(self) -> Tensor:
        """(*B) how many points count."""
        if self.lengths is not None:
            return self.lengths
        return torch.full(self.points.shape[:-2], self.points.shape[-2])


@dataclass(frozen=True)
class Recipe:
    """How to make a batch of clouds."""

    family: str
    batch: tuple[int, ...]
    count: int
    dtype: torch.dtype
    layout: str
    lengths: bool
    poison: float | None
    in_padding: bool
    """Put the invalid value into the padding, if there is any."""
    seed: int

    def make(self) -> Cloud:
        random = torch.Generator().manual_seed(self.seed)
        batch = math.prod(self.batch)
        points = _family(self.family, batch, self.count, random).to(self.dtype)
        lengths = torch.randint(0, self.count + 1, (batch,), generator=random) if self.lengths else None
        if self.layout == "expanded":
            points = points[:1].expand(batch, -1, -1).clone()
            lengths = None if lengths is None else lengths[:1].expand(batch).clone()
        poisoned = False
        if self.poison is not None and batch and self.count:
            first_padding = self.count if lengths is None else int(lengths[0])
            at = first_padding if self.in_padding else min(first_padding, self.count) - 1
            if 0 <= at < self.count:
                points[: batch if self.layout == "expanded" else 1, at, self.seed % 3] = self.poison
                poisoned = at < first_padding
        points = _layout(self.layout, points.reshape(*self.batch, self.count, 3), self.batch)
        return Cloud(
            points.requires_grad_(), None if lengths is None else lengths.reshape(self.batch), poisoned
        )


def _family(family: str, batch: int, count: int, random: torch.Generator) -> Tensor:
    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=random) - 0.5

    unit = uniform(batch, count, 3)
    if family == "duplicates":
        few = uniform(batch, 3, 3)
        chosen = torch.randint(0, 3, (batch, count), generator=random)
        return torch.take_along_dim(few, chosen[..., None], 1)
    return {
        "uniform": unit,
        "collapsed": uniform(batch, 1, 3) + 1e-6 * unit,
        "one point": uniform(batch, 1, 3).expand(batch, count, 3).clone(),
        "collinear": uniform(batch, 1, 3) * uniform(batch, count, 1),
        "coplanar": unit[..., :2] @ uniform(batch, 2, 3),
        "lattice": (8 * unit).round() / 4,
        "magnitudes": unit.sign() * 10 ** (12 * uniform(batch, count, 3)),
        "huge": 2e6 * unit,
        "tiny": 2e-6 * unit,
        "far": 1e4 + unit,
    }[family]


def _layout(layout: str, points: Tensor, batch: tuple[int, ...]) -> Tensor:
    """The same values in another arrangement of memory."""
    if layout == "batch last":
        return points.movedim(-2, 0).contiguous().movedim(0, -2)
    if layout == "axes first":
        return points.movedim(-1, 0).contiguous().movedim(0, -1)
    if layout == "every second":
        return points.repeat_interleave(2, dim=-2)[..., ::2, :]
    if layout == "expanded" and batch and points.numel():
        return points.flatten(0, -3)[0].clone().expand(points.shape)
    return points


def counts(largest: int) -> st.SearchStrategy[int]:
    """Sizes: any, and with preference those at the edges of vector lanes, tiles and chunks."""
    edges = [n for n in (0, 1, 2, 15, 16, 17, 31, 32, 33, 64, 65) if n <= largest]
    return st.one_of(st.sampled_from(edges), st.integers(0, largest))


sizes = st.sampled_from([1, 2, 3, 0])  # of batches
poisons = st.sampled_from([*[None] * 5, math.nan, math.nan, math.inf, -math.inf])
dtypes = st.sampled_from([torch.float32, torch.float64])
seeds = st.integers(0, 2**31)


@st.composite
def recipes(
    draw: st.DrawFn,
    largest: int,
    *,
    family: str | None = None,
    batch: tuple[int, ...] | None = None,
    dtype: torch.dtype | None = None,
    lengths: bool = True,
) -> Recipe:
    return Recipe(
        family=draw(st.sampled_from(FAMILIES)) if family is None else family,
        batch=draw(st.sampled_from([(), (1,), (3,), (2, 2), (0,)])) if batch is None else batch,
        count=draw(counts(largest)),
        dtype=draw(dtypes) if dtype is None else dtype,
        layout=draw(st.sampled_from(LAYOUTS)),
        lengths=lengths and draw(st.booleans()),
        poison=draw(poisons),
        in_padding=draw(st.booleans()),
        seed=draw(seeds),
    )


@st.composite
def pairs(draw: st.DrawFn, largest: int, family: str) -> tuple[Recipe, Recipe]:
    """Two batches of clouds that fit each other; half of the time of one family."""
    first = draw(recipes(largest, family=family))
    other = draw(st.sampled_from([family, None]))
    return first, draw(recipes(largest, family=other, batch=first.batch, dtype=first.dtype))


@dataclass(frozen=True)
class CameraRecipe:
    """Cameras of batch shape (), (V,) or (B, V)."""

    batch_shape: tuple[int, ...]
    height: int
    width: int
    on_axis: bool
    """At the origin of the world, looking along z, with a focal length that puts lattice points on pixel borders."""
    seed: int

    def make(self, dtype: torch.dtype) -> dp.PinholeCamera:
        random = torch.Generator().manual_seed(self.seed)
        if self.on_axis:
            K = torch.tensor([[4.0, 0, self.width // 2], [0, 4, self.height // 2], [0, 0, 1]], dtype=dtype)
            eye = torch.eye(4, dtype=dtype)
            return dp.PinholeCamera(K, eye, self.height, self.width).expand(*self.batch_shape)
        eyes = torch.randn(*self.batch_shape, 3, generator=random, dtype=torch.float64).to(dtype)
        eyes = 1.5 * eyes / eyes.norm(dim=-1, keepdim=True)
        focal = 2.0 * self.width
        return dp.PinholeCamera.look_at(eyes, focal_px=focal, height=self.height, width=self.width)


@st.composite
def cameras(draw: st.DrawFn, batch: int, views: int | None = None) -> CameraRecipe:
    views = draw(sizes) if views is None else views
    shapes = [(views,), (batch, views), (1, views)] + ([()] if views == 1 else [])
    return CameraRecipe(
        batch_shape=draw(st.sampled_from(shapes)),
        height=draw(st.integers(1, 9)),
        width=draw(st.integers(1, 9)),
        on_axis=draw(st.booleans()),
        seed=draw(seeds),
    )


@dataclass(frozen=True)
class DepthRecipe:
    """Depth maps (B, V, H, W): holes, magnitudes, and perhaps an invalid pixel."""

    full: float
    """Share of the pixels that are foreground."""
    magnitudes: bool
    poison: float | None
    seed: int

    def make(self, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, bool]:
        """The maps, and whether a pixel is invalid."""
        random = torch.Generator().manual_seed(self.seed)
        share = torch.rand(shape, generator=random, dtype=torch.float64)
        depth = 10 ** (12 * share - 6) if self.magnitudes else 1 + share
        foreground = torch.rand(shape, generator=random) < self.full
        depth = torch.where(foreground, depth, torch.inf).to(dtype)
        poisoned = self.poison is not None and depth.numel() > 0
        if poisoned:
            depth.view(-1)[self.seed % depth.numel()] = self.poison
        return depth.requires_grad_(), poisoned


depths = st.builds(
    DepthRecipe,
    full=st.sampled_from([0.0, 0.5, 0.9, 1.0]),
    magnitudes=st.booleans(),
    poison=st.sampled_from([None, None, None, math.nan, -math.inf, 0.0, -1.0]),
    seed=seeds,
)
