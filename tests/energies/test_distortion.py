"""Distortion energies against singular values, invariances, derivatives and extremes."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from metric_samples import extreme_metrics, jacobians, metric, with_singular_values
from thorough import examples

from nsm.energies import (
    ENERGIES,
    EquiarealConformal,
    SymmetricDirichlet,
    equiareal_conformal,
    symmetric_dirichlet,
)

# each energy from the singular values, as its definition reads
DEFINITIONS = {
    "symmetric_dirichlet": lambda a, b: a**2 + b**2 + 1 / (a**2 + 0.01) + 1 / (b**2 + 0.01),
    "conformal": lambda a, b: sum(((a**2 + b**2) / (a**4 + b**4) * s**2 - 1) ** 2 for s in (a, b)),
    "singular_value_ratio": lambda a, b: a / b,
    "arap": lambda a, b: (a - 1) ** 2 + (b - 1) ** 2,
    "symmetric_arap": lambda a, b: sum((s - 1) ** 2 + (1 / s - 1) ** 2 for s in (a, b)),
    "mips": lambda a, b: a / b + b / a,
    "area": lambda a, b: (a * b - 1) ** 2 + (1 / (a * b) - 1) ** 2,
    "dirichlet": lambda a, b: (a**2 + b**2) / 2,
    "equiareal_conformal": lambda a, b: (
        (a / b + b / a - 2) / 4 + ((a * b - 1) ** 2 + (1 / (a * b) - 1) ** 2) / 2
    ),
}
ISOMETRY = {
    "symmetric_dirichlet": 2 + 2 / 1.01,
    "conformal": 0.0,
    "singular_value_ratio": 1.0,
    "arap": 0.0,
    "symmetric_arap": 0.0,
    "mips": 2.0,
    "area": 0.0,
    "dirichlet": 1.0,
    "equiareal_conformal": 0.0,
}
SCALE_FREE = ("conformal", "singular_value_ratio", "mips")
# a root's slope turns rounding of 1e-16 in the metric to 1e-8 in σ₁/σ₂ where σ₁ = σ₂
ABSOLUTE = {name: 1e-7 if name == "singular_value_ratio" else 1e-10 for name in ENERGIES}


def rotation(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


def test_every_energy_is_tested_here():
    assert set(DEFINITIONS) == set(ISOMETRY) == set(ENERGIES)


@pytest.mark.parametrize("name", ENERGIES)
def test_isometry(name):
    a, b = with_singular_values(1.0, 1.0)
    want = torch.full((20,), ISOMETRY[name], dtype=torch.float64)
    torch.testing.assert_close(ENERGIES[name]()(a, b), want, rtol=1e-10, atol=ABSOLUTE[name])


@pytest.mark.parametrize("name", [n for n in ENERGIES if n != "dirichlet"])
@pytest.mark.parametrize("sigma", [(1.2, 1.0), (1.0, 0.8), (2.0, 0.5), (3.0, 3.0), (0.3, 0.3)])
def test_nothing_is_below_isometry(name, sigma):
    a, b = with_singular_values(*sigma)
    # ε = 0.01 shifts the minimum of the symmetric Dirichlet energy by about ε², from σ = 1
    assert (ENERGIES[name]()(a, b) >= ISOMETRY[name] - 1e-4).all()


@pytest.mark.parametrize("name", ENERGIES)
@pytest.mark.parametrize("scale", [0.01, 0.5, 3.0, 100.0])
def test_conformal_scaling(name, scale):
    a, b = with_singular_values(scale, scale)
    got = ENERGIES[name]()(a, b)
    want = torch.full_like(got, DEFINITIONS[name](scale, scale))
    torch.testing.assert_close(got, want, rtol=1e-6, atol=ABSOLUTE[name])
    if name in SCALE_FREE:
        torch.testing.assert_close(
            got, torch.full_like(got, ISOMETRY[name]), rtol=0, atol=ABSOLUTE[name]
        )


@pytest.mark.parametrize("name", ENERGIES)
@pytest.mark.parametrize("sigma", [(2.0, 0.5), (1.5, 1.2), (30.0, 0.1), (0.4, 0.002)])
def test_known_singular_values(name, sigma):
    a, b = with_singular_values(*sigma)
    got = ENERGIES[name]()(a, b)
    want = torch.full_like(got, DEFINITIONS[name](*sigma))
    torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-12)


def test_shear():
    k = 1.0
    b = metric(torch.tensor([[[1.0, k], [0.0, 1.0]]], dtype=torch.float64))
    eye = torch.eye(2, dtype=torch.float64)[None]
    golden = (1 + math.sqrt(5)) / 2  # singular values of the unit shear: golden, 1/golden
    assert ENERGIES["singular_value_ratio"]()(eye, b).item() == pytest.approx(golden**2)
    assert ENERGIES["mips"]()(eye, b).item() == pytest.approx(2 + k * k)
    assert ENERGIES["area"]()(eye, b).item() == pytest.approx(0, abs=1e-12)
    assert ENERGIES["dirichlet"]()(eye, b).item() == pytest.approx(1 + k * k / 2)
    assert ENERGIES["symmetric_dirichlet"]()(eye, b).item() == pytest.approx(3 + 3.02 / 1.0301)


@pytest.mark.parametrize("name", ENERGIES)
@pytest.mark.parametrize("rows", [2, 3])
def test_against_svd_of_the_explicit_differential(name, rows):
    source, target = jacobians(300, 3, 1), jacobians(300, rows, 2)
    sigma = torch.linalg.svdvals(target @ torch.linalg.pinv(source))[:, :2]
    want = DEFINITIONS[name](sigma[:, 0], sigma[:, 1])
    got = ENERGIES[name]()(metric(source), metric(target))
    torch.testing.assert_close(got, want, rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("name", ENERGIES)
def test_float32_agrees_with_float64(name):
    a, b = metric(jacobians(200, 3, 3) + torch.eye(3, 2)), metric(jacobians(200, 3, 4))
    got = ENERGIES[name]()(a.float(), b.float())
    want = ENERGIES[name]()(a.float().double(), b.float().double())
    assert got.dtype == torch.float32
    torch.testing.assert_close(got.double(), want, rtol=1e-6, atol=1e-6)


def test_symmetric_dirichlet_follows_epsilon():
    a, b = with_singular_values(2.0, 0.5)
    for epsilon in (0.0, 0.1, 1.0):
        want = 4.25 + 1 / (4 + epsilon) + 1 / (0.25 + epsilon)
        got = SymmetricDirichlet(epsilon)(a, b)
        torch.testing.assert_close(got, torch.full_like(got, want), rtol=1e-9, atol=0)


def test_equiareal_conformal_runs_from_angles_to_areas():
    a, b = with_singular_values(3.0, 0.5)
    torch.testing.assert_close(EquiarealConformal(0.0)(a, b), ENERGIES["mips"]()(a, b) / 2 - 1)
    torch.testing.assert_close(EquiarealConformal(1.0)(a, b), ENERGIES["area"]()(a, b))


@pytest.mark.parametrize("name", ENERGIES)
@examples(30)
@given(
    seed=st.integers(0, 10**6),
    angle=st.floats(-7, 7),
    reflect=st.booleans(),
    turned=st.sampled_from(["source", "target"]),
)
def test_frames_of_the_surfaces_do_not_matter(name, seed, angle, reflect, turned):
    source, target = jacobians(5, 2, seed), jacobians(5, 2, seed + 1)
    frame = rotation(angle) @ torch.diag(torch.tensor([1.0, -1.0 if reflect else 1.0]).double())
    before = ENERGIES[name]()(metric(source), metric(target))
    moved = {"source": source, "target": target}
    moved[turned] = frame @ moved[turned]
    after = ENERGIES[name]()(metric(moved["source"]), metric(moved["target"]))
    torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ENERGIES)
@examples(30)
@given(
    seed=st.integers(0, 10**6),
    angle=st.floats(-7, 7),
    stretch=st.floats(0.3, 3.0),
    shear=st.floats(-2, 2),
    reflect=st.booleans(),
)
def test_parametrisation_does_not_matter(name, seed, angle, stretch, shear, reflect):
    a, b = metric(jacobians(5, 3, seed)), metric(jacobians(5, 3, seed + 1))
    sign = -1.0 if reflect else 1.0
    c = rotation(angle) @ torch.tensor([[stretch, shear], [0.0, sign]], dtype=torch.float64)
    after = ENERGIES[name]()(c.T @ a @ c, c.T @ b @ c)
    torch.testing.assert_close(after, ENERGIES[name]()(a, b), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ENERGIES)
def test_gradients(name):
    a = metric(jacobians(6, 3, 5)).requires_grad_()
    b = metric(jacobians(6, 3, 6)).requires_grad_()
    torch.autograd.gradcheck(ENERGIES[name](), (a, b))


@pytest.mark.parametrize("name", ["symmetric_dirichlet", "symmetric_arap", "mips", "area"])
def test_second_derivatives(name):
    a = metric(jacobians(3, 3, 5)).requires_grad_()
    b = metric(jacobians(3, 3, 6)).requires_grad_()
    torch.autograd.gradgradcheck(ENERGIES[name](), (a, b))


@pytest.mark.parametrize("name", [n for n in ENERGIES if n != "dirichlet"])
def test_isometry_is_a_critical_point(name):
    eye = torch.eye(2, dtype=torch.float64)[None]
    b = eye.clone().requires_grad_()
    gradient = torch.autograd.grad(ENERGIES[name]()(eye, b).sum(), b)[0]
    # ε shifts the minimum of the symmetric Dirichlet energy a little below σ = 1
    slope = 1 - 1 / 1.01**2 if name == "symmetric_dirichlet" else 0.0
    torch.testing.assert_close(gradient, slope * eye, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ENERGIES)
def test_extremes_stay_finite(name):
    metrics = extreme_metrics()
    n = len(metrics)
    a = metrics.repeat(n, 1, 1).requires_grad_()
    b = metrics.repeat_interleave(n, dim=0).requires_grad_()
    value = ENERGIES[name]()(a, b)
    value.sum().backward()
    assert value.dtype == torch.float32
    assert value.isfinite().all() and (value >= 0).all()
    assert a.grad.isfinite().all() and b.grad.isfinite().all()


@pytest.mark.parametrize("name", ["symmetric_dirichlet", "symmetric_arap", "area", "dirichlet"])
def test_gradients_reach_the_jacobian_of_a_huge_map(name):
    j = torch.tensor([[[1e9, 0.0], [0.0, 1e9]], [[-1e9, 3.0], [2.0, 1e-9]]]).requires_grad_()
    eye = torch.eye(2).expand(2, 2, 2)
    ENERGIES[name]()(eye, j.mT @ j).sum().backward()
    assert j.grad.isfinite().all()


@pytest.mark.parametrize("name", ENERGIES)
def test_a_mirror_image_costs_the_same(name):
    j = jacobians(20, 2, 8)
    a = metric(jacobians(20, 3, 7))
    mirrored = j * torch.tensor([-1.0, 1.0], dtype=torch.float64)[:, None]
    torch.testing.assert_close(
        ENERGIES[name]()(a, metric(mirrored)), ENERGIES[name]()(a, metric(j))
    )


@pytest.mark.parametrize(
    ("name", "worst"),
    [
        ("symmetric_dirichlet", 200.0),
        ("conformal", 1.0),
        ("singular_value_ratio", 1e6),
        ("mips", 1e6),
        ("symmetric_arap", 1e12),
        ("area", 1e23),
    ],
)
def test_collapse_to_a_point_is_never_good(name, worst):
    eye, zero = torch.eye(2)[None], torch.zeros(1, 2, 2)
    assert ENERGIES[name]()(eye, zero).item() >= worst * (1 - 1e-5)


@pytest.mark.parametrize("shape", [(4, 3, 2), (4, 2, 3), (2,), (4, 3, 3)])
def test_wrong_shapes_are_refused(shape):
    good, bad = torch.ones(4, 2, 2), torch.ones(shape)
    for source, target in ((bad, good), (good, bad)):
        with pytest.raises(ValueError):
            ENERGIES["mips"]()(source, target)


def test_batches_of_any_shape():
    a, b = metric(jacobians(6, 3, 0)), metric(jacobians(6, 3, 1))
    flat = ENERGIES["arap"]()(a, b)
    torch.testing.assert_close(
        ENERGIES["arap"]()(a.view(2, 3, 2, 2), b.view(2, 3, 2, 2)).view(6), flat
    )
    torch.testing.assert_close(ENERGIES["arap"]()(a[0], b[0]), flat[0])
    assert ENERGIES["arap"]()(a[:0], b[:0]).shape == (0,)


def test_bad_parameters_are_refused():
    eye = torch.eye(2)[None]
    for epsilon in (-1.0, math.nan):
        with pytest.raises(ValueError):
            SymmetricDirichlet(epsilon)
    with pytest.raises(ValueError):
        symmetric_dirichlet(eye, eye, epsilon=-1.0)
    for blend in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError):
            EquiarealConformal(blend)
        with pytest.raises(ValueError):
            equiareal_conformal(eye, eye, blend=blend)
