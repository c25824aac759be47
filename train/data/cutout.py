"""An object cut out of a photograph: alone on white, in a square, as large as objects are in training.

The object is given by a mask or by transparency, or found on a plain background. That is a colour times light that
changes slowly over the picture; it is fitted to the border and then to all that resembles it. A cast shadow is the same
colour with less light and soft edges, an object has sharp ones, however faint: from the border, background spreads over
everything that has the background's hue and is not separated from it by a sharp edge. A grey part that touches its own
shadow of the same tone cannot be told from it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from PIL import Image
from scipy import ndimage

from train.errors import UserError

FILL = 0.88
"""Diagonal of the object's bounding box as a share of the frame's side. Of the measures of size this one varies least
over training views: 0.93 on average for models whose box has a diagonal of 1, 0.71 for the embedded shapes."""
LONGEST = 0.94
"""No side of the object takes more of the frame."""

_LARGEST_SIDE = 2048
_SMALL_IN_FRAME, _MARGIN = 0.5, 0.35
_FEWEST_PIXELS = 16
_HINT = "put the object on plain paper, make the rest transparent, or give a mask (NAME_mask.png)"

WORKING_SIDE = 640
"""Photographs are reduced to this side first; widths of edges below are in these pixels."""

_BAND = 0.03  # width of the border, share of the shorter side
_FAR = 0.06  # a border pixel further from the fit is not background
_FEWEST_INLIERS, _MOST_TEXTURE = 0.55, 0.03
_STRIDE = 4  # the background is fitted to every fourth pixel
_DARKEST_SHADOW = 0.25  # share of the light that a shadow leaves
_HUE, _SAME_LIGHT = 0.035, 0.02
_SHARP = 1.6  # ratio of the slopes behind filters of 1 and of 3 pixels: edges up to 2 pixels wide
_STEEP = 0.06  # a slope per pixel that no soft shadow has
_FAINTEST_EDGE, _SHORTEST_EDGE = 0.0065, 20
_FRONT = 11  # pixels of open passage through which shadow is entered
_EDGE_RULES = ((9, 0.25, 0.03), (9, 0.25, 0.03), (3, 0.5, 1.0), (3, 0.5, 1.0))
_SMALLEST_HOLE, _SPECK = 20, 12
_SMALLEST, _LARGEST = 0.002, 0.9


@dataclasses.dataclass(frozen=True, eq=False)
class CutOut:
    """An object cut out of a photograph.

    Attributes:
        picture: (S, S, 3) uint8, on white.
        mask: (H, W) bool, as large as the photograph.
        way: how the object was found: "mask", "alpha" or "plain background".
        found: a description of what was found.
    """

    picture: np.ndarray
    mask: np.ndarray
    way: str
    found: str


def cut_out(rgba: np.ndarray, *, size: int = 224, given: np.ndarray | None = None) -> CutOut:
    """Cuts the object out of a photograph.

    Args:
        rgba: (H, W, 4) in [0, 1].
        size: side of the picture that is made.
        given: (H, W, 4) in [0, 1], a mask: its alpha channel if that is transparent anywhere, else its brightness; of
            two values the brighter one marks the object, whatever it is. Without one, the photograph's own alpha is
            used, and if that is opaque the background has to be plain.

    Raises:
        UserError: a mask of another size, an empty mask, or a background that is not plain.
    """
    height, width = rgba.shape[:2]
    colours = rgba[..., :3]
    if given is not None:
        alpha, way, found = _mask_values(given, height, width), "mask", "mask"
    elif (rgba[..., 3] < 0.5).any():
        alpha, way, found = rgba[..., 3], "alpha", "alpha"
    else:
        image = Image.fromarray((colours * 255 + 0.5).astype(np.uint8))
        image.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE), Image.Resampling.BOX)
        alpha, ground = _segment(image)
        colours, way, found = np.asarray(image, np.float32) / 255, "plain background", _words(ground)
    mask = alpha >= 0.5
    if mask.sum() < _FEWEST_PIXELS:
        raise UserError(f"shows nothing: its {way} is empty")
    picture = _framed(colours * alpha[..., None] + (1 - alpha[..., None]), mask, size)
    if mask.shape != (height, width):
        full = Image.fromarray((alpha * 255).astype(np.uint8)).resize(
            (width, height), Image.Resampling.BILINEAR
        )
        mask = np.asarray(full) >= 128
    return CutOut(picture, mask, way, f"{found}; the object takes {mask.mean():.0%} of the photograph")


def _mask_values(given: np.ndarray, height: int, width: int) -> np.ndarray:
    if given.shape[:2] != (height, width):
        remedy = "make them the same size"
        # Cameras store the pixels as they were held, programs may not ask how.
        if given.shape[:2] == (width, height):
            remedy = "turn the mask upright, as the photograph is shown"
        raise UserError(
            f"its mask is {given.shape[1]} x {given.shape[0]} pixels, the photograph {width} x {height}; {remedy}"
        )
    if (given[..., 3] < 0.5).any():
        return given[..., 3]
    values = given[..., :3].mean(2)
    low, high = values.min(), values.max()
    # Programs that segment pictures write 0 and 1 of 255, or a colour.
    has_two_values = low < high and bool(((values == low) | (values == high)).all())
    return (values == high).astype(np.float32) if has_two_values else values


def _segment(image: Image.Image) -> tuple[np.ndarray, Foreground]:
    """Alpha (H, W) of the object on a plain background; a small object is looked at a second time, enlarged."""
    try:
        alpha, found = _segment_box(image, (0, 0, *image.size))
    except NotPlain as error:
        raise UserError(f"the background is not plain: {error}; {_HINT}") from None
    rows, columns = np.flatnonzero((alpha >= 0.5).any(1)), np.flatnonzero((alpha >= 0.5).any(0))
    if not rows.size:
        return alpha, found
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    if max(image.size) > WORKING_SIDE and extent < _SMALL_IN_FRAME * max(image.size):
        margin = round(_MARGIN * extent)
        left, top = max(columns[0] - margin, 0), max(rows[0] - margin, 0)
        right, bottom = min(columns[-1] + margin, image.width), min(rows[-1] + margin, image.height)
        try:
            closer, _ = _segment_box(image, (int(left), int(top), int(right), int(bottom)))
        except NotPlain:
            return alpha, found  # its shadow takes too much of the narrower border
        both = (closer >= 0.5) & (alpha >= 0.5)
        if both.sum() > 0.8 * (closer >= 0.5).sum():
            alpha = closer
    return alpha, found


def _segment_box(image: Image.Image, box: tuple[int, int, int, int]) -> tuple[np.ndarray, Foreground]:
    """Alpha of the whole image, from looking at a part of it."""
    part = image.crop(box)
    factor = min(WORKING_SIDE / max(part.size), 1.0)
    small = (max(round(part.width * factor), 1), max(round(part.height * factor), 1))
    found = find_foreground(np.asarray(part.resize(small, Image.Resampling.BOX), np.float32) / 255)
    alpha = Image.new("L", image.size)
    edges = Image.fromarray(found.mask.astype(np.uint8) * 255).resize(part.size, Image.Resampling.BILINEAR)
    alpha.paste(edges, box[:2])
    return np.asarray(alpha, np.float32) / 255, found


def _words(found: Foreground) -> str:
    red, green, blue = (round(float(value) * 255) for value in found.colour)
    words = f"plain background of colour ({red}, {green}, {blue})"
    if found.uneven >= 0.05:
        words += f", {found.uneven:.0%} darker in places"
    if found.shadow >= 0.01:
        words += f", shadow on {found.shadow:.0%}"
    return f"{words}; cut off at the {' and the '.join(found.cut)}" if found.cut else words


def _framed(on_white: np.ndarray, mask: np.ndarray, size: int) -> np.ndarray:
    """(S, S, 3) uint8: the object's box in the middle of a white square, at the scale of training."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    tall, wide = bottom - top, right - left
    side = max(np.hypot(tall, wide) / FILL, max(tall, wide) / LONGEST)
    border = int(np.ceil(side))
    padded = np.pad(on_white, ((border, border), (border, border), (0, 0)), constant_values=1.0)
    x, y = border + (left + right - side) / 2, border + (top + bottom - side) / 2
    image = Image.fromarray((padded.clip(0, 1) * 255 + 0.5).astype(np.uint8))
    return np.array(image.resize((size, size), Image.Resampling.LANCZOS, box=(x, y, x + side, y + side)))


