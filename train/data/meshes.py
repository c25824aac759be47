"""Meshes of any format to a data tree: load, turn upright, scale to a unit box, render, sample."""

from __future__ import annotations

import csv
import dataclasses
import glob
import hashlib
import io
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from diffpoint.camera import PinholeCamera
from train.data import game_meshes, mesh_text, tree_files
from train.data.categories import category_of
from train.data.images import eight_bits
from train.data.mesh_sources import (
    MESH_SUFFIXES,
    UPRIGHT,
    MeshFile,
    find_meshes,
    keep_labelled,
    of_category,
    read_labels,
    shape_ids,
)
from train.data.render import Orbit, Renderer, draw_camera, orbit_camera
from train.data.surface import Surface, sample_triangles
from train.errors import UserError
from train.files import as_paths, write_text
from train.processes import map_unordered

# What trimesh logs, with tracebacks, is among the reasons and the missing files of a report.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

LEFT_OUT = "left_out.csv"
"""In the dataset's folder: the meshes that the last run could not use, and why."""

_NAMED = 20  # as many are named on the terminal
_TEXTURE_SIZE = 512
"""Larger textures are made smaller: a view has few pixels, and the nearest texel of a large texture is noise."""

_LARGEST_FILE = 256 << 20
"""Bytes: about ten million faces, which take 5 GB of memory to read. A mesh of three million takes 1.7 GB."""

_UNREAD_PICTURES = (".exr", ".hdr", ".ktx", ".ktx2", ".svg")

_LFS = b"version https://git-lfs"

_MAX_STRETCH = 0.3  # natural logarithm of the factor along an axis
_FLAT = 1e-5  # extent over the diagonal

_CAMERAS, _SIZE = 64, 320
_DRAWN_AT_ONCE = 4  # candidates for each requested point
_ROUNDS = 8
_SAME, _NEAR = 1e-4, 0.02
"""Shares of the depth. A face hides a point if its plane is nearer by more than the first on the ray to the point; the
plane counts only if the depth at the pixel's centre differs from the point's by less than the second."""


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """How meshes become shapes. All but the category and `stretched` must be the same throughout a dataset.

    Attributes:
        category: of every mesh; None reads it from folders or labels.
        up: the axis that points up in the files: x, y, z, -x, -y or -z.
        scale: world units per unit of the files; None gives each mesh a bounding box with the diagonal 1.
        drop_hidden: leave out ground-truth points that are visible neither in a view nor from outside.
        stretched: how many more shapes are made of each mesh, stretched along its three axes; see `stretch`.
        orbit: positions of the cameras.
    """

    category: str | None = None
    up: str = "y"
    scale: float | None = None
    drop_hidden: bool = False
    stretched: int = 0
    orbit: Orbit = dataclasses.field(default_factory=Orbit)

    def check(self) -> None:
        """Refuses options that are out of range.

        Raises:
            UserError: an unknown axis, a scale that is not positive, or cameras that cannot hold a shape.
        """
        if self.up not in UPRIGHT:
            raise UserError(f"up must be one of {', '.join(UPRIGHT)}; got {self.up!r}")
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise UserError(f"scale must be positive; got {self.scale}")
        tree_files.require_between(stretched=(self.stretched, 0, 99))
        self.orbit.check()


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """What `convert` did.

    Attributes:
        out: the dataset.
        made, kept, others: its shapes that this run and an earlier one have made of these sources, and all others.
        counts, categories: its shapes by split and by category.
        failures: reasons by the name of the mesh.
        missing_files: textures and other files that were not found or cannot be read, by the mesh that names them.
    """

    out: Path
    made: int
    kept: int
    others: int
    counts: dict[str, int]
    categories: dict[str, int]
    failures: dict[str, str]
    missing_files: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    def summary(self) -> str:
        """Lines for the terminal."""
        splits, kinds = tree_files.in_words(self.counts), tree_files.in_words(self.categories)
        earlier = f", {self.kept} were there" if self.kept else ""
        earlier += f", {self.others} are not from these sources" if self.others else ""
        lines = [f"{self.out}: made {self.made} shapes{earlier} ({splits}): {kinds}"]
        lost = {name: ", ".join(files) for name, files in self.missing_files.items()}
        for words, by_mesh, rest in (
            ("meshes were left out:", self.failures, f"; {self.out / LEFT_OUT} names all"),
            ("meshes were made without files that they name:", lost, ""),
        ):
            named = sorted(by_mesh.items())
            lines += [f"{len(named)} {words}"] if named else []
            lines += [f"  {name}: {reason}" for name, reason in named[:_NAMED]]
            lines += [f"  and {len(named) - _NAMED} others{rest}"] if len(named) > _NAMED else []
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Job:
    mesh: MeshFile
    shape: str
    stretched: bool
    out: Path
    size: int
    views: int
    seed: int
    options: MeshOptions


