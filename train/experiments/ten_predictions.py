"""Ten predictions for one image: how different they are, how far from the observed depth, and from real shapes."""

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
    compare_clouds,
    concatenate,
    distance_to_nearest,
    one_view_each,
    pairwise_distance,
    sample_predictions,
)
from train.evaluation.runs import load_autoencoder
from train.experiments.store import Metrics
from train.experiments.study import Study
from train.experiments.table import Row
from train.methods import get_method

_PREDICTIONS = 10
_NEAREST_AMONG = 300
# What a critic is trained on, and for how long. With a third or twice of the steps its values are 6 to 15 % lower or
# higher, in the same order.
_TRAINED_ON, _TRAINED_PREDICTIONS = 300, 4
_STEPS, _BATCH, _LEARNING_RATE = 1500, 128, 1e-3

Source = Callable[[LoadedSplit, int], Iterator[tuple[Tensor, Batch, Tensor]]]
"""(split, R) -> batches of shapes: their numbers (B,), the view that is shown, and R predictions for it (R, B, N, 3),
or as many as there are."""


def ten_predictions(row: Row, study: Study, config: FitConfig) -> Metrics:
    """A row's metrics, as chamfer distances x100.

    Returns:
        "diversity" between the predictions for one image, "visible" to its observed depth, "novelty" of one of them to
        the nearest training shape; and for rows with `critic_of` "critic", see `below_real_shapes`. Diversity alone
        does not distinguish other shapes from noise; the others do.
    """
    points, train = get_method(config.system).cloud_size(config), study.split(config, "train")
    some = torch.linspace(0, len(train) - 1, min(_NEAREST_AMONG, len(train))).long()

    def measured(name: str, inputs: list, function: Callable[[Source, LoadedSplit], Metrics]) -> Metrics:
        """Of the predictions of the row's network; or of samples of the ground truth in their place."""
        if row.source == "target":
            test, source = (
                study.split(config, "test"),
                functools.partial(_samples, points=points, seed=config.seed),
            )
            key = [f"{name} of samples", config.seed, points, test.fingerprint, *inputs]
            return study.kept(key, lambda: function(source, test))

        def of_network(model: Predictor, test: LoadedSplit) -> Metrics:
            return function(
                lambda split, count: sample_predictions(model, split, codes=count, seed=config.seed), test
            )

        what = [f"{name} of predictions", _PREDICTIONS, *inputs]
        return study.measure(config, what, of_network, stage=row.stage)

    def distances(source: Source, test: LoadedSplit) -> Metrics:
        real = train.points[some, :points].to(test.device)
        predictions = source(test, _PREDICTIONS)
        return concatenate([_distances(shown, clouds, real=real) for _, shown, clouds in predictions])

    found = measured("distances", [train.fingerprint, len(some)], distances)
    if row.critic_of is None:
        return found
    of_critic, steps = study.config(row.critic_of, seed=config.seed), study.steps or _STEPS
    trained_on = study.split(config, "train", limit=_TRAINED_ON)

    def critic(source: Source, test: LoadedSplit) -> Metrics:
        encode = load_autoencoder(study.train(of_critic)).to(test.device).encode_frozen
        return below_real_shapes(
            source, test, trained_on=trained_on, encode=encode, points=points, seed=config.seed, steps=steps
        )

    inputs = [study.weights_key(of_critic), trained_on.fingerprint, _TRAINED_PREDICTIONS, steps]
    return found | measured("critic", inputs, critic)  # apart: the distances need no critic


def best_of_ten(row: Row, study: Study, config: FitConfig) -> Metrics:
    """Errors of that of ten predictions from one image which is nearest to the ground truth by chamfer distance."""

    def measure(model: Predictor, test: LoadedSplit) -> Metrics:
        parts = []
        for shapes, _, clouds in sample_predictions(model, test, codes=_PREDICTIONS, seed=config.seed):
            true = test.points[shapes].expand(len(clouds), -1, -1, -1)
            found = compare_clouds(clouds, true, points=model.points)
            best = found["cd"].argmin(0)[None]
            parts.append({name: values.gather(0, best)[0] for name, values in found.items()})
        return concatenate(parts)

    return study.measure(config, ["best of predictions", _PREDICTIONS], measure, stage=row.stage)


