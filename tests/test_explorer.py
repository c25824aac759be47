"""The explorer's page: what it holds is what the network predicts, and a browser shows it."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from models import Predictor, build_generator
from train.__main__ import main
from train.data.images import read_images
from train.evaluation.explore import directions_of_change, explore
from train.evaluation.inference import reconstruct
from train.evaluation.runs import load_generator, open_run
from train.methods import get_method
from train.methods.weights import save_weights
from train.show.explorer import CodePlane, write_explorer


class _Linear(Predictor):
    """Clouds that are linear in the code: two directions change them more than all others together."""

    code_dim = 16

    def __init__(self) -> None:
        super().__init__()
        self.config = dataclasses.replace(build_generator("smoke").config)
        draw = torch.Generator().manual_seed(1)
        self.mean = torch.rand(self.points, 3, generator=draw) - 0.5
        self.directions = torch.linalg.qr(torch.randn(16, 16, generator=draw)).Q
        self.changes = 0.03 * torch.randn(16, self.points, 3, generator=draw)
        self.changes[2:] *= 0.05

    def forward(self, images: Tensor, codes: Tensor) -> Tensor:
        return self.mean + torch.einsum("rbd,kd,knc->rbnc", codes, self.directions, self.changes)

    def predict_views(self, images: Tensor, codes: Tensor | None = None) -> Tensor:
        raise NotImplementedError


def _planes_in(page: Path) -> list[dict[str, Any]]:
    (found,) = re.findall(r'<script type="application/json" id="planes">(.*?)</script>', page.read_text())
    return json.loads(found)


def _blended(packed: dict[str, Any], right: float, up: float) -> np.ndarray:
    """(N, 3): what the page's script computes at a place of the plane in [-1, 1], from the bytes in the page."""

    def array(name: str, kind: str) -> np.ndarray:
        return np.frombuffer(base64.b64decode(packed[name]), kind)

    mean = array("mean", "<i2") * packed["mean_scale"]
    basis = array("basis", "i1").reshape(-1, len(mean))
    weights = array("weights", "<f4").reshape(-1, len(basis))
    side = round(len(weights) ** 0.5)
    across, along = (right + 1) / 2 * (side - 1), (up + 1) / 2 * (side - 1)
    column, row = min(int(across), side - 2), min(int(along), side - 2)
    x, y = across - column, along - row
    grid = weights.reshape(side, side, -1)[row : row + 2, column : column + 2]
    mixed = np.einsum("r,c,rck->k", [1 - y, y], [1 - x, x], grid)
    return (mean + mixed @ basis).reshape(-1, 3)


def _rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).sum(-1).mean()))


def test_the_plane_holds_the_two_directions_that_change_the_predictions_most():
    model = _Linear()
    codes = torch.randn(256, 16, generator=torch.Generator().manual_seed(0))
    found = directions_of_change(codes, model(torch.rand(1, 3, 8, 8), codes[:, None])[:, 0])
    torch.testing.assert_close(found @ found.T, torch.eye(2))
    assert (found @ model.directions[:2].T).square().sum() > 1.98, "of 2, if both lie in the true plane"


def test_the_plane_passes_through_the_given_codes(tmp_path: Path):
    model, images = _Linear(), torch.rand(2, 3, 8, 8)
    codes = torch.randn(2, 16, generator=torch.Generator().manual_seed(3))
    codes[0] *= 0.3
    codes[1] += 6 * model.directions[0]  # further out than the plane usually reaches
    planes = explore(model, images, codes, progress=False)
    write_explorer(tmp_path / "page.html", planes)
    for packed, each, code in zip(_planes_in(tmp_path / "page.html"), planes, codes, strict=True):
        assert np.abs(packed["start"]).max() < 1
        expected = model(images[:1], code[None, None])[0, 0].numpy()
        # Blending is exact for clouds that are linear in the code; what is left are the basis' 8 bits.
        assert _rms(_blended(packed, *packed["start"]), expected) < 0.004
        true_spread = torch.einsum("knc,knc->n", model.changes, model.changes).sqrt()
        torch.testing.assert_close(each.spread, true_spread, rtol=0.3, atol=0)
    assert planes[0].reach == 2.5
    assert planes[1].reach > 4


