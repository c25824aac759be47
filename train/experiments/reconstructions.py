"""A figure of held-out shapes reconstructed from several images by three methods, with their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from train.config import FitConfig, changed_settings
from train.data.batches import LoadedSplit
from train.data.tree import read_shape
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors, thin_out
from train.evaluation.per_shape import view_order
from train.experiments.frame import Experiment, Outcome, markdown_page
from train.experiments.store import Metrics
from train.experiments.study import Change, Study, of_method, unchanged
from train.show import figures
from train.show.tables import markdown_lines

VIEWS = 8
"""Images of a shape, where the data have as many."""
SHAPES = 6
SEED = 0
"""Of the trainings, the views and the codes."""
_SHOWN_VIEWS = 4

_METHODS: dict[str, tuple[Change, Literal["all", "first"]]] = {
    "ours": (unchanged, "all"),
    "PSGN": (of_method("psgn"), "first"),
    "3D-R2N2": (of_method("r2n2"), "all"),
}
"""Method -> how its training differs from the profile's, and which of the images it gets."""


def configs(study: Study) -> list[FitConfig]:
    """Every training that the figure needs."""
    return [study.config(change, seed=SEED) for change, _ in _METHODS.values()]


def make(study: Study) -> Outcome:
    """For each shape and method "cd" and "fps_cd" (un-squared, x100), and their means over the shapes.

    Ours agrees on all images' codes, 3D-R2N2 reads the same images, PSGN gets the first of them.
    """
    study.train_all(configs(study))
    ours = study.config(unchanged, seed=SEED)
    test = study.split(ours, "test")
    chosen = by_turns(test.categories, SHAPES)
    views = view_order(test, SEED)[chosen, :VIEWS]
    given = {name: views if which == "all" else views[:, :1] for name, (_, which) in _METHODS.items()}
    found = {
        name: _reconstruct(study, config, chosen, given[name])
        for name, config in zip(_METHODS, configs(study), strict=True)
    }
    errors = {
        name: pd.DataFrame({key: m[key].double() for key in ("cd", "fps_cd")}) for name, m in found.items()
    }
    result = study.about(ours) | {
        "seed": SEED,
        "views": views.shape[1],
        "views_of": {name: each.shape[1] for name, each in given.items()},
        "shapes": {
            test.ids[shape]: {"category": test.categories[shape]}
            | {name: each.loc[row].to_dict() for name, each in errors.items()}
            for row, shape in enumerate(chosen.tolist())
        },
        "mean": {name: each.mean().to_dict() for name, each in errors.items()},
    }
    clouds = {name: metrics["points"] for name, metrics in found.items()}
    return Outcome(result, markdown(result), {"": _figure(study, result, test.points[chosen], clouds, views)})


reconstructions = Experiment(make, configs)


def by_turns(categories: Sequence[str], count: int) -> Tensor:
    """The numbers (up to `count`,) of the first shapes of every category, then the second ones, and so on.

    Example:
        >>> by_turns(["chair", "chair", "sofa"], 2).tolist()
        [0, 2]
    """
    ranks = [categories[:number].count(category) for number, category in enumerate(categories)]
    return torch.tensor(sorted(range(len(categories)), key=ranks.__getitem__)[:count])


def _reconstruct(study: Study, config: FitConfig, chosen: Tensor, views: Tensor) -> Metrics:
    """A method's reconstruction from `views` (M, V) of shapes (M,): "points" (M, N, 3), "cd" and "fps_cd" (M,)."""
    test: LoadedSplit = study.split(config, "test")  # images of the size that this network reads

    def measure() -> Metrics:
        model = study.network(config)
        images, true = test.float_images(chosen, views), test.points[chosen]
        points = reconstruct(model, images, seed=SEED, settings=config.inference).points
        thinned = cloud_errors(thin_out(points, model.points), true)
        return {"points": points.contiguous(), "cd": cloud_errors(points, true).cd, "fps_cd": thinned.cd}

    settings = changed_settings(config.inference)
    key = ["reconstructions", *study.weights_key(config), settings, chosen.tolist(), views.tolist()]
    return study.kept([*key, test.fingerprint], measure)


def markdown(result: Mapping[str, Any]) -> str:
    """A line for every shape, and their mean."""
    names = list(result["mean"])
    given = ", ".join(f"{name} {n} image{'s' if n > 1 else ''}" for name, n in result["views_of"].items())
    head = (
        f"{len(result['shapes'])} held-out shapes, profile `{result['profile']}`, seed {result['seed']}; images given: "
        f"{given}. Chamfer distance to the ground truth, un-squared, x100; in brackets after reduction to the size "
        "of one prediction."
    )

    def cells(errors: Mapping[str, Mapping[str, float]]) -> list[str]:
        return [f"{errors[name]['cd']:.2f} ({errors[name]['fps_cd']:.2f})" for name in names]

    rows = [[f"{each['category']} `{shape}`", *cells(each)] for shape, each in result["shapes"].items()]
    rows.append(["mean", *cells(result["mean"])])
    return markdown_page(head, markdown_lines(["", *names], rows))


def _figure(
    study: Study, result: Mapping[str, Any], true: Tensor, clouds: Mapping[str, Tensor], views: Tensor
) -> Figure:
    """Two rows for each shape: from the first image's side above, from behind below."""
    figure, panels = figures.grid(rows=2 * len(true), columns=3 + len(clouds))
    for row, (name, errors) in enumerate(result["shapes"].items()):
        upper, lower = pair = panels[2 * row : 2 * row + 2]
        shape = read_shape(study.test_tree, name)
        images, cameras = figures.close_up(shape.images, shape.camera, shape.points)
        first = cameras[int(views[row, 0])]
        for axes in pair[:, :2].flat:
            figures.bare(axes)
        for axes, view in zip(pair[:, :2].flat, views[row, :_SHOWN_VIEWS].tolist(), strict=False):
            figures.draw_image(axes, images[view])
        figures.caption(upper[0], f"{errors['category']}, the first image")
        for line, camera in zip(pair, (first, figures.from_behind(first)), strict=True):
            for axes, points in zip(line[2:], clouds.values(), strict=False):
                figures.draw_cloud(axes, points[row], camera)
            figures.draw_cloud(line[-1], true[row], camera, colours=figures.TRUE)
        for axes, method in zip(lower[2:], clouds, strict=False):
            figures.caption(axes, f"CD {errors[method]['cd']:.2f}, FPS-CD {errors[method]['fps_cd']:.2f}")
    methods = [f"{name}, {n} image{'s' if n > 1 else ''}" for name, n in result["views_of"].items()]
    figures.titles(panels, ["some of the images", "", *methods, "ground truth"])
    figures.headline(
        figure,
        f"Held-out shapes, profile {result['profile']}, seed {result['seed']}, {result['views']} images of each; "
        "from the first image's side and from behind; chamfer distance x100",
    )
    return figure