# Finding the object on a plain background.


class NotPlain(Exception):
    """Why no object can be told from the background."""


@dataclasses.dataclass(frozen=True, eq=False)
class Foreground:
    """An object found on a plain background.

    Attributes:
        mask: (H, W) bool, True where the object is.
        colour: (3,) of the background in the middle of the picture, in [0, 1].
        uneven: how much the background's light changes over the picture, a share of the brightest.
        shadow: share of the picture that is background in shadow.
        cut: sides of the picture that the object touches: "left", "top", ...
    """

    mask: np.ndarray
    colour: np.ndarray
    uneven: float
    shadow: float
    cut: tuple[str, ...]


def find_foreground(pixels: np.ndarray) -> Foreground:
    """Separates an object from a plain background.

    Args:
        pixels: (H, W, 3) in [0, 1], the longer side about `WORKING_SIDE`.

    Raises:
        NotPlain: the border is no single colour under slowly changing light, or nothing or everything stands out.
    """
    pixels = np.asarray(pixels, np.float32)
    paper = _fit_paper(pixels)
    light = (pixels * paper).sum(2) / np.maximum((paper * paper).sum(2), 1e-6)
    hue = np.abs(pixels - light[..., None] * paper).max(2)
    tone = pixels.mean(2)
    # Its standard deviation: of what a 3 x 3 mean does not explain, over most of the picture.
    noise = float(1.4826 * np.median(np.abs(tone - _mean3(tone))) / np.sqrt(8 / 9))
    same_light = _SAME_LIGHT + 2 * noise / float(np.median(paper))
    open_ground = ~_sharp_edges(tone, noise) & ~_sharp_edges(hue, noise)
    open_ground &= (_mean3(hue) < _HUE + 3 * noise) & (light > _DARKEST_SHADOW) & (light < 1 + 2 * same_light)
    like_paper = open_ground & (np.abs(_mean3(light) - 1) < same_light)

    background = _spread(like_paper, np.pad(np.zeros(tone[1:-1, 1:-1].shape, bool), 1, constant_values=True))
    background |= _seen_through(like_paper & ~background, light)
    background = _in_shadow(background, open_ground)
    background = _spread(like_paper | background, background)
    mask = _without_specks(~_with_edges(background, pixels, paper))
    share = mask.mean()
    if share < _SMALLEST:
        raise NotPlain("nothing stands out from it")
    sides = {"left": mask[:, :2], "top": mask[:2], "right": mask[:, -2:], "bottom": mask[-2:]}
    cut = tuple(name for name, strip in sides.items() if strip.any())
    if len(cut) > 2:
        raise NotPlain(
            f"what differs from it reaches the {', the '.join(cut)} of the picture; two backgrounds?"
        )
    if share > _LARGEST:
        raise NotPlain("the object fills the picture; leave some background around it")
    shadow = (~mask & (light < 1 - 2 * same_light)).mean()
    level = paper.mean(2)
    uneven = float(1 - level.min() / level.max())
    return Foreground(mask, np.median(paper, (0, 1)), uneven, float(shadow), cut)


