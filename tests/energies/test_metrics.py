"""Metrics, invariants and singular values."""

import pytest
import torch
from metric_samples import extreme_metrics, jacobians, metric, with_singular_values

from nsm.energies import first_fundamental_form, pullback_invariants, singular_values


@pytest.mark.parametrize("rows", [2, 3])
def test_first_fundamental_form(rows):
    j = jacobians(10, rows, 0)
    form = first_fundamental_form(j)
    assert form.shape == (10, 2, 2)
    torch.testing.assert_close(form[:, 0, 1], (j[:, :, 0] * j[:, :, 1]).sum(dim=1))
    torch.testing.assert_close(form[:, 1, 1], (j[:, :, 1] ** 2).sum(dim=1))
    torch.testing.assert_close(form, form.mT)


def test_a_jacobian_has_two_columns():
    with pytest.raises(ValueError, match="Jacobian"):
        first_fundamental_form(torch.zeros(4, 2, 3))


def test_invariants_are_trace_and_determinant_of_the_quotient():
    a, b = metric(jacobians(100, 3, 1)), metric(jacobians(100, 3, 2))
    m = torch.linalg.solve(a, b)
    t, d = pullback_invariants(a, b)
    torch.testing.assert_close(t, m.diagonal(dim1=1, dim2=2).sum(dim=1), rtol=1e-7, atol=0)
    torch.testing.assert_close(d, torch.linalg.det(m), rtol=1e-7, atol=0)


def test_shifted_invariants():
    a, b = metric(jacobians(100, 3, 1)), metric(jacobians(100, 3, 2))
    m = torch.linalg.solve(a, b) + 0.3 * torch.eye(2, dtype=torch.float64)
    t, d = pullback_invariants(a, b).shifted(0.3)
    torch.testing.assert_close(t, m.diagonal(dim1=1, dim2=2).sum(dim=1), rtol=1e-7, atol=0)
    torch.testing.assert_close(d, torch.linalg.det(m), rtol=1e-7, atol=0)


def test_invariants_of_extremes_are_those_of_a_matrix():
    metrics = extreme_metrics()
    n = len(metrics)
    t, d = pullback_invariants(metrics.repeat(n, 1, 1), metrics.repeat_interleave(n, dim=0))
    assert t.isfinite().all() and d.isfinite().all()
    assert (t >= 0).all() and (d >= 0).all() and (d <= t**2 / 4).all()


def test_a_singular_source_shows_as_a_huge_stretch():
    source = torch.tensor([[[1.0, 1.0], [1.0, 1.0]]])
    t, _ = pullback_invariants(source, torch.eye(2)[None])
    assert t.item() > 1e6


@pytest.mark.parametrize("sigma", [(1.0, 1.0), (2.0, 0.5), (1e2, 1e-1), (5.0, 5.0), (1e-3, 1e-6)])
def test_singular_values_are_found(sigma):
    a, b = with_singular_values(*sigma)
    first, second = singular_values(*pullback_invariants(a, b))
    torch.testing.assert_close(first, torch.full_like(first, sigma[0]), rtol=1e-6, atol=0)
    torch.testing.assert_close(second, torch.full_like(second, sigma[1]), rtol=1e-6, atol=0)


def test_singular_values_against_svd():
    source, target = jacobians(500, 3, 3), jacobians(500, 3, 4)
    want = torch.linalg.svdvals(target @ torch.linalg.pinv(source))[:, :2]
    got = torch.stack(singular_values(*pullback_invariants(metric(source), metric(target))), -1)
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


def test_singular_values_have_right_derivatives():
    t = torch.tensor([5.0, 2.5, 10.0], dtype=torch.float64, requires_grad=True)
    d = torch.tensor([4.0, 1.0, 0.01], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(singular_values, (t, d))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_singular_values_stay_finite_and_ordered(dtype):
    t = torch.tensor([0.0, 2.0, 2.0, 1.0, 1e-30, 1e30, 1e30, 2.0], dtype=dtype).requires_grad_()
    d = torch.tensor([0.0, 1.0, 1.1, 0.0, 0.0, 0.0, 1e38, 1.0], dtype=dtype).requires_grad_()
    first, second = singular_values(t, d)
    (first + second).sum().backward()
    assert first.isfinite().all() and second.isfinite().all()
    assert (first >= second).all() and (second >= 0).all()
    assert t.grad.isfinite().all() and d.grad.isfinite().all()
    assert first[3] == 1 and second[3] == 0
