"""Every function of the data that takes a path takes a str as well as a Path."""

import importlib
import inspect
import pkgutil
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import train.data
from train.data import ShapeTree
from train.data.batches import load_split
from train.data.cache import damaged_files
from train.data.check import check_tree
from train.data.contact_sheet import show
from train.data.images import read_images
from train.data.meshes import convert
from train.data.photos import convert_photos
from train.data.procedural import generate
from train.data.tree import read_shape

SMALL = {"size": 32, "views": 1, "processes": 1}
BATCHES = {"image_size": (16, 16), "map_size": 16, "progress": False}

# Each takes str or Path and the folder; what it returns is compared.
CALLS = {
    "ShapeTree": lambda p, at: ShapeTree(p(at / "data"), "train").ids,
    "read_shape": lambda p, at: read_shape(p(at / "data"), ShapeTree(at / "data", "train").ids[0]).id,
    "load_split": lambda p, at: load_split(p(at / "data"), "train", **BATCHES).ids,
    "load_split of two": lambda p, at: load_split([p(at / "data")] * 2, "train", **BATCHES).ids,
    "damaged_files": lambda p, at: damaged_files(p(at / "data")),
    "check_tree": lambda p, at: check_tree(p(at / "data")).problems,
    "show": lambda p, at: list(show(p(at / "data"), p(at / "sheets"), shapes=1)),
    "generate": lambda p, at: generate(p(at / "new"), shapes=1, categories=["lamp"], seed=0, **SMALL).counts,
    "convert": lambda p, at: convert(p(at / "x.off"), p(at / "new"), labels=p(at / "y.csv"), **SMALL).counts,
    "convert_photos": lambda p, at: convert_photos(p(at / "photos"), p(at / "new"), processes=1).ways,
    "read_images": lambda p, at: read_images([p(at / "photos" / "a.png")]).sum().item(),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    at = tmp_path_factory.mktemp("paths")
    generate(at / "data", shapes=5, categories=["display"], seed=0, **SMALL)
    trimesh.creation.box().export(at / "x.off")
    (at / "y.csv").write_text("model,category\nx.off,lamp\n")
    (at / "photos").mkdir()
    picture = np.full((64, 64, 3), 240, np.uint8)
    picture[16:48, 16:48] = (120, 60, 20)
    Image.fromarray(picture).save(at / "photos" / "a.png")
    return at


@pytest.mark.parametrize("name", CALLS)
def test_a_str_is_as_good_as_a_path(folder, name):
    found = []
    for kind in (str, Path):
        found.append(CALLS[name](kind, folder))
        shutil.rmtree(folder / "new", ignore_errors=True)
    assert found[0] == found[1]


def test_no_public_function_asks_for_a_path_only():
    asking = set()
    for info in pkgutil.walk_packages(train.data.__path__, "train.data."):
        for name, function in inspect.getmembers(importlib.import_module(info.name), inspect.isfunction):
            hints = [
                str(parameter.annotation) for parameter in inspect.signature(function).parameters.values()
            ]
            if function.__module__ == info.name and not name.startswith("_"):
                asking |= {name for hint in hints if re.search(r"(?<!str \| )\bPath\b", hint)}
    assert asking == {"assembled", "read_file"}  # which get their paths from the layouts only
