"""Trainings and measurements that experiments share: each is made once, and found again by all that it depends on.

    OUT/runs/KEY-seed0/    a run of `fit`; KEY is the digest of its whole configuration, the data's fingerprint and
                           `TRAINING_VERSION`. `trained.json` marks a finished one. Stage 1 and stage 2 are runs of
                           their own, so that trainings share a stage 1
    OUT/metrics...         per-shape metrics, see store.py

An experiment that was stopped continues when it is called again: `fit` resumes, finished measurements are read.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from models import Predictor
from train.config import (
    FitConfig,
    InferenceConfig,
    Profile,
    Recipe,
    changed_settings,
    fit_config_from_json,
    with_steps,
)
from train.data.batches import LoadedSplit
from train.device import CPU, prepare
from train.errors import UserError
from train.evaluation.per_shape import SHAPES_AT_ONCE, compare_clouds, concatenate, evaluate_split, on_cpu
from train.evaluation.retrieval import medoid, nearest_by_image
from train.evaluation.runs import best_weights, load_predictor, open_run, read_split
from train.experiments import store
from train.experiments.store import Metrics, NotMeasured
from train.files import write_text
from train.methods import get_method
from train.methods import recipe as recipe_of
from train.methods.weights import weights_digest
from train.processes import run_in_processes
from train.training import TRAINING_VERSION
from train.training.trainer import fit

Split = Literal["train", "val", "test"]
Change = Callable[[FitConfig], FitConfig]
"""How the configuration of a variant differs from that of its profile."""

# Fields that do not change the weights. The seed has a place of its own in the name of a run.
_NOT_OF_THE_WEIGHTS = (
    "inference", "seed", "log_every", "picture_every", "checkpoint_every", "keep_checkpoints",
)  # fmt: skip
# The error of a method on its training shapes is measured on so many of them.
_SOME_TRAINING_SHAPES = 100


class Network(NamedTuple):
    """A network to measure with one draw of codes."""

    key: list[Any]
    """The part of a measurement's key that names its weights and the draw."""
    load: Callable[[], Predictor]
    config: FitConfig
    seed: int
    """Of the codes."""


