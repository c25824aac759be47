"""Networks trained with each loss: front constraint, projection losses, another visibility; everything else equal."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from diffpoint import farthest_point_sample, nearest, visible_points
from models import Predictor
from train.config import FitConfig, InferenceConfig, StageConfig, Supervision, fit_config_from_json
from train.data.batches import Batch, LoadedSplit
from train.evaluation.metrics import cloud_errors, in_silhouette, visible_error
from train.evaluation.per_shape import concatenate, one_view_each, sample_predictions
from train.evaluation.runs import read_metrics
from train.experiments.statistics import spread
from train.experiments.store import Metrics
from train.experiments.study import Study
from train.methods import get_method
from train.training.trainer import STAGES
from train.training.validation import validate

Verdict = Literal["converged", "in between", "did not converge"]

_STAGE1_SHARE, _STAGE2_SHARE, _MANY_SHARE = 0.25, 0.2, 0.35
"""Of the profile's steps, with half of its shapes in a batch: enough to see what converges, in an hour and a half for
all trainings."""
_VIEWS = 8
_RANDOM = InferenceConfig(groups=1, steps=0)
_PARTS = 32
_CURVES = ("visible", "inside", "cd_1", "cd")


@dataclasses.dataclass(frozen=True)
class Training:
    """A loss to train with.

    Attributes:
        name: of the loss, as tables show it.
        colour: of its curves.
        supervision: see `StageConfig`.
        visibility: see `StageConfig`.
    """

    name: str
    colour: str
    supervision: Supervision
    visibility: Literal["zbuffer", "horizon"] = "zbuffer"

    def config(self, config: FitConfig, *, single: bool) -> FitConfig:
        """A profile's recipe under this loss.

        The check for collapse is off: here a collapse is a result.

        Args:
            config: the profile's.
            single: True: stage 1 on single views, then stage 2 on joined ones. False: stage 2 alone, from fresh weights
                and longer.
        """

        def stage(like: StageConfig, share: float) -> StageConfig:
            like = like.lasting(max(1, round(share * like.steps)))
            return dataclasses.replace(
                like,
                shapes=max(1, like.shapes // 2),
                supervision=self.supervision,
                visibility=self.visibility,
            )

        changes: dict[str, Any] = {
            "stage1": stage(config.stage1, _STAGE1_SHARE),
            "stage2": stage(config.stage2, _STAGE2_SHARE),
        }
        if not single:
            changes = {
                "stage1": dataclasses.replace(config.stage1, steps=0),
                "stage2": stage(config.stage2, _MANY_SHARE),
            }
        every = max(1, changes["stage2"].steps // 4)
        return dataclasses.replace(
            config, **changes, min_image_sensitivity=0.0, validate_every=every, collapse_check_every=every,
            validation_shapes=min(16, config.validation_shapes),
        )  # fmt: skip


TRAININGS: dict[str, Training] = {
    "front": Training("front constraint", "#22577a", "front"),
    "horizon": Training("front constraint, hidden points dropped", "#57a0c9", "front", "horizon"),
    "projection": Training("projection loss, depth alone", "#c8553d", "projection"),
    "lin": Training("projection loss of Lin et al.", "#e59866", "lin"),
    "soft": Training("soft projection loss", "#6a994e", "soft"),
}


def configs(study: Study) -> list[FitConfig]:
    """All trainings of the study, seed by seed."""
    return [
        study.config(functools.partial(training.config, single=single), seed=seed)
        for seed in range(study.seeds)
        for single in (True, False)
        for training in TRAININGS.values()
        if single or training.visibility == "zbuffer"
    ]


def single_views(model: Predictor, test: LoadedSplit, *, seed: int) -> Metrics:
    """Metrics (M,) of each shape's prediction from its first view in a seed's order, with one random code.

    "cd_1", "pred_to_gt", "gt_to_pred" x100 against the whole shape; "visible" and "inside" as in validation;
    "front_density": which share of the points lies where the view sees the surface, over the share of the true surface
    that it sees (1: as dense as behind); "imbalance": which share of the points would have to move to another of 32
    parts of the surface for all parts to be as dense (0 to 1).
    """
    predicted = sample_predictions(model, test, codes=1, seed=seed)
    return concatenate(
        [single_view_metrics(made[0], test.points[shapes], shown) for shapes, shown, made in predicted]
    )


def single_view_metrics(clouds: Tensor, true: Tensor, shown: Batch) -> Metrics:
    """`single_views` of clouds (B, N, 3) with the ground truth (B, P, 3) and the one view of each that is shown."""
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
    """How evenly clouds (B, N, 3) lie on surfaces; see `single_views`.

    Args:
        clouds: (B, N, 3).
        true: (B, P, 3) evenly spread over the surface.
        seen: (B, P) bool: the points that the view sees.
    """
    at = nearest(clouds, true).index
    true_share, share = seen.float().mean(1), seen.gather(1, at).float().mean(1)
    centres = torch.take_along_dim(true, farthest_point_sample(true, _PARTS)[..., None], 1)
    part = nearest(true, centres).index
    true_parts, parts = _histogram(part), _histogram(part.gather(1, at))
    return {
        "front_density": share / true_share.clamp(min=1e-6),
        "imbalance": (parts - true_parts).abs().sum(1) / 2,
    }


def _histogram(part: Tensor) -> Tensor:
    """(B, N) numbers of parts -> (B, _PARTS) shares."""
    return torch.nn.functional.one_hot(part, _PARTS).float().mean(1)


def summarise(study: Study) -> dict[str, Any]:
    """Trains and measures what is missing; the result is for JSON.

    Returns:
        "single" and "many": for each of `TRAININGS` means and spreads over trainings after each stage, and the curves
        of validation with a verdict for each training.
    """
    study.train_all(configs(study))
    study.measure_all(_measured, _networks(study))
    return {
        "shapes": len(study.reconstruction_metrics(configs(study)[0], _RANDOM, views=_VIEWS)["cd"]),
        "seeds": study.seeds,
        "profile": study.profile,
        "floor": _floor(study),
        "single": {name: _summary(study, each, single=True) for name, each in TRAININGS.items()},
        "many": {
            name: _summary(study, each, single=False)
            for name, each in TRAININGS.items()
            if each.visibility == "zbuffer"
        },
    }


def _networks(study: Study) -> list[tuple[FitConfig, Literal[1, 2]]]:
    """Everything that is measured: every training, after each of its stages."""
    both: tuple[Literal[1, 2], ...] = (1, 2)
    return [
        (config, stage) for config in configs(study) for stage in (both if config.stage1.steps else both[1:])
    ]


@torch.no_grad()
def examples(study: Study, *, count: int = 3) -> tuple[Batch, Tensor, dict[str, Tensor]]:
    """Predictions after stage 1 of the first training with each loss.

    Returns:
        Shapes (M, with one view) spread over the test split, their ground truth (M, P, 3), and for each of `TRAININGS`
        clouds (M, N, 3).
    """
    trained = {
        name: study.config(functools.partial(each.config, single=True), seed=0)
        for name, each in TRAININGS.items()
    }
    test = study.split(trained["front"], "test")
    shapes = torch.linspace(0, len(test) - 1, min(count, len(test))).long()
    seen = test.batch(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))
    clouds = {}
    for name, config in trained.items():
        model = study.network(config, stage=1)
        codes = torch.randn(1, len(shapes), model.code_dim, generator=torch.Generator().manual_seed(0))
        clouds[name] = model(seen.images[:, 0], codes)[0]
    return seen, test.points[shapes], clouds


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


def _summary(study: Study, training: Training, *, single: bool) -> dict[str, Any]:
    """Steps of the stages that are trained, metrics after each, and the curves of the first with a verdict."""
    runs = study.configs(lambda config: training.config(config, single=single))
    stages: tuple[Literal[1, 2], ...] = (1, 2) if single else (2,)
    after = {
        f"stage{stage}": _over_seeds([_measured(study, config, stage) for config in runs]) for stage in stages
    }
    steps = [runs[0].stages[stage - 1].steps for stage in stages]
    return {"steps": steps, **after, "curves": [_curve(study, config, stages[0]) for config in runs]}


def _measured(study: Study, config: FitConfig, stage: Literal[1, 2]) -> dict[str, float]:
    """Means over the test shapes: of single views, and of all views joined."""
    alone = study.measure(
        config, "single views", lambda m, d: single_views(m, d, seed=config.seed), stage=stage
    )
    joined = study.reconstruction_metrics(config, _RANDOM, stage=stage, views=_VIEWS)
    both = {**alone, "cd": joined["cd"], "fps_cd": joined["fps_cd"]}
    return {name: values.mean().item() for name, values in both.items()}


def _over_seeds(by_seed: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    return {name: spread([found[name] for found in by_seed]) for name in by_seed[0]}


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
    steps = [0, *(record["step"] - before for record in records)]
    curve = {
        name: [fresh[f"val_{name}"].item(), *(record[f"val_{name}"] for record in records)]
        for name in _CURVES
    }
    left, inside = curve["visible"][-1] / curve["visible"][0], curve["inside"][-1]
    return {"step": steps, **curve, "left": left, "verdict": verdict(left, inside)}


def verdict(left: float, inside: float) -> Verdict:
    """Did a training converge?

    Args:
        left: its last validation's error of the visible part, as a share of the fresh network's.
        inside: share of its points in the silhouette then.
    """
    if left >= 0.8 or inside < 0.5:
        return "did not converge"
    return "converged" if left < 0.3 else "in between"
