"""Closed analytic surfaces: symmetries, size, degree, orientation, and their closed forms."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ellipeinc, ellipj, ellipk, ellipkinc
from thorough import examples

from nsm.domains.names import domain as domain_of
from nsm.energies import symmetric_dirichlet
from nsm.errors import NsmError
from nsm.maps import ANALYTIC, build_analytic

CONFIGS = [
    {"name": "sphere"},
    {"name": "ellipsoid"},
    {"name": "ellipsoid", "a": 0.5, "b": 2.0, "c": 1.2},
    {"name": "torus"},
    {"name": "torus", "major": 3.0, "minor": 0.5},
]
CONES = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
each = pytest.mark.parametrize("config", CONFIGS, ids=str)


def natural(config):
    return build_analytic({**config, "area": None})


def points(count=400, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1


def gauss_points(surface, side=150):
    """Gauss points of the fundamental domain, and weights that sum to its area."""
    t, w = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(side))
    u, v = torch.meshgrid(t, t, indexing="ij")
    weights = w[:, None] * w
    if surface.even:
        v, weights = 0.5 * (v + 1), 0.5 * weights
    return torch.stack([u.ravel(), v.ravel()], dim=1), weights.ravel()


def normals(jacobian):
    return torch.linalg.cross(jacobian[..., 0], jacobian[..., 1], dim=-1)


def ellipsoid_area(*axes):
    """Legendre's formula."""
    c, b, a = sorted(axes)
    if a == c:
        return 4 * math.pi * a * a
    phi = math.acos(c / a)
    m = (a * a * (b * b - c * c)) / (b * b * (a * a - c * c))
    bent = ellipeinc(phi, m) * math.sin(phi) ** 2 + ellipkinc(phi, m) * math.cos(phi) ** 2
    return 2 * math.pi * (c * c + a * b / math.sin(phi) * bent)


def known_area(config):
    if config["name"] == "torus":
        return 4 * math.pi**2 * config.get("major", 1.0) * config.get("minor", 0.4)
    if config["name"] == "sphere":
        return 4 * math.pi
    return ellipsoid_area(*(config.get(k, d) for k, d in (("a", 1.0), ("b", 0.8), ("c", 0.6))))


def known_volume(config):
    if config["name"] == "torus":
        return 2 * math.pi**2 * config.get("major", 1.0) * config.get("minor", 0.4) ** 2
    if config["name"] == "sphere":
        return 4 / 3 * math.pi
    a, b, c = (config.get(k, d) for k, d in (("a", 1.0), ("b", 0.8), ("c", 0.6)))
    return 4 / 3 * math.pi * a * b * c


@each
def test_area_is_that_of_the_domain_unless_asked(config):
    for area in (math.pi, 2.0, None):
        surface = build_analytic({**config, "area": area})
        x, weights = gauss_points(surface)
        found = float((weights * normals(surface.value_and_jacobian(x)[1]).norm(dim=1)).sum())
        wanted = known_area(config) if area is None else area
        assert found == pytest.approx(wanted, rel=1e-9)


@each
def test_volume_is_enclosed_once_and_normals_point_outwards(config):
    """By the divergence theorem: a wrong degree or orientation changes factor or sign."""
    surface = natural(config)
    x, weights = gauss_points(surface)
    value, jacobian = surface.value_and_jacobian(x)
    volume = float((weights * (value * normals(jacobian)).sum(dim=1)).sum() / 3)
    assert volume == pytest.approx(known_volume(config), rel=1e-9)


