"""Eigenvalues of the Laplace–Beltrami operator against closed forms, an ODE and libigl."""

import math
import warnings

import igl
import numpy as np
import pytest
import robust_laplacian
import torch
from hypothesis import given
from hypothesis import strategies as st
from map_samples import network as neural_map
from scipy.sparse.linalg import eigsh
from thorough import examples

from nsm.energies import curvatures, spectrum
from nsm.maps import SplineGrid
from nsm.results import analytic_surface

TAU = 2 * math.pi


def periodic_grid(n):
    """Points of [0, 2π]² with copies at its sides, triangles, and the number of each point."""
    axis = np.linspace(0, TAU, n + 1)
    uv = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    faces = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    row, column = np.divmod(np.arange((n + 1) ** 2), n + 1)
    return uv, np.concatenate(faces), (row % n) * n + column % n


@examples(2)
@given(a=st.floats(0.5, 2), b=st.floats(0.5, 2))
def test_the_flat_torus(a, b):
    """(a cos u, a sin u, b cos v, b sin v): λ = (k/a)² + (l/b)²."""

    def phi(x):
        u, v = x.unbind(dim=1)
        return torch.stack([a * u.cos(), a * u.sin(), b * v.cos(), b * v.sin()], dim=1)

    uv, faces, joined = periodic_grid(28)
    values, functions = spectrum(phi, uv, faces, 7, joined=joined)
    orders = [(k / a) ** 2 + (m / b) ** 2 for k in range(-6, 7) for m in range(-6, 7)]
    exact = np.sort(orders)[:7]
    np.testing.assert_allclose(values, exact, rtol=0.06, atol=1e-8)
    assert (values >= exact - 1e-8).all()  # Galerkin's are upper bounds
    assert np.ptp(functions[:, 0]) < 1e-6 * np.abs(functions[:, 0]).max()
    copies = joined == joined[0]
    assert np.ptp(functions[copies], axis=0).max() == 0


def test_the_torus_of_revolution():
    """Functions e^{imu} w(v) leave an equation in v, solved by finite differences of 400 points."""
    R, r, n = 2.0, 0.8, 400
    v = TAU * np.arange(n) / n
    h, ring = TAU / n, R + r * np.cos(v)
    half = R + r * np.cos(v + h / 2)
    exact = []
    for m in range(5):
        # -(ring w')' / (r² ring) + m² w / ring² = λ w
        D = np.diag(half + np.roll(half, 1)) - np.diag(half[:-1], 1) - np.diag(half[:-1], -1)
        D[0, -1] = D[-1, 0] = -half[-1]
        operator = D / (r * h) ** 2 + np.diag(m**2 / ring)
        scaled = operator / np.sqrt(ring[:, None] * ring)
        exact += list(np.linalg.eigvalsh(scaled)[:4]) * (1 if m == 0 else 2)

    def phi(x):
        u, v = x.unbind(dim=1)
        reach = R + r * v.cos()
        return torch.stack([reach * u.cos(), reach * u.sin(), r * v.sin()], dim=1)

    uv, faces, joined = periodic_grid(48)
    values, _ = spectrum(phi, uv, faces, 9, joined=joined)
    np.testing.assert_allclose(values, np.sort(exact)[:9], rtol=0.02, atol=1e-8)


def test_the_sphere_has_the_eigenvalues_of_spherical_harmonics():
    """λ = l(l + 1)/ρ², 2l + 1 times, on the orbifold's layout with its four cones."""
    sphere = analytic_surface({"name": "sphere"}, "orbifold")
    values, functions = sphere.spectrum(9)
    radius = 0.5
    exact = np.array([0] + [2] * 3 + [6] * 5) / radius**2
    np.testing.assert_allclose(values, exact, rtol=0.02, atol=1e-8)
    # those of degree 1 are the coordinates
    points = sphere.file_mesh()[0]
    fit = np.linalg.lstsq(points, functions[:, 1:4], rcond=None)[0]
    assert np.abs(points @ fit - functions[:, 1:4]).max() < 0.02 * np.abs(functions[:, 1:4]).max()


def test_on_a_mesh_libigl_and_robust_laplacian_find_the_same():
    def phi(x):
        u, v = x.unbind(dim=1)
        return torch.stack([u, v, 0.3 * (2 * u).sin() * v.cos()], dim=1)

    axis = np.linspace(-0.6, 0.6, 36)
    uv = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    k = np.arange(36 * 36).reshape(36, 36)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    ours, _ = spectrum(phi, uv, faces, 6)
    vertices = phi(torch.from_numpy(uv)).numpy()
    cotan = -igl.cotmatrix(vertices, faces)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    for stiffness, weights in ((cotan, mass), robust_laplacian.mesh_laplacian(vertices, faces)):
        shift = -1e-3 * ours[1]
        theirs = eigsh(stiffness, k=6, M=weights, sigma=shift, return_eigenvectors=False)
        np.testing.assert_allclose(ours[1:], np.sort(theirs)[1:], rtol=0.02)


def test_what_does_not_fit_is_refused():
    uv, faces, joined = periodic_grid(4)
    flat = lambda x: x  # noqa: E731
    for count, labels in ((0, joined), (16, joined), (2, joined[:-1])):
        with pytest.raises(ValueError):
            spectrum(flat, uv, faces, count, joined=labels)
    with pytest.raises(ValueError, match="counter-clockwise"):
        spectrum(flat, uv, faces[:, ::-1], 2)


@pytest.mark.parametrize("degree", [2, 3])
def test_grids_of_degree_2_are_warned_of(degree):
    grid = SplineGrid(resolutions=[4], degree=degree)
    phi = neural_map(width=8, depth=1, block="plain", encoding=grid).double()
    uv = torch.rand(5, 2, dtype=torch.float64)
    if degree == 2:
        with pytest.warns(UserWarning, match="encoding.degree=3"):
            curvatures(phi, uv)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = curvatures(phi, uv)
        assert all(part.isfinite().all() for part in found)
