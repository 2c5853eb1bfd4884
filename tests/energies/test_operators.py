"""Operators on φ against closed forms, finite differences, libigl and robust_laplacian."""

import math

import igl
import numpy as np
import pytest
import robust_laplacian
import torch
from hypothesis import given
from hypothesis import strategies as st
from map_samples import network as neural_map
from thorough import examples

import nsm
from nsm.energies import operators

U, V = 0, 1


def sphere(radius):
    def phi(x):
        u, v = x[:, U], x[:, V]
        parts = [torch.sin(u) * torch.cos(v), torch.sin(u) * torch.sin(v), torch.cos(u)]
        return radius * torch.stack(parts, dim=1)

    return phi


def torus(R, r):
    def phi(x):
        u, v = x[:, U], x[:, V]
        ring = R + r * torch.cos(v)
        return torch.stack([ring * torch.cos(u), ring * torch.sin(u), r * torch.sin(v)], dim=1)

    return phi


def ellipsoid(a, b, c):
    axes = torch.tensor([a, b, c], dtype=torch.float64)
    return lambda x: sphere(1.0)(x) * axes


def catenoid(c):
    def phi(x):
        u, v = x[:, U], x[:, V]
        ring = c * torch.cosh(v / c)
        return torch.stack([ring * torch.cos(u), ring * torch.sin(u), v], dim=1)

    return phi


def points(count=60, low=0.4, high=2.6):
    generator = torch.Generator().manual_seed(3)
    return low + (high - low) * torch.rand(count, 2, generator=generator, dtype=torch.float64)


LENGTH = st.floats(0.3, 3.0)


@examples(20)
@given(radius=LENGTH)
def test_sphere(radius):
    x, phi = points(), sphere(radius)
    H, K, low, high = operators.curvatures(phi, x)
    outward = phi(x) / radius
    torch.testing.assert_close(operators.normals(phi, x), outward)
    torch.testing.assert_close(operators.area_element(phi, x), radius**2 * torch.sin(x[:, U]))
    torch.testing.assert_close(H, torch.full_like(H, -1 / radius))
    torch.testing.assert_close(K, torch.full_like(K, 1 / radius**2))
    # at umbilics the principal curvatures have half the digits
    torch.testing.assert_close(low, high, atol=1e-5 / radius, rtol=0)
    # z is a spherical harmonic of degree 1, and x y one of degree 2
    for degree, f in ((1, lambda y: phi(y)[:, 2]), (2, lambda y: phi(y)[:, 0] * phi(y)[:, 1])):
        eigenvalue = -degree * (degree + 1) / radius**2
        torch.testing.assert_close(operators.laplace_beltrami(phi, f, x), eigenvalue * f(x))


@examples(20)
@given(r=st.floats(0.2, 0.9), ratio=st.floats(1.2, 4))
def test_torus(r, ratio):
    R = ratio * r
    x, phi = points(), torus(R, r)
    H, K, low, high = operators.curvatures(phi, x)
    cos, ring = torch.cos(x[:, V]), R + r * torch.cos(x[:, V])
    torch.testing.assert_close(operators.area_element(phi, x), r * ring)
    torch.testing.assert_close(H, -(R + 2 * r * cos) / (2 * r * ring))
    torch.testing.assert_close(K, cos / (r * ring))
    torch.testing.assert_close(low, torch.full_like(low, -1 / r), rtol=1e-6, atol=0)
    torch.testing.assert_close(high, -cos / ring, rtol=1e-6, atol=1e-6)
    # f(v) has the Laplacian (ring f')'/(r² ring)
    got = operators.laplace_beltrami(phi, lambda y: torch.sin(y[:, V]), x)
    sin = torch.sin(x[:, V])
    torch.testing.assert_close(got, -sin / r**2 - sin * cos / (r * ring))


