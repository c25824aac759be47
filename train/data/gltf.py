"""glTF files rewritten without what trimesh misreads.

trimesh reads sparse accessors as zeros, takes the texture coordinates of the first set as they are (whatever set and
transform the material names, and integers that stand for [0, 1]), leaves out fans, needs a scene, and ignores
extensions that it does not know, also those that say where the geometry is. Colours, which are linear in glTF, it takes
for those of pictures, and materials without one for grey.
"""

from __future__ import annotations

import base64
import importlib.util
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from train.data.gltf_pose import DRACO, is_compressed, pose

_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_FAN = 6
_TRIANGLES = 4

_HARMLESS = (
    DRACO, "KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_animation_", "KHR_xmp",
    "EXT_texture_", "EXT_lights_", "MSFT_texture_", "MSFT_packing_", "ADOBE_materials_", "VRM",
)  # fmt: skip
"""How the names of extensions begin that leave the geometry as it is, or that are read."""

_SPECULAR = "KHR_materials_pbrSpecularGlossiness"
_TRANSFORM = "KHR_texture_transform"


def plain(content: bytes, file_content: Callable[[str], bytes]) -> bytes:
    """The same meshes and materials as a GLB file with one buffer; pictures in files of their own stay there.

    Raises:
        ValueError: the file is broken, its geometry is in an extension that is not read, or compressed with Draco while
            the package DracoPy is missing.
        FileNotFoundError: a file with its data is missing.
    """
    scene, binary = _split(content)
    required = scene.get("extensionsRequired", ())
    if DRACO in required and importlib.util.find_spec("DracoPy") is None:
        raise ValueError(
            "its geometry is compressed with Draco: pip install DracoPy, or save it uncompressed"
        )
    for extension in required:
        if not extension.startswith(_HARMLESS):
            raise ValueError(f"it needs the glTF extension {extension}, which is not read: save it without")
    document = _Document(scene, binary, file_content)
    by_trimesh = "trimesh" in scene.get("asset", {}).get("generator", "")
    for accessor in scene.get("accessors", ()):
        if "sparse" in accessor:
            document.make_dense(accessor)
    for material in scene.get("materials", ()):
        _without_specular(material)
        if by_trimesh:
            _without_default_grey(material)
        colours = material.setdefault("pbrMetallicRoughness", {})
        *colour, alpha = colours.get("baseColorFactor", (1, 1, 1, 1))
        colours["baseColorFactor"] = [*(colour if by_trimesh else _as_seen(np.array(colour)).tolist()), alpha]
    for mesh in scene.get("meshes", ()):
        for primitive in mesh["primitives"]:
            if not is_compressed(primitive):
                document.unroll_fan(primitive)
                document.transform_uv(primitive)
                document.convert_colours(primitive, linear=not by_trimesh)
    if not scene.get("scenes"):
        nodes = scene.setdefault("nodes", [{"mesh": i} for i in range(len(scene.get("meshes", ())))])
        inner = {child for node in nodes for child in node.get("children", ())}
        scene["scenes"] = [{"nodes": [i for i in range(len(nodes)) if i not in inner]}]
        scene["scene"] = 0
    pose(document)
    return document.as_glb()


def _split(content: bytes) -> tuple[dict[str, Any], bytes | None]:
    """The JSON of a file, and its binary chunk if it has one."""
    if content[:4] != b"glTF":
        return _parsed(content), None
    chunks, at = {}, 12
    while at + 8 <= len(content):
        length, kind = struct.unpack_from("<II", content, at)
        if at + 8 + length > len(content):
            raise ValueError("the file ends early")
        chunks.setdefault(kind, content[at + 8 : at + 8 + length])
        at += 8 + length + -length % 4
    if _JSON not in chunks:
        raise ValueError("the file ends early")
    return _parsed(chunks[_JSON]), chunks.get(_BINARY)


def _parsed(content: bytes) -> dict[str, Any]:
    try:
        found = json.loads(content.decode("utf-8-sig"))
    except ValueError as error:
        raise ValueError(f"neither GLB nor the JSON of glTF ({error})") from None
    if not isinstance(found, dict) or not str(found.get("asset", {}).get("version", "2")).startswith("2"):
        raise ValueError("only version 2 of glTF is read")
    return found


def _without_specular(material: dict[str, Any]) -> None:
    """Diffuse colours of the older material model as base colours."""
    older = material.get("extensions", {}).pop(_SPECULAR, None)
    if older is not None and "pbrMetallicRoughness" not in material:
        names = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
        material["pbrMetallicRoughness"] = {new: older[old] for old, new in names.items() if old in older}


def _without_default_grey(material: dict[str, Any]) -> None:
    """trimesh multiplies the pictures that it exports by the grey that it gives to materials without a colour."""
    colours = material.get("pbrMetallicRoughness", {})
    factor = colours.get("baseColorFactor")
    if "baseColorTexture" in colours and factor and np.allclose(factor[:3], 0.4, atol=0.002):
        del colours["baseColorFactor"]


def _as_seen(linear: np.ndarray) -> np.ndarray:
    """Linear colours in [0, 1] as pictures store them, in sRGB; trimesh writes its colours so in the first place."""
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