def test_at_the_grids_codes_the_page_holds_the_predictions(smoke_run: Path, picture: Path, tmp_path: Path):
    model, images = load_generator(smoke_run), read_images([picture])
    codes = torch.randn(1, model.code_dim, generator=torch.Generator().manual_seed(0))
    (plane,) = explore(model, images, codes, progress=False)
    write_explorer(tmp_path / "page.html", [plane])
    (packed,) = _planes_in(tmp_path / "page.html")
    side = round(len(plane.clouds) ** 0.5)
    errors = [
        _rms(_blended(packed, 2 * column / (side - 1) - 1, 2 * row / (side - 1) - 1), cloud.numpy())
        for (row, column), cloud in zip(np.ndindex(side, side), plane.clouds, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(errors))) < 0.0025, "0.002 left out of the basis, and rounding"
    assert np.ptp(plane.clouds.numpy(), axis=0).max() > 0.02, "and they differ by much more than that"
    (at_code,) = model(images, codes[None])[0]
    assert _rms(_blended(packed, *packed["start"]), at_code.detach().numpy()) < 0.004


def test_pages_are_small_even_where_the_clouds_of_the_plane_share_nothing(tmp_path: Path):
    draw = torch.Generator().manual_seed(0)
    cloud = torch.rand(1024, 3, generator=draw) - 0.5
    places = torch.randn(121, 6, generator=draw)
    smooth = cloud + torch.einsum("gk,knc->gnc", places, 0.02 * torch.randn(6, 1024, 3, generator=draw))
    rough = cloud + 0.05 * torch.randn(121, 1024, 3, generator=draw)
    image = torch.ones(3, 224, 224)
    image[:, 60:160, 80:130] = 0.3
    sizes = []
    for clouds in (smooth, rough):
        plane = CodePlane(image, clouds, torch.rand(1024), torch.zeros(2), 2.5)
        write_explorer(tmp_path / "page.html", [plane] * 3)
        sizes.append((tmp_path / "page.html").stat().st_size)
        for packed in _planes_in(tmp_path / "page.html"):
            assert _rms(_blended(packed, -1, 1), clouds[110].numpy()) < 0.004
    assert sizes[0] < 250_000
    assert sizes[1] < 2_000_000


def test_clouds_that_are_all_the_same_make_a_page(tmp_path: Path):
    cloud = torch.rand(50, 3)
    plane = CodePlane(torch.ones(3, 8, 8), cloud.expand(121, -1, -1), torch.zeros(50), torch.zeros(2), 2.5)
    write_explorer(tmp_path / "page.html", [plane])
    assert _rms(_blended(_planes_in(tmp_path / "page.html")[0], 0.3, 0.1), cloud.numpy()) < 1e-4


@pytest.fixture(scope="module")
def picture(tiny_data: Path) -> Path:
    return next(tiny_data.rglob("render_0.png"))


