"""The demo ends with a report that holds what the run found, and a second call does no work twice."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from train.data import ShapeTree
from train.demo import DEMO_CONFIG, demo
from train.errors import UserError
from train.evaluation.report import make_example, write_report
from train.evaluation.runs import load_generator, read_metrics
from train.methods import recipe

_SMOKE = recipe("ours", "smoke")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo that was stopped in the middle of training and called again."""
    out = tmp_path_factory.mktemp("demo") / "out"
    watch = threading.Thread(target=_stop_training, args=(out / "run" / "metrics.jsonl",), daemon=True)
    watch.start()
    with pytest.raises(KeyboardInterrupt):
        demo(out, shapes=8, seed=3, config=_SMOKE, progress=False)
    watch.join()
    assert json.loads((out / "times.json").read_text())["finished"] == ["data"]
    assert not (out / "run" / "evaluation.json").exists()
    assert not (out / "report.html").exists()

    page = demo(out, shapes=8, seed=3, config=_SMOKE, progress=False)
    assert page == out / "report.html"
    assert len(read_metrics(out / "run")) == 70
    return out


def _stop_training(metrics: Path) -> None:
    """Asks this process to end, as a user would, as soon as training has logged a step."""
    while not (metrics.exists() and metrics.stat().st_size):
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGTERM)


def test_the_report_holds_table_figures_configuration_and_clouds(finished: Path):
    page = (finished / "report.html").read_text()
    body = page[page.rindex("</head>") :]
    result = json.loads((finished / "run" / "evaluation.json").read_text())
    for n in ("1", "2", "4", "8"):
        scores, other = result["views"][n], result["nearest_image"][n]
        noun = "image" if n == "1" else "images"
        figures = "".join(
            f"<td>{scores[name]:.2f}</td>" for name in ("gt_to_pred", "pred_to_gt", "cd", "fps_cd")
        )
        assert f"<td>generator, {n} {noun}</td>{figures}" in body
        assert f"<td>nearest by image, {n} {noun}</td><td>-</td><td>-</td><td>{other['cd']:.2f}</td>" in body
    assert f"<td>most typical shape</td><td>-</td><td>-</td><td>{result['medoid']['cd']:.2f}</td>" in body
    assert f"moves by {result['sensitivity']['image']:.2f}" in body
    assert "&quot;diversity_images&quot;: 2" in body
    assert body.count("Plotly.newPlot(") == 2
    written = sorted(path.stem for path in (finished / "figures").glob("*.png"))
    examples = range(1, 1 + min(3, result["data"]["shapes"]))
    numbered = [f"{kind}_{i}" for kind in ("predictions", "reconstruction") for i in examples]
    assert written == sorted(["overview", "errors", "curves", *numbered])
    assert body.count("data:image/png;base64") == len(written)
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", body)


def test_the_demo_leaves_what_the_commands_leave(finished: Path):
    assert load_generator(finished / "run").profile == "smoke"
    assert (finished / "reconstruction" / "reconstruction.ply").stat().st_size > 0
    assert (finished / "reconstruction" / "reconstruction.html").stat().st_size > 0
    times = json.loads((finished / "times.json").read_text())
    assert times["finished"] == ["data", "training", "evaluation", "reconstruction", "report"]
    assert all(value > 0 for value in times["seconds"].values())
    assert not list(finished.rglob(".*.tmp"))


def test_a_second_call_reuses_what_is_there(finished: Path):
    kept = [
        finished / "run" / "evaluation.json",
        finished / "run" / "checkpoints" / "best-stage2.safetensors",
        next((finished / "data" / "pcdata_2048").rglob("*.ply")),
        finished / "times.json",
    ]
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in kept[:3]]
    seconds = kept[3].read_bytes()
    (finished / "report.html").unlink()
    demo(finished, shapes=8, seed=3, config=_SMOKE, progress=False)
    assert (finished / "report.html").exists()
    assert [(path.read_bytes(), path.stat().st_mtime_ns) for path in kept[:3]] == before
    assert kept[3].read_bytes() == seconds


def test_other_settings_in_the_same_directory_are_refused(finished: Path):
    with pytest.raises(UserError, match="seed"):
        demo(finished, shapes=8, seed=4, config=_SMOKE, progress=False)
    other = dataclasses.replace(_SMOKE, seed=1)
    with pytest.raises(UserError, match="other values of seed"):
        demo(finished, shapes=8, seed=3, config=other, progress=False)


def test_a_report_without_an_evaluation_says_what_to_run(tmp_path: Path, tiny_data: Path):
    with pytest.raises(UserError, match="python -m train evaluate"):
        write_report(tmp_path, run=tmp_path, data=tiny_data)
    assert list(tmp_path.iterdir()) == []


def test_an_example_is_predicted_from_the_front(smoke_run: Path, tiny_data: Path):
    model, shape = load_generator(smoke_run), ShapeTree(tiny_data, "train")[0]
    example = make_example(model, shape, _SMOKE, seed=5)
    ahead = shape.camera.position @ torch.tensor([0.0, 0.0, 1.0])
    assert ahead[example.chosen] == ahead.max()
    codes = torch.randn(4, 1, model.code_dim, generator=torch.Generator().manual_seed(5))
    image = shape.images[example.chosen][None]
    torch.testing.assert_close(example.predictions, model(image, codes)[:, 0])
    assert len(example.reconstruction) == len(shape.images) * model.points


def test_the_demo_recipe_is_the_cpu_profile_cut_short():
    assert DEMO_CONFIG.profile == "cpu"
    assert 1_000 < sum(stage.steps for stage in DEMO_CONFIG.stages) < 4_000
