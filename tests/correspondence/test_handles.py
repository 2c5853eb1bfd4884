"""Proposals without landmarks on shapes with handles, which are cut open around these."""

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nsm.correspondence import opened_handles, proposal, proposed, search
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.opened_handles import ways_to_open
from nsm.correspondence.search import Round
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.homology import lifted, linking_number, short_loops
from nsm.surfaces.shapes import torus
from nsm.surfaces.validation import clean

NONE = np.zeros(0, dtype=np.int64)


def marching(solid, low, high, size):
    """The zero set of a function of points (N, 3), as vertices and faces."""
    axes = [np.arange(a, b + size, size) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).transpose(2, 1, 0, 3)
    points = points.reshape(-1, 3)
    vertices, faces, _ = igl.marching_cubes(solid(points), points, *map(len, axes), 0.0)
    mesh = clean(vertices, faces, "shape")
    return mesh.vertices, mesh.faces


def kettle(p):
    """Distances from a ball with a spout, a short foot, and a handle above."""
    ball = np.linalg.norm(p / [1, 0.8, 1], axis=1) - 0.5
    spout = capsule(p, [0.4, 0, 0], [1.1, 0.1, 0.2], 0.13)
    foot = capsule(p, [-0.1, 0.1, -0.4], [-0.2, 0.5, -0.7], 0.14)
    around = np.hypot(p[:, 0] + 0.1, p[:, 2] - 0.55) - 0.42
    return np.minimum.reduce([ball, spout, foot, np.hypot(around, p[:, 1]) - 0.1])


def capsule(p, a, b, radius):
    a, d = np.asarray(a), np.subtract(b, a)
    t = ((p - a) @ d / (d @ d)).clip(0, 1)
    return np.linalg.norm(p - a - t[:, None] * d, axis=1) - radius


def two_rings(p):
    far = [
        np.hypot(np.hypot(p[:, 0] - c, p[:, 1]) - r, p[:, 2]) - 0.26
        for c, r in ((-0.75, 0.62), (0.8, 0.7))
    ]
    return np.minimum(*far)


@pytest.fixture(scope="module")
def pair():
    """A kettle, and the same stretched, bent, turned, and with its vertices in another order; and
    the vertex of the second for each of the first."""
    vertices, faces = marching(kettle, [-0.7, -0.6, -0.95], [1.35, 0.75, 1.2], 0.075)
    assert topology.genus_and_boundary(faces) == (1, 0)
    place = np.random.default_rng(0).permutation(len(vertices))
    bent = vertices * [1.1, 0.9, 1.0] + 0.05 * np.sin(2 * vertices[:, [1, 2, 0]])
    moved = np.empty_like(bent)
    moved[place] = 7 * bent @ Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    return (vertices, faces), (moved, place[faces]), place


@pytest.fixture
def quick(monkeypatch):
    rounds = (Round(60, 3, 10), Round(10, 6, 30))
    monkeypatch.setattr(search, "_SOURCE_SETS", 2)
    monkeypatch.setattr(search, "_TARGET_SETS", 5)
    monkeypatch.setattr(opened_handles, "_PLACES", 1)
    monkeypatch.setattr(proposal, "candidates", lambda s, t: search.candidates(s, t, rounds))
    monkeypatch.setattr(proposal, "MENDING", ())
    monkeypatch.setattr(proposal, "LEAST_MARGIN", -1.0)  # no finer maps


def errors(found, target, place):
    """Geodesic distances of landmarks from their true places, over √area."""
    ours, theirs = found.T
    away = edge_distances(*target, place[ours])[np.arange(len(ours)), theirs]
    return away / np.sqrt(topology.face_areas(*target).sum())


def test_linking_numbers_of_circles():
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    through = np.stack([1 + 0.5 * np.cos(t), 0 * t, 0.5 * np.sin(t)], axis=1)
    assert abs(linking_number(circle, through)) == abs(linking_number(through, circle)) == 1
    assert linking_number(circle, through[::-1]) == -linking_number(circle, through)
    assert linking_number(circle, through + [3, 0, 0]) == 0
    assert linking_number(circle, 0.5 * circle) == 0


def test_short_loops_of_a_torus_do_not_separate_it():
    vertices, faces = torus(24, 12, tube=0.3)
    found = short_loops(vertices, faces, np.array([0, 50]))
    assert found.length.shape == (2, 3)
    neighbours = set(map(tuple, topology.edges_of(faces).pairs.tolist()))
    around = 12 * 2 * 0.3 * np.sin(np.pi / 12)
    assert found.length.min(axis=1) == pytest.approx(around)  # around the tube
    for row in found.loops:
        for loop in row:
            assert len(set(loop.tolist())) == len(loop)
            steps = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
            assert set(map(tuple, steps.tolist())) <= neighbours


