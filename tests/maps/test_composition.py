"""Composed and rotated maps: the chain rule against automatic differentiation."""

import math

import pytest
import torch
from map_samples import encoding, network
from torch import nn

from nsm.maps.analytic import build_analytic
from nsm.maps.composition import Composition, Rotated


def planar_map(seed=0):
    torch.manual_seed(seed)
    return network(out_dim=2, width=16, depth=2, block="plain")


def turn(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


def points(n=50):
    return torch.rand(n, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5


MAPS = {
    "analytic": lambda: Composition(build_analytic({"name": "torus_patch"}), planar_map()),
    "neural": lambda: Composition(
        network(enc=encoding("RandomFourierFeatures", features=4), width=16, depth=2),
        planar_map(),
    ),
    "planar": lambda: Composition(planar_map(1), planar_map(2)),
    "rotated": lambda: Rotated(planar_map(), turn(0.7)),
    "all": lambda: Composition(
        build_analytic({"name": "graph", "z": "sin(2*u)*v"}), Rotated(planar_map(), turn(-2.0))
    ),
}


@pytest.mark.parametrize("name", MAPS)
def test_chain_rule(name):
    mapping, x = MAPS[name](), points()
    value, jacobian = mapping.value_and_jacobian(x)
    expected = torch.vmap(torch.func.jacfwd(lambda p: mapping(p[None])[0]))(x)
    torch.testing.assert_close(value, mapping(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-10)


def test_jacobian_trains_the_inner_map():
    inner = planar_map()
    mapping = Composition(build_analytic({"name": "paraboloid"}), inner)
    weight = inner.output.weight

    def loss(w):
        with torch.no_grad():
            weight.copy_(w)
        return mapping.value_and_jacobian(points(5))[1].square().sum()

    start = weight.detach().clone()
    loss(start).backward()
    step = torch.randn(start.shape, generator=torch.Generator().manual_seed(0)).double()
    slope = (loss(start + 1e-5 * step) - loss(start - 1e-5 * step)).item() / 2e-5
    assert (weight.grad * step).sum().item() == pytest.approx(slope, rel=1e-6)


def test_rotation_turns_the_input_by_its_columns():
    quarter = Rotated(build_analytic({"name": "plane"}), turn(math.pi / 2))
    got = quarter(torch.tensor([[1.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(got, torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))


def test_rotation_is_kept_in_the_state_and_not_trained():
    mapping = Rotated(planar_map(), turn(0.3))
    other = Rotated(planar_map(5), turn(2.0))
    other.load_state_dict(mapping.state_dict())
    torch.testing.assert_close(other(points()), mapping(points()))
    assert "rotation" not in dict(mapping.named_parameters())


@pytest.mark.parametrize(
    "matrix",
    [
        torch.diag(torch.tensor([1.0, -1.0])),
        2 * torch.eye(2),
        torch.zeros(2, 2),
        torch.full((2, 2), math.nan),
        torch.eye(3),
    ],
)
def test_what_is_not_a_rotation_is_refused(matrix):
    with pytest.raises(ValueError, match="rotation"):
        Rotated(nn.Identity(), matrix)
