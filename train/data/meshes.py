"""Meshes of any format to a data tree: load, turn upright, scale to a unit box, render, sample."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from train.data import tree_files
from train.data.categories import category_of
from train.data.mesh_files import MeshError, load_surface
from train.data.mesh_sources import (
    UPRIGHT,
    MeshFile,
    find_meshes,
    keep_labelled,
    of_category,
    read_labels,
    shape_ids,
)
from train.data.render import Orbit, Renderer, draw_camera
from train.data.surface import sample_triangles
from train.data.visible_samples import sample_visible
from train.errors import UserError
from train.files import write_text
from train.processes import map_unordered

LEFT_OUT = "left_out.csv"
"""In the dataset's folder: the meshes that the last run could not use, and why."""

_NAMED = 20  # as many are named on the terminal


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """How meshes become shapes. All but the category must be the same throughout a dataset.

    Attributes:
        category: of every mesh; None reads it from folders or labels.
        up: the axis that points up in the files: x, y, z, -x, -y or -z.
        scale: world units per unit of the files; None gives each mesh a bounding box with the diagonal 1.
        drop_hidden: leave out ground-truth points that are visible neither in a view nor from outside.
        orbit: positions of the cameras.
    """

    category: str | None = None
    up: str = "y"
    scale: float | None = None
    drop_hidden: bool = False
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
        self.orbit.check()


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """What `convert` did.

    Attributes:
        out: the dataset.
        made: shapes of this run.
        kept: shapes that an earlier run had made of these sources.
        others: shapes of the dataset that are not from these sources.
        counts: shapes of the dataset by split.
        categories: and by category.
        failures: reasons by the name of the mesh.
    """

    out: Path
    made: int
    kept: int
    others: int
    counts: dict[str, int]
    categories: dict[str, int]
    failures: dict[str, str]

    def summary(self) -> str:
        """Lines for the terminal."""
        splits = ", ".join(f"{count} {split}" for split, count in self.counts.items())
        kinds = ", ".join(f"{count} {name}" for name, count in self.categories.items())
        earlier = f", {self.kept} were there" if self.kept else ""
        earlier += f", {self.others} are not from these sources" if self.others else ""
        lines = [f"{self.out}: made {self.made} shapes{earlier} ({splits}): {kinds}"]
        if self.failures:
            lines.append(f"{len(self.failures)} meshes were left out:")
            named = sorted(self.failures.items())
            lines += [f"  {name}: {reason}" for name, reason in named[:_NAMED]]
            if len(named) > _NAMED:
                lines.append(f"  and {len(named) - _NAMED} others; {self.out / LEFT_OUT} names all")
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Job:
    mesh: MeshFile
    shape: str
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
    size: int = 224,
    views: int = 8,
    seed: int = 0,
    processes: int | None = None,
    options: MeshOptions | None = None,
) -> MeshReport:
    """Makes a data tree of meshes; running it again finishes or extends it.

    Args:
        sources: folders, .zip and .sh3f archives, and mesh files (OBJ with its materials, GLB, PLY, OFF, STL).
        out: folder of the dataset.
        labels: CSV with the columns library, model, category, synset; only the meshes it names are made. Without
            one, the category is that of a folder on the path (a name of the paper's or a synset), or "unknown".
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
    sources = [sources] if isinstance(sources, str | Path) else sources
    for name, value, low, high in (("size", size, 16, 2048), ("views", views, 1, 256)):
        if not low <= value <= high:
            raise UserError(f"{name} must be between {low} and {high}; got {value}")
    if labels is not None and options.category is not None:
        raise UserError("labels and category both set the category of the meshes; give one of them")
    options.check()
    wanted = read_labels(labels) if labels is not None else None
    with tempfile.TemporaryDirectory(prefix="meshes-") as scratch:
        meshes, failures = find_meshes([Path(source) for source in sources], Path(scratch), up=options.up)
        if not meshes:
            raise UserError(f"no meshes in {', '.join(map(str, sources)) or 'no sources'}")
        if wanted is not None and labels is not None:
            meshes, absent = keep_labelled(meshes, wanted, labels)
            failures |= absent
        if options.category is not None:
            meshes = of_category(meshes, options.category)
        tree_files.prepare_output(out, _settings(size, views, seed, options))
        jobs = [
            _Job(mesh, shape, out, size, views, seed, options)
            for mesh, shape in zip(meshes, shape_ids(meshes), strict=True)
        ]
        made = kept = 0
        for job, result in map_unordered(
            _convert_one, jobs, processes=processes, title="rendering meshes", unit="mesh"
        ):
            if isinstance(result, Exception):
                failures[job.mesh.name] = str(result)
            else:
                made += result
                kept += not result
    counts = tree_files.write_lists(out, seed=seed)
    totals = {split: sum(by_synset.values()) for split, by_synset in counts.items()}
    if not sum(totals.values()):
        tree_files.discard(out)
        name, reason = next(iter(failures.items()))
        others = f" (and {len(failures) - 1} others)" if len(failures) > 1 else ""
        raise UserError(f"no usable mesh; {name}: {reason}{others}")
    _write_left_out(out, failures)
    categories = {
        category_of(synset): sum(by_synset[synset] for by_synset in counts.values())
        for synset in counts["train"]
    }
    others = sum(totals.values()) - made - kept
    return MeshReport(out, made, kept, others, totals, categories, failures)


def _settings(size: int, views: int, seed: int, options: MeshOptions) -> dict:
    """The settings that must be the same throughout a dataset."""
    return {
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


def _write_left_out(out: Path, failures: dict[str, str]) -> None:
    if not failures:
        (out / LEFT_OUT).unlink(missing_ok=True)
        return
    table = io.StringIO()
    csv.writer(table).writerows([("mesh", "reason"), *sorted(failures.items())])
    write_text(out / LEFT_OUT, table.getvalue())


def _convert_one(job: _Job) -> int | Exception:
    """Makes one shape if it is not there yet; returns how many were made."""
    if tree_files.is_written(job.out, job.shape):
        return 0
    options = job.options
    try:
        surface = load_surface(job.mesh.path, job.mesh.rotation, scale=options.scale, root=job.mesh.root)
        radius = float(np.linalg.norm(surface.vertices, axis=1).max())
        if options.scale is not None and radius > options.orbit.max_radius:
            raise MeshError(
                f"its radius is {radius:.2f} world units and the frame holds {options.orbit.max_radius:.2f}: "
                "lower the scale"
            )
        entropy = int.from_bytes(hashlib.sha256(job.shape.encode()).digest()[:8], "big")
        cameras, samples = (np.random.default_rng([job.seed, entropy, stream]) for stream in range(2))
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
    return 1