class _Document:
    """A file with all its data in one buffer, to which rewritten accessors are added."""

    def __init__(
        self, scene: dict[str, Any], binary: bytes | None, file_content: Callable[[str], bytes]
    ) -> None:
        self.scene = scene
        self.data = bytearray()
        starts = []
        for number, buffer in enumerate(scene.get("buffers", ())):
            uri = buffer.get("uri")
            if uri is None:
                part = binary if number == 0 and binary is not None else bytes(buffer["byteLength"])
            elif uri.startswith("data:"):
                part = base64.b64decode(uri.partition(",")[2])
            else:
                part = file_content(uri)
            if len(part) < buffer["byteLength"]:
                raise ValueError(f"its data is {len(part)} bytes long instead of {buffer['byteLength']}")
            starts.append(self._append(part))
        for view in scene.get("bufferViews", ()):
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
            view["buffer"] = 0

    def _append(self, part: bytes) -> int:
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += part
        return start

    def as_glb(self) -> bytes:
        self.data += bytes(-len(self.data) % 4)
        self.scene["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.scene).encode()
        text += b" " * (-len(text) % 4)
        chunks = [struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(self.data), _BINARY)]
        length = 12 + sum(map(len, chunks)) + len(self.data)
        return b"".join([b"glTF", struct.pack("<II", 2, length), *chunks, self.data])

    def _rows(self, view: int, kind: Any, count: int, width: int, start: int = 0) -> np.ndarray:
        """(count, width) numbers of a buffer view."""
        place = self.scene["bufferViews"][view]
        size = np.dtype(kind).itemsize
        first = place["byteOffset"] + start
        strides = (place.get("byteStride", width * size), size)
        if count and first + (count - 1) * strides[0] + width * size > len(self.data):
            raise ValueError("its data ends early")
        return np.ndarray((count, width), kind, self.data, first, strides).copy()

    def read(self, accessor: dict[str, Any]) -> np.ndarray:
        """(count, width) numbers as they are stored."""
        kind, width = _TYPES[accessor["componentType"]], _WIDTHS[accessor["type"]]
        if "bufferView" not in accessor:
            return np.zeros((accessor["count"], width), kind)
        start = accessor.get("byteOffset", 0)
        return self._rows(accessor["bufferView"], kind, accessor["count"], width, start)

    def read_scaled(self, accessor: dict[str, Any]) -> np.ndarray:
        """(count, width) float64, of integers that stand for [0, 1] or [-1, 1] those numbers."""
        stored = self.read(accessor)
        if not accessor.get("normalized") or stored.dtype.kind == "f":
            return stored.astype(np.float64)
        return np.maximum(stored / np.iinfo(stored.dtype).max, -1)

    def _write(self, values: np.ndarray) -> int:
        """The number of a new buffer view."""
        views = self.scene.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": self._append(values.tobytes()), "byteLength": values.nbytes})
        return len(views) - 1

    def add(self, values: np.ndarray, component: int, kind: str) -> int:
        """The number of a new accessor."""
        view = self._write(values.astype(_TYPES[component]))
        self.scene["accessors"].append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        )
        return len(self.scene["accessors"]) - 1

    def make_dense(self, accessor: dict[str, Any]) -> None:
        values, sparse = self.read(accessor), accessor.pop("sparse")
        at, new = sparse["indices"], sparse["values"]
        kind, count = _TYPES[at["componentType"]], sparse["count"]
        rows = self._rows(at["bufferView"], kind, count, 1, at.get("byteOffset", 0))[:, 0]
        values[rows] = self._rows(
            new["bufferView"], values.dtype, count, values.shape[1], new.get("byteOffset", 0)
        )
        accessor.update(bufferView=self._write(values), byteOffset=0)

    def unroll_fan(self, primitive: dict[str, Any]) -> None:
        if primitive.get("mode", _TRIANGLES) != _FAN:
            return
        accessors = self.scene["accessors"]
        if "indices" in primitive:
            corners = self.read(accessors[primitive["indices"]])[:, 0].astype(np.int64)
        else:
            corners = np.arange(accessors[primitive["attributes"]["POSITION"]]["count"])
        centre = np.broadcast_to(corners[:1], len(corners[2:]))
        triangles = np.stack((centre, corners[1:-1], corners[2:]), axis=1)
        primitive.update(mode=_TRIANGLES, indices=self.add(triangles.reshape(-1, 1), 5125, "SCALAR"))

    def transform_uv(self, primitive: dict[str, Any]) -> None:
        """Makes the first texture coordinates those that the base colour's picture is read at."""
        attributes = primitive["attributes"]
        materials = self.scene.get("materials", ())
        material = materials[primitive["material"]] if "material" in primitive else {}
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if texture is None:
            return
        change = texture.get("extensions", {}).get(_TRANSFORM, {})
        name = f"TEXCOORD_{change.get('texCoord', texture.get('texCoord', 0))}"
        if name not in attributes:
            attributes.pop("TEXCOORD_0", None)
            return
        accessor = self.scene["accessors"][attributes[name]]
        if name == "TEXCOORD_0" and not change and accessor["componentType"] == 5126:
            return
        uv = self.read_scaled(accessor)
        cos, sin = np.cos(change.get("rotation", 0)), np.sin(change.get("rotation", 0))
        turned = uv * change.get("scale", (1, 1)) @ np.array([[cos, -sin], [sin, cos]])
        attributes["TEXCOORD_0"] = self.add(turned + change.get("offset", (0, 0)), 5126, "VEC2")

    def convert_colours(self, primitive: dict[str, Any], *, linear: bool) -> None:
        """Makes the colours of vertices floats, as those of pictures."""
        attributes = primitive["attributes"]
        if "COLOR_0" in attributes:
            accessor = self.scene["accessors"][attributes["COLOR_0"]]
            colours = self.read_scaled(accessor | {"normalized": True})[:, :3]  # not all files say so
            colours = _as_seen(colours) if linear else colours
            attributes["COLOR_0"] = self.add(colours, 5126, "VEC3")