@pytest.fixture(scope="module")
def page(smoke_run: Path, picture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of three images of one object."""
    path = tmp_path_factory.mktemp("explorer") / "deep" / "page.html"
    images = [str(picture.with_name(f"render_{i}.png")) for i in range(3)]
    assert main(["explore", str(smoke_run), *images, "--out", str(path)]) == 0
    return path


def test_the_command_writes_a_page_that_starts_where_the_images_agree(
    page: Path, smoke_run: Path, picture: Path, tmp_path: Path
):
    model, config, _ = open_run(smoke_run)
    images = read_images([picture.with_name(f"render_{i}.png") for i in range(3)])
    agreed = reconstruct(model, images, settings=config.inference).points[0].unflatten(0, (3, -1))
    found = _planes_in(page)
    assert len(found) == 3
    for packed, cloud in zip(found, agreed, strict=True):
        assert _rms(_blended(packed, *packed["start"]), cloud.numpy()) < 0.004
    assert page.stat().st_size < 250_000
    assert [file.name for file in page.parent.iterdir()] == ["page.html"]
    again = tmp_path / "again.html"
    files = [str(picture.with_name(f"render_{i}.png")) for i in range(3)]
    assert main(["explore", str(smoke_run), *files, "--out", str(again), "--seed", "0"]) == 0
    for packed, same in zip(found, _planes_in(again), strict=True):
        assert packed["start"] == pytest.approx(same["start"], abs=1e-3)
        assert _rms(_blended(packed, 0.7, -0.4), _blended(same, 0.7, -0.4)) < 1e-3


def test_reconstruct_writes_the_page_of_its_reconstruction(smoke_run: Path, picture: Path, tmp_path: Path):
    files = [str(picture), str(picture.with_name("render_1.png"))]
    assert main(["reconstruct", str(smoke_run), *files, "--out", str(tmp_path), "--steps", "1"]) == 0
    run = open_run(smoke_run)
    found = reconstruct(
        run.model, read_images([Path(file) for file in files]), steps=1, settings=run.config.inference
    )
    for packed, cloud in zip(
        _planes_in(tmp_path / "explore.html"), found.points[0].unflatten(0, (2, -1)), strict=True
    ):
        assert _rms(_blended(packed, *packed["start"]), cloud.numpy()) < 0.004


@pytest.fixture
def weights(tmp_path: Path) -> dict[str, Path]:
    """Files of untrained networks that have nothing to explore."""
    voxels = get_method("r2n2")
    networks = {
        "one prediction": build_generator("smoke", deterministic=True),
        "all images": voxels.network_class(voxels.sizes["smoke"]),  # type: ignore[call-arg]
        "no order": build_generator(
            config=dataclasses.replace(build_generator("smoke").config, occupancy_logits=True)
        ),
    }
    files = {name: tmp_path / f"{name.replace(' ', '-')}.safetensors" for name in networks}
    for name, network in networks.items():
        save_weights(network, files[name])
    return files


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("one prediction", "one prediction of an image, whatever the code"),
        ("all images", "one prediction of all images together"),
        ("no order", "points of two predictions do not correspond"),
    ],
)
def test_a_network_without_something_to_explore_says_so(
    name: str,
    complaint: str,
    weights: dict[str, Path],
    picture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    command = ["explore", str(weights[name]), str(picture), "--out", str(tmp_path / "page.html")]
    assert main(command) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()
    out = tmp_path / "out"
    out.mkdir()
    (out / "explore.html").write_text("of an earlier reconstruction")
    assert main(["reconstruct", str(weights[name]), str(picture), "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["reconstruction.html", "reconstruction.ply"]


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        ("explore {run} {tmp}/noise.png --out {tmp}/page.html", "noise.png is not an image"),
        ("explore {run} {tmp}/nothing.png --out {tmp}/page.html", "nothing.png does not exist"),
        ("explore {run} --out {tmp}/page.html", "explore takes 1 to 24 images; got 0"),
        ("explore {run} {picture} --out {tmp}", "is a directory where a file is to be written"),
        ("explore {run} {picture} --out {tmp}/noise.png/a.html", "noise.png is a file, not a directory"),
        ("explore {tmp} {picture} --out {tmp}/page.html", "is not a run"),
    ],
)
def test_a_users_mistake_is_one_line(
    command: str,
    complaint: str,
    smoke_run: Path,
    picture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    (tmp_path / "noise.png").write_bytes(bytes(range(256)))
    assert main(command.format(run=smoke_run, tmp=tmp_path, picture=picture).split()) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert complaint in line
    assert [file.name for file in tmp_path.iterdir()] == ["noise.png"]


# ---- in a browser ---------------------------------------------------------------------------------------------------


def _chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium: that of $CHROMIUM, of the system, or of `playwright install chromium`."""
    api = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (pip install playwright)"
    )
    with api.sync_playwright() as playwright:
        program = _chromium() or playwright.chromium.executable_path
        if not Path(program).exists():
            pytest.skip("no Chromium found (apt-get install chromium, or playwright install chromium)")
        arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        opened = playwright.chromium.launch(executable_path=program, args=arguments)
        yield opened
        opened.close()


