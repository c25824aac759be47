"""The experiments: a new one is a file with an `Experiment`, and a line here. Nothing is imported before it is used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from train.experiments.frame import Experiment


class Entry(NamedTuple):
    """A description in a line, and where the experiment is: "module:name", relative to train.experiments."""

    description: str
    where: str


EXPERIMENTS = {
    "diversity": Entry(
        "diversity of ten predictions for one image, by training loss (the paper's table 1)",
        "paper:diversity",
    ),
    "single-category": Entry(
        "five methods on the shapes of one --category, eight views", "paper:single_category"
    ),
    "multi-category": Entry(
        "one network for all categories: ours, PSGN and 3D-R2N2, by category", "paper:multi_category"
    ),
    "deterministic": Entry("our method with and without latent codes", "paper:deterministic"),
    "ablation": Entry("effect of stage 1, stage 2, its diversity loss, search and descent", "paper:ablation"),
    "consistency": Entry("search and descent on the highly diverse model", "paper:consistency"),
    "correlation": Entry(
        "correlation of consistency loss and error, over shapes and over groups of codes",
        "correlation:correlation",
    ),
    "views": Entry("error for 1 to 8 images", "paper:views"),
    "runtime": Entry("time of view-based sampling, and share of hidden points it selects", "runtime:runtime"),
    "predictions": Entry(
        "do predictions with different codes differ more behind than in front?", "predictions:predictions"
    ),
    "reconstructions": Entry(
        "figure: reconstructions from eight views, three methods", "reconstructions:reconstructions"
    ),
    "one-armed": Entry(
        "does the deterministic network invent the hidden arm rest of a chair, and does ours avoid it with two views?",
        "one_armed.measure:one_armed",
    ),
    "coverage": Entry(
        "do predictions reach all backs that a front can have, and are any unlike all of them?",
        "coverage:coverage",
    ),
    "critic": Entry("training with and without the latent critic", "critic:critic"),
    "agreement": Entry(
        "search and descent in detail: step sizes, steps, groups, regularisation", "agreement:agreement"
    ),
    "collapse": Entry("which design choices prevent predictions that ignore the image", "collapse:collapse"),
    "front-vs-projection": Entry(
        "front constraint against projection losses, on free point clouds and in networks",
        "front_vs_projection.experiment:front_vs_projection",
    ),
    "photos": Entry("figure: reconstructions of your own photographs (--pictures)", "photos:photos"),
}
"""Name -> entry, in the order in which `all` makes them."""

FORMER_NAMES = {"health": "collapse"}
"""Names that an experiment had before -> its name; the command line accepts both."""

ABOUT_ALL = {
    "list": "status of every experiment, and how long the missing trainings will take",
    "all": "makes every experiment that is not done yet",
    "page": "puts the results in --out, and in the folders in it, on one page beside it: OUT.md",
}
"""Commands on all experiments together."""


def load(name: str) -> Experiment:
    """Imports an experiment."""
    module, attribute = EXPERIMENTS[name].where.split(":")
    return getattr(importlib.import_module(f"train.experiments.{module}"), attribute)
