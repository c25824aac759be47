"""Seeded shapes with designed ambiguity: several backs for one front. The families are in `families/`."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import KDTree

from diffpoint.camera import PinholeCamera
from train.data import tree_files
from train.data.categories import SYNSET_OF
from train.data.families import FAMILIES, MODES, Cone
from train.data.render import MAX_RADIUS, Renderer, Views, draw_camera, orbit_camera
from train.data.solids import Solid, sample_union, surface_of
from train.errors import UserError
from train.processes import map_unordered

_SAME_DEPTH, _SAME_COLOUR = 1e-3, 3  # world units; steps of 255
_FRONT, _SEPARATION = 0.005, 2.2  # for acceptance; tighter than the rules, 0.01 and 2
_ATTEMPTS = 60


@dataclasses.dataclass(frozen=True)
class Ambiguity:
    """How well one front hides several backs; the worst pair of variants decides.

    Attributes:
        front: share of the object's pixels that differ between two variants, seen from the front.
        back: the same, seen from behind.
        separation: chamfer distance between two variants, over that between two samplings of one.
        radius: of the largest variant, world units.
    """

    front: float
    back: float
    separation: float
    radius: float

    @property
    def holds(self) -> bool:
        """The rules: equal fronts, different backs, distinguishable modes, and nothing outside of the frame."""
        return self.front < 0.01 and self.back > 0.1 and self.separation >= 2 and self.radius <= MAX_RADIUS

    @property
    def accepted(self) -> bool:
        """`holds` with a margin, so that it also holds in other views and samples of the same shapes."""
        return self.holds and self.front < _FRONT and self.separation >= _SEPARATION


@dataclasses.dataclass(frozen=True)
class ProceduralReport:
    """What `generate` did."""

    out: Path
    made: int
    kept: int
    categories: tuple[str, ...]
    counts: dict[str, int]
    failures: dict[str, str]

    def summary(self) -> str:
        """A line for the terminal."""
        splits = tree_files.in_words(self.counts)
        earlier = f", {self.kept} were there" if self.kept else ""
        failed = (
            f"; {len(self.failures)} failed: {'; '.join(self.failures.values())}" if self.failures else ""
        )
        kinds = ", ".join(self.categories)
        return f"{self.out}: made {self.made} shapes{earlier} of {kinds} ({splits}){failed}"


@dataclasses.dataclass(frozen=True)
class _Job:
    out: Path
    category: str
    index: int
    seed: int
    size: int
    views: int
    variants: int
    fronts: int

    def shape(self, mode: int) -> str:
        return f"{SYNSET_OF[self.category]}/{self.category}_s{self.seed}_{self.index:06d}_h{mode}"


def variants_of(category: str, seed: int | Sequence[int]) -> tuple[list[Solid], ...]:
    """All shapes that share one front: the hidden variants of one object, one for each mode.

    Objects are drawn until one passes the rules of `ambiguity`; the same seed always gives the same variants. A family
    without designed ambiguity gives one shape. To measure whether predictions cover all shapes that are consistent with
    an image, compare them with samples of each variant.

    Example:
        >>> variants = variants_of("display", 0)
        >>> len(variants), len(variants[0]) < len(variants[2])  # the third has a body behind the screen
        (3, True)
    """
    entropy = [seed] if isinstance(seed, int) else list(seed)
    number = list(FAMILIES).index(category)
    family = FAMILIES[category]
    for attempt in range(_ATTEMPTS):
        visible, *hidden = (
            functools.partial(np.random.default_rng, [*entropy, number, attempt, stream])
            for stream in range(family.modes + 1)
        )
        design = family.design(visible())
        variants = tuple(design.solids(hidden[mode](), mode) for mode in range(family.modes))
        if family.cone is None:
            accepted = _radius(variants) <= MAX_RADIUS
        else:
            accepted = ambiguity(variants, family.cone).accepted
        if accepted:
            return variants
    raise RuntimeError(
        f"the family {category} gave no acceptable object in {_ATTEMPTS} attempts (seed {seed})"
    )


def ambiguity(
    variants: Sequence[list[Solid]], cone: Cone, *, size: int = 112, fronts: int = 3, sampling: int = 0
) -> Ambiguity:
    """Measures how well one front hides the variants of one object.

    Args:
        variants: the same object with different backs.
        cone: where the front views are.
        size: pixels of a side of the views that are compared.
        fronts: views from the front, over the cone's azimuths.
        sampling: seeds the clouds of 2048 points.
    """
    radius = _radius(variants)
    if radius > MAX_RADIUS:
        return Ambiguity(np.nan, np.nan, np.nan, radius)
    azimuth_deg = np.append(np.linspace(-cone.azimuth_deg, cone.azimuth_deg, fronts), 180)
    camera = orbit_camera(azimuth_deg, np.full(fronts + 1, cone.elevation_deg), size)
    views = [Renderer(surface_of(solids)).render(camera) for solids in variants]
    pairs = list(itertools.combinations(range(len(variants)), 2))
    changed = np.array([_changed_share(views[i], views[j]) for i, j in pairs])
    clouds = [
        [sample_union(solids, tree_files.POINTS, np.random.default_rng([sampling, k])) for k in range(2)]
        for solids in variants
    ]
    noise = [_chamfer(*pair) for pair in clouds]
    return Ambiguity(
        front=float(changed[:, :-1].max()),
        back=float(changed[:, -1].min()),
        separation=min(_chamfer(clouds[i][0], clouds[j][0]) / max(noise[i], noise[j]) for i, j in pairs),
        radius=radius,
    )


def generate(
    out: str | Path,
    *,
    shapes: int,
    categories: Sequence[str] | None,
    seed: int,
    size: int = 224,
    views: int = 8,
    processes: int | None = None,
    variants: int = 1,
    fronts: int = 0,
) -> ProceduralReport:
    """Makes a data tree of procedural objects; running it again finishes or extends it.

    Args:
        out: folder of the dataset.
        shapes: how many objects, shared evenly among the categories.
        categories: families to draw from; None for all.
        seed: of everything; object i is the same whatever `shapes` is.
        size: pixels of a side of each view.
        views: per object.
        processes: None for one per core.
        variants: hidden variants written for each object, 1 to 3, with the same cameras and in the same split;
            families without designed ambiguity have one.
        fronts: how many of the views show the front that hides the variants (random views are within the cone of front
            views in one case of thirty); families without designed ambiguity have random views only.

    Raises:
        UserError: an unknown category, a number out of range, or a folder that holds something else.
    """
    out = Path(out)
    names = tuple(FAMILIES) if categories is None else tuple(dict.fromkeys(categories))
    unknown = [name for name in names if name not in FAMILIES]
    if unknown or not names:
        raise UserError(
            f"no procedural family {', '.join(unknown) or '(none given)'}; there are: {', '.join(FAMILIES)}"
        )
    tree_files.require_between(
        shapes=(shapes, 1, 10**6),
        size=(size, 16, 2048),
        views=(views, 1, 256),
        variants=(variants, 1, MODES),
        fronts=(fronts, 0, views),
    )
    if seed < 0:
        raise UserError(f"seed must not be negative; got {seed}")
    settings = {
        "kind": "procedural",
        "seed": seed,
        "size": size,
        "views": views,
        "variants": variants,
        "categories": list(names),
    }
    if fronts:  # trees of earlier versions have no such setting
        settings["fronts"] = fronts
    tree_files.prepare_output(out, settings)
    jobs = [_Job(out, names[i % len(names)], i, seed, size, views, variants, fronts) for i in range(shapes)]
    made, failures = 0, {}
    for job, result in map_unordered(
        _make, jobs, processes=processes, title="procedural shapes", unit="shape"
    ):
        if isinstance(result, Exception):
            failures[f"{job.category} {job.index}"] = f"{job.category} {job.index}: {result}"
        else:
            made += result
    counts = tree_files.write_lists(out, seed=seed)
    totals = {split: sum(by_synset.values()) for split, by_synset in counts.items()}
    return ProceduralReport(out, made, sum(totals.values()) - made, names, totals, failures)


def _make(job: _Job) -> int | Exception:
    """Writes the object's variants that are not there yet; returns how many were written."""
    entropy = [job.seed, job.index]
    modes = np.random.default_rng([*entropy, 1]).permutation(FAMILIES[job.category].modes)[: job.variants]
    missing = [int(mode) for mode in modes if not tree_files.is_written(job.out, job.shape(int(mode)))]
    if not missing:
        return 0
    try:
        solids_of_mode = variants_of(job.category, entropy)
        camera = _draw_views(np.random.default_rng([*entropy, 2]), job)
        for mode in missing:
            solids = solids_of_mode[mode]
            points = sample_union(solids, tree_files.POINTS, np.random.default_rng([*entropy, 3, mode]))
            tree_files.write_shape(
                job.out, job.shape(mode), Renderer(surface_of(solids)).render(camera), points
            )
    except (RuntimeError, OSError) as error:
        return error
    return len(missing)


