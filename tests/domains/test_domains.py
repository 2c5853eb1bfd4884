"""Disc and square against brute force: boundary, distance, area, symmetries, maps, layout."""

from dataclasses import dataclass

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm import domains
from nsm.domains import Disc, Domain, Keys, Square, Surface
from nsm.domains.baselines import harmonic
from nsm.domains.planar_mesh import flipped, signed_areas
from nsm.errors import NsmError
from nsm.surfaces import shapes, topology

each = pytest.mark.parametrize("domain", [Disc(), Square()], ids=str)
domain = st.sampled_from([Disc(), Square()])
coordinate = st.floats(-3, 3)
fraction = st.floats(0, 1, exclude_max=True)


def brute_distance(omega: Domain, point: np.ndarray) -> float:
    """Signed distance to the densely sampled boundary; inside by the winding number."""
    polygon = omega.boundary_points(np.arange(4000) / 4000)
    gap = polygon - point
    angle = np.arctan2(gap[:, 1], gap[:, 0])
    turn = np.mod(np.roll(angle, -1) - angle + np.pi, 2 * np.pi) - np.pi
    inside = round(turn.sum() / (2 * np.pi)) == 1
    return (-1 if inside else 1) * float(np.linalg.norm(gap, axis=1).min())


@given(domain, coordinate, coordinate)
@examples(50)
def test_signed_distance_is_that_to_the_nearest_boundary_point(omega, x, y):
    distance = float(omega.signed_distance(torch.tensor([x, y], dtype=torch.float64)))
    assert distance == pytest.approx(brute_distance(omega, np.array([x, y])), abs=2e-3)


@given(domain, coordinate, coordinate)
@examples(50)
def test_projection_is_the_nearest_point_and_idempotent(omega, x, y):
    p = torch.tensor([x, y], dtype=torch.float64)
    near = omega.project(p)
    distance = float(omega.signed_distance(p))
    assert float(omega.signed_distance(near)) <= 1e-12
    assert float((p - near).norm()) == pytest.approx(max(distance, 0), abs=1e-12)
    assert torch.allclose(omega.project(near), near, atol=1e-15)


@each
def test_gradients_of_the_distance_are_finite_at_the_centre(domain):
    p = torch.zeros(1, 2, requires_grad=True)
    domain.signed_distance(p).sum().backward()
    assert p.grad.isfinite().all()


@given(domain, st.lists(fraction, min_size=1, max_size=9))
@examples(50)
def test_fractions_lead_to_the_boundary_and_back(omega, t):
    points = omega.boundary_points(np.array(t))
    assert omega.signed_distance(torch.from_numpy(points)).abs().max() < 1e-12
    gap = np.mod(omega.boundary_fractions(points) - t + 0.5, 1) - 0.5
    assert np.abs(gap).max() < 1e-12


