"""Networks and maps of any make: Jacobians are autograd's, inverses undo, compositions chain."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from map_samples import ACTIVATIONS, activation, encoding, network, planar
from metric_samples import Disc, Square
from thorough import examples

from nsm.maps import BLOCKS, Composition, Rotated, TransitionMap, inverted

DOMAINS = {None: None, "disc": Disc(), "square": Square()}

POINTS = st.lists(st.tuples(*[st.floats(-1, 1)] * 2), min_size=1, max_size=4).map(
    lambda rows: torch.tensor(rows, dtype=torch.float64)
)
SETTINGS = st.fixed_dictionaries(
    {
        "width": st.integers(1, 6),
        "depth": st.integers(0, 3),
        "block": st.sampled_from(sorted(BLOCKS)),
        # at its usual 30, a few layers of sines multiply rounding errors by millions
        "act": st.sampled_from(ACTIVATIONS).map(
            lambda name: activation(name, **({"omega": 3.0} if name == "Sine" else {}))
        ),
        "enc": st.sampled_from(
            [
                encoding("Identity"),
                encoding("RandomFourierFeatures", features=2, sigma=0.5),
                encoding("SplineGrid", resolutions=[3, 5], features=2),
            ]
        ),
        "initialization": st.sampled_from(["xavier", "kaiming", "siren"]),
    }
)


def check_jacobian(map_, x):
    """Forward and value_and_jacobian agree, and with reverse-mode differentiation of forward."""
    value, jacobian = map_.value_and_jacobian(x)
    assert torch.allclose(value, map_(x), rtol=1e-9, atol=1e-9)
    by_rows = torch.autograd.functional.jacobian(lambda p: map_(p).sum(dim=0), x)
    assert torch.allclose(jacobian, by_rows.permute(1, 0, 2), rtol=1e-6, atol=1e-7)


def shaken(map_, seed):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in map_.parameters():
            p += 0.2 * torch.randn(p.shape, generator=generator)
    return map_.double()


@examples(20)
@given(SETTINGS, st.sampled_from([2, 3]), st.integers(0, 10**6), POINTS)
def test_any_network(settings, out_dim, seed, x):
    torch.manual_seed(seed)
    check_jacobian(shaken(network(out_dim=out_dim, **settings), seed), x)


@examples(12)
@given(SETTINGS, st.sampled_from([None, "disc", "square"]), st.floats(-4, 4), POINTS)
def test_any_map_of_surfaces(settings, onto, angle, x):
    """ψ∘h∘R, as in every map between surfaces."""
    torch.manual_seed(0)
    h = shaken(planar(onto, **settings), 1)
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    turn = torch.stack([torch.stack([c, -s]), torch.stack([s, c])]).double()
    psi = shaken(network(width=4, depth=1, block="plain"), 2)
    check_jacobian(Rotated(h, turn), x)
    check_jacobian(Composition(psi, Rotated(h, turn)), x)


def small(onto, seed):
    """A map near the identity, injective."""
    map_ = planar(onto, width=4, depth=1, block="plain")
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in map_.parameters():
            p += 0.05 * torch.randn(p.shape, generator=generator)
    return map_.requires_grad_(False)


@pytest.mark.parametrize("onto", [None, "disc", "square"])
@examples(6)
@given(x=POINTS)
def test_an_inverse_undoes_its_map(onto, x):
    h, project = small(onto, 0), getattr(DOMAINS[onto], "project", None)
    if onto == "disc":
        x = x / x.norm(dim=1, keepdim=True).clamp(min=1)
    there = h(x)
    back = inverted(h, there, there.clone(), project)
    assert (back - x).norm(dim=1).max() < 1e-6
    nodes = torch.cartesian_prod(*[torch.linspace(-1, 1, 9, dtype=torch.float64)] * 2)
    if onto == "disc":
        nodes = nodes[nodes.norm(dim=1) <= 1]
    second = small(onto, 0)
    # h and itself: the way there and back is none; and with another, it is that one alone
    assert (TransitionMap(h, h, nodes, project)(there) - there).norm(dim=1).max() < 1e-6
    assert (TransitionMap(h, second, nodes, project)(there) - second(x)).norm(dim=1).max() < 1e-5