def _draw_views(rng: np.random.Generator, job: _Job) -> PinholeCamera:
    """The cameras of an object: some of its front, the others all around it."""
    cone = FAMILIES[job.category].cone
    fronts = job.fronts if cone else 0
    cameras = [draw_camera(rng, job.views - fronts, job.size)] if fronts < job.views else []
    if cone and fronts:
        azimuth = rng.uniform(-cone.azimuth_deg, cone.azimuth_deg, fronts)
        cameras.insert(0, orbit_camera(azimuth, np.full(fronts, cone.elevation_deg), job.size))
    K, pose = (torch.cat([getattr(c, name) for c in cameras]) for name in ("K", "cam_from_world"))
    return PinholeCamera(K, pose, job.size, job.size)


def _radius(variants: Sequence[list[Solid]]) -> float:
    return max(float(np.linalg.norm(solid.vertices, axis=1).max()) for solids in variants for solid in solids)


def _changed_share(a: Views, b: Views) -> np.ndarray:
    """(V,) share of the pixels that either object covers where depth or colour differ."""
    seen = np.isfinite(a.depth) | np.isfinite(b.depth)
    with np.errstate(invalid="ignore"):  # inf - inf where both are empty, which `seen` leaves out
        depth_differs = ~(np.abs(a.depth - b.depth) <= _SAME_DEPTH)
    colour_differs = (np.abs(a.images.astype(int) - b.images) > _SAME_COLOUR).any(-1)
    return ((depth_differs | colour_differs) & seen).sum((1, 2)) / seen.sum((1, 2))


def _chamfer(a: np.ndarray, b: np.ndarray) -> float:
    return float(KDTree(b).query(a)[0].mean() + KDTree(a).query(b)[0].mean())
