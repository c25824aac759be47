"""Finding the object in a photograph with a plain background, and whether the background is plain.

The background is a colour times light that changes slowly over the picture; it is fitted to the border and then to all
that resembles it. A cast shadow is the same colour with less light and soft edges, an object has sharp ones, however
faint: from the border, background spreads over everything that has the background's hue and is not separated from it by
a sharp edge. A grey part that touches its own shadow of the same tone cannot be told from it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage

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
    noise = _noise(tone)
    same_light = _SAME_LIGHT + 2 * noise / float(np.median(paper))
    open_ground = ~_sharp_edges(tone, noise) & ~_sharp_edges(hue, noise)
    open_ground &= (_mean3(hue) < _HUE + 3 * noise) & (light > _DARKEST_SHADOW) & (light < 1 + 2 * same_light)
    like_paper = open_ground & (np.abs(_mean3(light) - 1) < same_light)

    background = _spread(like_paper, _rim(like_paper))
    background |= _seen_through(like_paper & ~background, light)
    background = _in_shadow(background, open_ground)
    background = _spread(like_paper | background, background)
    mask = _without_specks(~_with_edges(background, pixels, paper))
    share = mask.mean()
    if share < _SMALLEST:
        raise NotPlain("nothing stands out from it")
    cut = _touched(mask)
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
            _check_plain(np.abs(coarse - paper).max(2)[border])
    full = np.tensordot(_terms(pixels.shape[0], pixels.shape[1], degree), weights, (0, 0))
    return np.clip(full, 0.02, 1.0).astype(np.float32)


def _terms(height: int, width: int, degree: int) -> np.ndarray:
    """(terms, H, W): all x^i y^j up to a degree, x and y from -1 to 1 over the picture."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32)[:, None], np.linspace(-1, 1, width, dtype=np.float32)
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])


def _check_plain(off: np.ndarray) -> None:
    inliers = off < _FAR
    if inliers.mean() < _FEWEST_INLIERS:
        raise NotPlain(f"{1 - inliers.mean():.0%} of the border differs from any one colour under even light")
    texture = float(np.median(off[inliers]))
    if texture > _MOST_TEXTURE:
        raise NotPlain(f"the border is textured, its brightness varies by {texture:.0%}")


def _noise(tone: np.ndarray) -> float:
    """Standard deviation of the noise: of what a 3 x 3 mean does not explain, over most of the picture."""
    rough = tone - _mean3(tone)
    return float(1.4826 * np.median(np.abs(rough)) / np.sqrt(8 / 9))


def _sharp_edges(tone: np.ndarray, noise: float) -> np.ndarray:
    """Pixels at edges that are sharp, however faint: seen through a wider filter they lose their slope."""
    fine = ndimage.gaussian_gradient_magnitude(tone, 1.0)
    coarse = ndimage.gaussian_gradient_magnitude(tone, 3.0)
    sharp = (fine > _SHARP * coarse) | (fine > _STEEP)
    faintest = max(_FAINTEST_EDGE, 1.2 * noise)
    edges = _flooded(sharp & (fine > faintest), sharp & (fine > 0.5 * faintest), corners=True)
    return _large(edges, _SHORTEST_EDGE)


def _rim(picture: np.ndarray) -> np.ndarray:
    rim = np.ones_like(picture, bool)
    rim[1:-1, 1:-1] = False
    return rim


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


def _touched(mask: np.ndarray) -> tuple[str, ...]:
    sides = {"left": mask[:, :2], "top": mask[:2], "right": mask[:, -2:], "bottom": mask[-2:]}
    return tuple(name for name, strip in sides.items() if strip.any())


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
