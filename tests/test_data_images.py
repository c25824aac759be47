"""Pictures as cameras and other programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from train.data import images
from train.data.images import decode, is_cut_out, read_images, read_rgba
from train.data.photos import find_photos
from train.errors import UserError
from train.evaluation.reconstruct import image_files


def _picture(mode: str = "RGB", size: tuple[int, int] = (64, 48)) -> Image.Image:
    """A dark square on magenta."""
    picture = Image.new("RGB", size, (255, 0, 255))
    picture.paste((10, 10, 10), (size[0] // 3, size[1] // 3, 2 * size[0] // 3, 2 * size[1] // 3))
    return picture.convert(mode)


def test_one_colour_of_a_png_can_be_transparent(tmp_path: Path) -> None:
    for mode, clear in (("RGB", (255, 0, 255)), ("L", _picture("L").getpixel((0, 0))), ("P", 0)):
        picture = _picture(mode)
        clear = picture.getpixel((0, 0)) if mode == "P" else clear
        picture.save(tmp_path / "a.png", transparency=clear)
        rgba = read_rgba(tmp_path / "a.png")
        assert rgba[0, 0, 3] == 0, mode
        assert rgba[24, 32, 3] == 1, mode
        assert is_cut_out(rgba)
        assert read_images([tmp_path / "a.png"])[0, :, 0, 0].tolist() == [1, 1, 1]


def test_large_photographs_are_read_at_a_reduced_size(tmp_path: Path) -> None:
    _picture(size=(20_000, 10_000)).save(tmp_path / "a.jpg", quality=30)  # Pillow refuses so many pixels
    pixels = decode(tmp_path / "a.jpg")
    assert pixels.shape == (5_000, 10_000, 3)
    assert np.abs(pixels[2_500, 5_000].astype(int) - 10).max() < 8


def test_even_larger_ones_are_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "_LARGEST", 64 * 47)
    _picture().save(tmp_path / "a.png")
    with pytest.raises(UserError, match=r"64 x 48 pixels are too many: make it smaller"):
        read_images([tmp_path / "a.png"])


def test_floats_are_taken_from_0_to_1(tmp_path: Path) -> None:
    values = np.asarray(_picture("L"), np.float32)
    Image.fromarray(values / 255).save(tmp_path / "good.tif")
    assert read_rgba(tmp_path / "good.tif").max() <= 1
    Image.fromarray(values).save(tmp_path / "bad.tif")
    with pytest.raises(
        UserError, match=r"floats from 10 to .* should be between 0 and 1: save it with 8 bits"
    ):
        read_rgba(tmp_path / "bad.tif")


def test_values_of_fewer_bits_than_the_file_has_are_refused_with_the_remedy(tmp_path: Path) -> None:
    values = np.asarray(_picture("L"), np.uint16)
    Image.fromarray(257 * values).save(tmp_path / "a.png")
    assert read_images([tmp_path / "a.png"]).min() < 0.05
    for factor in (1, 16):
        Image.fromarray(factor * values[:48, :48]).save(tmp_path / "a.png")
        with pytest.raises(UserError, match=r"black everywhere; a file of 16 bits .* saved with 8 bits"):
            read_images([tmp_path / "a.png"])


def _swapped_profile() -> bytes:
    """sRGB with red and green exchanged, under another name."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for old, new in ((b"rXYZ", b"_XYZ"), (b"gXYZ", b"rXYZ"), (b"_XYZ", b"gXYZ"), (b"\0s\0R", b"\0t\0R")):
        profile = profile.replace(old, new, 1)
    return profile


@pytest.mark.parametrize(
    ("mode", "suffix"), [("RGB", "jpg"), ("RGB", "png"), ("RGBA", "png"), ("RGB", "webp")]
)
def test_colours_are_those_of_the_profile(mode: str, suffix: str, tmp_path: Path) -> None:
    Image.new(mode, (32, 32), "red").save(tmp_path / f"a.{suffix}", icc_profile=_swapped_profile())
    assert read_rgba(tmp_path / f"a.{suffix}")[16, 16] == pytest.approx([0, 1, 0, 1], abs=0.02)


def test_transparency_stays_where_colours_are_converted(tmp_path: Path) -> None:
    clear = Image.new("RGBA", (32, 32), (255, 0, 0, 51))
    clear.save(tmp_path / "clear.png", icc_profile=_swapped_profile())
    key = Image.new("RGB", (32, 32), "red")
    key.save(tmp_path / "key.png", icc_profile=_swapped_profile(), transparency=(255, 0, 0))
    for name, alpha in (("clear", 0.2), ("key", 0)):
        assert read_rgba(tmp_path / f"{name}.png")[16, 16, 3] == pytest.approx(alpha)


def test_a_broken_profile_is_left_out(tmp_path: Path) -> None:
    for mode, profile in (("RGB", b"none"), ("L", _swapped_profile())):
        Image.new(mode, (32, 32), "white").save(tmp_path / "a.png", icc_profile=profile)
        assert read_rgba(tmp_path / "a.png").min() == 1


@pytest.mark.parametrize("suffix", [".heic", ".AVIF", ".nef"])
def test_formats_of_cameras_are_refused_with_the_remedy(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"a{suffix}").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    with pytest.raises(UserError, match=f"convert {suffix} files to JPEG or PNG first"):
        read_images([tmp_path / f"a{suffix}"])


def test_jfif_files_are_photographs(tmp_path: Path) -> None:
    _picture().save(tmp_path / "a.jfif", format="JPEG")
    found, _ = find_photos(tmp_path)
    assert [photo.path.name for photos in found.values() for photo in photos] == ["a.jfif"]
    assert image_files([tmp_path]) == [tmp_path / "a.jfif"]
