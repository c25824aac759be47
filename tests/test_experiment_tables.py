"""Tables of trainings: what is trained once stays, what is claimed is measured, what is undone is undone."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from models import build_generator
from models.parts import prepare_images
from train.config import FitConfig, scaled
from train.data.batches import Batch, LoadedSplit
from train.errors import UserError
from train.evaluation.per_shape import one_view_each
from train.evaluation.runs import best_weights, load_autoencoder, read_metrics
from train.experiments.collapse import VARIANTS
from train.experiments.ledger import overview
from train.experiments.paper import (
    DETERMINISTIC,
    TABLES,
    deterministic,
    of_system,
    second_stage_alone,
    second_stage_without_diversity,
    with_critic,
    without_critic,
)
from train.experiments.run import EXPERIMENTS, Workbench, run_experiment
from train.experiments.table import Row, Table, below, confidence, make, markdown, measured
from train.experiments.ten_answers import below_real_shapes
from train.experiments.workbench import parts_of, stage1_of


@pytest.fixture(scope="module")
def bench(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    """With both systems trained, two seeds each."""
    out = tmp_path_factory.mktemp("bench")
    bench = Workbench((tiny_data,), out, "smoke", seeds=2, limit=4, steps=3, progress=False)
    bench.train_all(DETERMINISTIC.configs(bench))
    return bench


@pytest.fixture(autouse=True)
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tables as they are, with as many views as the test's data have."""
    for name, table in TABLES.items():
        rows = tuple(dataclasses.replace(row, views=min(row.views, 4)) for row in table.rows)
        monkeypatch.setitem(TABLES, name, dataclasses.replace(table, rows=rows))


def test_a_table_is_what_was_measured_and_is_made_once(bench: Workbench) -> None:
    table = TABLES["deterministic"]
    result = make(table, bench)
    assert json.loads((bench.out / "deterministic.json").read_text()) == json.loads(json.dumps(result))
    config = bench.config(deterministic, seed=1)
    scores = bench.scores(config, config.inference, views=4)
    assert result["rows"]["deterministic"]["by_seed"]["cd"][1] == pytest.approx(scores["cd"].mean().item())
    row = result["rows"]["conditional"]
    assert row["mean"]["cd"] == pytest.approx(sum(row["by_seed"]["cd"]) / 2)
    assert row["by_seed"]["cd"][0] != row["by_seed"]["cd"][1]
    expected = result["claims"][0]
    assert expected["gain"] == pytest.approx(
        result["rows"]["deterministic"]["mean"]["cd"] - row["mean"]["cd"]
    )
    text = (bench.out / "deterministic.md").read_text()
    assert f"{row['mean']['cd']:.2f} ± {row['sd']['cd']:.2f} (3.37)" in text
    assert expected["verdict"] in text

    before = {path: path.stat().st_mtime_ns for path in bench.out.glob("*/**/*") if path.is_file()}
    assert make(table, bench) == result
    after = {path: path.stat().st_mtime_ns for path in bench.out.glob("*/**/*") if path.is_file()}
    assert after == before


