"""Maps of closed domains: equivariant by construction, cones fixed, Jacobians."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nsm.maps import EquivariantMap, LatticeAligned, SplineField, TorusMap


def displacement(cells: int = 8) -> SplineField:
    """A periodic network with small values."""
    torch.manual_seed(0)
    field = SplineField(2, cells, periodic=True).double()
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    return field


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-4, 4), min_size=2, max_size=2),
    st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    st.sampled_from([-1, 1]),
)
def test_equivariant(point: list[float], shift: tuple[int, int], sign: int) -> None:
    x = torch.tensor([point], dtype=torch.float64)
    k = 2 * torch.tensor([shift], dtype=torch.float64)
    h = EquivariantMap.around(displacement())
    torch.testing.assert_close(h(sign * x + k), sign * h(x) + k, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(
        TorusMap.around(displacement())(x + k), TorusMap.around(displacement())(x) + k
    )


def test_cones_stay_exactly() -> None:
    h = EquivariantMap.around(displacement())
    cones = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    torch.testing.assert_close(h(cones), cones, rtol=0, atol=1e-15)


@pytest.mark.parametrize("kind", [EquivariantMap, TorusMap])
def test_jacobians(kind) -> None:
    matrix = torch.tensor([[2.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    shift = torch.tensor([1.0, 0.0], dtype=torch.float64)
    h = LatticeAligned(kind.around(displacement()), matrix, shift)
    x = torch.rand(20, 2, dtype=torch.float64) * 6 - 3
    value, jacobian = h.value_and_jacobian(x)
    torch.testing.assert_close(value, h(x))
    step = 1e-6
    for k in range(2):
        offset = step * torch.eye(2, dtype=torch.float64)[k]
        slope = (h(x + offset) - h(x - offset)) / (2 * step)
        torch.testing.assert_close(jacobian[..., k], slope, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(h.back(h.before(x)), x)


@pytest.mark.parametrize(
    ("matrix", "shift"), [([[2, 0], [0, 1]], [0, 0]), ([[1, 0.5], [0, 1]], [0, 0])]
)
def test_a_matrix_that_is_no_change_of_basis_is_refused(matrix, shift) -> None:
    with pytest.raises(ValueError):
        LatticeAligned(torch.nn.Identity(), torch.tensor(matrix).float(), torch.tensor(shift))