def _fit_paper(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 3): the background without its shadows; polynomials per channel, fitted to what agrees with them."""
    coarse = pixels[::_STRIDE, ::_STRIDE]
    height, width = coarse.shape[:2]
    band = max(2, round(_BAND * min(height, width)))
    border = np.ones((height, width), bool)
    border[band:-band, band:-band] = False
    paper = np.broadcast_to(np.median(coarse[border], 0), coarse.shape)
    degree, weights = 0, np.median(coarse[border], 0)[None]
    for next_degree, among, tolerance in (
        (1, border, 4 * _FAR),
        (1, border, 2 * _FAR),
        (2, border, _FAR),
        (2, None, _FAR),
        (4, None, 0.6 * _FAR),
        (4, None, 0.4 * _FAR),
    ):
        chosen = np.abs(coarse - paper).max(2) < tolerance
        if among is not None:
            chosen &= among
        terms = _terms(height, width, next_degree)
        if chosen.sum() < 4 * len(terms):
            break
        weights, *_ = np.linalg.lstsq(terms[:, chosen].T, coarse[chosen], rcond=None)
        paper, degree = np.tensordot(terms, weights, (0, 0)), next_degree
        if degree == 2 and among is border:
            off = np.abs(coarse - paper).max(2)[border]
            inliers = off < _FAR
            if inliers.mean() < _FEWEST_INLIERS:
                raise NotPlain(
                    f"{1 - inliers.mean():.0%} of the border differs from any one colour under even light"
                )
            texture = float(np.median(off[inliers]))
            if texture > _MOST_TEXTURE:
                raise NotPlain(f"the border is textured, its brightness varies by {texture:.0%}")
    full = np.tensordot(_terms(pixels.shape[0], pixels.shape[1], degree), weights, (0, 0))
    return np.clip(full, 0.02, 1.0).astype(np.float32)


def _terms(height: int, width: int, degree: int) -> np.ndarray:
    """(terms, H, W): all x^i y^j up to a degree, x and y from -1 to 1 over the picture."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32)[:, None], np.linspace(-1, 1, width, dtype=np.float32)
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])


