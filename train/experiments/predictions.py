"""Several answers to one image: do they differ where the image does not tell?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, nearest, visible_points
from models import Generator
from train.data import ShapeTree
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.per_shape import ShapeMetrics, concatenate, sample_predictions, stack_seeds
from train.evaluation.report import make_example, pick_shapes
from train.experiments.table import judged, table_lines, trainings
from train.experiments.workbench import Workbench, as_it_is
from train.show import figures

CODES = 6
SHOWN_CODES, SHOWN_SHAPES = 5, 6
LEAST_RATIO = 1.5
"""How much more the back has to vary than the front."""


def predictions(bench: Workbench) -> dict[str, Any]:
    """Draws what several codes make of one image, and measures where they differ; writes predictions.json, .md, .png.

    Each held-out shape shows one view, which the seed draws; the figure's shapes show their front. See `spread`.

    Returns:
        What predictions.json holds: "front", "back" (x100) and "ratio" over all shapes and by category, and the share
        of bootstrap samples, over trainings and shapes, in which the back varies more than 1.5 times as much.
    """
    configs = bench.configs(as_it_is)
    bench.train_all(configs)
    test = bench.split(configs[0], "test")
    by_seed = []
    for config in configs:
        key = ["spread", bench.run_of(config).name, CODES, test.fingerprint]
        model = _generator(bench, config)
        by_seed.append(bench.kept(key, lambda model=model, seed=config.seed: _spreads(model, test, seed)))
    scores = stack_seeds(by_seed)
    names = list(dict.fromkeys(test.categories))
    result = bench.about(configs[0]) | {
        "shapes": len(test),
        "codes": CODES,
        "all": _summary(scores),
        "categories": {
            name: _summary({k: v[:, [c == name for c in test.categories]] for k, v in scores.items()})
            for name in names
        },
        "claims": [
            judged(
                f"the back varies more than {LEAST_RATIO} times as much as the front",
                scores["back"] - LEAST_RATIO * scores["front"],
            )
        ],
    }
    bench.publish("predictions", result, _markdown(result), _figure(bench))
    return result


def spread(clouds: Tensor, camera: PinholeCamera) -> dict[str, Tensor]:
    """How far several predictions of one image are apart, in the front and in the back.

    Point n of every prediction comes from the same output of the network, so that points correspond. A point is of
    the front if the image's camera sees it in the mean cloud (`visible_points`, "horizon", which does not let the
    back shine through between 512 points), else of the back.

    Args:
        clouds: (R, B, N, 3) R predictions of each of B images, world frame.
        camera: (B, 1) the images' cameras.

    Returns:
        Each (B,), x100: "front" and "back", the mean distance of a point from its mean place; "front_surface" and
        "back_surface", its mean distance from the nearest point of another prediction, which sliding along the surface
        does not raise, but the spacing of the points bounds from below. And "front_share", of the points.
    """
    count = len(clouds)
    mean = clouds.mean(0)
    front = visible_points(mean.contiguous(), camera, method="horizon")[:, 0]
    away = {"": (clouds - mean).norm(dim=-1).mean(0)}
    others = [nearest(clouds, clouds.roll(step, 0)).squared_distance.sqrt() for step in range(1, count)]
    away["_surface"] = torch.stack(others).mean((0, 1))
    found = {
        f"{side}{kind}": 100 * (values * chosen).sum(-1) / chosen.sum(-1).clamp(min=1)
        for kind, values in away.items()
        for side, chosen in (("front", front), ("back", ~front))
    }
    return found | {"front_share": front.to(mean.dtype).mean(-1)}


def _spreads(model: Generator, test: LoadedSplit, seed: int) -> ShapeMetrics:
    answered = sample_predictions(model, test, codes=CODES, seed=seed)
    found = concatenate([spread(clouds, shown.camera) for _, shown, clouds in answered])
    return {name: values.double() for name, values in found.items()}


def _generator(bench: Workbench, config: Any) -> Generator:
    model = bench.network(config)
    if not isinstance(model, Generator):
        raise UserError("only our own system takes codes")
    return model


def _summary(scores: Mapping[str, Tensor]) -> dict[str, Any]:
    found: dict[str, Any] = {"shapes": scores["front"].shape[1]}
    for kind in ("", "_surface"):
        front, back = scores[f"front{kind}"].mean(1), scores[f"back{kind}"].mean(1)
        found |= {f"front{kind}": front.mean().item(), f"back{kind}": back.mean().item()}
        found |= {
            f"ratio{kind}": (back / front).mean().item(),
            f"ratio{kind}_by_seed": (back / front).tolist(),
        }
    return found | {"front_share": scores["front_share"].mean().item()}


def _markdown(result: Mapping[str, Any]) -> str:
    head = (
        f"{result['codes']} codes for one image of each of {result['shapes']} held-out shapes, profile "
        f"`{result['profile']}`, {trainings(result['seeds'])}. Spread x100: mean distance of a point "
        "from its mean place over the codes, for "
        "the points that the image's camera sees and for those behind; surface: from the nearest point of "
        f"another prediction. The back varies more than {LEAST_RATIO} times as much as the front in "
        f"{result['claims'][0]['confidence']:.1%} of the bootstrap samples over trainings and shapes."
    )
    rows = [
        [
            name,
            str(row["shapes"]),
            f"{row['front']:.2f}",
            f"{row['back']:.2f}",
            " / ".join(f"{ratio:.2f}" for ratio in row["ratio_by_seed"]),
            f"{row['ratio_surface']:.2f}",
        ]
        for name, row in {"all": result["all"], **result["categories"]}.items()
    ]
    columns = ["", "shapes", "front", "back", "back / front, by seed", "of the surface"]
    return "\n".join([head, "", *table_lines(columns, rows), ""])


def _figure(bench: Workbench) -> Figure:
    config = bench.config(as_it_is, seed=0)
    model = _generator(bench, config)
    tree = ShapeTree(bench.scored_tree, "test", list(config.categories) or None)
    examples = [
        make_example(model, shape, config, seed=0, codes=SHOWN_CODES)
        for shape in pick_shapes(tree, SHOWN_SHAPES)
    ]
    return figures.predictions_figure(*examples)
