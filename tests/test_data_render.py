"""Rendering: exact depth at pixel centres, in the convention of the cameras."""

import numpy as np
import pytest
import torch
import trimesh

from diffpoint.camera import PinholeCamera
from train.data.render import MAX_RADIUS, Renderer, draw_camera, orbit_camera
from train.data.surface import Surface

RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def surface_of(mesh, colour=(0.5, 0.5, 0.5)):
    return Surface.plain(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), np.tile(colour, (len(mesh.faces), 1))
    )


def pixel_rays(camera):
    """(V, H, W, 3) directions with z = 1 in the camera frame, turned to the world, and eyes (V, 3)."""
    column, row = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
    centres = torch.stack((column + 0.5, row + 0.5, torch.ones_like(row)), -1).double()
    rays = centres @ torch.linalg.inv(camera.K[0]).T
    return torch.einsum(
        "vji,hwj->vhwi", camera.cam_from_world[:, :3, :3], rays
    ).numpy(), camera.position.numpy()


def test_depth_is_exact_on_a_box():
    camera = orbit_camera(np.array([0.0, 37, 200]), np.array([0.0, 25, -15]), 96)
    half = np.array([0.2, 0.3, 0.1])
    depth = Renderer(surface_of(trimesh.creation.box(2 * half))).render(camera).depth
    directions, eyes = pixel_rays(camera)
    crossings = (np.array([-1, 1])[:, None] * half - eyes[:, None, None, None]) / directions[..., None, :]
    near, far = crossings.min(-2).max(-1), crossings.max(-2).min(-1)
    expected = np.where(near < far, near, np.inf)
    clear = np.abs(near - far) > 1e-5  # a ray along an edge may go either way
    np.testing.assert_array_equal(np.isfinite(depth)[clear], np.isfinite(expected)[clear])
    both = np.isfinite(expected) & np.isfinite(depth)
    assert both.sum() > 1000
    assert np.abs(depth[both] - expected[both]).max() < 1e-4


def test_depth_is_depth_and_not_ray_length():
    plane = trimesh.Trimesh(
        [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], [(0, 1, 2), (0, 2, 3)], process=False
    )
    depth = Renderer(surface_of(plane)).render(orbit_camera(np.zeros(1), np.zeros(1), 32)).depth
    np.testing.assert_allclose(depth, 2.0, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "row_sign", "column_sign"),
    [((0.0, 0.3, 0), -1, 0), ((0.3, 0, 0), 0, 1), ((-0.3, -0.3, 0), 1, -1)],
)
def test_up_is_up_and_right_is_right_from_the_front(place, row_sign, column_sign):
    box = trimesh.creation.box((0.1, 0.1, 0.1), transform=trimesh.transformations.translation_matrix(place))
    depth = Renderer(surface_of(box)).render(orbit_camera(np.zeros(1), np.zeros(1), 64)).depth[0]
    row, column = np.argwhere(np.isfinite(depth)).mean(0) - 31.5
    assert np.sign(round(row)) == row_sign
    assert np.sign(round(column)) == column_sign


def test_azimuth_90_stands_at_plus_x():
    eye = orbit_camera(np.array([0.0, 90]), np.array([0.0, 0]), 8).position.numpy()
    np.testing.assert_allclose(eye, [(0, 0, 2), (2, 0, 0)], atol=1e-12)


def test_views_are_equispaced_in_azimuth_within_the_elevations():
    eyes = draw_camera(np.random.default_rng(3), 8, 224).position.numpy()
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 2)
    azimuth_deg = np.degrees(np.arctan2(eyes[:, 0], eyes[:, 2]))
    np.testing.assert_allclose(np.diff(azimuth_deg) % 360, 45)
    elevation_deg = np.degrees(np.arcsin(eyes[:, 1] / 2))
    assert elevation_deg.min() >= -20
    assert elevation_deg.max() <= 40


def test_nothing_within_the_radius_is_cut():
    ball = trimesh.creation.icosphere(3, radius=MAX_RADIUS)
    depth = Renderer(surface_of(ball)).render(draw_camera(np.random.default_rng(0), 4, 112)).depth
    border = np.concatenate((depth[:, 0], depth[:, -1], depth[:, :, 0], depth[:, :, -1]))
    assert not np.isfinite(border).any()
    assert np.isfinite(depth).mean() > 0.6


def test_an_object_behind_the_frame_s_edge_or_camera_is_drawn_without_error():
    ball = trimesh.creation.icosphere(3, radius=3.0)  # the camera is inside
    depth = Renderer(surface_of(ball)).render(orbit_camera(np.zeros(1), np.zeros(1), 16)).depth
    assert np.isfinite(depth).all()
    away = PinholeCamera.look_at((0.0, 0, 9), (0.0, 0, 20), focal_px=30.0, height=16, width=16)
    views = Renderer(surface_of(ball)).render(away.expand(1))
    assert not np.isfinite(views.depth).any()
    assert (views.images == 255).all()


def test_winding_does_not_matter_and_white_is_not_background():
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    camera = orbit_camera(np.array([30.0]), np.array([20.0]), 64)
    images = [
        Renderer(surface_of(trimesh.Trimesh(box.vertices, faces, process=False), (1, 1, 1))).render(camera)
        for faces in (box.faces, box.faces[:, ::-1])
    ]
    np.testing.assert_array_equal(images[0].images, images[1].images)
    seen = np.isfinite(images[0].depth)
    assert images[0].images[seen].max() < 250
    assert (images[0].images[0, :4] == 255).all()


def test_texture_lies_as_its_coordinates_say():
    """Left half red, right half green; upper row of the texture bright, lower row dark."""
    texture = np.array([[RED, GREEN], [(0.5, 0, 0), (0, 0.5, 0)]]) * 255
    surface = Surface(
        np.array([(-0.4, -0.4, 0), (0.4, -0.4, 0), (0.4, 0.4, 0), (-0.4, 0.4, 0)]),
        np.array([(0, 1, 2), (0, 2, 3)]),
        np.zeros((2, 3, 3), np.float32),
        np.zeros(2, int),
        np.array([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]], np.float32),
        (texture.astype(np.uint8),),
    )
    image = Renderer(surface).render(orbit_camera(np.zeros(1), np.zeros(1), 64)).images[0].astype(int)
    upper_left, upper_right, lower_left = image[20, 20], image[20, 44], image[44, 20]
    assert upper_left[0] > upper_left[1] + 80
    assert upper_right[1] > upper_right[0] + 80
    assert upper_left[0] > lower_left[0] + 40
