"""Generating procedural data: what is written, and that the same seed gives the same bits."""

import pytest

from train.data import ShapeTree, tree_files
from train.data.categories import SYNSET_OF
from train.data.families import FAMILIES
from train.data.procedural import generate
from train.errors import UserError

PAIR = ["chair", "display"]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    out = tmp_path_factory.mktemp("procedural") / "data"
    report = generate(out, shapes=10, categories=PAIR, seed=3, size=48, views=3, processes=1)
    return out, report


def tree_bytes(root):
    return {path.relative_to(root): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_generate_writes_what_it_says(small):
    out, report = small
    assert report.made == 10
    assert "10 shapes" in report.summary()
    trees = [ShapeTree(out, split) for split in tree_files.SPLITS]
    shapes = [shape for tree in trees for shape in tree.iter_valid()]
    assert len(shapes) == 10
    assert not any(tree.skipped for tree in trees)
    assert sorted({shape.category for shape in shapes}) == ["chair", "display"]
    for shape in shapes:
        assert shape.images.shape == (3, 3, 48, 48)
        assert shape.points.shape == (2048, 3)


def test_same_seed_same_bits_with_any_number_of_processes(small, tmp_path):
    out, _ = small
    generate(tmp_path / "again", shapes=10, categories=PAIR, seed=3, size=48, views=3, processes=2)
    assert tree_bytes(tmp_path / "again") == tree_bytes(out)


def test_all_families_are_the_paper_s_and_are_generated_by_default(tmp_path):
    assert sorted(FAMILIES) == sorted(SYNSET_OF)
    report = generate(
        tmp_path / "data", shapes=13, categories=None, seed=0, size=32, views=1, processes=1, variants=3
    )
    assert report.failures == {}
    assert report.made == sum(family.modes for family in FAMILIES.values())
    folders = (tmp_path / "data" / tree_files.RENDERS).glob("*/*")
    assert {folder.name.split("_")[0] for folder in folders} == set(FAMILIES)


def test_other_seed_other_shapes(small, tmp_path):
    generate(tmp_path / "other", shapes=1, categories=["chair"], seed=4, size=48, views=3, processes=1)
    clouds = [next(root.glob("pcdata_2048/*/chair*_000000_*.ply")) for root in (small[0], tmp_path / "other")]
    assert clouds[0].read_bytes() != clouds[1].read_bytes()


def test_a_restarted_run_keeps_what_is_there_and_adds_the_rest(tmp_path):
    arguments = {"categories": ["display"], "seed": 0, "size": 32, "views": 2, "processes": 1}
    generate(tmp_path / "data", shapes=2, **arguments)
    before = tree_bytes(tmp_path / "data" / tree_files.RENDERS)
    report = generate(tmp_path / "data", shapes=3, **arguments)
    assert (report.made, report.kept) == (1, 2)
    after = tree_bytes(tmp_path / "data" / tree_files.RENDERS)
    assert before.items() < after.items()


def test_variants_share_views_of_one_object(tmp_path):
    generate(
        tmp_path / "data", shapes=1, categories=["chair"], seed=0, size=32, views=2, processes=1, variants=3
    )
    folders = sorted((tmp_path / "data" / tree_files.RENDERS).glob("*/*"))
    assert [folder.name[-3:] for folder in folders] == ["_h0", "_h1", "_h2"]
    assert len({(folder / "camera_0.json").read_text() for folder in folders}) == 1
    assert (
        len({tree_files.cloud_file(tmp_path / "data", f"03001627/{f.name}").read_bytes() for f in folders})
        == 3
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"categories": ["hat"]}, "hat.*there are: chair, display"),
        ({"categories": []}, "none given"),
        ({"shapes": 0}, "shapes must be between"),
        ({"seed": -1}, "seed"),
        ({"size": 2}, "size must be"),
    ],
)
def test_wrong_requests_leave_nothing_behind(tmp_path, changes, message):
    arguments = {"shapes": 1, "categories": None, "seed": 0, "size": 32, "views": 1, "processes": 1}
    with pytest.raises(UserError, match=message):
        generate(tmp_path / "data", **(arguments | changes))
    assert not (tmp_path / "data").exists()
