"""What is shown: pages that open offline, figures that draw what they are given, and the demo's report."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from diffpoint import PinholeCamera, project
from train.data import ShapeTree
from train.demo import DEMO_CONFIG, demo
from train.errors import UserError
from train.evaluation.examples import make_example, report_run
from train.evaluation.runs import load_generator, read_metrics
from train.methods import recipe
from train.show import figures, pages
from train.show.pages import write_reconstruction_page

_SMOKE = recipe("ours", "smoke")
LOADED_FROM_ELSEWHERE = re.compile(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""")


def _embedded_images(page: str) -> list[np.ndarray]:
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    return [imageio.imread(io.BytesIO(base64.b64decode(data))) for data in found]


def _cameras(count: int, *, size: int = 32, focal_px: float = 60.0) -> PinholeCamera:
    angle = torch.arange(count) * 2 * torch.pi / count
    eyes = torch.stack((2 * angle.sin(), torch.full((count,), 0.5), 2 * angle.cos()), -1)
    return PinholeCamera.look_at(eyes, focal_px=focal_px, height=size, width=size)


@pytest.fixture
def example() -> figures.Example:
    torch.manual_seed(0)
    cloud = torch.rand(200, 3) * 0.5 - 0.25
    return figures.Example(
        images=torch.rand(5, 3, 32, 32),
        camera=_cameras(5),
        chosen=3,
        predictions=torch.rand(4, 100, 3) - 0.5,
        reconstruction=torch.rand(500, 3) - 0.5,
        target=cloud,
    )


def test_the_reconstruction_page_holds_images_and_points_and_needs_no_network(tmp_path: Path):
    images, points = torch.rand(3, 3, 8, 10), torch.rand(50, 3) - 0.5
    path = tmp_path / "page.html"
    write_reconstruction_page(path, images, points, title="A <b>chair</b>", subtitle="3 images & 50 points")
    page = path.read_text()

    own_part = page[
        page.rindex("</head>") :
    ]  # plotly's library, in the head, has pictures and links of its own
    shown = _embedded_images(own_part)
    assert [picture.shape[:2] for picture in shown] == [(8, 10)] * 3
    wanted = (images[1].permute(1, 2, 0) * 255).numpy()
    assert np.abs(shown[1][..., :3].astype(float) - wanted).max() <= 1

    assert "A &lt;b&gt;chair&lt;/b&gt;" in page
    assert "<b>chair" not in page
    assert "3 images &amp; 50 points" in page
    assert own_part.count("Plotly.newPlot(") == 1
    assert len(page) > 1_000_000, "plotly's library is inside"
    assert '"aspectmode":"data"' in page
    assert '"up":{"x":0,"y":1,"z":0}' in page
    assert not LOADED_FROM_ELSEWHERE.search(own_part)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_page_without_a_cloud_is_light():
    assert len(pages.page("title", [pages.paragraph("a < b"), pages.listing("x & y")])) < 5_000


def test_a_page_replaces_an_older_one_and_is_never_half_written(tmp_path: Path):
    path = tmp_path / "page.html"
    path.write_text("older")
    with pytest.raises(ValueError, match="unpack"):
        write_reconstruction_page(path, torch.rand(1, 3, 4, 4), torch.rand(5, 2), title="broken")
    assert path.read_text() == "older"
    write_reconstruction_page(path, torch.rand(1, 3, 4, 4), torch.rand(5, 3), title="whole")
    assert "whole" in path.read_text()
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]


def test_from_behind_is_the_same_height_on_the_other_side():
    camera = _cameras(5)[2]
    x, y, z = camera.position.tolist()
    behind = figures.from_behind(camera).position
    torch.testing.assert_close(behind, torch.tensor([-x, y, -z]))
    origin = project(torch.zeros(1, 1, 3), figures.from_behind(camera)).pixels[0, 0, 0]
    torch.testing.assert_close(origin, torch.tensor([16.0, 16.0]))


def test_a_close_up_keeps_the_object_and_every_pixel_of_it(example: figures.Example):
    small = example.target * 0.5
    images, camera = figures.close_up(example.images, example.camera, small)
    cut = (32 - camera.width) // 2
    assert 4 <= cut < 16
    torch.testing.assert_close(images, example.images[..., cut : 32 - cut, cut : 32 - cut])
    before, after = project(small[None], example.camera).pixels, project(small[None], camera).pixels
    torch.testing.assert_close(after, before - cut)
    assert after.min() > 0
    assert after.max() < camera.width


