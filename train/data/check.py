"""Is a dataset whole, and do its pictures, cameras, depth maps and clouds speak of the same objects?"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from train.data import store
from train.data.agreement import Agreement, agreement
from train.data.categories import category_of
from train.data.frames import AS_IT_IS, Frame, find_frame, is_own
from train.data.tree import Shape, ShapeError, ShapeTree, frame_of, layout_of, read_shape, sample_shapes
from train.data.work import run_all

__all__ = ["Agreement", "TreeReport", "agreement", "check_tree"]

_INK = 0.85
"""A pixel darker than this in a channel is drawn on; white is the background."""
_MOST_OUTSIDE = 0.25
_MOST_FILLED = 0.995
_WORTH_PROCESSES = 200
"""Shapes from which on reading them takes longer than starting processes."""


@dataclasses.dataclass(frozen=True)
class TreeReport:
    """What `check_tree` found."""

    path: Path
    counts: dict[str, int]
    categories: dict[str, int]
    agreements: tuple[Agreement, ...]
    problems: list[str]
    frame: Frame
    has_depth: bool = True

    @property
    def inside(self) -> float:
        """Mean over the shapes that can be read."""
        return float(np.mean([each.inside for each in self.agreements])) if self.agreements else float("nan")

    @property
    def residual(self) -> float:
        """Median over the shapes that can be read."""
        return (
            float(np.median([each.residual for each in self.agreements])) if self.agreements else float("nan")
        )

    def summary(self) -> str:
        """Lines for the terminal."""
        splits = ", ".join(f"{count} {split}" for split, count in self.counts.items())
        kinds = ", ".join(f"{count} {name}" for name, count in self.categories.items())
        agree = sum(each.holds for each in self.agreements)
        fit = f"{self.inside:.2%} of the points project into the silhouette"
        if self.has_depth:
            files, fit = (
                "cameras, depth and clouds",
                f"{fit}, visible ones are {self.residual:.4f} from the depth map",
            )
        else:
            files = "cameras, silhouettes and clouds"
        lines = [
            f"{self.path}: {len(self.agreements)} shapes can be read ({splits}): {kinds}",
            f"{files} agree in {agree} of them: {fit}",
            f"frames: {self.frame.verdict}",
        ]
        if not self.has_depth:
            lines.append("no depth maps: for reconstruct and evaluate, not for fit")
        if self.problems:
            count = f"{len(self.problems)} problem{'s' if len(self.problems) > 1 else ''}:"
            lines += [count, *(f"  {problem}" for problem in self.problems)]
        else:
            lines.append("no problems")
        return "\n".join(lines)


class _Job(NamedTuple):
    root: Path
    shape: str


@dataclasses.dataclass(frozen=True)
class _Looked:
    """What one shape looks like by itself; how many views, how large, how many points is compared with the others."""

    agreement: Agreement
    views: int
    size: tuple[int, int]
    points: int
    has_depth: bool
    problems: tuple[str, ...]


def check_tree(path: str | Path, *, processes: int | None = None) -> TreeReport:
    """Read every shape of every split; name what is missing, broken, listed twice or does not agree.

    Args:
        path: root of a data tree.
        processes: None for one per core, and only this one for a small tree.

    Raises:
        UserError: no dataset at `path`.
    """
    root = Path(path)
    trees = {split: ShapeTree(root, split) for split in store.SPLITS}
    problems = [reason for tree in trees.values() for reason in tree.skipped.values()]
    listed = Counter(shape for tree in trees.values() for shape in (*tree.ids, *tree.skipped))
    problems += [f"{shape}: listed {count} times" for shape, count in listed.items() if count > 1]
    problems += [
        f"{shape}: in no list; run the command that made the data again"
        for shape in layout_of(root).on_disk()
        if shape not in listed
    ]
    frame = frame_of(root)
    jobs = [
        _Job(root, shape) for shape in dict.fromkeys(shape for tree in trees.values() for shape in tree.ids)
    ]
    if processes is None and len(jobs) < _WORTH_PROCESSES:
        processes = 1
    looked: dict[str, _Looked] = {}
    for job, result in run_all(_look, jobs, processes=processes, desc="checking", unit="shape"):
        if isinstance(result, _Looked):
            looked[job.shape] = result
        else:
            problems.append(str(result) if isinstance(result, ShapeError) else f"{job.shape}: {result}")
    looked = {job.shape: looked[job.shape] for job in jobs if job.shape in looked}
    apart = [shape for shape, each in looked.items() if not each.agreement.holds]
    if is_own(root) and 2 * len(apart) > len(looked):
        frame = _whose_frame(root, apart)
    if not frame.settled and looked:
        problems.append(f"{root}: {frame.verdict}")
    for each in looked.values():
        problems += each.problems
    problems += _unusual(looked)
    categories = Counter(category_of(shape.split("/")[0]) for shape in looked)
    counts = {split: len(looked.keys() & set(tree.ids)) for split, tree in trees.items()}
    return TreeReport(
        root,
        counts,
        dict(categories),
        tuple(each.agreement for each in looked.values()),
        problems,
        frame,
        has_depth=all(each.has_depth for each in looked.values()),
    )


def _look(job: _Job) -> _Looked | ShapeError:
    try:
        shape = read_shape(job.root, job.shape)
    except ShapeError as error:
        return error
    found = agreement(shape)
    problems = [f"{shape.id}: {problem}" for problem in _blemishes(shape)]
    if not found.holds:
        what = "depth and cloud" if shape.has_depth else "silhouettes and cloud"
        problems.append(f"{shape.id}: cameras, {what} do not agree ({found})")
    size = (shape.depth.shape[1], shape.depth.shape[2])
    return _Looked(found, len(shape.depth), size, len(shape.points), shape.has_depth, tuple(problems))


def _blemishes(shape: Shape) -> Iterable[str]:
    """Views that show nothing, views without background, pictures of something else than the depth map."""
    for view, (image, depth) in enumerate(zip(shape.images.numpy(), shape.depth.numpy(), strict=True)):
        seen = np.less(depth, np.inf) | np.isnan(depth)
        if not seen.any():
            yield f"view {view} shows nothing: its mask is empty"
        elif seen.mean() > _MOST_FILLED:
            yield f"view {view} has no background: is its depth 65535 where nothing is seen?"
        else:
            drawn = (image < _INK).any(0)
            around = np.asarray(binary_dilation(seen, np.ones((5, 5))), bool)
            outside = (drawn & ~around).sum() / max(drawn.sum(), 1)
            if outside > _MOST_OUTSIDE:
                yield f"view {view}: {outside:.0%} of what the picture shows is outside the mask of the depth map"


def _unusual(looked: dict[str, _Looked]) -> list[str]:
    """Shapes that differ from most of the tree in what must be the same for all."""
    problems = []
    for name, unit in (("views", "views"), ("size", "pixels"), ("points", "points")):
        values = {shape: getattr(each, name) for shape, each in looked.items()}
        usual = Counter(values.values()).most_common(1)[0][0] if values else None
        problems += [
            f"{shape}: {_said(value)} {unit}, elsewhere {_said(usual)}"
            for shape, value in values.items()
            if value != usual
        ]
    return problems


def _said(value) -> str:
    return " x ".join(map(str, value[::-1])) if isinstance(value, tuple) else str(value)


def _whose_frame(root: Path, shapes: list[str]) -> Frame:
    """The verdict on a tree that this program made and in which most shapes do not agree: somebody changed it."""
    found = find_frame(sample_shapes(layout_of(root), shapes))
    if not found.settled or not found.changes:
        return dataclasses.replace(AS_IT_IS, verdict=found.verdict, settled=found.settled)
    said = found.verdict.split(":")[0]
    return dataclasses.replace(
        AS_IT_IS, verdict=f"{said}; not as this program wrote them: make the data again", settled=False
    )
