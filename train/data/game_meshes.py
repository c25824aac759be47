"""Mesh formats of simulators and games that trimesh does not read: AC3D, with TORCS's strips, and Quake 2's MD2."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from train.data.images import eight_bits
from train.data.polygons import triangulate

FileContent = Callable[[str], bytes]
"""The content of a file that a mesh names; FileNotFoundError if there is none."""

_CLEAR = 0.5
"""Faces whose texture is more transparent than this are left out, such as discs that stand for turning propellers.
The colour of a material does not count: panes of glass belong to the shape."""

_EFFECT = re.compile(
    r"wake|sillage|flame|shadow|blur|prop\w*[ _.-]?(disc|disk|fast|slow)|\b(chute|hose|drogue)\b",
    re.IGNORECASE,
)
"""Names of AC3D objects that are no part of the shape: what moves too fast to be seen, and what trails behind."""

_IMAGE_SUFFIXES = (".png", ".jpg", ".tga")
_LINES, _STRIP = (1, 2), 4
"""Types of an AC3D surface besides polygons; the strip of triangles is TORCS's."""

_Colour = tuple[int, int, int]
_GREY = (178, 178, 178)


def read_ac3d(content: bytes, file_content: FileContent) -> trimesh.Scene:
    """Reads an AC3D file: the polygons of all objects but those of effects, in the frame of the file (y up).

    Args:
        content: of the .ac or .acc file; TORCS's .acc has normals behind the vertices, and strips of triangles.
        file_content: returns textures; those that it does not find or that are no image are replaced by the colour of
            the material.

    Raises:
        ValueError: not an AC3D file, or one that ends early or contains something unexpected.
    """
    lines = _Lines([line.decode("latin-1") for line in content.splitlines()])
    if not lines.next().startswith("AC3D"):
        raise ValueError("does not start with AC3D")
    materials: list[_Colour] = []
    # By texture and colour: corners (3 F, 3) and their places (3 F, 2) in the texture. One mesh for each, not for each
    # object, for every mesh keeps a texture of its own.
    parts: dict[tuple[str, _Colour], list[tuple[np.ndarray, np.ndarray]]] = {}
    # Of the objects around the current one: their own placement, and how many children they still expect.
    placements, expected = [(np.eye(3), np.zeros(3))], [1]
    while expected and not lines.at_end():  # some writers count children that they do not write
        if expected[-1] == 0:
            placements.pop()
            expected.pop()
            continue
        word, rest = lines.words()
        if word == "MATERIAL":
            colour = re.search(r"rgb\s+(\S+)\s+(\S+)\s+(\S+)", rest)
            numbers = [float(number) for number in colour.groups()] if colour else [0.7, 0.7, 0.7]
            red, green, blue = (round(255 * min(max(number, 0.0), 1.0)) for number in numbers)
            materials.append((red, green, blue))
        elif word == "OBJECT":
            expected[-1] -= 1
            part = _Ac3dObject(lines)
            rotation, origin = placements[-1]
            placed = part.rotation @ rotation, part.origin @ rotation + origin
            for material, triangles in part.triangles.items():
                colour = materials[material] if 0 <= material < len(materials) else _GREY
                corners = np.array(triangles, float).reshape(-1, 3)
                points = np.array(part.vertices)[corners[:, 0].astype(int)] @ placed[0] + placed[1]
                uv = corners[:, 1:] * part.repeat + part.offset
                parts.setdefault((part.texture, colour), []).append((points, uv))
            placements.append(placed)
            expected.append(part.children)
        else:
            raise ValueError(f"line {lines.number}: {word!r} where a MATERIAL or an OBJECT should be")
    images = {texture: _image(texture, file_content) for texture, _ in parts if texture}
    meshes = []
    for (texture, colour), arrays in parts.items():
        points, uv = (np.concatenate(each) for each in zip(*arrays, strict=True))
        meshes.append(_mesh(points, uv, images.get(texture), colour))
    return trimesh.Scene([mesh for mesh in meshes if len(mesh.faces)])