@examples(20)
@given(a=LENGTH, b=LENGTH, c=LENGTH)
def test_ellipsoid(a, b, c):
    x, phi = points(), ellipsoid(a, b, c)
    squares = torch.tensor([a, b, c], dtype=torch.float64) ** 2
    p = phi(x)
    support = ((p / squares) ** 2).sum(dim=1)  # 1/h², h the distance of the tangent plane
    H, K, *_ = operators.curvatures(phi, x)
    expected = (p**2).sum(dim=1) - squares.sum()
    volume = a * b * c
    torch.testing.assert_close(K, 1 / (volume**2 * support**2), rtol=1e-7, atol=0)
    torch.testing.assert_close(H, expected / (2 * volume**2 * support**1.5), rtol=1e-7, atol=1e-9)


@examples(20)
@given(c=st.floats(0.5, 3))
def test_catenoid(c):
    x, phi = points(), catenoid(c)
    H, K, *_ = operators.curvatures(phi, x)
    torch.testing.assert_close(H, torch.zeros_like(H), atol=1e-12, rtol=0)
    torch.testing.assert_close(K, -1 / (c**2 * torch.cosh(x[:, V] / c) ** 4), rtol=1e-8, atol=1e-12)
    # the coordinates of a minimal surface are harmonic
    for axis in range(3):
        got = operators.laplace_beltrami(phi, lambda y, axis=axis: phi(y)[:, axis], x)
        torch.testing.assert_close(got, torch.zeros_like(got), atol=1e-11, rtol=0)


def network():
    torch.manual_seed(2)
    return neural_map(width=16, depth=2, block="plain").double()


def test_derivatives_of_a_network_agree_with_finite_differences():
    phi, x, step = network(), points(20, -0.5, 0.5), 1e-5
    second = operators.second_derivatives(phi, x)
    for j in range(2):
        shift = torch.zeros(2, dtype=torch.float64)
        shift[j] = step
        J = (operators.jacobian(phi, x + shift) - operators.jacobian(phi, x - shift)) / (2 * step)
        torch.testing.assert_close(second[..., j], J, atol=1e-7, rtol=1e-6)
        slope = (phi(x + shift) - phi(x - shift)) / (2 * step)
        torch.testing.assert_close(operators.jacobian(phi, x)[..., j], slope, atol=1e-8, rtol=1e-6)


def test_the_laplacian_of_the_position_is_twice_the_mean_curvature_normal():
    phi, x = network(), points(20, -0.5, 0.5)
    H = operators.curvatures(phi, x).mean
    normal = operators.normals(phi, x)
    for axis in range(3):
        got = operators.laplace_beltrami(phi, lambda y, axis=axis: phi(y)[:, axis], x)
        torch.testing.assert_close(got, 2 * H * normal[:, axis], rtol=1e-6, atol=1e-7)


def test_gradient_is_tangent_and_has_the_slope_of_the_function():
    phi, x = torus(2.0, 0.7), points()
    gradient = operators.surface_gradient(phi, lambda y: phi(y)[:, 2], x)
    n = operators.normals(phi, x)
    vertical = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(gradient, vertical - n[:, 2:] * n)


def test_gradients_reach_points_and_weights():
    phi, x = network(), points(10, -0.5, 0.5).requires_grad_()
    operators.curvatures(phi, x).gaussian.sum().backward()
    assert x.grad.abs().max() > 0
    assert all(p.grad is not None for name, p in phi.named_parameters() if "weight" in name)
    eps = 1e-6

    def total(shift):
        return operators.curvatures(phi, x.detach() + shift).gaussian[0]

    shift = torch.zeros_like(x)
    shift[0, 0] = eps
    slope = ((total(shift) - total(-shift)) / (2 * eps)).item()
    assert math.isclose(x.grad[0, 0].item(), slope, rel_tol=1e-4, abs_tol=1e-6)


def grid(n):
    """Points (n², 2) and triangles of the square [0.5, 2.5]²."""
    axis = torch.linspace(0.5, 2.5, n, dtype=torch.float64)
    uv = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    faces = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    interior = np.zeros((n, n), dtype=bool)
    interior[8:-8, 8:-8] = True
    return uv, np.concatenate(faces), interior.ravel()