@pytest.mark.parametrize("tube", [0.25, 0.75])
def test_a_ring_is_cut_around_its_tube_however_thick_that_is(tube):
    """The shortest curve of a thick ring goes around its hole."""
    vertices, faces = torus(48, 24, tube)
    for way in ways_to_open(vertices, faces, NONE):
        assert topology.euler_characteristic(way.faces) == 2
        assert (topology.edges_of(way.faces).count == 2).all() and len(way.caps) == 2
        for cap in way.caps:
            rim = np.setdiff1d(way.faces[(way.faces == cap).any(axis=1)], [cap])
            place = vertices[way.origin[rim]]
            angle = np.arctan2(place[:, 1], place[:, 0])
            spread = np.angle(np.exp(1j * (angle - angle[0])))
            assert np.ptp(spread) < 0.5
            assert np.ptp(place[:, 2]) > 1.6 * tube  # all around the tube
        points, whole = way.whole
        assert topology.genus_and_boundary(whole) == (1, 0)
        assert np.array_equal(points[np.unique(whole)], vertices[np.unique(whole)])


def test_two_handles_are_cut_open_at_once():
    mesh = marching(two_rings, [-1.9, -1.1, -0.4], [1.9, 1.1, 0.4], 0.15)
    ways = ways_to_open(*mesh, NONE)
    assert len(ways) > 1
    for way in ways:
        assert topology.euler_characteristic(way.faces) == 2 and len(way.caps) == 4
        side = mesh[0][way.origin[way.caps]][:, 0]
        assert (side[:2] > 0).all() != (side[2:] > 0).all()  # each ring once
    orders = [tuple(order.tolist()) for order in ways[0].orders()]
    assert len(set(orders)) == 8 and orders[0] == (0, 1, 2, 3) and (3, 2, 0, 1) in orders


def test_cuts_keep_off_given_landmarks_and_there_are_not_too_many(monkeypatch):
    mesh = torus(24, 12, 0.3)
    fixed = np.arange(0, 24, 3)
    for way in ways_to_open(*mesh, fixed):
        kept, count = np.unique(way.origin[: -len(way.caps)], return_counts=True)
        assert (count[np.isin(kept, fixed)] == 1).all()
    with pytest.raises(NsmError) as refused:
        ways_to_open(*mesh, np.arange(len(mesh[0])))
    assert (refused.value.kind, refused.value.key) == ("no_proposal", "landmarks")
    monkeypatch.setattr(opened_handles, "_MOST_HANDLES", 0)
    with pytest.raises(NsmError, match="1 handle"):
        ways_to_open(*mesh, NONE)


def test_where_a_surface_meets_itself_any_short_curves_are_taken(monkeypatch):
    monkeypatch.setattr(opened_handles, "linking_number", lambda *_: 1)
    assert ways_to_open(*torus(24, 12, 0.3), NONE)


def test_lifted_vertices_are_outside():
    vertices, faces = torus(24, 12, 0.3)
    for turned in (faces, faces[:, ::-1]):
        off = lifted(vertices, turned)
        tube = np.hypot(np.hypot(off[:, 0], off[:, 1]) - 1, off[:, 2])
        assert (tube > 0.3).all() and (tube < 0.305).all()


def test_a_turned_and_bent_shape_with_a_handle_is_recognised(pair, quick):
    source, target, place = pair
    found = proposed(source, target)
    best = found.hypotheses[0]
    assert len(best.vertices) >= 4 and best.score < 2
    assert errors(best.vertices, target, place).max() < 0.15
    # one of them on the handle
    around = source[0][best.vertices[:, 0]]
    assert ((around[:, 2] > 0.6) & (np.abs(around[:, 1]) < 0.2)).any()
    for k in (0, 1):
        assert len(np.unique(best.vertices[:, k])) == len(best.vertices)


def test_given_landmarks_of_shapes_with_handles_are_kept(pair, quick):
    source, target, place = pair
    side = int(source[0][:, 1].argmax())
    given = np.array([[side, place[side]]])
    found = proposed(source, target, given)
    best = found.hypotheses[0].vertices
    assert found.given == 1 and best[0].tolist() == given[0].tolist()
    assert errors(best, target, place).max() < 0.15


def test_other_numbers_of_handles_are_refused(pair):
    rings = marching(two_rings, [-1.9, -1.1, -0.4], [1.9, 1.1, 0.4], 0.15)
    with pytest.raises(NsmError) as refused:
        proposed(pair[0], rings)
    assert refused.value.kind == "wrong_topology" and "1 handle" in str(refused.value)


@pytest.mark.parametrize(("rings", "sure"), [(2, True), (3, False)])
def test_three_handles_are_never_sure(rings, sure, monkeypatch):
    centres = np.array([-0.75, 0.8, 2.3])[:rings]

    def solid(p):
        return np.minimum.reduce(
            [np.hypot(np.hypot(p[:, 0] - c, p[:, 1]) - 0.65, p[:, 2]) - 0.26 for c in centres]
        )

    mesh = marching(solid, [-1.9, -1.1, -0.4], [3.4, 1.1, 0.4], 0.15)
    assert topology.genus_and_boundary(mesh[1]) == (rings, 0)
    pairs = np.arange(8).reshape(4, 2)
    best = proposal.Hypothesis(pairs, 1.0, True, None)
    monkeypatch.setattr(proposal, "opened_shapes", lambda *_: (None, []))
    monkeypatch.setattr(proposal, "hypotheses", lambda *_: [best])
    monkeypatch.setattr(proposal, "on_whole", lambda candidate, ends, least, meshes: ends + 1)
    found = proposed(mesh, mesh)
    assert found.sure == sure
    assert np.array_equal(found.hypotheses[0].vertices, pairs + 1)
