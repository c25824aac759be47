"""A chair with one arm, seen from its side: does a network invent the other one, and what do two views say?

Nothing in view A tells whether the arm that it hides is there; in view B it is seen to be missing. What is measured is
the share of a cloud's points in the box where the missing arm would be, relative to that of a real arm.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from train.config import FitConfig
from train.data import ShapeTree
from train.data.categories import SYNSET_OF
from train.data.rules import hider_of
from train.errors import UserError
from train.evaluation.inference import reconstruct
from train.evaluation.metrics import cloud_errors
from train.evaluation.per_shape import ShapeMetrics, stack_seeds
from train.experiments.one_armed.chairs import RULES, SEED, Arms, OneArmedChair, one_armed_chairs
from train.experiments.one_armed.page import CODED, COLUMNS, DRAWN, PLAIN, PSGN, ROWS, TWO, figure, page
from train.experiments.paper import deterministic, of_system
from train.experiments.table import judged
from train.experiments.workbench import Change, Workbench, as_it_is

CHAIRS = 20
CODES = 10
_SHOWN = 3
_TRUE_POINTS = 2048

_CHANGES: dict[str, Change] = {
    "ours": as_it_is,
    "deterministic": deterministic,
    "psgn": of_system("psgn"),
}


def configs(bench: Workbench) -> list[FitConfig]:
    """Every training that the measurement needs."""
    return [bench.config(change, seed=seed) for seed in range(bench.seeds) for change in _CHANGES.values()]


def one_armed(bench: Workbench) -> dict[str, Any]:
    """Measures how much of an arm that is not there is drawn; writes one-armed.json, .md and .png.

    `limit` bounds the number of chairs.

    Returns:
        What one-armed.json holds: for each row and each of `COLUMNS` the points in an arm's box, as a share of those of
        a real arm, mean over the chairs, by training; what single codes draw; and the claims.

    Raises:
        UserError: no chairs to train on, or a tree that was made with these chairs' seed.
    """
    _check(bench)
    bench.train_all(configs(bench))
    size = ShapeTree(bench.scored_tree, "test")[0].camera.height
    number = min(CHAIRS, bench.limit or CHAIRS)
    chairs: list[OneArmedChair] = []

    def needed() -> list[OneArmedChair]:
        if not chairs:
            bar = tqdm(total=number, desc="chairs", unit="chair", disable=not bench.progress)
            for chair in itertools.islice(one_armed_chairs(), number):
                chairs.append(chair)
                bar.update()
        return chairs

    which = ["one-armed", SEED, number, list(RULES)]
    known = bench.kept(which, lambda: _record(needed()))
    clouds: list[dict[str, dict[Arms, Tensor]]] = []
    for seed in range(bench.seeds):
        made: dict[str, ShapeMetrics] = {}
        for name, change in _CHANGES.items():
            config = bench.config(change, seed=seed)
            key = [*which, bench.run_of(config).name, dataclasses.asdict(config.inference), size, CODES]
            made[name] = bench.kept(key, lambda config=config: _answers(bench, config, needed(), size))
        clouds.append(_rows(made, known))
    drawn = stack_seeds([_drawn(rows, known) for rows in clouds])
    result = bench.about(bench.config(as_it_is, seed=0)) | _summary(drawn, known)
    shown = {name: variants["one"][:_SHOWN, 0] for name, variants in clouds[0].items()}
    bench.publish("one-armed", result, page(result), figure(result, size, known, shown, drawn))
    return result


def presence(clouds: Tensor, boxes: Tensor, shares: Tensor) -> Tensor:
    """How much of each arm clouds draw: their share of points in its box, over that of a real arm.

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


def _check(bench: Workbench) -> None:
    """Chairs have to be in the training data, and these ones must not."""
    bench.need_data()
    trained = [shape for root in bench.data for shape in ShapeTree(root, "train").ids]
    if not any(shape.startswith(SYNSET_OF["chair"]) for shape in trained):
        raise UserError(
            f"no chairs to train on in {', '.join(map(str, bench.data))}; make some with: python -m train data "
            "procedural --out DIR"
        )
    if any(hider and hider.seed[0] == SEED for hider in map(hider_of, trained)):
        raise UserError(
            f"a tree was made with --seed {SEED}, which this experiment keeps for chairs that no network has seen; "
            "make it with another seed"
        )