@dataclasses.dataclass(frozen=True)
class Study:
    """Data, a profile and seeds; and a directory for what is trained and measured with them."""

    data: tuple[Path, ...]
    """Roots of data trees, put together for training; the test split of the first is used for measurements."""
    out: Path
    """Directory for runs, metrics and results."""
    profile: Profile = "cpu"
    """Size of the networks, and length of their training."""
    seeds: int = 3
    """Number of trainings of each variant, with seeds 0, 1, ..."""
    limit: int | None = None
    """Measure at most that many test shapes."""
    steps: int | None = None
    """If given, the same number of steps for every phase, for a quick look."""
    progress: bool = True
    """Show progress bars."""
    processes: int = 1
    """How many trainings or measurements run at the same time, each in a process with one thread."""
    category: str = "chair"
    """For single-category, the category that it is about."""
    pictures: Path | None = None
    """For photos, a folder with a folder of photographs for each object."""
    run: Path | None = None
    """For agreement, coverage and photos, a trained run as `open_run` takes it; networks are trained here if not
    given."""
    views: int = 8
    """For agreement, views per shape."""
    recipe: Recipe = "paper"
    """How our method is trained; other methods have one recipe each."""
    device: torch.device = CPU
    """Where networks are trained and measured. Splits that are not only measured, and all metrics, are on the CPU."""
    measures: bool = True
    """False: `NotMeasured` is raised instead of measuring anything."""
    _splits: dict[tuple, LoadedSplit] = dataclasses.field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, least in (("seeds", 1), ("limit", 2), ("processes", 1)):  # 2 shapes, for a spread over them
            value = getattr(self, name)
            if value is not None and value < least:
                raise UserError(f"--{name} must be at least {least}; got {value}")

    # Configurations and data

    def config(self, change: Change, *, seed: int) -> FitConfig:
        """The profile's configuration with the changes of a variant."""
        config = dataclasses.replace(
            change(recipe_of("ours", self.profile, self.recipe)), seed=seed, picture_every=0
        )
        return config if self.steps is None else with_steps(config, self.steps)

    def configs(self, *changes: Change) -> list[FitConfig]:
        """The configurations of variants with every seed, seed by seed."""
        return [self.config(change, seed=seed) for seed in range(self.seeds) for change in changes]

    def on_trees(self) -> Study:
        """The same with only those of its data that are data trees, on which networks can be trained."""
        trees = tuple(root for root in self.data if (root / "data_list").is_dir())
        return dataclasses.replace(self, data=trees)

    def need_data(self) -> None:
        """Raises a UserError if there are no data."""
        if not self.data:
            raise UserError("no data; name one or more data trees with --data")

    @property
    def test_tree(self) -> Path:
        """The first data tree, whose test shapes are measured."""
        self.need_data()
        return self.data[0]

    def fingerprints(self) -> list[str]:
        """Of each data tree: changes when its lists, or what it was made with, change."""
        self.need_data()
        return [_tree_fingerprint(root) for root in self.data]

    def split(self, config: FitConfig, split: Split, *, limit: int | None = None) -> LoadedSplit:
        """A split of the first tree as a configuration's network reads it; read once. Without a limit, all training
        shapes, or `self.limit` of the others."""
        size = get_method(config.system).image_size(config)
        limit = limit or (self.limit if split != "train" else None)
        key = (self.test_tree, limit, split, *size, config.map_size, config.gt_pool, config.categories)
        if key not in self._splits:
            self._splits[key] = read_split(
                config, self.test_tree, split, image_size=size, limit=limit, progress=self.progress
            )
        return self._splits[key]

    def on_device(self, split: LoadedSplit) -> LoadedSplit:
        """One of this study's splits on its device, moved there once."""
        if self.device == CPU:
            return split
        (key,) = (("moved", *key) for key, found in self._splits.items() if found is split)
        if key not in self._splits:
            self._splits[key] = split.to(self.device)
        return self._splits[key]

    # Trainings

    def run_key(self, config: FitConfig) -> dict[str, Any]:
        """All that decides the weights of a training, but for the seed."""
        fields = {k: v for k, v in changed_settings(config).items() if k not in _NOT_OF_THE_WEIGHTS}
        return {"config": fields, "data": self.fingerprints(), "training_version": TRAINING_VERSION}

    def run_of(self, config: FitConfig) -> Path:
        """The directory of a configuration's run."""
        return self.out / "runs" / f"{store.digest(self.run_key(config))}-seed{config.seed}"

    def is_trained(self, config: FitConfig) -> bool:
        """Is a configuration's training finished?"""
        return (self.run_of(parts_of(config)[-1]) / "trained.json").exists()

    def train(self, config: FitConfig, *, stage: Literal[1, 2] = 2) -> Path:
        """The run that holds a stage of a configuration's training: trained now, continued, or there already.

        Raises:
            KeyboardInterrupt: a signal ended the training early; it has saved a checkpoint.
        """
        parts = parts_of(config)
        run = self._train_part(parts[0], None)
        if stage == 2 and len(parts) > 1:
            run = self._train_part(parts[1], best_weights(run, 1))
        return run

    def _train_part(self, config: FitConfig, start: Path | None) -> Path:
        """Trains one of `parts_of`; from the weights of the part before it, if it is not the first."""
        run = self.run_of(config)
        if self.is_trained(config):
            return run
        if start is not None:
            config = dataclasses.replace(after_stage1(config), start=str(start))
        saved = run / "config.json"
        begun = saved.exists()
        if begun:
            config = fit_config_from_json(saved.read_text(), where=str(saved))
        begin = time.process_time()  # wall-clock time would include what else the machine does
        if not fit(self.data, run, config, resume=begun, progress=self.progress, device=self.device):
            raise KeyboardInterrupt
        seconds = round(time.process_time() - begin)
        write_text(run / "trained.json", json.dumps({"seconds": seconds, "continued": begun}) + "\n")
        return run

    def train_all(self, configs: Sequence[FitConfig]) -> None:
        """Trains what is not trained yet, `processes` at once; the weights do not depend on how many.

        If one cannot be trained, those that run at the same time are finished; see `train` for interruptions.
        """
        for number in (0, 1):  # first the runs from fresh weights, then those that start from them
            parts = [part for config in configs for part in parts_of(config)[number : number + 1]]
            missing = {self.run_of(part): part for part in parts if not self.is_trained(part)}.values()
            self.side_by_side(Study.train, [(part,) for part in missing], title="trainings")
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                for part in missing:
                    self.train(part)
            finally:
                torch.set_num_threads(threads)

    def network(self, config: FitConfig, *, stage: Literal[0, 1, 2] = 2) -> Predictor:
        """A configuration's network with the best weights of a stage, trained if need be.

        Stage 0 is the network before training; of a method without the stage, the last stage is taken.
        """
        if stage == 0:
            torch.manual_seed(config.seed)
            return get_method(config.system).build(config).to(self.device)
        run = self.train(config, stage=stage)
        weights = best_weights(run, stage) if f"stage{stage}" in config.phases else run
        return load_predictor(weights, device=self.device)

    def networks(self, change: Change) -> list[Network]:
        """The trainings of a variant with every seed; or the network of `run`, for as many draws of codes."""
        if self.run is None:
            return [
                Network(self.weights_key(c), functools.partial(self.network, c), c, c.seed)
                for c in self.configs(change)
            ]
        opened = open_run(self.run, device=self.device)
        key = ["run", weights_digest(opened.model)]
        return [
            Network([*key, seed], lambda: opened.model, opened.config, seed) for seed in range(self.seeds)
        ]

    # Measurements

    def weights_key(self, config: FitConfig) -> list[Any]:
        """The part of a measurement's key that names a configuration's weights."""
        return [self.run_key(config), config.seed]

    def kept(self, key: Sequence[object], measure: Callable[[], Metrics]) -> Metrics:
        """The metrics under a key of plain JSON values, measured now if they are not kept; see `store.kept`."""
        return store.kept(self.out, key, (lambda: on_cpu(measure())) if self.measures else None)

    def measure(
        self,
        config: FitConfig,
        what: object,
        function: Callable[[Predictor, LoadedSplit], Metrics],
        *,
        stage: Literal[0, 1, 2] = 2,
        split: Split = "test",
    ) -> Metrics:
        """What a function finds of a configuration's network on a split, trained and measured if need be.

        Args:
            config: whose network.
            what: everything else that decides the outcome, as plain JSON values.
            function: makes the measurement, of a network and a split on the study's device.
            stage: see `network`.
            split: of the first tree; of the training shapes a hundred, evenly spread.
        """
        data = self.split(config, split, limit=_SOME_TRAINING_SHAPES if split == "train" else None)
        run = self.weights_key(stage1_of(config) if stage == 1 else config)
        key = [*run, stage, what, split, data.fingerprint]
        return self.kept(key, lambda: function(self.network(config, stage=stage), self.on_device(data)))

    def reconstruction_metrics(
        self,
        config: FitConfig,
        settings: InferenceConfig,
        *,
        stage: Literal[1, 2] = 2,
        views: int,
        split: Split = "test",
        code_seed: int | None = None,
    ) -> Metrics:
        """Errors (M,) of what a configuration's network reconstructs from several views of each shape.

        The configuration's seed draws the views, and the codes if there is no `code_seed`.
        """

        def evaluate(model: Predictor, data: LoadedSplit) -> Metrics:
            return evaluate_split(model, data, settings, views=views, seed=config.seed, code_seed=code_seed)

        what = [changed_settings(settings), views, *([] if code_seed is None else [code_seed])]
        return self.measure(config, what, evaluate, stage=stage, split=split)

    def retrieval_metrics(
        self, baseline: Literal["medoid", "nearest image"], config: FitConfig, *, views: int
    ) -> Metrics:
        """Errors (M,) of the medoid of the training shapes, or for each test shape of the training shape with the
        nearest image; with a configuration's sizes of images and clouds."""
        test, train = self.split(config, "test"), self.split(config, "train")
        points = get_method(config.system).cloud_size(config)

        def measure() -> Metrics:
            if baseline == "medoid":
                clouds = train.points[medoid(train.points)].expand_as(test.points)
            else:
                clouds = train.points[nearest_by_image(test, train, views=(views,))[views]]
            parts = zip(clouds.split(SHAPES_AT_ONCE), test.points.split(SHAPES_AT_ONCE), strict=True)
            return concatenate(
                [compare_clouds(each.contiguous(), true, points=points) for each, true in parts]
            )

        size = get_method(config.system).image_size(config)
        return self.kept([baseline, points, size, views, train.fingerprint, test.fingerprint], measure)

    def first_missing(self, function: Callable[[Study], object]) -> str | None:
        """KEY of the first metrics that a function would have to measure; None if all are kept."""
        try:
            function(dataclasses.replace(self, measures=False))
        except NotMeasured as key:
            return str(key)
        return None

    def measure_all(self, function: Callable[..., object], arguments: Sequence[tuple[Any, ...]]) -> None:
        """Calls `function(study, *each)` for those arguments whose metrics are not kept; see `side_by_side`.

        The networks that they need must be trained. After a signal (KeyboardInterrupt), finished measurements are kept.
        """
        if self.processes == 1:  # nothing is saved by looking for what is missing
            return
        missing = {
            self.first_missing(lambda study, given=given: function(study, *given)): given
            for given in arguments
        }
        missing.pop(None, None)
        self.side_by_side(function, list(missing.values()), title="measurements")

    def side_by_side(self, function: Callable[..., object], calls: Sequence[tuple], *, title: str) -> None:
        """Calls `function(study, *each)`, `processes` at once; results are dropped, what is kept on disk stays.

        With one process, or for a single call, it does nothing: the caller makes the call then.

        Args:
            function: importable by name; called with a quiet study of one process.
            calls: the further arguments of each call, which can be pickled.
            title: of the progress bar.
        """
        if min(self.processes, len(calls)) < 2:
            return
        alone = dataclasses.replace(self, progress=False, processes=1, _splits={})
        call, given = functools.partial(_call, function), [(alone, *each) for each in calls]
        run_in_processes(call, given, processes=self.processes, title=title, progress=self.progress)

    def about(self, config: FitConfig) -> dict[str, Any]:
        """What every result states of its making: profile, data, seeds, and the networks' configuration."""
        return {
            "profile": self.profile,
            "recipe": self.recipe,
            "data": [str(root) for root in self.data],
            "seeds": self.seeds,
            "config": dataclasses.asdict(config),
        }


