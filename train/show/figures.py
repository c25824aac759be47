"""Matplotlib figures of point clouds, of a run's curves and of errors.

Pyplot's global state is not used; `save` writes a figure. Clouds are drawn in perspective: near points are dark and
large, far ones pale and small.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, project
from train.files import replacing

PREDICTED = LinearSegmentedColormap.from_list("predicted", ["#0b2545", "#1f6f8b", "#5fb3b3", "#cfe8e0"])
TRUE = LinearSegmentedColormap.from_list("true", ["#3d1f0c", "#a4562a", "#dd9f63", "#f6e3c5"])
MUTED = "#6b7785"
_CELL_INCHES = 2.1
_DEPTH_RANGE = 0.45  # world units before and behind the origin over which the colour changes
_SHOWN_PICTURES = 3
_INK = 17_000  # total area of a cloud's markers in a cell, in square typographic points


class Example(NamedTuple):
    """One test shape with predictions and a reconstruction."""

    images: Tensor
    """(V, 3, H, W) all views in [0, 1], with the cameras' height and width."""
    camera: PinholeCamera
    """(V,) the views' cameras."""
    chosen: int
    """Index of the input view of the predictions."""
    predictions: Tensor
    """(R, N, 3) predictions from that view with R codes."""
    reconstruction: Tensor
    """(M, 3) reconstruction from all views."""
    target: Tensor
    """(P, 3) ground truth."""

    @property
    def sides(self) -> tuple[PinholeCamera, PinholeCamera]:
        """The chosen view's camera, and the one on the opposite side."""
        return self.camera[self.chosen], from_behind(self.camera[self.chosen])


def from_behind(camera: PinholeCamera) -> PinholeCamera:
    """The camera after half a turn around the world's vertical axis: the same height, the opposite side."""
    half_turn = torch.diag(camera.cam_from_world.new_tensor([-1.0, 1.0, -1.0, 1.0]))
    return PinholeCamera(camera.K, camera.cam_from_world @ half_turn, camera.height, camera.width)


def close_up(images: Tensor, camera: PinholeCamera, points: Tensor) -> tuple[Tensor, PinholeCamera]:
    """Crops all images of an object by the same margin, so that it fills them, and adapts the cameras.

    Args:
        images: (V, 3, H, W).
        camera: (V,), of H x W pixels.
        points: (P, 3) of the object.
    """
    closer = narrowed(camera, points)
    top, left = (camera.height - closer.height) // 2, (camera.width - closer.width) // 2
    return images[..., top : camera.height - top, left : camera.width - left], closer


def narrowed(camera: PinholeCamera, points: Tensor) -> PinholeCamera:
    """Cameras (V,), cropped by the largest margin with which all of them still show points (P, 3)."""
    size = points.new_tensor([camera.width, camera.height])
    away = (project(points[None], camera).pixels / size - 0.5).abs().max().item()
    share = max(0.0, 0.5 - 1.15 * away)
    top, left = int(share * camera.height), int(share * camera.width)
    K = camera.K.clone()
    K[..., 0, 2] -= left
    K[..., 1, 2] -= top
    return PinholeCamera(K, camera.cam_from_world, camera.height - 2 * top, camera.width - 2 * left)


def draw_cloud(
    axes: Axes, points: Tensor, camera: PinholeCamera, *, colours: LinearSegmentedColormap = PREDICTED
) -> None:
    """Draws a cloud (N, 3) in the view of a single camera; the axes show the whole image plane."""
    projected = project(points[None], camera)
    pixels, depth = projected.pixels[0, 0], projected.depth[0, 0]
    order = depth.argsort(descending=True)
    order = order[depth[order] > 0]
    pixels, depth = pixels[order], depth[order]
    middle = camera.cam_from_world[2, 3]  # depth of the world's origin, around which objects stand
    tone = ((depth - middle) / (2 * _DEPTH_RANGE) + 0.5).clamp(0, 1)
    area = _INK / max(len(points), 300) * (middle / depth).clamp(0.5, 2).square()
    axes.scatter(
        pixels[:, 0], pixels[:, 1], s=area, c=colours(tone.numpy()), linewidths=0.2, edgecolors="#ffffffa0"
    )
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
    bare(axes)


