"""Networks trained with each loss: front constraint, projection losses, another visibility; everything else equal."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import farthest_point_sample, nearest, visible_points
from models import Predictor
from train.config import FitConfig, InferenceConfig, StageConfig, Supervision, fit_config_from_json
from train.data.batches import Batch, LoadedSplit
from train.evaluation.inference import predict_images
from train.evaluation.metrics import cloud_errors, in_silhouette, visible_error
from train.evaluation.per_shape import concatenate, one_view_each, sample_predictions
from train.evaluation.runs import read_metrics
from train.experiments.statistics import spread, spread_text, trainings
from train.experiments.store import Metrics
from train.experiments.study import Study
from train.methods import get_method
from train.show import figures
from train.show.tables import markdown_lines
from train.training.trainer import STAGES
from train.training.validation import validate

Verdict = Literal["converged", "in between", "did not converge"]

_STAGE1_SHARE, _STAGE2_SHARE, _MANY_SHARE = 0.25, 0.2, 0.35
"""Of the profile's steps, with half of its shapes in a batch: enough to see what converges, in an hour and a half for
all trainings."""
_VIEWS = 8
_RANDOM = InferenceConfig(groups=1, steps=0)
_PARTS = 32
_EXAMPLES = 3
_FLOOR = "points of the true surface"
_COLUMNS = {
    "visible": "visible part",
    "inside": "inside",
    "pred_to_gt": "cloud to shape",
    "gt_to_pred": "shape to cloud",
    "cd": "8 views joined, CD",
    "fps_cd": "FPS-CD",
}
_EVENNESS = {"front_density": "density in front", "imbalance": "imbalance"}
_CURVES = ("visible", "inside", "cd_1", "cd")
_PANELS = {
    "visible": "visible part, chamfer x100",
    "inside": "share inside the silhouette",
    "cd_1": "one view against the whole shape, CD x100",
}


class Training(NamedTuple):
    """A loss to train with: its name and colour as tables and curves show them, and the fields of `StageConfig`."""

    name: str
    colour: str
    supervision: Supervision
    visibility: Literal["zbuffer", "horizon"] = "zbuffer"

    def single(self, config: FitConfig) -> FitConfig:
        """A profile's recipe under this loss: stage 1 on single views, then stage 2 on joined ones."""
        return self._config(config, self._stage(config.stage1, _STAGE1_SHARE), _STAGE2_SHARE)

    def many(self, config: FitConfig) -> FitConfig:
        """A profile's recipe under this loss: stage 2 alone, from fresh weights and longer."""
        return self._config(config, dataclasses.replace(config.stage1, steps=0), _MANY_SHARE)

    def _config(self, config: FitConfig, stage1: StageConfig, stage2_share: float) -> FitConfig:
        stage2 = self._stage(config.stage2, stage2_share)
        every = max(1, stage2.steps // 4)
        return dataclasses.replace(
            config,
            stage1=stage1,
            stage2=stage2,
            min_image_sensitivity=0.0,  # a collapse is a result here
            validate_every=every,
            collapse_check_every=every,
            validation_shapes=min(16, config.validation_shapes),
        )

    def _stage(self, like: StageConfig, share: float) -> StageConfig:
        return dataclasses.replace(
            like.lasting(max(1, round(share * like.steps))),
            shapes=max(1, like.shapes // 2),
            supervision=self.supervision,
            visibility=self.visibility,
        )


TRAININGS = {
    "front": Training("front constraint", "#22577a", "front"),
    "horizon": Training("front constraint, hidden points dropped", "#57a0c9", "front", "horizon"),
    "projection": Training("projection loss, depth alone", "#c8553d", "projection"),
    "lin": Training("projection loss of Lin et al.", "#e59866", "lin"),
    "soft": Training("soft projection loss", "#6a994e", "soft"),
}


def _trained_on_many() -> dict[str, Training]:
    return {name: each for name, each in TRAININGS.items() if each.visibility == "zbuffer"}


def configs(study: Study) -> list[FitConfig]:
    """All trainings of the study, seed by seed."""
    return study.configs(
        *(each.single for each in TRAININGS.values()), *(each.many for each in _trained_on_many().values())
    )


# Measurements


def summarise(study: Study) -> dict[str, Any]:
    """Trains and measures what is missing; the result is for JSON.

    Returns:
        "single" and "many": for each of `TRAININGS` means and spreads over trainings after each stage, and the curves
        of validation with a verdict for each training.
    """
    study.train_all(configs(study))
    cells = [(config, stage) for config in configs(study) for stage in _stages(config)]
    study.measure_all(_measured, cells)
    return {
        "shapes": len(study.reconstruction_metrics(configs(study)[0], _RANDOM, views=_VIEWS)["cd"]),
        "seeds": study.seeds,
        "profile": study.profile,
        "floor": _floor(study),
        "single": {name: _of_runs(study, study.configs(each.single)) for name, each in TRAININGS.items()},
        "many": {
            name: _of_runs(study, study.configs(each.many)) for name, each in _trained_on_many().items()
        },
    }


def _stages(config: FitConfig) -> tuple[Literal[1, 2], ...]:
    return (1, 2) if config.stage1.steps else (2,)


def _of_runs(study: Study, runs: Sequence[FitConfig]) -> dict[str, Any]:
    """What one way of training leads to, over its seeds: errors after each stage, and the curves of the first stage."""
    stages = _stages(runs[0])
    found: dict[str, Any] = {"steps": [runs[0].phases[f"stage{stage}"].steps for stage in stages]}
    for stage in stages:
        by_seed = [_measured(study, config, stage) for config in runs]
        found[f"stage{stage}"] = {name: spread([each[name] for each in by_seed]) for name in by_seed[0]}
    return found | {"curves": [_curve(study, config, stages[0]) for config in runs]}


def _measured(study: Study, config: FitConfig, stage: Literal[1, 2]) -> dict[str, float]:
    """Means over the test shapes: of single views, and of all views joined."""

    def single_views(model: Predictor, test: LoadedSplit) -> Metrics:
        predicted = sample_predictions(model, test, codes=1, seed=config.seed)
        return concatenate(
            [
                single_view_metrics(clouds[0], test.points[shapes], shown)
                for shapes, shown, clouds in predicted
            ]
        )

    alone = study.measure(config, "single views", single_views, stage=stage)
    joined = study.reconstruction_metrics(config, _RANDOM, stage=stage, views=_VIEWS)
    both = alone | {name: joined[name] for name in ("cd", "fps_cd")}
    return {name: values.mean().item() for name, values in both.items()}


def single_view_metrics(clouds: Tensor, true: Tensor, shown: Batch) -> Metrics:
    """Metrics (B,) of clouds (B, N, 3) predicted from one view each, against the ground truth (B, P, 3).

    "cd_1", "pred_to_gt", "gt_to_pred" x100 against the whole shape; "visible" and "inside" as in validation; and those
    of `densities`.
    """
    errors = cloud_errors(clouds, true)
    return {
        "visible": visible_error(clouds, shown.camera, shown.depth)[:, 0],
        "inside": in_silhouette(clouds, shown.camera, shown.depth).float().mean((1, 2)),
        "cd_1": errors.cd,
        "pred_to_gt": errors.pred_to_gt,
        "gt_to_pred": errors.gt_to_pred,
        **densities(clouds, true, visible_points(true, shown.camera, method="horizon")[:, 0]),
    }


def densities(clouds: Tensor, true: Tensor, seen: Tensor) -> Metrics:
    """How evenly clouds lie on surfaces.

    Args:
        clouds: (B, N, 3).
        true: (B, P, 3) evenly spread over the surface.
        seen: (B, P) bool: the points that the view sees.

    Returns:
        "front_density" (B,): which share of a cloud lies where the view sees the surface, over the share of the true
        surface that it sees (1: as dense as behind). "imbalance" (B,): which share would have to move to another of 32
        parts of the surface for all parts to be as dense (0 to 1).
    """
    at = nearest(clouds, true).index
    true_share, share = seen.float().mean(1), seen.gather(1, at).float().mean(1)
    centres = torch.take_along_dim(true, farthest_point_sample(true, _PARTS)[..., None], 1)
    part = nearest(true, centres).index
    true_parts, parts = (
        torch.nn.functional.one_hot(of, _PARTS).float().mean(1) for of in (part, part.gather(1, at))
    )
    return {
        "front_density": share / true_share.clamp(min=1e-6),
        "imbalance": (parts - true_parts).abs().sum(1) / 2,
    }


def _floor(study: Study) -> dict[str, float]:
    """The metrics of as many points of the true surface as a network predicts."""
    config = configs(study)[0]
    test = study.split(config, "test")
    count = get_method(config.system).network_config(config).points
    generator = torch.Generator().manual_seed(0)
    some = torch.stack([torch.randperm(test.points.shape[1], generator=generator)[:count] for _ in test.ids])
    found = [
        single_view_metrics(test.clouds(shapes, some[shapes]), test.points[shapes], shown)
        for shapes, shown in one_view_each(test, 0)
    ]
    return {name: values.mean().item() for name, values in concatenate(found).items()}


def _curve(study: Study, config: FitConfig, stage: Literal[1, 2]) -> dict[str, Any]:
    """The validations during a training, from the fresh weights on; and whether it converged."""
    fresh = study.measure(
        config,
        "validation",
        lambda m, d: {k: torch.tensor([v]) for k, v in validate(m, d, seed=config.seed).items()},
        stage=0,
        split="val",
    )
    run = study.train(config, stage=stage)
    records = [r for r in read_metrics(run) if r["stage"] == stage and "val_visible" in r]
    trained = fit_config_from_json((run / "config.json").read_text(), where=str(run))
    before = sum(phase.steps for name, phase in trained.phases.items() if STAGES[name] < stage)
    curve = {
        name: [fresh[f"val_{name}"].item(), *(record[f"val_{name}"] for record in records)]
        for name in _CURVES
    }
    left = curve["visible"][-1] / curve["visible"][0]
    steps = [0, *(record["step"] - before for record in records)]
    return {"step": steps, **curve, "left": left, "verdict": verdict(left, curve["inside"][-1])}


def verdict(left: float, inside: float) -> Verdict:
    """Did a training converge?

    Args:
        left: its last validation's error of the visible part, as a share of the fresh network's.
        inside: share of its points in the silhouette then.
    """
    if left >= 0.8 or inside < 0.5:
        return "did not converge"
    return "converged" if left < 0.3 else "in between"


# The page


def markdown(found: Mapping[str, Any]) -> str:
    """Tables of everything."""
    single, many, floor = found["single"], found["many"], found["floor"]
    stage1, stage2 = single["front"]["steps"]
    evenness = [
        [each.name, f"stage {stage}", *(spread_text(single[name][f"stage{stage}"][m]) for m in _EVENNESS)]
        for name, each in TRAININGS.items()
        for stage in (1, 2)
    ]
    evenness.append([_FLOOR, "", *(f"{floor[metric]:.2f}" for metric in _EVENNESS)])
    lines = [
        f"Networks of the profile `{found['profile']}`, {found['seeds']} trainings of each, {found['shapes']} held-out "
        "shapes, one random code for each image. Mean ± standard deviation over trainings; distances un-squared, x100.",
        "",
        f"Stage 1 on single views, {stage1} steps. Converged, by the last validation: the error of the visible part "
        "below 30 % of the fresh network's; not converged: above 80 %, or less than half of the points in the "
        "silhouette. The last row is for as many points of the true surface, a lower bound.",
        "",
        *_table(single, "stage1", floor=floor),
        "",
        f"The same networks after stage 2 on joined views, {stage2} more steps with the same loss:",
        "",
        *_table(single, "stage2", converged=False),
        "",
        f"Joined views from the first step, no stage 1, {many['front']['steps'][0]} steps:",
        "",
        *_table(many, "stage2"),
        "",
        "How evenly predictions for single views lie on the surface. Density in front: 1 is as dense as behind. "
        "Imbalance: share of the points that would have to move for 32 parts of the surface to be as dense.",
        "",
        *markdown_lines(["loss", "after", *_EVENNESS.values()], evenness, "llrr"),
    ]
    return "\n".join([*lines, ""])


def _table(
    rows: Mapping[str, Any], stage: str, *, converged: bool = True, floor: Mapping[str, float] | None = None
) -> list[str]:
    head = ["loss", *_COLUMNS.values(), *(["error left", "converged?"] if converged else [])]
    lines = []
    for name, row in rows.items():
        cells = [TRAININGS[name].name, *(spread_text(row[stage][metric]) for metric in _COLUMNS)]
        if converged:
            left = sorted(curve["left"] for curve in row["curves"])
            ends = dict.fromkeys(f"{share:.0%}" for share in (left[0], left[-1]))
            verdicts = Counter(curve["verdict"] for curve in row["curves"])
            words = [f"{count} {each}" if len(verdicts) > 1 else each for each, count in verdicts.items()]
            cells += [" to ".join(ends), ", ".join(words)]
        lines.append(cells)
    if floor:
        lines.append([_FLOOR, *(f"{floor[m]:.2f}" if m in floor else "" for m in _COLUMNS), "", ""])
    return markdown_lines(head, lines)


def curves(found: Mapping[str, Any]) -> Figure:
    """Validations during training: a line for each loss, a band from the lowest to the highest training."""
    figure = Figure(figsize=(14, 8), layout="constrained", dpi=110)
    figure.suptitle(
        f"Networks trained with each loss: {trainings(found['seeds'])} of each; mean, lowest and highest, validation "
        "shapes",
        fontsize=14,
    )
    rows = np.asarray(figure.subplots(2, len(_PANELS)))
    parts = {"single": "stage 1, single views", "many": "joined views from the start"}
    for panels, (part, title) in zip(rows, parts.items(), strict=True):
        for axes, (name, label) in zip(panels, _PANELS.items(), strict=True):
            start = 0.0
            for loss, row in found[part].items():
                values = np.array([curve[name] for curve in row["curves"]])
                start = max(start, values[:, 0].max())
                steps, colour = row["curves"][0]["step"], TRAININGS[loss].colour
                axes.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
                axes.plot(steps, values.mean(0), color=colour, lw=1.6, label=TRAININGS[loss].name)
            axes.axhline(found["floor"][name], color=figures.MUTED, lw=1, ls="--", label=_FLOOR)
            # Not up to the largest value: a training that diverges would press the others flat.
            axes.set(
                title=title, xlabel="step", ylabel=label, ylim=(0, 1 if name == "inside" else 1.6 * start)
            )
            figures.plain(axes)
    rows[0, 0].legend(fontsize=8)
    return figure


@torch.no_grad()
def predictions(study: Study) -> Figure:
    """Held-out shapes, spread over the test split, and predictions of the first training with each loss after stage 1;
    from the image's side and a quarter turn away."""
    losses = {each.name: study.config(each.single, seed=0) for each in TRAININGS.values()}
    test = study.split(configs(study)[0], "test")
    shapes = torch.linspace(0, len(test) - 1, min(_EXAMPLES, len(test))).long()
    seen = test.batch(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))
    columns = {"ground truth": test.points[shapes]}
    for name, config in losses.items():
        model = study.network(config, stage=1)
        codes = torch.randn(1, len(shapes), model.code_dim, generator=torch.Generator().manual_seed(0))
        columns[name] = predict_images(model, seen.images[:, 0], codes)[0]
    turn = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])  # about the vertical
    figure, panels = figures.grid(rows=2 * len(shapes), columns=len(columns) + 1)
    for shape, (upper, lower) in enumerate(panels.reshape(len(shapes), 2, -1)):
        figures.draw_image(upper[0], seen.images[shape, 0])
        lower[0].axis("off")
        front = seen.camera[shape, 0]
        beside = dataclasses.replace(front, cam_from_world=front.cam_from_world @ turn)
        for row, eye in ((upper, front), (lower, beside)):
            for axes, cloud in zip(row[1:], columns.values(), strict=True):
                colours = figures.TRUE if axes is row[1] else figures.PREDICTED
                figures.draw_cloud(axes, cloud[shape], eye, colours=colours)
    for axes, name in zip(panels[0], ("the image", *columns), strict=True):
        axes.set_title(name.replace(", ", "\n"), fontsize=8)
    figures.headline(
        figure,
        "Held-out shapes after stage 1 on single views, 1 training of each. Above: from the image's side; below: after "
        "a quarter turn",
    )
    return figure