def test_a_close_up_of_what_fills_the_frame_cuts_nothing(example: figures.Example):
    images, camera = figures.close_up(example.images, example.camera, example.target * 4)
    assert images.shape == example.images.shape
    assert (camera.height, camera.width) == (32, 32)


def test_mosaic_lays_images_out_in_rows():
    images = torch.arange(5.0).div(10)[:, None, None, None].expand(5, 3, 2, 4)
    sheet = figures.mosaic(images)
    assert sheet.shape == (3, 4, 12)
    assert sheet[0, ::2, ::4].flatten().tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 1.0])


def test_near_points_are_drawn_last_larger_and_darker():
    camera = PinholeCamera.look_at((0, 0, 2), focal_px=10.0, height=8, width=8)
    axes = Figure().subplots()
    figures.draw_cloud(axes, torch.tensor([[0.0, 0, 0.4], [0.1, 0, -0.4], [0.0, 0, 3.0]]), camera)
    drawn = axes.collections[0]
    offsets, sizes, colours = np.asarray(drawn.get_offsets()), drawn.get_sizes(), drawn.get_facecolors()
    assert len(offsets) == 2, "what is behind the camera is not seen"
    assert offsets[-1] == pytest.approx([4.0, 4.0])
    assert sizes[1] > sizes[0]
    assert colours[1, :3].sum() < colours[0, :3].sum()


def test_figures_are_written_and_leave_no_window_behind(example: figures.Example, tmp_path: Path):
    drawn = {
        "predictions": figures.predictions_figure(example),
        "reconstruction": figures.reconstruction_figure(example),
        "overview": figures.overview_figure([example, example]),
    }
    for name, figure in drawn.items():
        figures.save(figure, tmp_path / "new" / f"{name}.png")
        picture = imageio.imread(tmp_path / "new" / f"{name}.png")
        assert picture.std() > 5
    assert len(list((tmp_path / "new").iterdir())) == 3
    assert [len(figure.axes) for figure in drawn.values()] == [12, 5, 28]
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or pyplot.get_fignums() == []