def convert(
    sources: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    labels: str | Path | None = None,
    unlabelled: bool = False,
    size: int = 224,
    views: int = 8,
    seed: int = 0,
    processes: int | None = None,
    options: MeshOptions | None = None,
) -> MeshReport:
    """Makes a data tree of meshes; running it again finishes or extends it.

    Args:
        sources: folders, .zip and .sh3f archives, and mesh files (a suffix of `MESH_SUFFIXES`).
        out: folder of the dataset.
        labels: CSV with the columns library, model, category, synset; only the meshes it names are made. Without
            one, the category is that of a folder on the path (a name of the paper's or a synset), or "unknown".
        unlabelled: make the meshes without a label too, as if there were no label file.
        size: pixels of a side of each view.
        views: per mesh.
        seed: of cameras, samples and split.
        processes: None for one per core.
        options: of the meshes and the cameras.

    Raises:
        UserError: sources without meshes, an unreadable label file, an option out of range, a folder that holds
            something else, not a single usable mesh (nothing is left behind then), or a full disk.
    """
    options, out = options or MeshOptions(), Path(out)
    labels = None if labels is None else Path(labels)
    sources = as_paths(sources)
    tree_files.require_between(size=(size, 16, 2048), views=(views, 1, 256))
    if labels is not None and options.category is not None:
        raise UserError("labels and category both set the category of the meshes; give one of them")
    if unlabelled and labels is None:
        raise UserError(
            "unlabelled says what happens to meshes that a label file does not name; give labels too"
        )
    options.check()
    wanted = None if labels is None else read_labels(labels)
    with tempfile.TemporaryDirectory(prefix="meshes-") as scratch:
        meshes, failures = find_meshes(sources, scratch, up=options.up)
        if not meshes:
            named = ", ".join(map(str, sources)) or "no sources"
            raise UserError(f"no meshes in {named}; looked for {', '.join(MESH_SUFFIXES)}")
        if wanted is not None and labels is not None:
            meshes, absent = keep_labelled(meshes, wanted, labels, others=unlabelled)
            failures |= absent
        if options.category is not None:
            meshes = of_category(meshes, options.category)
        settings = {
            "kind": "meshes",
            "seed": seed,
            "size": size,
            "views": views,
            "elevation": list(options.orbit.elevation_deg),
            "distance": options.orbit.distance,
            "focal": options.orbit.focal,
            "up": options.up,
            "scale": options.scale,
            "drop hidden": options.drop_hidden,
        }
        tree_files.prepare_output(out, settings)
        named = zip(meshes, shape_ids(meshes), strict=True)
        jobs = [
            _Job(
                mesh, f"{shape}_stretched{copy}" if copy else shape, copy > 0, out, size, views, seed, options
            )
            for mesh, shape in named
            for copy in range(1 + options.stretched)
        ]
        made = kept = 0
        missing_files: dict[str, tuple[str, ...]] = {}
        for job, result in map_unordered(
            _convert_one, jobs, processes=processes, title="rendering meshes", unit="mesh"
        ):
            if isinstance(result, Exception):
                failures[job.mesh.name] = str(result)
            else:
                made += result is not None
                kept += result is None
                if result:
                    missing_files[job.mesh.name] = result
    counts = tree_files.write_lists(out, seed=seed)
    totals = {split: sum(by_synset.values()) for split, by_synset in counts.items()}
    if not sum(totals.values()):
        tree_files.discard(out)
        raise UserError(f"no usable mesh; {tree_files.first_of(failures)}")
    if failures:
        table = io.StringIO()
        csv.writer(table).writerows([("mesh", "reason"), *sorted(failures.items())])
        write_text(out / LEFT_OUT, table.getvalue())
    else:
        (out / LEFT_OUT).unlink(missing_ok=True)
    categories = {
        category_of(synset): sum(by_synset[synset] for by_synset in counts.values())
        for synset in counts["train"]
    }
    others = sum(totals.values()) - made - kept
    return MeshReport(out, made, kept, others, totals, categories, failures, missing_files)


