"""The demo: what the shipped weights predict, then the whole chain from data to a report about a network of its own."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from train.config import FitConfig, scaled
from train.data import Shape, ShapeTree
from train.data.procedural import generate
from train.data.tree_files import SPLITS, render_folder
from train.device import CPU
from train.errors import UserError
from train.evaluation.evaluate import evaluate
from train.evaluation.examples import make_example, report_run
from train.evaluation.inference import predict
from train.evaluation.reconstruct import explore_to_file, read_pictures, reconstruct_to_files
from train.evaluation.runs import PRETRAINED, best_weights, open_run
from train.files import write_text
from train.methods import recipe
from train.show import figures, pages
from train.show.report import shipped_weights_section
from train.training.trainer import fit

# A sixth of the profile's steps: four to six minutes on two cores, and enough for more views to lower the error.
DEMO_CONFIG = scaled(recipe("ours", "cpu", "whole-shapes"), 0.16)
_RENDER_SIZE = 112
_CATEGORIES = ("chair", "display")  # learnt in so short a training

# Objects that the shipped weights have not seen: no data that they were trained on have this seed.
_UNSEEN_SEED = 1_000
_UNSEEN_CATEGORIES = ("chair", "sofa", "car", "table", "airplane", "loudspeaker")
_PHOTOGRAPHS = Path(__file__).parents[1] / "examples" / "photographs"
_CODES = 3


def demo(
    out: str | Path,
    *,
    shapes: int = 160,
    seed: int = 0,
    config: FitConfig = DEMO_CONFIG,
    progress: bool = True,
    device: torch.device = CPU,
) -> Path:
    """Shows the shipped weights, then runs the whole chain; a second call continues where the first was stopped.

    Args:
        out: directory to write to: shipped/, data/, run/, reconstruction/, figures/ and report.html, which is there
            after the first phase and rewritten after the last.
        shapes: number of generated chairs and displays in all splits together, each with its three backs.
        seed: of data and examples.
        config: the training's configuration.
        progress: show progress bars.
        device: where networks are trained and evaluated.

    Returns:
        The report, out/report.html.

    Raises:
        UserError: `out` holds a demo with other settings, or other files.
        KeyboardInterrupt: training was stopped, after it saved its state.
    """
    out = Path(out)
    data, run = out / "data", out / "run"
    clock = _Clock(out / "times.json")
    steps = sum(stage.steps for stage in config.stages)

    with clock.phase(
        "first look", "1/6 the weights that come with the repository, on objects they have not seen"
    ):
        section = _shipped_weights(out, seed=seed, device=device)
    print(f"Open {out / 'report.html'} in a browser; it is completed at the end.")

    with clock.phase("data", f"2/6 {shapes} objects with three possible backs each -> {data}"):
        made = generate(
            data, shapes=shapes, categories=_CATEGORIES, seed=seed, size=_RENDER_SIZE, variants=3, fronts=2
        )
        print(made.summary())

    with clock.phase("training", f"3/6 training a small network, {steps} steps -> {run}"):
        resume = (run / "config.json").exists()
        finished = fit(data, run, config, resume=resume, progress=progress, device=device)
        if not finished:
            raise KeyboardInterrupt

    with clock.phase("evaluation", "4/6 evaluation on shapes that were not used for training"):
        if not _up_to_date(run):
            evaluate(run, data, progress=progress, device=device)

    test = ShapeTree(data, "test")
    images = sorted(render_folder(data, test.ids[0]).glob("render_*.png"))
    with clock.phase(
        "reconstruction",
        f"5/6 reconstruction of one of them from {len(images)} images -> {out / 'reconstruction'}",
    ):
        reconstruct_to_files(run, images, out / "reconstruction", seed=seed, device=device)

    with clock.phase("report", "6/6 the report"):
        page = report_run(
            out, run=run, data=data, seconds=clock.seconds, seed=seed, first=section, device=device
        )
    print(f"\nDone in {sum(clock.seconds.values()) / 60:.1f} minutes. Open {page} in a browser.")
    return page


def _shipped_weights(out: Path, *, seed: int, device: torch.device) -> list[str]:
    """What the shipped weights predict, as a section of the report; also written as a page of its own at first.

    Pages to explore are written to out/shipped/.
    """
    kept = out / "shipped" / "section.json"
    if kept.exists():
        return json.loads(kept.read_text())
    try:
        model, config, _ = open_run(PRETRAINED, device=device)
    except UserError as error:  # a checkout without them
        print(f"note: left out: {error}", file=sys.stderr)
        return []
    data = out / "shipped" / "data"
    generate(
        data,
        shapes=len(_UNSEEN_CATEGORIES),
        categories=_UNSEEN_CATEGORIES,
        seed=_UNSEEN_SEED,
        size=_RENDER_SIZE,
    )
    unseen = [shape for split in SPLITS for shape in _shapes(data, split)]
    unseen.sort(key=lambda shape: _UNSEEN_CATEGORIES.index(shape.category))
    examples = [make_example(model, shape, config, seed=seed, codes=_CODES) for shape in unseen]
    photographed, links = [], {}
    for example, shape in zip(examples, unseen, strict=True):
        if shape.category in ("chair", "sofa"):
            front = render_folder(data, shape.id) / f"render_{example.chosen}.png"
            links[f"an unseen {shape.category}"] = _explorer(
                out, shape.category, front, seed=seed, device=device
            )
    for path in sorted(_PHOTOGRAPHS.glob("*.png")):
        picture = read_pictures([path])
        clouds = predict(model, picture[0], _CODES, seed=seed)
        photographed.append(figures.Photographed(path.stem, picture, clouds, clouds[0]))
        if path.stem == "sedan":
            links["the photograph of a car"] = _explorer(out, path.stem, path, seed=seed, device=device)
    section = shipped_weights_section(examples, photographed, links)
    page = pages.page(
        "What the shipped weights predict", section, subtitle="A small network of its own is next."
    )
    write_text(out / "report.html", page)
    write_text(kept, json.dumps(section))
    return section


def _shapes(data: Path, split: str) -> list[Shape]:
    try:
        return list(ShapeTree(data, split).iter_valid())
    except UserError:  # no shape of so few is in this split
        return []


def _explorer(out: Path, name: str, image: Path, *, seed: int, device: torch.device) -> str:
    """Writes the page to explore an image; returns its address relative to the report."""
    explore_to_file(PRETRAINED, [image], out / "shipped" / f"explore-{name}.html", seed=seed, device=device)
    return f"shipped/explore-{name}.html"


class _Clock:
    """Duration of each phase in seconds, until it was first finished, summed over all calls of the demo."""

    def __init__(self, path: Path) -> None:
        self._path = path
        known = json.loads(path.read_text()) if path.exists() else {"seconds": {}, "finished": []}
        self.seconds: dict[str, float] = known["seconds"]
        self._finished: list[str] = known["finished"]

    @contextmanager
    def phase(self, name: str, message: str) -> Iterator[None]:
        print(f"\n{message}", flush=True)
        begun, again = time.monotonic(), name in self._finished
        try:
            yield
            self._finished += [] if again else [name]
        finally:
            if not again:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - begun
            if self._path.parent.is_dir():
                write_text(
                    self._path, json.dumps({"seconds": self.seconds, "finished": self._finished}) + "\n"
                )


def _up_to_date(run: Path) -> bool:
    """Whether the run was evaluated after its last weights were written."""
    evaluation = run / "evaluation.json"
    return evaluation.exists() and evaluation.stat().st_mtime >= best_weights(run, 2).stat().st_mtime