class _Lines:
    """The lines of a file, one after the other."""

    def __init__(self, lines: Sequence[str]) -> None:
        self._lines = lines
        self.number = 0
        """Of the last line, from 1."""

    def next(self) -> str:
        if self.number == len(self._lines):
            raise ValueError("the file ends early")
        self.number += 1
        return self._lines[self.number - 1]

    def at_end(self) -> bool:
        """Whether nothing but empty lines is left."""
        return all(not self._lines[at].strip() for at in range(self.number, len(self._lines)))

    def filled(self) -> str:
        """The next line that is not empty, without spaces around."""
        while not (line := self.next().strip()):
            pass
        return line

    def words(self) -> tuple[str, str]:
        """The first word of the next such line, and the rest."""
        word, _, rest = self.filled().partition(" ")
        return word, rest

    def triples(self, count: int) -> list[tuple[float, float, float]]:
        """The first three numbers of each of the next such lines."""
        rows = [self.filled().split() for _ in range(count)]
        return [(float(row[0]), float(row[1]), float(row[2])) for row in rows]


class _Ac3dSurface(NamedTuple):
    kind: int
    material: int
    corners: list[tuple[float, float, float]]
    """Index of the vertex, u and v."""


class _Ac3dObject:
    """An object without its children, as it is written: vertices in its own frame."""

    def __init__(self, lines: _Lines) -> None:
        self.rotation, self.origin = np.eye(3), np.zeros(3)  # row vectors: v @ rotation + origin
        self.name = self.texture = ""
        self.children = 0
        self.repeat, self.offset = np.ones(2), np.zeros(2)  # of the texture
        self.vertices: list[tuple[float, float, float]] = []
        self.triangles: dict[int, list[tuple[float, float, float]]] = {}
        """By material: index, u and v of the corners, three for each triangle; none of an effect."""
        while True:
            word, rest = lines.words()
            if word == "kids":
                self.children = int(rest)
                break
            if word == "rot":
                self.rotation = np.array(rest.split(), float).reshape(3, 3)
            elif word == "loc":
                self.origin = np.array(rest.split(), float)
            elif word == "name":
                self.name = rest
            elif word == "texture":  # TORCS names up to four: the paint, then dirt and light
                self.texture = self.texture or re.sub(r'^"?([^"]*).*$', r"\1", rest)
            elif word == "texrep":
                self.repeat = np.array(rest.split(), float)
            elif word == "texoff":
                self.offset = np.array(rest.split(), float)
            elif word == "data":  # text of the user's, which may look like anything
                left = int(rest)
                while left > 0:
                    left -= len(lines.next()) + 1
            elif word == "numvert":
                self.vertices = lines.triples(int(rest))
            elif word == "numsurf":
                self._add([self._read_surface(lines) for _ in range(int(rest))])
        if _EFFECT.search(self.name):
            self.triangles = {}

    def _add(self, surfaces: Sequence[_Ac3dSurface]) -> None:
        polygons = [
            [] if each.kind in (*_LINES, _STRIP) else [int(index) for index, _, _ in each.corners]
            for each in surfaces
        ]
        vertices = np.array(self.vertices, float).reshape(-1, 3)
        for surface, triangles in zip(surfaces, triangulate(vertices, polygons), strict=True):
            if surface.kind == _STRIP:
                triangles = np.arange(max(len(surface.corners) - 2, 0))[:, None] + np.arange(3)
            if len(triangles):
                corners = [surface.corners[at] for at in triangles.ravel().tolist()]
                self.triangles.setdefault(surface.material, []).extend(corners)

    def _read_surface(self, lines: _Lines) -> _Ac3dSurface:
        word, rest = lines.words()
        if word != "SURF":
            raise ValueError(f"line {lines.number}: {word!r} where a SURF should be")
        kind, material = int(rest, 16) & 15, 0
        word, rest = lines.words()
        if word == "mat":
            material = int(rest)
            word, rest = lines.words()
        if word != "refs":
            raise ValueError(f"line {lines.number}: {word!r} where refs should be")
        corners = lines.triples(int(rest))
        if any(not 0 <= index < len(self.vertices) for index, _, _ in corners):
            raise ValueError(f"line {lines.number}: refs to vertices that the object does not have")
        return _Ac3dSurface(kind, material, corners)


