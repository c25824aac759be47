"""Procedural objects: the front hides the back, the same seed gives the same bits."""

import itertools
import os

import numpy as np
import pytest
from scipy.spatial import KDTree

from train.data import ShapeTree, store
from train.data.families import FAMILIES, MODES
from train.data.procedural import ambiguity, generate, variants_of
from train.data.render import MAX_RADIUS, Renderer, orbit_camera
from train.data.solids import bar, box, sample_union, surface_of
from train.data.work import run_all
from train.errors import UserError

GREY = np.full(3, 0.5)


def chamfer(a, b):
    return KDTree(b).query(a)[0].mean() + KDTree(a).query(b)[0].mean()


@pytest.mark.parametrize("category", FAMILIES)
def test_the_front_hides_the_back(category):
    """Measured here on its own terms, at another size, from views between those that the acceptance uses."""
    azimuths_deg = np.array([-15.0, -8, 0, 8, 15, 180])
    camera = orbit_camera(azimuths_deg, np.full(6, 15.0), 160)
    for seed in range(4):
        variants = variants_of(category, seed)
        assert len(variants) == MODES
        views = [Renderer(surface_of(solids)).render(camera) for solids in variants]
        clouds = [[sample_union(s, 2048, np.random.default_rng(k)) for k in (5, 6)] for s in variants]
        for i, j in itertools.combinations(range(MODES), 2):
            seen = np.isfinite(views[i].depth) | np.isfinite(views[j].depth)
            differs = (views[i].images != views[j].images).any(-1) & seen
            share = differs.sum((1, 2)) / seen.sum((1, 2))
            assert share[:5].max() < 0.01
            assert share[5] > 0.1
            noise = max(chamfer(*clouds[i]), chamfer(*clouds[j]))
            assert chamfer(clouds[i][0], clouds[j][0]) >= 2 * noise
        assert max(np.linalg.norm(s.vertices, axis=1).max() for v in variants for s in v) <= MAX_RADIUS


def test_a_body_that_shows_is_refused():
    plate = box((0.5, 0.4, 0.03), (0, 0, 0), GREY)
    hidden = [plate, box((0.3, 0.25, 0.3), (0, 0, -0.16), GREY)]
    deeper = [plate, box((0.3, 0.25, 0.45), (0, 0, -0.23), GREY)]
    wide = [plate, box((0.6, 0.25, 0.3), (0, 0, -0.16), GREY)]
    assert ambiguity([[plate], hidden]).front < 0.01
    assert not ambiguity([[plate], wide]).accepted
    assert ambiguity([[plate], hidden]).accepted
    assert ambiguity([hidden, hidden]).separation < 1.2
    assert not ambiguity([hidden, deeper, [box((2, 0.1, 0.1), (0, 0, 0), GREY)]]).accepted


def test_colours_and_front_parts_come_from_the_visible_stream_only():
    for category, family in FAMILIES.items():
        first = family(np.random.default_rng(1), np.random.default_rng(2), 2)
        second = family(np.random.default_rng(1), np.random.default_rng(3), 2)
        assert [part.colour.tolist() for part in first] == [part.colour.tolist() for part in second], category
        for a, b in zip(first[:-1], second[:-1], strict=True):  # the body is the last part
            np.testing.assert_array_equal(a.vertices, b.vertices)
        assert not np.array_equal(first[-1].vertices, second[-1].vertices)
        other = family(np.random.default_rng(9), np.random.default_rng(2), 2)
        assert not np.array_equal(first[0].vertices, other[0].vertices)


