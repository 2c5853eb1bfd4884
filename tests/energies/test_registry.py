"""Energies as objects, and in weighted sums."""

import math

import pytest
import torch
from metric_samples import jacobians, metric

from nsm.energies import ENERGIES, At, Blend, SymmetricDirichlet, call_energy, distortion
from nsm.instantiation import made

A, B = metric(jacobians(10, 3, 0)), metric(jacobians(10, 3, 1))
AT = At(uv=jacobians(10, 3, 2)[:, 0], position=None)


@pytest.mark.parametrize("name", ENERGIES)
def test_objects_are_their_functions(name):
    made_again = made({"_target_": f"nsm.energies.{ENERGIES[name].__name__}"})
    assert made_again == ENERGIES[name]()
    assert torch.equal(made_again(A, B, AT), getattr(distortion, name)(A, B))


@pytest.mark.parametrize("name", ENERGIES)
def test_energies_without_scale_are_those_that_say_so(name):
    energy = ENERGIES[name]()
    source = torch.eye(2, dtype=torch.float64)
    target = torch.tensor([[3.0, 0.4], [0.4, 1.2]], dtype=torch.float64)
    same = bool(torch.isclose(energy(source, target), energy(source, 4 * target)))
    assert same == energy.scale_free


def test_parameters_are_passed_on():
    want = distortion.symmetric_dirichlet(A, B, epsilon=0.5)
    assert torch.equal(SymmetricDirichlet(epsilon=0.5)(A, B), want)


def test_blend_is_the_weighted_sum():
    mixed = Blend({"arap": 0.25, "conformal": 2.0, "area": 0.0})
    want = 0.25 * distortion.arap(A, B) + 2.0 * distortion.conformal(A, B)
    torch.testing.assert_close(mixed(A, B), want)
    assert list(mixed.parts(A, B)) == ["arap", "conformal", "area"]


class Own:
    def __call__(self, source, target, at):
        return at.uv.sum(dim=-1)


@pytest.mark.parametrize(
    ("energy", "want"),
    [
        (lambda source, target: source[..., 0, 0], A[:, 0, 0]),
        (lambda source, target, at: at.uv[:, 0], AT.uv[:, 0]),
        (lambda source, target, *, at=None: at.uv[:, 0], AT.uv[:, 0]),
        (lambda source, target, power=2: target[..., 0, 0] ** power, B[:, 0, 0] ** 2),
        (Own(), AT.uv.sum(dim=-1)),
        (torch.dist, torch.dist(A, B)),
        (distortion.symmetric_dirichlet, distortion.symmetric_dirichlet(A, B)),
    ],
)
def test_energies_of_the_user(energy, want):
    torch.testing.assert_close(call_energy(energy, A, B, AT), want)
    mixed = Blend({"mine": 2.0, "arap": 1.0}, terms={"mine": energy})
    torch.testing.assert_close(mixed(A, B, AT), 2 * want + distortion.arap(A, B))


@pytest.mark.parametrize("weights", [{}, {"arap": -1.0}, {"arap": math.nan}, {"arap": math.inf}])
def test_bad_weights_are_refused(weights):
    with pytest.raises(ValueError):
        Blend(weights)


def test_names_must_fit():
    with pytest.raises(ValueError):
        Blend({"arapp": 1.0})
    with pytest.raises(ValueError):
        Blend({"arap": 1.0}, terms={"mine": Own()})
