"""Photographs become pictures of the object alone: by mask, by transparency, or from a plain background."""

import contextlib
import io
import json
import shutil

import numpy as np
import photographs
import pytest
from PIL import Image

from models import build_generator
from train.__main__ import main
from train.data.cutout import FILL, NotPlain, cut_out, find_foreground
from train.data.images import read_rgba
from train.data.photos import convert_photos, find_photos
from train.errors import UserError
from train.evaluation.reconstruct import image_files, read_pictures
from train.methods.weights import save_weights

WHITE, CREAM, BLUE = (0.95, 0.95, 0.94), (0.93, 0.9, 0.82), (0.75, 0.82, 0.9)


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def read_mask(path):
    return np.asarray(Image.open(path)) >= 128


def box_of(mask):
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1


def inked(picture):
    """What is not white in a picture (H, W, 3)."""
    return (np.asarray(picture) < 250).any(2)


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """Three folders of photographs: shadows, uneven light, noise, objects anywhere in the frame, JPEG of 60 to 85.

    Half of the parts are light grey, as on white paper they are hard to see. The true masks come with them.
    """
    root = tmp_path_factory.mktemp("studio")
    masks = {}
    for number, (category, paper, light_grey) in enumerate(
        [("chair", WHITE, True), ("table", CREAM, False), ("lamp", BLUE, True)]
    ):
        surface = photographs.surface_for(category, 100 + number, light_grey=light_grey)
        for view, quality in enumerate((60, 85)):
            rng = np.random.default_rng([number, view])
            photo = photographs.take(
                surface,
                rng,
                paper=paper,
                shadow=rng.uniform(0.25, 0.5),
                gradient=rng.uniform(0.05, 0.2),
                object_px=int(rng.integers(430, 650)),
                azimuth_deg=30 + 110 * view,
                elevation_deg=rng.uniform(8, 30),
            )
            path = root / category / f"{view}.jpg"
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(photographs.as_jpeg(photo, quality))
            masks[path.relative_to(root)] = photo.mask
    return root, masks


@pytest.fixture(scope="module")
def cut(studio, tmp_path_factory):
    """All of them, cut out, and what the command prints."""
    out = tmp_path_factory.mktemp("cut") / "out"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["data", "photos", str(studio[0]), "--out", str(out)]) == 0
    return out, printed.getvalue()


def test_objects_on_plain_paper_are_cut_out_at_the_scale_of_training(studio, cut):
    out, said = cut
    assert "cut 6 photographs out (6 by plain background); 3 objects" in said
    assert "chair/0.jpg: plain background of colour (2" in said
    overlaps = {}
    for path, mask in studio[1].items():
        found = read_mask(out / path.parent / "masks" / f"{path.stem}.png")
        assert found.shape == mask.shape
        overlaps[str(path)] = overlap(found, mask)
        with Image.open(out / path.with_suffix(".png")) as picture:
            assert (picture.size, picture.mode) == ((224, 224), "RGB")
            tall, wide = box_of(inked(picture))
            assert np.hypot(tall, wide) / 224 == pytest.approx(FILL, abs=0.03) or max(tall, wide) / 224 > 0.9
            assert np.asarray(picture)[:3].min() == 255
    assert min(overlaps.values()) > 0.95, overlaps


def test_reconstruct_takes_cut_outs_as_they_are_and_cuts_photographs_out(studio, cut, tmp_path, capsys):
    weights = tmp_path / "weights.safetensors"
    save_weights(build_generator("smoke"), weights)
    photo = studio[0] / "table" / "0.jpg"
    for pictures in ([cut[0] / "chair" / f"{view}.png" for view in range(2)], [photo]):
        out = tmp_path / pictures[0].stem / pictures[0].suffix
        words = ["reconstruct", weights, *pictures, "--steps", "0", "--out", out]
        assert main([str(word) for word in words]) == 0
        said = capsys.readouterr().err
        assert (f"note: {photo}: cut out: plain background of colour" in said) == (pictures == [photo])
        assert ("note" in said) == (pictures == [photo])
        assert (out / "reconstruction.ply").is_file()


def disc(size=240, radius=70, centre=(120, 120)):
    y, x = np.mgrid[0:size, 0:size]
    return (y - centre[0]) ** 2 + (x - centre[1]) ** 2 < radius**2


def plain_with_disc():
    pixels = np.full((60, 60, 3), 240, np.uint8)
    pixels[disc(60, 18, (30, 30))] = (120, 60, 20)
    return Image.fromarray(pixels)


