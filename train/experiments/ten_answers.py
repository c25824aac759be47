"""Ten answers to one image: how far they are apart and from what it shows, and whether they pass for real shapes."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from models import Critic, Predictor, critic_loss, gradient_penalty
from train.config import FitConfig, StageConfig
from train.data.batches import Batch, LoadedSplit
from train.evaluation.metrics import visible_error
from train.evaluation.per_shape import (
    ShapeMetrics,
    concatenate,
    distance_to_nearest,
    one_view_each,
    pairwise_distance,
    sample_predictions,
)
from train.evaluation.runs import load_autoencoder
from train.experiments.table import Row
from train.experiments.workbench import Workbench
from train.methods.systems import cloud_size

_ANSWERS = 10
_NEAREST_AMONG = 300
# What a critic learns from, and for how long. With a third or twice of the steps its opinions are 6 to 15 % lower or
# higher, in the same order.
_TAUGHT_ON, _TAUGHT_ANSWERS = 300, 4
_STEPS, _AT_ONCE, _RATE = 1500, 128, 1e-3

Source = Callable[[LoadedSplit, int], Iterator[tuple[Tensor, Batch, Tensor]]]
"""(split, R) -> some shapes at a time: their numbers (B,), the view that is shown, and R answers to it (R, B, N, 3), or
as many as there are."""


def ten_answers(row: Row, bench: Workbench, config: FitConfig) -> ShapeMetrics:
    """A row's figures, as chamfer distances x100: "diversity" between the answers to one image, "visible" from what it
    shows, "novelty" of one of them from the nearest training shape. All but the first tell other shapes from noise, and
    so does "critic" for rows with a judge, see `below_real_shapes`."""
    points, train = cloud_size(config), bench.split(config, "train")
    some = torch.linspace(0, len(train) - 1, min(_NEAREST_AMONG, len(train))).long()

    def spread(given: Source, test: LoadedSplit) -> ShapeMetrics:
        real = train.points[some, :points]
        return concatenate([_spread(shown, clouds, real=real) for _, shown, clouds in given(test, _ANSWERS)])

    found = _taken(row, bench, config, "spread", [train.fingerprint, len(some)], spread)
    if row.judge is None:
        return found
    judge, steps = bench.config(row.judge, seed=config.seed), bench.steps or _STEPS
    taught = bench.split(config, "train", limit=_TAUGHT_ON)

    def critic(given: Source, test: LoadedSplit) -> ShapeMetrics:
        encode = load_autoencoder(bench.train(judge)).encode_frozen
        return below_real_shapes(
            given, test, taught=taught, encode=encode, points=points, seed=config.seed, steps=steps
        )

    learnt = [bench.run_of(judge).name, taught.fingerprint, _TAUGHT_ANSWERS, steps]
    return found | _taken(row, bench, config, "critic", learnt, critic)  # apart: the distances need no critic


def _taken(
    row: Row,
    bench: Workbench,
    config: FitConfig,
    name: str,
    beside: list,
    measure: Callable[[Source, LoadedSplit], ShapeMetrics],
) -> ShapeMetrics:
    """A measurement of what a row's network answers; or of true shapes in place of answers: what it says of samples of
    one surface, and of shapes that are real."""
    if row.answer == "truth":
        test, points = bench.split(config, "test"), cloud_size(config)
        source = functools.partial(_samples, points=points, seed=config.seed)
        key = [f"{name} of samples", config.seed, points, test.fingerprint, *beside]
        return bench.kept(key, lambda: measure(source, test))

    def of_network(model: Predictor, test: LoadedSplit) -> ShapeMetrics:
        return measure(
            lambda split, count: sample_predictions(model, split, codes=count, seed=config.seed), test
        )

    return bench.measured(config, [f"{name} of answers", _ANSWERS, *beside], of_network, stage=row.stage)


def _samples(
    split: LoadedSplit, count: int, *, points: int, seed: int
) -> Iterator[tuple[Tensor, Batch, Tensor]]:
    """A `Source`: disjoint samples of true shapes, as large as a prediction where the data have points for two."""
    available = split.points.shape[1]
    size = min(points, available // 2)
    order = torch.randperm(available, generator=torch.Generator().manual_seed(seed))
    samples = order[: size * min(count, available // size)].split(size)
    for shapes, shown in one_view_each(split, seed):
        yield shapes, shown, torch.stack([split.points[shapes][:, sample] for sample in samples])


def _spread(shown: Batch, clouds: Tensor, *, real: Tensor) -> ShapeMetrics:
    visible = [visible_error(cloud, shown.camera, shown.depth)[:, 0] for cloud in clouds]
    figures = {
        "diversity": pairwise_distance(clouds),
        "visible": torch.stack(visible).mean(0),
        "novelty": distance_to_nearest(clouds[0], real),
    }
    return {name: values.double() for name, values in figures.items()}


def below_real_shapes(
    given: Source,
    test: LoadedSplit,
    *,
    taught: LoadedSplit,
    encode: Callable[[Tensor], Tensor],
    points: int,
    seed: int,
    steps: int,
) -> ShapeMetrics:
    """How far a critic puts answers below real shapes, after it has learnt to tell just these from real ones.

    It is trained afresh for every source, on its answers to training images: the critic of a training knows the
    predictions that it met there, and what it thinks of others says nothing.

    Args:
        given: whose answers.
        test: held-out shapes, which are judged.
        taught: training shapes, from which the critic learns.
        encode: clouds (B, N, 3) -> codes (B, D), of a frozen network.
        points: of a real cloud, as many as an answer has.
        seed: draws the samples of real shapes, and what the critic learns from.
        steps: for which it learns.

    Returns:
        "critic": (M,) for each held-out shape, the critic's mean score of samples of it less that of the answers.
    """

    def codes(clouds: Tensor) -> Tensor:
        return encode(clouds.flatten(0, 1).contiguous()).unflatten(0, clouds.shape[:2])

    def of_both(split: LoadedSplit, count: int) -> tuple[Tensor, Tensor]:
        """Codes (R, M, D) of samples of a split's shapes, and of answers."""
        # Another seed: where the answers are samples too, these are others of the same shapes.
        real = [codes(clouds) for _, _, clouds in _samples(split, count, points=points, seed=seed + 1)]
        fake = [codes(clouds) for _, _, clouds in given(split, count)]
        return torch.cat(real, 1), torch.cat(fake, 1)

    lessons, questions = of_both(taught, _TAUGHT_ANSWERS), of_both(test, _ANSWERS)
    critic = trained_critic(*(each.flatten(0, 1) for each in lessons), seed=seed, steps=steps)
    real, fake = (critic(each).mean(0) for each in questions)
    return {"critic": (real - fake).double()}


def trained_critic(real: Tensor, fake: Tensor, *, seed: int, steps: int) -> Critic:
    """A critic (WGAN-GP) that gives codes real (K, D) more than fake (L, D), with a slope of about one between them.

    Its mean scores of codes that it has not met differ by more, the farther apart the two kinds are, in their unit. It
    comes back frozen.

    Example:
        >>> some, others = torch.randn(2, 500, 128, generator=torch.Generator().manual_seed(0))
        >>> critic = trained_critic(some[:250] + 0.5, others[:250], seed=0, steps=100)
        >>> bool(critic(some[250:] + 0.5).mean() > critic(others[250:]).mean() + 1)
        True
    """
    random = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        critic = Critic()
    optimiser = torch.optim.Adam(critic.parameters(), lr=_RATE)
    for _ in range(steps):
        some = [each[torch.randint(len(each), (_AT_ONCE,), generator=random)] for each in (real, fake)]
        penalty = gradient_penalty(critic, *some, mix=torch.rand(_AT_ONCE, generator=random))
        loss = critic_loss(*map(critic, some)) + StageConfig.penalty * penalty
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return critic.requires_grad_(False)
