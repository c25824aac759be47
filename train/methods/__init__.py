"""Methods: what `fit --system` chooses between. A new one is a file in this folder and a line in `METHODS`.

Listing the names imports no method, so that the command line starts fast.
"""

from __future__ import annotations

import functools
import importlib
from typing import TYPE_CHECKING, NamedTuple

from train.errors import UserError

if TYPE_CHECKING:
    from train.config import FitConfig, Recipe
    from train.methods.base import Method


class Entry(NamedTuple):
    """Where a method is, and a line about it for `--help`."""

    location: str
    """Module in this folder, and class."""
    summary: str


METHODS = {
    "ours": Entry("ours:Ours", "the paper's conditional generator"),
    "psgn": Entry("psgn:PSGN", "Fan et al. 2017: a deterministic network trained on whole clouds"),
    "psgn-mon": Entry("psgn:BestOfNClouds", "the same with codes: the best of n predictions is trained"),
    "front-mon": Entry("psgn:BestOfNFronts", "best of n predictions by the front constraint"),
    "lin": Entry("lin:Lin", "Lin et al. 2018: depth maps of eight fixed cameras, fused to a cloud"),
    "r2n2": Entry("r2n2:R2N2", "Choy et al. 2016 (3D-R2N2): a recurrent network that predicts voxels"),
    "ptn": Entry("ptn:PTN", "Yan et al. 2016 (PTN): voxels trained on silhouettes"),
}
"""Name -> entry. A lone weights file of a network that several methods share counts as the first one's."""


@functools.cache
def get_method(name: str) -> Method:
    """The method of a name.

    Raises:
        UserError: there is none of that name.
    """
    if name not in METHODS:
        raise UserError(f"--system must be one of {', '.join(METHODS)}; got {name!r}")
    module, kind = METHODS[name].location.split(":")
    return getattr(importlib.import_module(f"train.methods.{module}"), kind)(name)


def recipe(name: str, profile: str, recipe: Recipe = "paper") -> FitConfig:
    """How a method is trained at a profile ("full", "cpu", "smoke")."""
    method = get_method(name)
    return method.with_recipe(method.recipe(profile), recipe)