class _Shown:
    """A page in a tab of the browser, with what it complains about and what it asks the network for."""

    def __init__(self, browser: Any, file: Path, **options: Any) -> None:
        self.context = browser.new_context(viewport={"width": 1280, "height": 900}, **options)
        self.tab = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda message: self.complaints.append(message.text))
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(file.as_uri())
        self.settle()

    def settle(self) -> None:
        """Waits until a picture is drawn that was asked for by now."""
        self.tab.evaluate(
            "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )

    def pictures(self) -> list[str]:
        """The two views' pixels."""
        self.settle()
        return self.tab.evaluate(
            "() => [...document.querySelectorAll('.views canvas')].map(c => c.toDataURL())"
        )

    def place(self) -> tuple[float, float]:
        """Of the handle's centre, in shares of the pad from its left and top."""
        pad, handle = (self.tab.locator(f"#{name}").bounding_box() for name in ("pad", "handle"))
        return tuple(
            (handle[start] + handle[size] / 2 - pad[start]) / pad[size]
            for start, size in (("x", "width"), ("y", "height"))
        )

    def on_pad(self, across: float, down: float) -> tuple[float, float]:
        """Pixels of a place in shares of the pad."""
        pad = self.tab.locator("#pad").bounding_box()
        return pad["x"] + across * pad["width"], pad["y"] + down * pad["height"]


@pytest.fixture
def shown(browser: Any, page: Path) -> Iterator[_Shown]:
    found = _Shown(browser, page)
    yield found
    assert found.complaints == []
    assert [url for url in found.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    found.context.close()


def test_dragging_the_handle_changes_both_pictures(shown: _Shown):
    shown.tab.get_by_role("tab", name="Image 2").click()
    before = shown.pictures()
    assert len({*before}) == 2
    mouse = shown.tab.mouse
    mouse.move(*shown.on_pad(0.5, 0.5))
    mouse.down()
    mouse.move(*shown.on_pad(0.9, 0.2), steps=4)
    dragged = shown.pictures()
    assert shown.place() == pytest.approx((0.9, 0.2), abs=0.01)
    mouse.move(*shown.on_pad(1.4, -0.3))
    assert shown.place() == pytest.approx((1, 0), abs=0.01), "it stays on the plane"
    mouse.up()
    mouse.move(*shown.on_pad(0.1, 0.1))
    assert shown.place() == pytest.approx((1, 0), abs=0.01), "after it was let go"
    assert all(a != b for a, b in zip(before, dragged, strict=True))
    shown.tab.get_by_role("button", name="Back").click()
    assert shown.pictures() == before


def test_the_page_draws_the_clouds_that_python_blends(shown: _Shown, page: Path):
    for i, packed in enumerate(_planes_in(page)):
        for place in ([0.0, 0.0], [-1.0, 1.0], [0.37, -0.81], packed["start"]):
            values = shown.tab.evaluate("([i, place]) => [...all[i].cloud(place)]", [i, place])
            np.testing.assert_allclose(
                np.reshape(values, (-1, 3)), _blended(packed, *place), rtol=0, atol=1e-5
            )


def test_keys_move_the_handle_and_turn_the_shape(shown: _Shown):
    shown.tab.get_by_role("tab", name="Image 1").click()
    before, (across, down) = shown.pictures(), shown.place()
    for _ in range(40):  # the handle is reached with the Tab key alone
        shown.tab.keyboard.press("Tab")
        if shown.tab.evaluate("() => document.activeElement.id") == "handle":
            break
    for key in ("ArrowLeft", "ArrowLeft", "ArrowUp"):
        shown.tab.keyboard.press(key)
    assert shown.place() == pytest.approx((across - 0.04, down - 0.02), abs=0.002)
    moved = shown.pictures()
    assert all(a != b for a, b in zip(before, moved, strict=True))
    words = shown.tab.get_by_role("slider", name="Code").get_attribute("aria-valuetext")
    assert re.fullmatch(r"-?\d+ right, -?\d+ up; points moved by 0\.\d+", words)
    shown.tab.keyboard.press("Home")
    assert shown.pictures() == before
    shown.tab.locator(".views canvas").first.focus()
    shown.tab.keyboard.press("ArrowRight")
    turned = shown.pictures()
    assert all(a != b for a, b in zip(before, turned, strict=True)), "the views are linked"
    shown.tab.keyboard.press("ArrowLeft")
    shown.tab.keyboard.press("+")
    assert len({*before, *turned, *shown.pictures()}) == 6


def test_a_finger_moves_the_handle_and_turns_the_shape(browser: Any, page: Path):
    shown = _Shown(browser, page, has_touch=True, is_mobile=True)
    shown.tab.get_by_role("tab", name="Image 1").tap()
    before = shown.pictures()
    finger = shown.context.new_cdp_session(shown.tab)

    def drag(start: tuple[float, float], end: tuple[float, float]) -> None:
        def touch(kind: str, *at: tuple[float, float]) -> None:
            points = [{"x": x, "y": y} for x, y in at]
            finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        touch("touchStart", start)
        for share in (0.3, 0.7, 1.0):
            touch("touchMove", tuple(a + share * (b - a) for a, b in zip(start, end, strict=True)))
        touch("touchEnd")

    shown.tab.locator("#pad").scroll_into_view_if_needed()
    drag(shown.on_pad(0.5, 0.5), shown.on_pad(0.2, 0.9))
    assert shown.place() == pytest.approx((0.2, 0.9), abs=0.01), "the page did not scroll instead"
    moved = shown.pictures()
    assert all(a != b for a, b in zip(before, moved, strict=True))
    view = shown.tab.locator(".views canvas").first
    view.scroll_into_view_if_needed()
    box = view.bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    drag(middle, (middle[0] + 40, middle[1] + 10))
    assert all(a != b for a, b in zip(moved, shown.pictures(), strict=True))
    assert shown.complaints == []
    shown.context.close()


def test_wheel_and_drag_turn_and_zoom(shown: _Shown):
    before = shown.pictures()
    shown.tab.locator(".views canvas").nth(1).hover()
    shown.tab.mouse.wheel(0, -300)
    zoomed = shown.pictures()
    shown.tab.mouse.down()
    shown.tab.mouse.move(700, 400)
    shown.tab.mouse.up()
    assert len({*before, *zoomed, *shown.pictures()}) == 6


def test_tabs_show_each_images_predictions_and_what_all_agree_on(shown: _Shown):
    tab = shown.tab
    assert tab.get_by_role("tab", name="Agreed").get_attribute("aria-selected") == "true"
    pictures = {"agreed": shown.pictures()[0]}
    assert tab.locator("#plane").is_hidden()
    assert tab.evaluate("() => scene.colours.length") == 3 * 128
    tab.get_by_role("button", name="points of image 2").click()
    pictures["without the second"] = shown.pictures()[0]
    assert tab.evaluate("() => scene.colours.length") == 2 * 128
    tab.get_by_text("how unsure", exact=True).click()
    pictures["unsure"] = shown.pictures()[0]
    tab.get_by_role("tab", name="Agreed").focus()
    for name in ("Image 1", "Image 2"):  # from the last tab around to the first
        tab.keyboard.press("ArrowRight")
        assert tab.get_by_role("tab", name=name).get_attribute("aria-selected") == "true"
        pictures[name] = shown.pictures()[0]
        assert tab.locator("#plane").is_visible()
    tab.get_by_text("height", exact=True).click()
    pictures["height"] = shown.pictures()[0]
    assert len({*pictures.values()}) == len(pictures)


def test_buttons_draw_codes_wander_and_save(shown: _Shown, tmp_path: Path):
    tab = shown.tab
    tab.get_by_role("tab", name="Image 3").click()
    start = shown.place()
    tab.get_by_role("button", name="Random code").click()
    drawn = shown.place()
    assert drawn != pytest.approx(start, abs=0.001)
    tab.get_by_role("button", name="Wander").click()
    tab.wait_for_timeout(400)
    tab.get_by_role("button", name="Stop").click()
    assert shown.place() != pytest.approx(drawn, abs=0.001)
    with tab.expect_download() as download:
        tab.get_by_role("button", name="Save this cloud").click()
    download.value.save_as(tmp_path / "cloud.ply")
    lines = (tmp_path / "cloud.ply").read_text().splitlines()
    points = np.array(
        [[float(word) for word in line.split()] for line in lines[lines.index("end_header") + 1 :]]
    )
    assert "element vertex 128" in lines
    np.testing.assert_allclose(
        points, np.reshape(tab.evaluate("() => [...scene.points]"), (-1, 3)), atol=1e-5
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_one_image_needs_no_tabs_and_both_colour_schemes_work(
    scheme: str, browser: Any, smoke_run: Path, picture: Path, tmp_path: Path
):
    file = tmp_path / "page.html"
    assert main(["explore", str(smoke_run), str(picture), "--out", str(file)]) == 0
    shown = _Shown(browser, file, color_scheme=scheme)
    assert shown.tab.get_by_role("tab").count() == 0
    assert shown.tab.locator("#plane").is_visible()
    pixels = np.asarray(Image.open(_saved(shown, tmp_path)).convert("L"), float)
    assert (pixels.mean() > 200) == (scheme == "light")
    assert shown.complaints == []
    shown.context.close()


def _saved(shown: _Shown, folder: Path) -> Path:
    shown.tab.screenshot(path=folder / "shot.png")
    return folder / "shot.png"
