"""Clouds and depth maps survive the way to disk and back."""

import pytest
import torch

from diffpoint import io


def test_depth_maps_come_back_to_half_a_step(tmp_path):
    depth = torch.rand(7, 5, generator=torch.Generator().manual_seed(0)) * 9.9
    depth[2, 3] = torch.inf
    io.write_depth(tmp_path / "d.png", depth)
    again = io.read_depth(tmp_path / "d.png")
    assert torch.isinf(again[2, 3])
    seen = torch.isfinite(depth)
    assert torch.equal(torch.isfinite(again), seen)
    assert (again - depth)[seen].abs().max() <= 10 / 65535 / 2 + 1e-6
    io.write_depth(tmp_path / "d.png", again)
    assert torch.equal(io.read_depth(tmp_path / "d.png"), again)


def test_the_depth_code_is_the_releases():
    code = io.encode_depth(torch.tensor([2.0, torch.inf, 9.9999, 0.0]))
    assert code.tolist() == [13107, 65535, 65534, 0]
    assert io.decode_depth(code)[1] == torch.inf
    assert io.decode_depth(code)[0] == pytest.approx(2.0)


def test_clouds_come_back_to_the_last_bit(tmp_path):
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(0))
    io.write_points(tmp_path / "cloud.ply", points)
    assert torch.equal(io.read_points(tmp_path / "cloud.ply"), points)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]


@pytest.mark.parametrize("suffix", ["ply", "PLY", "xyz", "obj", "glb"])
def test_formats_of_points(suffix, tmp_path):
    points = torch.randn(30, 3, generator=torch.Generator().manual_seed(0))
    io.write_points(tmp_path / f"cloud.{suffix}", points)
    assert torch.allclose(io.read_points(tmp_path / f"cloud.{suffix}"), points, atol=1e-6)


@pytest.mark.parametrize("suffix", ["stl", "off", "gltf", "csv"])
def test_formats_without_points_are_refused(suffix, tmp_path):
    with pytest.raises(ValueError, match=r"write_points: 'path' must end in one of \.ply, \.xyz"):
        io.write_points(tmp_path / f"cloud.{suffix}", torch.zeros(2, 3))
    with pytest.raises(ValueError, match="'points' must hold at least one point"):
        io.write_points(tmp_path / "cloud.ply", torch.zeros(0, 3))
    assert not list(tmp_path.iterdir())


def test_vertices_of_obj_files_are_those_of_the_file(tmp_path):
    corners = [
        [0, 0, 0],
        [1, 0, 0],
        [9, 9, 9],
        [1, 1, 0],
        [0, 1, 0],
    ]  # one is in no face, two have two textures
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", "vt 1 1", "f 5/1 1/1 2/1", "f 1/2 2/2 4/2"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    assert io.read_points(tmp_path / "a.obj").tolist() == corners


def test_what_is_no_cloud_and_no_map_is_refused(tmp_path):
    text = tmp_path / "text.ply"
    text.write_text("nothing of the kind")
    with pytest.raises(ValueError, match=r"read_points: 'path' must name a point cloud; got .*text\.ply"):
        io.read_points(text)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        io.read_points(tmp_path / "missing.ply")
    with pytest.raises(ValueError, match="lie in"):
        io.write_depth(tmp_path / "d.png", torch.full((2, 2), 11.0))
    with pytest.raises(ValueError, match="'points' must be finite"):
        io.write_points(tmp_path / "c.ply", torch.full((2, 3), torch.nan))
    with pytest.raises(TypeError, match=r"encode_depth: 'depth' must be a torch\.Tensor; got ndarray"):
        io.encode_depth(torch.ones(2).numpy())  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"decode_depth: 'code' must be a numpy\.ndarray; got Tensor"):
        io.decode_depth(torch.ones(2))  # pyright: ignore[reportArgumentType]
    import imageio.v3

    imageio.v3.imwrite(tmp_path / "eight.png", torch.zeros(4, 4, dtype=torch.uint8).numpy())
    with pytest.raises(ValueError, match="16-bit image with one channel"):
        io.read_depth(tmp_path / "eight.png")
    assert not list(tmp_path.glob(".*"))
