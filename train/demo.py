"""The demo: data, training, evaluation, reconstruction and a report, with the functions behind the commands."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from train.config import FitConfig, scaled
from train.data import ShapeTree
from train.data.procedural import generate
from train.data.tree_files import render_folder
from train.evaluation.evaluate import evaluate
from train.evaluation.examples import report_run
from train.evaluation.reconstruct import reconstruct_to_files
from train.evaluation.runs import best_weights
from train.files import write_text
from train.methods import recipe
from train.training.trainer import fit

# Two fifths of the profile's steps: about six minutes on two cores, and enough for more views to lower the error.
DEMO_CONFIG = scaled(recipe("ours", "cpu"), 0.4)
_RENDER_SIZE = 112
_CATEGORIES = ("chair", "display")  # learnt in so short a training


def demo(
    out: str | Path,
    *,
    shapes: int = 400,
    seed: int = 0,
    config: FitConfig = DEMO_CONFIG,
    progress: bool = True,
) -> Path:
    """Runs the whole chain on generated shapes; a second call continues where the first was stopped.

    Args:
        out: directory to write to: data/, run/, reconstruction/, figures/ and report.html.
        shapes: number of generated chairs and displays in all splits together.
        seed: of data and examples.
        config: the training's configuration.
        progress: show progress bars.

    Returns:
        The report, out/report.html.

    Raises:
        UserError: `out` holds a demo with other settings, or other files.
        KeyboardInterrupt: training was stopped, after it saved its state.
    """
    out = Path(out)
    data, run = out / "data", out / "run"
    clock = _Clock(out / "times.json")

    with clock.phase("data", f"1/5 {shapes} shapes with more than one possible back -> {data}"):
        print(generate(data, shapes=shapes, categories=_CATEGORIES, seed=seed, size=_RENDER_SIZE).summary())

    with clock.phase("training", f"2/5 training, {sum(s.steps for s in config.stages)} steps -> {run}"):
        finished = fit(data, run, config, resume=(run / "config.json").exists(), progress=progress)
        if not finished:
            raise KeyboardInterrupt

    with clock.phase("evaluation", "3/5 evaluation on shapes that were not used for training"):
        if not _up_to_date(run):
            evaluate(run, data, progress=progress)

    test = ShapeTree(data, "test")
    images = sorted(render_folder(data, test.ids[0]).glob("render_*.png"))
    with clock.phase(
        "reconstruction",
        f"4/5 reconstruction of one of them from {len(images)} images -> {out / 'reconstruction'}",
    ):
        reconstruct_to_files(run, images, out / "reconstruction", seed=seed)

    with clock.phase("report", "5/5 the report"):
        page = report_run(out, run=run, data=data, seconds=clock.seconds, seed=seed)
    print(f"\nDone in {sum(clock.seconds.values()) / 60:.1f} minutes. Open {page} in a browser.")
    return page


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
