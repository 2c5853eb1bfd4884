"""Maps of closed domains: equivariant by construction, cones fixed, Jacobians."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nsm.domains import DOMAINS
from nsm.maps import (
    EquivariantMap,
    LatticeAligned,
    LatticeSplineGrid,
    MultilevelSpline,
    NeuralMap,
    SplineField,
    TorusMap,
    build_stored,
)
from nsm.tasks.planar import planar_map


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


# ---------------------------------------------------------------- splines in levels


def levels(odd: bool, cells: int = 16) -> MultilevelSpline:
    """A spline with small values on all levels."""
    torch.manual_seed(1)
    spline = MultilevelSpline(2, cells, odd).double()
    for table in spline.tables:
        torch.nn.init.normal_(table, std=0.1)
    return spline


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-4, 4), min_size=2, max_size=2),
    st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    st.sampled_from([-1, 1]),
)
def test_an_odd_spline_makes_a_map_of_the_orbifold(point, shift, sign) -> None:
    x = torch.tensor([point], dtype=torch.float64)
    k = 2 * torch.tensor([shift], dtype=torch.float64)
    h = TorusMap.around(levels(odd=True))
    torch.testing.assert_close(h(sign * x + k), sign * h(x) + k, rtol=1e-12, atol=1e-12)
    cones = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    torch.testing.assert_close(h(cones), cones, rtol=0, atol=1e-14)


def test_the_odd_spline_is_the_odd_part_of_the_one_with_its_tables() -> None:
    odd, full = levels(odd=True), levels(odd=False)
    x = torch.rand(50, 2, dtype=torch.float64) * 6 - 3
    value, jacobian = odd.value_and_jacobian(x)
    (here, by_here), (there, by_there) = (full.value_and_jacobian(p) for p in (x, -x))
    torch.testing.assert_close(value, 0.5 * (here - there))
    torch.testing.assert_close(jacobian, 0.5 * (by_here + by_there))
    torch.testing.assert_close(odd(x), value)


def test_levels_add_up_to_the_splines_of_their_own_grids() -> None:
    spline = levels(odd=False)
    x = torch.rand(50, 2, dtype=torch.float64) * 2 - 1
    total = torch.zeros_like(x)
    for table in spline.tables:
        one = LatticeSplineGrid([table.shape[:2]], 2).double()
        one.tables[0].data = 0.5 / len(table) ** 0.5 * table.detach().flatten(0, 1)
        total += one(x)
    assert [len(t) for t in spline.tables] == [4, 8, 16]
    torch.testing.assert_close(spline(x), total)


def test_gradients_of_a_spline_are_those_of_finite_differences() -> None:
    spline = levels(odd=True, cells=8)
    x = torch.tensor([[0.3, 0.4], [-0.7, -0.2], [1.2, 0.9]], dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda p, *_: spline.value_and_jacobian(p), (x, *spline.tables), fast_mode=True
    )
    assert torch.autograd.gradcheck(lambda p, *_: spline(p), (x, *spline.tables), fast_mode=True)
    by_func = torch.func.vmap(torch.func.jacrev(lambda p: spline(p[None])[0]))(x.detach())
    torch.testing.assert_close(by_func, spline.value_and_jacobian(x)[1])


def test_a_spline_is_stored_and_made_again() -> None:
    h = TorusMap.around(levels(odd=True))
    again = build_stored(h.config).double()
    again.load_state_dict(h.state_dict())
    x = torch.rand(20, 2, dtype=torch.float64)
    torch.testing.assert_close(again(x), h(x), rtol=0, atol=0)


@pytest.mark.parametrize("wrong", [{"cells": 2}, {"cells": 9}, {"out_dim": 0}])
def test_a_spline_of_other_sizes_is_refused(wrong) -> None:
    with pytest.raises(ValueError):
        MultilevelSpline(**wrong)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("orbifold", MultilevelSpline), ("torus", MultilevelSpline), ("disc", NeuralMap)],
)
def test_the_default_network_of_a_planar_map_suits_its_domain(name, kind) -> None:
    settings = {"_target_": "nsm.maps.PlanarNetwork", "width": 8, "depth": 1}
    grid = {"_target_": "nsm.maps.SplineGrid", "resolutions": [4, 16]}
    softplus = {"_target_": "nsm.maps.activations.Softplus"}
    h = planar_map(DOMAINS[name], settings, softplus, grid)
    assert type(h.network) is kind
    assert kind is NeuralMap or (h.network.cells, h.network.odd) == (16, name == "orbifold")
    x = torch.rand(10, 2) * 0.5
    torch.testing.assert_close(h(x), x)
    own = planar_map(DOMAINS[name], {**settings, "_target_": "nsm.maps.NeuralMap"}, softplus, grid)
    assert type(own.network) is NeuralMap