@pytest.mark.parametrize(
    "name", ["diversity", "single-category", "multi-category", "ablation", "consistency"]
)
def test_every_table_of_the_paper_can_be_made(
    name: str, tiny_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.getbasetemp() / "tables"  # shared: what one table trains, the next one has
    bench = Workbench((tiny_data,), out, "smoke", seeds=1, limit=4, steps=2, progress=False)
    table = TABLES[name]
    result = make(table, bench)
    assert list(result["rows"]) == [row.name for row in table.rows]
    for row in result["rows"].values():
        assert all(math.isfinite(value) for value in row["mean"].values())
    text = (out / f"{name}.md").read_text()
    assert text == markdown(json.loads((out / f"{name}.json").read_text()))
    assert all(claim.words in text for claim in table.claims)
    kinds = set(bench.split(table.config(table.rows[-1], bench, seed=0), "test").categories)
    assert kinds == ({"chair"} if table.of_one_category else {"chair", "display"})
    if table.category_claims:
        of_categories = result["categories"].values()
        weighted = sum(each["shapes"] * each["rows"]["ours"]["cd"] for each in of_categories)
        assert weighted / result["shapes"] == pytest.approx(result["rows"]["ours"]["mean"]["cd"])


def test_true_shapes_are_nearer_than_an_untaught_network_to_what_their_images_show(bench: Workbench) -> None:
    table = TABLES["diversity"]
    ours, truth = (
        next(row for row in table.rows if row.name == name)
        for name in ("diversity loss, beta 10", "the truth, sampled again")
    )
    for seed in range(bench.seeds):
        network, surface = (
            row.measure(row, bench, table.config(row, bench, seed=seed))["visible"] for row in (ours, truth)
        )
        assert surface.mean() < 0.7 * network.mean()


def test_a_critic_tells_noise_from_real_shapes_and_not_real_shapes_from_themselves(bench: Workbench) -> None:
    judge = bench.config(with_critic, seed=0)
    encode = load_autoencoder(bench.train(judge)).encode_frozen
    test, taught = bench.split(judge, "test"), bench.split(judge, "train")

    def below(share_of_noise: float) -> Tensor:
        def answered(split: LoadedSplit, count: int) -> Iterator[tuple[Tensor, Batch, Tensor]]:
            for shapes, shown in one_view_each(split, 0):
                true = split.points[shapes, :128].expand(count, -1, -1, -1)
                yield shapes, shown, true + share_of_noise * torch.randn(true.shape)

        found = below_real_shapes(answered, test, taught=taught, encode=encode, points=128, seed=0, steps=150)
        assert found["critic"].shape == (len(test),)
        return found["critic"].mean()

    torch.manual_seed(0)
    nothing, some, more = below(0.0), below(0.1), below(0.3)
    assert nothing.abs() < 0.2 * some
    assert some < more


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_what_is_claimed_holds_for_the_papers_own_figures(table: Table) -> None:
    paper = {row.name: row.paper for row in table.rows}
    for claim in (*table.claims, *table.category_claims):
        try:
            gain = claim.gain(paper)
        except KeyError:  # no figure of the paper's
            continue
        assert gain > 0, claim.words


def test_trainings_share_their_first_stage(bench: Workbench) -> None:
    config = bench.config(without_critic, seed=0)
    variant = second_stage_without_diversity(config)
    first, whole = parts_of(config)
    assert (first.stage1, first.stage2.steps) == (config.stage1, 0)
    assert whole == config
    assert parts_of(stage1_of(variant)) == (first,)
    bench.train_all([config, variant])
    runs = {bench.run_of(part).name for part in (first, config, variant)}
    assert len(runs) == 3
    assert bench.train(config, stage=1) == bench.train(variant, stage=1) == bench.run_of(first)
    weights = best_weights(bench.run_of(first), 1)
    for each in (config, variant):
        saved = json.loads((bench.run_of(each) / "config.json").read_text())
        assert (saved["start"], saved["stage1"]["steps"]) == (str(weights), 0)
        assert not best_weights(bench.run_of(each), 1).exists()
    same, other = (bench.network(each, stage=1) for each in (config, variant))
    assert all(torch.equal(a, b) for a, b in zip(same.parameters(), other.parameters(), strict=True))
    # A critic goes on learning, and a first stage that is missing or the only one cannot be parted.
    alone = second_stage_alone(config)
    for whole in (bench.config(with_critic, seed=0), alone, bench.config(of_system("psgn"), seed=0)):
        assert parts_of(whole) == (whole,)


def test_one_category_takes_half_the_steps_of_all_at_cpu(bench: Workbench) -> None:
    table = TABLES["single-category"]
    ours, psgn = (next(row for row in table.rows if row.name == name) for name in ("ours", "PSGN"))
    for profile, share in (("cpu", 0.5), ("full", 1.0)):
        usual = dataclasses.replace(bench, profile=profile, steps=None)
        for row in (ours, psgn):
            config, of_all = table.config(row, usual, seed=0), usual.config(row.change, seed=0)
            assert config.categories == (bench.category,)
            assert config.stage1.steps == share * of_all.stage1.steps
            assert config.stage2.steps == share * of_all.stage2.steps
    assert table.config(ours, bench, seed=0).stage1.steps == bench.steps


def test_tables_share_what_is_trained(bench: Workbench) -> None:
    runs = set((bench.out / "runs").iterdir())
    wanted = {bench.run_of(part) for config in DETERMINISTIC.configs(bench) for part in parts_of(config)}
    assert wanted <= runs
    made = make(TABLES["views"], bench)
    assert set((bench.out / "runs").iterdir()) == runs
    agreed = made["rows"]["4 views"]
    assert agreed["consistency"]["descended"] < agreed["consistency"]["searched"]
    other = dataclasses.replace(bench, steps=2)
    assert not any(other.is_trained(config) for config in TABLES["views"].configs(other))


def test_scores_outlive_their_runs(bench: Workbench, tmp_path: Path) -> None:
    table = dataclasses.replace(TABLES["deterministic"], claims=())
    first = make(table, bench)
    shutil.copytree(bench.out / "scores", tmp_path / "scores")
    elsewhere = dataclasses.replace(bench, out=tmp_path)
    assert make(table, elsewhere) == first
    assert not (tmp_path / "runs").exists()
    for path in (tmp_path / "scores").iterdir():
        path.unlink()
    seeds = [config.seed for config in table.missing(elsewhere)]
    assert seeds == [config.seed for config in table.configs(elsewhere)]
    row = table.rows[0]
    config = table.config(row, bench, seed=0)
    assert not elsewhere.has(lambda asked: row.measure(row, asked, config))
    assert bench.has(lambda asked: row.measure(row, asked, config))
    other = dataclasses.replace(row, codes="agreed as in the paper")
    assert not bench.has(lambda asked: other.measure(other, asked, config))


def test_a_new_field_of_the_configuration_renames_no_run(bench: Workbench) -> None:
    @dataclasses.dataclass(frozen=True)
    class Later(FitConfig):
        invented: int = 7

    config = bench.config(deterministic, seed=0)
    later = Later(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})
    assert bench.run_of(later) == bench.run_of(config)
    assert bench.run_of(dataclasses.replace(later, invented=8)) != bench.run_of(config)
    assert bench.run_of(dataclasses.replace(config, map_size=8)) != bench.run_of(config)


