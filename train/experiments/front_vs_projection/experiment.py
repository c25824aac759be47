"""Front constraint against projection losses: free clouds fitted to depth maps by every loss, from one view to
twenty-four; and networks trained with each of them.

OUT/front-vs-projection.json, .md, .png     all numbers, tables, curves of the free clouds
OUT/front-vs-projection-clouds.png, .gif    the clouds of one shape during the fit
OUT/front-vs-projection-networks.png        validation curves of the networks
OUT/front-vs-projection-predictions.png     predictions of the networks
"""

from __future__ import annotations

import sys

from train.experiments.frame import Experiment, Outcome
from train.experiments.front_vs_projection import free_clouds, networks
from train.experiments.study import Study


def make(study: Study) -> Outcome:
    """Free clouds on all of the study's data, and networks on its data trees, if there are any.

    `study.limit` is the number of shapes of each kind (procedural, meshes, each tree), `study.steps` that of
    iterations and of training steps.
    """
    found, drawn = free_clouds.free_clouds(study)
    page = free_clouds.markdown(found)
    trees = study.on_trees()
    if not trees.data:
        print("no data tree among --data: the networks are left out", file=sys.stderr)
        return Outcome(found, page, drawn)
    found["networks"] = networks.summarise(trees)
    drawn["-networks"] = networks.curves(found["networks"])
    drawn["-predictions"] = networks.predictions(trees)
    return Outcome(found, f"{page}\n{networks.markdown(found['networks'])}", drawn)


front_vs_projection = Experiment(make, networks.configs)
