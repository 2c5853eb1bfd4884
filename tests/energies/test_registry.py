"""Energies by name, and mixed."""

import math

import pytest
import torch
from metric_samples import jacobians, metric

from nsm.energies import ENERGIES, Blend, distortion, energy

A, B = metric(jacobians(10, 3, 0)), metric(jacobians(10, 3, 1))


@pytest.mark.parametrize("name", ENERGIES)
def test_names_are_those_of_the_functions(name):
    assert torch.equal(energy(name)(A, B), getattr(distortion, name)(A, B))


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("symetric_dirichlet", "symmetric_dirichlet"),
        ("Conformal", "conformal"),
        ("singular_values_ratio", "singular_value_ratio"),
    ],
)
def test_a_misspelt_name_meets_the_nearest(wrong, meant):
    with pytest.raises(ValueError, match=f"did you mean '{meant}'"):
        energy(wrong)
    with pytest.raises(ValueError, match=f"did you mean '{meant}'"):
        Blend({"arap": 1.0, wrong: 1.0})


def test_parameters_are_checked():
    with pytest.raises(ValueError, match="did you mean 'epsilon'"):
        energy("symmetric_dirichlet", epsilom=0.1)
    with pytest.raises(ValueError, match="takes no parameters"):
        energy("arap", epsilon=0.1)


def test_blend_is_the_weighted_sum():
    mixed = Blend({"arap": 0.25, "conformal": 2.0, "area": 0.0})
    want = 0.25 * energy("arap")(A, B) + 2.0 * energy("conformal")(A, B)
    torch.testing.assert_close(mixed(A, B), want)


@pytest.mark.parametrize("weights", [{}, {"arap": -1.0}, {"arap": math.nan}, {"arap": math.inf}])
def test_bad_weights_are_refused(weights):
    with pytest.raises(ValueError, match="weight"):
        Blend(weights)