def _convert_one(job: _Job) -> tuple[str, ...] | Exception | None:
    """Makes one shape and returns the names of files that were not found; None if it was there already."""
    if tree_files.is_written(job.out, job.shape):
        return None
    options = job.options
    try:
        surface = load_surface(job.mesh.path, job.mesh.rotation, scale=options.scale, root=job.mesh.root)
        entropy = int.from_bytes(hashlib.sha256(job.shape.encode()).digest()[:8], "big")
        cameras, samples, factors = (np.random.default_rng([job.seed, entropy, k]) for k in range(3))
        if job.stretched:
            surface = stretch(surface, factors)
        radius = float(np.linalg.norm(surface.vertices, axis=1).max())
        if options.scale is not None and radius > options.orbit.max_radius:
            raise MeshError(
                f"its radius is {radius:.2f} world units and the frame holds {options.orbit.max_radius:.2f}: "
                "lower the scale"
            )
        camera = draw_camera(cameras, job.views, job.size, options.orbit)
        renderer = Renderer(surface)
        views = renderer.render(camera)
        empty = np.flatnonzero(~np.isfinite(views.depth).any((1, 2)))
        if len(empty):
            raise MeshError(
                f"view {empty[0]} of {job.views} shows nothing: the mesh is too thin or too small for its pixels"
            )
        if options.drop_hidden:
            points = sample_visible(renderer, camera, tree_files.POINTS, samples)
        else:
            points, _ = sample_triangles(surface.vertices[surface.faces], tree_files.POINTS, samples)
        tree_files.write_shape(job.out, job.shape, views, points)
    except (MeshError, UserError, OSError) as error:
        return error
    except Exception as error:  # whatever is wrong with one mesh, the others must be made
        return MeshError(f"{type(error).__name__}: {error}")
    return surface.missing_files


# Reading a mesh file: any format of trimesh or `game_meshes`, with its textures, materials and colours.


class MeshError(Exception):
    """Why a mesh cannot become a shape."""


def load_surface(
    path: str | Path,
    rotation: Sequence[float] | None = None,
    *,
    scale: float | None = None,
    root: str | Path | None = None,
) -> Surface:
    """Loads a mesh, turns it, and centres its bounding box on the origin.

    Args:
        path: the file.
        rotation: 9 numbers, row by row; None for none.
        scale: world units per unit of the file; None makes the diagonal of the bounding box 1, as ShapeNet does.
        root: folder below which its materials and textures may be; by default that above the file's, for ShapeNet's
            second version names textures `../images/...`.

    Raises:
        MeshError: no faces, coordinates that are no numbers, no extent in one of the three directions (as one triangle
            has none), a file that cannot be read or is too large.
    """
    path = Path(path)
    if path.stat().st_size > _LARGEST_FILE:
        raise MeshError(f"larger than {_LARGEST_FILE >> 20} MB: reduce its number of faces")
    try:
        files = _Files(path, Path(root) if root else path.parent.parent)
        suffix = path.suffix.lower()
        with path.open("rb") as file:
            if file.read(len(_LFS)) == _LFS:
                raise MeshError("a pointer of Git LFS instead of the file: fetch it with git lfs pull")
            file.seek(0)
            if suffix in game_meshes.READERS:
                scene = game_meshes.READERS[suffix](file.read(), files.get)
            elif suffix in mesh_text.READERS:
                scene = mesh_text.READERS[suffix](file.read(), files)
            else:
                scene = trimesh.load(file, file_type=suffix[1:], resolver=files, force="scene", process=False)
        parts = _parts(scene)  # pyright: ignore[reportArgumentType]
    except MeshError:
        raise
    except Exception as error:  # each format's reader has its own exceptions
        raise MeshError(f"cannot be read ({type(error).__name__}: {error})") from error
    if not parts:
        raise MeshError("no faces: points and lines have no surface to render")
    surface = _joined(parts)
    corners = surface.vertices[surface.faces]
    if not np.isfinite(corners).all():
        raise MeshError("NaN or infinite vertices")
    if rotation is not None:
        corners = corners @ np.reshape(rotation, (3, 3)).T
    low, high = corners.min((0, 1)), corners.max((0, 1))
    diagonal = float(np.linalg.norm(high - low))
    if diagonal == 0 or not np.isfinite(diagonal):
        raise MeshError("no extent: all its vertices are at one point")
    corners = (corners - (low + high) / 2) / diagonal
    sides = corners[:, 1:] - corners[:, :1]
    if np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() < 1e-9:
        raise MeshError("no area: all its faces are lines or points")
    corners = corners.reshape(-1, 3)
    _, axes = np.linalg.eigh(corners.T @ corners - len(corners) * np.outer(corners.mean(0), corners.mean(0)))
    if np.ptp(corners @ axes[:, 0]) < _FLAT:
        raise MeshError("flat: all its faces lie in one plane, a view along it would show nothing")
    if scale is not None:
        corners *= diagonal * scale
    return dataclasses.replace(
        surface,
        vertices=corners,
        faces=np.arange(len(corners)).reshape(-1, 3),
        missing_files=files.missing,
    )