def lawn(size=240):
    """Noise in green, and a red disc."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(40, 180, (size, size, 3)).astype(np.uint8)
    pixels[..., 1] |= 128
    pixels[disc(size)] = (200, 30, 30)
    return pixels


def test_a_given_mask_goes_first_then_alpha(tmp_path):
    source, mask = tmp_path / "in", disc()
    for name in ("beside", "folder", "clear", "both"):
        (source / name).mkdir(parents=True)
    Image.fromarray(lawn()).save(source / "beside" / "a.png")
    Image.fromarray(mask).save(source / "beside" / "a_mask.png")
    Image.fromarray(lawn()).save(source / "folder" / "a.jpg")
    (source / "folder" / "masks").mkdir()
    Image.fromarray(mask.astype(np.uint8) * 255).save(source / "folder" / "masks" / "a.png")
    cut = np.dstack((lawn(), mask.astype(np.uint8) * 255))
    Image.fromarray(cut, "RGBA").save(source / "clear" / "a.png")
    smaller = disc(radius=40)
    Image.fromarray(cut, "RGBA").save(source / "both" / "a.png")
    Image.fromarray(smaller).save(source / "both" / "a_mask.png")
    report = convert_photos(source, tmp_path / "out", processes=1)
    assert report.failures == {}
    assert report.ways == {"mask": 3, "alpha": 1}
    for name, wanted in (("beside", mask), ("folder", mask), ("clear", mask), ("both", smaller)):
        assert np.array_equal(read_mask(tmp_path / "out" / name / "masks" / "a.png"), wanted), name
        picture = np.asarray(Image.open(tmp_path / "out" / name / "a.png"))
        assert np.hypot(*box_of(inked(picture))) / 224 == pytest.approx(FILL, abs=0.03)
        assert np.abs(picture[112, 112].astype(int) - (200, 30, 30)).max() < 6


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("A_mask.PNG", "grey"),
        ("a_MASK.png", "grey"),
        ("Masks/a.png", "grey"),
        ("a_mask.png", "0 and 1"),
        ("a_mask.png", "16 bits"),
        ("a_mask.png", "palette"),
    ],
)
def test_masks_of_other_programs(name, values, tmp_path):
    source, mask = tmp_path / "in", disc().astype(np.uint8)
    (source / name).parent.mkdir(parents=True)
    Image.fromarray(lawn()).save(source / "a.jpg")
    palette = Image.fromarray(mask)
    palette.putpalette([0, 0, 0, 128, 0, 0])
    made = {"grey": mask * 255, "0 and 1": mask, "16 bits": mask.astype(np.uint16) * 255}
    picture = palette if values == "palette" else Image.fromarray(made[values])
    picture.save(source / name, format="PNG")
    assert convert_photos(source, tmp_path / "out", processes=1).ways == {"mask": 1}
    assert np.array_equal(read_mask(tmp_path / "out" / "in" / "masks" / "a.png"), disc())
    # reconstruct takes the same masks, and they are no pictures of the object.
    (source / "._a.jpg").write_bytes(b"what macOS notes of the file")
    assert image_files([source]) == [source / "a.jpg"]
    red, green, _ = read_pictures([source / "a.jpg"])[0, :, 112, 112].tolist()
    assert red > 0.7 > 0.2 > green
    assert read_pictures([source / "a.jpg"])[0, :, 0, 0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("height", "width", "remedy"),
    [(100, 100, "make them the same size"), (240, 120, "turn the mask upright")],
)
def test_reconstruct_refuses_a_mask_that_does_not_fit(height, width, remedy, tmp_path):
    Image.fromarray(lawn()[:120]).save(tmp_path / "a.jpg")
    Image.fromarray(disc()[:height, :width]).save(tmp_path / "a_mask.png")
    said = rf"a\.jpg: its mask is {width} x {height} pixels, the photograph 240 x 120; {remedy}"
    with pytest.raises(UserError, match=said):
        read_pictures([tmp_path / "a.jpg"])


def test_a_mask_that_came_out_can_be_corrected_and_given_back(studio, cut, tmp_path):
    shutil.copytree(studio[0] / "chair", tmp_path / "in" / "chair")
    shutil.copytree(cut[0] / "chair" / "masks", tmp_path / "in" / "chair" / "masks")
    report = convert_photos(str(tmp_path / "in"), str(tmp_path / "out"), processes=1)
    assert report.ways == {"mask": 2}
    for view in range(2):
        once, again = (root / "chair" / "masks" / f"{view}.png" for root in (cut[0], tmp_path / "out"))
        assert np.array_equal(read_mask(once), read_mask(again))


def test_what_cannot_be_used_is_named_with_a_hint_and_the_rest_is_made(tmp_path, capsys):
    source = tmp_path / "in"
    (source / "mug").mkdir(parents=True)
    plain = np.full((240, 240, 3), 235, np.uint8)
    Image.fromarray(plain).save(source / "mug" / "nothing.png")
    plain[disc()] = (30, 90, 160)
    Image.fromarray(plain).save(source / "mug" / "good.png")
    Image.fromarray(lawn()).save(source / "mug" / "lawn.jpg")
    whole = (source / "mug" / "good.png").read_bytes()
    (source / "mug" / "half.png").write_bytes(whole[: len(whole) // 2])
    (source / "mug" / "text.jpg").write_text("hello")
    (source / "mug" / "phone.heic").write_bytes(b"x")
    Image.fromarray(plain).save(source / "mug" / "odd.png")
    Image.fromarray(disc(100, 30, (50, 50))).save(source / "mug" / "odd_mask.png")
    clear = np.dstack((plain, np.zeros((240, 240), np.uint8)))
    Image.fromarray(clear, "RGBA").save(source / "mug" / "clear.png")
    assert main(["data", "photos", str(source), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "cut 1 photographs out (1 by plain background); 1 object\n" in said
    assert "7 photographs were left out:" in said
    for name, reason in {
        "nothing.png": "the background is not plain: nothing stands out",
        "lawn.jpg": "the background is not plain: .* on plain paper, make the rest transparent, or give a mask",
        "half.png": "not an image that can be read",
        "text.jpg": "not an image that can be read",
        "phone.heic": "save it as JPEG or PNG",
        "odd.png": "its mask is 100 x 100 pixels, the photograph 240 x 240",
        "clear.png": "shows nothing: its alpha is empty",
    }.items():
        lines = [line for line in said.splitlines() if f"mug/{name}: " in line]
        assert len(lines) == 1, (name, said)
        assert all(part in lines[0] for part in reason.split(" .* ")), lines
    assert sorted(path.name for path in (tmp_path / "out" / "mug").glob("*.png")) == ["good.png"]
    for path in (source / "mug").iterdir():
        if path.name not in ("half.png", "text.jpg"):
            path.unlink()
    with pytest.raises(UserError, match=r"no photograph can be used; mug/.*\(and 1 others\)"):
        convert_photos(source, tmp_path / "none", processes=1)
    assert not (tmp_path / "none").exists()


def test_backgrounds_that_are_not_plain_are_refused():
    y, x = np.mgrid[0:240, 0:320] / 240
    object_ = np.hypot(y - 0.5, x - 0.6) < 0.2
    stripes = np.repeat((0.5 + 0.4 * np.sign(np.sin(20 * x)))[..., None], 3, 2)
    halves = np.where((x > 0.66)[..., None], (0.9, 0.9, 0.9), (0.2, 0.3, 0.6))
    rng = np.random.default_rng(0)
    rings = 0.15 * np.sin(40 * x + 3 * np.sin(9 * y))[..., None] * (1.0, 0.8, 0.6)
    wood = 0.5 + rings + rng.normal(0, 0.02, (240, 320, 3))
    for pixels, said in (
        (stripes, "two backgrounds"),
        (halves, "two backgrounds"),
        (wood, "border|backgrounds"),
    ):
        pixels = pixels.copy()
        pixels[object_] = (0.8, 0.1, 0.1)
        with pytest.raises(NotPlain, match=said):
            find_foreground(pixels)


def test_an_object_at_the_edge_is_said_to_be_cut_off_and_holes_stay_open():
    pixels = np.full((240, 240, 3), 0.9)
    ring = disc(240, 80, (150, 60)) & ~disc(240, 40, (150, 60))
    pixels[ring] = (0.2, 0.5, 0.3)
    found = find_foreground(pixels)
    assert found.cut == ("left",)
    assert overlap(found.mask, ring) > 0.98
    assert "cut off at the left" in cut_out(np.dstack((pixels, np.ones((240, 240))))).found


def test_a_small_object_in_a_large_photograph_is_looked_at_again():
    surface = photographs.surface_for("chair", 102)
    photo = photographs.take(surface, np.random.default_rng(3), object_px=340, frame_px=(1200, 1600))
    with Image.open(io.BytesIO(photographs.as_jpeg(photo, 80))) as image:
        pixels = np.asarray(image, np.float32) / 255
    found = cut_out(np.dstack((pixels, np.ones(pixels.shape[:2], np.float32))))
    assert overlap(found.mask, photo.mask) > 0.95


def test_stanford_online_products_are_read_by_listing(tmp_path):
    source = tmp_path / "Stanford_Online_Products"
    for super_class, names in {
        "chair_final": ("111_0.JPG", "111_1.JPG", "111_2.JPG", "222_0.JPG"),
        "sofa_final": ("111_0.JPG",),
    }.items():
        (source / super_class).mkdir(parents=True)
        for name in names:
            plain_with_disc().save(source / super_class / name, quality=90)
    (source / "Ebay_info.txt").write_text("image_id class_id super_class_id path\n")
    names = {name: len(photos) for name, photos in find_photos(source)[0].items()}
    assert names == {"chair/111": 3, "chair/222": 1, "sofa/111": 1}
    assert set(find_photos(source / "chair_final")[0]) == {"111", "222"}
    report = convert_photos(source, tmp_path / "out", fewest=3, processes=1)
    assert list(report.found) == ["chair/111/111_0.JPG", "chair/111/111_1.JPG", "chair/111/111_2.JPG"]
    assert (tmp_path / "out" / "chair" / "111" / "111_2.png").is_file()


def test_a_folder_of_pictures_is_one_object_and_names_may_be_anything(tmp_path):
    source = tmp_path / "my møbel"
    source.mkdir()
    for name in ("forfra på gulvet.png", "a.png", "a.jpg", ".hidden.png"):
        plain_with_disc().save(source / name)
    report = convert_photos(source, tmp_path / "out", processes=1)
    assert (report.objects, report.failures) == (1, {})
    made = sorted(path.name for path in (tmp_path / "out" / "my møbel").glob("*.png"))
    assert made == ["a_jpg.png", "a_png.png", "forfra på gulvet.png"]


def test_photographs_are_turned_upright(tmp_path):
    plain = np.full((200, 100, 3), 240, np.uint8)
    plain[30:150, 40:60] = (120, 60, 20)
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter clockwise
    Image.fromarray(plain).save(tmp_path / "held.jpg", exif=exif, quality=95)
    assert read_rgba(tmp_path / "held.jpg").shape == (100, 200, 4)
    tall, wide = box_of(cut_out(read_rgba(tmp_path / "held.jpg")).mask)
    assert wide > 5 * tall


def test_running_again_makes_what_is_missing_and_nothing_else(studio, cut, tmp_path):
    """As after a kill: pictures are there completely or not at all, and remains of one that was being written."""
    out = tmp_path / "out"
    shutil.copytree(cut[0], out)
    (out / "lamp" / "1.png").unlink()
    (out / "lamp" / ".1.png.0badf00d.tmp").write_bytes(b"half")
    before = {path: path.stat().st_ino for path in out.glob("*/*.png")}
    report = convert_photos(studio[0], out, processes=1)
    assert (report.kept, list(report.found), report.objects) == (5, ["lamp/1.jpg"], 3)
    assert all(path.stat().st_ino == number for path, number in before.items())
    assert len(json.loads((out / "photos.json").read_text())["found"]) == 6
    assert not list(out.glob("**/.*.tmp"))
    report = convert_photos(studio[0], out, objects=1)
    assert (report.kept, report.found, report.objects) == (2, {}, 1)
    with pytest.raises(UserError, match="size: 224 there, 112 now"):
        convert_photos(studio[0], out, size=112)


def test_pictures_made_below_the_photographs_are_not_taken_for_photographs(tmp_path):
    Image.fromarray(lawn()).save(tmp_path / "a.jpg")
    Image.fromarray(disc()).save(tmp_path / "a_mask.png")
    for kept in (0, 1):
        report = convert_photos(tmp_path, tmp_path / "cut", processes=1, size=240)
        assert (report.kept, report.objects, report.failures) == (kept, 1, {})


def test_wrong_arguments_are_refused(tmp_path):
    for arguments, said in (
        ({"size": 8}, "size must be between"),
        ({"fewest": 0}, "fewest and objects"),
        ({}, "no photographs in"),
        ({"fewest": 2}, "at least 2"),
    ):
        with pytest.raises(UserError, match=said):
            convert_photos(tmp_path, tmp_path / "out", **arguments)
    with pytest.raises(UserError, match="is no folder"):
        convert_photos(tmp_path / "absent", tmp_path / "out")
    assert not (tmp_path / "out").exists()