def _samples(
    split: LoadedSplit, count: int, *, points: int, seed: int
) -> Iterator[tuple[Tensor, Batch, Tensor]]:
    """A `Source`: disjoint samples of the ground truth, as large as a prediction where it has points for two."""
    available = split.points.shape[1]
    size = min(points, available // 2)
    order = torch.randperm(available, generator=torch.Generator().manual_seed(seed))
    samples = order[: size * min(count, available // size)].split(size)
    for shapes, shown in one_view_each(split, seed):
        yield shapes, shown, torch.stack([split.points[shapes][:, sample] for sample in samples])


def _distances(shown: Batch, clouds: Tensor, *, real: Tensor) -> Metrics:
    visible = [visible_error(cloud, shown.camera, shown.depth)[:, 0] for cloud in clouds]
    return {
        "diversity": pairwise_distance(clouds),
        "visible": torch.stack(visible).mean(0),
        "novelty": distance_to_nearest(clouds[0], real),
    }


def below_real_shapes(
    source: Source,
    test: LoadedSplit,
    *,
    trained_on: LoadedSplit,
    encode: Callable[[Tensor], Tensor],
    points: int,
    seed: int,
    steps: int,
) -> Metrics:
    """How much lower a critic rates predictions than real shapes, after training to distinguish just these.

    It is trained from fresh weights for every source, on predictions for training images: the critic of a training has
    learnt to rate the predictions of that training, and its output for others means nothing.

    Args:
        source: of the predictions.
        test: held-out shapes, for which predictions are rated.
        trained_on: training shapes, on which the critic is trained for so many `steps`.
        encode: clouds (B, N, 3) -> codes (B, D), of a frozen network.
        points: of a real cloud, as many as a prediction has.
        seed: draws the samples of real shapes, and the critic's batches.

    Returns:
        "critic": (M,) for each held-out shape, the critic's mean output for samples of it less that for predictions.
    """

    def codes(clouds: Tensor) -> Tensor:
        return encode(clouds.flatten(0, 1).contiguous().to(test.device)).unflatten(0, clouds.shape[:2])

    def real_and_predicted(split: LoadedSplit, count: int) -> tuple[Tensor, Tensor]:
        """Codes (R, M, D) of samples of a split's shapes, and of predictions."""
        # Another seed: where the predictions are samples too, these are others of the same shapes.
        real = [codes(clouds) for _, _, clouds in _samples(split, count, points=points, seed=seed + 1)]
        predicted = [codes(clouds) for _, _, clouds in source(split, count)]
        return torch.cat(real, 1), torch.cat(predicted, 1)

    pairs = real_and_predicted(trained_on, _TRAINED_PREDICTIONS)
    critic = train_critic(*(each.flatten(0, 1) for each in pairs), seed=seed, steps=steps)
    real, predicted = (critic(each).mean(0) for each in real_and_predicted(test, _PREDICTIONS))
    return {"critic": real - predicted}


def train_critic(real: Tensor, fake: Tensor, *, seed: int, steps: int) -> Critic:
    """A critic (WGAN-GP), trained to give codes real (K, D) more than fake (L, D), with a slope of about one; frozen.

    The farther apart the two kinds of codes are, in their unit, the more its mean outputs for further codes differ.

    Example:
        >>> some, others = torch.randn(2, 500, 128, generator=torch.Generator().manual_seed(0))
        >>> critic = train_critic(some[:250] + 0.5, others[:250], seed=0, steps=100)
        >>> bool(critic(some[250:] + 0.5).mean() > critic(others[250:]).mean() + 1)
        True
    """
    random = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        critic = Critic().to(real.device)
    optimiser = torch.optim.Adam(critic.parameters(), lr=_LEARNING_RATE)
    for _ in range(steps):
        batches = [each[torch.randint(len(each), (_BATCH,), generator=random)] for each in (real, fake)]
        penalty = gradient_penalty(critic, *batches, mix=torch.rand(_BATCH, generator=random).to(real.device))
        loss = critic_loss(*map(critic, batches)) + StageConfig.penalty * penalty
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return critic.requires_grad_(False)
