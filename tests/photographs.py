"""Photographs that a test can judge: a rendered object on a plain ground with shadow, uneven light, noise and JPEG."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
from PIL import Image
from scipy.ndimage import binary_erosion, distance_transform_edt, gaussian_filter, zoom

from train.data.procedural import variants_of
from train.data.render import Renderer, orbit_camera
from train.data.solids import surface_of
from train.data.surface import Surface


@dataclasses.dataclass(frozen=True)
class Photograph:
    """pixels (H, W, 3) uint8 and the true mask (H, W)."""

    pixels: np.ndarray
    mask: np.ndarray


def surface_for(category: str, seed: int, *, light_grey: bool = False) -> Surface:
    """An object of an embedded family; with `light_grey`, half of its parts are nearly as light as white paper."""
    surface = surface_of(variants_of(category, seed)[0])
    if not light_grey:
        return surface
    colours = surface.corner_colours.copy()
    tones = np.unique(colours.reshape(-1, 3).round(3), axis=0)
    for tone in tones[::2]:
        colours[np.isclose(colours, tone, atol=2e-3).all(-1)] = 0.9
    return dataclasses.replace(surface, corner_colours=colours)


def take(
    surface: Surface,
    rng: np.random.Generator,
    *,
    paper: tuple[float, float, float] = (0.95, 0.95, 0.94),
    shadow: float = 0.35,
    gradient: float = 0.12,
    noise: float = 0.012,
    object_px: int = 600,
    frame_px: tuple[int, int] = (720, 960),
    azimuth_deg: float = 30.0,
    elevation_deg: float = 18.0,
) -> Photograph:
    """The object somewhere in a frame of H x W pixels, on paper that is darker towards one side and the corners.

    Args:
        surface: what stands there.
        rng: draws the place, the direction of the light and the noise.
        paper: colour where the light is full.
        shadow: how much light the middle of the cast shadow lacks; its edges are soft.
        gradient: how much light is lacking at the darkest side.
        noise: standard deviation of the sensor's noise.
        object_px: side of the square into which the object is rendered.
        frame_px: height and width.
        azimuth_deg: of the camera.
        elevation_deg: of the camera.
    """
    height, width = frame_px
    camera = orbit_camera(np.array([azimuth_deg]), np.array([elevation_deg]), object_px)
    views = Renderer(surface).render(camera)
    image, seen = views.images[0] / 255, np.isfinite(views.depth[0])
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    image = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    seen = seen[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    # Pixels at the edge are part white, of the render's background: they get their inner neighbour's colour.
    inner = binary_erosion(seen, np.ones((3, 3)))
    row, column = distance_transform_edt(~inner, return_distances=False, return_indices=True)
    image = image[row, column]
    tall, wide = seen.shape
    margin = 25
    top = rng.integers(margin, max(height - tall - 3 * margin, margin + 1))
    left = rng.integers(margin, max(width - wide - margin, margin + 1))

    y, x = np.mgrid[0:height, 0:width]
    towards = rng.uniform(0, 2 * np.pi)
    across = (x / width - 0.5) * np.cos(towards) + (y / height - 0.5) * np.sin(towards)
    corner = (x / width - 0.5) ** 2 + (y / height - 0.5) ** 2
    light = 1 - gradient * (0.5 + across / 1.4) - 0.5 * gradient * corner
    light *= 1 - shadow * _cast_shadow((height, width), seen, top, left, rng)

    canvas = np.array(paper) * light[..., None]
    mask = np.zeros((height, width), bool)
    mask[top : top + tall, left : left + wide] = seen
    canvas[mask] = image[seen]
    canvas = gaussian_filter(canvas, (0.7, 0.7, 0)) + rng.normal(0, noise, canvas.shape)
    return Photograph((canvas.clip(0, 1) * 255 + 0.5).astype(np.uint8), mask)


def _cast_shadow(
    size: tuple[int, int], seen: np.ndarray, top: int, left: int, rng: np.random.Generator
) -> np.ndarray:
    """(H, W) in [0, 1]: a soft ellipse around the foot of the object, longer towards one side."""
    coarse = 4
    y, x = np.mgrid[0 : size[0] : coarse, 0 : size[1] : coarse]
    tall, wide = seen.shape
    foot = seen[int(0.9 * tall) :].any(0)
    middle = left + np.flatnonzero(foot).mean() + rng.uniform(-0.25, 0.25) * wide
    ellipse = ((x - middle) / (0.6 * wide)) ** 2 + ((y - (top + 0.95 * tall)) / (0.13 * tall)) ** 2 < 1
    soft = gaussian_filter(ellipse.astype(float), rng.uniform(0.01, 0.025) * max(size) / coarse)
    return zoom(soft, coarse, order=1)[: size[0], : size[1]]


def as_jpeg(photograph: Photograph, quality: int) -> bytes:
    """The bytes of a JPEG file, with the halved colour resolution that cameras use."""
    file = io.BytesIO()
    Image.fromarray(photograph.pixels).save(file, "JPEG", quality=quality, subsampling=2)
    return file.getvalue()