def test_curves_show_each_stage_and_survive_a_run_that_has_barely_begun():
    records = [
        {"step": s, "stage": 1 + s // 60, "front": 30.0 - s / 4, "diversity": 1.0, "val_cd": 8.0}
        for s in range(1, 101)
    ]
    for record in records[::20]:
        record |= {"image_sensitivity": 5.0, "code_sensitivity": 4.0, "dead_share": 0.1}
        record |= {"real_score": 2.0, "fake_score": 0.5}
    before = [{"step": -s, "stage": 0, "cd": 20.0 + s} for s in range(10, 0, -1)]
    panels = figures.curves_figure([*before, *records]).axes
    assert [line.get_xdata()[[0, -1]].tolist() for line in panels[0].lines] == [[1, 59]] * 2
    assert [line.get_xdata()[[0, -1]].tolist() for line in panels[1].lines] == [[60, 100]]
    mean = panels[0].lines[1].get_ydata()
    assert mean[30] == pytest.approx(30 - 31 / 4, abs=0.2), "the running mean follows the curve"
    assert set(panels[6].lines[0].get_ydata()) == {-1.5}
    assert list(panels[7].lines[0].get_ydata()) == [record["cd"] for record in before]
    assert len(figures.curves_figure([]).axes) == 8


def test_errors_figure_shows_the_table():
    def rows(*values: float):
        return {str(n): {"cd": value} for n, value in zip((1, 2, 4), values, strict=True)}

    result = {
        "views": rows(7, 6, 5),
        "random_codes": rows(7, 5.5, 4.5),
        "nearest_image": rows(5, 4, 4),
        "medoid": {"cd": 8.0},
    }
    lines = figures.errors_figure(result).axes[0].lines
    assert [list(line.get_ydata()) for line in lines] == [[7, 6, 5], [7, 5.5, 4.5], [5, 4, 4], [8, 8]]


# --- the demo and its report


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo that was stopped in the middle of training and called again."""
    out = tmp_path_factory.mktemp("demo") / "out"
    watch = threading.Thread(target=_stop_training, args=(out / "run" / "metrics.jsonl",), daemon=True)
    watch.start()
    with pytest.raises(KeyboardInterrupt):
        demo(out, shapes=8, seed=3, config=_SMOKE, progress=False)
    watch.join()
    assert json.loads((out / "times.json").read_text())["finished"] == ["first look", "data"]
    assert not (out / "run" / "evaluation.json").exists()
    first = (out / "report.html").read_text()
    assert "The weights that come with the repository" in first
    assert "How was it trained?" not in first

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
        noun = "view" if n == "1" else "views"
        figures = "".join(
            f"<td>{scores[name]:.2f}</td>" for name in ("gt_to_pred", "pred_to_gt", "cd", "fps_cd")
        )
        assert f"<td>generator, {n} {noun}</td>{figures}" in body
        assert f"<td>nearest by image, {n} {noun}</td><td>-</td><td>-</td><td>{other['cd']:.2f}</td>" in body
    assert f"<td>medoid of train</td><td>-</td><td>-</td><td>{result['medoid']['cd']:.2f}</td>" in body
    assert "<td>total</td>" in body
    assert f"changes by {result['sensitivity']['image']:.2f}" in body
    assert "&quot;diversity_images&quot;: 2" in body
    assert body.count("Plotly.newPlot(") == 2
    written = sorted(path.stem for path in (finished / "figures").glob("*.png"))
    examples = range(1, 1 + min(3, result["data"]["shapes"]))
    numbered = [f"{kind}_{i}" for kind in ("predictions", "reconstruction") for i in examples]
    assert written == sorted(["overview", "errors", "curves", *numbered])
    of_shipped_weights = 2  # the overview of unseen shapes, and the photographs
    assert body.count("data:image/png;base64") == len(written) + of_shipped_weights
    assert body.index("The weights that come with the repository") < body.index(
        "A small network, trained here"
    )
    explorers = re.findall(r'<a href="(shipped/explore-[a-z]+\.html)">', body)
    assert len(explorers) == 3
    for address in explorers:
        assert "Plane of codes" in (finished / address).read_text()
    assert not LOADED_FROM_ELSEWHERE.search(body)


def test_the_demo_leaves_what_the_commands_leave(finished: Path):
    assert load_generator(finished / "run").profile == "smoke"
    assert (finished / "reconstruction" / "reconstruction.ply").stat().st_size > 0
    assert (finished / "reconstruction" / "reconstruction.html").stat().st_size > 0
    times = json.loads((finished / "times.json").read_text())
    assert times["finished"] == [
        "first look", "data", "training", "evaluation", "reconstruction", "report",
    ]  # fmt: skip
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
    kept_section = finished / "shipped" / "section.json"
    written = kept_section.stat().st_mtime_ns
    (finished / "report.html").unlink()
    demo(finished, shapes=8, seed=3, config=_SMOKE, progress=False)
    assert (finished / "report.html").exists()
    assert [(path.read_bytes(), path.stat().st_mtime_ns) for path in kept[:3]] == before
    assert kept[3].read_bytes() == seconds
    assert kept_section.stat().st_mtime_ns == written


def test_photographs_are_shown_with_what_they_leave_open():
    clouds = torch.rand(3, 40, 3) - 0.5
    one = figures.Photographed("a car", torch.rand(1, 3, 32, 32), clouds, clouds[0])
    figure = figures.photographs_figure([one, one])
    found = [axes.get_title() for axes in figure.axes[:5]]
    assert found == ["pictures", "code 1", "code 2", "code 3", "code 1, from behind"]
    several = figures.Photographed("a ship", torch.rand(2, 3, 32, 32), clouds, clouds.flatten(0, 1), "agreed")
    figure = figures.photographs_figure([one, several])
    assert [axes.get_title() for axes in figure.axes[5:7]] == ["from all pictures", "from behind"]
    words = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert words == ["a car", "a ship", "agreed"]


def test_other_settings_in_the_same_directory_are_refused(finished: Path):
    with pytest.raises(UserError, match="seed"):
        demo(finished, shapes=8, seed=4, config=_SMOKE, progress=False)
    other = dataclasses.replace(_SMOKE, seed=1)
    with pytest.raises(UserError, match="other values of seed"):
        demo(finished, shapes=8, seed=3, config=other, progress=False)


def test_a_report_without_an_evaluation_says_what_to_run(tmp_path: Path, tiny_data: Path):
    with pytest.raises(UserError, match="python -m train evaluate"):
        report_run(tmp_path, run=tmp_path, data=tiny_data)
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
    assert DEMO_CONFIG.recipe == "whole-shapes"
    assert 400 < sum(stage.steps for stage in DEMO_CONFIG.stages) < 4_000