def draw_image(axes: Axes, image: Tensor) -> None:
    """Draws an image (3, H, W) in [0, 1] with a frame."""
    axes.imshow(image.permute(1, 2, 0).numpy(), interpolation="antialiased")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color("#d5dbe1")


def mosaic(images: Tensor) -> Tensor:
    """(V, 3, H, W) -> (3, rows * H, columns * W), as square as possible; empty cells are white."""
    columns = math.ceil(math.sqrt(len(images)))
    blank = images.new_ones(-len(images) % columns, *images.shape[1:])
    grid = torch.cat((images, blank)).unflatten(0, (-1, columns))
    return grid.permute(2, 0, 3, 1, 4).flatten(3, 4).flatten(1, 2)


def predictions_figure(*examples: Example) -> Figure:
    """An image, predictions with several codes, the true shape; from the image's side and from behind.

    Args:
        examples: one or more, with the same number of predictions; each takes two rows.
    """
    count = len(examples[0].predictions)
    figure, panels = grid(rows=2 * len(examples), columns=count + 2)
    for example, pair in zip(examples, panels.reshape(len(examples), 2, -1), strict=True):
        draw_image(pair[0, 0], example.images[example.chosen])
        bare(pair[1, 0])
        for row, camera in zip(pair, example.sides, strict=True):
            for axes, cloud in zip(row[1:-1], example.predictions, strict=True):
                draw_cloud(axes, cloud, camera)
            draw_cloud(row[-1], example.target, camera, colours=TRUE)
        _sides(pair[:, 1])
    titles(panels, ["the image", *(f"random code {i + 1}" for i in range(count)), "the true shape"])
    return figure


def reconstruction_figure(example: Example) -> Figure:
    """All views of a shape, its reconstruction, and the true shape; from one side and from behind."""
    figure, panels = grid(rows=1, columns=5)
    draw_image(panels[0, 0], mosaic(example.images))
    for axes, camera in zip(panels[0, 1:3], example.sides, strict=True):
        draw_cloud(axes, example.reconstruction, camera)
    for axes, camera in zip(panels[0, 3:], example.sides, strict=True):
        draw_cloud(axes, example.target, camera, colours=TRUE)
    titles(
        panels,
        [f"{len(example.images)} images", "reconstruction", "from behind", "the true shape", "from behind"],
    )
    return figure


def overview_figure(examples: Sequence[Example]) -> Figure:
    """The whole system in one figure: image, predictions, reconstruction from all images, true shape."""
    count, views = len(examples[0].predictions), len(examples[0].images)
    figure, panels = grid(rows=2 * len(examples), columns=count + 3)
    for example, (upper, lower) in zip(examples, panels.reshape(len(examples), 2, -1), strict=True):
        draw_image(upper[0], example.images[example.chosen])
        draw_image(lower[0], mosaic(example.images))
        for row, camera in zip((upper, lower), example.sides, strict=True):
            for axes, cloud in zip(row[1:-2], example.predictions, strict=True):
                draw_cloud(axes, cloud, camera)
            draw_cloud(row[-2], example.reconstruction, camera)
            draw_cloud(row[-1], example.target, camera, colours=TRUE)
        _sides([upper[1], lower[1]])
    guesses = [f"from this image, code {i + 1}" for i in range(count)]
    titles(panels, ["one image / all images", *guesses, f"from all {views} images", "the true shape"])
    return figure


class Photographed(NamedTuple):
    """An object in photographs, whose cameras and shape are not known."""

    caption: str
    pictures: Tensor
    """(V, 3, H, W) in [0, 1]."""
    predictions: Tensor
    """(R, N, 3) from the first picture with R codes."""
    reconstruction: Tensor
    """(M, 3) from all pictures."""
    remark: str = ""
    """About the reconstruction."""


