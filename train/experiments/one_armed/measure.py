"""A chair with one arm, seen from its side: does a network invent the other arm, and do two views prevent it?

View A does not show whether the arm that it hides is there; view B shows that it is missing. Measured is the share of a
cloud's points in the box where the missing arm would be, relative to that of a real arm.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from train.config import FitConfig
from train.data import ShapeTree
from train.data.ambiguity_check import ambiguous_object
from train.data.categories import SYNSET_OF
from train.errors import UserError
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors
from train.experiments.frame import Experiment, Outcome
from train.experiments.one_armed.chairs import RULES, SEED, Arms, OneArmedChair, one_armed_chairs
from train.experiments.one_armed.page import CODED, COLUMNS, DRAWN, PLAIN, PSGN, ROWS, TWO, figure, markdown
from train.experiments.paper import without_codes
from train.experiments.statistics import claim, spread, stacked
from train.experiments.store import Metrics
from train.experiments.study import Change, Study, of_method, unchanged
from train.processes import progress_bar

CHAIRS = 20
CODES = 10
_SHOWN = 3
_TRUE_POINTS = 2048
_CHANGES: dict[str, Change] = {"ours": unchanged, "deterministic": without_codes, "psgn": of_method("psgn")}


def configs(study: Study) -> list[FitConfig]:
    """Every training that the measurement needs."""
    return study.configs(*_CHANGES.values())


def make(study: Study) -> Outcome:
    """For each row and each of `COLUMNS` the points in an arm's box, as a share of those of a real arm, mean over the
    chairs, by training; the same of single codes; and the claims. `study.limit` bounds the number of chairs.

    Raises:
        UserError: no chairs to train on, or a tree that was made with these chairs' seed.
    """
    _check(study)
    study.train_all(configs(study))
    size = ShapeTree(study.test_tree, "test")[0].camera.height
    number = min(CHAIRS, study.limit or CHAIRS)
    made: list[OneArmedChair] = []

    def needed() -> list[OneArmedChair]:
        if not made:
            bar = progress_bar(total=number, title="chairs", unit="chair", progress=study.progress)
            for chair in itertools.islice(one_armed_chairs(), number):
                made.append(chair)
                bar.update()
        return made

    which = ["one-armed", SEED, number, list(RULES)]
    chairs = study.kept(which, lambda: _record(needed()))
    clouds: list[dict[str, dict[Arms, Tensor]]] = []
    for seed in range(study.seeds):
        found: dict[str, Metrics] = {}
        for name, change in _CHANGES.items():
            config = study.config(change, seed=seed)
            key = [*which, *study.weights_key(config), dataclasses.asdict(config.inference), size, CODES]
            found[name] = study.kept(key, lambda config=config: _predict(study, config, needed(), size))
        clouds.append(_rows(found, chairs))
    shares = stacked([_shares(rows, chairs) for rows in clouds])
    result = study.about(study.config(unchanged, seed=0)) | _summary(shares, chairs)
    shown = {name: variants["one"][:_SHOWN, 0] for name, variants in clouds[0].items()}
    return Outcome(result, markdown(result), {"": figure(result, size, chairs, shown, shares)})


one_armed = Experiment(make, configs)


def presence(clouds: Tensor, boxes: Tensor, shares: Tensor) -> Tensor:
    """How much of each arm clouds contain: their share of points in its box, over that of a real arm.

    Args:
        clouds: (M, K, N, 3) K clouds of each of M chairs, world frame.
        boxes: (M, 2, 2, 3) of the missing and the present arm: lowest and highest corner.
        shares: (M, 2) of a real arm.

    Returns:
        (M, K, 2) of the missing and the present arm; 0 is no arm, 1 as many points as a real one has.
    """
    low, high = boxes[:, None, :, :, None].to(clouds.dtype).unbind(3)
    inside = ((clouds[:, :, None] > low) & (clouds[:, :, None] < high)).all(-1)
    return inside.double().mean(-1) / shares[:, None]


def _check(study: Study) -> None:
    """Chairs have to be in the training data, and these ones must not."""
    study.need_data()
    trained = [shape for root in study.data for shape in ShapeTree(root, "train").ids]
    if not any(shape.startswith(SYNSET_OF["chair"]) for shape in trained):
        raise UserError(
            f"no chairs to train on in {', '.join(map(str, study.data))}; make some with: python -m train data "
            "procedural --out DIR"
        )
    if any(hider and hider.seed[0] == SEED for hider in map(ambiguous_object, trained)):
        raise UserError(
            f"a tree was made with --seed {SEED}, which this experiment reserves for chairs that no network has seen; "
            "make it with another seed"
        )


def _record(chairs: list[OneArmedChair]) -> Metrics:
    """What is kept of the chairs, each (M, ...), and samples (M, P, 3) of them by their arms."""
    fields = ("boxes", "shares", "changed")
    found = {name: torch.from_numpy(np.stack([getattr(c, name) for c in chairs])).double() for name in fields}
    found["number"] = torch.tensor([chair.seed[1] for chair in chairs])
    found["side"] = torch.tensor([chair.side for chair in chairs])
    for arms in get_args(Arms):
        samples = np.stack([chair.samples(_TRUE_POINTS, arms) for chair in chairs])
        found[f"{arms}, truth"] = torch.from_numpy(samples).float()
    return found


def _predict(study: Study, config: FitConfig, chairs: list[OneArmedChair], size: int) -> Metrics:
    """A network's predictions for each chair by its arms: "ARMS" (M, 2, N, 3) of views A and B, ours with agreed codes.

    Of ours also "ARMS, codes" (M, K, N, 3), from view A with random codes, the same for all three.
    """
    model = study.network(config)
    generator = torch.Generator().manual_seed(config.seed)
    codes = torch.randn(CODES, len(chairs), model.code_dim, generator=generator)
    found: Metrics = {}
    for arms in get_args(Arms):
        pictures = torch.from_numpy(np.stack([chair.images(size, arms) for chair in chairs]))
        images = pictures.permute(0, 1, 4, 2, 3).float() / 255
        points = reconstruct(model, images, seed=config.seed, settings=config.inference).points
        found[arms] = points.unflatten(1, (2, -1)).contiguous()
        if model.takes_codes:
            with torch.no_grad():
                found[f"{arms}, codes"] = model(images[:, 0], codes).transpose(0, 1).contiguous()
    return found


def _rows(found: Mapping[str, Metrics], chairs: Metrics) -> dict[str, dict[Arms, Tensor]]:
    """Row -> its clouds (M, K, N, 3), by the chairs' arms."""
    rows: dict[str, dict[Arms, Tensor]] = {name: {} for name in ROWS}
    for arms in get_args(Arms):
        plain, psgn, ours = (found[name][arms] for name in ("deterministic", "psgn", "ours"))
        true = chairs[f"{arms}, truth"]
        errors = cloud_errors(psgn, true[:, None].expand(-1, 2, -1, -1).contiguous()).cd
        better = psgn[torch.arange(len(psgn)), errors.argmin(1)]
        coded = found["ours"][f"{arms}, codes"]
        joined = [each.flatten(1, 2)[:, None] for each in (plain, ours)]
        of_rows = (plain[:, :1], joined[0], psgn[:, :1], better[:, None], coded, joined[1], true[:, None])
        for name, clouds in zip(ROWS, of_rows, strict=True):
            rows[name][arms] = clouds
    return rows


