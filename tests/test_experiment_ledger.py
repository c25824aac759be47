"""All experiments together: what is listed is so, what is done stays done, one that fails stops no other."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from train.config import FitConfig
from train.errors import UserError
from train.experiments.ledger import Experiment, answer, answer_all, is_done, list_lines, overview
from train.experiments.paper import TABLES, deterministic, second_stage_without_diversity, without_critic
from train.experiments.registry import ABOUT_ALL, QUESTIONS
from train.experiments.run import EXPERIMENTS, Workbench, write_page
from train.experiments.table import markdown
from train.experiments.workbench import stage1_of


def _shared(bench: Workbench) -> list[FitConfig]:
    return [bench.config(without_critic, seed=seed) for seed in range(bench.seeds)]


def _variant(bench: Workbench) -> list[FitConfig]:
    return [second_stage_without_diversity(config) for config in _shared(bench)]


def _write(name: str, *, fails: bool = False) -> Any:
    def make(bench: Workbench) -> dict[str, Any]:
        if fails:
            raise UserError("no luck")
        claims = [{"words": "a < b", "gain": 0.5, "paper_gain": None, "confidence": 0.95, "verdict": "holds"}]
        result = {
            "profile": bench.profile,
            "data": ["somewhere/tiny"],
            "seeds": bench.seeds,
            "claims": claims,
        }
        for kind, text in (("json", json.dumps(result)), ("md", f"what {name} found\n"), ("png", "picture")):
            (bench.out / f"{name}.{kind}").write_text(text)
        return {}

    return make


@pytest.fixture
def bench(tiny_data: Path, tmp_path: Path) -> Workbench:
    out = tmp_path / "answers"
    out.mkdir()
    return Workbench((tiny_data,), out, "smoke", seeds=1, steps=2, limit=4, progress=False)


def test_every_question_has_an_experiment() -> None:
    assert set(EXPERIMENTS) == set(QUESTIONS)
    assert not set(QUESTIONS) & set(ABOUT_ALL)


def test_what_is_listed_is_so(bench: Workbench) -> None:
    experiments = {
        "views": Experiment(_write("views"), _shared),
        "ablation": Experiment(_write("ablation"), _variant),
    }
    first, second = overview(experiments, bench)
    assert [first[:4], second[:4]] == [("views", False, 0, 2), ("ablation", False, 0, 2)]
    assert first.seconds is None  # nothing of the kind was timed yet

    bench.train(stage1_of(_shared(bench)[0]))
    run = bench.run_of(stage1_of(_shared(bench)[0]))
    (run / "trained.json").write_text(json.dumps({"seconds": 8, "continued": False}))
    first, second = overview(experiments, bench)
    assert (first.trained, second.trained) == (1, 1)

    bench.train(_shared(bench)[0])
    run = bench.run_of(_shared(bench)[0])
    (run / "trained.json").write_text(json.dumps({"seconds": 20, "continued": False}))
    first, second = overview(experiments, bench)
    assert (first.trained, first.seconds, first.whole) == (2, 0, 28)
    assert (second.trained, second.seconds) == (
        1,
        20,
    )  # two steps of stage 2, as long as those that were timed
    lines = list_lines([first, second], QUESTIONS, processes=2)
    assert "2/2 runs" in lines[0]
    assert QUESTIONS["views"] in lines[0]
    assert lines[-1].startswith("trainings that are missing: 0 min")


def test_a_missing_run_is_counted_once(bench: Workbench) -> None:
    both = {
        "views": Experiment(_write("views"), _shared),
        "ablation": Experiment(_write("ablation"), _shared),
    }
    cpu = dataclasses.replace(bench, profile="cpu", steps=1000)
    first, second = overview(both, cpu)
    assert first.seconds is not None
    assert first.seconds > 60
    assert second.seconds == 0


def test_what_is_done_stays_done_and_what_fails_stops_no_other(
    bench: Workbench, capsys: pytest.CaptureFixture[str]
) -> None:
    experiments = {
        "views": Experiment(_write("views"), lambda bench: []),
        "health": Experiment(_write("health", fails=True), lambda bench: []),
        "ablation": Experiment(_write("ablation"), lambda bench: []),
    }
    with pytest.raises(UserError, match="2 made; these could not be: health: no luck"):
        answer_all(experiments, bench)
    del experiments["health"]
    before = {path: path.stat().st_mtime_ns for path in bench.out.rglob("*")}
    assert answer_all(experiments, bench) == []
    assert {path: path.stat().st_mtime_ns for path in bench.out.rglob("*")} == before
    # Other seeds are another answer, and so is one whose picture is gone.
    views = experiments["views"]
    assert not is_done("views", views, dataclasses.replace(bench, seeds=2))
    assert is_done("views", views, bench)
    (bench.out / "views.png").unlink()
    assert not is_done("views", views, bench)
    capsys.readouterr()
    assert answer_all(experiments, dataclasses.replace(bench, progress=True)) == ["views"]
    assert capsys.readouterr().err == "-- views\n-- views: made in 0 min\n"


def test_what_an_answer_was_made_from_belongs_to_it(bench: Workbench) -> None:
    plain = Experiment(_write("views"), lambda bench: [bench.config(without_critic, seed=0)])
    answer_all({"views": plain}, bench)
    assert is_done("views", plain, bench)
    other = Experiment(_write("views"), lambda bench: [bench.config(deterministic, seed=0)])
    assert not is_done("views", other, bench)


def test_other_photographs_are_another_answer(bench: Workbench, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    (pictures / "chair").mkdir(parents=True)
    (pictures / "chair" / "1.png").write_bytes(b"one")
    of = {"photos": Experiment(_write("photos"), lambda bench: [], EXPERIMENTS["photos"].files)}
    shown = dataclasses.replace(bench, pictures=pictures)
    plain = {"views": Experiment(_write("views"), lambda bench: [])}
    answer_all(of | plain, shown)
    assert answer_all(of | plain, shown) == []
    (pictures / "chair" / "1.png").write_bytes(b"two")
    assert answer_all(of | plain, shown) == ["photos"]
    # What is about neither photographs nor one category stays as it is.
    assert answer_all(plain, dataclasses.replace(bench, category="display")) == []
    single = EXPERIMENTS["single-category"]
    answer("single-category", Experiment(_write("single-category"), single.configs), bench)
    assert is_done("single-category", single, bench)
    assert not is_done("single-category", single, dataclasses.replace(bench, category="display"))


def test_what_needs_no_data_is_made_without(tmp_path: Path) -> None:
    bench = Workbench((), tmp_path, "smoke")
    experiment = Experiment(_write("runtime"), _shared)
    answer("runtime", experiment, bench)
    assert is_done("runtime", experiment, bench)
    assert not is_done("runtime", experiment, dataclasses.replace(bench, data=(Path("meshes.zip"),)))


def test_without_data_nothing_is_listed(tmp_path: Path) -> None:
    for data in ((), (tmp_path,)):
        with pytest.raises(UserError, match="no data"):
            list(overview({}, Workbench(data, tmp_path, "smoke")))


def test_the_published_page_is_made_of_what_was_measured(tmp_path: Path) -> None:
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
            assert set(result["rows"]) <= {row.name for row in table.rows}


def test_one_page_of_all_answers(bench: Workbench) -> None:
    answer_all({"views": Experiment(_write("views"), lambda bench: [])}, bench)
    (bench.out / "views.reading.md").write_text("More views are better.\n")
    (bench.out / "views-more.png").write_text("picture")
    page = write_page(bench.out)
    assert page == bench.out.parent / "answers.md"
    text = page.read_text()
    assert "| views | a < b | +0.50 |  | 95.0% | holds |" in text
    order = [
        QUESTIONS["views"], "what views found", "More views are better.", "answers/views.png", "answers/views-more.png",
        "experiment views --data tiny --out OUT --profile smoke --seeds 1",
    ]  # fmt: skip
    places = [text.index(words) for words in order]
    assert places == sorted(places)
    with pytest.raises(UserError, match="holds no answers"):
        write_page(bench.out / "done")
