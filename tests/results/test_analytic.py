"""Analytic surfaces with their meshes: closed where they should be, and on their own domains."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

import nsm
from nsm.domains.names import domain as domain_of
from nsm.domains.orbifold.quotient_mesh import quotient_mesh
from nsm.errors import NsmError
from nsm.maps import ANALYTIC
from nsm.pipeline.resolve_inputs import read_shape
from nsm.results.analytic import analytic_surface
from nsm.results.artifact import NeuralSurface
from nsm.results.evaluation import evaluate
from nsm.results.networks import network_of

CLOSED = [
    ({"name": "sphere"}, "orbifold", math.pi / 6),
    ({"name": "ellipsoid", "a": 1.0, "b": 0.7, "c": 0.5}, "orbifold", None),
    ({"name": "torus", "minor": 0.3}, "torus", None),
]
each = pytest.mark.parametrize(("config", "domain", "volume"), CLOSED, ids=lambda v: str(v)[:40])


def natural_volume(config, scale):
    if config["name"] == "torus":
        return 2 * math.pi**2 * config["minor"] ** 2 * scale**3
    return 4 / 3 * math.pi * config["a"] * config["b"] * config["c"] * scale**3


@each
def test_the_mesh_is_closed_and_fine(config, domain, volume):
    target = analytic_surface(config, domain)
    surface = target.surface
    points, faces, uv = target.to_mesh()
    mesh = trimesh.Trimesh(points, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and len(faces) > 20_000
    assert mesh.euler_number == (2 if domain == "orbifold" else 0)
    if volume is None:
        volume = natural_volume(config, target.map.scale)
    assert 0.99 * volume < mesh.volume < volume  # the mesh is inscribed
    assert 0.998 * math.pi < mesh.area < math.pi
    assert np.degrees(mesh.face_angles.min()) > 10 and mesh.area_faces.min() > 0
    # figures are drawn of the mesh with its copies, which have one point
    np.testing.assert_array_equal(surface.vertices[surface.whole()[0]], points)
    a, b = surface.vertices[surface.seam_pairs.T]
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(evaluate(target.map, surface.uv), surface.vertices, atol=1e-6)
    assert len(surface.seam_pairs) == len(surface.uv) - len(points)


@each
def test_the_mesh_covers_the_domain_once(config, domain, volume):
    surface = analytic_surface(config, domain).surface
    assert surface.domain.certificate(surface.uv, surface.faces)["certified"]
    cells = 2 if domain == "orbifold" else 1
    assert np.linalg.det(surface.lattice) == pytest.approx(cells * math.pi)
    if domain == "orbifold":
        cones = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        assert all((surface.uv == cone).all(axis=1).any() for cone in cones)
    ends = (surface.uv @ (surface.lattice.T / 2))[surface.faces]
    edges = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2)
    assert (edges.max(axis=1) / edges.min(axis=1)).max() < 2


@each
def test_copies_are_lifts_of_one_point(config, domain, volume):
    surface = analytic_surface(config, domain).surface
    a, b = torch.from_numpy(surface.uv[surface.seam_pairs.T])
    np.testing.assert_allclose(surface.domain.lift(a, b), b, atol=1e-12)


@each
def test_what_is_saved_is_loaded(config, domain, volume, tmp_path):
    target = analytic_surface(config, domain)
    target.save(tmp_path)
    again = nsm.load(tmp_path)
    assert isinstance(again, NeuralSurface)
    by_name = network_of(config, {})
    uv = np.random.default_rng(0).uniform(-2, 2, (50, 2))
    np.testing.assert_array_equal(again(uv), target(uv))
    np.testing.assert_array_equal(evaluate(by_name, uv), target(uv))
    np.testing.assert_array_equal(again.jacobian(uv), target.jacobian(uv))
    for name, array in target.surface.arrays().items():
        np.testing.assert_array_equal(again.surface.arrays()[name], array)


@pytest.mark.parametrize(
    ("name", "domain"),
    [
        *((name, "orbifold") for name in ("plane", "sphere_cap", "torus", "saddle")),
        *((name, "torus") for name in ("plane", "torus_patch", "sphere", "ellipsoid")),
        *((name, "disc") for name in ("sphere", "ellipsoid", "torus")),
        ("ellipsoid", "square"),
    ],
)
def test_surfaces_of_another_topology_are_refused(name, domain):
    with pytest.raises(NsmError) as error:
        analytic_surface({"name": name}, domain)
    assert (error.value.kind, error.value.key) == ("wrong_domain", "domain")
    message = str(error.value)
    assert "\n" not in message
    proposed = message.split("takes ")[1].split(";")[0].split(", ")
    for other in proposed:
        if other != "graph":  # which needs its formula
            analytic_surface({"name": other}, domain)
    analytic_surface({"name": name}, message.rsplit("domain=", 1)[1])


def test_users_own_functions_lie_over_the_disc():
    before = dict(ANALYTIC)
    try:
        nsm.register_analytic("ramp", lambda u, v: (u, v, u))
        assert analytic_surface({"name": "ramp"}, "disc").surface.name == "ramp"
        with pytest.raises(NsmError) as error:
            analytic_surface({"name": "ramp"}, "orbifold")
        assert error.value.kind == "wrong_domain"
    finally:
        ANALYTIC.clear()
        ANALYTIC.update(before)


@pytest.mark.parametrize(
    ("name", "domain", "analytic"),
    [
        ("sphere", "orbifold", True),
        ("ellipsoid", "orbifold", True),
        ("torus", "torus", True),
        ("plane", "disc", True),
        ("sphere", "disc", False),
        ("torus", "square", False),
        ("hemisphere", "disc", False),
    ],
)
def test_names_of_targets(name, domain, analytic):
    target = read_shape(name, domain_of(domain), "target")
    assert isinstance(target, NeuralSurface) == analytic
    if name != "ellipsoid":  # sources are meshes of the catalogue
        assert not isinstance(read_shape(name, domain_of(domain), "source"), NeuralSurface)


@pytest.mark.parametrize(
    ("name", "domain"),
    [("plane", "orbifold"), ("torus", "orbifold"), ("sphere", "torus"), ("ellipsoid", "disc")],
)
def test_targets_that_are_no_surface_of_the_domain(name, domain):
    with pytest.raises(NsmError) as error:
        read_shape(name, domain_of(domain), "target")
    assert (error.value.kind, error.value.key) == ("wrong_domain", "domain")


@examples(60)
@given(st.floats(0, 40), st.floats(0, 40), st.booleans())
def test_any_grid_closes_up(columns, rows, even):
    points, faces, origin = quotient_mesh(columns, rows, even)
    whole = origin[faces]
    mesh = trimesh.Trimesh(np.zeros((origin.max() + 1, 3)), whole, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == (2 if even else 0)
    assert len(np.unique(np.sort(whole, axis=1), axis=0)) == len(whole)
    edges = np.sort(whole[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    closed = domain_of("orbifold" if even else "torus")
    assert closed.certificate(points, faces)["certified"] and closed.contains(points).all()
    assert set(origin) == set(range(origin.max() + 1))
