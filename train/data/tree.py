"""Reading data trees: `ShapeTree`."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

from train.data import tree_files
from train.data.categories import CATEGORY_OF, SYNSET_OF, category_of, synset_of
from train.data.consistency import AS_IT_IS, SAMPLE, Frame, find_frame
from train.data.layouts import Layout, layout_of
from train.data.shape import Shape, ShapeError, is_shape_id
from train.errors import UserError
from train.processes import progress_bar

__all__ = ["Shape", "ShapeError", "ShapeTree", "frame_of", "read_shape"]


class ShapeTree:
    """The shapes of one split; `tree[i]` reads shape i from disk.

    Trees of this program, of the paper's release, and of Choy's renderings with clouds beside them are read alike;
    where clouds and cameras of a tree from elsewhere are in different frames, they are turned when read (`frame_of`).

    A broken shape raises `ShapeError` from `tree[i]`; `iter_valid` and `load_all` leave it out, and `skipped`
    names it with the reason. Shapes without files, and lines of a list that are no "synset/model", are skipped when the
    tree is opened and are not counted in `len(tree)`.

    Args:
        path: a folder made by `python -m train data`, the paper's release, or Choy's renderings.
        split: "train", "val" or "test".
        categories: names or synsets to keep; all by default.

    Raises:
        UserError: no data at `path`, or no such split or category.
    """

    def __init__(
        self, path: str | Path, split: str = "train", categories: Sequence[str] | None = None
    ) -> None:
        self.path = Path(path)
        self.split = split
        self.skipped: dict[str, str] = {}
        if split not in tree_files.SPLITS:
            raise UserError(f"ShapeTree: split must be one of {', '.join(tree_files.SPLITS)}; got {split!r}")
        layout = layout_of(self.path)
        members = layout.listed(split)
        self.ids: list[str] = []
        for synset in self._chosen(list(members), categories):
            for shape in members[synset]:
                reason = _missing(layout, shape)
                if reason:
                    self.skipped[shape] = reason
                else:
                    self.ids.append(shape)

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Shape:
        return read_shape(self.path, self.ids[index])

    def iter_valid(self) -> Iterator[Shape]:
        """The shapes that can be read, in order; the others go to `skipped`."""
        for shape in self.ids:
            try:
                yield read_shape(self.path, shape)
            except ShapeError as error:
                self.skipped[shape] = str(error)

    def load_all(self, *, progress: bool = True) -> list[Shape]:
        """Reads every shape into memory; the broken ones are named on the progress line and in `skipped`.

        Raises:
            UserError: not a single shape can be read.
        """
        bar = progress_bar(
            self.iter_valid(),
            total=len(self),
            title=f"reading {self.split}",
            unit="shape",
            progress=progress,
        )
        shapes = list(bar)
        if progress:
            for reason in self.skipped.values():
                bar.write(f"skipped: {reason}")
        if not shapes:
            first = next(iter(self.skipped.values()), "the lists are empty")
            raise UserError(f"{self.path} has no readable shape in the {self.split} split ({first})")
        return shapes

    def _chosen(self, present: list[str], categories: Sequence[str] | None) -> list[str]:
        if categories is None:
            return present
        wanted = [name if name in CATEGORY_OF else synset_of(name) for name in categories]
        for name, synset in zip(categories, wanted, strict=True):
            if synset not in present:
                known = ", ".join(category_of(each) for each in present) or "none"
                spelling = "" if name in SYNSET_OF or name in CATEGORY_OF else " (is it spelt right?)"
                raise UserError(f"{self.path} has no category {name!r}{spelling}; it has: {known}")
        return wanted


def read_shape(root: str | Path, shape: str) -> Shape:
    """Reads the shape "synset/model", in the world with y up.

    Raises:
        ShapeError: no such name, a file is missing or broken, or the files do not fit together.
    """
    return frame_of(root).applied(_read_unturned(layout_of(root), shape))


def frame_of(root: str | Path) -> Frame:
    """How clouds and cameras of this tree are turned when they are read; `data check` prints it.

    Found once per process from a few shapes that are spread over the tree, without writing anything. Trees that this
    program made need no turning and are not examined.
    """
    root = Path(root)
    if tree_files.is_own(root):
        return AS_IT_IS
    return _found_frame(root.resolve(), root.stat().st_mtime_ns)


@functools.lru_cache(maxsize=16)
def _found_frame(root: Path, _: int) -> Frame:
    return find_frame(sample_shapes(layout_of(root)))


def sample_shapes(layout: Layout, among: Sequence[str] | None = None) -> list[Shape]:
    """Up to `SAMPLE` readable shapes, spread over the tree or over those named, in the frames of their files."""
    if among is None:
        among = [
            shape
            for split in tree_files.SPLITS
            for members in layout.listed(split).values()
            for shape in members
        ]
    order = [among[(number * len(among)) // (4 * SAMPLE)] for number in range(4 * SAMPLE)] if among else []
    found: list[Shape] = []
    for shape in dict.fromkeys(order[start + step] for step in range(4) for start in range(0, len(order), 4)):
        try:
            found.append(_read_unturned(layout, shape))
        except ShapeError:
            continue
        if len(found) == SAMPLE:
            break
    return found


def _read_unturned(layout: Layout, shape: str) -> Shape:
    reason = _missing(layout, shape)
    if reason:
        raise ShapeError(reason)
    return layout.read(shape)


def _missing(layout: Layout, shape: str) -> str | None:
    """Why a shape of a list has no files; None if it has."""
    if not is_shape_id(shape):
        return (
            f"{shape}: not of the form <synset>/<model>, as the lines of the lists in {layout.root} must be"
        )
    folder, cloud = layout.folder(shape), layout.cloud_file(shape)
    if not folder.is_dir():
        return f"{shape}: no folder {folder}"
    return None if cloud.is_file() else f"{shape}: no file {cloud}"
