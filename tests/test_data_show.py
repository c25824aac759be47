"""Contact sheets: one row a shape, what is broken left out, mistakes named."""

import numpy as np
import pytest
from PIL import Image

from train.__main__ import main
from train.data import ShapeTree, store
from train.data.procedural import generate
from train.data.show import row_of, show
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
    assert (tall, wide) == (2 * 128, 7 * 130)
    only = show(data, tmp_path / "one", categories=["car"], shapes=50)
    assert list(only) == ["car"]
    assert np.asarray(Image.open(only["car"])).shape[0] == 3 * 128


def test_each_cell_shows_the_object_on_white(data):
    strip = row_of(ShapeTree(data, "train")[0])
    cells = strip.reshape(128, 7, 130, 3).transpose(1, 0, 2, 3)
    for cell in cells:
        assert 0.01 < (cell < 250).any(-1).mean() < 0.6
        assert (cell[:3] == 255).all()
    ink = [(cell < 250).any(-1) for cell in cells]
    same = (ink[0] & ink[5]).sum() / (ink[0] | ink[5]).sum()  # the first view, and the cloud from there
    other = (ink[0] & ink[6]).sum() / (ink[0] | ink[6]).sum()
    assert same > 0.75
    assert same > other


def test_broken_shapes_are_left_out_and_mistakes_named(data, tmp_path, capsys):
    with pytest.raises(UserError, match="no shape of chair; it has: car, lamp"):
        show(data, tmp_path, categories=["chair"])
    with pytest.raises(UserError, match="shapes must be"):
        show(data, tmp_path, shapes=0)
    root = tmp_path / "broken"
    generate(root, shapes=2, categories=["lamp"], seed=1, size=32, views=1, processes=1)
    folders = sorted((root / store.RENDERS).glob("*/*"))
    (folders[0] / "depth_0.png").write_bytes(b"no")
    assert main(["data", "show", str(root)]) == 0
    assert "lamp: " in capsys.readouterr().out
    assert np.asarray(Image.open(root / "contact" / "lamp.png")).shape[0] == 128
    assert main(["data", "check", str(root)]) == 1
    (folders[1] / "depth_0.png").write_bytes(b"no")
    with pytest.raises(UserError, match="no shape of lamp can be read"):
        show(root)
