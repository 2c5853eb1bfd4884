"""Position and normal terms of the overfit."""

import pytest
import torch
from metric_samples import jacobians

from nsm.energies import normal, position


def unit_normals(j):
    return torch.nn.functional.normalize(torch.linalg.cross(j[..., 0], j[..., 1], dim=-1), dim=-1)


def test_position():
    p = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    q = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert position(p, q).tolist() == [13.0, 0.0]


def test_normal_is_zero_if_right_two_if_square_four_if_reversed():
    j = jacobians(50, 3, 0)
    n = unit_normals(j)
    across = torch.nn.functional.normalize(j[..., 0], dim=-1)
    for target, want in ((n, 0.0), (across, 2.0), (-n, 4.0)):
        torch.testing.assert_close(
            normal(j, target), torch.full((50,), want, dtype=torch.float64), rtol=0, atol=1e-8
        )


def test_normal_does_not_see_scale():
    j = jacobians(50, 3, 1) + 2 * torch.eye(3, 2, dtype=torch.float64)
    n = unit_normals(jacobians(50, 3, 2))
    torch.testing.assert_close(normal(30 * j, n), normal(j, n), rtol=1e-6, atol=1e-6)


def test_gradients():
    j = jacobians(6, 3, 3).requires_grad_()
    n = unit_normals(jacobians(6, 3, 4)).requires_grad_()
    torch.autograd.gradcheck(normal, (j, n))
    torch.autograd.gradcheck(position, (n, unit_normals(jacobians(6, 3, 5))))


@pytest.mark.parametrize("scale", [0.0, 1e-45, 1e-30, 1e-9, 1e-4, 1.0, 1e9, 1e18, 1e30, 3e38])
def test_degenerate_jacobians_stay_finite(scale):
    shapes = torch.tensor(
        [
            [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]],
            [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]],
            [[1.0, -1.0], [0.3, -0.3], [0.2, -0.2]],
            [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
        ]
    )
    j = (scale * shapes).requires_grad_()
    target = torch.tensor([0.0, 0.0, 1.0]).expand(4, 3)
    value = normal(j, target)
    value.sum().backward()
    assert value.isfinite().all() and j.grad.isfinite().all()
    torch.testing.assert_close(value[3], torch.tensor(1.0))  # no normal at all


def test_far_positions_stay_finite():
    p = torch.full((1, 3), 3e38, requires_grad=True)
    value = position(p, -torch.ones(1, 3))
    value.sum().backward()
    assert value.isfinite().all() and p.grad.isfinite().all()


def test_shapes_must_match():
    with pytest.raises(ValueError, match="target"):
        position(torch.zeros(4, 3), torch.zeros(3))
    with pytest.raises(ValueError):
        normal(torch.zeros(4, 2, 2), torch.zeros(4, 3))
    with pytest.raises(ValueError):
        normal(torch.zeros(4, 3, 2), torch.zeros(3, 3))
