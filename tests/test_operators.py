"""The ops as torch operators: registered, traceable, and refusing a second derivative by name."""

import pytest
import torch

import diffpoint as dp

B, V, N, M, H, W = 2, 2, 9, 7, 6, 5


def operator_arguments() -> dict[str, tuple]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(B, N, 3, generator=generator).requires_grad_()
    b = torch.rand(B, M, 3, generator=generator).requires_grad_()
    lengths = torch.tensor([N, 4]), torch.tensor([3, M])
    camera = dp.PinholeCamera.look_at(
        torch.tensor([[0.0, 0, -2], [2, 0, 0]]), focal_px=5.0, height=H, width=W
    )
    camera = camera.expand(B, V)
    projection = camera.projection.clone().requires_grad_()
    depth = dp.splat_depth(a.detach(), camera).depth.requires_grad_()
    return {
        "nearest": (a, b, *lengths, "nearest", 0),
        "splat": (a, lengths[0], projection, H, W, 0.0),
        "project": (a, projection, "project"),
        "unproject": (depth, camera.back_projection.clone().requires_grad_(), True, "unproject"),
        "earth_mover_distance": (a, b, *lengths, 0.02),
        "approxmatch": (a, b, *lengths, True),
        "farthest_point_sample": (a.detach(), lengths[0], 3, 0),
        "sample_view": (a, dp.splat_depth(a, camera).visible),
    }


@pytest.mark.parametrize("name", operator_arguments())
def test_operators_pass_opcheck(name):
    operator = getattr(torch.ops.diffpoint, name).default
    torch.library.opcheck(operator, operator_arguments()[name])


@pytest.mark.parametrize(
    "function",
    [
        lambda a, b: dp.nearest(a, b).squared_distance.sum(),
        lambda a, b: dp.earth_mover_distance(a, b).cost.sum(),
    ],
)
def test_a_second_derivative_is_refused(function):
    a, b = torch.rand(1, 5, 3, requires_grad=True), torch.rand(1, 5, 3)
    (gradient,) = torch.autograd.grad(function(a, b), a, create_graph=True)
    with pytest.raises(RuntimeError, match=r"diffpoint\.\w+_backward.* no autograd formula"):
        gradient.square().sum().backward()