def photographs_figure(objects: Sequence[Photographed]) -> Figure:
    """A row for each object: some of its pictures, predictions from the first, and the reconstruction from all.

    Clouds are seen from the network's own front, and the reconstruction from behind, too. If no object has more than
    one picture, a reconstruction is the first prediction and only shown from behind.
    """
    most = max(len(each.pictures) for each in objects)
    shown = min(most, _SHOWN_PICTURES)
    count = len(objects[0].predictions)
    last = ["from all pictures", "from behind"] if most > 1 else ["code 1, from behind"]
    figure, panels = grid(rows=len(objects), columns=shown + count + len(last))
    eyes = torch.tensor(
        [[0.94, 0.68, 1.63], [-0.94, 0.68, -1.63]]
    )  # 30 degrees to the side, 20 up; and opposite
    camera = PinholeCamera.look_at(eyes, focal_px=240.0, height=128, width=128)
    for line, each in zip(panels, objects, strict=True):
        for axes in line[:shown]:
            bare(axes)
        for axes, picture in zip(line, each.pictures[:shown], strict=False):
            draw_image(axes, picture)
        caption(line[0], each.caption)
        clouds = torch.cat([each.reconstruction, each.predictions.flatten(0, 1)])
        ahead, behind = narrowed(camera, clouds)
        for axes, cloud in zip(line[shown:], each.predictions, strict=False):
            draw_cloud(axes, cloud, ahead)
        for axes, side in zip(line[-len(last) :], (ahead, behind)[-len(last) :], strict=True):
            draw_cloud(axes, each.reconstruction, side)
        if each.remark:
            caption(line[-len(last)], each.remark)
    from_first = "from the first, " if most > 1 else ""
    codes = [f"{from_first}code {number + 1}" for number in range(count)]
    titles(panels, ["pictures", *[""] * (shown - 1), *codes, *last])
    return figure


def curves_figure(records: Sequence[Mapping[str, Any]]) -> Figure:
    """A run's losses, validation errors and collapse checks over its steps, from the records of metrics.jsonl."""
    figure = Figure(figsize=(17, 6.6), layout="constrained", dpi=110)
    panels = np.asarray(figure.subplots(2, 4)).ravel()
    stages = [[record for record in records if record.get("stage") == stage] for stage in (1, 2)]
    for axes, stage, what in zip(panels[:2], stages, ("each view alone", "views joined"), strict=True):
        _curves(axes, stage, {"front": "front constraint"})
        axes.set_title(f"Stage {1 if stage is stages[0] else 2}, {what}: front constraint")
    panels[0].set_ylabel("front constraint (EMD, sum)")
    panels[1].set_ylabel("front constraint (chamfer x100)")
    _curves(panels[2], records, {"diversity": "diversity loss"})
    panels[2].set(title="Diversity of shapes over codes", ylabel="diversity loss")
    _curves(
        panels[3],
        records,
        {"val_cd_1": "one view", "val_cd": "all views joined", "val_fps_cd": "all views, thinned"},
    )
    panels[3].set(title="Error on validation shapes", ylabel="chamfer distance x100", ylim=(0, None))
    _curves(panels[4], records, {"image_sensitivity": "with the image", "code_sensitivity": "with the code"})
    panels[4].set(title="Change of predictions", ylabel="chamfer distance x100", ylim=(0, None))
    _curves(panels[5], records, {"dead_share": "dead channels"})
    panels[5].set(title="Dead channels of the image trunk", ylabel="share", ylim=(-0.02, 1.02))
    scores = [
        {"step": record["step"], "difference": record["fake_score"] - record["real_score"]}
        for record in records
        if "fake_score" in record
    ]
    _curves(panels[6], scores, {"difference": "predictions"})
    panels[6].axhline(0, color=MUTED, lw=0.8)
    panels[6].set(title="Critic: predictions against real shapes", ylabel="difference of scores")
    pretraining = [record for record in records if record.get("stage") == 0]
    _curves(panels[7], pretraining, {"cd": "training shapes", "val_autoencoder_cd": "validation shapes"})
    panels[7].set(title="Auto-encoder: reconstruction error", ylabel="chamfer distance x100", ylim=(0, None))
    if stages[0] and stages[1]:
        for axes in panels[2:7]:
            axes.axvline(stages[0][-1]["step"], color=MUTED, lw=0.8, ls="--")
    return figure


