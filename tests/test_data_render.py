"""Rendering: exact depth at pixel centres, in the convention of the cameras, the same from embree and the z-buffer."""

import dataclasses
import sys

import numpy as np
import pytest
import torch
import trimesh
from trees import plain_surface

from diffpoint.camera import PinholeCamera
from train.data.procedural import variants_of
from train.data.rays import EmbreeCaster, Rasteriser, has_embree
from train.data.render import MAX_RADIUS, Orbit, Renderer, draw_camera, orbit_camera
from train.data.solids import surface_of
from train.data.surface import Surface
from train.errors import UserError

RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
needs_embree = pytest.mark.skipif(not has_embree(), reason="embreex has no wheel here")


@pytest.fixture(params=[pytest.param(EmbreeCaster, marks=needs_embree), Rasteriser])
def caster(request):
    return request.param


def pixel_rays(camera):
    """(V, H, W, 3) directions with z = 1 in the camera frame, turned to the world, and eyes (V, 3)."""
    column, row = torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy")
    centres = torch.stack((column + 0.5, row + 0.5, torch.ones_like(row)), -1).double()
    rays = centres @ torch.linalg.inv(camera.K[0]).T
    return torch.einsum(
        "vji,hwj->vhwi", camera.cam_from_world[:, :3, :3], rays
    ).numpy(), camera.position.numpy()


def test_depth_is_exact_on_a_box(caster):
    camera = orbit_camera(np.array([0.0, 37, 200]), np.array([0.0, 25, -15]), 96)
    half = np.array([0.2, 0.3, 0.1])
    depth = Renderer(plain_surface(trimesh.creation.box(2 * half)), caster).render(camera).depth
    directions, eyes = pixel_rays(camera)
    crossings = (np.array([-1, 1])[:, None] * half - eyes[:, None, None, None]) / directions[..., None, :]
    near, far = crossings.min(-2).max(-1), crossings.max(-2).min(-1)
    expected = np.where(near < far, near, np.inf)
    clear = np.abs(near - far) > 1e-5  # a ray along an edge may go either way
    np.testing.assert_array_equal(np.isfinite(depth)[clear], np.isfinite(expected)[clear])
    both = np.isfinite(expected) & np.isfinite(depth)
    assert both.sum() > 1000
    assert np.abs(depth[both] - expected[both]).max() < 1e-4


def test_depth_is_depth_and_not_ray_length(caster):
    plane = trimesh.Trimesh(
        [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], [(0, 1, 2), (0, 2, 3)], process=False
    )
    depth = Renderer(plain_surface(plane), caster).render(orbit_camera(np.zeros(1), np.zeros(1), 32)).depth
    np.testing.assert_allclose(depth, 2.0, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "row_sign", "column_sign"),
    [((0.0, 0.3, 0), -1, 0), ((0.3, 0, 0), 0, 1), ((-0.3, -0.3, 0), 1, -1)],
)
def test_up_is_up_and_right_is_right_from_the_front(place, row_sign, column_sign):
    box = trimesh.creation.box((0.1, 0.1, 0.1), transform=trimesh.transformations.translation_matrix(place))
    depth = Renderer(plain_surface(box)).render(orbit_camera(np.zeros(1), np.zeros(1), 64)).depth[0]
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


def test_nothing_within_the_radius_is_cut(caster):
    ball = trimesh.creation.icosphere(3, radius=MAX_RADIUS)
    depth = Renderer(plain_surface(ball), caster).render(draw_camera(np.random.default_rng(0), 4, 112)).depth
    border = np.concatenate((depth[:, 0], depth[:, -1], depth[:, :, 0], depth[:, :, -1]))
    assert not np.isfinite(border).any()
    assert np.isfinite(depth).mean() > 0.6


