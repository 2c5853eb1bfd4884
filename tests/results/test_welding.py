"""Weld: copies of seam vertices in one point of the target, meshes closed, triangles not turned."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from domains.orbifold.shapes import limbs, torus
from domains.test_surface import ring_with_holes
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.domains import Surface
from nsm.results.welding import weld
from nsm.surfaces import shapes, topology
from nsm.surfaces.geometry import point_mesh_distance
from nsm.surfaces.location import Places, locate


def pretzel():
    """A rounded closed mesh of genus 2."""
    vertices, faces = ring_with_holes(2)
    for _ in range(2):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    trimesh.smoothing.filter_laplacian(mesh, iterations=3)
    return np.array(mesh.vertices), np.array(mesh.faces)


MESHES = {
    "limbs": limbs(3)[:2],
    "torus": torus((40, 20)),
    "pretzel": pretzel(),
    "cylinder": shapes.cylinder(),
}
PAIRS = {
    name: (
        Surface.from_arrays(*mesh, name=name),
        # another triangulation, cut elsewhere
        Surface.from_arrays(*trimesh.remesh.subdivide(*mesh), name=f"{name} subdivided"),
    )
    for name, mesh in MESHES.items()
}
each = pytest.mark.parametrize("name", sorted(PAIRS))
names = st.sampled_from(sorted(PAIRS))


def on_seam(source):
    number, count = np.unique(source.source_vertex, return_inverse=True, return_counts=True)[1:]
    return (count > 1)[number.reshape(-1)] & (source.source_vertex >= 0)


def pulled_apart(source, target, random, share):
    """The identity, with each copy on the seam put off by a share of the mean edge."""
    a, b = source.vertices[source.faces[:, 0]], source.vertices[source.faces[:, 1]]
    size = share * np.linalg.norm(a - b, axis=1).mean()
    noise = size * random.normal(size=source.vertices.shape) * on_seam(source)[:, None]
    return locate(source.vertices + noise, target.vertices, target.faces)


def turned(points, faces, vertices):
    """Triangles (F, 3) whose images (W, 3) face against those of the mesh (W, 3) itself: an
    independent check where the map is near the identity."""
    sides = [np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
             for p in (points, vertices)]  # fmt: skip
    return (sides[0] * sides[1]).sum(axis=1) <= 0


def by_file(source, values):
    return values[source.cut_vertex]


def as_set(faces):
    """Oriented triangles, wherever they start."""
    first = faces.argmin(axis=1)[:, None]
    return {tuple(f) for f in np.take_along_axis(faces, (first + np.arange(3)) % 3, 1).tolist()}


@each
def test_faces_are_those_of_the_file(name):
    source, target = PAIRS[name]
    faces = weld(source, target, pulled_apart(source, target, np.random.default_rng(0), 0)).faces
    assert as_set(faces) == as_set(MESHES[name][1]) and len(faces) == len(MESHES[name][1])
    assert (topology.edges_of(faces).count == 2).all() == (name != "cylinder")


def test_the_shapes_have_seams_and_inserted_points():
    assert all(on_seam(source).any() for source, _ in PAIRS.values())
    assert any((source.source_vertex < 0).any() for source, _ in PAIRS.values())


@each
def test_what_is_together_stays(name):
    source, target = PAIRS[name]
    places = pulled_apart(source, target, np.random.default_rng(0), 0)
    welded = weld(source, target, places)
    assert welded.flipped_triangles == 0
    assert welded.largest_move < 1e-12
    np.testing.assert_allclose(welded.points, places.take(target.vertices, target.faces), atol=1e-9)


@given(st.integers(0, 2**32 - 1), names, st.floats(0.01, 0.08))
@examples(25)
def test_copies_meet_on_the_target_and_nothing_else_moves(seed, name, share):
    source, target = PAIRS[name]
    places = pulled_apart(source, target, np.random.default_rng(seed), share)
    before = places.take(target.vertices, target.faces)
    welded = weld(source, target, places)
    at = welded.places.take(target.vertices, target.faces)
    np.testing.assert_allclose(at, welded.points, atol=1e-12)
    assert point_mesh_distance(welded.points, target.vertices, target.faces).max() < 1e-9
    a, b = source.seam_pairs.T
    assert (welded.points[a] == welded.points[b]).all()
    still = ~on_seam(source)
    assert (welded.points[still] == before[still]).all()
    moves = np.linalg.norm(welded.points - before, axis=1)
    assert welded.largest_move == pytest.approx(moves.max())
    # small gaps turn nothing over
    assert welded.flipped_triangles == 0
    points, vertices = by_file(source, welded.points), by_file(source, source.vertices)
    assert not turned(points, welded.faces, vertices).any()


@given(st.integers(0, 2**32 - 1), names)
@examples(10)
def test_gaps_of_half_an_edge_are_relaxed(seed, name):
    """The middles alone turn triangles over; the relaxation turns nearly all of them back."""
    source, target = PAIRS[name]
    places = pulled_apart(source, target, np.random.default_rng(seed), 0.7)
    welded = weld(source, target, places)
    before = places.take(target.vertices, target.faces)
    number = np.maximum(source.source_vertex, 0)
    count = np.bincount(number, source.source_vertex >= 0, len(source.cut_vertex))
    middle = np.stack([np.bincount(number, x * (source.source_vertex >= 0)) for x in before.T], 1)
    middle /= count[:, None]
    at = by_file(source, source.vertices)
    sides = [before, source.vertices], [middle, at], [by_file(source, welded.points), at]
    faces = (welded.corners, welded.faces, welded.faces)
    torn, naive, after = (turned(p, f, q) for (p, q), f in zip(sides, faces, strict=True))
    naive, after = (int((x & ~torn).sum()) for x in (naive, after))
    assert welded.flipped_triangles <= max(2, naive // 4) and after <= max(3, naive // 3)


@each
def test_kept_vertices_draw_their_copies(name):
    source, target = PAIRS[name]
    places = pulled_apart(source, target, np.random.default_rng(3), 0.2)
    before = places.take(target.vertices, target.faces)
    kept = source.seam_pairs[::5, 1]
    kept = kept[np.unique(source.source_vertex[kept], return_index=True)[1]]
    points = weld(source, target, places, kept.tolist()).points
    np.testing.assert_allclose(points[kept], before[kept], atol=1e-12)
    same = source.source_vertex[:, None] == source.source_vertex[kept]
    vertex, which = np.nonzero(same)
    assert (points[vertex] == points[kept][which]).all()


def test_triangles_that_cannot_be_turned_back_are_counted():
    """Copies three edges apart: some triangles stay turned, and a plain recount finds them."""
    source, target = PAIRS["limbs"]
    places = pulled_apart(source, target, np.random.default_rng(0), 3.0)
    welded = weld(source, target, places)
    normals = np.zeros_like(target.vertices)
    corners = target.vertices[target.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    number = target.source_vertex
    for v in range(number.max() + 1):
        normals[number == v] = cross[(number[target.faces] == v).any(axis=1)].sum(axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def count(p):
        points, normal = p.take(target.vertices, target.faces), p.take(normals, target.faces)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        a, b, c = (points[welded.corners[:, k]] for k in range(3))
        middle = normal[welded.corners].sum(axis=1)
        return (np.cross(b - a, c - a) * middle).sum(axis=1) <= 0

    new = count(welded.places) & ~count(places)
    assert welded.flipped_triangles == new.sum() > 0


def test_another_sheet_is_not_taken():
    """Copies on two sides of a thin plate: the point between is not inside or on another side."""
    box = trimesh.creation.box((2, 2, 0.02)).subdivide().subdivide().subdivide()
    plate = Surface.from_arrays(np.array(box.vertices), np.array(box.faces), name="plate")
    source = PAIRS["limbs"][0]
    up = np.array([0.4, 0.4, 1.0]) * plate.scale
    down = np.array([0.4, 0.4, -1.0]) * plate.scale
    points = np.tile(up, (len(source.vertices), 1))
    a, b = source.seam_pairs[0]
    points[b] = down
    places = locate(points, plate.vertices, plate.faces)
    first = Places(places.face[[a]], places.weights[[a]]).take(plate.vertices, plate.faces)[0]
    assert np.linalg.norm(weld(source, plate, places).points[b] - first) < 1e-9