def stretch(surface: Surface, rng: np.random.Generator) -> Surface:
    """The same mesh, stretched along the world's axes by random factors between 0.74 and 1.35; its diagonal is kept.

    A wider sofa is another sofa: a few hundred meshes teach more proportions than they have.

    Example:
        >>> from train.data.solids import box, surface_of
        >>> cube = surface_of([box((0.5, 0.5, 0.5), (0, 0, 0), np.ones(3))])
        >>> sides = np.ptp(stretch(cube, np.random.default_rng(0)).vertices, axis=0)
        >>> bool(np.isclose(np.linalg.norm(sides), np.linalg.norm([0.5] * 3))), len(np.unique(sides.round(3)))
        (True, 3)
    """
    factors = np.exp(rng.uniform(-_MAX_STRETCH, _MAX_STRETCH, 3))
    vertices = surface.vertices * factors
    diagonals = [np.linalg.norm(np.ptp(corners, axis=0)) for corners in (surface.vertices, vertices)]
    return dataclasses.replace(surface, vertices=vertices * (diagonals[0] / diagonals[1]))


class _Files(FilePathResolver):
    """Finds the files that a mesh names: beside it or elsewhere below a folder.

    Names may have slashes of either kind, quotes, percent signs as in addresses, and letters of another case.
    """

    def __init__(self, path: Path, root: Path) -> None:
        super().__init__(str(path))
        self._root = root.resolve()
        self._asked: dict[str, bool] = {}

    @property
    def missing(self) -> tuple[str, ...]:
        """Names that were not found, under no suffix that was tried, and pictures that cannot be read."""
        found = {Path(name).stem for name, exists in self._asked.items() if exists}
        return tuple(
            name for name, exists in self._asked.items() if not exists and Path(name).stem not in found
        )

    def get(self, name: str) -> bytes:
        name = name.strip().replace("\\", "/")
        content = self._read(name)
        self._asked[name] = content is not None and _is_usable(name, content)
        if content is None:
            raise FileNotFoundError(name)
        return mesh_text.clean_mtl(content) if name.lower().endswith(".mtl") else content

    def _read(self, name: str) -> bytes | None:
        plain = name.strip('"')
        spelled = dict.fromkeys(
            Path(self.parent, candidate).resolve()
            for each in (name, plain, unquote(plain))
            for candidate in (each, each.lstrip("/"), each.rpartition("/")[2])
        )
        for spell in (Path, _in_any_case):
            for path in filter(None, map(spell, spelled)):
                if path.is_relative_to(self._root) and path.is_file():
                    return path.read_bytes()
        # FlightGear's paints: in this folder is one for each airline.
        paints = Path(self.parent).resolve().parent / "Textures"
        for path in sorted(paints.rglob(glob.escape(name.rpartition("/")[2]))):
            if path.is_relative_to(self._root) and path.is_file():
                return path.read_bytes()
        return None


