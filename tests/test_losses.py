"""The paper's losses: counts, empty and unseen views, and what the paper claims of their gradients."""

import itertools

import pytest
import torch

import diffpoint as dp
from diffpoint.testing import assert_close, tie_free_clouds

DTYPES = (torch.float32, torch.float64)


def camera(dtype: torch.dtype = torch.float64) -> dp.PinholeCamera:
    eyes = torch.tensor([[0.1, 0.3, -2.0], [2.0, -0.4, 0.2]], dtype=dtype)
    return dp.PinholeCamera.look_at(eyes, focal_px=21.0, height=14, width=16)


def scene(dtype: torch.dtype = torch.float64, count: int = 80) -> tuple[torch.Tensor, torch.Tensor]:
    """Predicted clouds, and depth maps of other clouds."""
    target = tie_free_clouds(2, 120, camera(), seed=1, dtype=dtype) * 0.8
    points = tie_free_clouds(2, count, camera(), seed=2, dtype=dtype)
    return points.requires_grad_(), dp.splat_depth(target, camera(dtype)).depth


def front_case(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """3 clouds before 2 views: views 1 and 3 of 6 have an empty map, and the third cloud is out of sight."""
    points, depth = scene(dtype)
    away = tie_free_clouds(1, points.shape[1], camera(), seed=3, dtype=dtype) + torch.tensor([3, 0, -3])
    depth = torch.cat((depth, depth[1:].flip(1)))
    depth[0, 1] = depth[1, 1] = torch.inf
    return torch.cat((points.detach(), away)).requires_grad_(), depth


def test_front_terms_count_the_points_that_they_compared():
    points, depth = front_case(torch.float32)
    terms = dp.front_terms(points, camera(torch.float32), depth)
    seen = dp.splat_depth(points, camera(torch.float32)).visible.sum(-1)
    seen[2] = points.shape[1]
    observed = depth.isfinite().sum((-2, -1))
    assert torch.equal(terms.observed, observed)
    assert torch.equal(terms.matched, seen.minimum(observed))
    assert terms.fallback.tolist() == [[False, False], [False, False], [True, True]]
    depth[2, 0] = torch.inf  # with nothing to compare, nothing is visible or not
    terms = dp.front_terms(points, camera(torch.float32), depth)
    assert terms.fallback[2].tolist() == [False, True]
    assert terms.matched[2, 0] == terms.observed[2, 0] == terms.loss[2, 0] == 0


@pytest.mark.parametrize("distance", ["chamfer", "emd"])
def test_front_terms_are_the_distances_of_the_padded_sets_to_the_bit(distance):
    points, depth = scene(torch.float32)
    sets = dp.front_sets(points, camera(torch.float32), depth)
    lengths = {"a_lengths": sets.predicted_lengths, "b_lengths": sets.observed_lengths}
    if distance == "chamfer":
        expected = sum(dp.chamfer_distance(sets.predicted, sets.observed, squared=False, **lengths))
    else:
        expected = dp.earth_mover_distance(sets.predicted, sets.observed, **lengths).cost
    terms = dp.front_terms(points, camera(torch.float32), depth, distance=distance)
    constraint = dp.front_constraint(points, camera(torch.float32), depth, distance=distance)
    assert torch.equal(terms.loss, expected)
    assert torch.equal(constraint, expected.mean())
    x, y = (torch.autograd.grad(loss, points)[0] for loss in (constraint, expected.mean()))
    assert torch.equal(x, y)


@pytest.mark.parametrize("distance", ["chamfer", "emd"])
def test_a_batch_of_empty_depth_maps_has_loss_and_gradient_zero(distance):
    points, depth = scene(torch.float32)
    terms = dp.front_terms(
        points, camera(torch.float32), torch.full_like(depth, torch.inf), distance=distance
    )
    (gradient,) = torch.autograd.grad(terms.loss.sum(), points)
    assert not any(value.any() for value in (*terms, gradient))


def test_the_projection_loss_moves_points_along_the_optical_axis_only_and_the_front_constraint_does_not():
    """In the camera's frame: x and y of the projection loss's gradient are zero to the last bit."""
    view = dp.PinholeCamera(torch.tensor([[30.0, 0, 8], [0, 30.0, 7], [0, 0, 1]]), torch.eye(4), 14, 16)
    generator = torch.Generator().manual_seed(3)
    target = torch.rand(1, 500, 3, generator=generator) * 0.6 + torch.tensor([-0.3, -0.3, 1.5])
    points = (
        torch.rand(1, 500, 3, generator=generator) * 0.8 + torch.tensor([-0.4, -0.4, 1.5])
    ).requires_grad_()
    depth = dp.splat_depth(target, view).depth
    (projection,) = torch.autograd.grad(dp.projection_loss(points, view, depth), points)
    (front,) = torch.autograd.grad(dp.front_constraint(points, view, depth), points)
    assert (projection[..., :2] == 0).all()
    assert (projection[..., 2] != 0).any()
    assert front[..., :2].norm() / front.norm() > 0.3
    outside = torch.isinf(depth)[0, 0][
        tuple(dp.project(points, view).pixels[0, 0].long().T.flip(0).clamp(min=0, max=13))
    ]
    visible = dp.splat_depth(points, view).visible[0, 0]
    assert (projection[0, outside & visible] == 0).all()
    assert (front[0, outside & visible].norm(dim=-1) > 0).all()


def test_front_sets_compare_what_the_views_show():
    points, depth = scene(torch.float32)
    sets = dp.front_sets(points, camera(torch.float32), depth)
    assert torch.equal(sets.predicted_lengths, dp.splat_depth(points, camera(torch.float32)).visible.sum(-1))
    assert torch.equal(sets.observed_lengths, torch.isfinite(depth).sum((-2, -1)))
    assert sets.observed.shape[2] == sets.observed_lengths.max()
    assert not sets.fallback.any()


def test_a_cloud_out_of_sight_is_pulled_into_view():
    _, depth = scene(torch.float32)
    away = torch.full((2, 10, 3), 50.0).add_(torch.rand(2, 10, 3)).requires_grad_()
    for distance in ("chamfer", "emd"):
        with pytest.warns(RuntimeWarning, match="no predicted point is visible"):
            loss = dp.front_constraint(away, camera(torch.float32), depth, distance=distance)
        (gradient,) = torch.autograd.grad(loss, away)
        assert torch.isfinite(loss)
        assert (gradient.sum(1) > 0).all()  # a step against it leads back to the origin


def test_the_front_constraint_warns_of_an_empty_depth_map():
    points, depth = scene(torch.float32)
    depth[0, 1] = torch.inf
    with pytest.warns(RuntimeWarning, match=r"in 1 of 4 views the depth map is empty.* \(0, 1\)"):
        loss = dp.front_constraint(points, camera(torch.float32), depth, reduction="none")
    assert torch.equal(loss, dp.front_terms(points, camera(torch.float32), depth).loss)
    assert dp.projection_loss(points, camera(torch.float32), torch.full_like(depth, torch.inf)) == 0


def test_diversity_is_satisfied_by_shapes_that_differ_enough():
    codes = torch.tensor([[[0.0]], [[2.0]]])
    clouds = torch.zeros(2, 1, 6, 3)
    clouds[1, ..., 0] = 0.5
    assert dp.diversity_loss(codes, clouds, alpha=4.0).item() == pytest.approx(0.0, abs=1e-6)
    assert dp.diversity_loss(codes, clouds, alpha=3.0).item() == pytest.approx(0.5, rel=1e-5)
    assert dp.diversity_loss(codes, clouds[:1].expand(2, -1, -1, -1), alpha=4.0).item() == pytest.approx(2.0)


def test_consistency_is_the_mean_over_pairs_and_zero_for_equal_predictions():
    clouds = torch.rand(4, 25, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pairs = [
        sum(dp.chamfer_distance(clouds[i], clouds[j], squared=False))
        for i, j in itertools.combinations(range(4), 2)
    ]
    assert_close(dp.consistency_loss(clouds), torch.stack(pairs).mean())
    assert dp.consistency_loss(clouds[:1].expand(3, -1, -1)) == 0
