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
from train.data.cache import damaged_files, prepare
from train.data.check import check_tree
from train.data.contact_sheet import draw_families, show
from train.data.images import decode, read_images, read_rgba
from train.data.layouts import layout_of, pictures_of, require_depth
from train.data.mesh_sources import find_meshes, read_labels
from train.data.meshes import convert, load_surface
from train.data.photos import convert_photos, find_photos, is_mask, mask_of, masks_in
from train.data.procedural import generate
from train.data.shrink import Sizes
from train.data.tree import frame_of, read_shape
from train.files import kept, remove, write_text

SMALL = {"size": 32, "views": 1, "processes": 1}
BATCHES = {"image_size": (16, 16), "map_size": 16, "progress": False}

# Each takes a function that makes a path of a Path, and the folder; what it returns is compared.
CALLS = {
    "ShapeTree": lambda p, at: ShapeTree(p(at / "data"), "train").ids,
    "load_split": lambda p, at: load_split(p(at / "data"), "train", **BATCHES).ids,
    "load_split of two": lambda p, at: load_split([p(at / "data")] * 2, "train", **BATCHES).ids,
    "prepare": lambda p, at: list(prepare(p(at / "data"), shapes(at), Sizes((16, 16), 16), progress=False)),
    "damaged_files": lambda p, at: damaged_files(p(at / "data")),
    "check_tree": lambda p, at: check_tree(p(at / "data")).problems,
    "read_shape": lambda p, at: read_shape(p(at / "data"), shapes(at)[0]).id,
    "frame_of": lambda p, at: frame_of(p(at / "data")).verdict,
    "layout_of": lambda p, at: layout_of(p(at / "data")).on_disk(),
    "require_depth": lambda p, at: require_depth([p(at / "data")]),
    "show": lambda p, at: list(show(p(at / "data"), p(at / "sheets"), shapes=1)),
    "generate": lambda p, at: generate(p(at / "new"), shapes=1, categories=["lamp"], seed=0, **SMALL).counts,
    "draw_families": lambda p, at: draw_families(p(at / "pictures"), ["lamp"], objects=1),
    "convert": lambda p, at: convert([p(at / "x.off")], p(at / "meshes"), **SMALL).counts,
    "convert with labels": lambda p, at: convert(
        p(at / "x.off"), p(at / "labelled"), labels=p(at / "labels.csv"), **SMALL
    ).categories,
    "find_meshes": lambda p, at: find_meshes([p(at / "x.off")], p(at)),
    "load_surface": lambda p, at: load_surface(p(at / "x.off"), root=p(at)).vertices.tolist(),
    "read_labels": lambda p, at: read_labels(p(at / "labels.csv")),
    "find_photos": lambda p, at: find_photos(p(at / "photos")),
    "convert_photos": lambda p, at: convert_photos(p(at / "photos"), p(at / "cut"), processes=1).ways,
    "decode": lambda p, at: decode(p(at / "photos" / "a.png")).shape,
    "read_images": lambda p, at: read_images([p(at / "photos" / "a.png")]).sum().item(),
    "read_rgba": lambda p, at: read_rgba(p(at / "photos" / "a.png")).sum(),
    "pictures_of": lambda p, at: pictures_of(p(at / "photos")),
    "masks": lambda p, at: (is_mask(p(at / "masks" / "a.png")), mask_of(p(at / "a"), masks_in(p(at / "photos")))),
    "files": lambda p, at: (write_text(p(at / "a"), "a"), kept(p(at / "k"), 1, lambda: 2), remove(p(at / "a"))),
}  # fmt: skip


def shapes(at: Path) -> list[str]:
    return ShapeTree(at / "data", "train").ids


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    at = tmp_path_factory.mktemp("paths")
    generate(at / "data", shapes=5, categories=["display"], seed=0, **SMALL)
    trimesh.creation.box().export(at / "x.off")
    (at / "labels.csv").write_text("model,category\nx.off,lamp\n")
    (at / "photos").mkdir()
    picture = np.full((64, 64, 3), 240, np.uint8)
    picture[16:48, 16:48] = (120, 60, 20)
    Image.fromarray(picture).save(at / "photos" / "a.png")
    return at


@pytest.mark.parametrize("name", CALLS)
def test_a_str_is_as_good_as_a_path(folder: Path, name: str) -> None:
    found = []
    for kind in (str, Path):
        found.append(CALLS[name](kind, folder))
        for made in ("new", "meshes", "labelled", "cut"):
            shutil.rmtree(folder / made, ignore_errors=True)
    assert found[0] == found[1]


def test_no_public_function_asks_for_a_path_only() -> None:
    asking = []
    for info in pkgutil.walk_packages(train.data.__path__, "train.data."):
        module = importlib.import_module(info.name)
        for name, function in vars(module).items():
            if (
                name.startswith("_")
                or getattr(function, "__module__", "") != info.name
                or isinstance(function, type)
            ):
                continue
            if not callable(function):
                continue
            for parameter in inspect.signature(function).parameters.values():
                hint = str(parameter.annotation)
                if re.search(r"\bPath\b", hint) and not re.search(r"\bstr \| Path\b", hint):
                    asking.append(f"{info.name}.{name}: {parameter}")
    # Two that only layouts and their readers call, with paths that they have made themselves.
    assert asking == [
        "train.data.shape.assembled: folder: 'Path'",
        "train.data.shape.assembled: cloud: 'Path'",
        "train.data.shape.read_file: path: 'Path'",
        "train.data.shape.read_file: reader: 'Callable[[Path], Content]'",
    ]