def _is_usable(name: str, content: bytes) -> bool:
    """False for a broken picture, or one in a format that is not read: readers of meshes leave it out silently."""
    suffix = Path(name).suffix.lower()
    if suffix not in Image.registered_extensions():
        return suffix not in _UNREAD_PICTURES
    try:
        Image.open(io.BytesIO(content)).close()
    except Exception:  # every decoder has its own exceptions
        return False
    return True


def _in_any_case(path: Path) -> Path | None:
    """A path that exists and differs in no more than the case of letters, which Windows does not mind."""
    if path.exists():
        return path
    folder = _in_any_case(path.parent) if path.parent != path else None
    if folder is None or not folder.is_dir():
        return None
    name = path.name.casefold()
    return min((each for each in folder.iterdir() if each.name.casefold() == name), default=None)


def _parts(scene: trimesh.Scene) -> list[Surface]:
    """The scene's meshes where its graph puts them; lines and points are left out."""
    parts = []
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        if mesh.faces.max() >= len(mesh.vertices) or mesh.faces.min() < 0:
            raise MeshError("faces with indices of vertices that it does not have")
        vertices = np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        parts.append(_coloured(mesh, vertices, np.asarray(mesh.faces)))
    return parts


def _coloured(mesh: trimesh.Trimesh, vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Texture if there is one, else vertex or face colours, else the material's colour; in glTF, their product."""
    visual = mesh.visual
    colours = np.full((len(faces), 3), 0.7)
    if isinstance(visual, TextureVisuals):
        tint = _tint(visual, faces)
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        uv = visual.uv
        if image is not None and uv is not None and len(uv) == len(vertices) and np.isfinite(uv).all():
            return Surface(
                vertices,
                faces,
                np.ones((len(faces), 3, 3), np.float32) if tint is None else tint,
                np.zeros(len(faces), int),
                np.asarray(uv, np.float32)[faces],
                (_texture(image, *_transparency(material)),),
            )
        if tint is not None and "color" in visual.vertex_attributes:
            return dataclasses.replace(Surface.plain(vertices, faces, colours), corner_colours=tint)
        colours[:] = np.asarray(material.main_color[:3]) / 255
    elif isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        surface = Surface.plain(vertices, faces, colours)
        corner_colours = np.asarray(visual.vertex_colors)[faces, :3].astype(np.float32) / 255
        return dataclasses.replace(surface, corner_colours=corner_colours)
    elif isinstance(visual, ColorVisuals) and visual.kind == "face":
        colours = np.asarray(visual.face_colors)[:, :3] / 255
    return Surface.plain(vertices, faces, colours)


def _tint(visual: TextureVisuals, faces: np.ndarray) -> np.ndarray | None:
    """(F, 3, 3): by what glTF multiplies the picture, the material's factor and the colours of vertices."""
    if not isinstance(visual.material, PBRMaterial):
        return None
    tint = np.ones((len(faces), 3, 3), np.float32)
    if visual.material.baseColorFactor is not None:
        tint *= np.asarray(visual.material.baseColorFactor[:3], np.float32) / 255
    colours = visual.vertex_attributes.get("color")
    if colours is not None:
        top = np.iinfo(colours.dtype).max if colours.dtype.kind == "u" else 1
        tint *= (np.asarray(colours, np.float32)[faces, :3] / top).clip(0, 1)
    return tint


def _transparency(material: object) -> tuple[str, float]:
    """How a material reads its texture's alpha, and the threshold of MASK; glTF's default is not to read it."""
    mode = (
        (getattr(material, "alphaMode", None) or "OPAQUE") if isinstance(material, PBRMaterial) else "BLEND"
    )
    cutoff = getattr(material, "alphaCutoff", None)
    return mode, 0.5 if cutoff is None else cutoff


def _texture(image: Image.Image, alpha_mode: str, cutoff: float) -> np.ndarray:
    """RGB (h, w, 3) uint8, transparency on white."""
    image = eight_bits(image).convert("RGBA")
    if alpha_mode == "OPAQUE":
        image.putalpha(255)
    elif alpha_mode == "MASK":
        shown = np.asarray(image.getchannel("A")) >= 255 * cutoff
        image.putalpha(Image.fromarray(np.where(shown, 255, 0).astype(np.uint8)))
    image.thumbnail((_TEXTURE_SIZE, _TEXTURE_SIZE))
    ground = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(ground, image).convert("RGB"))


