"""Front constraint against projection losses: free clouds fitted to depth maps by every loss, from one view to
twenty-four; and networks trained with each of them.

OUT/front-vs-projection.json, .md, .png         all numbers, tables, curves of the free clouds
OUT/front-vs-projection-clouds.png, .gif        the clouds of one shape during the fit
OUT/front-vs-projection-networks.png            validation curves of the networks
OUT/front-vs-projection-predictions.png         predictions of the networks
OUT/free-clouds/*.json, OUT/runs, OUT/metrics   one fit, training or measurement each: a stopped study continues there
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from train.errors import UserError
from train.experiments.frame import Experiment, Outcome
from train.experiments.front_vs_projection import networks, networks_page, page
from train.experiments.front_vs_projection.free_clouds import LOSSES, Fit, fit_cloud
from train.experiments.front_vs_projection.shapes import (
    EMBEDDED,
    Cameras,
    Scene,
    StudyShape,
    embedded_shape,
    shapes_of,
)
from train.experiments.study import Study
from train.files import kept
from train.processes import progress_bar

SETTINGS = tuple(Cameras(n) for n in (1, 2, 4, 8)) + tuple(Cameras(n, sphere=True) for n in (8, 24))
RATES = (0.003, 0.01, 0.03)
_TUNED_ON = (SETTINGS[0], SETTINGS[4])
_EMD_VIEWS = 1
"""The assignment of a cloud that is far from its target takes most of a second per view: it is measured with one
view."""
_ITERATIONS, _LEAST_ITERATIONS = 200, 20
_SHAPES = 2


class Cell(NamedTuple):
    """One fit of the study."""

    shape: str
    cameras: Cameras
    loss: str
    seed: int

    @property
    def file(self) -> str:
        return f"{self.shape}-{self.cameras.name.replace(' ', '-')}-{self.loss}-seed{self.seed}.json"


def make(study: Study) -> Outcome:
    """Free clouds on all of the study's data, and networks on its data trees, if there are any.

    `study.limit` is the number of shapes of each kind (procedural, meshes, each tree), `study.steps` that of
    iterations and of training steps.
    """
    found, drawn = free_clouds(study)
    trees = study.on_trees()
    if not trees.data:
        print("no data tree among --data: the networks are left out", file=sys.stderr)
        return Outcome(found, page.markdown(found), drawn)
    found["networks"] = networks.summarise(trees)
    drawn["-networks"] = networks_page.curves(found["networks"])
    drawn["-predictions"] = networks_page.predictions(*networks.examples(trees))
    return Outcome(found, "\n".join((page.markdown(found), networks_page.markdown(found["networks"]))), drawn)


front_vs_projection = Experiment(make, networks.configs)


def free_clouds(
    study: Study, settings: Sequence[Cameras] = SETTINGS
) -> tuple[dict[str, Any], dict[str, Figure]]:
    """Fits every cloud that has not been fitted yet; writes the animation.

    Args:
        study: its data are data trees and sources of meshes, see `shapes.shapes_of`; procedural shapes take part
            always. Its seeds draw start clouds and turns of the cameras.
        settings: where the cameras are.

    Returns:
        All numbers, and figures by the ending of their files.

    Raises:
        UserError: unusable data, or numbers out of range.
    """
    limit, iterations = study.limit or _SHAPES, study.steps or _ITERATIONS
    if iterations < _LEAST_ITERATIONS:
        raise UserError(f"a fit needs at least --steps {_LEAST_ITERATIONS}; got {iterations}")
    if limit > len(EMBEDDED):
        raise UserError(f"--limit must be at most {len(EMBEDDED)}; got {limit}")
    shapes = [embedded_shape(category) for category in EMBEDDED[:limit]]
    shapes += shapes_of(study.data, limit=limit)
    names = [shape.name for shape in shapes]
    if doubles := {name for name in names if names.count(name) > 1}:
        raise UserError(f"two shapes of --data are called {', '.join(sorted(doubles))}; leave one source out")
    with _one_thread():
        rates = _tune(study, settings, iterations)
        fits = _fit_all(study, shapes, settings, rates, iterations)
        found = page.summarise(fits, shapes, iterations=iterations, rates=rates, seeds=study.seeds)
        return found, page.draw(found, shapes[0], study.out, iterations=iterations, rates=rates)


@contextmanager
def _one_thread() -> Iterator[None]:
    """The tensors are so small that torch's threads would wait more than they work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _tune(study: Study, settings: Sequence[Cameras], iterations: int) -> dict[str, float]:
    """The best step size of each loss, on a shape that is not in the study.

    By the error of the visible part, geometric mean over one view and 8 on the sphere.
    """
    shape = embedded_shape("bench", seed=1)
    available = [cameras for cameras in _TUNED_ON if cameras in settings] or list(settings[:1])
    rates = {}
    for name in progress_bar(LOSSES, title="step sizes", unit="loss", progress=study.progress):
        own = [cameras for cameras in available if takes_part(name, cameras)] or available[:1]
        errors = []
        for rate in RATES:
            cells = [Cell(f"tuning_{rate:g}_{shape.name}", cameras, name, 0) for cameras in own]
            found = [_fit(study, cell, shape.scene(cell.cameras, seed=0), rate, iterations) for cell in cells]
            errors.append(sum(np.log(each["visible_cd"]) for each in found))
        rates[name] = RATES[int(np.argmin(errors))]
    return rates


def _fit_all(
    study: Study,
    shapes: Sequence[StudyShape],
    settings: Sequence[Cameras],
    rates: dict[str, float],
    iterations: int,
) -> list[dict[str, Any]]:
    """A record of every fit; the first seed of all shapes first."""
    cells = [
        (shape, Cell(shape.name, cameras, loss, seed))
        for seed in range(study.seeds)
        for shape in shapes
        for cameras in settings
        for loss in LOSSES
        if takes_part(loss, cameras)
    ]
    records = []
    for shape, cell in progress_bar(cells, title="free clouds", unit="fit", progress=study.progress):
        scene = shape.scene(cell.cameras, seed=cell.seed)
        if scene is not None:
            place = {**cell._asdict(), "cameras": cell.cameras.name}
            records.append(place | _fit(study, cell, scene, rates[cell.loss], iterations))
    return records


def takes_part(loss: str, cameras: Cameras) -> bool:
    """Is a loss measured with these cameras?"""
    return loss != "front_emd" or cameras.count <= _EMD_VIEWS


def _fit(study: Study, cell: Cell, scene: Scene | None, rate: float, iterations: int) -> dict[str, Any]:
    """A finished fit is read, if it is of the same scene and settings; others are made."""
    assert scene is not None
    parts = (scene.depth, scene.camera.cam_from_world, scene.surface, scene.start)
    digest = hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in parts)).hexdigest()[:16]
    key = {"iterations": iterations, "rate": rate, "scene": digest}

    def fit() -> dict[str, Any]:
        return _record(fit_cloud(scene, LOSSES[cell.loss], iterations=iterations, rate=rate))

    return kept(study.out / "free-clouds" / cell.file, key, fit)


def _record(fit: Fit) -> dict[str, Any]:
    return {
        **{name: round(value, 6) for name, value in fit.measures._asdict().items()},
        "sideways": round(fit.sideways, 6),
        "largest_sideways": fit.largest_sideways,
        "ms_per_iteration": round(fit.ms_per_iteration, 3),
        "first_loss": fit.losses[0],
        "last_loss": fit.losses[-1],
        "visible_cd_on_the_way": [round(value, 4) for value in fit.visible_cd],
    }
