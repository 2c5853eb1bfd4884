"""Shapes with handles cut alike: branches through corresponding handles."""

import igl
import numpy as np
import pytest

from nsm.domains import Disc
from nsm.domains.common_cut import best_common_cut
from nsm.domains.common_handles import open_handles
from nsm.domains.common_seams import aligned_keys, lead_tree, tracers_of
from nsm.domains.joint_preparation import Mesh, prepare_jointly
from nsm.domains.matched_landmarks import matched_landmarks
from nsm.surfaces import topology
from nsm.surfaces.cutting import cut_along_paths
from nsm.surfaces.validation import clean

ENDS = np.array([[-1.6, 0, 0], [1.6, 0, 0], [0, 0.4, 0], [-0.8, -0.8, 0], [0.8, 0.3, 0.2]])


def two_rings(cells=24):
    """A surface of genus 2 by marching cubes, of rings of two sizes, as vertices and faces."""
    axes = [np.linspace(-1.9, 1.9, cells), np.linspace(-1.1, 1.1, cells), np.linspace(-0.4, 0.4, 8)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    far = [
        np.hypot(np.hypot(points[:, 0] - c, points[:, 1]) - r, points[:, 2]) - 0.26
        for c, r in ((-0.75, 0.62), (0.8, 0.7))
    ]
    sizes = [len(axis) for axis in axes]
    vertices, faces, _ = igl.marching_cubes(np.minimum(*far), points, *sizes, 0.0)
    mesh = clean(vertices, faces, "rings")
    return mesh.vertices, mesh.faces


def nearest(vertices, points):
    return np.array([np.linalg.norm(vertices - p, axis=1).argmin() for p in points])


@pytest.fixture(scope="module")
def pair():
    """The rings, and the same bent, scaled and with its vertices in another order."""
    vertices, faces = two_rings()
    assert topology.genus_and_boundary(faces) == (2, 0)
    order = np.random.default_rng(0).permutation(len(vertices))
    place = np.argsort(order)
    bent = 3 * vertices + 0.4 * np.sin(vertices[:, [1, 2, 0]])
    ids = nearest(vertices, ENDS)
    meshes = [Mesh("rings", vertices, faces), Mesh("bent", bent[order], place[faces])]
    return meshes, [ids, place[ids]], place


@pytest.mark.parametrize("count", [2, 3])
def test_few_landmarks_open_handles_from_between_them(pair, count):
    """At two landmarks fewer edges meet than the branches of two handles need."""
    meshes, ids, _ = pair
    surfaces = prepare_jointly(meshes, [one[:count] for one in ids], cache=False)
    for surface, own in zip(surfaces, ids, strict=True):
        assert surface.quality["flipped_triangles"] == 0 and topology.is_disc(surface.faces)
        assert np.isin(own[:count], surface.source_vertex).all()
    matched = matched_landmarks(surfaces, [one[:count] for one in ids])
    on_boundary = slice(matched.on_boundary)
    np.testing.assert_allclose(matched.points[0][on_boundary], matched.points[1][on_boundary])
    assert set(matched.numbers[on_boundary].tolist()) == set(range(count))


def test_branches_leave_a_disc_and_meet_at_landmarks_only(pair):
    meshes, ids, _ = pair
    tracers = tracers_of([(m.vertices, m.faces) for m in meshes], ids)
    assert lead_tree(tracers) and open_handles(tracers)
    for mesh, tracer, own in zip(meshes, tracers, ids, strict=True):
        assert len(tracer.laid) == len(own) - 1 + 4
        inner = [v for path in tracer.laid for v in path[1:-1]]
        assert len(set(inner)) == len(inner) and not set(inner) & set(own.tolist())
        assert topology.is_disc(cut_along_paths(mesh.vertices, mesh.faces, tracer.laid).faces)
        # no branch of the tree alone opens a handle
        rest = topology.cut_along(mesh.faces, _on(mesh.faces, tracer.laid[: len(own) - 1]))[0]
        assert topology.genus_and_boundary(rest) == (2, 1)


def _on(faces, paths):
    """(E,) mask of the edges on paths."""
    steps = {
        tuple(sorted(step)) for path in paths for step in zip(path[:-1], path[1:], strict=True)
    }
    return np.array([tuple(pair) in steps for pair in topology.edges_of(faces).pairs.tolist()])


def test_equal_shapes_in_another_order_are_cut_along_the_same_edges(pair):
    meshes, ids, place = pair
    first, faces = meshes[0], meshes[1].faces
    same = Mesh("same", first.vertices[np.argsort(place)], faces)
    both = tracers_of([(m.vertices, m.faces) for m in (first, same)], ids)
    assert lead_tree(both) and open_handles(both)
    moved = [[int(place[v]) for v in path] for path in both[0].laid]
    assert [min(p, p[::-1]) for p in moved] == [min(p, p[::-1]) for p in both[1].laid]


def test_the_walk_around_the_cut_passes_the_same_branches(pair):
    meshes, ids, _ = pair
    cleaned = [clean(m.vertices, m.faces, m.name) for m in meshes]
    nothing = [np.zeros(0, dtype=np.int64)] * 2
    way = best_common_cut(["rings", "bent"], cleaned, ids, "shortest", None, nothing)
    ends = [
        [int(cut.origin[v]) for v in keys] for cut, keys in zip(way.cuts, way.keys, strict=True)
    ]
    assert len(ends[0]) == 2 * (len(ENDS) - 1 + 4)
    numbers = [[own.tolist().index(v) for v in e] for own, e in zip(ids, ends, strict=True)]
    assert numbers[0] == numbers[1]


def test_landmarks_on_the_cut_have_the_same_places(pair):
    meshes, ids, _ = pair
    surfaces = prepare_jointly(
        meshes, ids, domain="disc", parameterization="tutte", seam="shortest", cache=False
    )
    matched = matched_landmarks(surfaces, ids)
    assert matched.on_boundary == 2 * (len(ENDS) - 1 + 4)
    p, q = (points[: matched.on_boundary] for points in matched.points)
    np.testing.assert_allclose(p, q, atol=1e-6)
    for sides in matched.seam(Disc(), 5):  # where they are told, both lie on the boundary
        np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), 1, atol=1e-6)


def test_of_several_rotations_the_nearest_is_taken():
    walk = np.array([[0, 5], [1, 6], [0, 7], [1, 8]])
    angle = np.arange(4) * np.pi / 2
    places = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    turned = np.roll(walk, 2, axis=0), np.roll(places, 2, axis=0)
    found = aligned_keys([walk, turned[0]], [places, turned[1]])
    assert found[1].tolist() == walk.tolist()