def read_md2(content: bytes, file_content: FileContent) -> trimesh.Scene:
    """Reads the first frame of an MD2 file, turned from z up to y up, with its first skin.

    A skin whose name starts with a dot, as in UFO: Alien Invasion, is a PNG, JPEG or TGA file beside the model.

    Raises:
        ValueError: not an MD2 file, or one that ends early.
    """
    header = np.frombuffer(content[:68], "<i4")
    if content[:4] != b"IDP2" or len(header) < 17:
        raise ValueError("does not start with IDP2")
    width, height = header[2:4]
    skins, vertices, uvs, faces = header[5:9]
    at_skins, at_uvs, at_faces, at_frames = header[11:15]
    if min(width, height, vertices, uvs, faces) < 1:
        raise ValueError("no faces")
    uv = np.frombuffer(content, "<i2", 2 * uvs, at_uvs).reshape(-1, 2) / (width, height)
    corners = np.frombuffer(content, "<u2", 6 * faces, at_faces).reshape(-1, 2, 3)
    scale, origin = np.frombuffer(content, "<f4", 6, at_frames).reshape(2, 3).astype(float)
    packed = np.frombuffer(content, "u1", 4 * vertices, at_frames + 40).reshape(-1, 4)
    if corners[:, 0].max() >= vertices or corners[:, 1].max() >= uvs:
        raise ValueError("faces with indices of vertices that it does not have")
    image = None
    if skins:
        image = _image(content[at_skins : at_skins + 64].split(b"\0")[0].decode("latin-1"), file_content)
    points = (packed[:, :3] * scale + origin)[:, (0, 2, 1)] * (1, 1, -1)
    places = uv * (1, -1) + (0, 1)  # v up
    mesh = _mesh(points[corners[:, 0].ravel()], places[corners[:, 1].ravel()], image, _GREY)
    return trimesh.Scene([mesh] if len(mesh.faces) else [])


def _mesh(corners: np.ndarray, uv: np.ndarray, image: Image.Image | None, colour: _Colour) -> trimesh.Trimesh:
    """Triangles of corners (3 F, 3) with places (3 F, 2) in the image, without those where the image is clear."""
    faces = np.arange(len(corners)).reshape(-1, 3)
    if image is None:
        visual = ColorVisuals(face_colors=np.tile((*colour, 255), (len(faces), 1)))
        return trimesh.Trimesh(corners, faces, visual=visual, process=False)
    uv = np.where(np.isfinite(uv), uv, 0)
    faces = faces[_opacity(image, uv[faces]) >= _CLEAR]
    visual = TextureVisuals(uv=uv, material=SimpleMaterial(image=image))
    return trimesh.Trimesh(corners, faces, visual=visual, process=False)


def _opacity(image: Image.Image, uv: np.ndarray) -> np.ndarray:
    """Mean opacity (F,) in [0, 1] of an image inside triangles (F, 3, 2), at fifteen points of each."""
    steps = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)])
    inside = (steps + 1 / 3) / 5
    places = np.einsum("pk,fkc->fpc", inside, uv) % 1.0
    opacity = np.asarray(image.getchannel("A"))
    height, width = opacity.shape
    column = (places[..., 0] * width).astype(int).clip(0, width - 1)
    row = ((1 - places[..., 1]) * height).astype(int).clip(0, height - 1)
    return opacity[row, column].mean(-1) / 255


def _image(name: str, file_content: FileContent) -> Image.Image | None:
    """An image that a mesh names, as RGBA, if it exists and can be read."""
    names = [name]
    if name.startswith("."):
        names = [f"{name[1:]}{suffix}" for suffix in _IMAGE_SUFFIXES]
    for candidate in names:
        try:
            return eight_bits(Image.open(io.BytesIO(file_content(candidate)))).convert("RGBA")
        except (OSError, ValueError, SyntaxError):
            continue
    return None


READERS = {".ac": read_ac3d, ".acc": read_ac3d, ".md2": read_md2}
"""By the suffix of the file."""
