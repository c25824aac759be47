"""Meshes of any make to the dataset: load, stand upright in a unit box, render, sample."""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals

from train.data import store
from train.data.categories import category_of
from train.data.render import Renderer, draw_camera
from train.data.sources import MeshFile, find_meshes, keep_labelled, read_labels, shape_ids
from train.data.surface import Surface, sample_triangles
from train.data.work import run_all
from train.errors import UserError

_TEXTURE_SIZE = 512
"""Larger textures are made smaller: a view has few pixels, and the nearest texel of a large texture is noise."""


class MeshError(Exception):
    """Why a mesh cannot become a shape."""


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """What `convert` did; `failures` gives the reason by the name of the mesh."""

    out: Path
    made: int
    kept: int
    counts: dict[str, int]
    categories: dict[str, int]
    failures: dict[str, str]

    def summary(self) -> str:
        """Lines for the terminal."""
        splits = ", ".join(f"{count} {split}" for split, count in self.counts.items())
        kinds = ", ".join(f"{count} {name}" for name, count in self.categories.items())
        earlier = f", {self.kept} were there" if self.kept else ""
        lines = [f"{self.out}: made {self.made} shapes{earlier} ({splits}): {kinds}"]
        if self.failures:
            lines.append(f"{len(self.failures)} meshes were left out:")
            lines += [f"  {name}: {reason}" for name, reason in sorted(self.failures.items())]
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Job:
    mesh: MeshFile
    shape: str
    out: Path
    size: int
    views: int
    seed: int


def convert(
    sources: Sequence[Path],
    out: Path,
    *,
    labels: Path | None,
    size: int = 224,
    views: int = 8,
    seed: int = 0,
    processes: int | None = None,
) -> MeshReport:
    """Make a dataset of meshes; running it again finishes or extends it.

    Args:
        sources: folders, .zip and .sh3f archives, and mesh files (OBJ with its materials, GLB, PLY, OFF, STL).
        out: folder of the dataset.
        labels: CSV with the columns library, model, category, synset; only the meshes it names are made. Without
            one, the category is that of a folder on the path (a name of the paper's or a synset), or "unknown".
        size: pixels of a side of each view.
        views: per mesh.
        seed: of cameras, samples and split.
        processes: None for one per core.

    Raises:
        UserError: sources without meshes, an unreadable label file, a folder that holds something else, or not a
            single usable mesh; nothing is left behind then.
    """
    for name, value, low, high in (("size", size, 16, 2048), ("views", views, 1, 256)):
        if not low <= value <= high:
            raise UserError(f"{name} must be between {low} and {high}; got {value}")
    wanted = read_labels(labels) if labels is not None else None
    with tempfile.TemporaryDirectory(prefix="meshes-") as scratch:
        meshes, failures = find_meshes([Path(source) for source in sources], Path(scratch))
        if not meshes:
            raise UserError(f"no meshes in {', '.join(map(str, sources)) or 'no sources'}")
        if wanted is not None and labels is not None:
            meshes, absent = keep_labelled(meshes, wanted, labels)
            failures |= absent
        store.claim(out, {"kind": "meshes", "seed": seed, "size": size, "views": views})
        jobs = [
            _Job(mesh, shape, out, size, views, seed)
            for mesh, shape in zip(meshes, shape_ids(meshes), strict=True)
        ]
        made = 0
        for job, result in run_all(
            _convert_one, jobs, processes=processes, desc="rendering meshes", unit="mesh"
        ):
            if isinstance(result, Exception):
                failures[job.mesh.name] = str(result)
            else:
                made += result
    counts = store.write_lists(out, seed=seed)
    totals = {split: sum(by_synset.values()) for split, by_synset in counts.items()}
    if not sum(totals.values()):
        store.discard(out)
        name, reason = next(iter(failures.items()))
        others = f" (and {len(failures) - 1} others)" if len(failures) > 1 else ""
        raise UserError(f"no usable mesh; {name}: {reason}{others}")
    categories = {
        category_of(synset): sum(by_synset[synset] for by_synset in counts.values())
        for synset in counts["train"]
    }
    return MeshReport(out, made, sum(totals.values()) - made, totals, categories, failures)


