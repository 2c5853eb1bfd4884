"""Planar maps: identity at the start, on the boundary by construction, Jacobians."""

import pytest
import torch
from map_samples import PLANAR, activation, planar
from torch.func import jacfwd, jacrev, vmap

from nsm.errors import NsmError
from nsm.maps import NeuralMap, StartedMap, build_network, build_stored

SMALL = {"width": 8, "depth": 1, "act": activation("Tanh")}
KINDS = [None, "disc", "square"]


def stirred(onto, scale=0.3):
    torch.manual_seed(0)
    h = planar(onto, **SMALL)
    for p in h.network.output.parameters():
        torch.nn.init.normal_(p, std=scale)
    return h


def points(n=64):
    torch.manual_seed(1)
    return (2 * torch.rand(n, 2, dtype=torch.float64) - 1) * 0.7


@pytest.mark.parametrize("onto", KINDS)
def test_it_starts_as_the_identity(onto):
    h = planar(onto, **SMALL)
    value, jacobian = h.value_and_jacobian(points())
    assert (value - points()).abs().max() == 0
    assert (jacobian - torch.eye(2)).abs().max() == 0


@pytest.mark.parametrize("onto", KINDS)
def test_jacobians_are_those_of_automatic_differentiation(onto):
    h = stirred(onto)
    value, jacobian = h.value_and_jacobian(points())
    assert (value - h(points())).abs().max() < 1e-12
    for derivative in (jacrev, jacfwd):
        expected = vmap(derivative(lambda x: h(x[None])[0]))(points())
        assert (jacobian - expected).abs().max() < 1e-10
    one_by_one = vmap(lambda x: tuple(t[0] for t in h.value_and_jacobian(x[None])))(points())
    torch.testing.assert_close(one_by_one, (value, jacobian))


def test_the_circle_goes_to_itself_and_slides():
    h = stirred("disc")
    t = torch.linspace(0, 6, 40, dtype=torch.float64)
    rim = torch.stack([t.cos(), t.sin()], dim=1)
    assert (h(rim).norm(dim=1) - 1).abs().max() < 1e-12
    assert (h(rim) - rim).abs().max() > 0.05


def test_each_side_of_the_square_goes_to_itself_and_corners_stay():
    h = stirred("square")
    along = torch.linspace(-1, 1, 9, dtype=torch.float64)
    side = torch.stack([torch.ones_like(along), along], dim=1)
    for p in (side, -side, side.flip(1), -side.flip(1)):
        fixed = (p[0] == p[1]).nonzero().item()
        assert (h(p)[:, fixed] - p[:, fixed]).abs().max() < 1e-12
        assert (h(p)[[0, -1]] - p[[0, -1]]).abs().max() < 1e-12
    assert (h(side) - side).abs().max() > 0.02


@pytest.mark.parametrize("onto", KINDS)
def test_config_builds_the_same_kind(onto):
    h = stirred(onto)
    twin = build_stored(h.config).double()
    twin.load_state_dict(h.state_dict())
    assert twin.config == h.config
    assert (twin(points()) - h(points())).abs().max() == 0


@pytest.mark.parametrize("onto", KINDS)
def test_a_network_of_the_user_is_zero_at_the_start(onto):
    kind = PLANAR[onto]
    network = torch.nn.Sequential(
        torch.nn.Linear(2, 4), torch.nn.Tanh(), torch.nn.Linear(4, kind.network_out_dim)
    )
    assert torch.equal(kind(network)(points().float()), points().float())


def test_a_network_without_a_last_layer_is_refused():
    outputs = torch.nn.Linear(2, 2)
    for network in (torch.nn.Tanh(), torch.nn.Linear(2, 5), torch.nn.Sequential(outputs, Shift())):
        with pytest.raises(NsmError) as error:
            PLANAR[None](network)
        assert error.value.kind == "unsuitable_network"


class Shift(torch.nn.Module):
    def forward(self, x):
        return x + 1


def test_a_start_is_added_and_not_trained():
    torch.manual_seed(0)
    grid = {"_target_": "nsm.maps.encodings.SplineGrid", "resolutions": [4], "features": 2}
    start = build_network({"_target_": "nsm.maps.LinearInFeatures"}, encoding=grid, out_dim=2)
    h = StartedMap(NeuralMap(out_dim=2, width=8, depth=1), start).double()
    x = points()
    assert torch.equal(h(x), start(x))
    assert {name.split(".")[0] for name, p in h.named_parameters() if p.requires_grad} == {
        "network"
    }
    torch.nn.init.normal_(h.network.output.weight)
    value, jacobian = h.value_and_jacobian(x)
    torch.testing.assert_close(value, h(x))
    expected = vmap(jacrev(lambda p: h(p[None])[0]))(x)
    torch.testing.assert_close(jacobian, expected)
    again = build_stored(h.config).double()
    again.load_state_dict(h.state_dict())
    assert torch.equal(again(x), value)
