"""Analytic surfaces: their areas, shapes and Jacobians, and what a graph may say."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.errors import NsmError
from nsm.maps.analytic import ANALYTIC, build_analytic
from nsm.maps.expressions import parse_expression

EXPRESSIONS = [
    "0.3*sin(3*u)*v",
    "u**2 - v**2",
    "-u**3 + +v/2",
    "exp(-u*u)*cos(pi*v) - tanh(u)/(2 + v)",
    "log(2+u) + sqrt(3+v) + tan(u/2)",
    "sinh(u)*cosh(v) + abs(u - 5)",
    "(2+u)**v + 2**u + (2+v)**0.5 + u**0 + v**1",
    "1/2 - 2/(u+3) + (1+1)**2*v",
    "sin(1)*0",
]
CONFIGS = [{"name": name} for name in ANALYTIC if name != "graph"] + [
    {"name": "graph", "z": z} for z in EXPRESSIONS
]
OVER_THE_DISC = [
    c for c in CONFIGS if getattr(ANALYTIC[str(c["name"])], "closed_domain", None) is None
]


def disc_points(n=200, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 2 * torch.rand(4 * n, 2, generator=generator, dtype=torch.float64) - 1
    return x[x.norm(dim=1) < 1][:n]


def polar_area(surface):
    """Area over the disc by Simpson's rule in radius, on nodes the implementation does not use."""
    radius = torch.linspace(0, 1, 401, dtype=torch.float64)
    weight = torch.ones(401, dtype=torch.float64)
    weight[1:-1:2], weight[2:-1:2] = 4, 2
    angle = (torch.arange(300, dtype=torch.float64) + 0.3) * (2 * math.pi / 300)
    rays = torch.stack([angle.cos(), angle.sin()], dim=-1)
    points = (radius[:, None, None] * rays).reshape(-1, 2)
    _, jacobian = surface.value_and_jacobian(points)
    element = torch.linalg.cross(jacobian[..., 0], jacobian[..., 1], dim=-1).norm(dim=-1)
    per_radius = element.reshape(401, 300).mean(dim=1) * 2 * math.pi * radius
    return float((weight * per_radius).sum() / (3 * 400))


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_jacobian_agrees_with_finite_differences(config):
    surface, x, step = build_analytic(config), disc_points(), 1e-5
    value, jacobian = surface.value_and_jacobian(x)
    ends = [
        (surface(x + d) - surface(x - d)) / (2 * step)
        for d in step * torch.eye(2, dtype=x.dtype)[:, None]
    ]
    assert value.shape == (200, 3)
    torch.testing.assert_close(jacobian, torch.stack(ends, dim=-1), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(surface(x), value, rtol=0, atol=1e-15)
    one_by_one = torch.vmap(lambda p: tuple(t[0] for t in surface.value_and_jacobian(p[None])))(x)
    torch.testing.assert_close(one_by_one, (value, jacobian))


CLOSED_FORMS = {
    "plane": lambda u, v: [[1, 0], [0, 1], [0, 0]],
    "cylinder": lambda u, v: [[math.cos(u / 0.6), 0], [0, 1], [-math.sin(u / 0.6), 0]],
    "paraboloid": lambda u, v: [[1, 0], [0, 1], [u, v]],
    "saddle": lambda u, v: [[1, 0], [0, 1], [u, -v]],
    "cone": lambda u, v: [[1, 0], [0, 1], [-w / math.hypot(u, v, 0.05) for w in (u, v)]],
    "torus_patch": lambda u, v: [
        [-(1 + 0.4 * math.cos(2 * v)) * math.sin(u), -0.8 * math.sin(2 * v) * math.cos(u)],
        [(1 + 0.4 * math.cos(2 * v)) * math.cos(u), -0.8 * math.sin(2 * v) * math.sin(u)],
        [0, 0.8 * math.cos(2 * v)],
    ],
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_jacobian_has_its_closed_form(name):
    surface, x = build_analytic({"name": name, "area": None}), disc_points(20)
    wanted = torch.tensor([CLOSED_FORMS[name](*p) for p in x.tolist()], dtype=x.dtype)
    torch.testing.assert_close(surface.value_and_jacobian(x)[1], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_jacobian_is_itself_differentiable(config):
    surface = build_analytic(config)
    x = disc_points(3).requires_grad_()
    torch.autograd.gradcheck(lambda p: surface.value_and_jacobian(p)[1], x)


@pytest.mark.parametrize("config", OVER_THE_DISC, ids=str)
def test_area_is_that_of_the_disc_unless_asked(config):
    assert polar_area(build_analytic(config)) == pytest.approx(math.pi, rel=2e-4)
    assert polar_area(build_analytic({**config, "area": 2.0})) == pytest.approx(2.0, rel=2e-4)


def test_natural_size_is_kept_on_request():
    paraboloid = build_analytic({"name": "paraboloid", "curvature": 0.7, "area": None})
    a = 0.7
    natural = math.pi / (6 * a * a) * ((1 + 4 * a * a) ** 1.5 - 1)
    assert polar_area(paraboloid) == pytest.approx(natural, rel=1e-6)
    assert paraboloid.scale == 1.0


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_config_builds_the_same_surface_again(config):
    surface = build_analytic(config)
    x = disc_points(10)
    torch.testing.assert_close(build_analytic(surface.config)(x), surface(x), rtol=0, atol=0)


def test_type_and_batch_follow_the_points():
    surface = build_analytic({"name": "torus_patch"})
    value, jacobian = surface.value_and_jacobian(torch.zeros(0, 2))
    assert (value.shape, jacobian.shape) == ((0, 3), (0, 3, 2))
    assert surface(torch.zeros(2, 2)).dtype == torch.float32


def test_sphere_cap_is_round_conformal_and_as_wide_as_asked():
    angle = 1.2
    surface = build_analytic({"name": "sphere_cap", "angle": angle, "area": None})
    x = disc_points()
    value, jacobian = surface.value_and_jacobian(x)
    torch.testing.assert_close(value.norm(dim=1), torch.ones(200, dtype=x.dtype))
    metric = jacobian.mT @ jacobian
    torch.testing.assert_close(metric[:, 0, 0], metric[:, 1, 1])
    assert metric[:, 0, 1].abs().max() < 1e-12
    rim = surface(torch.tensor([[0.0, 1.0]], dtype=x.dtype))[0]
    assert math.acos(float(rim[2])) == pytest.approx(angle)


def test_cylinder_is_isometric_to_the_plane_and_round():
    surface = build_analytic({"name": "cylinder", "radius": 0.5})
    value, jacobian = surface.value_and_jacobian(disc_points())
    eye = torch.eye(2, dtype=value.dtype).expand(200, 2, 2)
    torch.testing.assert_close(jacobian.mT @ jacobian, eye)
    axis_distance = torch.hypot(value[:, 0], value[:, 2] + 0.5)
    torch.testing.assert_close(axis_distance, torch.full_like(axis_distance, 0.5))


def test_torus_points_keep_their_distance_from_the_centre_line():
    surface = build_analytic({"name": "torus_patch", "minor": 0.3, "area": None})
    value = surface(disc_points())
    from_line = torch.hypot(torch.hypot(value[:, 0], value[:, 1]) - 1, value[:, 2])
    assert (from_line <= 0.3 + 1e-12).all() and (from_line > 0.3 - 1e-12).all()


def test_mobius_band_comes_back_upside_down():
    surface = build_analytic({"name": "mobius_graph", "sweep": math.pi, "area": None})
    ends = torch.tensor([[1.0, 0.4], [-1.0, -0.4]], dtype=torch.float64)
    one, other = surface(ends)
    torch.testing.assert_close(one, other)


def test_saddle_bends_both_ways_and_paraboloid_one():
    x = torch.tensor([[0.5, 0.0], [0.0, 0.5]], dtype=torch.float64)
    saddle = build_analytic({"name": "saddle"})(x)[:, 2]
    bowl = build_analytic({"name": "paraboloid"})(x)[:, 2]
    assert saddle[0] > 0 > saddle[1]
    assert bowl[0] == bowl[1] > 0


def test_cone_is_straight_away_from_its_rounded_tip():
    surface = build_analytic({"name": "cone", "slope": 2.0, "tip": 1e-4, "area": None})
    x = torch.tensor([[0.0, 0.0], [0.5, 0.0], [0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(
        surface(x)[:, 2], torch.tensor([0.0, -1.0, -2.0], dtype=x.dtype), rtol=0, atol=1e-3
    )


@pytest.mark.parametrize(
    ("z", "expected"),
    [
        ("0.3*sin(3*u)*v", lambda u, v: 0.3 * math.sin(3 * u) * v),
        ("-u**2", lambda u, v: -(u**2)),
        ("2**3**0.5 * u", lambda u, v: 2 ** (3**0.5) * u),
        ("(u - v) / pi - exp(v)", lambda u, v: (u - v) / math.pi - math.exp(v)),
        ("(u+3)**-2 + (u+v)**3", lambda u, v: (u + 3) ** -2 + (u + v) ** 3),
        (" 1 - abs(v) / 4 * 2", lambda u, v: 1 - abs(v) / 4 * 2),
        (0.25, lambda u, v: 0.25),
    ],
)
def test_graph_means_what_it_says(z, expected):
    surface = build_analytic({"name": "graph", "z": z, "area": None})
    u, v = 0.4, -0.7
    got = surface(torch.tensor([[u, v]], dtype=torch.float64))[0]
    assert got.tolist() == pytest.approx([u, v, expected(u, v)])


@pytest.mark.parametrize(
    "z",
    [
        "",
        "u +",
        "u; v",
        "import os",
        "__import__('os').system('true')",
        "u.real",
        "u[0]",
        "(lambda: u)()",
        "[u for u in v]",
        "open(u)",
        "eval('u')",
        "x + y",
        "sin(u, v)",
        "sin()",
        "sin(x=u)",
        "sin(*u)",
        "sin",
        "u ^ 2",
        "u % 2",
        "u // 2",
        "u @ v",
        "u if v else 1",
        "u < v",
        "not u",
        "~u",
        "True",
        "3j",
        "'u'",
        "u := 1",
        "u, v",
        "f'{u}'",
        "1\n+\nos",
        "u\0",
        "-" * 400 + "u",
        "(" * 240 + "u" + ")" * 240,
        "u+" * 300 + "u",
    ],
)
def test_other_expressions_are_refused_in_one_line(z):
    with pytest.raises(NsmError) as caught:
        parse_expression(z)
    assert (caught.value.kind, caught.value.key) == ("invalid_expression", "z")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("z", "kind", "key"),
    [
        ("1/u", "not_finite", "graph"),
        ("log(u)", "not_finite", "graph"),
        ("sqrt(1-u**2-v**2)", "not_finite", "graph"),
        ("1/0", "out_of_range", "z"),
        ("log(-1) + u", "out_of_range", "z"),
        ("10.0**400 * u", "out_of_range", "z"),
        ("9e999", "out_of_range", "z"),
        ("1e100", "out_of_range", "z"),
        ("u**1e200", "out_of_range", "z"),
        ("(1e25 + u)**2 / 1e25 / 1e25", "not_finite", "graph"),
        ("exp(1000*u)", "not_finite", "graph"),
        ("(-8)**0.5", "out_of_range", "z"),
        ("u**v", "not_finite", "graph"),
    ],
)
def test_graphs_without_finite_values_are_refused(z, kind, key):
    with pytest.raises(NsmError) as caught:
        build_analytic({"name": "graph", "z": z})
    assert (caught.value.kind, caught.value.key) == (kind, key)
    assert "\n" not in str(caught.value)


@examples(300)
@given(st.text(alphabet="uvpisncoexqrtlgabh0123456789.+-*/() ,_[]'\"\n", max_size=25))
def test_any_text_is_a_graph_or_a_plain_refusal(text):
    try:
        surface = build_analytic({"name": "graph", "z": text})
    except NsmError as error:
        assert "\n" not in str(error)
    else:
        assert surface.value_and_jacobian(torch.zeros(1, 2))[1].isfinite().all()


@pytest.mark.parametrize(
    ("config", "kind", "key"),
    [
        ({"name": "spheroid"}, "unknown_option", "name"),
        ({}, "unknown_option", "name"),
        ({"name": "plane", "colour": 1}, "unknown_setting", "plane"),
        ({"name": "graph"}, "unknown_setting", "graph"),
        ({"name": "graph", "z": None}, "out_of_range", "z"),
        ({"name": "sphere_cap", "angle": 4.0}, "out_of_range", "angle"),
        ({"name": "cylinder", "radius": 0.1}, "out_of_range", "radius"),
        ({"name": "cone", "tip": 0.0}, "out_of_range", "tip"),
        ({"name": "cone", "tip": 1e200}, "wrong_type", "cone"),
        ({"name": "cone", "slope": math.nan}, "not_finite", "cone"),
        ({"name": "torus_patch", "minor": 1.5}, "out_of_range", "minor"),
        ({"name": "torus_patch", "sweep": 4.0}, "out_of_range", "sweep"),
        ({"name": "torus_patch", "tube": 0.0}, "out_of_range", "tube"),
        ({"name": "mobius_graph", "width": 2}, "out_of_range", "width"),
        ({"name": "mobius_graph", "sweep": -1}, "out_of_range", "sweep"),
        ({"name": "saddle", "curvature": "steep"}, "wrong_type", "saddle"),
        ({"name": "plane", "area": -1}, "out_of_range", "area"),
        ({"name": "plane", "area": math.inf}, "out_of_range", "area"),
        ({"_target_": "nsm.maps.NeuralMap"}, "wrong_type", "nsm.maps.NeuralMap"),
        ({"_target_": "os.getcwd"}, "not_trusted", "os"),
    ],
)
def test_bad_settings_are_refused(config, kind, key):
    with pytest.raises(NsmError) as error:
        build_analytic(config)
    assert (error.value.kind, error.value.key) == (kind, key)