@each
def test_fractions_walk_once_around_at_constant_speed(domain):
    points = domain.boundary_points(np.arange(800) / 800)
    side = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(side, axis=1)
    assert lengths == pytest.approx(lengths.mean(), rel=1e-9)
    # the shoelace formula: counter-clockwise around Ω's area
    following = np.roll(points, -1, axis=0)
    area = 0.5 * (points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum()
    assert area == pytest.approx(domain.area, rel=1e-4)
    speed = np.abs((side / lengths[:, None] * domain.tangents(points)).sum(axis=1))
    assert speed[~domain.at_corner(points)] == pytest.approx(1, abs=1e-4)
    assert domain.at_corner(points).sum() == len(domain.corners)


@given(domain, fraction, st.floats(-0.2, 0.2))
@examples(50)
def test_points_slide_along_the_boundary(omega, t, length):
    p = omega.boundary_points(np.array([t]))
    moved = omega.slide(p, np.array([length]))
    assert omega.signed_distance(torch.from_numpy(moved)).abs().max() < 1e-12
    assert np.linalg.norm(moved - p) <= abs(length) + 1e-12
    # to second order: the tangent, and what the curvature adds
    step = 1e-4
    flat = p + step * omega.tangents(p) + 0.5 * step**2 * omega.curvature(p)
    assert np.abs(omega.retract(flat) - omega.slide(p, np.array([step]))).max() < 1e-10


@given(domain, coordinate, coordinate)
@examples(50)
def test_points_are_scaled_onto_the_boundary(omega, x, y):
    p = torch.tensor([x + 3.5, y], dtype=torch.float64)
    on = omega.to_boundary(p)
    assert float(omega.signed_distance(on).abs()) < 1e-12
    assert float(p[0] * on[1] - p[1] * on[0]) == pytest.approx(0, abs=1e-9)


@each
def test_the_mesh_fills_the_domain(domain):
    uv, faces = domain.mesh(40)
    assert not flipped(uv, faces).any() and topology.is_disc(faces)
    assert signed_areas(uv, faces).sum() == pytest.approx(domain.area, rel=2e-3)
    assert domain.contains(0.999 * uv).all() and not domain.contains(1.5 * uv[-1:]).any()
    assert domain.certificate(uv, faces)["certified"]
    # quadrature at the triangles' middles: second moments of the disc (π/4) and square (4/3)
    middle = uv[faces].mean(axis=1)
    moment = (signed_areas(uv, faces)[:, None] * middle**2).sum(axis=0)
    assert moment == pytest.approx(np.pi / 4 if domain == Disc() else 4 / 3, rel=5e-3)


@each
def test_boundary_samples_are_even(domain):
    points = domain.boundary_samples(128).double()
    assert len(points) == 128 and domain.signed_distance(points).abs().max() < 1e-6
    gaps = (points.roll(-1, 0) - points).norm(dim=1)
    assert gaps.max() - gaps.min() < 1e-6


@given(domain, st.floats(-np.pi, np.pi))
@examples(50)
def test_the_nearest_rotation_takes_the_domain_to_itself(omega, angle):
    c, s = np.cos(angle), np.sin(angle)
    wanted = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    turn = omega.nearest_rotation(wanted)
    assert torch.allclose(turn @ turn.T, torch.eye(2, dtype=turn.dtype), atol=1e-12)
    points = omega.boundary_samples().double()
    assert omega.signed_distance(points @ turn.T).abs().max() < 1e-6
    # none of those that keep Ω is nearer
    others = torch.from_numpy(omega.rotations())
    assert (turn - wanted).norm() <= (others - wanted).flatten(1).norm(dim=1).min() + 1e-12


@each
def test_candidate_rotations_start_with_the_identity_and_keep_the_domain(domain):
    turns = torch.from_numpy(domain.rotations())
    points = domain.boundary_samples().double()
    assert torch.equal(turns[0], torch.eye(2, dtype=torch.float64))
    assert domain.signed_distance(points @ turns.transpose(1, 2)).abs().max() < 1e-6


class Network(torch.nn.Module):
    def __init__(self, out_dim: int) -> None:
        super().__init__()
        self.hidden = torch.nn.Linear(2, 16)
        self.output = torch.nn.Linear(16, out_dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.output((5 * self.hidden(x)).sin())


@each
def test_an_equivariant_map_starts_as_the_identity_and_keeps_the_boundary(domain):
    torch.manual_seed(0)
    h = domain.equivariant(Network(domain.network_out_dim)).double()
    points = torch.from_numpy(domain.boundary_points(np.arange(500) / 500))
    inner = torch.cat([s * points for s in (0.1, 0.5, 0.9)])
    assert torch.allclose(h(inner), inner)
    torch.nn.init.normal_(h.network.output.weight, std=0.05)
    assert (h(inner) - inner).abs().max() > 0.1
    assert domain.signed_distance(h(points)).abs().max() < 1e-12
    corners = torch.from_numpy(domain.corners)
    assert torch.allclose(h(corners), corners)


# ---------------------------------------------------------------- layout


def terrain(n: int = 15) -> shapes.Mesh:
    vertices, faces = shapes.plane(n)
    vertices[:, 2] = 0.4 * np.sin(3 * vertices[:, 0]) * np.cos(2 * vertices[:, 1])
    return vertices, faces


def scaled(mesh: shapes.Mesh, area: float) -> shapes.Mesh:
    vertices, faces = mesh
    return vertices * np.sqrt(area / topology.face_areas(vertices, faces).sum()), faces


@each
@pytest.mark.parametrize("method", ["tutte", "slim_held", "slim"])
@pytest.mark.parametrize("mesh", [shapes.hemisphere(8), terrain()], ids=["hemisphere", "terrain"])
def test_layouts_are_injective_and_cover_the_domain(domain, method, mesh):
    vertices, faces = scaled(mesh, domain.area)
    flat = domain.embed(vertices, faces, method=method)
    found = domain.certificate(flat.uv, faces)
    assert found == {"certified": True, "flipped_triangles": 0, "boundary_order_violations": 0}
    loop = topology.boundary_loops(faces)[0]
    assert domain.signed_distance(torch.from_numpy(flat.uv[loop])).abs().max() < 1e-12
    assert signed_areas(flat.uv, faces).sum() == pytest.approx(domain.area, rel=0.05)
    assert flat.distortion <= flat.tutte_distortion + 1e-9
    corners = domain.corners
    gap = np.linalg.norm(flat.uv[loop][:, None] - corners, axis=2)
    assert (gap.min(axis=0) == 0).all()  # each corner is a vertex


def test_the_disc_starts_where_libigl_puts_the_boundary():
    vertices, faces = shapes.hemisphere(8)
    loop = topology.boundary_loops(faces)[0]
    placed = Disc().place_boundary(vertices, loop)
    assert placed == pytest.approx(igl.map_vertices_to_circle(vertices, loop), abs=1e-12)
    assert harmonic(vertices, faces, vertices[:, :2])[loop] == pytest.approx(placed)


@each
def test_keys_stay_where_they_are(domain):
    vertices, faces = scaled(terrain(), domain.area)
    loop = topology.boundary_loops(faces)[0]
    keys = Keys(loop[[0, 7, 20, 41]], np.array([0.05, 0.3, 0.5, 0.9]))
    uv = domain.embed(vertices, faces, keys=keys).uv
    assert uv[keys.vertices] == pytest.approx(domain.boundary_points(keys.fractions), abs=1e-12)


def test_a_triangle_has_no_four_corners():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    assert Disc().embed(*triangle, method="tutte").uv.shape == (3, 2)
    with pytest.raises(NsmError) as error:
        Square().embed(*triangle)
    assert (error.value.kind, error.value.key) == ("wrong_domain", "domain")


def test_keys_near_the_quarters_become_the_corners():
    t = np.array([0.0, 0.1, 0.2, 0.4, 0.55, 0.8, 0.9])
    warped = Square().through_corners(t)
    assert warped[[0, 2, 4, 5]] == pytest.approx([0, 0.25, 0.5, 0.75])
    assert (np.diff(warped) > 0).all()
    assert (Disc().through_corners(t) == t).all()
    assert (Square().through_corners(t[:3]) == t[:3]).all()


@each
def test_places_on_a_layout(domain):
    uv, faces = domain.mesh(8)
    points = 0.7 * np.random.default_rng(0).uniform(-1, 1, (50, 2))
    places = domain.locate(points, uv, faces)
    assert places.take(uv, faces) == pytest.approx(points, abs=1e-12)
    at = torch.from_numpy(points)
    assert domain.lift(at, at + 5) is at


# ---------------------------------------------------------------- names and files


def test_domains_by_name_settings_and_value():
    assert domains.domain("disc") == Disc() != Square()
    assert domains.domain(Square()) == Square() and hash(Square()) == hash(domains.domain("square"))
    assert domains.domain(Square().config) == Square()
    assert domains.domain({"_target_": "nsm.domains.Disc"}) == Disc()
    assert [str(d) for d in domains.DOMAINS.values()] == ["disc", "square", "orbifold", "torus"]
    for wrong, kind in (("circle", "unknown_option"), (3, "wrong_type"), (None, "wrong_type")):
        with pytest.raises(NsmError) as error:
            domains.domain(wrong)
        assert (error.value.kind, error.value.key) == (kind, "domain")


@dataclass(frozen=True)
class Ring(Disc):
    """A domain of the user's own, with a parameter."""

    width: float = 1.0


def test_files_keep_names_and_trust_no_strangers():
    assert domains.stored(Disc()) == "disc" and domains.from_stored("disc") == Disc()
    kept = domains.stored(Ring(0.5))
    assert kept == {"_target_": f"{__name__}.Ring", "width": 0.5}
    with pytest.raises(NsmError) as error:
        domains.from_stored(kept)
    assert error.value.kind == "not_trusted"
    assert domains.from_stored(kept, trust=[__name__]) == Ring(0.5) != Ring()


class Quotient(Domain):
    """A domain without boundary, as far as this test asks for it."""

    name, area, has_boundary = "quotient", 2.0, False

    embed = certificate = repaired = contains = nearest_rotation = rotations = mesh = None
    equivariant = None


def test_what_needs_a_boundary_says_so():
    assert domains.bounded("square") == Square()
    with pytest.raises(NsmError) as error:
        domains.bounded(Quotient())
    assert (error.value.kind, error.value.key) == ("wrong_domain", "domain")


@each
def test_surfaces_carry_their_domain(domain, tmp_path, monkeypatch):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path))
    by_name = Surface.from_arrays(*shapes.hemisphere(5), domain=str(domain), cache=True)
    by_object = Surface.from_arrays(*shapes.hemisphere(5), domain=domain, cache=True)
    assert by_name.domain == by_object.domain == domain
    assert len(list((tmp_path / "surfaces").iterdir())) == 1
    assert by_name.content_key() == by_object.content_key()
