"""Several predictions for one image: do they differ more behind, where the image shows nothing, than in front?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, nearest, visible_points
from models import Predictor
from train.config import FitConfig
from train.data import ShapeTree
from train.data.batches import LoadedSplit
from train.evaluation.examples import make_example, pick_shapes
from train.evaluation.per_shape import concatenate, sample_predictions
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.statistics import claim, spreads, stacked, trainings
from train.experiments.store import Metrics
from train.experiments.study import Study, unchanged
from train.show import figures
from train.show.tables import markdown_lines

CODES = 6
SHOWN_CODES, SHOWN_SHAPES = 5, 6
LEAST_RATIO = 1.5
"""Claimed: the back varies by more than this times the variation of the front."""


def make(study: Study) -> Outcome:
    """The metrics of `variation` over all shapes and by category; each shape shows one view, which the seed draws."""
    configs = study.configs(unchanged)
    study.train_all(configs)
    test = study.split(configs[0], "test")
    per_shape = stacked([_measured(study, config) for config in configs])
    categories = np.array(test.categories)
    words = f"the back varies more than {LEAST_RATIO} times as much as the front"
    result = study.about(configs[0]) | {
        "shapes": len(test),
        "codes": CODES,
        "all": _summary(per_shape, slice(None)),
        "categories": {
            name: _summary(per_shape, categories == name) for name in dict.fromkeys(test.categories)
        },
        "claims": [claim(words, per_shape["back"] - LEAST_RATIO * per_shape["front"])],
    }
    return Outcome(result, markdown(result), {"": _figure(study)})


predictions = Experiment(make, lambda study: study.configs(unchanged))


def _measured(study: Study, config: FitConfig) -> Metrics:
    def measure(model: Predictor, test: LoadedSplit) -> Metrics:
        found = sample_predictions(model, test, codes=CODES, seed=config.seed)
        return concatenate([variation(clouds, shown.camera) for _, shown, clouds in found])

    return study.measure(config, ["variation", CODES], measure)


def variation(clouds: Tensor, camera: PinholeCamera) -> dict[str, Tensor]:
    """How far several predictions for one image are apart, in front and behind.

    Point n of every prediction comes from the same output of the network, so that points correspond. A point is in
    front if the image's camera sees it in the mean cloud (`visible_points`, "horizon", which hides the back also where
    the points in front are sparse), else behind.

    Args:
        clouds: (R, B, N, 3) R predictions for each of B images, world frame.
        camera: (B, 1) the images' cameras.

    Returns:
        Each (B,), x100: "front" and "back", the mean distance of a point from its mean position; "front_surface" and
        "back_surface", its mean distance to the nearest point of another prediction, which sliding along the surface
        does not raise, and which the spacing of the points bounds from below. And "front_share", of the points.
    """
    mean = clouds.mean(0)
    front = visible_points(mean.contiguous(), camera, method="horizon")[:, 0]
    distances = {"": (clouds - mean).norm(dim=-1).mean(0)}
    others = [nearest(clouds, clouds.roll(step, 0)).squared_distance.sqrt() for step in range(1, len(clouds))]
    distances["_surface"] = torch.stack(others).mean((0, 1))
    found = {
        f"{side}{kind}": 100 * (values * chosen).sum(-1) / chosen.sum(-1).clamp(min=1)
        for kind, values in distances.items()
        for side, chosen in (("front", front), ("back", ~front))
    }
    return found | {"front_share": front.to(mean.dtype).mean(-1)}


def _summary(per_shape: Mapping[str, np.ndarray], shapes: Any) -> dict[str, Any]:
    found: dict[str, Any] = {"shapes": per_shape["front"][:, shapes].shape[1]}
    means = {name: np.array(each["by_seed"]) for name, each in spreads(per_shape, shapes).items()}
    for kind in ("", "_surface"):
        ratio = means[f"back{kind}"] / means[f"front{kind}"]
        found |= {f"{side}{kind}": means[f"{side}{kind}"].mean().item() for side in ("front", "back")}
        found |= {f"ratio{kind}": ratio.mean().item(), f"ratio{kind}_by_seed": ratio.tolist()}
    return found | {"front_share": means["front_share"].mean().item()}


def markdown(result: Mapping[str, Any]) -> str:
    """A line for all shapes, and for every category."""
    (found,) = result["claims"]
    head = (
        f"{result['codes']} codes for one image of each of {result['shapes']} held-out shapes, profile "
        f"`{result['profile']}`, {trainings(result['seeds'])}. Variation x100: mean distance of a point from its mean "
        "position over the codes, for the points that the image's camera sees and for the others; surface: to the "
        f"nearest point of another prediction. Claim: {found['words']}; it "
        f"{found['verdict'].replace('undecided', 'is undecided')}."
    )
    rows = []
    for name, row in {"all": result["all"], **result["categories"]}.items():
        ratios = " / ".join(f"{ratio:.2f}" for ratio in row["ratio_by_seed"])
        front, back, of_surface = (f"{row[column]:.2f}" for column in ("front", "back", "ratio_surface"))
        rows.append([name, str(row["shapes"]), front, back, ratios, of_surface])
    columns = ["", "shapes", "front", "back", "back / front, by seed", "of the surface"]
    return markdown_page(head, markdown_lines(columns, rows))


def _figure(study: Study) -> Figure:
    config = study.config(unchanged, seed=0)
    tree = ShapeTree(study.test_tree, "test", list(config.categories) or None)
    model = study.network(config)
    shapes = pick_shapes(tree, SHOWN_SHAPES)
    examples = (make_example(model, shape, config, seed=0, codes=SHOWN_CODES) for shape in shapes)
    return figures.predictions_figure(*examples)