@each
def test_normals_are_those_of_the_implicit_surface(config):
    surface, x = natural(config), points()
    value, jacobian = surface.value_and_jacobian(x)
    at = value.detach().requires_grad_()
    if config["name"] == "torus":
        ring = torch.hypot(at[:, 0], at[:, 1]) - config.get("major", 1.0)
        level = ring**2 + at[:, 2] ** 2 - config.get("minor", 0.4) ** 2
    else:
        unit = {"a": 1.0, "b": 1.0, "c": 1.0}
        default = unit if config["name"] == "sphere" else {"a": 1.0, "b": 0.8, "c": 0.6}
        axes = torch.tensor([config.get(k, d) for k, d in default.items()], dtype=x.dtype)
        level = ((at / axes) ** 2).sum(dim=1) - 1
    assert level.abs().max() < 1e-12
    (outwards,) = torch.autograd.grad(level.sum(), at)
    ours = torch.nn.functional.normalize(normals(jacobian))
    torch.testing.assert_close(ours, torch.nn.functional.normalize(outwards), rtol=0, atol=1e-9)


@each
@examples(25)
@given(
    st.integers(-1000, 1000),
    st.integers(-1000, 1000),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_all_lifts_are_one_point(config, m, n, dtype):
    surface = build_analytic(config)
    x = points().to(dtype)
    lifts = x + 2 * torch.tensor([m, n], dtype=dtype)
    rounding = float((lifts.abs().max() + 2) * torch.finfo(dtype).eps)
    torch.testing.assert_close(surface(lifts), surface(x), rtol=0, atol=20 * rounding)
    if surface.even:
        torch.testing.assert_close(surface(-x), surface(x), rtol=0, atol=0)
        torch.testing.assert_close(surface(-lifts), surface(x), rtol=0, atol=20 * rounding)


@each
def test_different_points_are_different(config):
    """A grid of one point for each cell of the domain stays apart on the surface."""
    surface = build_analytic(config)
    t = torch.arange(0.05, 1, 0.1, dtype=torch.float64)
    x = torch.cartesian_prod(torch.cat([-t, t]), t if surface.even else torch.cat([-t, t]))
    distance = torch.pdist(surface(x))
    assert distance.min() > 1e-3


@each
def test_single_precision_is_accurate(config):
    surface, x = build_analytic(config), points(20_000)
    near = (CONES[:, None] + 1e-3 * points(500)).flatten(0, 1)
    x = torch.cat([x, near, CONES]).float()
    value, jacobian = surface.value_and_jacobian(x)
    exact, exact_jacobian = surface.value_and_jacobian(x.double())
    assert (value - exact).abs().max() < 1e-6
    assert (jacobian - exact_jacobian).abs().max() < 1e-5
    assert (surface(x) - exact).abs().max() < 1e-6


@each
def test_jacobians_are_smooth_across_the_sides_of_the_fundamental_domain(config):
    surface, step = build_analytic(config), 1e-6
    t = torch.linspace(-1.5, 1.5, 31, dtype=torch.float64)
    for side in (0.0, 1.0):
        for flip in (False, True):
            across = torch.full_like(t, side)
            x = torch.stack([across, t] if flip else [t, across], dim=1)
            d = step * torch.tensor([1.0, 0.0] if flip else [0.0, 1.0], dtype=x.dtype)
            before, after = (surface.value_and_jacobian(x + s * d)[1] for s in (-1, 1))
            torch.testing.assert_close(before, after, rtol=0, atol=100 * step)


def test_sphere_is_conformal_with_its_cones_at_quarter_turns():
    surface = natural({"name": "sphere"})
    jacobian = surface.value_and_jacobian(points())[1]
    metric = jacobian.mT @ jacobian
    torch.testing.assert_close(metric[:, 0, 0], metric[:, 1, 1], rtol=1e-9, atol=1e-12)
    assert metric[:, 0, 1].abs().max() < 1e-12
    value, jacobian = surface.value_and_jacobian(CONES)
    wanted = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=value.dtype)
    torch.testing.assert_close(value, wanted, rtol=0, atol=1e-12)
    assert jacobian.abs().max() < 1e-12


