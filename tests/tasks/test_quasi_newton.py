"""Quasi-Newton steps: H¹ coordinates, levels that are subspaces, descent, and resumption."""

import copy

import numpy as np
import pytest
import torch

from nsm.errors import NsmError
from nsm.maps import DiscMap, NeuralMap, SplineField
from nsm.tasks.optimizers import build_optimizer
from nsm.tasks.quasi_newton import QuasiNewton
from nsm.tasks.sobolev import Level, Sobolev

SETTINGS = {
    "_target_": "nsm.tasks.quasi_newton.QuasiNewton",
    "levels": [4, 8],
    "steps": [2],
    "iterations": 5,
}


def path_or_cycle(count, periodic):
    """Minus the second difference as a dense matrix."""
    matrix = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    if periodic:
        matrix[0, -1] = matrix[-1, 0] = -1
    else:
        matrix[0, 0] = matrix[-1, -1] = 1
    return matrix


@pytest.mark.parametrize("periodic", [False, True])
def test_preconditioner_is_the_inverse_of_the_dense_inner_product(periodic):
    cells = 6
    side = cells if periodic else cells + 2
    along = path_or_cycle(side, periodic) * (cells / 2) ** 2  # neighbours are 2 / cells apart
    one = np.eye(side)
    dense = np.eye(side**2) + np.kron(along, one) + np.kron(one, along)
    c = torch.randn(side**2, 3, dtype=torch.float64)
    p = Sobolev(side, cells, periodic, c)
    expected = torch.as_tensor(np.linalg.solve(dense, c.numpy()))
    torch.testing.assert_close(p(p(c)), expected)


@pytest.mark.parametrize("periodic", [False, True])
def test_a_level_is_the_same_spline_on_the_fine_grid(periodic):
    torch.manual_seed(0)
    coarse, fine = (SplineField(2, cells, periodic).double() for cells in (5, 20))
    with torch.no_grad():
        coarse.coefficients.normal_()
    level = Level(fine, 5)
    with torch.no_grad():
        fine.coefficients.copy_(level.prolonged(coarse.coefficients))
    x = 2 * torch.rand(300, 2, dtype=torch.float64) - 1
    torch.testing.assert_close(fine(x), coarse(x))
    g = torch.randn_like(fine.coefficients)
    down = (level.restricted(g) * coarse.coefficients).sum()
    torch.testing.assert_close(down, (g * level.prolonged(coarse.coefficients)).sum())


def test_a_level_must_fit_the_field():
    with pytest.raises(ValueError, match="power of two"):
        Level(SplineField(2, 12), 5)


def test_only_splines_are_trained():
    with pytest.raises(NsmError) as caught:
        build_optimizer(NeuralMap(out_dim=2, width=4, depth=1), SETTINGS)
    assert caught.value.kind == "unsuitable_network"
    with pytest.raises(NsmError) as caught:
        build_optimizer(SplineField(2, 8), {**SETTINGS, "steps": [1, 1]})
    assert caught.value.kind == "not_instantiable"


def problem():
    """A disc map that should become a rotation with a swirl, and the closure of its loss."""
    h = DiscMap(SplineField(3, 8))
    g = torch.Generator().manual_seed(0)
    x = torch.rand(400, 2, generator=g) * 1.2 - 0.6
    angle = 0.4 + 0.5 * (x**2).sum(dim=1)
    c, s = angle.cos(), angle.sin()
    wanted = torch.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]], dim=1)

    def made(optimizer):
        def closure():
            optimizer.zero_grad()
            value, jacobian = h.value_and_jacobian(x)
            loss = ((value - wanted) ** 2).sum(dim=1).mean() + 1e-6 * (jacobian**2).mean()
            loss.backward()
            return loss.detach()

        return closure

    return h, made


def test_the_loss_only_decreases_and_far():
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    closure = made(optimizer)
    losses = [float(optimizer.step(closure)) for _ in range(8)]
    assert all(after <= before for before, after in zip(losses, losses[1:], strict=False))
    assert losses[-1] < 1e-2 * losses[0] or losses[-1] < 1e-5


def test_a_coarse_level_stays_in_its_subspace():
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    optimizer.step(made(optimizer))
    c = h.network.coefficients.detach()
    level = Level(h.network, 4)
    basis = torch.stack([level.prolonged(e[:, None])[:, 0] for e in torch.eye(36)], dim=1)
    fitted = basis @ torch.linalg.lstsq(basis, c).solution
    torch.testing.assert_close(fitted, c, atol=1e-5, rtol=0)
    assert float(c.abs().max()) > 1e-2


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_stored_and_loaded_it_goes_on_bit_for_bit(steps):
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    for _ in range(steps):
        optimizer.step(made(optimizer))
    weights, state = copy.deepcopy(h.state_dict()), copy.deepcopy(optimizer.state_dict())
    for _ in range(3):
        optimizer.step(made(optimizer))
    again, other = problem()
    again.load_state_dict(weights)
    resumed = build_optimizer(again, SETTINGS)
    resumed.load_state_dict(state)
    for _ in range(3):
        resumed.step(other(resumed))
    assert torch.equal(again.network.coefficients, h.network.coefficients)


def test_a_line_search_does_not_deepen_a_fold():
    f = SplineField(2, 8)
    optimizer = QuasiNewton([f.coefficients], [f], levels=[8], steps=[], iterations=3)
    seen = []

    def least():
        seen.append(0.01 - float(f.coefficients.detach().abs().max()))  # folds if it moves far
        return torch.tensor(seen[-1])

    optimizer.watch(least)

    def closure():
        optimizer.zero_grad()
        loss = ((f.coefficients - 1) ** 2).sum()
        loss.backward()
        return loss.detach()

    optimizer.step(closure)
    assert min(seen) < 0  # it was tried
    assert 0 < float(f.coefficients.detach().abs().max()) <= 0.01


def test_a_step_that_was_rolled_back_ends():
    f = SplineField(2, 8)
    optimizer = build_optimizer(f, SETTINGS)

    def closure():
        f.coefficients.grad = None
        return torch.tensor(float("nan"))

    assert optimizer.step(closure) is None
    assert not f.coefficients.detach().any()


def test_a_further_training_is_on_the_finest_level():
    f = SplineField(2, 8)
    with torch.no_grad():
        f.coefficients.fill_(0.1)
    optimizer = build_optimizer(f, SETTINGS)
    assert optimizer.state[f.coefficients]["step"] == sum(SETTINGS["steps"])
