"""Is a data tree complete, and are its pictures, cameras, depth maps and clouds consistent?"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation

from train.data import tree_files
from train.data.cache import damaged_files
from train.data.categories import category_of
from train.data.consistency import AS_IT_IS, Consistency, Frame, find_frame, measure_consistency
from train.data.layouts import layout_of
from train.data.tree import Shape, ShapeError, ShapeTree, frame_of, read_shape, sample_shapes
from train.processes import map_unordered

_INK = 0.85
"""A pixel darker than this in a channel is drawn on; white is the background."""
_MOST_OUTSIDE = 0.25
_MOST_FILLED = 0.995
_SHAPES_PER_PROCESS = 100


@dataclasses.dataclass(frozen=True)
class TreeReport:
    """What `check_tree` found.

    Attributes:
        path: root of the tree.
        counts, categories: readable shapes by split and by category.
        consistencies: of the readable shapes.
        problems: a line for each.
        frame: the axis conventions of clouds and cameras.
        has_depth: False for renderings without depth maps.
    """

    path: Path
    counts: dict[str, int]
    categories: dict[str, int]
    consistencies: tuple[Consistency, ...]
    problems: list[str]
    frame: Frame
    has_depth: bool = True

    @property
    def inside(self) -> float:
        """Mean over the readable shapes; NaN if there is none."""
        return float(np.mean([each.inside for each in self.consistencies] or [np.nan]))

    @property
    def residual(self) -> float:
        """Median over the readable shapes; NaN if there is none."""
        return float(np.median([each.residual for each in self.consistencies] or [np.nan]))

    def summary(self) -> str:
        """Lines for the terminal."""
        splits, kinds = tree_files.in_words(self.counts), tree_files.in_words(self.categories)
        consistent = sum(each.holds for each in self.consistencies)
        files = "cameras, silhouettes and clouds"
        fit = f"{self.inside:.2%} of the points project into the silhouette"
        if self.has_depth:
            files = "cameras, depth and clouds"
            fit += f", visible ones are {self.residual:.4f} from the depth map"
        lines = [
            f"{self.path}: {len(self.consistencies)} shapes can be read ({splits}): {kinds}",
            f"{files} agree in {consistent} of them: {fit}",
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


@dataclasses.dataclass(frozen=True)
class _Checked:
    """A readable shape: what is wrong with it, and what must be the same for all shapes of a tree."""

    consistency: Consistency
    views: int
    size: str
    points: int
    has_depth: bool
    problems: tuple[str, ...]


def check_tree(path: str | Path, *, processes: int | None = None) -> TreeReport:
    """Reads every shape of every split; names what is missing, broken, listed twice or inconsistent.

    The files that training has prepared of the tree are compared with their checksums.

    Args:
        path: root of a data tree.
        processes: None for one per core, and only this one for a small tree.

    Raises:
        UserError: no dataset at `path`.
    """
    root = Path(path)
    trees = {split: ShapeTree(root, split) for split in tree_files.SPLITS}
    problems = [reason for tree in trees.values() for reason in tree.skipped.values()]
    listed = Counter(shape for tree in trees.values() for shape in (*tree.ids, *tree.skipped))
    problems += [f"{shape}: listed {count} times" for shape, count in listed.items() if count > 1]
    problems += [
        f"{shape}: in no list; run the command that made the data again"
        for shape in layout_of(root).on_disk()
        if shape not in listed
    ]
    frame = frame_of(root)
    shapes = dict.fromkeys(shape for tree in trees.values() for shape in tree.ids)
    checked: dict[str, _Checked] = {}
    for (_, shape), result in map_unordered(
        _check_one,
        [(root, shape) for shape in shapes],
        processes=processes,
        title="checking",
        unit="shape",
        jobs_per_process=_SHAPES_PER_PROCESS,
    ):
        if isinstance(result, _Checked):
            checked[shape] = result
        else:
            problems.append(str(result) if isinstance(result, ShapeError) else f"{shape}: {result}")
    checked = {shape: checked[shape] for shape in shapes if shape in checked}
    inconsistent = [shape for shape, each in checked.items() if not each.consistency.holds]
    if tree_files.is_own(root) and 2 * len(inconsistent) > len(checked):
        frame = _changed_frame(root, inconsistent)
    if not frame.settled and checked:
        problems.append(f"{root}: {frame.verdict}")
    for each in checked.values():
        problems += each.problems
    problems += _unusual(checked)
    problems += [
        f"{damaged}: prepared for training, and damaged; delete it, training makes it again"
        for damaged in damaged_files(root)
    ]
    return TreeReport(
        root,
        {split: len(checked.keys() & set(tree.ids)) for split, tree in trees.items()},
        dict(Counter(category_of(shape.split("/")[0]) for shape in checked)),
        tuple(each.consistency for each in checked.values()),
        problems,
        frame,
        has_depth=all(each.has_depth for each in checked.values()),
    )


def _check_one(job: tuple[Path, str]) -> _Checked | ShapeError:
    try:
        shape = read_shape(*job)
    except ShapeError as error:
        return error
    found = measure_consistency(shape)
    problems = [f"{shape.id}: {problem}" for problem in _bad_views(shape)]
    if not found.holds:
        what = "depth and cloud" if shape.has_depth else "silhouettes and cloud"
        problems.append(f"{shape.id}: cameras, {what} do not agree ({found})")
    size = f"{shape.depth.shape[2]} x {shape.depth.shape[1]}"
    return _Checked(found, len(shape.depth), size, len(shape.points), shape.has_depth, tuple(problems))


def _bad_views(shape: Shape) -> Iterable[str]:
    """Views that show nothing, views without background, pictures that do not fit their depth map."""
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


def _unusual(checked: dict[str, _Checked]) -> list[str]:
    """Shapes that differ from most of the tree in what must be the same for all."""
    problems = []
    for name, unit in (("views", "views"), ("size", "pixels"), ("points", "points")):
        values = {shape: getattr(each, name) for shape, each in checked.items()}
        usual = Counter(values.values()).most_common(1)[0][0] if values else None
        problems += [
            f"{shape}: {value} {unit}, elsewhere {usual}" for shape, value in values.items() if value != usual
        ]
    return problems


def _changed_frame(root: Path, shapes: list[str]) -> Frame:
    """The frame of a tree that this program made and in which most shapes are inconsistent: it was changed since."""
    found = find_frame(sample_shapes(layout_of(root), shapes))
    if not found.settled or not found.changes:
        return dataclasses.replace(AS_IT_IS, verdict=found.verdict, settled=found.settled)
    verdict = f"{found.verdict.split(':')[0]}; not as this program wrote them: make the data again"
    return dataclasses.replace(AS_IT_IS, verdict=verdict, settled=False)