def test_an_interrupted_training_is_finished_to_the_same_weights(bench: Workbench) -> None:
    config = bench.config(deterministic, seed=0)
    run = bench.run_of(config)
    weights = best_weights(run, 2).read_bytes()
    (run / "trained.json").unlink()
    assert not bench.is_trained(config)
    assert bench.train(config) == run
    assert best_weights(run, 2).read_bytes() == weights
    assert json.loads((run / "trained.json").read_text())["continued"]


def test_a_training_of_one_stage_is_told_as_done(bench: Workbench, tmp_path: Path) -> None:
    elsewhere = dataclasses.replace(bench, out=tmp_path)
    config = scaled(elsewhere.config(of_system("psgn"), seed=0), 0.5)
    assert not elsewhere.is_trained(config)
    elsewhere.train(config)
    assert elsewhere.is_trained(config)


def test_other_data_are_another_run(bench: Workbench, tiny_data: Path, tmp_path: Path) -> None:
    config = bench.config(deterministic, seed=0)
    for split in ("train", "val", "test"):
        for path in (tiny_data / "data_list" / split).glob("*.list"):
            target = tmp_path / "data_list" / split / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(path.read_text() + "03001627/another\n")
    assert dataclasses.replace(bench, data=(tmp_path,)).run_of(config).name != bench.run_of(config).name


def test_confidence_is_the_share_of_samples_with_a_gain() -> None:
    random = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 200, generator=random, dtype=torch.float64)
    noise -= noise.mean(1, keepdim=True)
    assert confidence(noise + 1) == 1
    assert confidence(-noise - 1) == 0
    assert 0.35 < confidence(noise) < 0.65
    # Trainings that disagree leave a doubt, however many shapes there are.
    assert confidence(noise * 1e-3 + torch.tensor([[1.0], [1.0], [-1.5]])) < 0.9


def test_a_verdict_says_what_the_numbers_say(bench: Workbench) -> None:
    rows = (Row(name="network", views=4), Row(name="medoid", answer="medoid", views=4))
    pairs = (below("cd", "medoid", "network"), below("cd", "network", "medoid"))
    found = make(Table(name="try", title="Untrained beside the medoid.", rows=rows, claims=pairs), bench)
    verdicts = [claim["verdict"] for claim in found["claims"]]
    assert verdicts in (["holds", "does not hold"], ["does not hold", "holds"], ["undecided", "undecided"])
    gains = [claim["gain"] for claim in found["claims"]]
    assert gains[0] == pytest.approx(-gains[1])
    assert (gains[0] > 0) == (verdicts[0] == "holds") or verdicts[0] == "undecided"


