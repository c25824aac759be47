"""Contact sheets: one row a shape, what is broken left out, mistakes named."""

import numpy as np
import pytest
from PIL import Image

from train.__main__ import main
from train.data import ShapeTree, tree_files
from train.data.contact_sheet import _arranged, show, strip_of
from train.data.procedural import generate
from train.errors import UserError


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("show") / "data"
    generate(root, shapes=6, categories=["lamp", "car"], seed=0, size=64, views=3, processes=1)
    return root


def test_a_sheet_for_each_category(data, tmp_path):
    sheets = show(data, tmp_path / "sheets", shapes=2)
    assert sheets == {name: tmp_path / "sheets" / f"{name}.png" for name in ("lamp", "car")}
    tall, wide, _ = np.asarray(Image.open(sheets["lamp"])).shape
    assert (tall, wide) == (2 * (18 + 144), 7 * 144)
    only = show(data, tmp_path / "one", categories=["car"], shapes=50)
    assert list(only) == ["car"]
    assert np.asarray(Image.open(only["car"])).shape[0] == 3 * (18 + 144)


def test_each_cell_shows_the_object_on_white(data):
    strip = strip_of(ShapeTree(data, "train")[0], split="train")
    title, cells = strip[:18], strip[18:].reshape(144, 7, 144, 3).transpose(1, 0, 2, 3)
    assert 0.005 < (title < 200).any(-1).mean() < 0.2
    for cell in cells:
        assert 0.01 < (cell < 250).any(-1).mean() < 0.6
        assert (cell[:3] > 250).all()
    ink = [(cell < 250).any(-1) for cell in cells]
    views, depth, cloud, behind = ink[:4], *ink[4:]
    assert _overlap(views[0], depth) > 0.9
    assert _overlap(views[0], cloud) > 0.75
    assert _overlap(views[0], cloud) > _overlap(views[0], behind)
    assert len(np.unique(cells[4][depth].reshape(-1, 3), axis=0)) > 100  # many depths, many colours


def _overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def test_the_object_fills_its_cells(data):
    strip = strip_of(ShapeTree(data, "train")[0], split="train")
    cells = strip[18:].reshape(144, 7, 144, 3).transpose(1, 0, 2, 3)
    reach = max(abs(np.argwhere((cell < 250).any(-1)) - 71.5).max() for cell in cells)
    assert 55 < reach < 72


def test_many_shapes_stand_in_columns():
    strips = [np.full((2, 10, 3), k, np.uint8) for k in range(40)]
    sheet = _arranged(strips)
    assert sheet.shape == (20 * 2, 10 + 16 + 10, 3)
    assert sheet[::2, 0, 0].tolist() == list(range(20))
    assert sheet[::2, -1, 0].tolist() == list(range(20, 40))
    assert _arranged(strips[:16]).shape == (32, 10, 3)
    assert (_arranged(strips[:39])[-1, -1] == 255).all()


def test_broken_shapes_are_left_out_and_mistakes_named(data, tmp_path, capsys):
    with pytest.raises(UserError, match="no shape of chair; it has: car, lamp"):
        show(data, tmp_path, categories=["chair"])
    with pytest.raises(UserError, match="shapes must be"):
        show(data, tmp_path, shapes=0)
    root = tmp_path / "broken"
    generate(root, shapes=2, categories=["lamp"], seed=1, size=32, views=1, processes=1)
    folders = sorted((root / tree_files.RENDERS).glob("*/*"))
    (folders[0] / "depth_0.png").write_bytes(b"no")
    assert main(["data", "show", str(root)]) == 0
    assert "lamp: " in capsys.readouterr().out
    assert np.asarray(Image.open(root / "contact" / "lamp.png")).shape[0] == 18 + 144
    assert main(["data", "check", str(root)]) == 1
    (folders[1] / "depth_0.png").write_bytes(b"no")
    with pytest.raises(UserError, match="no shape of lamp can be read"):
        show(root)