def _shares(rows: Mapping[str, Mapping[Arms, Tensor]], chairs: Metrics) -> Metrics:
    """Row -> (M, K, 4): `presence` for each of `COLUMNS`."""
    boxes, shares = chairs["boxes"], chairs["shares"]
    found = {}
    for name, clouds in rows.items():
        others = [presence(clouds[arms], boxes, shares)[..., :1] for arms in ("both", "none")]
        found[name] = torch.cat([presence(clouds["one"], boxes, shares), *others], -1)
    return found


def _summary(shares: Mapping[str, np.ndarray], chairs: Metrics) -> dict[str, Any]:
    """From (S, M, K, 4) of every row, see `_shares`."""
    means = {
        name: dict(zip(COLUMNS, np.moveaxis(values.mean(2), -1, 0), strict=True))
        for name, values in shares.items()
    }
    missing = {name: each["missing"] for name, each in means.items()}
    two, coded = means[TWO], shares[CODED][..., 0]
    return {
        "chairs": len(chairs["number"]),
        "seed_of_chairs": SEED,
        "changed": dict(zip("AB", chairs["changed"].median(0).values.tolist(), strict=True)),
        "codes": {
            "number": CODES,
            "least": coded.min(2).mean().item(),
            "most": coded.max(2).mean().item(),
            "draw_it": (coded > DRAWN).mean().item(),
        },
        "rows": {
            name: {column: spread(values.mean(1)) for column, values in each.items()}
            for name, each in means.items()
        },
        "claims": [
            *(
                claim(f"missing arm: {TWO} < {other}", missing[other] - missing[TWO])
                for other in (PSGN, PLAIN)
            ),
            claim(
                f"{TWO}: more of the arm that is there than of the missing one",
                two["present"] - two["missing"],
            ),
            claim(f"{TWO}: more of the second arm where the chair has one", two["both"] - two["missing"]),
        ],
    }
