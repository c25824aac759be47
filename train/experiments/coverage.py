"""One front, three backs: do the predictions for the front's image reach all of them, and are any unlike all of them?

Seven of the procedural families hide several backs behind one front, and all of them are known (`variants_of`). The
hidden part alone is compared. Over whole clouds, even samples of a back, as large as one prediction, are seldom nearer
to it than half the distance between two backs ("whole" in the result): the sampling of the front dominates.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import nearest
from models import Predictor
from train.config import FitConfig
from train.data import ShapeTree, tree_files
from train.data.ambiguity_check import AmbiguousObject, ambiguous_object
from train.data.families import FAMILIES
from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.solids import sample_union, surface_of
from train.errors import UserError
from train.evaluation.inference import predict
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.paper import without_codes
from train.experiments.statistics import (
    claim,
    claim_lines,
    percent_text,
    spread_text,
    spreads,
    stacked,
    trainings,
)
from train.experiments.store import Metrics
from train.experiments.study import Change, Network, Study, unchanged
from train.methods.ours import highly_diverse
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines

CODES = (10, 50)
APART = 0.04
"""World units: a point of one back distinguishes it from another back if it is farther than this from it."""
NEAR = 0.5
"""Close to a back: within this share of the smallest distance between two backs of the object."""
_SHOWN_CODES = 5
_NETWORKS: dict[str, tuple[Change, tuple[int, ...]]] = {
    "ours": (unchanged, CODES),
    "highly diverse": (highly_diverse, CODES[:1]),
    "deterministic": (without_codes, (1,)),
}
"""Network -> how its training differs from the profile's, and how many codes it is given."""
_CODED = [f"{name}, {CODES[0]} codes" for name in ("ours", "highly diverse")]
_RETRIEVED = f"{CODES[0]} random training shapes of the category"
_COLUMNS = {
    "reached": "backs reached",
    "none": "close to none",
    "nearest": "distance to the nearest back",
    "reached_whole": "whole clouds: reached",
    "none_whole": "close to none",
}


class Object(NamedTuple):
    """An object with several backs."""

    category: str
    image: Tensor
    """(3, H, W) of its front, in [0, 1]."""
    backs: Tensor
    """(K, P, 3) samples of each of its shapes."""
    again: Tensor
    """(K, P, 3) other samples of the same."""
    limits: Mapping[float | None, float]
    """`apart` -> within this distance of a back a cloud is close to it."""


def configs(study: Study) -> list[FitConfig]:
    """Every training that the measurement needs, seed by seed."""
    return [] if study.run else study.configs(*(change for change, _ in _NETWORKS.values()))


def _networks(study: Study) -> dict[str, tuple[list[Network], tuple[int, ...]]]:
    """Row -> networks and numbers of codes: of the study's trainings, or of a given run."""
    if study.run:
        draws = study.networks(unchanged)
        return {str(study.run): (draws, CODES if draws[0].load().takes_codes else (1,))}
    return {name: (study.networks(change), codes) for name, (change, codes) in _NETWORKS.items()}


def make(study: Study) -> Outcome:
    """For each row "reached", the share of an object's backs that are reached, and "none", the share of clouds that are
    close to none; for the hidden part, and for whole clouds.

    Besides our method with 10 and 50 codes: 10 codes of the highly diverse model; the deterministic network's single
    prediction; as many random training shapes of the category; and samples of the backs themselves, which reach all.
    With `study.run`, that run's network alone in place of the trained ones.

    Raises:
        UserError: the first tree's test split has no object of a family that hides something, or no such run.
    """
    study.train_all(configs(study))
    networks = _networks(study)
    first = next(iter(networks.values()))[0][0]
    config = first.config
    hiders = [found for found in map(ambiguous_object, study.split(config, "test").ids) if found]
    if not hiders:
        raise UserError(
            f"{study.test_tree} has no test shape of a family with hidden backs; make some with: "
            "python -m train data procedural --out DIR"
        )
    size = ShapeTree(study.test_tree, "test")[0].camera.height

    @functools.cache
    def objects() -> list[Object]:
        bar = progress_bar(hiders, title="fronts and backs", unit="object", progress=study.progress)
        return [make_object(hider, size) for hider in bar]

    inputs = [[NEAR, APART], list(map(list, hiders))]
    rows: dict[str, list[Metrics]] = {}
    for name, (trained, codes) in networks.items():
        for network in trained:
            found = study.kept(
                ["coverage", *network.key, list(codes), *inputs],
                lambda network=network, codes=codes: _predicted(study, network, objects(), codes),
            )
            for count in codes:
                row = f"{name}, {count} codes" if count > 1 else name
                rows.setdefault(row, []).append(_starting_with(f"{count}/", found))
    key = ["coverage", "without network", *first.key, *inputs]
    found = study.kept(key, lambda: _without_network(study, config, first.load().points, objects()))
    rows[_RETRIEVED] = [_starting_with(f"{CODES[0]}/", found)]
    rows[f"{CODES[0]} samples of the backs"] = [_starting_with(f"resampled {CODES[0]}/", found)]
    per_shape = {name: stacked(by_seed) for name, by_seed in rows.items()}
    categories = np.array([hider.category for hider in hiders])
    result = study.about(config) | {
        "profile": config.profile,  # of the run, if there is one
        "run": str(study.run) if study.run else None,
        "objects": len(hiders),
        "near": NEAR,
        "apart": APART,
        "rows": {name: spreads(metrics) for name, metrics in per_shape.items()},
        "categories": {
            category: {name: spreads(metrics, categories == category) for name, metrics in per_shape.items()}
            for category in dict.fromkeys(categories.tolist())
        },
        "claims": _claims(per_shape),
    }
    return Outcome(result, markdown(result), {"": _figure(first.load(), hiders, size)})


