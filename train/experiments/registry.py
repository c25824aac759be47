"""What `train experiment` can be asked: names and a line for each, without importing anything that measures."""

from __future__ import annotations

QUESTIONS = {
    "diversity": "how different are ten answers to one image, by training loss? (the paper's table 1)",
    "single-category": "our system and four others on shapes of one --category, from eight views",
    "multi-category": "one network for all categories: ours, PSGN and 3D-R2N2, category by category",
    "deterministic": "our system beside its counterpart without codes",
    "ablation": "what stage 1, stage 2, diversity in it, search and descent add",
    "consistency": "search and descent on the highly diverse model",
    "correlation": "does disagreement tell the error, over shapes and over groups of codes?",
    "views": "the error from 1 to 8 images",
    "runtime": "time of view sampling, and how much of what it selects is hidden",
    "predictions": "several codes for one image: do they differ where the image does not tell?",
    "reconstructions": "pictures: reconstructions from eight views beside other methods",
    "one-armed": "does a network without codes invent the hidden arm of a chair, and ours with two views not?",
    "coverage": "do the codes reach all backs that a front can have, and is anything drawn that is none of them?",
    "critic": "with the latent critic and without",
    "agreement": "search and descent in detail: step sizes, steps, groups and restraints",
    "health": "which choices keep a network listening to its image",
    "front-vs-projection": "free clouds and networks, moved by the front constraint and by projection losses",
    "photos": "pictures: what our system makes of your own photographs (--pictures)",
}
"""Name of an experiment -> its question, in the order in which `all` takes them."""

ABOUT_ALL = {
    "list": "what there is, what of it is done, and how long the rest will take",
    "all": "everything that is not done yet, one after the other",
    "page": "puts what --out holds, and the folders in it, on one page beside it: OUT.md",
}
"""What is asked of all experiments together."""
