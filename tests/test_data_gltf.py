"""glTF files whose geometry or colours trimesh misreads."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from train.data.meshes import MeshError, load_surface
from train.data.surface import Surface

_BOX = trimesh.creation.box((1, 2, 3))
_SIDES = np.array([1, 2, 3]) / np.sqrt(14)
_TYPES = {"u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class _Gltf:
    """A box with one primitive, whose JSON a test changes before it is written."""

    def __init__(self, vertices: np.ndarray | None = None) -> None:
        self.data = bytearray()
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        vertices = np.asarray(_BOX.vertices if vertices is None else vertices, "f4")
        self.primitive: dict[str, Any] = {
            "attributes": {"POSITION": self.add(vertices, "VEC3")},
            "indices": self.add(np.asarray(_BOX.faces, "u2").reshape(-1, 1), "SCALAR"),
        }
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "meshes": [{"primitives": [self.primitive]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        }

    def view(self, values: np.ndarray) -> int:
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += values.tobytes()
        return len(self.views) - 1

    def add(self, values: np.ndarray, kind: str, **more: Any) -> int:
        component = _TYPES[values.dtype.str[1:]]
        self.accessors.append(
            {"bufferView": self.view(values), "componentType": component, "count": len(values)}
        )
        self.accessors[-1] |= {"type": kind, **more}
        return len(self.accessors) - 1

    def paint(self, folder: Path, texture: dict[str, Any], **material: Any) -> None:
        """Gives the box a picture: left half green, right half white."""
        picture = Image.new("RGB", (8, 8), (0, 255, 0))
        picture.paste((255, 255, 255), (4, 0, 8, 8))
        picture.save(folder / "t.png")
        self.json |= {"textures": [{"source": 0}], "images": [{"uri": "t.png"}]}
        colours = {"baseColorTexture": {"index": 0, **texture}, **material}
        self.json["materials"] = [{"pbrMetallicRoughness": colours}]
        self.primitive["material"] = 0

    def load(self, folder: Path, uri: str | None = None) -> Surface:
        described = {"accessors": self.accessors, "bufferViews": self.views, **self.json}
        described["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        if uri is None:
            described["buffers"][0]["uri"] = (
                "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            )
        (folder / "a.gltf").write_text(json.dumps(described))
        return load_surface(folder / "a.gltf")


def _sides(surface: Surface) -> np.ndarray:
    return np.ptp(surface.vertices[surface.faces].reshape(-1, 3), axis=0)


def _seen(surface: Surface) -> list[float]:
    """The colour at the first corner."""
    tint = surface.corner_colours[0, 0].astype(float)
    if not surface.textures:
        return tint.round(3).tolist()
    (texture,), (u, v) = surface.textures, surface.corner_uv[0, 0]
    return (tint * texture[int((1 - v) * 7.99), int(u * 7.99)] / 255).round(3).tolist()


@pytest.mark.parametrize("has_base", [True, False])
def test_sparse_accessors(has_base: bool, tmp_path: Path) -> None:
    vertices = np.asarray(_BOX.vertices, "f4")
    made = _Gltf(np.where(np.arange(8)[:, None] < 3, vertices, 0) if has_base else vertices)
    rows = np.arange(3 if has_base else 0, 8, dtype="u2")
    made.accessors[0]["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": made.view(rows), "componentType": _TYPES["u2"]},
        "values": {"bufferView": made.view(vertices[rows])},
    }
    if not has_base:
        del made.accessors[0]["bufferView"]
    assert _sides(made.load(tmp_path)) == pytest.approx(_SIDES)


def test_triangle_fans(tmp_path: Path) -> None:
    made = _Gltf()
    made.json["meshes"][0]["primitives"] = []
    for name, corners in (("indices", [0, 1, 3, 2]), (None, [4, 5, 7, 6])):
        attributes = {"POSITION": made.add(np.asarray(_BOX.vertices[corners], "f4"), "VEC3")}
        fan: dict[str, Any] = {"mode": 6, "attributes": attributes}
        if name:
            fan["attributes"] = made.primitive["attributes"]
            fan["indices"] = made.add(np.array(corners, "u2").reshape(-1, 1), "SCALAR")
        made.json["meshes"][0]["primitives"].append(fan)
    surface = made.load(tmp_path)
    assert len(surface.faces) == 4
    assert _sides(surface) == pytest.approx(_SIDES)


def _with_bones(made: _Gltf) -> None:
    """One bone holds the lower half of the box, another the upper half, which it moves up by 1."""
    upper = (_BOX.vertices[:, 1] > 0).astype("u1")
    joints = np.zeros((8, 4), "u1")
    joints[:, 0] = upper
    shares = np.tile(np.array([255, 0, 0, 0], "u1"), (8, 1))
    made.primitive["attributes"] |= {
        "JOINTS_0": made.add(joints, "VEC4"),
        "WEIGHTS_0": made.add(shares, "VEC4", normalized=True),
    }
    binding = np.tile(np.eye(4, dtype="f4"), (2, 1, 1))
    binding[:, 3, 1] = (0, 3)  # by columns: the second bone was at y = -3
    made.json["skins"] = [{"joints": [1, 2], "inverseBindMatrices": made.add(binding.reshape(2, 16), "MAT4")}]
    made.json["nodes"] = [
        {"mesh": 0, "skin": 0, "scale": [9, 1, 1]},  # does not count
        {"children": [2], "rotation": [0, 0, 0, 0]},
        {"translation": [0, -2, 0]},
    ]
    made.json["scenes"] = [{"nodes": [0, 1]}]


def test_meshes_are_posed_by_their_bones(tmp_path: Path) -> None:
    made = _Gltf()
    _with_bones(made)
    assert _sides(made.load(tmp_path)) == pytest.approx(np.array([1, 3, 3]) / np.sqrt(19), abs=1e-6)


def test_meshes_have_the_shape_of_their_weights(tmp_path: Path) -> None:
    made = _Gltf()
    wider = np.asarray(_BOX.vertices * (4, 0, 0), "f4")
    made.primitive["targets"] = [{"POSITION": made.add(wider, "VEC3")}]
    for of_mesh, of_node, width in ((0.5, None, 3), (0.5, 1.0, 5), (0.0, None, 1)):
        made.json["meshes"][0]["weights"] = [of_mesh]
        made.json["nodes"] = [{"mesh": 0} if of_node is None else {"mesh": 0, "weights": [of_node]}]
        sides = np.array([width, 2, 3])
        assert _sides(made.load(tmp_path)) == pytest.approx(sides / np.linalg.norm(sides), abs=1e-6)


def test_files_without_scenes(tmp_path: Path) -> None:
    made = _Gltf(_BOX.vertices / [1, 2, 3])
    del made.json["scenes"], made.json["scene"]
    made.json["nodes"] = [{"mesh": 0}, {"children": [0], "scale": [1, 2, 3]}]
    assert _sides(made.load(tmp_path)) == pytest.approx(_SIDES)
    del made.json["nodes"]
    assert _sides(made.load(tmp_path)) == pytest.approx(np.full(3, 1 / np.sqrt(3)))


@pytest.mark.parametrize("extension", ["EXT_meshopt_compression", "EXT_mesh_gpu_instancing"])
def test_geometry_in_an_extension_is_refused(extension: str, tmp_path: Path) -> None:
    made = _Gltf()
    made.json |= {"extensionsUsed": [extension], "extensionsRequired": [extension]}
    with pytest.raises(MeshError, match=f"needs the glTF extension {extension}, which is not read"):
        made.load(tmp_path)
    made.json["extensionsRequired"] = ["KHR_materials_unlit"]
    assert len(made.load(tmp_path).faces) == 12


@pytest.mark.parametrize("name", ["my data.bin", "My Data.BIN"])
def test_names_of_files_as_in_addresses(name: str, tmp_path: Path) -> None:
    made = _Gltf()
    made.paint(tmp_path, {})
    (tmp_path / "t.png").rename(tmp_path / "my T.png")
    made.json["images"] = [{"uri": "my%20T.png"}]
    made.primitive["attributes"]["TEXCOORD_0"] = made.add(np.full((8, 2), 0.25, "f4"), "VEC2")
    (tmp_path / name).write_bytes(made.data)
    surface = made.load(tmp_path, "my%20data.bin")
    assert len(surface.faces) == 12
    assert surface.missing_files == ()
    assert _seen(surface) == [0, 1, 0]


def test_broken_files_say_so(tmp_path: Path) -> None:
    made = _Gltf()
    (tmp_path / "short.bin").write_bytes(made.data[:50])
    for uri, said in (("short.bin", "50 bytes long instead of"), ("gone.bin", "gone.bin")):
        with pytest.raises(MeshError, match=said):
            made.load(tmp_path, uri)
    for content, said in (
        (b"glTF" + bytes(4), "ends early"),
        (b"<html>", "neither GLB nor the JSON"),
        (b'{"asset": {"version": "1.0"}}', "only version 2"),
    ):
        (tmp_path / "a.glb").write_bytes(content)
        with pytest.raises(MeshError, match=said):
            load_surface(tmp_path / "a.glb")


_TURNED = {"KHR_texture_transform": {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [0.5, 0.25]}}


@pytest.mark.parametrize(
    ("texture", "uv", "more", "expected"),
    [
        ({}, np.array([[0.75, 0.5]], "f4"), {}, (0.75, 0.5)),
        ({"texCoord": 1}, np.array([[0.75, 0.25]], "f4"), {}, (0.75, 0.75)),
        ({}, np.array([[255, 51, 0, 0]], "u1")[:, :2], {"normalized": True}, (1, 0.8)),
        ({}, np.array([[32767, 0]], "i2"), {"normalized": True}, (1, 1)),
        # (0.5, 0.25) is scaled to (0.25, 0.0625), and a quarter turn takes (u, v) to (v, -u).
        ({"extensions": _TURNED}, np.array([[0.5, 0.25]], "f4"), {}, (0.3125, 0.75)),
    ],
)
def test_texture_coordinates(
    texture: dict[str, Any], uv: np.ndarray, more: dict[str, Any], expected: Any, tmp_path: Path
) -> None:
    made = _Gltf()
    made.paint(tmp_path, texture)
    attributes = made.primitive["attributes"]
    attributes["TEXCOORD_0"] = made.add(np.zeros((8, 2), "f4"), "VEC2")
    name = f"TEXCOORD_{texture.get('texCoord', 0)}"
    attributes[name] = made.add(np.ascontiguousarray(np.repeat(uv, 8, 0)), "VEC2", **more)
    assert made.load(tmp_path).corner_uv[0, 0] == pytest.approx(expected, abs=1e-6)


def test_pictures_are_multiplied_by_factors_and_colours_of_vertices(tmp_path: Path) -> None:
    made = _Gltf()
    made.paint(tmp_path, {}, baseColorFactor=[1, 0.033105, 0, 1])  # 0.2 in sRGB
    made.primitive["attributes"]["TEXCOORD_0"] = made.add(np.full((8, 2), 0.75, "f4"), "VEC2")
    assert _seen(made.load(tmp_path)) == [1, 0.2, 0]
    half = np.repeat(np.array([[14027, 65535, 0, 65535]], "u2"), 8, 0)  # 0.5 in sRGB
    made.primitive["attributes"]["COLOR_0"] = made.add(half, "VEC4", normalized=True)
    assert _seen(made.load(tmp_path)) == [0.5, 0.2, 0]
    del made.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    assert _seen(made.load(tmp_path)) == [0.5, 0.2, 0]
    del made.json["materials"], made.primitive["material"]
    assert _seen(made.load(tmp_path)) == pytest.approx([0.5, 1, 0], abs=0.003)


def test_colours_of_trimesh_are_those_of_pictures(tmp_path: Path) -> None:
    made = _Gltf()
    made.json["asset"]["generator"] = "https://github.com/mikedh/trimesh"
    colours = np.repeat(np.array([[51, 255, 0, 255]], "u1"), 8, 0)
    made.primitive["attributes"]["COLOR_0"] = made.add(colours, "VEC4", normalized=True)
    assert _seen(made.load(tmp_path)) == [0.2, 1, 0]


@pytest.mark.parametrize("material", [{}, {"pbrMetallicRoughness": {"metallicFactor": 0}}])
def test_materials_without_a_colour_are_white(material: dict[str, Any], tmp_path: Path) -> None:
    made = _Gltf()
    made.json["materials"] = [material]
    made.primitive["material"] = 0
    assert _seen(made.load(tmp_path)) == [1, 1, 1]


def test_colours_of_the_older_material_model(tmp_path: Path) -> None:
    made = _Gltf()
    name = "KHR_materials_pbrSpecularGlossiness"
    made.json["materials"] = [{"extensions": {name: {"diffuseFactor": [1, 0, 0, 1]}}}]
    made.primitive["material"] = 0
    assert _seen(made.load(tmp_path)) == [1, 0, 0]
