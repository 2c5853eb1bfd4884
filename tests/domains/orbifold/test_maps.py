"""Symmetry of maps by construction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from domains.orbifold.shapes import limbs, torus
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nsm.domains.orbifold.embedding import embed_orbifold, embed_torus
from nsm.domains.orbifold.fitting import fitted_spline, resolution_for, rms_error, spline_basis
from nsm.domains.orbifold.maps import Even, EvenMap, PeriodicSplineGrid
from nsm.maps import EquivariantMap, TorusMap


@pytest.fixture(autouse=True)
def _double() -> None:
    torch.manual_seed(0)


def _grid(features: int = 2) -> PeriodicSplineGrid:
    return PeriodicSplineGrid([4, (8, 6), 16], features, scale=0.3).double()


def _displacement() -> nn.Module:
    return PeriodicSplineGrid([8], 2, scale=0.02).double()


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-4, 4), min_size=2, max_size=2),
    st.tuples(st.integers(-5, 5), st.integers(-5, 5)),
    st.sampled_from([-1, 1]),
)
def test_even_and_equivariant(point: list[float], shift: tuple[int, int], sign: int) -> None:
    torch.manual_seed(1)
    x = torch.tensor([point], dtype=torch.float64)
    moved = sign * x + 2 * torch.tensor([shift], dtype=torch.float64)
    phi = EvenMap(_grid(), nn.Sequential(nn.Linear(6, 8), nn.SiLU(), nn.Linear(8, 3)).double())
    torch.testing.assert_close(phi(moved), phi(x), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(phi(-x), phi(x), rtol=0, atol=0)
    h = EquivariantMap.around(_displacement())
    there = sign * h(x) + 2 * torch.tensor([shift], dtype=torch.float64)
    torch.testing.assert_close(h(moved), there, rtol=1e-12, atol=1e-12)


def test_cones_stay_exactly() -> None:
    h = EquivariantMap.around(PeriodicSplineGrid([8, 16], 1, scale=0.1).double())
    cones = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    torch.testing.assert_close(h(cones), cones, rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["grid", "even", "even_map", "equivariant", "torus"])
def test_jacobians(kind: str) -> None:
    network = nn.Sequential(nn.Linear(6, 8), nn.Tanh(), nn.Linear(8, 3)).double()
    function: nn.Module = {
        "grid": _grid(),
        "even": Even(_grid()),
        "even_map": EvenMap(_grid(), network),
        "equivariant": EquivariantMap.around(_displacement()),
        "torus": TorusMap.around(_displacement()),
    }[kind]
    x = torch.rand(20, 2, dtype=torch.float64) * 6 - 3
    value, jacobian = function.value_and_jacobian(x)  # type: ignore[operator]
    torch.testing.assert_close(value, function(x))

    def one(point: torch.Tensor) -> torch.Tensor:
        image: torch.Tensor = function(point[None])[0]
        return image

    wanted = torch.func.vmap(torch.func.jacrev(one))(x)
    torch.testing.assert_close(jacobian, wanted)
    forward = torch.func.vmap(torch.func.jacfwd(one))(x)
    torch.testing.assert_close(forward, wanted)
    jacobian.square().sum().backward()
    assert all(p.grad is not None for p in function.parameters() if p.ndim > 1)


def test_refined_grids_are_the_same_function() -> None:
    grid = _grid()
    x = torch.rand(50, 2, dtype=torch.float64) * 4
    torch.testing.assert_close(grid.refined().double()(x), grid(x))


def test_the_basis_is_that_of_the_grid() -> None:
    grid = PeriodicSplineGrid([(6, 10)], 3, scale=1.0).double()
    at = np.random.default_rng(0).uniform(-3, 3, (40, 2))
    value = spline_basis(at, (6, 10)) @ grid.tables[0].detach().numpy()
    np.testing.assert_allclose(value, grid(torch.from_numpy(at)).detach().numpy(), atol=1e-12)


def test_fitted_surfaces_are_closed_and_near() -> None:
    vertices, faces, tips = limbs()
    embedding = embed_orbifold(vertices, faces, tips)
    errors = []
    for cells in (16, 32):
        phi = fitted_spline(embedding, vertices, resolution_for(embedding.lattice, cells**2))
        errors.append(rms_error(phi, embedding, vertices))
    assert errors[1] < errors[0] and errors[1] < 1.0
    corners = torch.from_numpy(embedding.corners())
    # both triangles at an edge see the same points: the image of a vertex is one
    image = phi(corners).detach().numpy()
    of_vertex = np.zeros_like(vertices)
    of_vertex[faces] = image
    np.testing.assert_allclose(image, of_vertex[faces], atol=1e-9)


def test_a_torus_is_fitted() -> None:
    vertices, faces = torus((48, 24))
    embedding = embed_torus(vertices, faces)
    phi = fitted_spline(embedding, vertices, resolution_for(embedding.lattice, 32**2))
    assert rms_error(phi, embedding, vertices) < 1.0