def test_sphere_along_a_side_is_a_quotient_of_elliptic_functions():
    """(θ₁/θ₃)² = k k' (sn/dn)², and k = k' = 1/√2 on the square lattice (DLMF 22.2)."""
    u = torch.linspace(-1, 1, 41, dtype=torch.float64)
    x, y, _ = natural({"name": "sphere"})(torch.stack([u, torch.zeros_like(u)], dim=1)).T
    sn, _, dn, _ = ellipj(ellipk(0.5) * u.numpy(), 0.5)
    np.testing.assert_allclose((y / (1 + x)).numpy(), 0.5 * (sn / dn) ** 2, atol=1e-12)


def test_distortion_of_the_sphere_is_as_documented():
    surface = build_analytic({"name": "sphere"})
    x, weights = gauss_points(surface, 300)
    jacobian = surface.value_and_jacobian(x)[1]
    stretch = jacobian / math.sqrt(math.pi / 2)  # of the plane in which the domain has area π
    metric = stretch.mT @ stretch
    energy = symmetric_dirichlet(torch.eye(2, dtype=x.dtype).expand_as(metric), metric)
    order = energy.argsort()
    share = (weights * normals(jacobian).norm(dim=1))[order].cumsum(0) / math.pi
    for fraction, wanted in ((0.5, 4.24), (0.95, 5.26)):
        assert float(energy[order][share >= fraction][0]) == pytest.approx(wanted, abs=5e-3)


def test_ellipsoid_of_equal_axes_is_the_sphere():
    x = points()
    ball = build_analytic({"name": "ellipsoid", "a": 2.0, "b": 2.0, "c": 2.0})
    torch.testing.assert_close(ball(x), build_analytic({"name": "sphere"})(x))


@each
def test_the_lattice_has_the_least_dirichlet_energy(config):
    surface = natural(config)
    x, weights = gauss_points(surface, 40)
    jacobian = surface.value_and_jacobian(x)[1]

    def energy(lattice):
        stretch = (jacobian @ torch.linalg.inv(lattice)).square().sum(dim=(1, 2))
        return float((weights * stretch).sum() / lattice.det())

    lattice = surface.lattice()
    assert float(lattice.det()) == pytest.approx(1.0) and lattice[1, 0] == 0
    for entry in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        change = torch.eye(2, dtype=x.dtype)
        change = change + 0.05 * torch.tensor([[entry[0], entry[1]], [0, 0]], dtype=x.dtype)
        other = change @ lattice
        assert energy(other / other.det().sqrt()) > energy(lattice)


@pytest.mark.parametrize("name", ["sphere", "ellipsoid", "torus"])
def test_the_domain_has_the_same_symmetries(name):
    kind = ANALYTIC[name]
    assert domain_of(kind.closed_domain).even == kind.even


@pytest.mark.parametrize(
    ("config", "kind", "key"),
    [
        ({"name": "sphere", "radius": 1}, "unknown_setting", "sphere"),
        ({"name": "sphere", "area": 0}, "out_of_range", "area"),
        ({"name": "ellipsoid", "a": 0.0}, "out_of_range", "a"),
        ({"name": "ellipsoid", "b": -1.0}, "out_of_range", "b"),
        ({"name": "ellipsoid", "c": math.inf}, "out_of_range", "c"),
        ({"name": "ellipsoid", "c": "tall"}, "wrong_type", "ellipsoid"),
        ({"name": "ellipsoid", "a": 1e200}, "not_finite", "ellipsoid"),
        ({"name": "torus", "minor": 1.0}, "out_of_range", "minor"),
        ({"name": "torus", "minor": 0.0}, "out_of_range", "minor"),
        ({"name": "torus", "major": -1.0}, "out_of_range", "major"),
    ],
)
def test_bad_settings_are_refused(config, kind, key):
    with pytest.raises(NsmError) as error:
        build_analytic(config)
    assert (error.value.kind, error.value.key) == (kind, key)
    assert "\n" not in str(error.value)
