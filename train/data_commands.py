"""The commands under `python -m train data`. Each imports what it runs when it runs, so that --help answers at once."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, subcommand


@dataclasses.dataclass
class Procedural:
    """Generate shapes with designed ambiguity: what one view hides, it truly leaves open."""

    out: Path
    """Directory of the new data tree."""
    shapes: int = 400
    """How many shapes, over all categories."""
    categories: tuple[str, ...] = ()
    """Families to draw from, for instance `chair display`; none means all thirteen."""
    seed: int = 0
    """The same seed gives the same tree."""
    size: int = 224
    """Side of the renders in pixels; 112 is enough for the cpu profile."""
    views: int = 8
    """Views per shape."""

    def run(self) -> None:
        from train.data.procedural import generate

        report = generate(
            self.out,
            shapes=self.shapes,
            categories=self.categories or None,
            seed=self.seed,
            size=self.size,
            views=self.views,
        )
        print(report.summary())


@dataclasses.dataclass
class Meshes:
    """Render meshes into a data tree: OBJ, GLB, PLY or OFF in folders, zips, .sh3f libraries or ShapeNet trees."""

    sources: Positional[tuple[Path, ...]]
    """Mesh files, folders, zips or .sh3f libraries."""
    out: Path
    """Directory of the new data tree."""
    labels: Path | None = None
    """CSV that names the category of each mesh; only labelled meshes are taken then."""
    category: str | None = None
    """What all of the meshes are; by default a folder on the path says so, by name or by synset."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "y"
    """The axis that points up in the files; a .sh3f library says so itself."""
    scale: float | None = None
    """World units per unit of the files, where sizes matter; by default each mesh gets a box with the diagonal 1."""
    drop_hidden: bool = False
    """Leave points out of the ground truth that neither a view nor anybody outside can see."""
    size: int = 224
    """Side of the renders in pixels; 112 is enough for the cpu profile."""
    views: int = 8
    """Views per mesh, evenly around it."""
    elevation: tuple[float, float] = (-20.0, 40.0)
    """Lowest and highest elevation of the cameras in degrees."""
    distance: float = 2.0
    """Of the cameras from the middle of the mesh."""
    focal: float = 1.875
    """Focal length over the side of the renders; 1.875 is 420 pixels at 224."""
    seed: int = 0
    """Seeds cameras, surface samples and the split."""
    processes: int | None = None
    """How many work at once; one per core by default."""

    def run(self) -> None:
        from train.data.meshes import MeshOptions, convert
        from train.data.render import Orbit

        orbit = Orbit(self.elevation, self.distance, self.focal)
        report = convert(
            self.sources,
            self.out,
            labels=self.labels,
            size=self.size,
            views=self.views,
            seed=self.seed,
            processes=self.processes,
            options=MeshOptions(self.category, self.up, self.scale, self.drop_hidden, orbit),
        )
        print(report.summary())


@dataclasses.dataclass
class Photos:
    """Cut objects out of photographs: alone on white, in a square, as large as in training; no cameras needed.

    One folder for each object, one folder of one object, or Stanford Online Products. The object is told from the rest
    by a mask beside the photograph (NAME_mask.png or masks/NAME.png), by transparency, or by a plain background.
    """

    source: Positional[Path]
    """Folder of the photographs."""
    out: Path
    """New folder: OUT/OBJECT/NAME.png to reconstruct from, and OUT/OBJECT/masks/NAME.png to look at."""
    size: int = 224
    """Side of the pictures in pixels."""
    fewest: int = 1
    """Leave out objects with fewer photographs."""
    objects: int | None = None
    """At most so many objects."""

    def run(self) -> None:
        from train.data.photos import convert_photos

        report = convert_photos(
            self.source, self.out, size=self.size, fewest=self.fewest, objects=self.objects
        )
        print(report.summary())


@dataclasses.dataclass
class Check:
    """Look through a data tree: what is there, what is broken, whether cameras, depth and clouds agree."""

    data: Positional[Path]
    """Root of the data tree."""

    def run(self) -> int:
        from train.data.check import check_tree

        report = check_tree(self.data)
        print(report.summary())
        return 1 if report.problems else 0


@dataclasses.dataclass
class Show:
    """Draw a contact sheet for each category of a data tree: views, depth, and the cloud from front and back."""

    data: Positional[Path]
    """Root of the data tree."""
    out: Path | None = None
    """Folder of the sheets; contact/ in the data tree if not given."""
    categories: tuple[str, ...] = ()
    """Categories to draw; none means all."""
    shapes: int = 8
    """Shapes on a sheet, evenly spread over the category."""

    def run(self) -> None:
        from train.data.contact_sheet import show

        for category, path in show(
            self.data, self.out, categories=self.categories or None, shapes=self.shapes
        ).items():
            print(f"{category}: {path}")


@dataclasses.dataclass
class Rules:
    """Measure whether the fronts of the families hide their backs; see docs/families.md."""

    data: Path | None = None
    """Measure every object of this procedural data tree, not fresh ones."""
    categories: tuple[str, ...] = ()
    """Families to measure; none means all that have designed ambiguity."""
    objects: int = 20
    """Objects of each family."""
    seed: int = 0
    """Draws the objects."""
    pictures: Path | None = None
    """Folder for a picture of each family, front and backs; of all thirteen if no categories are given."""

    def run(self) -> int:
        from train.data.families import FAMILIES
        from train.data.portraits import draw_families
        from train.data.rules import measure, measure_tree

        if self.pictures is not None:
            draw_families(self.pictures, self.categories or tuple(FAMILIES), seed=self.seed)
        if self.data is not None:
            report = measure_tree(self.data)
        else:
            report = measure(self.categories or None, objects=self.objects, seed=self.seed)
        print(report.summary())
        return 1 if report.broken else 0


@dataclasses.dataclass
class Data:
    """Make a data tree, or look through one."""

    action: OmitArgPrefixes[
        Annotated[Procedural, subcommand("procedural")]
        | Annotated[Meshes, subcommand("meshes")]
        | Annotated[Photos, subcommand("photos")]
        | Annotated[Check, subcommand("check")]
        | Annotated[Show, subcommand("show")]
        | Annotated[Rules, subcommand("rules")]
    ]

    def run(self) -> int | None:
        return self.action.run()
