"""Compiled forms and invariants: plain operations' values, and derivatives of both orders."""

import pytest
import torch

from nsm.energies import first_fundamental_form, pullback_invariants
from nsm.energies.metrics import _invariants


def jacobians(count=20, rows=3, dtype=torch.float64):
    torch.manual_seed(0)
    return torch.randn(count, rows, 2, dtype=torch.float64).to(dtype)


def metrics(count=20, dtype=torch.float64):
    return [(j.mT @ j).to(dtype) for j in jacobians(2 * count).split(count)]


@pytest.mark.parametrize("rows", [2, 3])
def test_forms_and_their_derivatives(rows):
    j = jacobians(rows=rows).requires_grad_()
    torch.testing.assert_close(first_fundamental_form(j), j.mT @ j)
    assert torch.autograd.gradcheck(first_fundamental_form, (j,))
    assert torch.autograd.gradgradcheck(first_fundamental_form, (j,))
    many = first_fundamental_form(j.expand(4, *j.shape).transpose(0, 1))
    torch.testing.assert_close(many[:, 3], j.mT @ j)


def test_invariants_and_their_derivatives():
    a, b = (m.requires_grad_() for m in metrics())
    for found, plain in zip(pullback_invariants(a, b), _invariants(a, b), strict=True):
        torch.testing.assert_close(found, plain)

    def both(a, b):
        return tuple(pullback_invariants(a, b))

    assert torch.autograd.gradcheck(both, (a, b))
    assert torch.autograd.gradgradcheck(both, (a, b))


def test_gradients_where_a_bound_holds():
    thin = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
    zero, one, far = torch.zeros(2, 2), torch.eye(2), 1e18 * torch.eye(2)
    negative = torch.tensor([[1.0, 0.3], [0.1, -0.5]])
    cases = [thin, zero, one, far, negative]
    a = torch.stack(cases).repeat(5, 1, 1).requires_grad_()
    b = torch.stack(cases).repeat_interleave(5, dim=0).requires_grad_()
    given = torch.randn(2, 25, dtype=torch.float64)

    def gradients(function):
        t, d = function(a, b)
        return torch.autograd.grad((given[0] * t + given[1] * d).sum(), (a, b))

    for found, plain in zip(gradients(pullback_invariants), gradients(_invariants), strict=True):
        torch.testing.assert_close(found, plain, rtol=1e-5, atol=1e-5)


def test_shapes_that_differ_are_spread():
    a, b = metrics()
    t, d = pullback_invariants(a[:1], b)
    same = pullback_invariants(a[:1].expand_as(b), b)
    torch.testing.assert_close((t, d), tuple(same))


def test_not_numbers_stay_so():
    a, b = metrics(2, torch.float32)
    b[0, 0, 0] = torch.nan
    t, d = pullback_invariants(a, b)
    assert t[0].isnan() and d[0].isnan() and t[1].isfinite() and d[1].isfinite()
