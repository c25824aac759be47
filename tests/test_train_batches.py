"""Data in memory: shrunken depth maps keep exact geometry, samplers continue, broken shapes are left out."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from diffpoint import PinholeCamera, unproject
from train.data.batches import Sampler, load_split
from train.data.procedural import generate
from train.data.shrink import decimate_depth, min_pool_depth
from train.errors import UserError


def _slope(side: int) -> tuple[torch.Tensor, PinholeCamera]:
    """A tilted plane with a hole, seen by two cameras; depth in float32 at pixel centres."""
    eyes = torch.tensor([[0.0, 0.4, -2.0], [0.5, -0.2, -1.9]])
    camera = PinholeCamera.look_at(eyes, focal_px=1.9 * side, height=side, width=side)
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    depth = 2 + 0.01 * rows + 0.003 * columns
    depth[: side // 3, : side // 4] = float("inf")
    return depth.expand(2, side, side).clone(), camera


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_decimation_keeps_points_at_their_exact_places(factor: int) -> None:
    side = 12 * factor
    depth, camera = _slope(side)
    small = decimate_depth(depth, camera, size=12)
    fine = unproject(depth[None], camera)
    coarse = unproject(small.depth[None], small.camera)
    assert coarse.lengths.tolist() == [[12 * 12 - 4 * 3] * 2]
    for view in range(2):
        a = coarse.points[0, view, : coarse.lengths[0, view]]
        b = fine.points[0, view, : fine.lengths[0, view]]
        assert torch.cdist(a.double(), b.double()).amin(1).max() < 2e-6


def test_min_pool_keeps_the_nearest_depth_of_each_block() -> None:
    depth, camera = _slope(24)
    small = min_pool_depth(depth, camera, size=12)
    assert small.depth[0, 6, 6] == depth[0, 12:14, 12:14].min()
    assert small.depth[0, 0, 0] == torch.inf
    assert torch.equal(small.camera.K[:, :2] * 2, camera.K[:, :2])


def test_a_map_size_that_does_not_divide_is_refused(tiny_data: Path) -> None:
    with pytest.raises(UserError, match="64 pixels wide, not a multiple of the map size 28"):
        load_split(tiny_data, "train", image_size=(48, 64), map_size=28, progress=False)


def test_a_split_in_memory_agrees_with_itself(tiny_data: Path) -> None:
    """Ground truth points, seen through the small maps' cameras, lie in the silhouette or one pixel beside
    it."""
    split = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, progress=False)
    batch = split.batch(torch.arange(len(split)), torch.arange(4).expand(len(split), -1))
    assert batch.images.shape == (len(split), 4, 3, 48, 64)
    assert 0 <= batch.images.min() < 0.5
    assert batch.images.max() == 1
    cam = torch.einsum("mvij,mpj->mvpi", batch.camera.cam_from_world[..., :3, :3], split.points)
    cam = cam + batch.camera.cam_from_world[..., None, :3, 3]
    pixels = torch.einsum("mvij,mvpj->mvpi", batch.camera.K, cam / cam[..., 2:])[..., :2].floor().long()
    inside = torch.nn.functional.max_pool2d(batch.depth.isfinite().float(), 3, 1, 1).bool()
    hit = inside.flatten(2).gather(2, (pixels[..., 1] * 16 + pixels[..., 0]).clamp(0, 255))
    assert hit.float().mean() > 0.99


def test_broken_shapes_are_named_and_left_out(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "broken"
    shutil.copytree(tiny_data, root)
    whole = load_split(root, "train", image_size=(48, 64), map_size=16, progress=False)
    (root / "rendered-shapenet" / whole.ids[0] / "depth_1.png").write_bytes(b"no picture")
    (root / "rendered-shapenet" / whole.ids[1] / "render_3.png").unlink()
    rest = load_split(root, "train", image_size=(48, 64), map_size=16, progress=False)
    assert rest.ids == whole.ids[2:]
    complaint = capsys.readouterr().err
    assert whole.ids[0] in complaint
    assert whole.ids[1] in complaint
    assert rest.fingerprint != whole.fingerprint


def test_a_limit_takes_shapes_from_the_whole_list(tiny_data: Path) -> None:
    some = load_split(tiny_data, "train", image_size=(48, 64), map_size=16, limit=4, progress=False)
    assert len(some) == 4
    assert set(some.categories) == {"chair", "display"}


def test_several_trees_are_put_together_whatever_the_size_of_their_renders(
    tiny_data: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    generate(other, shapes=5, categories=["table"], seed=1, size=96, views=4, processes=1)
    both = load_split([tiny_data, other], "train", image_size=(48, 64), map_size=16, progress=False)
    alone = [
        load_split(root, "train", image_size=(48, 64), map_size=16, progress=False)
        for root in (tiny_data, other)
    ]
    assert both.ids == alone[0].ids + alone[1].ids
    assert torch.equal(
        torch.stack([depth[:] for depth in both.depth]),
        torch.stack([depth[:] for split in alone for depth in split.depth]),
    )
    few = load_split([tiny_data, other], "train", image_size=(48, 64), map_size=16, limit=4, progress=False)
    assert set(few.categories) == set(both.categories)


def test_the_sampler_repeats_no_shape_and_continues_from_its_state() -> None:
    sampler = Sampler(5, 4, seed=1)
    sampler.draw(3, 2)
    state = sampler.state()
    drawn = [sampler.draw(5, 4) for _ in range(3)]
    for shapes, views in drawn:
        assert sorted(shapes.tolist()) == [0, 1, 2, 3, 4]
        assert all(sorted(row) == [0, 1, 2, 3] for row in views.tolist())
    other = Sampler(5, 4, seed=2)
    other.restore(state)
    for (shapes, views), (shapes_again, views_again) in zip(
        drawn, [other.draw(5, 4) for _ in range(3)], strict=True
    ):
        assert torch.equal(shapes, shapes_again)
        assert torch.equal(views, views_again)


def test_a_split_smaller_than_the_batch_repeats_its_shapes() -> None:
    shapes, _ = Sampler(1, 2, seed=0).draw(3, 2)
    assert shapes.tolist() == [0, 0, 0]
