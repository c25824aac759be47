"""The frame of the experiments: what is trained and measured once is found again, and tables, status and page show
it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

import train.experiments.study as study_module
from train.config import FitConfig, StageConfig
from train.experiments import store
from train.experiments.study import Study, unchanged


@pytest.fixture
def fresh(tiny_data: Path, tmp_path: Path) -> Study:
    """Nothing is trained."""
    return Study((tiny_data,), tmp_path / "out", "smoke", seeds=1, steps=2, limit=4, progress=False)


def test_a_run_is_found_by_its_whole_configuration(fresh: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    config = fresh.config(unchanged, seed=0)
    run = fresh.run_of(config)
    assert fresh.run_of(dataclasses.replace(config)) == run
    # A value that equals the default of its field counts like any other: another default is another run.
    penalty = next(field for field in dataclasses.fields(StageConfig) if field.name == "penalty")
    assert config.stage1.penalty == penalty.default
    monkeypatch.setattr(penalty, "default", 5.0)
    assert fresh.run_of(config) == run
    stage1 = dataclasses.replace(config.stage1, penalty=5.0)
    assert fresh.run_of(dataclasses.replace(config, stage1=stage1)) != run

    @dataclasses.dataclass(frozen=True)
    class Later(FitConfig):
        new_field: int = 7

    later = Later(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
    assert fresh.run_of(later) != run


def test_every_field_that_changes_weights_is_part_of_the_key(fresh: Study) -> None:
    config = fresh.config(unchanged, seed=0)
    described = fresh.run_key(config)["config"]
    left_out = {field.name for field in dataclasses.fields(config)} - set(described)
    assert left_out == {
        "inference", "seed", "log_every", "picture_every", "checkpoint_every", "keep_checkpoints"
    }  # fmt: skip
    for stage in ("stage1", "stage2", "pretrain"):
        assert described[stage] == dataclasses.asdict(getattr(config, stage))


def test_other_data_or_training_code_is_another_run(
    fresh: Study, tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = fresh.config(unchanged, seed=0)
    run = fresh.run_of(config)
    assert fresh.run_of(dataclasses.replace(config, seed=1)).name == run.name.replace("seed0", "seed1")
    for path in tiny_data.glob("data_list/*/*.list"):
        target = tmp_path / "other" / path.relative_to(tiny_data)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(path.read_text() + "03001627/another\n")
    assert dataclasses.replace(fresh, data=(tmp_path / "other",)).run_of(config).name != run.name
    monkeypatch.setattr(study_module, "TRAINING_VERSION", 2)
    assert fresh.run_of(config) != run


def test_packed_metrics_are_found_as_single_ones_are(tmp_path: Path) -> None:
    keys = [["a", 1], ["a", 2], [{"config": {"steps": 3}}, "test"]]
    values = [{"cd": torch.arange(3.0), "one, truth": torch.ones(2, 3)}, {"cd": torch.zeros(1)}, {}]
    for key, value in zip(keys[:2], values[:2], strict=True):
        store.kept(tmp_path, key, lambda value=value: value)
    store.pack(tmp_path)
    assert not list((tmp_path / "metrics").iterdir())
    store.kept(tmp_path, ["a", 3], lambda: {"cd": torch.full((2,), 7.0)})
    store.pack(tmp_path)  # adds to what is packed
    for key, value in zip(keys[:2], values[:2], strict=True):
        found = store.kept(tmp_path, key, None)
        assert list(found) == list(value) and all(found[name].equal(value[name]) for name in value)
    assert store.kept(tmp_path, ["a", 3], None)["cd"].tolist() == [7, 7]
    with pytest.raises(store.NotMeasured):
        store.kept(tmp_path, ["a", 4], None)
