"""The experiments: a new one is a file with an `Experiment`, and a line here. Nothing is imported before it is used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from train.experiments.frame import Experiment

EXPERIMENTS = {
    "diversity": "diversity of ten predictions for one image, by training loss (the paper's table 1)",
    "single-category": "five methods on the shapes of one --category, eight views",
    "multi-category": "one network for all categories: ours, PSGN and 3D-R2N2, by category",
    "deterministic": "our method with and without latent codes",
    "one-image": "our method with and without latent codes, from one image",
    "ablation": "effect of stage 1, stage 2, its diversity loss, search and descent",
    "consistency": "search and descent on the highly diverse model",
    "correlation": "correlation of consistency loss and error, over shapes and over groups of codes",
    "views": "error for 1 to 8 images",
    "runtime": "time of view-based sampling, and share of hidden points it selects",
    "predictions": "do predictions with different codes differ more behind than in front?",
    "reconstructions": "figure: reconstructions from eight views, three methods",
    "one-armed": "does the deterministic network invent the hidden arm rest of a chair, and does ours avoid it with "
    "two views?",
    "coverage": "do predictions reach all backs that a front can have, and are any unlike all of them?",
    "critic": "training with and without the latent critic",
    "agreement": "search and descent in detail: step sizes, steps, groups, regularisation",
    "collapse": "which design choices prevent predictions that ignore the image",
    "front-vs-projection": "front constraint against projection losses, on free point clouds and in networks",
    "photos": "figure: reconstructions of your own photographs (--pictures)",
}
"""Name -> description, in the order in which `all` makes them."""

_MODULES = {
    **dict.fromkeys(("diversity", "single-category", "multi-category", "deterministic"), "paper"),
    **dict.fromkeys(("one-image", "ablation", "consistency", "views"), "paper"),
    "front-vs-projection": "front_vs_projection.experiment",
}
"""Where an experiment is that has no module of its own name."""

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
    attribute = name.replace("-", "_")
    module = importlib.import_module(f"train.experiments.{_MODULES.get(name, attribute)}")
    return getattr(module, attribute)
