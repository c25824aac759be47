"""The report of an evaluated run: one HTML page with examples, errors, training curves and configuration."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from train.files import write_text
from train.show import figures, pages
from train.show.figures import Example
from train.show.summary import format_metric, result_rows
from train.show.tables import html_table

_OVERVIEW_SHAPES = 2

_INTRODUCTION = (
    "One photograph does not show what the back of a chair looks like. The generator takes an image and a random code "
    "and predicts a shape that fits the image; another code gives another such shape. With several images of one "
    "object, codes are searched and then optimised until the shapes predicted from all images agree; the positions of "
    "the cameras are not needed. The objects on this page were not used for training."
)
_SUPERVISION = {
    False: " The training loss uses depth maps, never a whole shape.",
    True: (
        " Every prediction has to fit the depth map of its image; of several predictions for an image the one nearest "
        "to the whole shape is trained on all of it, so that codes choose between shapes."
    ),
}
_COLUMNS = {
    "gt_to_pred": "ground truth to prediction",
    "pred_to_gt": "prediction to ground truth",
    "cd": "sum (CD)",
    "fps_cd": "CD, equal points",
    "consistency": "disagreement",
}


def write_report(
    out: str | Path,
    *,
    result: Mapping[str, Any],
    examples: Sequence[Example],
    records: Sequence[Mapping[str, Any]],
    config: str,
    run: str,
    seconds: Mapping[str, float],
    first: Sequence[str] = (),
) -> Path:
    """Writes out/report.html and out/figures/*.png.

    Args:
        out: directory to write to.
        result: the content of evaluation.json.
        examples: test shapes with predictions, at least one.
        records: of metrics.jsonl.
        config: the training's configuration as text.
        run: where the run is, for the reader.
        seconds: duration of each phase; may be empty.
        first: parts of the page that precede those about the run.

    Returns:
        The page.
    """
    out = Path(out)
    numbered = list(enumerate(examples, 1))
    drawn = {
        "overview": figures.overview_figure(examples[:_OVERVIEW_SHAPES]),
        **{f"predictions_{i}": figures.predictions_figure(example) for i, example in numbered},
        **{f"reconstruction_{i}": figures.reconstruction_figure(example) for i, example in numbered},
        "errors": figures.errors_figure(result),
        "curves": figures.curves_figure(records),
    }
    for name, figure in drawn.items():
        figures.save(figure, out / "figures" / f"{name}.png")
    whole_shapes = any(json.loads(config)[stage].get("shape_weight") for stage in ("stage1", "stage2"))
    body = [
        pages.paragraph(_INTRODUCTION + _SUPERVISION[whole_shapes]),
        *first,
        *(["<h2>A small network, trained here</h2>"] if first else []),
        pages.drawing(
            drawn["overview"],
            "Each pair of rows is one object: above from the side of the image, below from behind.",
        ),
        *_predictions(examples, drawn, result),
        *_reconstructions(examples, drawn),
        *_errors(result, drawn),
        *_training(drawn),
        *_record(config, run, seconds),
    ]
    categories = ", ".join(f"{each['shapes']} of {name}" for name, each in result["categories"].items())
    subtitle = (
        f"Evaluated on {result['data']['shapes']} unseen objects: {categories}. Size of the network: "
        f"{result['profile']}."
    )
    write_text(
        out / "report.html", pages.page("Shapes from single and from several images", body, subtitle=subtitle)
    )
    return out / "report.html"


def shipped_weights_section(
    examples: Sequence[Example], photographed: Sequence[figures.Photographed], explorers: Mapping[str, str]
) -> list[str]:
    """What the weights that come with the repository predict: unseen shapes, photographs, and pages to explore.

    Args:
        examples: shapes that the weights were not trained on.
        photographed: objects in photographs; may be empty.
        explorers: words about an image -> address of the page on which to explore it.
    """
    links = "; ".join(
        f'<a href="{html.escape(address)}">{html.escape(words)}</a>' for words, address in explorers.items()
    )
    body = [
        "<h2>The weights that come with the repository</h2>",
        pages.paragraph(
            "Objects that they have not seen. Each pair of rows is one object: the image and predictions for it with "
            "different codes, the reconstruction from all images, and the true shape; above from the side of the "
            "image, below from behind, where the predictions may differ."
        ),
        pages.drawing(figures.overview_figure(examples), "Generated objects."),
        f"<p>Drag through the codes of an image, and see what it leaves open: {links}.</p>",
    ]
    if photographed:
        body += [
            pages.drawing(
                figures.photographs_figure(photographed),
                "Photographs, with unknown cameras and true shapes. The network has been trained on renders only.",
            )
        ]
    return body


def _predictions(
    examples: Sequence[Example], drawn: Mapping[str, Figure], result: Mapping[str, Any]
) -> list[str]:
    change = result["sensitivity"]
    return [
        "<h2>One image, several shapes</h2>",
        pages.paragraph(
            "The same image with different random codes. Seen from the side of the image the predictions should look "
            "alike; they may differ where the image does not show the object."
        ),
        *(
            pages.drawing(
                drawn[f"predictions_{i}"], f"Object {i}: above from the image's side, below from behind."
            )
            for i in range(1, len(examples) + 1)
        ),
        pages.paragraph(
            f"On average a prediction changes by {change['image']:.2f} when the image is another object's, and by "
            f"{change['code']:.2f} when only the code changes (chamfer distance x100). If the first were zero, the "
            "network would ignore the image; if the second were zero, it would predict one shape only."
        ),
    ]


def _reconstructions(examples: Sequence[Example], drawn: Mapping[str, Figure]) -> list[str]:
    views, first = len(examples[0].images), examples[0]
    return [
        f"<h2>{views} images, one shape</h2>",
        pages.paragraph(
            "The predictions from all images after search and descent on their codes, joined into one cloud, beside "
            "the true surface. The first pair can be turned with the mouse."
        ),
        pages.row(
            [
                pages.cloud(first.reconstruction, f"Object 1, from {views} images", colours="Viridis"),
                pages.cloud(first.target, "Object 1, the true shape", colours="Oranges"),
            ],
            kind="pair",
        ),
        *(pages.drawing(drawn[f"reconstruction_{i}"], f"Object {i}.") for i in range(1, len(examples) + 1)),
    ]


def _errors(result: Mapping[str, Any], drawn: Mapping[str, Figure]) -> list[str]:
    most = max(result["views"], key=int)
    ours = result["views"][most]["cd"]

    def against(other: float) -> str:
        return f"{abs(1 - ours / other):.0%} {'below' if ours < other else 'above'}"

    medoid, nearest = against(result["medoid"]["cd"]), against(result["nearest_image"][most]["cd"])
    rows = [
        [name, *(format_metric(metrics.get(column)) for column in _COLUMNS)]
        for name, metrics in result_rows(result)
    ]
    return [
        "<h2>How large is the error?</h2>",
        html_table(["", *_COLUMNS.values()], rows),
        pages.paragraph(
            "Mean distances from each point to the other cloud, x100; an object's size is about one unit, so 1.00 is a "
            "hundredth of its size. Equal points: after thinning to the size of one prediction, because more images "
            "give more points, which alone lowers the error. Disagreement: distance between the predictions from an "
            "object's images. Random codes: without search and descent. Two baselines need no network: the training "
            "shape whose images are nearest to the given ones, and the medoid, the training shape with the smallest "
            f"mean distance to all others. With {most} images the generator's error (CD) is {medoid} that of the "
            f"medoid and {nearest} that of the nearest shape by image."
        ),
        pages.drawing(drawn["errors"], "Error (CD) by number of images. Lower is better."),
    ]


def _training(drawn: Mapping[str, Figure]) -> list[str]:
    return [
        "<h2>How was it trained?</h2>",
        pages.paragraph(
            "Stage 1 uses single images: the part of a predicted shape that the image's camera sees must match the "
            "depth map (front constraint), and different codes must give different shapes (diversity). Stage 2 uses "
            "several images of an object, whose predictions are joined before the comparison. In a healthy run "
            "predictions change with the image and with the code, and few channels of the image trunk are zero."
        ),
        pages.drawing(
            drawn["curves"],
            "Losses, errors on held-out shapes and collapse checks over the steps; dashed: start of stage 2.",
        ),
    ]


def _record(config: str, run: str, seconds: Mapping[str, float]) -> list[str]:
    took = [[phase, f"{value / 60:.1f} min"] for phase, value in seconds.items()]
    total = [["total", f"{sum(seconds.values()) / 60:.1f} min"]]
    return [
        "<h2>What was run?</h2>",
        *([html_table(["phase", "time"], took + total)] if took else []),
        pages.paragraph(
            f"The run is in {run}, with checkpoints, metrics and TensorBoard events. Its configuration:"
        ),
        pages.listing(config),
    ]