def test_on_a_mesh_libigl_finds_the_same():
    phi = torus(2.0, 0.8)
    uv, faces, interior = grid(120)
    vertices = phi(uv).numpy()
    normals = igl.per_vertex_normals(vertices, faces)
    ours = operators.normals(phi, uv).numpy()
    assert (normals * ours).sum(axis=1)[interior].min() > 0.9999
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    K = operators.curvatures(phi, uv).gaussian.numpy()
    theirs = igl.gaussian_curvature(vertices, faces) / mass
    assert np.abs(theirs - K)[interior].max() < 0.01 * np.abs(K).max()
    f = lambda y: torch.sin(2 * y[:, U]) * torch.cos(y[:, V])  # noqa: E731
    got = operators.laplace_beltrami(phi, f, uv).numpy()
    theirs = (igl.cotmatrix(vertices, faces) @ f(uv).numpy()) / mass
    assert np.abs(theirs - got)[interior].max() < 0.01 * np.abs(got).max()


def test_on_a_mesh_robust_laplacian_finds_the_same():
    phi = torus(2.0, 0.8)
    uv, faces, interior = grid(120)
    stiffness, mass = robust_laplacian.mesh_laplacian(phi(uv).numpy(), faces)
    f = lambda y: torch.sin(2 * y[:, U]) * torch.cos(y[:, V])  # noqa: E731
    got = operators.laplace_beltrami(phi, f, uv).numpy()
    # intrinsic Delaunay triangles are not those of the grid: pointwise values differ more
    theirs = -(stiffness @ f(uv).numpy()) / mass.diagonal()
    difference = (theirs - got)[interior]
    assert np.sqrt((difference**2).mean()) < 0.01 * np.abs(got).max()


def test_on_the_neural_surface_of_a_sphere_both_find_the_same():
    settings = ["encoding.degree=3", "encoding.resolutions=[8,16]", "trainer.max_steps=0"]
    phi = nsm.overfit(nsm.Surface.load("hemisphere"), overrides=settings, progress=False)
    uv, module = torch.as_tensor(phi.surface.uv), phi.module().double()
    interior = np.linalg.norm(phi.surface.uv, axis=1) < 0.9
    H, K, *_ = (part.numpy()[interior] for part in operators.curvatures(module, uv))
    assert np.abs(K - 1).max() < 0.2 and np.abs(H + 1).max() < 0.1  # of the unit sphere
    vertices, faces = module(uv).numpy(), phi.surface.faces
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    z = vertices[:, 2]
    got = operators.laplace_beltrami(module, lambda y: module(y)[:, 2], uv).numpy()
    assert np.abs(got + 2 * z)[interior].max() < 0.1  # -Δz = 2 z, a spherical harmonic
    stiffness, weights = robust_laplacian.mesh_laplacian(vertices, faces)
    for theirs in (igl.cotmatrix(vertices, faces) @ z / mass, -stiffness @ z / weights.diagonal()):
        assert np.sqrt(((theirs - got)[interior] ** 2).mean()) < 0.01
    theirs = (igl.gaussian_curvature(vertices, faces) / mass)[interior]
    assert np.sqrt(((theirs - K) ** 2).mean()) < 0.01
    n = operators.normals(module, uv).numpy()
    assert (n * igl.per_vertex_normals(vertices, faces)).sum(axis=1)[interior].min() > 0.999


@pytest.mark.parametrize("uv", [torch.zeros(3), torch.zeros(3, 3), torch.zeros(3, 2).long()])
def test_points_of_another_shape_are_refused(uv):
    with pytest.raises(ValueError, match="points of Ω"):
        operators.curvatures(sphere(1.0), uv)


def test_maps_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="map to space"):
        operators.normals(lambda x: x, points())
    with pytest.raises(ValueError, match="one value"):
        operators.laplace_beltrami(sphere(1.0), lambda x: x, points())
