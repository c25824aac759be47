"""One front, three backs: do the answers to the front's image reach all of them, and is anything drawn that is none?

Seven of the embedded families hide several backs behind one front, and all of them are known (`variants_of`). What
is compared is the hidden part alone. Over whole clouds even samples of a back, as large as one prediction, are seldom
nearer to it than half the distance between two backs ("whole" in what is written): the sampling of the front drowns it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from diffpoint import PinholeCamera, nearest
from models import Predictor
from train.config import FitConfig
from train.data import ShapeTree, store
from train.data.families import FAMILIES
from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.rules import Hider, hider_of
from train.data.solids import sample_union, surface_of
from train.errors import UserError
from train.evaluation.per_shape import ShapeMetrics, stack_seeds
from train.experiments.paper import deterministic, highly_diverse
from train.experiments.table import claim_lines, judged, mean_and_spread, table_lines, trainings
from train.experiments.workbench import Change, Workbench, as_it_is
from train.show import figures

CODES = (10, 50)
APART = 0.04
"""World units: where a point of one back is farther than this from another back, it tells them apart."""
NEAR = 0.5
"""Near a back: within this share of the smallest distance between two backs of the object."""
_SHOWN_CODES = 5
_NETWORKS: dict[str, tuple[Change, tuple[int, ...]]] = {
    "ours": (as_it_is, CODES),
    "highly diverse": (highly_diverse, CODES[:1]),
    "deterministic": (deterministic, (1,)),
}
"""Network -> how its training differs from the profile's, and how many codes it is given."""


class Object(NamedTuple):
    """An object with several backs.

    Attributes:
        category: its family.
        image: (3, H, W) of its front, in [0, 1].
        camera: the image's.
        backs: (K, P, 3) samples of each of its shapes.
        again: (K, P, 3) other samples of the same.
    """

    category: str
    image: Tensor
    camera: PinholeCamera
    backs: Tensor
    again: Tensor


def configs(bench: Workbench) -> list[FitConfig]:
    """Every training that the measurement needs, seed by seed."""
    return [
        bench.config(change, seed=seed) for seed in range(bench.seeds) for change, _ in _NETWORKS.values()
    ]


def coverage(bench: Workbench) -> dict[str, Any]:
    """Scores what our system draws for the fronts of held-out objects; writes coverage.json, .md and .png.

    Beside 10 and 50 codes: 10 of the highly diverse model; the deterministic network's one answer; as many random
    training shapes of the category; and samples of the backs themselves, for which all is reached and nothing is wrong.

    Returns:
        What coverage.json holds: for each row "reached", the share of an object's backs that are reached, and
        "none", the share of clouds that are near none; for the hidden part, and once more for whole clouds.

    Raises:
        UserError: the first tree's test split has no object of a family that hides something.
    """
    bench.train_all(configs(bench))
    config = bench.config(as_it_is, seed=0)
    test = bench.split(config, "test")
    hiders = [found for found in map(hider_of, test.ids) if found]
    if not hiders:
        raise UserError(
            f"{bench.scored_tree} has no test shape of a family with hidden backs; make some with: "
            "python -m train data procedural --out DIR"
        )
    size = ShapeTree(bench.scored_tree, "test")[0].camera.height
    objects: list[Object] = []

    def needed() -> list[Object]:
        if not objects:
            bar = tqdm(hiders, desc="fronts and backs", unit="object", disable=not bench.progress)
            objects.extend(make_object(hider, size) for hider in bar)
        return objects

    rows: dict[str, list[ShapeMetrics]] = {}
    for seed in range(bench.seeds):
        for name, (change, codes) in _NETWORKS.items():
            found = _kept(bench, bench.config(change, seed=seed), hiders, needed, codes=codes, seed=seed)
            for count, scores in found.items():
                rows.setdefault(f"{name}, {count} codes" if count > 1 else name, []).append(scores)
    for name, scores in _without_network(bench, hiders, needed).items():
        rows[name] = [scores]
    result = bench.about(config) | {
        "objects": len(hiders),
        "near": NEAR,
        "apart": APART,
        "rows": {name: _summary(found) for name, found in rows.items()},
        "categories": {
            category: {
                name: _summary(
                    [{k: v[[h.category == category for h in hiders]] for k, v in s.items()} for s in by_seed]
                )
                for name, by_seed in rows.items()
            }
            for category in dict.fromkeys(h.category for h in hiders)
        },
        "claims": _claims({name: stack_seeds(found) for name, found in rows.items()}),
    }
    bench.publish("coverage", result, _markdown(result), _figure(bench, hiders, size, result))
    return result


def _claims(rows: Mapping[str, ShapeMetrics]) -> list[dict[str, Any]]:
    """What codes are for: other backs, and none that there is not."""
    coded = [f"{name}, {CODES[0]} codes" for name in ("ours", "highly diverse")]
    reached = [
        judged(f"backs reached, %: {low} < {high}", 100 * (rows[high]["reached"] - rows[low]["reached"]))
        for low, high in (("deterministic", coded[0]), coded)
    ]
    wrong = [
        judged(f"near none, %: {name} < {_OTHERS}", 100 * (rows[_OTHERS]["none"] - rows[name]["none"]))
        for name in coded
    ]
    return [*reached, *wrong]