def test_an_object_behind_the_frame_s_edge_or_camera_is_drawn_without_error(caster):
    ball = trimesh.creation.icosphere(3, radius=3.0)  # the camera is inside
    depth = Renderer(plain_surface(ball), caster).render(orbit_camera(np.zeros(1), np.zeros(1), 16)).depth
    assert np.isfinite(depth).all()
    away = PinholeCamera.look_at((0.0, 0, 9), (0.0, 0, 20), focal_px=30.0, height=16, width=16)
    views = Renderer(plain_surface(ball), caster).render(away.expand(1))
    assert not np.isfinite(views.depth).any()
    assert (views.images == 255).all()


def test_winding_does_not_matter_and_white_is_not_background(caster):
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    camera = orbit_camera(np.array([30.0]), np.array([20.0]), 64)
    images = [
        Renderer(
            plain_surface(trimesh.Trimesh(box.vertices, faces, process=False), (1, 1, 1)), caster
        ).render(camera)
        for faces in (box.faces, box.faces[:, ::-1])
    ]
    np.testing.assert_array_equal(images[0].images, images[1].images)
    seen = np.isfinite(images[0].depth)
    assert images[0].images[seen].max() < 250
    assert (images[0].images[0, :4] == 255).all()


def test_texture_lies_as_its_coordinates_say(caster):
    """Left half red, right half green; upper row of the texture bright, lower row dark."""
    texture = np.array([[RED, GREEN], [(0.5, 0, 0), (0, 0.5, 0)]]) * 255
    surface = Surface(
        np.array([(-0.4, -0.4, 0), (0.4, -0.4, 0), (0.4, 0.4, 0), (-0.4, 0.4, 0)]),
        np.array([(0, 1, 2), (0, 2, 3)]),
        np.ones((2, 3, 3), np.float32),
        np.zeros(2, int),
        np.array([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]], np.float32),
        (texture.astype(np.uint8),),
    )
    image = Renderer(surface, caster).render(orbit_camera(np.zeros(1), np.zeros(1), 64)).images[0].astype(int)
    upper_left, upper_right, lower_left = image[20, 20], image[20, 44], image[44, 20]
    assert upper_left[0] > upper_left[1] + 80
    assert upper_right[1] > upper_right[0] + 80
    assert upper_left[0] > lower_left[0] + 40


def soup(count, size):
    """Random triangles through and past one another, each of its own colours."""
    rng = np.random.default_rng(count)
    corners = rng.uniform(-0.3, 0.3, (count, 1, 3)) + rng.normal(scale=size, size=(count, 3, 3))
    surface = Surface.plain(
        corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), np.full((count, 3), 0.7)
    )
    return dataclasses.replace(surface, corner_colours=rng.random((count, 3, 3)).astype(np.float32))


def textured_ball():
    ball = trimesh.creation.icosphere(4, radius=0.45)
    u = 0.5 + np.arctan2(ball.vertices[:, 2], ball.vertices[:, 0]) / np.pi
    uv = np.stack((u, ball.vertices[:, 1] * 3), axis=1).astype(np.float32)
    texture = np.random.default_rng(0).integers(0, 256, (6, 5, 3), np.uint8)
    return dataclasses.replace(
        plain_surface(ball),
        face_texture=np.arange(len(ball.faces)) % 2 - 1,
        corner_uv=uv[ball.faces],
        textures=(texture,),
    )


AGREEING = {
    "ring of 12 000 faces": lambda: plain_surface(trimesh.creation.torus(0.35, 0.12, 100, 60)),
    "ball of 81 920 faces": lambda: plain_surface(trimesh.creation.icosphere(6, radius=0.5)),
    "box": lambda: plain_surface(trimesh.creation.box((0.5, 0.3, 0.4))),
    "triangles that cross": lambda: soup(300, 0.2),
    "many thin triangles": lambda: soup(5000, 0.02),
    "textured ball": textured_ball,
    "chair": lambda: surface_of(variants_of("chair", 1)[0]),
    "watercraft": lambda: surface_of(variants_of("watercraft", 1)[0]),
}


