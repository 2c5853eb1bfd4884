"""Inverse maps by Newton's method."""

import torch
from map_samples import activation, planar
from metric_samples import Disc
from torch.func import jacfwd, jacrev, vmap

from nsm.maps import TransitionMap, inverted


def stirred(seed, scale=0.15):
    torch.manual_seed(seed)
    h = planar("disc", activation("Tanh"), width=8, depth=1)
    for p in h.network.output.parameters():
        torch.nn.init.normal_(p, std=scale)
    return h


def disc(n, seed=0):
    g = torch.Generator().manual_seed(seed)
    r = torch.rand(n, generator=g, dtype=torch.float64).sqrt()
    t = 2 * torch.pi * torch.rand(n, generator=g, dtype=torch.float64)
    return torch.stack([r * t.cos(), r * t.sin()], dim=1)


def test_the_inverse_undoes_the_map():
    h, x = stirred(0), disc(300)
    assert (torch.linalg.det(h.value_and_jacobian(x)[1]) > 0).all()
    assert (inverted(h, h(x), h(x)) - x).norm(dim=1).max() < 1e-9


def test_a_point_without_preimage_is_never_farther_than_the_start():
    h, start = stirred(1), disc(20)
    targets = torch.full((20, 2), 5.0, dtype=torch.float64)
    before = (h(start) - targets).norm(dim=1)
    assert ((h(inverted(h, targets, start)) - targets).norm(dim=1) <= before + 1e-12).all()


def test_between_two_maps_goes_through_the_common_domain():
    first, second, x = stirred(2), stirred(3), disc(200)
    between = TransitionMap(first, second, disc(400, seed=1))
    assert (between(first(x)) - second(x)).norm(dim=1).max() < 1e-8
    back = TransitionMap(second, first, disc(400, seed=1))
    assert (back(between(first(x))) - first(x)).norm(dim=1).max() < 1e-8


def test_points_of_the_rim_come_back_to_the_rim():
    h = stirred(4, scale=0.08)
    t = torch.linspace(0, 6.28, 200, dtype=torch.float64)
    rim = torch.stack([t.cos(), t.sin()], dim=1)
    back = TransitionMap(h, h, disc(400), Disc().project).back(rim)
    assert (h(back) - rim).norm(dim=1).max() < 1e-8
    assert (back.norm(dim=1) - 1).abs().max() < 1e-6


def test_derivatives_are_those_of_the_inverse_function_theorem():
    between = TransitionMap(stirred(2), stirred(3), disc(400, seed=1))
    x = between.first(0.9 * disc(20, seed=2)).detach()
    value, jacobian = between.value_and_jacobian(x)
    torch.testing.assert_close(value, between(x))
    for derivative in (jacrev, jacfwd):
        expected = vmap(derivative(lambda p: between(p[None])[0]))(x)
        torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-9)
    step = 1e-6 * torch.tensor([[1.0, 0.0]], dtype=x.dtype)
    slope = (between(x + step) - between(x - step)) / 2e-6
    torch.testing.assert_close(jacobian[..., 0], slope, rtol=0, atol=1e-5)
