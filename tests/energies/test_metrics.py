"""Metrics and invariants."""

import pytest
import torch
from metric_samples import extreme_metrics, jacobians, metric

from nsm.energies import first_fundamental_form, pullback_invariants


@pytest.mark.parametrize("rows", [2, 3])
def test_first_fundamental_form(rows):
    j = jacobians(10, rows, 0)
    form = first_fundamental_form(j)
    assert form.shape == (10, 2, 2)
    torch.testing.assert_close(form[:, 0, 1], (j[:, :, 0] * j[:, :, 1]).sum(dim=1))
    torch.testing.assert_close(form[:, 1, 1], (j[:, :, 1] ** 2).sum(dim=1))
    torch.testing.assert_close(form, form.mT)


def test_a_jacobian_has_two_columns():
    with pytest.raises(ValueError):
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
