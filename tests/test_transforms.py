"""The ops under `torch.func`: reverse mode and vmap work, forward mode is refused by name, alone and in combination."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from test_operators import operator_arguments
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

import diffpoint as dp

# torch's own, when it loads its formulas of forward mode
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

OPERATORS = {
    name: (getattr(torch.ops.diffpoint, name).default, arguments)
    for name, arguments in operator_arguments().items()
}
DIFFERENTIABLE = [
    name for name, (_, values) in OPERATORS.items() if any(getattr(v, "requires_grad", False) for v in values)
]
CAMERA = dp.PinholeCamera.look_at(torch.tensor([[0.0, 0, -2], [2, 0, 0]]), focal_px=9.0, height=7, width=6)
DEPTH = torch.full((2, 2, 7, 6), 2.0)
OTHER = torch.rand(2, 7, 3, generator=torch.Generator().manual_seed(1)) - 0.5

# Public functions of one batch of clouds that return floats.
FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "nearest": lambda x: dp.nearest(x, OTHER).squared_distance,
    "knn": lambda x: dp.knn(x, x, 2, exclude_self=True).squared_distance,
    "chamfer_distance": lambda x: sum(dp.chamfer_distance(x, OTHER, squared=False)),
    "hausdorff_distance": lambda x: dp.hausdorff_distance(x, OTHER),
    "minimal_matching_distance": lambda x: dp.minimal_matching_distance(x, OTHER, squared=True),
    "total_mutual_difference": lambda x: dp.total_mutual_difference(x, squared=True),
    "unidirectional_hausdorff_distance": lambda x: dp.unidirectional_hausdorff_distance(x[0], OTHER),
    "earth_mover_distance": lambda x: dp.earth_mover_distance(x, OTHER).cost,
    "earth_mover_distance, squared": lambda x: dp.earth_mover_distance(x, OTHER, squared=True).cost,
    "approxmatch": lambda x: dp.approxmatch(x, OTHER),
    "splat_depth": lambda x: dp.splat_depth(x, CAMERA).depth.clamp(max=9),
    "soft_splat": lambda x: dp.soft_splat(x, CAMERA).mask,
    "project": lambda x: dp.project(x, CAMERA).pixels,
    "unproject": lambda x: dp.unproject(x.sum().abs() + DEPTH, CAMERA).points,
    "reproject": lambda x: dp.reproject(x.sum().abs() + DEPTH, CAMERA, CAMERA[[1, 0]]).points,
    "consistency_loss": lambda x: dp.consistency_loss(torch.stack((x, x.flip(0)), 1)),
    "farthest_point_sample": lambda x: torch.take_along_dim(x, dp.farthest_point_sample(x, 3)[..., None], -2),
    "sample_view": lambda x: dp.sample_view(x, dp.visible_points(x, CAMERA)).points,
    "camera": lambda x: dp.PinholeCamera.look_at(x[0, 0], focal_px=9.0, height=7, width=6).position,
    "front_constraint": lambda x: dp.front_constraint(x, CAMERA, DEPTH),
    "projection_loss": lambda x: dp.projection_loss(x, CAMERA, DEPTH),
    "soft_projection_loss": lambda x: dp.soft_projection_loss(x, CAMERA, DEPTH),
    "diversity_loss": lambda x: dp.diversity_loss(x[..., 0].reshape(2, 1, -1), x[:, None], alpha=1.0),
}


@pytest.fixture
def cloud() -> Tensor:
    return torch.rand(2, 9, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    at = at.clone().requires_grad_()
    return torch.autograd.grad(function(at).sum(), at)[0]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_reverse_mode(name, cloud):
    function = FUNCTIONS[name]
    expected = gradient(function, cloud)
    assert expected.any()
    torch.testing.assert_close(grad(lambda x: function(x).sum())(cloud), expected)
    value, pullback = vjp(function, cloud)
    torch.testing.assert_close(pullback(torch.ones_like(value))[0], expected)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_jacobians(name, cloud):
    """jacrev maps the backward pass over all outputs at once."""
    function = FUNCTIONS[name]
    jacobian = jacrev(function)(cloud)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(function, cloud))


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - {"sample_view"}))
def test_vmap(name, cloud):
    function = FUNCTIONS[name]
    clouds = torch.stack((cloud, cloud.flip(0), cloud + 0.1), 1)  # mapped over the second dimension
    one_by_one = [clouds[:, i] for i in range(3)]
    torch.testing.assert_close(vmap(function, 1)(clouds), torch.stack([function(c) for c in one_by_one]))
    gradients = vmap(grad(lambda x: function(x).sum()), 1)(clouds)
    torch.testing.assert_close(gradients, torch.stack([gradient(function, c) for c in one_by_one]))
    outside = grad(lambda x: vmap(function, 1)(x).sum())(clouds)
    torch.testing.assert_close(outside, gradients.movedim(0, 1))


def test_vmap_over_nothing(cloud):
    assert vmap(FUNCTIONS["nearest"])(cloud[None][:0]).shape == (0, 2, 9)


def test_vmap_pads_to_the_largest_sample(cloud):
    clouds = torch.stack((cloud, cloud[:, :1].expand_as(cloud)))
    sizes = [FUNCTIONS["sample_view"](c).shape[2] for c in clouds]
    assert sizes[0] > sizes[1] == 1
    sampled = vmap(FUNCTIONS["sample_view"])(clouds)
    assert sampled.shape[3] == sizes[0]
    assert not sampled[1, :, :, 1:].any()


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_forward_mode_is_refused_by_name(name):
    operator, values = OPERATORS[name]
    values = [v.detach() if isinstance(v, Tensor) else v for v in values]
    which = [i for i, v in enumerate(OPERATORS[name][1]) if getattr(v, "requires_grad", False)]

    def function(*inputs: Tensor):
        return operator(*(inputs[which.index(i)] if i in which else v for i, v in enumerate(values)))

    inputs = tuple(values[i] for i in which)
    message = rf"diffpoint\.{name} has no forward-mode derivative .* reverse mode"
    with pytest.raises(NotImplementedError, match=message):
        jvp(function, inputs, inputs)
    for chosen in range(len(which)):
        with pytest.raises(NotImplementedError, match=message):
            jacfwd(function, chosen)(*inputs)
        for leaf in (False, True):
            with forward_ad.dual_level(), pytest.raises(NotImplementedError, match=message):
                dual = [x.clone().requires_grad_(leaf) for x in inputs]
                dual[chosen] = forward_ad.make_dual(dual[chosen], inputs[chosen])
                function(*dual)
    result = operator(*values)
    with forward_ad.dual_level():  # without a tangent there is nothing to refuse
        for x, y in zip(
            torch.utils._pytree.tree_leaves(function(*inputs)),
            torch.utils._pytree.tree_leaves(result),
            strict=True,
        ):
            assert torch.equal(x, y)


def test_every_backward_pass_refuses_forward_mode_by_name(cloud):
    _, pullback = vjp(lambda x: dp.nearest(x, OTHER).squared_distance, cloud)
    with pytest.raises(NotImplementedError, match=r"diffpoint\.nearest_backward has no forward-mode"):
        jvp(pullback, (torch.ones(2, 9),), (torch.ones(2, 9),))


def test_indices_have_no_tangent(cloud):
    for function in (
        lambda x: dp.farthest_point_sample(x, 3),
        lambda x: dp.visible_points(x, CAMERA, method="horizon"),
    ):
        value, tangent = jvp(function, (cloud,), (cloud,))
        assert torch.equal(value, function(cloud))
        assert not tangent.any()


def test_second_derivatives_are_refused_by_name(cloud):
    def loss(x: Tensor) -> Tensor:
        return dp.nearest(x, OTHER).squared_distance.sum()

    with pytest.raises(NotImplementedError, match=r"diffpoint\.nearest has no forward-mode"):
        hessian(loss)(cloud)
    with pytest.raises(RuntimeError, match=r"diffpoint\.nearest_backward has no autograd formula.*second"):
        jacrev(jacrev(loss))(cloud)


def test_a_gradient_inside_of_one(cloud):
    """The inner level of torch.func, the outer one of autograd and of torch.func."""
    other = OTHER.clone().requires_grad_()

    def inner(scale: Tensor, b: Tensor) -> Tensor:
        return grad(lambda s: (s * s * dp.nearest(cloud, b).squared_distance).sum())(scale)

    # d/ds of s^2 D(b) is 2 s D(b), whose gradient with respect to b is 2 s dD/db.
    expected = 6 * gradient(lambda b: dp.nearest(cloud, b).squared_distance, OTHER)
    (by_autograd,) = torch.autograd.grad(inner(torch.tensor(3.0), other), other)
    torch.testing.assert_close(by_autograd, expected)
    torch.testing.assert_close(grad(inner, 1)(torch.tensor(3.0), OTHER), expected)


def test_compiled_transforms(cloud):
    function = grad(lambda x: FUNCTIONS["chamfer_distance"](x).sum())
    compiled = torch.compile(function, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(cloud), function(cloud))
    clouds = torch.stack((cloud, cloud + 0.1))
    torch.testing.assert_close(
        torch.compile(vmap(function), backend="aot_eager", fullgraph=True)(clouds), vmap(function)(clouds)
    )
