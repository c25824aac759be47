"""Held-out shapes from several images, beside what other methods make of them: a figure with its errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from matplotlib.figure import Figure
from torch import Tensor

from train.config import FitConfig
from train.data.batches import LoadedSplit
from train.data.tree import read_shape
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors, thin_out
from train.evaluation.per_shape import ShapeMetrics, view_order
from train.experiments.paper import of_system
from train.experiments.table import table_lines
from train.experiments.workbench import Change, Workbench, as_it_is
from train.show import figures

VIEWS = 8
"""Images of a shape, where the data have as many."""
SHAPES = 6
SEED = 0
"""Of the trainings, the views and the codes."""
_SHOWN_VIEWS = 4

_METHODS: dict[str, tuple[Change, Literal["all", "first"]]] = {
    "ours": (as_it_is, "all"),
    "PSGN": (of_system("psgn"), "first"),
    "3D-R2N2": (of_system("r2n2"), "all"),
}
"""Method -> how its training differs from the profile's, and which of the images it gets."""


def configs(bench: Workbench) -> list[FitConfig]:
    """Every training that the figure needs."""
    return [bench.config(change, seed=SEED) for change, _ in _METHODS.values()]


def reconstructions(bench: Workbench) -> dict[str, Any]:
    """Reconstructs a few held-out shapes by each method; writes reconstructions.json, .md and .png.

    Ours agrees on all images' codes, 3D-R2N2 reads the same images, PSGN answers to the first of them.

    Returns:
        What reconstructions.json holds: for each shape and method "cd" and "fps_cd" (un-squared, x100), and their means
        over the shapes.
    """
    bench.train_all(configs(bench))
    ours = configs(bench)[0]
    test = bench.split(ours, "test")
    chosen = picked(test.categories, SHAPES)
    views = view_order(test, SEED)[chosen, :VIEWS]
    answers = {
        name: _answers(
            bench, bench.config(change, seed=SEED), chosen, views if given == "all" else views[:, :1]
        )
        for name, (change, given) in _METHODS.items()
    }
    errors = {
        name: [{key: found[key][row].item() for key in ("cd", "fps_cd")} for row in range(len(chosen))]
        for name, found in answers.items()
    }
    result = bench.about(ours) | {
        "seed": SEED,
        "views": views.shape[1],
        "views_of": {name: views.shape[1] if given == "all" else 1 for name, (_, given) in _METHODS.items()},
        "shapes": {
            test.ids[shape]: {
                "category": test.categories[shape],
                **{name: e[row] for name, e in errors.items()},
            }
            for row, shape in enumerate(chosen.tolist())
        },
        "mean": {
            name: {key: sum(each[key] for each in e) / len(e) for key in ("cd", "fps_cd")}
            for name, e in errors.items()
        },
    }
    clouds = {name: found["points"] for name, found in answers.items()}
    figure = _figure(bench, result, test.points[chosen], clouds, views)
    bench.publish("reconstructions", result, _markdown(result), figure)
    return result


def picked(categories: Sequence[str], count: int) -> Tensor:
    """The numbers (up to `count`,) of the first shapes of every category, then the second ones, and so on.

    Example:
        >>> picked(["chair", "chair", "sofa"], 2).tolist()
        [0, 2]
    """
    ranks = [categories[:number].count(category) for number, category in enumerate(categories)]
    return torch.tensor(sorted(range(len(categories)), key=ranks.__getitem__)[:count])


def _answers(bench: Workbench, config: FitConfig, chosen: Tensor, views: Tensor) -> ShapeMetrics:
    """What a method makes of `views` (M, V) of shapes (M,): "points" (M, N, 3), "cd" and "fps_cd" (M,)."""
    test: LoadedSplit = bench.split(config, "test")  # at the size at which this network looks at images

    def take() -> ShapeMetrics:
        model = bench.network(config)
        images, truth = test.float_images(chosen, views), test.points[chosen]
        found = reconstruct(model, images, seed=SEED, settings=config.inference).points
        errors = {
            "cd": cloud_errors(found, truth).cd,
            "fps_cd": cloud_errors(thin_out(found, model.points), truth).cd,
        }
        return {"points": found.contiguous()} | {name: values.double() for name, values in errors.items()}

    settings = dataclasses.asdict(config.inference)
    key = ["reconstructions", bench.run_of(config).name, settings, chosen.tolist(), views.tolist()]
    return bench.kept([*key, SEED, test.fingerprint], take)


def _markdown(result: Mapping[str, Any]) -> str:
    names = list(result["mean"])
    given = ", ".join(f"{name} {n} image{'s' if n > 1 else ''}" for name, n in result["views_of"].items())
    head = (
        f"{len(result['shapes'])} held-out shapes, profile `{result['profile']}`, seed {result['seed']}; images given: "
        f"{given}. Chamfer distance to the truth, un-squared, x100; in brackets after thinning to the size of one "
        "prediction."
    )

    def cells(errors: Mapping[str, Mapping[str, float]]) -> list[str]:
        return [f"{errors[name]['cd']:.2f} ({errors[name]['fps_cd']:.2f})" for name in names]

    rows = [[f"{each['category']} `{shape}`", *cells(each)] for shape, each in result["shapes"].items()]
    rows.append(["mean", *cells(result["mean"])])
    return "\n".join([head, "", *table_lines(["", *names], rows), ""])


def _figure(
    bench: Workbench, result: Mapping[str, Any], truth: Tensor, clouds: Mapping[str, Tensor], views: Tensor
) -> Figure:
    """Two rows for each shape: from the first image's side above, from behind below."""
    figure, panels = figures.grid(rows=2 * len(truth), columns=3 + len(clouds))
    for row, (name, errors) in enumerate(result["shapes"].items()):
        upper, lower = pair = panels[2 * row : 2 * row + 2]
        shape = read_shape(bench.scored_tree, name)
        images, cameras = figures.close_up(shape.images, shape.camera, shape.points)
        first = cameras[int(views[row, 0])]
        for axes in pair[:, :2].flat:
            figures.bare(axes)
        shown = views[row, :_SHOWN_VIEWS].tolist()
        for axes, view in zip(pair[:, :2].flat, shown, strict=False):
            figures.draw_image(axes, images[view])
        figures.caption(upper[0], f"{errors['category']}, the first image")
        for line, camera in zip(pair, (first, figures.from_behind(first)), strict=True):
            for axes, points in zip(line[2:], clouds.values(), strict=False):
                figures.draw_cloud(axes, points[row], camera)
            figures.draw_cloud(line[-1], truth[row], camera, colours=figures.TRUE)
        for axes, method in zip(lower[2:], clouds, strict=False):
            figures.caption(axes, f"CD {errors[method]['cd']:.2f}, FPS-CD {errors[method]['fps_cd']:.2f}")
    methods = [f"{name}, {n} image{'s' if n > 1 else ''}" for name, n in result["views_of"].items()]
    figures.titles(panels, ["some of the images", "", *methods, "the true shape"])
    figures.headline(
        figure,
        f"Held-out shapes, profile {result['profile']}, seed {result['seed']}, {result['views']} images of each; "
        "from the first image's side and from behind; chamfer distance x100",
    )
    return figure
