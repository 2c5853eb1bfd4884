"""Orbifold and torus as domains of surfaces: no seam, by construction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from domains.orbifold.shapes import limbs, torus
from hypothesis import given, settings
from hypothesis import strategies as st
from interruption import interrupted
from rich.console import Console

import nsm
from nsm.config import compose_config
from nsm.domains import Orbifold, Surface, Torus, domain, stored
from nsm.domains.orbifold.cover import lifted_near
from nsm.errors import NsmError
from nsm.maps import LatticeSplineGrid, NeuralMap, SplineGrid, build_network, build_stored
from nsm.pipeline import Given, make_task, run_task
from nsm.results.metrics import overfit_metrics, pointwise_metrics, seam_gap
from nsm.surfaces import shapes
from nsm.tasks.least_squares import fit_linear_skip
from nsm.tasks.multigrid import folding, lattice_refinements

TRAINING = {
    "encoding": {"resolutions": [8, 32]},
    "trainer": {"max_steps": 6},
    "data": {"batch_size": 256, "held_out": 256},
    "logger": "none",
}
EVERY = [Orbifold(), Torus()]
each = pytest.mark.parametrize("closed", EVERY, ids=str)


@pytest.fixture(scope="module")
def sphere_like() -> Surface:
    points, faces, tips = limbs(3)
    return Surface.from_arrays(points, faces, name="limbs", domain="orbifold", cones=tips)


@pytest.fixture(scope="module")
def torus_like() -> Surface:
    return Surface.from_arrays(*torus(), name="ring", domain="torus")


@pytest.fixture
def surface(request, sphere_like, torus_like) -> Surface:
    return {"orbifold": sphere_like, "torus": torus_like}[str(request.param)]


on_each = pytest.mark.parametrize("surface", EVERY, ids=str, indirect=True)


def grid_of(closed, lattice=None, resolutions=(4, 8)) -> LatticeSplineGrid:
    settings = {"_target_": "nsm.maps.SplineGrid", "resolutions": list(resolutions), "features": 3}
    torch.manual_seed(0)
    made = domain(closed).encoding(settings, lattice)
    return build_network(encoding=made, map={"width": 4, "depth": 1}).encoding


def moved(x, closed, generator):
    """Other lifts of points (N, 2)."""
    shift = torch.randint(-2, 3, x.shape, generator=generator).to(x.dtype)
    sign = 1 - 2 * torch.randint(2, (len(x), 1), generator=generator) if closed.even else 1
    return sign * x + 2 * shift, sign


# ---------------------------------------------------------------- grids


@each
def test_all_lifts_of_a_point_have_the_same_features(closed):
    generator = torch.Generator().manual_seed(1)
    grid = grid_of(closed).double()
    x = 2 * torch.rand(500, 2, generator=generator, dtype=torch.float64) - 1
    y, sign = moved(x, closed, generator)
    torch.testing.assert_close(grid(x), grid(y), rtol=0, atol=1e-12)
    here, there = (grid.value_and_jacobian_stack(p) for p in (x, y))
    torch.testing.assert_close(here[0], grid(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(here[1:], there[1:] * sign, rtol=0, atol=1e-10)


@each
def test_features_are_continuously_differentiable_across_the_rim(closed):
    """The Jacobian by values on both sides of where points are moved into the domain."""
    grid = grid_of(closed).double()
    along = torch.linspace(-0.9, 0.9, 37, dtype=torch.float64)
    one = torch.ones_like(along)
    for x in (torch.stack([one, along], 1), torch.stack([along, 0 * one], 1)):
        stack = grid.value_and_jacobian_stack(x)
        for k in range(2):
            step = 1e-5 * torch.eye(2, dtype=torch.float64)[k]
            slope = (grid(x + step) - grid(x - step)) / 2e-5
            torch.testing.assert_close(stack[1 + k], slope, rtol=0, atol=1e-4)


@each
def test_gradients_are_those_of_finite_differences(closed):
    grid = grid_of(closed, resolutions=(4,)).double()
    x = torch.tensor([[0.3, 0.4], [-0.7, -0.2], [1.2, 0.9]], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda p, _: grid.value_and_jacobian_stack(p), (x.requires_grad_(), grid.tables[0])
    )


@each
def test_torch_func_sees_the_same_jacobian(closed):
    network = build_network(
        encoding=closed.encoding({"_target_": "nsm.maps.SplineGrid", "resolutions": [4]}),
        map={"width": 4, "depth": 1},
    ).double()
    x = torch.tensor([[0.3, 0.4], [-0.7, -0.2]], dtype=torch.float64)
    by_func = torch.func.vmap(torch.func.jacrev(lambda p: network(p[None])[0]))(x)
    torch.testing.assert_close(by_func, network.value_and_jacobian(x)[1])


@each
def test_a_coarse_table_is_the_same_spline_on_the_finer_grid(closed):
    grid = grid_of(closed, resolutions=(128,))
    n, m = grid.cells(0)
    up = lattice_refinements(grid, 0)[0]
    coarse = LatticeSplineGrid([(n // 2, m // 2)], 3, closed.even)
    fine = LatticeSplineGrid([(n, m)], 3, closed.even)
    fine.tables[0].data = torch.from_numpy(up @ coarse.tables[0].detach().double().numpy()).float()
    x = 2 * torch.rand(300, 2, generator=torch.Generator().manual_seed(0)) - 1
    torch.testing.assert_close(coarse(x), fine(x), rtol=0, atol=1e-6)
    assert folding(grid, n, m).shape == (n * m, len(grid.tables[0]))


@each
def test_resolutions_follow_the_lattice_and_tables_of_surfaces_are_a_quarter_larger(closed):
    lattice = np.array([[4.0, 0.0], [0.0, 1.0]])
    n, m = grid_of(closed, lattice, (128,)).cells(0)
    assert 3 < n / m < 5
    size = len(grid_of(closed, lattice, (128,)).tables[0])
    assert size == pytest.approx(1.25 * 128**2, rel=0.15)
    settings = {"_target_": "nsm.maps.SplineGrid", "resolutions": [128]}
    n, m = closed.encoding(settings, of_map=True)["resolutions"][0]
    assert n * m / (2 if closed.even else 1) == pytest.approx(128**2, rel=0.15)


@pytest.mark.parametrize(
    ("resolutions", "features"), [([], 2), ([[4, 5]], 2), ([[2, 4]], 2), ([[4, 4]], 0)]
)
def test_grids_refuse_what_they_cannot_be(resolutions, features):
    with pytest.raises(ValueError, match="encoding"):
        LatticeSplineGrid(resolutions, features)


# ---------------------------------------------------------------- domains


@each
def test_the_nearest_lift(closed):
    generator = torch.Generator().manual_seed(2)
    near = 6 * torch.rand(200, 2, generator=generator, dtype=torch.float64) - 3
    x, _ = moved(near + 0.05, closed, generator)
    lifted = closed.lift(x, near)
    assert ((lifted - near).norm(dim=1) <= 0.05 * 2**0.5 + 1e-9).all()
    grid = grid_of(closed).double()
    torch.testing.assert_close(grid(lifted), grid(x), rtol=0, atol=1e-12)
    x = x.requires_grad_()
    closed.lift(x, near).sum().backward()
    assert (x.grad.abs() == 1).all()


@each
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_nearest_lift_is_that_of_numpy_for_any_lattice(closed, seed):
    rng = np.random.default_rng(seed)
    lattice = rng.normal(size=(2, 2)) @ np.array([[1, 3], [1, 4]])
    points, near = rng.uniform(-3, 3, (2, 20, 2))
    for shape in (None, lattice):
        found = closed.lift(torch.from_numpy(points), torch.from_numpy(near), shape)
        wanted = lifted_near(points, near, closed.even, shape)
        np.testing.assert_allclose(found.numpy(), wanted, rtol=0, atol=0)
    # no lift in reach is nearer
    lifts = torch.stack([s * torch.from_numpy(points) for s in ((1, -1) if closed.even else (1,))])
    shape = torch.from_numpy(lattice)
    gap = ((found - torch.from_numpy(near)) @ shape.T).norm(dim=1)
    shifts = 2 * torch.cartesian_prod(*[torch.arange(-12.0, 13)] * 2).double()
    every = lifts[:, None] + shifts[None, :, None]
    least = ((every - torch.from_numpy(near)) @ shape.T).norm(dim=-1).flatten(0, 1).amin(dim=0)
    assert (gap <= least + 1e-9).all()


@on_each
def test_points_in_any_lift_are_located(surface):
    random = np.random.default_rng(0)
    face = random.integers(len(surface.faces), size=200)
    weights = random.dirichlet([2, 2, 2], size=200)
    uv = np.einsum("nk,nki->ni", weights, surface.uv[surface.faces[face]])
    points = torch.from_numpy(uv)
    lifts = moved(points, surface.domain, torch.Generator().manual_seed(0))[0].numpy()
    places = surface.domain.locate(lifts, surface.uv, surface.faces)
    np.testing.assert_array_equal(places.face, face)
    np.testing.assert_allclose(places.weights, weights, atol=1e-6)


@each
def test_the_fundamental_domain_is_meshed(closed):
    points, faces = closed.mesh(4)
    assert closed.contains(points).all() and not closed.contains(points + 3).any()
    assert closed.certificate(points, faces)["certified"]
    assert not closed.certificate(points, faces[:, ::-1])["certified"]
    assert not closed.certificate(2 * points, faces)["certified"]


@each
def test_h_keeps_the_symmetries(closed):
    settings = closed.encoding({"_target_": "nsm.maps.SplineGrid", "resolutions": [4]})
    network = build_network(
        encoding={**settings, "even": False}, out_dim=2, map={"width": 4, "depth": 1}
    ).double()
    h = closed.equivariant(network)
    generator = torch.Generator().manual_seed(3)
    x = 2 * torch.rand(50, 2, generator=generator, dtype=torch.float64) - 1
    torch.testing.assert_close(h(x), x)
    torch.nn.init.normal_(network.output.weight)
    y, sign = moved(x, closed, generator)
    torch.testing.assert_close(h(y), sign * h(x) + (y - sign * x))


def test_networks_without_the_symmetries_are_refused():
    for closed in EVERY:
        with pytest.raises(NsmError) as error:
            closed.symmetric(NeuralMap(encoding=SplineGrid()))
        assert (error.value.kind, error.value.key) == ("unsuitable_network", "encoding")
    with pytest.raises(NsmError) as error:
        Orbifold().symmetric(NeuralMap(encoding=LatticeSplineGrid([[4, 4]])))
    assert error.value.kind == "unsuitable_network"


@each
def test_names_and_files(closed):
    assert domain(str(closed)) == closed == domain(closed.config)
    assert stored(closed) == str(closed)
    assert domain({"_target_": f"nsm.domains.{type(closed).__name__}"}) == closed


# ---------------------------------------------------------------- surfaces


@on_each
def test_a_surface_is_whole(surface):
    """Copies are there for lifts only, and each triangle is in one piece."""
    assert surface.domain.certificate(surface.uv, surface.faces)["certified"]
    first, faces = surface.whole()
    mesh = trimesh.Trimesh(surface.vertices[first], faces, process=False)
    assert mesh.is_watertight
    assert mesh.area == pytest.approx(surface.domain.area)
    corners = (surface.uv @ (surface.lattice / 2).T)[surface.faces]
    a, b = (corners[:, 1:] - corners[:, :1]).transpose(1, 0, 2)
    in_plane = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    assert in_plane == pytest.approx(surface.domain.area)
    a, b = surface.seam_pairs.T
    np.testing.assert_array_equal(surface.source_vertex[a], surface.source_vertex[b])
    np.testing.assert_array_equal(surface.vertices[a], surface.vertices[b])
    assert len(surface.uv) == len(first) + len(surface.seam_pairs)
    assert (surface.cut_vertex[surface.source_vertex[first]] == first).all()


def test_given_cones_lie_at_the_corners(sphere_like):
    tips = limbs(3)[2]
    np.testing.assert_array_equal(sphere_like.preimages(tips), [[0, 0], [1, 0], [1, 1], [0, 1]])


@pytest.mark.parametrize(
    ("mesh", "settings", "kind", "key"),
    [
        (shapes.hemisphere(5), {"domain": "orbifold"}, "wrong_topology", "domain"),
        (shapes.hemisphere(5), {"domain": "torus"}, "wrong_topology", "domain"),
        (torus(), {"domain": "orbifold"}, "wrong_topology", "domain"),
        (limbs(1)[:2], {"domain": "torus"}, "wrong_topology", "domain"),
        (torus(), {"domain": "torus", "cones": [0, 1, 2, 3]}, "wrong_domain", "cones"),
        (torus(), {"cones": [0, 1, 2, 3]}, "wrong_domain", "surface.cones"),
        (
            limbs(1)[:2],
            {"domain": "orbifold", "seam_vertices": [0, 1]},
            "wrong_domain",
            "surface.seam_vertices",
        ),
        (limbs(1)[:2], {"domain": "orbifold", "cones": [0, 1, 2]}, "wrong_cones", "cones"),
        (
            limbs(1)[:2],
            {"domain": "orbifold", "cones": [0, 1, 2, 9999]},
            "not_on_surface",
            "cones",
        ),
        (
            torus(),
            {"domain": "torus", "parameterization": "tutte"},
            "unknown_option",
            "parameterization",
        ),
    ],
)
def test_what_cannot_be_laid_out_is_refused(mesh, settings, kind, key):
    with pytest.raises(NsmError) as error:
        Surface.from_arrays(*mesh, **settings)
    assert (error.value.kind, error.value.key) == (kind, key)


def test_other_tasks_name_the_domain(sphere_like):
    with pytest.raises(NsmError) as error:
        make_task(compose_config(["task=param", "phi.path=nowhere", "domain=orbifold"]), Console())
    assert (error.value.kind, error.value.key) == ("wrong_domain", "domain")
    with pytest.raises(NsmError) as error:
        nsm.overfit(sphere_like, progress=False, encoding="fourier")
    assert (error.value.kind, error.value.key) == ("wrong_domain", "encoding")


# ---------------------------------------------------------------- φ


@on_each
def test_the_least_squares_start_has_no_seam(surface):
    encoding = {"_target_": "nsm.maps.SplineGrid", "resolutions": [16, 64]}
    network = build_network(
        encoding=surface.domain.encoding(encoding, surface.lattice),
        map={"width": 4, "depth": 1, "linear_skip": "fitted"},
    )
    fit_linear_skip(network, surface)
    assert pointwise_metrics(surface, network, samples=5000)["rms_percent"] < 0.2
    assert seam_gap(surface, network) < 2e-6 * surface.bounding_box_diagonal


@on_each
def test_from_mesh_to_files_and_back(surface, tmp_path):
    phi = nsm.overfit(surface, folder=tmp_path, progress=False, **TRAINING)
    assert phi.metrics["rms_percent"] < 1
    assert not any("seam" in name for name in [*phi.metrics, *surface.quality])
    again = nsm.load(tmp_path)
    assert again.surface.domain == surface.domain
    np.testing.assert_array_equal(again.surface.lattice, surface.lattice)
    uv = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    np.testing.assert_array_equal(again(uv), phi(uv))
    np.testing.assert_allclose(phi(uv + 2), phi(uv), atol=1e-5)
    if surface.domain.even:
        np.testing.assert_array_equal(phi(-uv), phi(uv))
    points, faces, _ = phi.to_mesh()
    given, given_faces = limbs(3)[:2] if surface.domain.even else torus()
    assert points.shape == given.shape
    np.testing.assert_array_equal(faces, given_faces)
    for ending in ("obj", "glb"):
        mesh = trimesh.load(tmp_path / f"reconstruction.{ending}", force="mesh", process=False)
        assert mesh.is_watertight
        np.testing.assert_array_equal(mesh.faces, given_faces)
        np.testing.assert_allclose(mesh.vertices, points, atol=1e-5)
    assert np.linalg.norm(points - given, axis=1).mean() < 0.03
    kept = build_stored(phi.map.config)
    assert kept.encoding.resolutions == phi.map.encoding.resolutions


def test_an_interrupted_training_is_resumed(torus_like, tmp_path):
    words = ["domain=torus", "encoding.resolutions=[8]", "logger=none", "artefacts=false"]
    words += ["trainer.max_steps=8", "data.steps_per_epoch=4", "data.batch_size=64"]
    words += ["data.held_out=64", "trainer.threads=1", "trainer.progress=false"]
    config, given = compose_config(words), Given(surface=torus_like)
    whole = run_task(config, tmp_path / "whole", given)
    with interrupted():
        run_task(config, tmp_path / "cut", given)
    resumed = run_task(config, tmp_path / "cut", given, resuming=True)
    for before, after in zip(whole.map.parameters(), resumed.map.parameters(), strict=True):
        assert torch.equal(before, after)


def test_figures_of_a_closed_domain_speak_of_no_seam(torus_like):
    figures = overfit_metrics(torus_like, NeuralMap(width=4, depth=1), samples=100)
    assert not any("seam" in name for name in figures)


def test_prepared_surfaces_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path))
    first, second = (Surface.from_arrays(*torus(), domain="torus", cache=True) for _ in range(2))
    np.testing.assert_array_equal(first.lattice, second.lattice)
    assert first.content_key() == second.content_key()
