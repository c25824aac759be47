"""A chair with one arm, seen from its side: does a network invent the other arm, and do two views prevent it?

View A does not show whether the arm that it hides is there; view B shows that it is missing. Measured is the share of a
cloud's points in the box where the missing arm would be, relative to that of a real arm.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from diffpoint import PinholeCamera, project
from train.config import FitConfig, changed_settings
from train.data import ShapeTree
from train.data.ambiguity_check import ambiguous_object
from train.data.categories import SYNSET_OF
from train.data.render import orbit_camera
from train.errors import UserError
from train.evaluation.inference import predict_images, reconstruct
from train.evaluation.metrics import cloud_errors
from train.experiments.frame import Experiment, Outcome
from train.experiments.one_armed_chairs import RULES, SEED, Arms, OneArmedChair, make_chair, one_armed_chairs
from train.experiments.paper import without_codes
from train.experiments.statistics import claim, claim_lines, spread_text, spreads, stacked, trainings
from train.experiments.store import Metrics
from train.experiments.study import Change, Study, of_method, unchanged
from train.processes import progress_bar
from train.show import figures
from train.show.tables import markdown_lines

CHAIRS = 20
CODES = 10
_SHOWN = 3
_TRUE_POINTS = 2048
_CHANGES: dict[str, Change] = {"ours": unchanged, "deterministic": without_codes, "psgn": of_method("psgn")}
ROWS = PLAIN, _, PSGN, _, CODED, TWO, TARGET = (
    "deterministic, A",
    "deterministic, A and B",
    "PSGN, A",
    "PSGN, the better of A and B",
    "ours, A, random codes",
    "ours, A and B",
    "the true chair",
)
COLUMNS = {
    "missing": "the missing arm",
    "present": "the arm that is there",
    "both": "the missing arm's place, if the chair has both",
    "none": "and if it has none",
}
DRAWN = 0.5
"""An arm counts as predicted from this share of the points of a real arm."""
_RED = "#d1352b"


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

    @functools.cache
    def drawn() -> list[OneArmedChair]:
        found = itertools.islice(one_armed_chairs(), number)
        return list(progress_bar(found, total=number, title="chairs", unit="chair", progress=study.progress))

    which = ["one-armed", SEED, number, list(RULES)]
    chairs = study.kept(which, lambda: _record(drawn()))
    clouds: list[dict[Arms, dict[str, Tensor]]] = []
    for seed in range(study.seeds):
        found: dict[str, Metrics] = {}
        for name, change in _CHANGES.items():
            config = study.config(change, seed=seed)
            key = [*which, *study.weights_key(config), changed_settings(config.inference), size, CODES]
            found[name] = study.kept(key, lambda config=config: _predict(study, config, drawn(), size))
        clouds.append({arms: _rows(found, chairs, arms) for arms in get_args(Arms)})
    shares = stacked([_shares(rows, chairs) for rows in clouds])
    result = study.about(study.config(unchanged, seed=0)) | _summary(shares, chairs)
    return Outcome(result, markdown(result), {"": _figure(result, size, chairs, clouds[0]["one"], shares)})


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
        found[f"{arms}, target"] = torch.from_numpy(samples).float()
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
            found[f"{arms}, codes"] = predict_images(model, images[:, 0], codes).transpose(0, 1).contiguous()
    return found


def _rows(found: Mapping[str, Metrics], chairs: Metrics, arms: Arms) -> dict[str, Tensor]:
    """Row -> its clouds (M, K, N, 3) of the chairs with these arms."""
    ours, plain, psgn = (found[name][arms] for name in _CHANGES)
    true = chairs[f"{arms}, target"][:, None]
    errors = cloud_errors(psgn, true.expand(-1, 2, -1, -1).contiguous()).cd
    better = psgn[torch.arange(len(psgn)), errors.argmin(1)][:, None]
    joined, joined_plain = (clouds.flatten(1, 2)[:, None] for clouds in (ours, plain))
    coded = found["ours"][f"{arms}, codes"]
    return dict(
        zip(ROWS, (plain[:, :1], joined_plain, psgn[:, :1], better, coded, joined, true), strict=True)
    )


def _shares(rows: Mapping[Arms, Mapping[str, Tensor]], chairs: Metrics) -> Metrics:
    """Row -> (M, K, 4): `presence` for each of `COLUMNS`."""
    found = {}
    for name in ROWS:
        one, both, none = (
            presence(rows[arms][name], chairs["boxes"], chairs["shares"]) for arms in get_args(Arms)
        )
        found[name] = torch.cat([one, both[..., :1], none[..., :1]], -1)
    return found


def _summary(shares: Mapping[str, np.ndarray], chairs: Metrics) -> dict[str, Any]:
    """From (S, M, K, 4) of every row, see `_shares`."""
    means = {
        name: dict(zip(COLUMNS, np.moveaxis(values.mean(2), -1, 0), strict=True))
        for name, values in shares.items()
    }
    two, coded = means[TWO], shares[CODED][..., 0]
    gains = {
        f"missing arm: {TWO} < {PSGN}": means[PSGN]["missing"] - two["missing"],
        f"missing arm: {TWO} < {PLAIN}": means[PLAIN]["missing"] - two["missing"],
        f"{TWO}: more of the arm that is there than of the missing one": two["present"] - two["missing"],
        f"{TWO}: more of the second arm where the chair has one": two["both"] - two["missing"],
    }
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
        "rows": {name: spreads(each) for name, each in means.items()},
        "claims": [claim(words, gain) for words, gain in gains.items()],
    }


def markdown(result: Mapping[str, Any]) -> str:
    """What was measured, in words and tables."""
    codes, changed = result["codes"], result["changed"]
    head = (
        f"{result['chairs']} procedural chairs with one arm, which are in no data tree; profile "
        f"`{result['profile']}`, {trainings(result['seeds'])} of each. View A hides whether there is another arm (that "
        f"would change {changed['A']:.1%} of the chair's pixels, median), view B shows that there is none "
        f"({changed['B']:.1%}). Points in the box of an arm, as a share of those of a real arm: 0 is no arm, 1 a whole "
        "one; mean ± standard deviation over trainings."
    )
    rows = [[name, *(spread_text(row[column]) for column in COLUMNS)] for name, row in result["rows"].items()]
    single = (
        f"Of {codes['number']} random codes for view A, the one with the fewest points of the missing arm predicts "
        f"{codes['least']:.2f} of it, the one with the most {codes['most']:.2f} (means over chairs); "
        f"{codes['draw_it']:.0%} of the codes predict more than half of it."
    )
    last = "A network that predicts no arms predicts no missing ones either; the last two claims exclude that case."
    table = "\n".join(markdown_lines(["", *COLUMNS.values()], rows))
    parts = [
        head,
        table,
        single,
        _weak_networks(result["rows"]),
        last,
        "\n".join(claim_lines(result["claims"])),
    ]
    return "\n\n".join(parts) + "\n"


def _weak_networks(rows: Mapping[str, Any]) -> str:
    """Can these networks predict arms at all?"""
    weak = [name for name, row in rows.items() if row["present"]["mean"] - row["none"]["mean"] < DRAWN]
    if not weak:
        return "All of them predict the arm that is there, so that a missing arm that is not predicted is a result."
    words = "; ".join(
        f"{name} {rows[name]['present']['mean']:.2f} and {rows[name]['none']['mean']:.2f}" for name in weak
    )
    return (
        "Networks that hardly predict arms show little about missing ones. For these, an arm that is there and the "
        f"same place on a chair without arms differ by less than half an arm: {words}."
    )


def _figure(
    result: Mapping[str, Any],
    size: int,
    chairs: Metrics,
    clouds: Mapping[str, Tensor],
    shares: Mapping[str, np.ndarray],
) -> Figure:
    """The first chairs, in pictures of `size` pixels, with the predictions of the first training (row -> (M, K, N, 3)),
    seen from above the missing arm; and the `shares` in its box and in that of the present one."""
    columns = [PLAIN, PSGN, CODED, TWO, TARGET]
    shown = min(_SHOWN, len(chairs["number"]))
    figure, panels = figures.grid(rows=shown, columns=2 + len(columns))
    for number, line in enumerate(panels):
        side = 1 if chairs["side"][number] > 0 else -1
        chair = make_chair((SEED, int(chairs["number"][number])), side)
        assert chair is not None
        for axes, image in zip(line, chair.images(size), strict=False):
            figures.draw_image(axes, torch.from_numpy(image).permute(2, 0, 1).float() / 255)
        eye = orbit_camera(np.array([-20.0 * side]), np.array([35.0]), 128).to(dtype=torch.float32)
        boxes = chairs["boxes"][number].float()
        close = figures.narrowed(eye, torch.cat([chairs["one, target"][number], boxes.flatten(0, 1)]))[0]
        for axes, name in zip(line[2:], columns, strict=True):
            cloud = clouds[name][number, 0]
            figures.draw_cloud(
                axes, cloud, close, colours=figures.TRUE if name == TARGET else figures.PREDICTED
            )
            _mark(axes, cloud, boxes[0], close)
            missing, present = shares[name][0, number, 0, :2]
            figures.caption(axes, f"missing arm {missing:.2f}, present {present:.2f}")
    names = [name.replace("random codes", "one code") for name in columns]
    figures.titles(panels, ["view A", "view B", *names])
    figures.headline(
        figure,
        f"Chairs with one arm, profile {result['profile']}, seed 0; red: where the other arm would be; "
        "points there and at the present arm, as shares of a real arm's",
    )
    return figure


def _mark(axes: Axes, cloud: Tensor, box: Tensor, camera: PinholeCamera) -> None:
    """Outlines a box (2, 3), and circles the points (N, 3) in it."""
    corners = torch.cartesian_prod(*box.T)
    pixels = project(corners[None], camera).pixels[0, 0]
    for start, end in itertools.combinations(range(8), 2):
        if int((corners[start] != corners[end]).sum()) == 1:  # they share an edge
            axes.plot(*pixels[[start, end]].T, color=_RED, lw=0.6, alpha=0.6)
    points = cloud[((cloud > box[0]) & (cloud < box[1])).all(-1)]
    if len(points):
        axes.scatter(*project(points[None], camera).pixels[0, 0].T, s=14, color=_RED, linewidths=0)
