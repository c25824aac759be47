"""The frame of the experiments: what is trained and measured once is found again; tables, status and page show it."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import train.experiments.study as study_module
from train.config import FitConfig, InferenceConfig, PretrainConfig, StageConfig, scaled
from train.errors import UserError
from train.evaluation.runs import best_weights
from train.experiments import store
from train.experiments.frame import Experiment, Outcome, is_done, make_experiment
from train.experiments.paper import (
    TABLES,
    second_stage_alone,
    second_stage_without_diversity,
    with_critic,
    without_codes,
    without_critic,
)
from train.experiments.registry import ABOUT_ALL, EXPERIMENTS, load
from train.experiments.run import make_all, run_experiment, write_page
from train.experiments.statistics import claim, counted, resampled_means, verdict
from train.experiments.status import status, status_lines
from train.experiments.study import Study, of_method, parts_of, stage1_of, unchanged
from train.experiments.table import Row, Table, below, make, markdown, measured

NO_TREES = {"front-vs-projection", "photos", "runtime"}


def few_views(table: Table) -> Table:
    """The table as it is, with as many views as the tests' data have."""
    return dataclasses.replace(
        table, rows=tuple(dataclasses.replace(row, views=min(row.views, 4)) for row in table.rows)
    )


@pytest.fixture
def fresh(tiny_data: Path, tmp_path: Path) -> Study:
    """Nothing is trained."""
    return Study((tiny_data,), tmp_path / "out", "smoke", seeds=1, steps=2, limit=4, progress=False)


