"""Label files may turn a model, after the turn that its library asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from train.data.mesh_sources import Label, MeshFile, keep_labelled, read_labels
from train.errors import UserError

SHIPPED = Path(__file__).parents[1] / "train" / "data" / "furniture_labels.csv"


def _read(path: Path, *turns: str) -> list[Label]:
    lines = [f"a.zip,m{i}.obj,chair,{turn}\n" for i, turn in enumerate(turns)]
    path.write_text("library,model,category,turn\n" + "".join(lines))
    return read_labels(path)


def _matrix(rotation: tuple[float, ...] | None) -> np.ndarray:
    assert rotation is not None
    return np.reshape(rotation, (3, 3))


def test_turns_are_right_handed_about_an_axis(tmp_path: Path) -> None:
    none, about_x, about_y, half = _read(tmp_path / "labels.csv", "", "x90", "y-90", " y180")
    assert none.turn is None
    lying = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # the head, the face, and the right-hand side
    standing = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    assert np.array_equal(lying @ _matrix(about_x.turn).T, standing)
    assert np.array_equal(_matrix(about_y.turn) @ [1, 0, 0], [0, 0, 1])
    assert np.array_equal(_matrix(half.turn), np.diag([-1, 1, -1]))


def test_a_turn_follows_the_library_s_own_rotation(tmp_path: Path) -> None:
    labels = _read(tmp_path / "labels.csv", "y90", "y90", "")
    own = tuple(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).ravel())  # z up -> y up
    meshes = [
        MeshFile(Path(f"m{i}.obj"), "a.zip", f"m{i}.obj", "unknown", rotation)
        for i, rotation in enumerate((own, None, own))
    ]
    (both, turn, rotation), absent = keep_labelled(meshes, labels, tmp_path / "labels.csv")
    assert not absent
    assert np.array_equal(_matrix(both.rotation) @ [0, 0, 1], [0, 1, 0])  # up, which a turn about y leaves
    assert np.array_equal(_matrix(both.rotation) @ [1, 0, 0], [0, 0, -1])
    assert turn.rotation == labels[1].turn
    assert rotation.rotation == own


@pytest.mark.parametrize("turn", ["90", "w90", "x90.5", "yaw"])
def test_a_turn_that_is_none_is_named(tmp_path: Path, turn: str) -> None:
    with pytest.raises(
        UserError, match=r"labels\.csv: m0\.obj: the turn .* is no axis and degrees such as y90"
    ):
        _read(tmp_path / "labels.csv", turn)


def test_the_shipped_telephones_stand_up() -> None:
    turned = {label.model.split("/")[-1]: label for label in read_labels(SHIPPED) if label.turn is not None}
    for model in ("iphone.obj", "mobile.obj"):
        assert np.array_equal(_matrix(turned[model].turn) @ [0, 1, 0], [0, 0, 1])