def _record(chairs: list[OneArmedChair]) -> ShapeMetrics:
    """What is kept of the chairs, each (M, ...), and samples (M, P, 3) of them by their arms."""
    fields = ("boxes", "shares", "changed")
    found = {name: torch.from_numpy(np.stack([getattr(c, name) for c in chairs])).double() for name in fields}
    found["number"] = torch.tensor([chair.seed[1] for chair in chairs])
    found["side"] = torch.tensor([chair.side for chair in chairs])
    for arms in get_args(Arms):
        samples = np.stack([chair.samples(_TRUE_POINTS, arms) for chair in chairs])
        found[f"{arms}, truth"] = torch.from_numpy(samples).float()
    return found


def _answers(bench: Workbench, config: FitConfig, chairs: list[OneArmedChair], size: int) -> ShapeMetrics:
    """What a network makes of each chair by its arms: "ARMS" (M, 2, N, 3) of views A and B, by ours after they agreed.

    Of ours also "ARMS, codes" (M, K, N, 3), from view A with random codes, the same for all three.
    """
    model = bench.network(config)
    generator = torch.Generator().manual_seed(config.seed)
    codes = torch.randn(CODES, len(chairs), model.code_dim, generator=generator)
    found: ShapeMetrics = {}
    for arms in get_args(Arms):
        pictures = torch.from_numpy(np.stack([chair.images(size, arms) for chair in chairs]))
        images = pictures.permute(0, 1, 4, 2, 3).float() / 255
        points = reconstruct(model, images, seed=config.seed, settings=config.inference).points
        found[arms] = points.unflatten(1, (2, -1)).contiguous()
        if model.takes_codes:
            with torch.no_grad():
                found[f"{arms}, codes"] = model(images[:, 0], codes).transpose(0, 1).contiguous()
    return found


def _rows(made: Mapping[str, ShapeMetrics], known: ShapeMetrics) -> dict[str, dict[Arms, Tensor]]:
    """Row -> the clouds (M, K, N, 3) that it is about, by the chairs' arms."""
    rows: dict[str, dict[Arms, Tensor]] = {name: {} for name in ROWS}
    for arms in get_args(Arms):
        plain, psgn, ours = (made[name][arms] for name in ("deterministic", "psgn", "ours"))
        truth = known[f"{arms}, truth"]
        errors = cloud_errors(psgn, truth[:, None].expand(-1, 2, -1, -1).contiguous()).cd
        better = psgn[torch.arange(len(psgn)), errors.argmin(1)]
        coded = made["ours"][f"{arms}, codes"]
        joined = [each.flatten(1, 2)[:, None] for each in (plain, ours)]
        of_rows = (plain[:, :1], joined[0], psgn[:, :1], better[:, None], coded, joined[1], truth[:, None])
        for name, clouds in zip(ROWS, of_rows, strict=True):
            rows[name][arms] = clouds
    return rows


def _drawn(rows: Mapping[str, Mapping[Arms, Tensor]], known: ShapeMetrics) -> ShapeMetrics:
    """Row -> (M, K, 4): `presence` of the figures of `COLUMNS`."""
    boxes, shares = known["boxes"], known["shares"]
    found = {}
    for name, clouds in rows.items():
        others = [presence(clouds[arms], boxes, shares)[..., :1] for arms in ("both", "none")]
        found[name] = torch.cat([presence(clouds["one"], boxes, shares), *others], -1)
    return found


def _summary(drawn: ShapeMetrics, known: ShapeMetrics) -> dict[str, Any]:
    """From (S, M, K, 4) of every row, see `_drawn`."""
    means = {
        name: dict(zip(COLUMNS, values.mean(2).unbind(-1), strict=True)) for name, values in drawn.items()
    }
    missing = {name: each["missing"] for name, each in means.items()}
    two, coded = means[TWO], drawn[CODED][..., 0]
    return {
        "chairs": len(known["number"]),
        "seed_of_chairs": SEED,
        "changed": dict(zip("AB", known["changed"].median(0).values.tolist(), strict=True)),
        "codes": {
            "number": CODES,
            "least": coded.amin(2).mean().item(),
            "most": coded.amax(2).mean().item(),
            "draw_it": (coded > DRAWN).double().mean().item(),
        },
        "rows": {
            name: {column: _spread(values.mean(1)) for column, values in each.items()}
            for name, each in means.items()
        },
        "claims": [
            *(
                judged(f"missing arm: {TWO} < {other}", missing[other] - missing[TWO])
                for other in (PSGN, PLAIN)
            ),
            judged(
                f"{TWO}: more of the arm that is there than of the missing one",
                two["present"] - two["missing"],
            ),
            judged(f"{TWO}: more of the second arm where the chair has one", two["both"] - two["missing"]),
        ],
    }


def _spread(by_seed: Tensor) -> dict[str, Any]:
    sd = by_seed.std().item() if len(by_seed) > 1 else None
    return {"mean": by_seed.mean().item(), "sd": sd, "by_seed": by_seed.tolist()}