def errors_figure(result: Mapping[str, Any]) -> Figure:
    """The error by number of images, beside the retrieval baselines; from the result of `evaluate`."""
    figure = Figure(figsize=(7.5, 4.2), layout="constrained", dpi=110)
    axes = figure.subplots()
    for label, rows, style in (
        ("generator, search and descent on the codes", result["views"], "o-"),
        ("generator, random codes", result["random_codes"], "o--"),
        ("nearest training shape by image", result["nearest_image"], "s-"),
    ):
        if not rows:
            continue
        colour = "#a4562a" if style[0] == "s" else "#1f6f8b"
        axes.plot(
            [int(n) for n in rows], [row["cd"] for row in rows.values()], style, color=colour, label=label
        )
    axes.axhline(result["medoid"]["cd"], color=MUTED, ls=":", label="medoid of the training shapes")
    counts = [int(n) for n in result["views"]]
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.set(xlabel="images of the object", ylabel="chamfer distance x100", ylim=(0, None))
    axes.legend(fontsize=9)
    plain(axes)
    return figure


def save(figure: Figure, path: str | Path) -> None:
    """Writes a PNG, atomically."""
    with replacing(Path(path)) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def grid(*, rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """A figure of square cells with narrow gaps, and with space for titles at the top."""
    width, height = columns * _CELL_INCHES + 0.1, rows * _CELL_INCHES + 0.4
    figure = Figure(figsize=(width, height), dpi=110)
    panels = figure.subplots(rows, columns, squeeze=False)
    top = 1 - 0.35 / height
    figure.subplots_adjust(0.05 / width, 0.05 / height, 1 - 0.05 / width, top, wspace=0.04, hspace=0.04)
    return figure, panels


def titles(panels: np.ndarray, words: Sequence[str]) -> None:
    """Sets the titles of a `grid`'s columns."""
    for axes, title in zip(panels[0], words, strict=True):
        axes.set_title(title, fontsize=11)


def headline(figure: Figure, words: str) -> None:
    """Adds a line of text above the column titles of a `grid`."""
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.3)
    bottom, top = figure.subplotpars.bottom, figure.subplotpars.top
    figure.subplots_adjust(bottom=bottom * height / (height + 0.3), top=top * height / (height + 0.3))
    figure.text(0.5, 1 - 0.08 / (height + 0.3), words, ha="center", va="top", fontsize=12)


def caption(axes: Axes, words: str) -> None:
    """Writes a line at the bottom of a cell, on a translucent white background."""
    behind = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5}
    where = {"transform": axes.transAxes, "ha": "center", "fontsize": 8, "color": MUTED}
    axes.text(0.5, 0.01, words, bbox=behind, **where)


def _sides(upper_and_lower: Sequence[Axes] | np.ndarray) -> None:
    for axes, side in zip(upper_and_lower, ("from the image's side", "from behind"), strict=True):
        axes.text(0, 0.5, side, transform=axes.transAxes, fontsize=8, color=MUTED, rotation=90, va="center")


def _curves(axes: Axes, records: Sequence[Mapping[str, Any]], names: Mapping[str, str]) -> None:
    """One line for each metric, over the records that have it; long ones are drawn with their running mean."""
    for (name, label), colour in zip(names.items(), ("#1f6f8b", "#c8553d", "#8a6d9e"), strict=False):
        found = [(record["step"], record[name]) for record in records if record.get(name) is not None]
        if not found:
            continue
        steps, values = np.array(found, float).T
        window = len(values) // 25
        if window < 2:
            axes.plot(steps, values, ".-", color=colour, label=label, lw=1.2)
            continue
        axes.plot(steps, values, color=colour, alpha=0.25, lw=0.8)
        axes.plot(steps, running_mean(values, share=25), color=colour, label=label, lw=1.6)
    if len(names) > 1 and axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=9)
    axes.set_xlabel("step")
    axes.title.set_fontsize(11)
    plain(axes)


def running_mean(values: np.ndarray, *, share: int) -> np.ndarray:
    """The mean over a window of `len(values) / share` values; shorter at the ends."""
    kernel = np.ones(max(1, len(values) // share))
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def plain(axes: Axes) -> None:
    """Leaves two sides of the frame, and adds a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)


def bare(axes: Axes) -> None:
    """Removes a cell's frame and ticks."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
