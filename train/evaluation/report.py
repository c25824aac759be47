"""The report of a run: what went in, what came out, how good it is; one HTML page for any reader."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from models import Generator
from train.config import FitConfig, fit_config_from_json
from train.data import Shape, ShapeTree
from train.errors import UserError
from train.evaluation.inference import reconstruct
from train.evaluation.runs import load_generator, read_metrics
from train.files import write_text
from train.show import figures, pages
from train.show.figures import Example

_CODES = 4
_SHAPES = 3
_FIRST_OVERVIEW_SHAPES = 2

_WHAT = (
    "One photograph does not say what the back of a chair looks like. The generator here takes an image and a "
    "random code and answers with one shape that fits the image; another code gives another such shape. With "
    "several images of one object the true shape is what all of their answers can agree on: codes are searched, "
    "then adjusted, until the shapes from all images coincide; nobody has to say where the cameras stood. The "
    "training loss sees depth maps, never a whole shape. The objects on this page were kept out of training."
)
_COLUMNS = {
    "gt_to_pred": "truth to prediction",
    "pred_to_gt": "prediction to truth",
    "cd": "sum (CD)",
    "fps_cd": "CD, equal points",
    "consistency": "disagreement",
}


def write_report(
    out: Path, *, run: Path, data: Path, seconds: Mapping[str, float] | None = None, seed: int = 0
) -> Path:
    """Writes out/report.html and out/figures/*.png about an evaluated run.

    Args:
        out: directory to write to.
        run: directory of the run; must hold evaluation.json.
        data: root of the data tree; examples come from its test split.
        seconds: time taken by each phase, for the record.
        seed: draws the codes of the examples.

    Returns:
        The page.

    Raises:
        UserError: no run, no evaluation or no data there.
    """
    if not (run / "evaluation.json").exists():
        raise UserError(
            f"{run} has no evaluation.json; make it with: python -m train evaluate {run} --data {data}"
        )
    result = json.loads((run / "evaluation.json").read_text())
    config = fit_config_from_json((run / "config.json").read_text(), where=str(run / "config.json"))
    model = load_generator(run)
    examples = [
        make_example(model, shape, config, seed=seed) for shape in pick_shapes(ShapeTree(data, "test"))
    ]
    drawn = {
        "overview": figures.overview_figure(examples[:_FIRST_OVERVIEW_SHAPES]),
        **{f"predictions_{i}": figures.predictions_figure(example) for i, example in enumerate(examples, 1)},
        **{
            f"reconstruction_{i}": figures.reconstruction_figure(example)
            for i, example in enumerate(examples, 1)
        },
        "errors": figures.errors_figure(result),
        "curves": figures.curves_figure(read_metrics(run)),
    }
    for name, figure in drawn.items():
        figures.save(figure, out / "figures" / f"{name}.png")
    body = [
        pages.paragraph(_WHAT),
        pages.drawing(
            drawn["overview"],
            "Each pair of rows is one object: seen from the image's side above, from behind below.",
        ),
        *_predictions(examples, drawn, result),
        *_reconstructions(examples, drawn),
        *_errors(result, drawn),
        *_training(drawn),
        *_record(result, run, seconds or {}),
    ]
    target = out / "report.html"
    write_text(
        target,
        pages.page("Shapes from single images, agreed on by several", body, subtitle=_subtitle(result)),
    )
    return target


@torch.no_grad()
def make_example(
    model: Generator, shape: Shape, config: FitConfig, *, seed: int, codes: int = _CODES
) -> Example:
    """A test shape, predictions from the image that shows its front best, and a reconstruction from all images."""
    chosen = int(
        shape.camera.position[:, 2].argmax()
    )  # objects face +z: their backs are what this view hides
    drawn = torch.randn(codes, 1, model.code_dim, generator=torch.Generator().manual_seed(seed))
    predictions = model(shape.images[chosen : chosen + 1], drawn)[:, 0]
    found = reconstruct(model, shape.images, seed=seed, settings=config.inference)
    images, camera = figures.close_up(shape.images, shape.camera, shape.points)
    return Example(images, camera, chosen, predictions, found.points[0], shape.points)


def pick_shapes(tree: ShapeTree, count: int = _SHAPES) -> list[Shape]:
    """A few readable shapes, of as many categories as there are."""
    by_category: dict[str, list[Shape]] = {}
    for shape in tree.iter_valid():
        same = by_category.setdefault(shape.category, [])
        if len(same) < count:
            same.append(shape)
    ranked = [(rank, shape) for same in by_category.values() for rank, shape in enumerate(same)]
    picked = [shape for _, shape in sorted(ranked, key=lambda pair: pair[0])][:count]
    if not picked:
        raise UserError(f"{tree.path} has no readable shape in its {tree.split} split")
    return picked


def _subtitle(result: dict[str, Any]) -> str:
    categories = ", ".join(f"{each['shapes']} of {name}" for name, each in result["categories"].items())
    shapes, size = result["data"]["shapes"], result["profile"]
    return f"Scored on {shapes} unseen objects: {categories}. Size of the network: {size}."


def _predictions(examples: list[Example], drawn: dict[str, Any], result: dict[str, Any]) -> list[str]:
    moved = result["sensitivity"]
    return [
        "<h2>One image, several shapes</h2>",
        pages.paragraph(
            "The same image with different random codes. From the image's side the predictions should look alike; "
            "what the image does not show, they may fill in differently."
        ),
        *(
            pages.drawing(
                drawn[f"predictions_{i}"], f"Object {i}: above from the image's side, below from behind."
            )
            for i in range(1, len(examples) + 1)
        ),
        pages.paragraph(
            f"On average a prediction moves by {moved['image']:.2f} when the image is another object's, and by "
            f"{moved['code']:.2f} when only the code changes (chamfer distance x100). Were the first zero, the "
            "network would not look; were the second zero, it would know only one answer."
        ),
    ]


def _reconstructions(examples: list[Example], drawn: dict[str, Any]) -> list[str]:
    views, first = len(examples[0].images), examples[0]
    return [
        f"<h2>{views} images, one shape</h2>",
        pages.paragraph(
            "The predictions of all images after search and descent on their codes, laid over one another, beside "
            "the true surface. The first pair can be turned with the mouse."
        ),
        pages.row(
            [
                pages.cloud(first.reconstruction, f"Object 1, from {views} images", colours="Viridis"),
                pages.cloud(first.truth, "Object 1, the true shape", colours="Oranges"),
            ],
            kind="pair",
        ),
        *(pages.drawing(drawn[f"reconstruction_{i}"], f"Object {i}.") for i in range(1, len(examples) + 1)),
    ]


def _errors(result: dict[str, Any], drawn: dict[str, Any]) -> list[str]:
    most = max(result["views"], key=int)
    ours = result["views"][most]["cd"]

    def beside(other: float) -> str:
        return f"{abs(1 - ours / other):.0%} {'below' if ours < other else 'above'}"

    typical, alike = beside(result["medoid"]["cd"]), beside(result["nearest_image"][most]["cd"])
    rows = [
        [name, *("-" if scores.get(c) is None else f"{scores[c]:.2f}" for c in _COLUMNS)]
        for name, scores in _scores(result)
    ]
    return [
        "<h2>How good is it?</h2>",
        pages.table(["", *_COLUMNS.values()], rows),
        pages.paragraph(
            "Mean distances from each point to the other cloud, x100; an object is about one unit across, so 1.00 is a "
            "hundredth of its size. Equal points: thinned to the size of one prediction, so that more images do not "
            "gain by more points alone. Disagreement: between the predictions of an object's images. Random codes: "
            "the same without the search for agreement. The two answers without a network: the most typical "
            "training shape, and the training shape whose pictures "
            f"look most alike. With {most} images the generator's error (CD) is {typical} that of the most typical "
            f"shape and {alike} that of the shape that looks most alike."
        ),
        pages.drawing(drawn["errors"], "Error (CD) by number of images. Lower is better."),
    ]


def _scores(result: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    def images(n: str) -> str:
        return f"{n} image" if n == "1" else f"{n} images"

    return [
        *((f"generator, {images(n)}", scores) for n, scores in result["views"].items()),
        *((f"random codes, {images(n)}", scores) for n, scores in result["random_codes"].items() if n != "1"),
        *((f"nearest by image, {images(n)}", scores) for n, scores in result["nearest_image"].items()),
        ("most typical shape", result["medoid"]),
    ]


def _training(drawn: dict[str, Any]) -> list[str]:
    return [
        "<h2>How it was trained</h2>",
        pages.paragraph(
            "First on single images: what the predicted shape shows to the image's camera must match what the camera "
            "saw (front constraint), and different codes must give different shapes (diversity). Then on several "
            "images of an object, whose predictions are laid together before they are compared. A healthy run moves "
            "with its image and with its codes, and keeps the image trunk alive."
        ),
        pages.drawing(
            drawn["curves"],
            "Losses, errors on held-out shapes and health, over the steps; dashed: stage 2 begins.",
        ),
    ]


def _record(result: dict[str, Any], run: Path, seconds: Mapping[str, float]) -> list[str]:
    took = [[phase, f"{value / 60:.1f} min"] for phase, value in seconds.items()]
    total = [["together", f"{sum(seconds.values()) / 60:.1f} min"]] if took else []
    return [
        "<h2>What was run</h2>",
        *([pages.table(["phase", "time"], took + total)] if took else []),
        pages.paragraph(
            f"The run is in {run}, with checkpoints, metrics and TensorBoard events. Its configuration:"
        ),
        pages.listing((run / "config.json").read_text()),
    ]
