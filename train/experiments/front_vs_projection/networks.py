"""Networks trained with each loss: front constraint, projection losses, another visibility; everything else equal."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from diffpoint import PinholeCamera, farthest_point_sample, nearest, visible_points
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
        study.config(lambda config, t=training, s=single: t.config(config, single=s), seed=seed)
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
    answered = sample_predictions(model, test, codes=1, seed=seed)
    return concatenate(
        [single_view_metrics(made[0], test.points[shapes], shown) for shapes, shown, made in answered]
    )


def single_view_metrics(clouds: Tensor, true: Tensor, shown: Batch) -> Metrics:
    """The metrics of `single_views` of clouds (B, N, 3) against the ground true (B, P, 3), of which one view each is
    shown."""
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
        "single": {name: _single(study, training) for name, training in TRAININGS.items()},
        "many": {
            name: _many(study, training)
            for name, training in TRAININGS.items()
            if training.visibility == "zbuffer"
        },
    }


class Examples(NamedTuple):
    """Held-out shapes, and predictions for one image of them after stage 1 with each loss.

    Attributes:
        images: (M, 3, H, W) in [0, 1].
        camera: (M,) theirs.
        true: (M, P, 3).
        clouds: name in `TRAININGS` -> (M, N, 3).
    """

    images: Tensor
    camera: PinholeCamera
    true: Tensor
    clouds: dict[str, Tensor]


def _networks(study: Study) -> list[tuple[FitConfig, Literal[1, 2]]]:
    """Everything that is measured: every training, after each of its stages."""
    both: tuple[Literal[1, 2], ...] = (1, 2)
    return [
        (config, stage) for config in configs(study) for stage in (both if config.stage1.steps else both[1:])
    ]


@torch.no_grad()
def examples(study: Study, *, count: int = 3) -> Examples:
    """Predictions of the first training with each loss; the shapes are spread over the test split."""
    clouds: dict[str, Tensor] = {}
    for name, training in TRAININGS.items():
        config = study.config(lambda c, t=training: t.config(c, single=True), seed=0)
        test = study.split(config, "test")
        shapes = torch.linspace(0, len(test) - 1, min(count, len(test))).long()
        model = study.network(config, stage=1)
        seen = test.batch(shapes, torch.zeros(len(shapes), 1, dtype=torch.long))
        codes = torch.randn(1, len(shapes), model.code_dim, generator=torch.Generator().manual_seed(0))
        clouds[name] = model(seen.images[:, 0], codes)[0]
    camera = PinholeCamera(
        seen.camera.K[:, 0], seen.camera.cam_from_world[:, 0], seen.camera.height, seen.camera.width
    )
    return Examples(seen.images[:, 0], camera, test.points[shapes], clouds)


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


def _single(study: Study, training: Training) -> dict[str, Any]:
    """Training that begins with single views: after stage 1 and after stage 2, curves, and whether it converged."""
    runs = [study.config(lambda c: training.config(c, single=True), seed=seed) for seed in range(study.seeds)]
    return {
        "steps": [runs[0].stage1.steps, runs[0].stage2.steps],
        "stage1": _over_seeds([_measured(study, config, 1) for config in runs]),
        "stage2": _over_seeds([_measured(study, config, 2) for config in runs]),
        "curves": [_curve(study, config, 1) for config in runs],
    }


def _many(study: Study, training: Training) -> dict[str, Any]:
    """Training with all views from the first step."""
    runs = [
        study.config(lambda c: training.config(c, single=False), seed=seed) for seed in range(study.seeds)
    ]
    return {
        "steps": [runs[0].stage2.steps],
        "stage2": _over_seeds([_measured(study, config, 2) for config in runs]),
        "curves": [_curve(study, config, 2) for config in runs],
    }


def _measured(study: Study, config: FitConfig, stage: Literal[1, 2]) -> dict[str, float]:
    """Means over the test shapes: of single views, and of all views joined."""
    alone = study.measure(
        config, "single views", lambda m, d: single_views(m, d, seed=config.seed), stage=stage
    )
    concatenate = study.reconstruction_metrics(config, _RANDOM, stage=stage, views=_VIEWS)
    both = {**alone, "cd": concatenate["cd"], "fps_cd": concatenate["fps_cd"]}
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