def load_surface(path: Path, rotation: Sequence[float] | None = None) -> Surface:
    """Load a mesh, turn it, centre its bounding box on the origin and make the box's diagonal 1, as ShapeNet does.

    Raises:
        MeshError: no faces, coordinates that are no numbers, no extent, or a file that cannot be read.
    """
    try:
        scene = trimesh.load(path, force="scene", process=False)
        parts = _parts(scene)  # pyright: ignore[reportArgumentType]
    except MeshError:
        raise
    except Exception as error:  # each format's reader has its own way to fail
        raise MeshError(f"cannot be read ({type(error).__name__}: {error})") from error
    if not parts:
        raise MeshError("no faces")
    surface = _joined(parts)
    corners = surface.vertices[surface.faces]
    if not np.isfinite(corners).all():
        raise MeshError("NaN or infinite vertices")
    if rotation is not None:
        corners = corners @ np.reshape(rotation, (3, 3)).T
    low, high = corners.min((0, 1)), corners.max((0, 1))
    diagonal = float(np.linalg.norm(high - low))
    if diagonal == 0 or not np.isfinite(diagonal):
        raise MeshError("no extent: all its vertices are in one place")
    corners = (corners - (low + high) / 2) / diagonal
    if (
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        < 1e-9
    ):
        raise MeshError("no area: all its faces are lines or points")
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return dataclasses.replace(surface, vertices=corners.reshape(-1, 3), faces=faces)


def _convert_one(job: _Job) -> int | Exception:
    """Make one shape if it is not there yet; how many were made."""
    if store.is_written(job.out, job.shape):
        return 0
    try:
        surface = load_surface(job.mesh.path, job.mesh.rotation)
        entropy = int.from_bytes(hashlib.sha256(job.shape.encode()).digest()[:8], "big")
        cameras, samples = (np.random.default_rng([job.seed, entropy, stream]) for stream in range(2))
        views = Renderer(surface).render(draw_camera(cameras, job.views, job.size))
        points, _ = sample_triangles(surface.vertices[surface.faces], store.POINTS, samples)
        store.write_shape(job.out, job.shape, views, points)
    except (MeshError, UserError) as error:
        return error
    except Exception as error:  # whatever is wrong with one mesh, the others must be made
        return MeshError(f"{type(error).__name__}: {error}")
    return 1


def _parts(scene: trimesh.Scene) -> list[Surface]:
    """The scene's meshes where its graph puts them; lines and points are left out."""
    parts = []
    for node in scene.graph.nodes_geometry:
        pose, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        if mesh.faces.max() >= len(mesh.vertices) or mesh.faces.min() < 0:
            raise MeshError("faces that name vertices it does not have")
        vertices = np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        parts.append(_coloured(mesh, vertices, np.asarray(mesh.faces)))
    return parts


def _coloured(mesh: trimesh.Trimesh, vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Texture if there is one, else vertex or face colours, else the material's colour."""
    visual = mesh.visual
    colours = np.full((len(faces), 3), 0.7)
    if isinstance(visual, TextureVisuals):
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        uv = visual.uv
        if image is not None and uv is not None and len(uv) == len(vertices) and np.isfinite(uv).all():
            return Surface(
                vertices,
                faces,
                np.ones((len(faces), 3, 3), np.float32),
                np.zeros(len(faces), int),
                np.asarray(uv, np.float32)[faces],
                (_texture(image),),
            )
        colours[:] = np.asarray(material.main_color[:3]) / 255
    elif isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        surface = Surface.plain(vertices, faces, colours)
        corner_colours = np.asarray(visual.vertex_colors)[faces, :3].astype(np.float32) / 255
        return dataclasses.replace(surface, corner_colours=corner_colours)
    elif isinstance(visual, ColorVisuals) and visual.kind == "face":
        colours = np.asarray(visual.face_colors)[:, :3] / 255
    return Surface.plain(vertices, faces, colours)


def _texture(image: Image.Image) -> np.ndarray:
    """RGB (h, w, 3) uint8, transparency on white."""
    image = image.convert("RGBA")
    image.thumbnail((_TEXTURE_SIZE, _TEXTURE_SIZE))
    paper = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(paper, image).convert("RGB"))


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
