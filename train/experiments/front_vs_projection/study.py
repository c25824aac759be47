"""Front constraint or projection loss? Free clouds fitted to depth maps by every loss, from one view to twenty-four;
and networks that learn by each of them.

OUT/front-vs-projection.json, .md, .png         what was found: all numbers, tables, curves of the free clouds
OUT/front-vs-projection-clouds.png, .gif        the clouds of one shape on their way
OUT/front-vs-projection-networks.png            curves of the networks
OUT/front-vs-projection-predictions.png         what they predict
OUT/free-clouds/*.json, OUT/runs, OUT/scores    one fit or training each: a study that was stopped goes on where it was
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from train.errors import UserError
from train.experiments.front_vs_projection import networks_page, page
from train.experiments.front_vs_projection.free_clouds import LOSSES, Fit, fit_cloud
from train.experiments.front_vs_projection.networks import examples, study
from train.experiments.front_vs_projection.shapes import (
    EMBEDDED,
    Cameras,
    Scene,
    StudyShape,
    embedded_shape,
    shapes_of,
)
from train.experiments.workbench import Workbench
from train.files import kept, write_text
from train.show import figures

SETTINGS = tuple(Cameras(n) for n in (1, 2, 4, 8)) + tuple(Cameras(n, sphere=True) for n in (8, 24))
RATES = (0.003, 0.01, 0.03)
_TUNED_ON = (SETTINGS[0], SETTINGS[4])
_EMD_VIEWS = 1
"""The assignment of a cloud that is nowhere near takes most of a second a view: it is raced where there is one."""


class Cell(NamedTuple):
    """One fit of the study."""

    shape: str
    cameras: Cameras
    loss: str
    seed: int

    @property
    def file(self) -> str:
        return f"{self.shape}-{self.cameras.name.replace(' ', '-')}-{self.loss}-seed{self.seed}.json"


def front_vs_projection(bench: Workbench) -> dict[str, Any]:
    """The whole study: free clouds on all of the bench's data, and networks on its data trees, if there are any.

    Returns:
        What front-vs-projection.json holds; "networks" is what `networks.study` found.
    """
    found = run(
        bench.data,
        bench.out,
        seeds=bench.seeds,
        limit=bench.limit,
        iterations=bench.steps,
        progress=bench.progress,
    )
    trained = bench.on_trees()
    if not trained.data:
        print("no data tree among --data: the networks are left out", file=sys.stderr)
        return found
    found["networks"] = study(trained)
    write_text(bench.out / "front-vs-projection.json", json.dumps(found, indent=1) + "\n")
    tables = page.markdown(found), networks_page.markdown(found["networks"])
    write_text(bench.out / "front-vs-projection.md", "\n".join(tables))
    figures.save(networks_page.curves(found["networks"]), bench.out / "front-vs-projection-networks.png")
    drawn = networks_page.predictions(examples(trained))
    figures.save(drawn, bench.out / "front-vs-projection-predictions.png")
    return found


def run(
    data: Sequence[Path],
    out: Path,
    *,
    seeds: int = 3,
    limit: int | None = None,
    iterations: int | None = None,
    progress: bool = True,
    settings: Sequence[Cameras] = SETTINGS,
) -> dict[str, Any]:
    """Fits every cloud that has not been fitted yet, then writes tables, figures and an animation into `out`.

    Args:
        data: data trees and sources of meshes; see `shapes.shapes_of`. Embedded shapes take part in any case.
        out: directory to write to.
        seeds: random starts and turns of the cameras, for every shape.
        limit: shapes of each kind: embedded, meshes, and each tree; 2 if not given.
        iterations: of every fit; 200 if not given.
        progress: show a bar.
        settings: where the cameras stand.

    Returns:
        What front-vs-projection.json holds.

    Raises:
        UserError: unusable data, or numbers out of range.
    """
    limit, iterations = limit or 2, iterations or 200
    if iterations < 20:
        raise UserError(f"a fit of {iterations} steps goes nowhere; take at least 20")
    if not 1 <= limit <= len(EMBEDDED) or seeds < 1:
        raise UserError(f"--limit must be 1 to {len(EMBEDDED)} and --seeds at least 1; got {limit}, {seeds}")
    shapes = [embedded_shape(category) for category in EMBEDDED[:limit]]
    shapes += shapes_of(data, limit=limit)
    doubles = {s.name for s in shapes if [t.name for t in shapes].count(s.name) > 1}
    if doubles:
        raise UserError(f"two shapes of --data are called {', '.join(sorted(doubles))}; leave one source out")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the tensors are so small that torch's threads would wait more than they work
    try:
        study = _Study(out / "free-clouds", iterations, progress)
        rates = study.tune(settings)
        results = study.fit_all(shapes, settings, range(seeds), rates)
        found = page.summarise(results, shapes, iterations=iterations, rates=rates, seeds=seeds)
        write_text(out / "front-vs-projection.json", json.dumps(found, indent=1) + "\n")
        write_text(out / "front-vs-projection.md", page.markdown(found))
        page.draw(found, shapes[0], out, iterations=iterations, rates=rates)
    finally:
        torch.set_num_threads(threads)
    return found


class _Study:
    """Fits that are made once and read afterwards."""

    def __init__(self, folder: Path, iterations: int, progress: bool) -> None:
        self.folder, self.iterations, self.progress = folder, iterations, progress

    def tune(self, settings: Sequence[Cameras]) -> dict[str, float]:
        """The best step size of each loss, on a shape that is not in the study.

        Judged by the visible part's error, geometric mean over one view and 8 on the sphere.
        """
        shape = embedded_shape("bench", seed=1)
        among = [cameras for cameras in _TUNED_ON if cameras in settings] or list(settings[:1])
        rates = {}
        for name in tqdm(LOSSES, desc="step sizes", unit="loss", disable=not self.progress):
            own = [cameras for cameras in among if takes_part(name, cameras)] or among[:1]
            errors = []
            for rate in RATES:
                cells = [Cell(f"tuning_{rate:g}_{shape.name}", cameras, name, 0) for cameras in own]
                found = [self._result(cell, shape.scene(cell.cameras, seed=0), rate) for cell in cells]
                errors.append(sum(np.log(result["visible_cd"]) for result in found))
            rates[name] = RATES[int(np.argmin(errors))]
        return rates

    def fit_all(
        self,
        shapes: Sequence[StudyShape],
        settings: Sequence[Cameras],
        seeds: Sequence[int],
        rates: dict[str, float],
    ) -> list[dict[str, Any]]:
        """A record of every fit; the first seed of all shapes first."""
        records = []
        jobs = list(self._cells(shapes, settings, seeds))
        for shape, cell in tqdm(jobs, desc="free clouds", unit="fit", disable=not self.progress):
            scene = shape.scene(cell.cameras, seed=cell.seed)
            if scene is not None:
                place = {
                    "shape": shape.name,
                    "cameras": cell.cameras.name,
                    "loss": cell.loss,
                    "seed": cell.seed,
                }
                records.append(place | self._result(cell, scene, rates[cell.loss]))
        return records

    @staticmethod
    def _cells(
        shapes: Sequence[StudyShape], settings: Sequence[Cameras], seeds: Sequence[int]
    ) -> Iterator[tuple[StudyShape, Cell]]:
        for seed in seeds:
            for shape in shapes:
                for cameras in settings:
                    for name in LOSSES:
                        if takes_part(name, cameras):
                            yield shape, Cell(shape.name, cameras, name, seed)

    def _result(self, cell: Cell, scene: Scene | None, rate: float) -> dict[str, Any]:
        """A finished fit is read, if it is of the same scene and settings; others are made."""
        assert scene is not None
        key = {"iterations": self.iterations, "rate": rate, "scene": _digest(scene)}

        def fit() -> dict[str, Any]:
            return _record(fit_cloud(scene, LOSSES[cell.loss], iterations=self.iterations, rate=rate))

        return kept(self.folder / cell.file, key, fit)


def takes_part(loss: str, cameras: Cameras) -> bool:
    """Is a loss measured with these cameras?"""
    return loss != "front_emd" or cameras.count <= _EMD_VIEWS


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


def _digest(scene: Scene) -> str:
    parts = (scene.depth, scene.camera.cam_from_world, scene.surface, scene.start)
    return hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in parts)).hexdigest()[:16]
