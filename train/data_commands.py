"""The commands under `python -m train data`. Each imports its code when it runs, so that --help is fast."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, subcommand


@dataclasses.dataclass
class Procedural:
    """Generate a data tree of procedural shapes; needs no download.

    In seven of thirteen categories the front view hides one of three different backs, see docs/families.md.
    """

    out: Path
    """Directory of the new data tree; running the command again finishes or extends it."""
    shapes: int = 400
    """Number of shapes, over all categories."""
    categories: tuple[str, ...] = ()
    """Categories to generate, for instance `chair display`; all thirteen if not given."""
    seed: int = 0
    """The same seed gives the same tree."""
    size: int = 224
    """Side of the renders in pixels; 112 is enough for the cpu profile."""
    views: int = 8
    """Views per shape."""
    variants: int = 1
    """How many of an object's three backs become shapes of their own, with the same front, cameras and split."""
    fronts: int = 0
    """How many of the views show the front that hides the backs; random views seldom do."""

    def run(self) -> None:
        from train.data.procedural import generate

        report = generate(
            self.out,
            shapes=self.shapes,
            categories=self.categories or None,
            seed=self.seed,
            size=self.size,
            views=self.views,
            variants=self.variants,
            fronts=self.fronts,
        )
        print(report.summary())


@dataclasses.dataclass
class Meshes:
    """Render meshes into a data tree: OBJ, GLB, glTF, PLY, OFF, STL, AC3D or MD2, from folders or archives.

    Folders may be laid out as ShapeNetCore; archives are .zip files and .sh3f libraries of Sweet Home 3D.
    """

    sources: Positional[tuple[Path, ...]]
    """Mesh files, folders, .zip archives or .sh3f libraries."""
    out: Path
    """Directory of the new data tree; running the command again finishes or extends it."""
    labels: Path | None = None
    """CSV file with the category of each mesh; meshes without a label are left out."""
    unlabelled: bool = False
    """Use the meshes without a label too; their category is that of a folder on the path, or "unknown"."""
    category: str | None = None
    """Category of all meshes; by default that of a folder on the path, by its name or its WordNet synset."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "y"
    """The axis that points up in the files; not used for .sh3f libraries, which are known to have y up."""
    scale: float | None = None
    """World units per unit of the files, to keep relative sizes; by default each mesh is scaled to a bounding box with
    the diagonal 1."""
    stretched: int = 0
    """How many more shapes to make of each mesh, stretched along its three axes by random factors from 0.74 to 1.35;
    they are in the split of their mesh."""
    drop_hidden: bool = False
    """Leave out ground-truth points that are visible neither in a view nor from anywhere outside."""
    size: int = 224
    """Side of the renders in pixels; 112 is enough for the cpu profile."""
    views: int = 8
    """Views per mesh, at equal steps around it."""
    elevation: tuple[float, float] = (-20.0, 40.0)
    """Lowest and highest elevation of the cameras in degrees."""
    distance: float = 2.0
    """Distance of the cameras from the middle of the mesh, in world units."""
    focal: float = 1.875
    """Focal length, as a multiple of the side of the renders; 1.875 is 420 pixels at 224."""
    seed: int = 0
    """Seed of cameras, surface samples and the split."""
    processes: int | None = None
    """Number of worker processes; one per core by default."""

    def run(self) -> None:
        from train.data.meshes import MeshOptions, convert
        from train.data.render import Orbit

        orbit = Orbit(self.elevation, self.distance, self.focal)
        report = convert(
            self.sources,
            self.out,
            labels=self.labels,
            unlabelled=self.unlabelled,
            size=self.size,
            views=self.views,
            seed=self.seed,
            processes=self.processes,
            options=MeshOptions(self.category, self.up, self.scale, self.drop_hidden, self.stretched, orbit),
        )
        print(report.summary())


@dataclasses.dataclass
class Photos:
    """Cut objects out of photographs, for `reconstruct`: centred on white, at the scale of training pictures.

    The folder holds photographs of one object, one folder for each object, or Stanford Online Products. The object is
    found by a mask beside the photograph (NAME_mask.png or masks/NAME.png), by transparency, or by a plain background.
    """

    source: Positional[Path]
    """Folder of the photographs."""
    out: Path
    """New folder: OUT/OBJECT/NAME.png are the pictures, OUT/OBJECT/masks/NAME.png the masks to check by eye."""
    size: int = 224
    """Side of the pictures in pixels."""
    fewest: int = 1
    """Leave out objects with fewer photographs than this."""
    objects: int | None = None
    """Use at most this many objects; all if not given."""

    def run(self) -> None:
        from train.data.photos import convert_photos

        report = convert_photos(
            self.source, self.out, size=self.size, fewest=self.fewest, objects=self.objects
        )
        print(report.summary())


@dataclasses.dataclass
class Check:
    """Check a data tree: count its shapes, name broken files, test that cameras, depth and clouds agree.

    The exit code is 1 if there are problems.
    """

    data: Positional[Path]
    """Root of the data tree."""

    def run(self) -> int:
        from train.data.check import check_tree

        report = check_tree(self.data)
        print(report.summary())
        return 1 if report.problems else 0


@dataclasses.dataclass
class Show:
    """Draw a picture of each category of a data tree: views, depth, and the cloud from front and back."""

    data: Positional[Path]
    """Root of the data tree."""
    out: Path | None = None
    """Folder for the pictures; contact/ in the data tree if not given."""
    categories: tuple[str, ...] = ()
    """Categories to draw; all if not given."""
    shapes: int = 8
    """Shapes in each picture, evenly spread over the category."""

    def run(self) -> None:
        from train.data.contact_sheet import show

        for category, path in show(
            self.data, self.out, categories=self.categories or None, shapes=self.shapes
        ).items():
            print(f"{category}: {path}")


@dataclasses.dataclass
class Rules:
    """Measure the ambiguity of the procedural categories: front views must hide different backs.

    See docs/families.md for the rules. The exit code is 1 if an object breaks one.
    """

    data: Path | None = None
    """Measure the objects of this procedural data tree; newly generated objects if not given."""
    categories: tuple[str, ...] = ()
    """Categories to measure; all seven with designed ambiguity if not given."""
    objects: int = 20
    """Number of newly generated objects of each category."""
    seed: int = 0
    """Seed of the first newly generated object."""
    pictures: Path | None = None
    """Also write a picture of each category, front and backs, to this folder; of all thirteen without --categories."""

    def run(self) -> int:
        from train.data.ambiguity_check import measure_families, measure_tree

        if self.pictures is not None:
            from train.data.contact_sheet import draw_families
            from train.data.families import FAMILIES

            draw_families(self.pictures, self.categories or tuple(FAMILIES), seed=self.seed)
        if self.data is not None:
            report = measure_tree(self.data)
        else:
            report = measure_families(self.categories or None, objects=self.objects, seed=self.seed)
        print(report.summary())
        return 1 if report.broken else 0


@dataclasses.dataclass
class Data:
    """Make a data tree, check it, or draw it.

    A data tree is the folder that `fit` and `evaluate` read: the views, depth maps, cameras and point cloud of each
    shape, and the lists of the training, validation and test split; see docs/data.md.
    """

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
