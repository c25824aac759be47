"""How the methods that the paper compares itself with are trained, as changes to a profile's configuration.

Full sizes follow the methods' own publications, with the images, shapes and batches of the paper; where nothing is
stated, the comment says what is assumed. The cpu profile's lengths let each of them come to rest within about twenty
minutes on one core, with the embedded data.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from train.config import FitConfig, InferenceConfig, StageConfig, System

# What the stages of all of them have in common: one image of each shape, one code, no diversity, no critic.
_PLAIN: dict[str, Any] = {
    "views": 1, "codes": 1, "joined_views": False, "front": "chamfer", "beta": 0.0, "gamma": 0.0, "ramp": (0, 1),
    "diversity_images": 1, "diversity_stride": 1, "warmup": 0,
}  # fmt: skip


def _rates(first: float, final: float | None = None) -> dict[str, float]:
    return {"learning_rate": first, "final_learning_rate": first if final is None else final}


# The paper: 100 000 steps for PSGN, 40 000 with the minimum over 5 codes (their number is assumed), Adam with 1e-4.
# Lin et al.: as published. 3D-R2N2: a tenth of the step size after a third of the steps. PTN: the length is assumed.
_STAGES: dict[str, dict[str, tuple[dict[str, Any], ...]]] = {
    "psgn": {
        "full": ({"steps": 100_000, "shapes": 16, "select": "cd_1"} | _rates(1e-4),),
        "cpu": ({"steps": 5_000, "shapes": 16, "warmup": 200, "select": "cd_1"} | _rates(5e-4, 2e-5),),
        "smoke": ({"steps": 12, "shapes": 3, "select": "cd_1"} | _rates(5e-4),),
    },
    "psgn-mon": {
        "full": ({"steps": 40_000, "shapes": 16, "codes": 5, "front": "emd", "select": "cd_1"} | _rates(1e-4),),
        "cpu": (
            {"steps": 2_500, "shapes": 16, "codes": 5, "front": "emd", "warmup": 200, "select": "cd_1"}
            | _rates(5e-4, 2e-5),
        ),
        "smoke": ({"steps": 12, "shapes": 3, "codes": 2, "front": "emd", "select": "cd_1"} | _rates(5e-4),),
    },
    "lin": {
        "full": (
            {"steps": 500_000, "shapes": 20, "select": "cd"} | _rates(1e-2),
            {"steps": 100_000, "shapes": 20, "select": "cd"} | _rates(1e-5),
        ),
        "cpu": (
            {"steps": 8_000, "shapes": 16, "select": "cd"} | _rates(2e-3, 1e-4),
            # It begins as published. With ten times as much the maps of thin parts are emptied faster than they are
            # mended: on two data sets the validation CD rises above what the first phase had.
            {"steps": 2_000, "shapes": 16, "select": "cd"} | _rates(1e-5, 1e-6),
        ),
        "smoke": (
            {"steps": 12, "shapes": 3, "select": "cd"} | _rates(1e-3),
            {"steps": 6, "shapes": 3, "select": "cd"} | _rates(1e-4),
        ),
    },
    "r2n2": {
        "full": (
            {"steps": 20_000, "shapes": 24, "views": 5, "select": "cd", "weight_decay": 5e-5} | _rates(1e-4),
            {"steps": 40_000, "shapes": 24, "views": 5, "select": "cd", "weight_decay": 5e-5} | _rates(1e-5),
        ),
        "cpu": (
            {"steps": 3_000, "shapes": 4, "views": 3, "warmup": 100, "select": "cd"} | _rates(1e-3),
            {"steps": 1_000, "shapes": 4, "views": 3, "select": "cd"} | _rates(2e-4, 2e-5),
        ),
        "smoke": (
            {"steps": 12, "shapes": 3, "views": 2, "select": "cd"} | _rates(1e-3),
            {"steps": 6, "shapes": 3, "views": 2, "select": "cd"} | _rates(1e-4),
        ),
    },
    "ptn": {
        "full": ({"steps": 100_000, "shapes": 6, "select": "cd", "weight_decay": 1e-3} | _rates(1e-4),),
        "cpu": ({"steps": 4_000, "shapes": 6, "warmup": 100, "select": "cd"} | _rates(5e-4, 5e-5),),
        "smoke": ({"steps": 12, "shapes": 3, "select": "cd"} | _rates(5e-4),),
    },
}  # fmt: skip
# It is at rest earlier at cpu: its validation CD falls by 0.06 in the last 250 of 2000 steps.
_STAGES["front-mon"] = _STAGES["psgn-mon"] | {"cpu": (_STAGES["psgn-mon"]["cpu"][0] | {"steps": 2_000},)}

_NETWORKS_OF_THEIR_OWN = ("lin", "r2n2", "ptn")


def with_system(config: FitConfig, system: System) -> FitConfig:
    """A profile's recipe, for one of the other methods.

    A method with one phase of training has an empty stage 2. Networks of one prediction per view are scored view by
    view; their image has no code to drown it, so nothing is stopped for not looking.
    """
    if system == "ours":
        return config
    stages = _STAGES[system][config.profile]
    stage1 = _stage(config.stage1, stages[0])
    stage2 = _stage(config.stage2, stages[1]) if len(stages) > 1 else dataclasses.replace(stage1, steps=0)
    config = dataclasses.replace(config, system=system, stage1=stage1, stage2=stage2)
    if system in ("psgn-mon", "front-mon"):
        return config
    scored = "joined" if system == "r2n2" else "each"
    return dataclasses.replace(
        config,
        inference=InferenceConfig(groups=1, steps=0, scored=scored),
        min_image_sensitivity=0.0 if system in _NETWORKS_OF_THEIR_OWN else config.min_image_sensitivity,
    )


def _stage(like: StageConfig, changes: dict[str, Any]) -> StageConfig:
    return dataclasses.replace(like, **(_PLAIN | changes))