coverage = Experiment(make, configs, lambda study: [str(study.run)] if study.run else [])


def _claims(rows: Mapping[str, Mapping[str, np.ndarray]]) -> list[dict[str, Any]]:
    """What codes are meant for: other backs, and nothing that is none of them."""
    lower_and_higher = [("reached", "deterministic", _CODED[0]), ("reached", *_CODED)]
    lower_and_higher += [("none", name, _RETRIEVED) for name in _CODED]
    return [
        claim(
            f"{_COLUMNS[metric]}, %: {lower} < {higher}", 100 * (rows[higher][metric] - rows[lower][metric])
        )
        for metric, lower, higher in lower_and_higher
        if {lower, higher} <= set(rows)
    ]


def make_object(hider: AmbiguousObject, size: int) -> Object:
    """The object behind a shape of a tree, in a picture of its front of `size` pixels, drawn with the first back."""
    cone = FAMILIES[hider.category].cone
    assert cone is not None
    variants = variants_of(hider.category, hider.seed)
    rng = np.random.default_rng(hider.seed)
    azimuth = rng.uniform(-cone.azimuth_deg, cone.azimuth_deg)
    camera = orbit_camera(np.array([azimuth]), np.array([cone.elevation_deg]), size)
    views = Renderer(surface_of(variants[0])).render(camera)
    backs, again = (
        torch.from_numpy(np.stack([sample_union(v, tree_files.POINTS, rng) for v in variants])).float()
        for _ in range(2)
    )
    image = torch.from_numpy(views.images[0]).permute(2, 0, 1).float() / 255
    different = ~torch.eye(len(backs), dtype=torch.bool)
    limits = {
        apart: NEAR * hidden_distances(again, backs, apart=apart)[different].min().item()
        for apart in (APART, None)
    }
    return Object(hider.category, image, backs, again, limits)


def hidden_distances(clouds: Tensor, backs: Tensor, *, apart: float | None = APART) -> Tensor:
    """The chamfer distance from clouds to each back, counting only the points that distinguish the backs.

    A point of a back counts if it is farther than `apart` from some other back; a point of a cloud counts if the point
    nearest to it, among those of all backs, does. Each direction sums over the points that count and divides by all
    points, so that a cloud with nothing behind a flat front is at distance 0 from the flat back.

    Args:
        clouds: (R, N, 3).
        backs: (K, P, 3).
        apart: world units; None counts every point, which is the chamfer distance.

    Returns:
        (R, K), un-squared, x100.
    """
    kinds, count = backs.shape[:2]
    distinct = torch.full((kinds, count), apart is None)
    for i, j in itertools.permutations(range(kinds), 2):
        distinct[i] |= nearest(backs[i], backs[j]).squared_distance.sqrt() > (apart or 0.0)
    together = backs.flatten(0, 1).expand(len(clouds), -1, -1).contiguous()
    counts = distinct.flatten()[nearest(clouds, together).index]
    found = []
    for back, counted in zip(backs, distinct, strict=True):
        repeated = back.expand(len(clouds), -1, -1).contiguous()
        to_back = nearest(clouds, repeated).squared_distance.sqrt() * counts
        from_back = nearest(repeated, clouds).squared_distance.sqrt() * counted
        found.append(100 * (to_back.mean(-1) + from_back.mean(-1)))
    return torch.stack(found, 1)


def reach(distances: Tensor, near: float) -> tuple[float, float]:
    """How well clouds cover the backs, from their distances (R, K).

    Returns:
        The share of backs that are the nearest one of some cloud that is within `near` of it; and the share of clouds
        that are within `near` of none.

    Example:
        >>> reach(torch.tensor([[0.1, 3.0], [2.0, 2.5]]), 1.0)
        (0.5, 0.5)
    """
    least, which = distances.min(1)
    close = least < near
    return len(set(which[close].tolist())) / distances.shape[1], (~close).double().mean().item()


def _judge(obj: Object, clouds: Tensor, counts: Sequence[int]) -> dict[str, float]:
    """For the first so many clouds "COUNT/NAME" of each of `_COLUMNS`, and "COUNT/nearest_whole"."""
    found: dict[str, float] = {}
    for suffix, apart in (("", APART), ("_whole", None)):
        near, distances = obj.limits[apart], hidden_distances(clouds, obj.backs, apart=apart)
        for count in counts:
            reached, none = reach(distances[:count], near)
            found |= {f"{count}/reached{suffix}": reached, f"{count}/none{suffix}": none}
            found[f"{count}/nearest{suffix}"] = (distances[:count].amin(1).mean() / near).item()
    return found


