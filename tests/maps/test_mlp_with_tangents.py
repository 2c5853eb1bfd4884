"""The hand-written backward pass, against finite differences and against plain autograd."""

import pytest
import torch
from map_samples import ACTIVATIONS, activation, network
from torch.autograd.graph import saved_tensors_hooks

from nsm.maps import BLOCKS, LatticeSplineGrid, MultilevelSpline, SplineGrid, mlp_with_tangents


def made(name: str, block: str, depth: int = 2, width: int = 5) -> torch.nn.Module:
    torch.manual_seed(0)
    act = {"_target_": name}
    if "." not in name:
        act = activation(name, **({"omega": 2.0} if name == "Sine" else {}))
    net = network(act, width=width, depth=depth, block=block)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(0.5 * torch.randn_like(parameter))
    return net


def points(n: int = 4) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return 2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1


def loss_of(value: torch.Tensor, jacobian: torch.Tensor) -> torch.Tensor:
    """Something that no derivative of value or Jacobian leaves untouched."""
    return (value.sin() * jacobian[:, :, 0] + jacobian.square().sum(dim=2)).sum()


def plain_gradients(net: torch.nn.Module, x: torch.Tensor) -> tuple[dict, torch.Tensor]:
    """The loss's gradients by all parameters and by x, by autograd through the bare network."""

    def loss(parameters, x):
        def f(p):
            return torch.func.functional_call(net, parameters, (p[None],))[0]

        return loss_of(torch.func.vmap(f)(x), torch.func.vmap(torch.func.jacfwd(f))(x))

    parameters = {name: p.detach() for name, p in net.named_parameters()}
    return torch.func.grad(loss, argnums=(0, 1))(parameters, x)


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("name", [*ACTIVATIONS, "torch.nn.Mish"])
def test_finite_differences(name, block):
    net = made(name, block, width=3)
    parameters = list(net.parameters())
    assert torch.autograd.gradcheck(
        lambda x, *_: net.value_and_jacobian(x), (points(2).requires_grad_(), *parameters)
    )


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("at_once", [1, 10**9], ids=["chunks", "whole"])
@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("name", [*ACTIVATIONS, "torch.nn.Softsign"])
def test_plain_autograd(name, block, at_once, frozen, monkeypatch):
    monkeypatch.setattr(mlp_with_tangents, "_AT_ONCE", at_once)
    net, x = made(name, block).requires_grad_(not frozen), points().requires_grad_()
    loss_of(*net.value_and_jacobian(x)).backward()
    by_parameter, by_point = plain_gradients(net, x.detach())
    torch.testing.assert_close(x.grad, by_point, rtol=1e-9, atol=1e-9)
    for name, parameter in net.named_parameters():
        if frozen:
            assert parameter.grad is None
        else:
            torch.testing.assert_close(parameter.grad, by_parameter[name], rtol=1e-9, atol=1e-9)


def test_parameters_alone():
    """Samples that need no gradient: that by the parameters is the same."""
    net = made("Softplus", "post")
    loss_of(*net.value_and_jacobian(points())).backward()
    for name, expected in plain_gradients(net, points())[0].items():
        torch.testing.assert_close(net.get_parameter(name).grad, expected, rtol=1e-9, atol=1e-9)


def floats_kept(net: torch.nn.Module, x: torch.Tensor) -> int:
    """Numbers that the recorded passes keep, beside parameters."""
    kept = []

    def pack(tensor):
        if not isinstance(tensor, torch.nn.Parameter):
            kept.append(tensor.numel())
        return tensor

    with saved_tensors_hooks(pack, lambda t: t):
        net.value_and_jacobian(x)
    return sum(kept)


def test_what_is_kept():
    """Of each hidden layer, its result; nothing where there is nothing to differentiate."""
    net, x = made("Softplus", "post", depth=3), points(8)
    stack = 3 * 8 * 5
    assert floats_kept(net, x) == 7 * stack + 3 * 8 * 2
    frozen = net.requires_grad_(False)
    assert floats_kept(frozen, x.requires_grad_()) <= 7 * stack + 8 * 2
    assert floats_kept(frozen, x.detach()) == 0
    with torch.no_grad():
        assert floats_kept(net.requires_grad_(), x) == 0


def matrix_products(net: torch.nn.Module, x: torch.Tensor) -> int:
    with torch.profiler.profile() as profile:
        value, jacobian = net.value_and_jacobian(x)
        (value.sum() + jacobian.sum()).backward()
    counts = {event.key: event.count for event in profile.key_averages()}
    return sum(counts.get(name, 0) for name in ("aten::mm", "aten::addmm", "aten::addmm_"))


def test_frozen_weights_cost_nothing():
    net, x = made("Softplus", "plain", depth=3), points().requires_grad_()
    layers = 5
    assert matrix_products(net, x) == 3 * layers
    assert matrix_products(net.requires_grad_(False), x) == 2 * layers
    net.requires_grad_()
    assert matrix_products(net, x.detach()) == 3 * layers - 1


def test_no_points_and_no_hidden_layers():
    net = made("Tanh", "plain", depth=0)
    value, jacobian = net.value_and_jacobian(points(0))
    assert value.shape == (0, 3) and jacobian.shape == (0, 3, 2)
    loss_of(value, jacobian).backward()
    assert all((p.grad == 0).all() for p in net.parameters())


@pytest.mark.parametrize("degree", [2, 3])
def test_spline_grid_by_finite_differences(degree):
    torch.manual_seed(0)
    grid = SplineGrid(2, resolutions=[3, 5], features=2, degree=degree, extent=0.9).double()
    x = points(6)  # some beyond the rim, where the grid goes on as a constant
    assert (x.abs() > 0.9).any()

    def f(x, *tables):
        return grid.value_and_jacobian_stack(x)

    assert torch.autograd.gradcheck(f, (x.requires_grad_(), *grid.tables))
    tangents = torch.func.vmap(torch.func.jacfwd(lambda p: grid(p[None])[0]))(x.detach())
    stack = grid.value_and_jacobian_stack(x)
    torch.testing.assert_close(stack[0], grid(x))
    torch.testing.assert_close(stack[1:], tangents.permute(2, 0, 1))


@pytest.mark.parametrize(
    "grid", [SplineGrid(resolutions=[3, 5]), LatticeSplineGrid([[4, 8]]), MultilevelSpline(2, 8)]
)
def test_no_points_of_spline_grids(grid):
    """As where an inversion has met all its targets."""
    if isinstance(grid, MultilevelSpline):
        value, jacobian = grid.value_and_jacobian(torch.zeros(0, 2))
        assert value.shape == (0, 2) and jacobian.shape == (0, 2, 2)
        jacobian.sum().backward()
    else:
        stack = grid.value_and_jacobian_stack(torch.zeros(0, 2))
        assert stack.shape == (3, 0, grid.out_dim)
        stack.sum().backward()
    assert all(not p.grad.any() for p in grid.parameters())


def test_frozen_spline_grid_keeps_derivatives_alone():
    grid = SplineGrid(2, resolutions=[8, 16], features=4).requires_grad_(False)
    kept = []
    x = torch.rand(10, 2).requires_grad_()
    with saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda t: t):
        grid.value_and_jacobian_stack(x)
    assert sum(kept) == 5 * 10 * 8