def _joined(parts: Sequence[Surface]) -> Surface:
    vertices = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    textures = np.cumsum([0] + [len(part.textures) for part in parts[:-1]])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, vertices, strict=True)]),
        np.concatenate([part.corner_colours for part in parts]),
        np.concatenate(
            [
                np.where(part.face_texture < 0, -1, part.face_texture + start)
                for part, start in zip(parts, textures, strict=True)
            ]
        ),
        np.concatenate([part.corner_uv for part in parts]),
        tuple(texture for part in parts for texture in part.textures),
    )


# Ground truth without the inside: samples that are visible in a view, or from outside.


def sample_visible(
    renderer: Renderer, camera: PinholeCamera, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Points (count, 3), uniform by area on the visible part of the surface.

    The bottoms of drawers, and parts inside of others, are left out: no picture shows them. A point is visible if one
    of the views' cameras (V,) sees it, or one of 64 cameras all around.

    Raises:
        MeshError: nearly nothing of the surface is visible.

    Example:
        >>> from train.data.solids import box, surface_of
        >>> outer, inner = (box((size,) * 3, (0, 0, 0), np.ones(3)) for size in (0.5, 0.4))
        >>> renderer, rng = Renderer(surface_of([outer, inner])), np.random.default_rng(0)
        >>> points = sample_visible(renderer, orbit_camera(np.zeros(1), np.zeros(1), 64), 500, rng)
        >>> bool(np.isclose(np.abs(points).max(1), 0.25).all())
        True
    """
    surface = renderer.surface
    triangles = surface.vertices[surface.faces]
    # Cameras evenly over a sphere (a Fibonacci lattice) around all of the shape, which fills their frames.
    number = np.arange(_CAMERAS)
    elevation_deg = np.degrees(np.arcsin(1 - (2 * number + 1) / _CAMERAS))
    azimuth_deg = np.degrees(number * np.pi * (3 - np.sqrt(5)))
    radius = float(np.linalg.norm(surface.vertices, axis=1).max())
    around = orbit_camera(azimuth_deg, elevation_deg, _SIZE, Orbit(distance=4 * radius))
    kept: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        points, face = sample_triangles(triangles, _DRAWN_AT_ONCE * count, rng)
        seen = np.zeros(len(points), bool)
        for cameras in (camera, around):
            for number in range(len(cameras.K)):
                left = np.flatnonzero(~seen)
                seen[left] = _sees(renderer, cameras, number, points[left], face[left])
        kept.append(points[seen])
        if sum(map(len, kept)) >= count:
            return np.concatenate(kept)[:count]
    raise MeshError("nearly nothing of its surface is visible from outside")


def _sees(
    renderer: Renderer, camera: PinholeCamera, view: int, points: np.ndarray, face: np.ndarray
) -> np.ndarray:
    """(N,) bool: which points (N, 3), each on its face (N,), one of the cameras sees."""
    hits = renderer.hits(camera, view)
    K, cam_from_world = camera.K[view].double().numpy(), camera.cam_from_world[view].double().numpy()
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    in_cam = points @ rotation.T + translation
    depth = in_cam[:, 2]
    column, row = np.floor(in_cam @ K[:2].T / depth[:, None]).T
    framed = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    at = row[framed].astype(int), column[framed].astype(int)
    first, first_depth = hits.face[at], hits.depth[at]
    eye = -rotation.T @ translation
    normals = renderer.normals[first]
    towards = points[framed] - eye
    with np.errstate(divide="ignore", invalid="ignore"):  # a plane that the ray runs along hides nothing
        reach = (renderer.offsets[first] - normals @ eye) / np.einsum("nc,nc->n", normals, towards)
    clear = (reach >= 1 - _SAME) & (first_depth > (1 - _NEAR) * depth[framed])
    seen = np.zeros(len(points), bool)
    seen[framed] = clear | (first == face[framed]) | (first < 0)
    return seen
