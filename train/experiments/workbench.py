"""What experiments share: runs that are trained once and scores that are taken once, whoever asks for them.

    OUT/runs/KEY-seed0/           a run of `fit`; KEY is of its configuration and its data. `trained.json`: it is done.
                                  Stage 1 and stage 2 are runs of their own, so that trainings share a stage 1
    OUT/scores/KEY.safetensors    one network on one split, with one choice of views and codes

An experiment that is stopped goes on where it was when it is called again: `fit` resumes, finished scores are read.
Scores outlive their runs: where they are kept, a table is made again, or finished on another machine, without training.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from safetensors.torch import load, save

from models import Predictor
from train.config import PROFILES, FitConfig, InferenceConfig, Profile, fit_config_from_json, with_steps
from train.data.batches import LoadedSplit
from train.errors import UserError
from train.evaluation.per_shape import (
    SHAPES_AT_ONCE,
    ShapeMetrics,
    compare_clouds,
    concatenate,
    evaluate_split,
)
from train.evaluation.retrieval import medoid, nearest_by_image
from train.evaluation.runs import best_weights, load_predictor, read_split
from train.experiments.side_by_side import run_side_by_side
from train.files import replacing, write_text
from train.methods.systems import build_network, cloud_size, image_size
from train.show import figures
from train.training.trainer import fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A method's error on the shapes that it was trained on needs no more of them.
_SOME_TRAINING_SHAPES = 100

# What does not change a run's weights, and so not its name.
_NO_PART_OF_A_KEY = (
    "inference",
    "seed",
    "log_every",
    "picture_every",
    "checkpoint_every",
    "keep_checkpoints",
)


class Unmeasured(Exception):
    """Scores that are not there, where nothing may be measured."""


Change = Callable[[FitConfig], FitConfig]
"""How a variant's configuration differs from its profile's."""


@dataclasses.dataclass(frozen=True)
class Workbench:
    """Data, a profile and seeds; and a directory for what is made of them.

    Attributes:
        data: roots of the data trees, put together for training; the first one's test split is scored.
        out: directory for runs and scores.
        profile: size of the networks, and recipe of their training.
        seeds: how many trainings of each variant, with seeds 0, 1, ...
        limit: score at most that many test shapes.
        steps: if given, the same number of steps for every phase, for a quick look.
        progress: show bars.
        processes: how many trainings or measurements at once, each in a process with one thread.
        category: what experiments on shapes of one kind are about.
        pictures: a folder of photographs for each object, for the experiment that shows what is made of them.
        measures: False: what would have to be measured is refused with `Unmeasured`.
    """

    data: tuple[Path, ...]
    out: Path
    profile: Profile = "cpu"
    seeds: int = 3
    limit: int | None = None
    steps: int | None = None
    progress: bool = True
    processes: int = 1
    category: str = "chair"
    pictures: Path | None = None
    measures: bool = True
    _loaded: dict[tuple, LoadedSplit] = dataclasses.field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UserError(f"--seeds must be at least 1; got {self.seeds}")
        if self.limit is not None and self.limit < 2:
            raise UserError(f"--limit must be at least 2, for a spread over shapes; got {self.limit}")
        if self.processes < 1:
            raise UserError(f"--processes must be at least 1; got {self.processes}")

    def on_trees(self) -> Workbench:
        """With the data trees among its data alone, on which networks can be trained."""
        return dataclasses.replace(
            self, data=tuple(root for root in self.data if (root / "data_list").is_dir())
        )

    def config(self, change: Change, *, seed: int) -> FitConfig:
        """The profile's configuration with a variant's changes."""
        # Nobody looks at the pictures of dozens of runs.
        config = dataclasses.replace(change(PROFILES[self.profile]), seed=seed, picture_every=0)
        return config if self.steps is None else with_steps(config, self.steps)

    def configs(self, change: Change) -> list[FitConfig]:
        """A variant's configuration with every seed."""
        return [self.config(change, seed=seed) for seed in range(self.seeds)]

    def run_of(self, config: FitConfig) -> Path:
        """Where a configuration's run is kept."""
        values = {k: v for k, v in _own_values(config).items() if k not in _NO_PART_OF_A_KEY}
        key = _digest(json.dumps([values, self.fingerprints()], sort_keys=True))
        return self.out / "runs" / f"{key}-seed{config.seed}"

    def need_data(self) -> None:
        """Raises a UserError if there are no data."""
        if not self.data:
            raise UserError("no data; name one or more data trees with --data")

    @property
    def scored_tree(self) -> Path:
        """The first data tree, whose test shapes are scored."""
        self.need_data()
        return self.data[0]

    def fingerprints(self) -> list[str]:
        """Of each data tree: changes when its lists, or what it was made with, change."""
        self.need_data()
        return [_tree_fingerprint(root) for root in self.data]

    def is_trained(self, config: FitConfig) -> bool:
        """Has a configuration's training come to its end?"""
        return (self.run_of(parts_of(config)[-1]) / "trained.json").exists()

    def train(self, config: FitConfig, *, stage: Literal[1, 2] = 2) -> Path:
        """The run with a stage of a configuration's training: made now, continued, or there already.

        Raises:
            KeyboardInterrupt: a signal ended the training early; it has saved.
        """
        parts = parts_of(config)
        run = self._train_part(parts[0], None)
        if stage == 2 and len(parts) > 1:
            run = self._train_part(parts[1], best_weights(run, 1))
        return run

    def _train_part(self, config: FitConfig, start: Path | None) -> Path:
        """A run of `parts_of`; with the weights it starts from, if it is not the first."""
        run = self.run_of(config)
        if self.is_trained(config):
            return run
        if start is not None:
            stage1 = dataclasses.replace(config.stage1, steps=0)
            config = dataclasses.replace(config, stage1=stage1, start=str(start))
        saved = run / "config.json"
        begun = saved.exists()
        if begun:
            config = fit_config_from_json(saved.read_text(), where=str(saved))
        begin = time.process_time()  # by the clock it would count what else the machine does
        if not fit(self.data, run, config, resume=begun, progress=self.progress):
            raise KeyboardInterrupt
        seconds = round(time.process_time() - begin)
        write_text(run / "trained.json", json.dumps({"seconds": seconds, "continued": begun}) + "\n")
        return run

    def has(self, measure: Callable[[Workbench], object]) -> bool:
        """Are the scores kept that a measurement would take? Then it needs no network."""
        return self._lacks(measure) is None

    def _lacks(self, measure: Callable[[Workbench], object]) -> str | None:
        """The first scores that a measurement would take, because they are not kept."""
        try:
            measure(dataclasses.replace(self, measures=False))
        except Unmeasured as scores:
            return str(scores)
        return None

    def missing(self, configs: Sequence[FitConfig]) -> tuple[list[FitConfig], list[FitConfig]]:
        """The runs that trainings still need, each once: those that start afresh, and those that start from them."""
        rounds: tuple[dict[Path, FitConfig], dict[Path, FitConfig]] = ({}, {})
        for config in configs:
            for found, part in zip(rounds, parts_of(config), strict=False):
                if not self.is_trained(part):
                    found.setdefault(self.run_of(part), part)
        return list(rounds[0].values()), list(rounds[1].values())

    def train_all(self, configs: Sequence[FitConfig]) -> None:
        """Trains what is not yet trained, `processes` at once. A training has the same bits whichever way it is made.

        Raises:
            KeyboardInterrupt: as `train`.
            UserError: one could not be trained; the others that were under way have come to their end.
        """
        for missing in self.missing(configs):
            if min(self.processes, len(missing)) > 1:
                calls = [(self.in_a_process(), config) for config in missing]
                run_side_by_side(
                    _train, calls, processes=self.processes, title="trainings", progress=self.progress
                )
                continue
            threads = torch.get_num_threads()
            torch.set_num_threads(1)
            try:
                for config in missing:
                    self.train(config)
            finally:
                torch.set_num_threads(threads)

    def measure_all(self, measure: Callable[..., object], arguments: Sequence[tuple[Any, ...]]) -> None:
        """Takes measurements whose scores are not kept yet, `processes` at once; a lone process leaves them for later.

        Args:
            measure: called with a bench and each of the arguments; importable by name. What it returns is thrown away,
                what it keeps on the bench stays.
            arguments: can be pickled; nothing that they need is still to be trained.

        Raises:
            KeyboardInterrupt: a signal ended it early; what was measured is kept.
        """
        if self.processes == 1:
            return
        missing: dict[str, tuple[Any, ...]] = {}
        for given in arguments:
            scores = self._lacks(lambda asked, given=given: measure(asked, *given))
            if scores is not None:
                missing.setdefault(scores, given)
        if len(missing) > 1:
            calls = [(measure, self.in_a_process(), *given) for given in missing.values()]
            run_side_by_side(
                _measure, calls, processes=self.processes, title="measurements", progress=self.progress
            )

    def in_a_process(self) -> Workbench:
        """The same for one of several processes: it is quiet, and starts no others."""
        return dataclasses.replace(self, progress=False, processes=1, _loaded={})

    def scores(
        self,
        config: FitConfig,
        settings: InferenceConfig,
        *,
        stage: Literal[1, 2] = 2,
        views: int,
        split: Literal["train", "val", "test"] = "test",
        code_seed: int | None = None,
    ) -> ShapeMetrics:
        """Figure -> (M,) of a configuration's network, trained if need be. Codes and views are drawn by its seed.

        Args:
            config: the network.
            settings: how its codes are chosen.
            stage: whose best weights.
            views: per shape.
            split: what is scored; of the training shapes a hundred, spread evenly.
            code_seed: draws the codes in place of the configuration's seed.
        """

        def measure(model: Predictor, data: LoadedSplit) -> ShapeMetrics:
            return evaluate_split(model, data, settings, views=views, seed=config.seed, code_seed=code_seed)

        what = [dataclasses.asdict(settings), views, *([] if code_seed is None else [code_seed])]
        return self.measured(config, what, measure, stage=stage, split=split)

    def measured(
        self,
        config: FitConfig,
        what: object,
        measure: Callable[[Predictor, LoadedSplit], ShapeMetrics],
        *,
        stage: Literal[0, 1, 2] = 2,
        split: Literal["train", "val", "test"] = "test",
    ) -> ShapeMetrics:
        """What a function finds of a configuration's network on a split, trained and measured if need be.

        Args:
            config: whose network.
            what: names the measurement, with everything that decides its outcome; can be written as JSON.
            measure: makes it.
            stage: see `network`.
            split: of the first tree; of the training shapes a hundred, spread evenly.
        """
        data = self.split(config, split, limit=_SOME_TRAINING_SHAPES if split == "train" else None)
        run = self.run_of(stage1_of(config) if stage == 1 else config)

        def take() -> ShapeMetrics:
            found = measure(self.network(config, stage=stage), data)
            return {name: values.double() for name, values in found.items()}

        return self.kept([run.name, stage, what, split, data.fingerprint], take)

    def network(self, config: FitConfig, *, stage: Literal[0, 1, 2] = 2) -> Predictor:
        """A configuration's network with the best weights of a stage, trained if need be.

        Stage 0 is the fresh network, before training; a method without the stage gives its last.
        """
        if stage == 0:
            torch.manual_seed(config.seed)
            return build_network(config)
        run = self.train(config, stage=stage)
        has_stage = f"stage{stage}" in config.phases
        return load_predictor(best_weights(run, stage) if has_stage else run)

    def trivial_scores(
        self, answer: Literal["medoid", "nearest image"], config: FitConfig, *, views: int
    ) -> ShapeMetrics:
        """Figure -> (M,) of an answer that needs no network, for the data that a configuration sees."""
        test, train = self.split(config, "test"), self.split(config, "train")
        points = cloud_size(config)

        def take() -> ShapeMetrics:
            if answer == "medoid":
                clouds = train.points[medoid(train.points)].expand_as(test.points)
            else:
                clouds = train.points[nearest_by_image(test, train, views=(views,))[views]]
            parts = zip(clouds.split(SHAPES_AT_ONCE), test.points.split(SHAPES_AT_ONCE), strict=True)
            found = concatenate(
                [compare_clouds(cloud.contiguous(), truth, points=points) for cloud, truth in parts]
            )
            return {name: values.double() for name, values in found.items()}

        key = [answer, points, image_size(config), views, train.fingerprint, test.fingerprint]
        return self.kept(key, take)

    def split(
        self, config: FitConfig, split: Literal["train", "val", "test"], *, limit: int | None = None
    ) -> LoadedSplit:
        """A split of the first tree as a configuration reads it; read once. All of it, but for the bench's own limit on
        the shapes that are scored, or at most `limit` of its shapes."""
        size = image_size(config)
        limit = limit or (self.limit if split != "train" else None)
        key = (self.scored_tree, limit, split, *size, config.map_size, config.gt_pool, config.categories)
        if key not in self._loaded:
            self._loaded[key] = read_split(
                config, self.scored_tree, split, image_size=size, limit=limit, progress=self.progress
            )
        return self._loaded[key]

    def kept(self, key: Sequence[object], take: Callable[[], ShapeMetrics]) -> ShapeMetrics:
        """What was measured under a key of plain JSON values: taken now, and kept, or there already.

        Args:
            key: all that the measurement depends on: the run's name, the split's fingerprint, settings.
            take: measures.
        """
        path = self.out / "scores" / f"{_digest(json.dumps(key, sort_keys=True))}.safetensors"
        if not path.exists():
            if not self.measures:
                raise Unmeasured(path)
            found = take()
            with replacing(path) as temporary:
                temporary.write_bytes(save(found))
        return load(path.read_bytes())

    def publish(self, name: str, result: Mapping[str, Any], page: str, figure: Figure) -> None:
        """Writes NAME.json, NAME.md and NAME.png."""
        write_text(self.out / f"{name}.json", json.dumps(result, indent=2) + "\n")
        write_text(self.out / f"{name}.md", page)
        figures.save(figure, self.out / f"{name}.png")

    def about(self, config: FitConfig) -> dict[str, Any]:
        """What every result says of its making: profile, data, seeds, and the networks' configuration."""
        return {
            "profile": self.profile,
            "data": [str(root) for root in self.data],
            "seeds": self.seeds,
            "config": dataclasses.asdict(config),
        }