def test_the_z_buffer_gives_what_is_seen_edge_on_no_depth_that_rounding_made():
    """Each lies in a plane of the eye and a column of pixel centres: what is left of its depth is noise."""
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-0.3, 0.3, (2, 3000, 3))
    column = rng.integers(60, 164, (3000, 1)) + 0.5
    corners = np.stack(((column - 112) / 420 * (2 - z), y, z), -1).reshape(-1, 3)
    surface = Surface.plain(corners, np.arange(len(corners)).reshape(-1, 3), np.ones((3000, 3)))
    depth = Renderer(surface, Rasteriser).render(orbit_camera(np.zeros(1), np.zeros(1), 224)).depth
    seen = depth[np.isfinite(depth)]
    assert ((seen > 1.69) & (seen < 2.31)).all()


@needs_embree
@pytest.mark.parametrize("name", AGREEING)
def test_embree_and_the_z_buffer_agree(name):
    surface = AGREEING[name]()
    camera = draw_camera(np.random.default_rng(5), 3, 224)
    cast, drawn = (Renderer(surface, caster).render(camera) for caster in (EmbreeCaster, Rasteriser))
    in_cast, in_drawn = np.isfinite(cast.depth), np.isfinite(drawn.depth)
    both = in_cast & in_drawn
    assert both.sum() > 5000
    assert both.sum() / (in_cast | in_drawn).sum() >= 0.999
    apart = np.abs(cast.depth[both] - drawn.depth[both]) >= 1e-4
    assert apart.mean() <= 5e-5  # a ray along the edge of a triangle that hides another may go either way
    other_colour = (np.abs(cast.images.astype(int) - drawn.images) > 3).any(-1)
    assert other_colour.sum() <= 2e-4 * both.sum()
    assert cast.images[both].std() > 5  # there is something to agree on


def test_without_embree_the_z_buffer_renders(monkeypatch):
    for name in ("embreex", "embreex.rtcore_scene", "embreex.mesh_construction"):
        monkeypatch.setitem(sys.modules, name, None)  # cannot be imported
    surface, camera = AGREEING["box"](), draw_camera(np.random.default_rng(5), 1, 64)
    expected = Renderer(surface, Rasteriser).render(camera)
    np.testing.assert_array_equal(Renderer(surface).render(camera).depth, expected.depth)
    with pytest.raises(UserError, match="install it: pip install embreex"):
        EmbreeCaster(surface)


def test_an_orbit_of_one_s_own(caster):
    orbit = Orbit(elevation_deg=(50.0, 60.0), distance=4.0, focal=3.0)
    orbit.check()
    camera = draw_camera(np.random.default_rng(0), 6, 80, orbit)
    eyes = camera.position.numpy()
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 4)
    elevation_deg = np.degrees(np.arcsin(eyes[:, 1] / 4))
    assert elevation_deg.min() >= 50
    assert elevation_deg.max() <= 60
    np.testing.assert_allclose(camera.K[:, 0, 0], 240)
    ball = plain_surface(trimesh.creation.icosphere(4, radius=0.97 * orbit.max_radius))
    depth = Renderer(ball, caster).render(camera).depth
    np.testing.assert_allclose(depth.min((1, 2)), 4 - 0.97 * orbit.max_radius, atol=1e-3)
    border = np.concatenate((depth[:, 0], depth[:, -1], depth[:, :, 0], depth[:, :, -1]))
    assert not np.isfinite(border).any()


@pytest.mark.parametrize(
    ("orbit", "message"),
    [
        (Orbit(elevation_deg=(40.0, -20.0)), "the lower one first; got 40 -20"),
        (Orbit(elevation_deg=(0.0, 90.0)), "between -89 and 89"),
        (Orbit(distance=12.0), "depth files end at 10"),
        (Orbit(focal=-1.0), "focal"),
        (Orbit(distance=1.5), "lower focal to 1.41"),
    ],
)
def test_an_orbit_that_cannot_hold_a_shape_is_refused(orbit, message):
    with pytest.raises(UserError, match=message):
        orbit.check()
    Orbit(distance=1.5, focal=1.41).check()