def make_object(hider: Hider, size: int) -> Object:
    """The object behind a shape of a tree, in a picture of its front of `size` pixels, drawn with the first back."""
    cone = FAMILIES[hider.category].cone
    assert cone is not None
    variants = variants_of(hider.category, hider.seed)
    rng = np.random.default_rng(hider.seed)
    azimuth = rng.uniform(-cone.azimuth_deg, cone.azimuth_deg)
    camera = orbit_camera(np.array([azimuth]), np.array([cone.elevation_deg]), size)
    views = Renderer(surface_of(variants[0])).render(camera)
    backs, again = (
        torch.from_numpy(np.stack([sample_union(solids, store.POINTS, rng) for solids in variants])).float()
        for _ in range(2)
    )
    image = torch.from_numpy(views.images[0]).permute(2, 0, 1).float() / 255
    return Object(hider.category, image, camera[0].to(dtype=torch.float32), backs, again)


def hidden_distances(clouds: Tensor, backs: Tensor, *, apart: float | None = APART) -> Tensor:
    """The chamfer distance from clouds to each back, counting only the points that tell the backs apart.

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
    telling = torch.zeros(kinds, count, dtype=torch.bool)
    for i, j in itertools.permutations(range(kinds), 2):
        telling[i] |= nearest(backs[i], backs[j]).squared_distance.sqrt() > (apart or 0.0)
    if apart is None:
        telling[:] = True
    together = backs.flatten(0, 1).expand(len(clouds), -1, -1).contiguous()
    counts = telling.flatten()[nearest(clouds, together).index]
    found = []
    for back, tells in zip(backs, telling, strict=True):
        repeated = back.expand(len(clouds), -1, -1).contiguous()
        there = nearest(clouds, repeated).squared_distance.sqrt() * counts
        back_again = nearest(repeated, clouds).squared_distance.sqrt() * tells
        found.append(100 * (there.mean(-1) + back_again.mean(-1)))
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


def near_distance(backs: Tensor, again: Tensor, *, apart: float | None = APART) -> float:
    """Half the smallest distance between two backs, other samples of one beside the first samples of the other."""
    distances = hidden_distances(again, backs, apart=apart)
    between = distances[~torch.eye(len(backs), dtype=torch.bool)]
    return NEAR * between.min().item()


def _judge(obj: Object, clouds: Tensor, counts: Sequence[int]) -> dict[int, dict[str, float]]:
    """For the first so many clouds: "reached", "none", and both for whole clouds."""
    found: dict[int, dict[str, float]] = {count: {} for count in counts}
    for suffix, apart in (("", APART), ("_whole", None)):
        near = near_distance(obj.backs, obj.again, apart=apart)
        distances = hidden_distances(clouds, obj.backs, apart=apart)
        for count in counts:
            reached, none = reach(distances[:count], near)
            found[count] |= {f"reached{suffix}": reached, f"none{suffix}": none}
            found[count][f"nearest{suffix}"] = (distances[:count].amin(1).mean() / near).item()
    return found


def _collect(found: Sequence[dict[int, dict[str, float]]]) -> dict[str, Tensor]:
    return {
        f"{count}/{name}": torch.tensor([each[count][name] for each in found], dtype=torch.float64)
        for count, values in found[0].items()
        for name in values
    }


def _split_up(scores: ShapeMetrics, counts: Sequence[int]) -> dict[int, ShapeMetrics]:
    return {
        count: {name.split("/")[1]: v for name, v in scores.items() if name.split("/")[0] == str(count)}
        for count in counts
    }


def _kept(
    bench: Workbench, config: Any, hiders: list[Hider], needed: Any, *, codes: Sequence[int], seed: int
) -> dict[int, ShapeMetrics]:
    def take() -> ShapeMetrics:
        model = bench.network(config)
        bar = tqdm(needed(), desc="answers", unit="object", disable=not bench.progress)
        return _collect([_judge(obj, answers(model, obj.image, max(codes), seed=seed), codes) for obj in bar])

    key = ["coverage", bench.run_of(config).name, list(codes), [NEAR, APART], list(map(list, hiders))]
    return _split_up(bench.kept(key, take), codes)


@torch.no_grad()
def answers(model: Predictor, image: Tensor, count: int, *, seed: int) -> Tensor:
    """(R, N, 3): what a network makes of one image (3, H, W) with `count` random codes."""
    codes = torch.randn(count, 1, model.code_dim, generator=torch.Generator().manual_seed(seed))
    return model(image[None], codes)[:, 0].contiguous()


def _without_network(bench: Workbench, hiders: list[Hider], needed: Any) -> dict[str, ShapeMetrics]:
    """Random training shapes of the category, and samples of the backs themselves, as large as one prediction."""
    config = bench.config(as_it_is, seed=0)

    def take() -> ShapeMetrics:
        points = bench.network(config).points
        train = bench.split(config, "train")
        random = np.random.default_rng(0)
        drawn, true = [], []
        for obj in needed():
            same = [i for i, c in enumerate(train.categories) if c == obj.category] or range(len(train))
            picked = random.choice(np.array(same), size=CODES[0])
            drawn.append(_judge(obj, train.points[picked][:, :points].contiguous(), CODES[:1])[CODES[0]])
            copies = obj.again[torch.arange(CODES[0]) % len(obj.again), :points].contiguous()
            true.append(_judge(obj, copies, CODES[:1])[CODES[0]])
        return _collect([{1: a, 2: b} for a, b in zip(drawn, true, strict=True)])

    key = ["coverage", "without network", bench.run_of(config).name, [NEAR, APART], list(map(list, hiders))]
    found = _split_up(bench.kept(key, take), (1, 2))
    return {
        _OTHERS: found[1],
        f"{CODES[0]} samples of the backs": found[2],
    }


def _summary(by_seed: Sequence[ShapeMetrics]) -> dict[str, Any]:
    means = {name: torch.stack([s[name].mean() for s in by_seed]) for name in by_seed[0]}
    return {
        name: {"mean": v.mean().item(), "sd": v.std().item() if len(v) > 1 else None, "by_seed": v.tolist()}
        for name, v in means.items()
    }


_OTHERS = f"{CODES[0]} random training shapes of the category"
_COLUMNS = {
    "reached": "backs reached",
    "none": "near none",
    "nearest": "distance of the nearest back",
    "reached_whole": "whole clouds: reached",
    "none_whole": "near none",
}


def _markdown(result: Mapping[str, Any]) -> str:
    head = (
        f"{result['objects']} held-out objects whose front hides one of three backs, profile `{result['profile']}`, "
        f"{trainings(result['seeds'])} of each. Reached: share of an object's backs that are the nearest of some "
        "prediction, and nearer than "
        "half the smallest distance between two of its backs. Near none: share of predictions with no back so near. "
        "Distance: mean over predictions, 1 is as near as that. Only points count that tell the backs apart, except in "
        "the last two columns."
    )
    rows = [
        [name, *(_cell(row[column], percent="nearest" not in column) for column in _COLUMNS)]
        for name, row in result["rows"].items()
    ]
    first = next(iter(result["categories"].values()))
    by_category = [
        [
            category,
            *(f"{found[name]['reached']['mean']:.0%} / {found[name]['none']['mean']:.0%}" for name in first),
        ]
        for category, found in result["categories"].items()
    ]
    lines = [head, "", *table_lines(["", *_COLUMNS.values()], rows)]
    lines += ["", *claim_lines(result["claims"])]
    lines += ["", "Backs reached / predictions near none, by family:", ""]
    return "\n".join([*lines, *table_lines(["", *first], by_category), ""])


def _cell(found: Mapping[str, Any], *, percent: bool) -> str:
    if not percent:
        return mean_and_spread(found)
    return f"{found['mean']:.0%}" + ("" if found["sd"] is None else f" ± {100 * found['sd']:.0f}")


def _figure(bench: Workbench, hiders: list[Hider], size: int, result: Mapping[str, Any]) -> Figure:
    """For one object of each family: the front, its backs, and what a few codes draw, all from one side behind."""
    chosen = list({hider.category: hider for hider in reversed(hiders)}.values())[::-1]
    model = bench.network(bench.config(as_it_is, seed=0))
    kinds = FAMILIES[chosen[0].category].modes
    figure, panels = figures.grid(rows=len(chosen), columns=1 + kinds + _SHOWN_CODES)
    side = orbit_camera(np.array([125.0]), np.array([20.0]), 128).to(dtype=torch.float32)
    for row, hider in zip(panels, chosen, strict=True):
        obj = make_object(hider, size)
        clouds = answers(model, obj.image, _SHOWN_CODES, seed=0)
        near = near_distance(obj.backs, obj.again)
        distances = hidden_distances(clouds, obj.backs)
        everything = torch.cat([obj.backs.flatten(0, 1), clouds.flatten(0, 1)])
        close = figures.narrowed(side, everything)
        figures.draw_image(row[0], obj.image)
        figures.caption(row[0], hider.category)
        for axes, back in zip(row[1:], obj.backs, strict=False):
            figures.draw_cloud(axes, back, close[0], colours=figures.TRUE)
        for axes, cloud, away in zip(row[1 + kinds :], clouds, distances, strict=True):
            figures.draw_cloud(axes, cloud, close[0])
            least, which = away.min(0)
            words = f"back {int(which) + 1}" if least < near else f"none (back {int(which) + 1} is nearest)"
            axes.text(0.5, 0.0, words, transform=axes.transAxes, fontsize=8, ha="center", color=figures.MUTED)
    heads = [
        "the front",
        *(f"back {k + 1}" for k in range(kinds)),
        *(f"code {k + 1}" for k in range(_SHOWN_CODES)),
    ]
    figures.titles(panels, heads)
    return figure