def as_it_is(config: FitConfig) -> FitConfig:
    """The change that changes nothing: our own system as the profile has it."""
    return config


def stage1_of(config: FitConfig) -> FitConfig:
    """A configuration's training up to the end of stage 1; all of it if it cannot be parted, see `parts_of`."""
    if config.needs_autoencoder or not config.stage1.steps:
        return config
    # As of every training with this stage 1, whatever follows.
    nothing = dataclasses.replace(config.stage1, steps=0)
    return dataclasses.replace(config, stage2=nothing, variant="standard")


def parts_of(config: FitConfig) -> tuple[FitConfig, ...]:
    """The runs that a training is made of: stage 1, and the whole, of which the second run trains what is left.

    A critic learns through both stages: such a training is one run, and so is one with a single stage.
    """
    first = stage1_of(config)
    return (first,) if first == config or not config.stage2.steps else (first, config)


def _train(bench: Workbench, config: FitConfig) -> None:
    bench.train(config)


def _measure(measure: Callable[..., object], bench: Workbench, *given: Any) -> None:
    measure(bench, *given)  # what it found is kept, and need not be sent back


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _own_values(config: Any) -> dict[str, Any]:
    """A configuration's values that are not their fields' defaults: a field that is new changes no key."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value != field.default:
            found[field.name] = _own_values(value) if dataclasses.is_dataclass(value) else value
    return found


def _tree_fingerprint(root: Path) -> str:
    """Changes when a tree's lists, or what it was made with, change; nothing is read but those."""
    files = sorted(root.glob("data_list/*/*.list")) + sorted(root.glob("made_with.json"))
    if not files:
        raise UserError(f"no data at {root}; make some with: python -m train data procedural --out {root}")
    return _digest("\n".join(f"{path.relative_to(root)}\n{path.read_text()}" for path in files))