def test_health_compares_what_it_says(tiny_data: Path, tmp_path: Path) -> None:
    bench = Workbench((tiny_data,), tmp_path, "smoke", seeds=1, steps=6, progress=False)
    before = next(overview({"health": EXPERIMENTS["health"]}, bench))
    result = run_experiment("health", bench)
    after = next(overview({"health": EXPERIMENTS["health"]}, bench))
    assert (before.trained, after.trained, after.runs, after.seconds) == (0, len(VARIANTS), len(VARIANTS), 0)
    assert before.seconds is None  # no training of the kind was timed in this directory
    rows = result["trees"][tiny_data.name]
    assert list(rows) == list(VARIANTS)
    usual = rows["as it is"]
    assert all(row["front"] != usual["front"] for name, row in rows.items() if name != "as it is")
    assert f"| as it is | {usual['image'][0]:.2f} |" in (tmp_path / "health.md").read_text()
    assert (tmp_path / "health.png").stat().st_size > 10_000
    assert run_experiment("health", bench) == result


def test_what_health_undoes_is_undone() -> None:
    torch.manual_seed(0)
    images = torch.rand(2, 3, 48, 64)
    seen: list[torch.Tensor] = []
    model = build_generator("smoke")
    (uncentre,) = VARIANTS["images not centred"].network
    uncentre(model)
    first = model.trunk[1]
    assert isinstance(first, torch.nn.Conv2d)
    first.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    model.encode(images)
    torch.testing.assert_close(seen[0], images)
    assert (prepare_images(images, (48, 64)) - images).abs().max() > 0.1

    (initialise,) = VARIANTS["torch's initialisation"].network
    before = first.weight.std()
    initialise(model)
    assert first.weight.std() < 0.8 * before


def test_the_critic_s_opinion_is_that_of_the_log(bench: Workbench, tmp_path: Path) -> None:
    bench = dataclasses.replace(bench, seeds=1)
    result = run_experiment("critic", bench)
    assert set(result["rows"]) == {row.name for row in TABLES["critic"].rows}
    run = bench.run_of(bench.config(with_critic, seed=0))
    scores = [record["fake_score"] for record in read_metrics(run) if "fake_score" in record]
    assert sum(result["opinion"][0]["fake"]) / len(result["opinion"][0]["fake"]) == pytest.approx(
        sum(scores) / len(scores), rel=0.2
    )
    assert (bench.out / "critic-scores.png").stat().st_size > 10_000

    shutil.move(run, tmp_path / run.name)
    assert run_experiment("critic", dataclasses.replace(bench, measures=False)) == result, (
        "opinions outlive runs"
    )


def test_wrong_requests_are_named(bench: Workbench, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="leave --run out"):
        run_experiment("views", bench, run=tmp_path)
    with pytest.raises(UserError, match="--seeds must be at least 1"):
        dataclasses.replace(bench, seeds=0)
    with pytest.raises(UserError, match="--limit must be at least 2"):
        dataclasses.replace(bench, limit=1)
    with pytest.raises(UserError, match="no data at"):
        dataclasses.replace(bench, data=(tmp_path,)).run_of(bench.config(deterministic, seed=0))


@pytest.mark.slow
def test_measurements_side_by_side_are_those_of_one_process(bench: Workbench, tmp_path: Path) -> None:
    table = TABLES["deterministic"]
    calls = [
        (row, table.config(row, bench, seed=0))
        for row in table.rows
        if row.name in ("deterministic", "conditional")
    ]
    bench.train_all([config for _, config in calls])
    (tmp_path / "runs").symlink_to(bench.out / "runs")
    beside = dataclasses.replace(bench, out=tmp_path, processes=2, _loaded={})
    assert not any(beside.has(lambda asked, row=row, c=c: row.measure(row, asked, c)) for row, c in calls)
    beside.measure_all(measured, [*calls, calls[0]])  # what is asked for twice is measured once
    assert len(list((tmp_path / "scores").iterdir())) == 2
    kept = dataclasses.replace(beside, measures=False)
    for row, config in calls:
        scores = row.measure(row, bench, config)
        assert all(scores[name].equal(values) for name, values in row.measure(row, kept, config).items())


@pytest.mark.slow
def test_trainings_side_by_side_have_the_same_bits(bench: Workbench, tmp_path: Path) -> None:
    wanted = [bench.config(deterministic, seed=seed) for seed in (0, 1)]
    beside = dataclasses.replace(bench, out=tmp_path, processes=2)
    beside.train_all(wanted)
    for config in wanted:
        assert beside.is_trained(config)
        for stage in (1, 2):
            weights = best_weights(beside.run_of(config), stage).read_bytes()
            assert weights == best_weights(bench.run_of(config), stage).read_bytes()
    with pytest.raises(UserError, match="asks for"):
        many = dataclasses.replace(wanted[0], stage2=dataclasses.replace(wanted[0].stage2, views=9))
        beside.train_all([many, dataclasses.replace(many, seed=1)])