@pytest.fixture(scope="module")
def trained(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Study:
    """What the tables share is trained here once."""
    out = tmp_path_factory.mktemp("study")
    return Study((tiny_data,), out, "smoke", seeds=2, limit=4, steps=2, progress=False)


# Keys and storage


def test_a_run_is_found_by_its_configuration(fresh: Study) -> None:
    config = fresh.config(unchanged, seed=0)
    run = fresh.run_of(config)
    assert fresh.run_of(dataclasses.replace(config)) == run
    stage1 = dataclasses.replace(config.stage1, penalty=5.0)
    assert fresh.run_of(dataclasses.replace(config, stage1=stage1)) != run

    @dataclasses.dataclass(frozen=True)
    class Later(FitConfig):
        new_field: int = 7

    # A version with a new field finds what earlier ones have trained, as long as the field is at its default.
    later = Later(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
    assert fresh.run_of(later) == run
    assert fresh.run_of(dataclasses.replace(later, new_field=8)) != run


def test_defaults_are_those_by_which_kept_results_are_known() -> None:
    """Keys leave out what is at its default. If you have only added a field, put the new digest here. If you have
    changed a default, also raise TRAINING_VERSION: else results of the old default pass for those of the new one."""
    defaults = {
        settings.__name__: store.digest(
            {
                field.name: repr(field.default)
                for field in dataclasses.fields(settings)
                if field.default is not dataclasses.MISSING
            }
        )
        for settings in (FitConfig, StageConfig, PretrainConfig, InferenceConfig)
    }
    assert defaults == {
        "FitConfig": "d854ccb9fa365f25",
        "StageConfig": "e93fe16768be9d63",
        "PretrainConfig": "4cf85f0401cf8eb3",
        "InferenceConfig": "f2402cf6aa4880e1",
    }


def _another_value(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return value + "?"
    return (7, 8) if isinstance(value, tuple) else value + 1


def test_every_field_that_changes_weights_is_part_of_the_key(fresh: Study) -> None:
    config = fresh.config(unchanged, seed=0)
    described = fresh.run_key(config)["config"]
    left_out = {
        field.name
        for field in dataclasses.fields(config)
        if fresh.run_key(dataclasses.replace(config, **{field.name: object()}))["config"] == described
    }
    assert left_out == {
        "inference", "seed", "log_every", "picture_every", "checkpoint_every", "keep_checkpoints"
    }  # fmt: skip
    for stage in ("stage1", "stage2"):
        for field in dataclasses.fields(StageConfig):
            other = _another_value(getattr(getattr(config, stage), field.name))
            changed = dataclasses.replace(getattr(config, stage), **{field.name: other})
            assert fresh.run_key(dataclasses.replace(config, **{stage: changed}))["config"] != described


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
    monkeypatch.setattr(study_module, "TRAINING_VERSION", study_module.TRAINING_VERSION + 1)
    assert fresh.run_of(config) != run


def test_packed_metrics_are_found_as_single_ones_are(tmp_path: Path) -> None:
    measured = {"cd": torch.arange(3.0), "one, target": torch.ones(2, 3)}
    first, second, third = ["a", 1], ["a", {"steps": 3}], ["b"]
    for key in (first, second):
        store.kept(tmp_path, key, lambda: measured)
    store.pack(tmp_path)
    assert not list((tmp_path / "metrics").iterdir())
    store.kept(tmp_path, third, lambda: {"cd": torch.full((2,), 7.0)})
    store.pack(tmp_path)  # adds to what is packed
    for key in (first, second):
        found = store.kept(tmp_path, key, None)
        assert set(found) == set(measured) and all(found[name].equal(measured[name]) for name in measured)
    assert store.kept(tmp_path, third, None)["cd"].tolist() == [7, 7]
    with pytest.raises(store.NotMeasured, match=store.digest(["c"])):
        store.kept(tmp_path, ["c"], None)
    keys = store.keys(tmp_path)  # the file says what it holds
    assert keys == {store.digest(key): key for key in (first, second, third)}


# Trainings


def test_an_interrupted_training_is_finished_to_the_same_weights(trained: Study) -> None:
    config = trained.config(without_codes, seed=0)
    run = trained.train(config)
    assert run == trained.run_of(config) and trained.is_trained(config)
    weights = best_weights(run, 2).read_bytes()
    (run / "trained.json").unlink()
    assert not trained.is_trained(config)
    assert trained.train(config) == run
    assert best_weights(run, 2).read_bytes() == weights
    assert json.loads((run / "trained.json").read_text())["continued"]


def test_trainings_share_their_stage_1(trained: Study) -> None:
    config = trained.config(without_critic, seed=0)
    variant = second_stage_without_diversity(config)
    first, whole = parts_of(config)
    assert (first.stage1, first.stage2.steps, whole) == (config.stage1, 0, config)
    assert parts_of(stage1_of(variant)) == (first,)
    trained.train_all([config, variant])
    assert len({trained.run_of(part) for part in (first, config, variant)}) == 3
    assert trained.train(config, stage=1) == trained.train(variant, stage=1) == trained.run_of(first)
    weights = best_weights(trained.run_of(first), 1)
    for each in (config, variant):
        saved = json.loads((trained.run_of(each) / "config.json").read_text())
        assert (saved["start"], saved["stage1"]["steps"]) == (str(weights), 0)
        assert not best_weights(trained.run_of(each), 1).exists()
    same, other = (trained.network(each, stage=1) for each in (config, variant))
    assert all(torch.equal(a, b) for a, b in zip(same.parameters(), other.parameters(), strict=True))
    # A critic learns through both stages, and a stage 1 that is missing or the only one cannot be separated.
    for change in (with_critic, lambda c: second_stage_alone(without_critic(c)), of_method("psgn")):
        whole = trained.config(change, seed=0)
        assert parts_of(whole) == (whole,)


def test_a_training_of_one_stage_is_finished_too(fresh: Study) -> None:
    config = scaled(fresh.config(of_method("psgn"), seed=0), 0.5)
    assert not fresh.is_trained(config)
    fresh.train(config)
    assert fresh.is_trained(config)


@pytest.mark.slow
def test_processes_train_and_measure_the_same(trained: Study, tmp_path: Path) -> None:
    table = few_views(TABLES["deterministic"])
    calls = [cell for cell in table.cells(trained) if cell[0].name == "deterministic"]
    beside = dataclasses.replace(trained, out=tmp_path, processes=2, _splits={})
    for study in (trained, beside):
        study.train_all([config for _, config in calls])
    for _, config in calls:
        for stage in (1, 2):
            weights = [best_weights(study.run_of(config), stage).read_bytes() for study in (trained, beside)]
            assert weights[0] == weights[1]
    assert all(beside.first_missing(lambda s, cell=cell: measured(s, *cell)) for cell in calls)
    beside.measure_all(measured, [*calls, calls[0]])  # what is asked for twice is measured once
    assert len(list((tmp_path / "metrics").iterdir())) == len(calls) == 2
    kept = dataclasses.replace(beside, measures=False)
    for cell in calls:
        metrics = measured(trained, *cell)
        assert all(metrics[name].equal(values) for name, values in measured(kept, *cell).items())
    with pytest.raises(UserError, match="asks for"):
        many = dataclasses.replace(calls[0][1], stage2=dataclasses.replace(calls[0][1].stage2, views=9))
        beside.train_all([many, dataclasses.replace(many, seed=1)])


# Statistics


def test_an_interval_is_of_shapes_and_of_trainings() -> None:
    noise = np.random.default_rng(0).standard_normal((3, 400))
    noise -= noise.mean(1, keepdims=True)
    found = claim("a < b", 1 + noise, paper_gain=0.5)
    low, high = found["interval"]
    # The mean of 400 shapes varies by 1.96 / 20; three trainings on the same shapes with independent noise by less.
    assert (
        found["gain"] == pytest.approx(1)
        and 0.05 < 1 - low < 0.12
        and high - 1 == pytest.approx(1 - low, abs=0.01)
    )
    assert found["verdict"] == "holds"
    assert claim("", -1 - noise)["verdict"] == "does not hold" and claim("", noise)["verdict"] == "undecided"
    # Trainings that disagree leave a doubt, however many shapes there are.
    disagree = noise * 1e-3 + np.array([[1.0], [1.0], [-1.5]])
    assert claim("", disagree)["verdict"] == "undecided"
    assert resampled_means(disagree).std() > 0.5
    assert [verdict(*each) for each in ((0.1, 1), (-1, -0.1), (-1, 1))] == [
        "holds",
        "does not hold",
        "undecided",
    ]
    assert counted([found] * 2).startswith("2 claims are tested: 2 hold, 0 do not hold, 0 are undecided")


# Tables


@pytest.mark.parametrize("name", [name for name in TABLES if name != "critic"])
def test_every_table_of_the_paper_is_what_was_measured(name: str, trained: Study) -> None:
    table, study = (
        few_views(TABLES[name]),
        dataclasses.replace(trained, seeds=2 if name == "deterministic" else 1),
    )
    result = make_experiment(name, table.experiment, study)
    assert json.loads((study.out / f"{name}.json").read_text()) == json.loads(json.dumps(result))
    assert list(result["rows"]) == [row.name for row in table.rows]
    for row in table.rows:
        found = result["rows"][row.name]
        metrics = [measured(study, row, table.config(row, study, seed=seed)) for seed in range(study.seeds)]
        for metric, values in found["by_seed"].items():
            assert values == pytest.approx([each[metric].double().mean().item() for each in metrics])
            assert found["mean"][metric] == pytest.approx(sum(values) / len(values))
    text = (study.out / f"{name}.md").read_text()
    assert text == markdown(json.loads((study.out / f"{name}.json").read_text()))
    assert all(each["words"] in text and each["verdict"] in text for each in result["claims"])
    categories = set(study.split(table.config(table.rows[-1], study, seed=0), "test").categories)
    assert categories == ({"chair"} if table.of_one_category else {"chair", "display"})
    if table.category_claims:
        row = table.rows[-1 if name == "multi-category" else 0].name
        of_categories = result["categories"].values()
        weighted = sum(each["shapes"] * each["rows"][row]["cd"] for each in of_categories)
        assert weighted / result["shapes"] == pytest.approx(result["rows"][row]["mean"]["cd"])
    if name == "deterministic":
        row = result["rows"]["conditional"]
        assert f"{row['mean']['cd']:.2f} ± {row['sd']['cd']:.2f} (3.37)" in text
        gain = result["rows"]["deterministic"]["mean"]["cd"] - row["mean"]["cd"]
        assert result["claims"][0]["gain"] == pytest.approx(gain)
        assert result["claims"][0]["interval"][0] <= gain <= result["claims"][0]["interval"][1]
    if name == "views":
        agreed = result["rows"]["4 views"]["consistency"]
        assert agreed["descended"] < agreed["searched"]


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_claims_hold_for_the_papers_own_values(table: Table) -> None:
    paper = {row.name: row.paper for row in table.rows}
    for each in (*table.claims, *table.category_claims):
        try:
            gain = each.gain(paper)
        except KeyError:  # the paper has no value
            continue
        assert gain > 0, each.words


def test_one_category_takes_half_the_steps_of_all_at_cpu(fresh: Study) -> None:
    cpu = dataclasses.replace(fresh, profile="cpu", steps=None, category="display")
    single, views = TABLES["single-category"], TABLES["views"]
    of_one, of_all = (table.config(table.rows[-1], cpu, seed=0) for table in (single, views))
    assert of_one.categories == ("display",) and of_all.categories == ()
    psgn = cpu.config(of_method("psgn"), seed=0)
    row = next(row for row in single.rows if row.name == "PSGN")
    assert single.config(row, cpu, seed=0).stage1.steps == psgn.stage1.steps / 2
    full = dataclasses.replace(cpu, profile="full")
    assert (
        single.config(row, full, seed=0).stage1.steps == full.config(of_method("psgn"), seed=0).stage1.steps
    )


def test_metrics_outlive_their_runs(trained: Study, tmp_path: Path) -> None:
    table = few_views(dataclasses.replace(TABLES["deterministic"], claims=()))
    first = make(table, trained).result
    files = {path: path.stat().st_mtime_ns for path in trained.out.glob("*/**/*") if path.is_file()}
    assert make(table, trained).result == first
    assert files == {path: path.stat().st_mtime_ns for path in files}
    shutil.copytree(trained.out / "metrics", tmp_path / "metrics")
    elsewhere = dataclasses.replace(trained, out=tmp_path)
    store.pack(tmp_path)
    assert make(table, elsewhere).result == first
    assert not (tmp_path / "runs").exists()
    (tmp_path / "metrics.safetensors").unlink()
    assert table.trainings(elsewhere, only_missing=True) == table.trainings(elsewhere)
    row = table.rows[0]
    config = table.config(row, trained, seed=0)
    other = dataclasses.replace(row, codes="agreed as in the paper")
    assert elsewhere.first_missing(lambda s: measured(s, row, config))
    assert trained.first_missing(lambda s: measured(s, row, config)) is None
    assert trained.first_missing(lambda s: measured(s, other, config))


def test_a_verdict_agrees_with_the_numbers(trained: Study) -> None:
    rows = (Row(name="network", views=4), Row(name="medoid", source="medoid", views=4))
    pairs = (below("cd", "medoid", "network"), below("cd", "network", "medoid"))
    claims = make(Table(title="Network and medoid.", rows=rows, claims=pairs), trained).result["claims"]
    assert claims[0]["gain"] == pytest.approx(-claims[1]["gain"])
    assert claims[0]["interval"] == pytest.approx([-each for each in claims[1]["interval"][::-1]])
    opposite = {"holds": "does not hold", "does not hold": "holds", "undecided": "undecided"}
    assert claims[0]["verdict"] == opposite[claims[1]["verdict"]]


# Status and page


def _experiment(*changes: Any, fails: bool = False, other_inputs: Any = lambda study: []) -> Experiment:
    """Writes a claim and a figure, and trains nothing."""

    def make(study: Study) -> Outcome:
        if fails:
            raise UserError("no luck")
        result = {"profile": study.profile, "data": ["somewhere/tiny"], "seeds": study.seeds}
        found = claim("a < b", np.full((3, 5), 0.5))
        return Outcome(result | {"claims": [found]}, "the page\n", {"": Figure(), "-more": Figure()})

    return Experiment(make, lambda study: study.configs(*changes), other_inputs)


def _ablated(config: FitConfig) -> FitConfig:
    return second_stage_without_diversity(without_critic(config))


def test_every_experiment_can_be_imported() -> None:
    assert all(isinstance(load(name), Experiment) for name in EXPERIMENTS)
    assert not set(EXPERIMENTS) & set(ABOUT_ALL)


def test_status_is_that_of_the_runs(fresh: Study) -> None:
    experiments = {"views": _experiment(without_critic), "ablation": _experiment(_ablated)}
    first, second = status(experiments, fresh)
    assert [first[:4], second[:4]] == [("views", False, 0, 2), ("ablation", False, 0, 2)]
    assert first.seconds is None  # no run of the kind was timed yet

    config = fresh.config(without_critic, seed=0)
    for part, seconds, finished in ((stage1_of(config), 8, (1, 1)), (config, 20, (2, 1))):
        fresh.train(part)
        (fresh.run_of(part) / "trained.json").write_text(json.dumps({"seconds": seconds, "continued": False}))
        first, second = status(experiments, fresh)
        assert (first.trained, second.trained) == finished
    assert (first.seconds, first.all_seconds) == (0, 28)
    assert second.seconds == 20  # two steps of stage 2, as long as those that were timed
    lines = status_lines([first, second], {"views": "error by views", "ablation": "stages"}, processes=2)
    assert "2/2 runs" in lines[0] and "error by views" in lines[0]
    assert lines[-1].startswith("missing trainings: 0 min")


def test_a_missing_run_is_counted_once(fresh: Study) -> None:
    both = {"views": _experiment(without_critic), "ablation": _experiment(without_critic)}
    first, second = status(both, dataclasses.replace(fresh, profile="cpu", steps=1000))
    assert first.seconds is not None and first.seconds > 60 and second.seconds == 0


def test_finished_experiments_stay_and_failures_stop_no_others(
    fresh: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    experiments = {"views": _experiment(), "collapse": _experiment(fails=True), "ablation": _experiment()}
    with pytest.raises(UserError, match="2 made; these could not be: collapse: no luck"):
        make_all(experiments, fresh)
    del experiments["collapse"]
    before = {path: path.stat().st_mtime_ns for path in fresh.out.rglob("*")}
    assert make_all(experiments, fresh) == []
    assert {path: path.stat().st_mtime_ns for path in fresh.out.rglob("*")} == before
    views = experiments["views"]
    assert is_done("views", views, fresh)
    assert not is_done("views", views, dataclasses.replace(fresh, seeds=2))
    assert not is_done("views", _experiment(without_codes), fresh)
    (fresh.out / "views.png").unlink()
    assert not is_done("views", views, fresh)
    capsys.readouterr()
    assert make_all(experiments, dataclasses.replace(fresh, progress=True)) == ["views"]
    assert capsys.readouterr().err == "-- views\n-- views: made in 0 min\n"


def test_other_inputs_are_another_result(fresh: Study, tmp_path: Path) -> None:
    (tmp_path / "pictures" / "chair").mkdir(parents=True)
    picture = tmp_path / "pictures" / "chair" / "1.png"
    picture.write_bytes(b"one")
    experiments = {"photos": _experiment(other_inputs=load("photos").other_inputs), "views": _experiment()}
    study = dataclasses.replace(fresh, pictures=tmp_path / "pictures")
    assert make_all(experiments, study) == ["photos", "views"]
    picture.write_bytes(b"two")
    assert make_all(experiments, study) == ["photos"]
    # The category matters to the experiments alone that are about one.
    display = dataclasses.replace(study, category="display")
    assert make_all(experiments, display) == []
    single = Experiment(_experiment().make, load("single-category").trainings)
    make_experiment("single-category", single, study)
    assert is_done("single-category", single, study) and not is_done("single-category", single, display)
    # Another run for agreement is another result.
    other = dataclasses.replace(study, run=tmp_path)
    assert load("agreement").other_inputs(other) and not load("agreement").other_inputs(study)


def test_experiments_without_data(tmp_path: Path) -> None:
    study = Study((), tmp_path / "out", "smoke", progress=False)
    make_experiment("runtime", _experiment(), study)
    assert is_done("runtime", _experiment(), study)
    assert not is_done("runtime", _experiment(), dataclasses.replace(study, data=(Path("meshes.zip"),)))
    for data in ((), (tmp_path,)):
        with pytest.raises(UserError, match="no data"):
            list(status({}, dataclasses.replace(study, data=data)))
    for name in sorted(set(EXPERIMENTS) - NO_TREES):
        with pytest.raises(UserError, match="no data; name one or more data trees with --data"):
            run_experiment(name, dataclasses.replace(study, out=tmp_path / "none"))
    assert not (tmp_path / "none").exists()


def test_wrong_options_are_named(fresh: Study, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="leave --run out"):
        run_experiment("views", dataclasses.replace(fresh, run=tmp_path))
    for options, message in (
        ({"seeds": 0}, "--seeds must be at least 1"),
        ({"limit": 1}, "--limit must be at least 2"),
        ({"processes": 0}, "--processes must be at least 1"),
    ):
        with pytest.raises(UserError, match=message):
            dataclasses.replace(fresh, **options)
    with pytest.raises(UserError, match="no data at"):
        dataclasses.replace(fresh, data=(tmp_path,)).run_of(fresh.config(unchanged, seed=0))


def test_one_page_of_all_results(fresh: Study) -> None:
    make_all({"views": _experiment()}, fresh)
    (fresh.out / "views.reading.md").write_text("More views are better.\n")
    fresh.kept(["something"], lambda: {"cd": torch.ones(2)})
    page = write_page(fresh.out)
    assert page == fresh.out.parent / "out.md"
    text = page.read_text()
    assert "1 claims are tested: 1 holds" in text
    assert "| views | a < b | +0.50 [+0.50, +0.50] |  | holds |" in text
    order = [
        EXPERIMENTS["views"], "the page", "More views are better.", "out/views.png", "out/views-more.png",
        "experiment views --data tiny --out OUT --profile smoke --seeds 1",
    ]  # fmt: skip
    places = [text.index(words) for words in order]
    assert places == sorted(places)
    assert (fresh.out / "metrics.safetensors").exists()  # packed
    with pytest.raises(UserError, match="holds no results"):
        write_page(fresh.out / "metrics")


def test_the_recipe_of_whole_shapes_has_results_of_its_own_beside_the_paper_s(fresh: Study) -> None:
    other = dataclasses.replace(fresh, recipe="whole-shapes")
    configs = [study.config(unchanged, seed=0) for study in (fresh, other)]
    assert [config.recipe for config in configs] == ["paper", "whole-shapes"]
    assert fresh.run_of(configs[0]) != other.run_of(configs[1])
    # Methods that have one recipe are trained once for both.
    psgn = [study.run_of(study.config(of_method("psgn"), seed=0)) for study in (fresh, other)]
    assert psgn[0] == psgn[1]
    make_all({"views": _experiment()}, fresh)
    assert make_all({"views": _experiment()}, other) == ["views"]
    assert make_all({"views": _experiment()}, fresh) == []
    text = write_page(fresh.out).read_text()
    places = [text.index(f"\n{words}\n") for words in ("## views", "## views, recipe whole-shapes")]
    assert places == sorted(places)
    papers, others = text[places[0] : places[1]], text[places[1] :]
    assert "out/views.png" in papers and "whole-shapes" not in papers
    assert "out/whole-shapes-views.png" in others and "--recipe whole-shapes" in others
    assert "| whole-shapes-views | a < b |" in text


def test_the_published_page_is_made_of_the_published_results(tmp_path: Path) -> None:
    docs = Path(__file__).parents[1] / "docs"
    shutil.copytree(docs / "results", tmp_path / "results")
    made = write_page(tmp_path / "results").read_text()
    assert made == (docs / "results.md").read_text(), (
        "make it again: python -m train experiment page --out docs/results"
    )
    for name, table in TABLES.items():
        for found in docs.glob(f"results/*/{name}.json"):
            result = json.loads(found.read_text())
            assert markdown(result) == found.with_suffix(".md").read_text()
            assert list(result["rows"]) == [row.name for row in table.rows]
            assert all(math.isfinite(gain) for each in result["claims"] for gain in each["interval"])