def test_union_samples_are_uniform_and_outside():
    cubes = [box((0.4, 0.4, 0.4), (0, 0, 0), GREY), box((0.4, 0.4, 0.4), (0.2, 0, 0), GREY)]
    points = sample_union(cubes, 4000, np.random.default_rng(0))
    inside_first = (np.abs(points) < 0.2 - 1e-5).all(1)
    inside_second = (np.abs(points - (0.2, 0, 0)) < 0.2 - 1e-5).all(1)
    assert not (inside_first | inside_second).any()
    ends = (np.abs(points[:, 0] - 0.1) > 0.3 - 1e-6).mean()
    # Ends 2 x 0.16; the flush sides of the overlap count twice: 4 x 0.4 x (0.2 + 2 x 0.2 + 0.2).
    assert ends == pytest.approx(0.32 / (0.32 + 4 * 0.4 * 0.8), abs=0.03)


def test_a_bar_is_closed_and_as_long_as_asked():
    rod = bar((0, 0, 0), (0.3, 0.4, 0), 0.05, GREY, sides=64)
    a, b, c = (rod.vertices[rod.faces[:, k]] for k in range(3))
    volume = np.einsum("fc,fc->f", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(np.pi * 0.05**2 * 0.5, rel=0.01)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    out = tmp_path_factory.mktemp("procedural") / "data"
    report = generate(out, shapes=10, categories=None, seed=3, size=48, views=3, processes=1)
    return out, report


def tree_bytes(root):
    return {path.relative_to(root): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_generate_writes_what_it_says(small):
    out, report = small
    assert report.made == 10
    assert "10 shapes" in report.summary()
    trees = [ShapeTree(out, split) for split in store.SPLITS]
    shapes = [shape for tree in trees for shape in tree.iter_valid()]
    assert len(shapes) == 10
    assert not any(tree.skipped for tree in trees)
    assert sorted({shape.category for shape in shapes}) == ["chair", "display"]
    for shape in shapes:
        assert shape.images.shape == (3, 3, 48, 48)
        assert shape.points.shape == (2048, 3)


def test_same_seed_same_bits_with_any_number_of_processes(small, tmp_path):
    out, _ = small
    generate(tmp_path / "again", shapes=10, categories=None, seed=3, size=48, views=3, processes=2)
    assert tree_bytes(tmp_path / "again") == tree_bytes(out)


def test_other_seed_other_shapes(small, tmp_path):
    generate(tmp_path / "other", shapes=1, categories=["chair"], seed=4, size=48, views=3, processes=1)
    clouds = [next(root.glob("pcdata_2048/*/chair*_000000_*.ply")) for root in (small[0], tmp_path / "other")]
    assert clouds[0].read_bytes() != clouds[1].read_bytes()


def test_a_restarted_run_keeps_what_is_there_and_adds_the_rest(tmp_path):
    arguments = {"categories": ["display"], "seed": 0, "size": 32, "views": 2, "processes": 1}
    generate(tmp_path / "data", shapes=2, **arguments)
    before = tree_bytes(tmp_path / "data" / store.RENDERS)
    report = generate(tmp_path / "data", shapes=3, **arguments)
    assert (report.made, report.kept) == (1, 2)
    after = tree_bytes(tmp_path / "data" / store.RENDERS)
    assert before.items() < after.items()


def test_variants_share_views_of_one_object(tmp_path):
    generate(
        tmp_path / "data", shapes=1, categories=["chair"], seed=0, size=32, views=2, processes=1, variants=3
    )
    folders = sorted((tmp_path / "data" / store.RENDERS).glob("*/*"))
    assert [folder.name[-3:] for folder in folders] == ["_h0", "_h1", "_h2"]
    assert len({(folder / "camera_0.json").read_text() for folder in folders}) == 1
    assert len({store.cloud_file(tmp_path / "data", f"03001627/{f.name}").read_bytes() for f in folders}) == 3


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


def die_on_two(job):
    if job == 2:
        os._exit(1)
    return job * 10


def test_a_process_that_dies_takes_no_other_job_with_it():
    results = dict(run_all(die_on_two, list(range(3)), processes=2, desc="dying", unit="job"))
    assert isinstance(results.pop(2), OSError)
    assert results == {0: 0, 1: 10}