def file_stem(experiment: str, recipe: Recipe) -> str:
    """Name of the files with an experiment's results; those of another recipe than the paper's begin with its name."""
    return experiment if recipe == "paper" else f"{recipe}-{experiment}"


def unchanged(config: FitConfig) -> FitConfig:
    """Our own method as the profile has it."""
    return config


def of_method(name: Any) -> Change:
    """The profile's recipe for another method."""
    return functools.partial(_recipe_like, name=name)


def _recipe_like(config: FitConfig, name: str) -> FitConfig:
    return recipe_of(name, config.profile)


def after_stage1(config: FitConfig) -> FitConfig:
    """A configuration without stage 1, of which only the weights that it starts from are left."""
    return dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, steps=0))


def stage1_of(config: FitConfig) -> FitConfig:
    """A configuration's training up to the end of stage 1; all of it if it cannot be split, see `parts_of`."""
    if config.needs_autoencoder or not config.stage1.steps:
        return config
    # The same for every training with this stage 1, whatever follows.
    nothing = dataclasses.replace(config.stage1, steps=0)
    return dataclasses.replace(config, stage2=nothing, variant="standard")


def parts_of(config: FitConfig) -> tuple[FitConfig, ...]:
    """The runs that a training consists of: stage 1, and the whole, of which the second run trains the rest.

    A critic learns through both stages: such a training is one run, and so is one with a single stage.
    """
    first = stage1_of(config)
    return (first,) if first == config or not config.stage2.steps else (first, config)


def _call(function: Callable[..., object], study: Study, *given: Any) -> None:
    prepare(study.device)
    function(study, *given)  # the result is on disk, and need not be sent back


def _tree_fingerprint(root: Path) -> str:
    """Changes when a tree's lists, or what it was made with, change; only these files are read."""
    files = sorted(root.glob("data_list/*/*.list")) + sorted(root.glob("made_with.json"))
    if not files:
        raise UserError(f"no data at {root}; make some with: python -m train data procedural --out {root}")
    return store.digest([f"{path.relative_to(root)}\n{path.read_text()}" for path in files])