def _sharp_edges(tone: np.ndarray, noise: float) -> np.ndarray:
    """Pixels at edges that are sharp, however faint: seen through a wider filter they lose their slope."""
    fine = ndimage.gaussian_gradient_magnitude(tone, 1.0)
    coarse = ndimage.gaussian_gradient_magnitude(tone, 3.0)
    sharp = (fine > _SHARP * coarse) | (fine > _STEEP)
    faintest = max(_FAINTEST_EDGE, 1.2 * noise)
    edges = _flooded(sharp & (fine > faintest), sharp & (fine > 0.5 * faintest), corners=True)
    return _large(edges, _SHORTEST_EDGE)


def _spread(like_paper: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The paper, from `start` on, through gaps of three pixels and more."""
    wide = _shrunk(like_paper, 3)
    reached = _flooded(wide & start, wide)
    return _grown(reached | (start & like_paper), 3) & like_paper


def _seen_through(like_paper: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Holes of the object that show the paper, as between the legs of a chair."""
    labels, count = _labelled(like_paper, corners=False)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    lights = np.asarray(ndimage.median(light, labels, np.arange(1, count + 1))) if count else np.empty(0)
    lit = np.concatenate(([False], np.abs(lights - 1) < 0.6 * _SAME_LIGHT))
    return ((sizes >= _SMALLEST_HOLE) & lit)[labels]


def _in_shadow(background: np.ndarray, open_ground: np.ndarray) -> np.ndarray:
    """Shadow on the paper: what the paper passes into without a sharp edge, on a broad front.

    Narrower passages lead through faint places of an object's outline into its grey parts; where a broad one ends, they
    are followed for a few pixels only.
    """
    ground = open_ground | background
    broad, narrow = _shrunk(ground, _FRONT), _shrunk(ground, 3)
    reached = background | (_grown(_flooded(background & broad, broad), _FRONT) & ground)
    near = _flooded(reached & narrow, narrow, steps=_FRONT)
    return reached | (_grown(near, 3) & ground)


def _with_edges(background: np.ndarray, pixels: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """The background up to where the colour is half-way to the object's, and without the ripples of JPEG around it.

    A rule (reach, share, most) adds pixels whose difference from the ground around them is below a share of the largest
    difference within a window, and below `most`.
    """
    for reach, share, most in _EDGE_RULES:
        weight = ndimage.gaussian_filter(background.astype(np.float32), 3.0)[..., None]
        sums = ndimage.gaussian_filter(pixels * background[..., None], (3.0, 3.0, 0.0))
        ground = np.where(weight > 1e-3, sums / np.maximum(weight, 1e-3), paper)
        off = np.abs(pixels - ground).max(2)
        contrast = ndimage.maximum_filter(off * ~background, reach)
        background = background | (_grown(background, reach) & (off < np.minimum(share * contrast, most)))
    return background


def _without_specks(mask: np.ndarray) -> np.ndarray:
    labels, _ = _labelled(mask, corners=True)
    largest = np.bincount(labels.ravel())[1:].max(initial=0)
    return ~_large(~_large(mask, max(_SPECK, 0.005 * largest)), _SPECK)


def _large(mask: np.ndarray, pixels: float) -> np.ndarray:
    """Without the parts that have fewer pixels."""
    labels, _ = _labelled(mask, corners=True)
    return mask & (np.bincount(labels.ravel()) >= pixels)[labels]


# scipy's operations with one convention: (H, W) bool in and out, square windows, borders as scipy's defaults.


def _mean3(values: np.ndarray) -> np.ndarray:
    return np.asarray(ndimage.uniform_filter(values, 3))


def _grown(mask: np.ndarray, window: int) -> np.ndarray:
    return np.asarray(ndimage.maximum_filter(mask, window), bool)


def _shrunk(mask: np.ndarray, window: int) -> np.ndarray:
    return np.asarray(ndimage.minimum_filter(mask, window), bool)


def _flooded(seeds: np.ndarray, within: np.ndarray, *, corners: bool = False, steps: int = -1) -> np.ndarray:
    """All of `within` that touches the seeds, in at most so many steps."""
    neighbours = np.ones((3, 3), bool) if corners else None
    return np.asarray(ndimage.binary_dilation(seeds & within, neighbours, steps, mask=within), bool)


def _labelled(mask: np.ndarray, *, corners: bool) -> tuple[np.ndarray, int]:
    labels = np.zeros(mask.shape, np.int32)
    ndimage.label(mask, np.ones((3, 3)) if corners else None, output=labels)
    return labels, int(labels.max())