def _over_objects(found: Sequence[Mapping[str, float]]) -> Metrics:
    return {name: torch.tensor([each[name] for each in found], dtype=torch.float64) for name in found[0]}


def _starting_with(prefix: str, metrics: Metrics) -> Metrics:
    return {name.removeprefix(prefix): v for name, v in metrics.items() if name.startswith(prefix)}


def _predicted(study: Study, network: Network, objects: Sequence[Object], codes: Sequence[int]) -> Metrics:
    """`_judge` over the objects of a network's predictions."""
    model = network.load()
    bar = progress_bar(objects, title="predictions", unit="object", progress=study.progress)
    return _over_objects(
        [_judge(obj, predict(model, obj.image, max(codes), seed=network.seed), codes) for obj in bar]
    )


def _without_network(study: Study, config: FitConfig, points: int, objects: Sequence[Object]) -> Metrics:
    """`_judge` over the objects of random training shapes of the category, and as "resampled COUNT/NAME" of samples of
    the backs themselves; both as large as one prediction."""
    count, train = CODES[0], study.split(config, "train")
    random = np.random.default_rng(0)
    found = []
    for obj in objects:
        same = [i for i, c in enumerate(train.categories) if c == obj.category] or range(len(train))
        retrieved = train.points[random.choice(np.array(same), size=count)][:, :points].contiguous()
        resampled = obj.again[torch.arange(count) % len(obj.again), :points].contiguous()
        of_samples = _judge(obj, resampled, (count,))
        found.append(
            _judge(obj, retrieved, (count,)) | {f"resampled {name}": v for name, v in of_samples.items()}
        )
    return _over_objects(found)


def markdown(result: Mapping[str, Any]) -> str:
    """A line for every row, claims, and a line for every family."""
    made = trainings(result["seeds"], run=result["run"]) + ("" if result["run"] else " of each")
    head = (
        f"{result['objects']} held-out objects whose front hides one of three backs, profile `{result['profile']}`, "
        f"{made}. Reached: share of an object's backs that are the nearest of some "
        "prediction, and closer than half the smallest distance between two of its backs. Close to none: share of "
        "predictions that are so close to no back. Distance: mean over predictions, in the unit of this limit. Only "
        "points that distinguish the backs are counted, except in the last two columns."
    )
    rows = [
        [name, *((spread_text if "nearest" in column else percent_text)(row[column]) for column in _COLUMNS)]
        for name, row in result["rows"].items()
    ]
    by_category = [
        [family, *(f"{row['reached']['mean']:.0%} / {row['none']['mean']:.0%}" for row in found.values())]
        for family, found in result["categories"].items()
    ]
    return markdown_page(
        head,
        markdown_lines(["", *_COLUMNS.values()], rows),
        *([claim_lines(result["claims"])] if result["claims"] else []),
        "Backs reached / predictions close to none, by family:",
        markdown_lines(["", *result["rows"]], by_category),
    )


def _figure(model: Predictor, hiders: Sequence[AmbiguousObject], size: int) -> Figure:
    """For one object of each family: the front, its backs, and predictions with a few codes, all from one side
    behind."""
    chosen = list({hider.category: hider for hider in reversed(hiders)}.values())[::-1]
    kinds = FAMILIES[chosen[0].category].modes
    figure, panels = figures.grid(rows=len(chosen), columns=1 + kinds + _SHOWN_CODES)
    side = orbit_camera(np.array([125.0]), np.array([20.0]), 128).to(dtype=torch.float32)
    for row, hider in zip(panels, chosen, strict=True):
        obj = make_object(hider, size)
        clouds = predict(model, obj.image, _SHOWN_CODES, seed=0)
        close = figures.narrowed(side, torch.cat([obj.backs.flatten(0, 1), clouds.flatten(0, 1)]))
        figures.draw_image(row[0], obj.image)
        figures.caption(row[0], hider.category)
        for axes, back in zip(row[1:], obj.backs, strict=False):
            figures.draw_cloud(axes, back, close[0], colours=figures.TRUE)
        found = hidden_distances(clouds, obj.backs).min(1)
        for axes, cloud, least, which in zip(row[1 + kinds :], clouds, *found, strict=True):
            figures.draw_cloud(axes, cloud, close[0])
            back = f"back {int(which) + 1}"
            words = back if least < obj.limits[APART] else f"none ({back} is nearest)"
            axes.text(0.5, 0.0, words, transform=axes.transAxes, fontsize=8, ha="center", color=figures.MUTED)
    backs, codes = (f"back {k + 1}" for k in range(kinds)), (f"code {k + 1}" for k in range(_SHOWN_CODES))
    figures.titles(panels, ["the front", *backs, *codes])
    return figure
