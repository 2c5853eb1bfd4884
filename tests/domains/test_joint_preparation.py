"""Meshes cut alike: corresponding seams, places on the boundary, and matched landmarks."""

import numpy as np
import pytest
import trimesh
from domains.orbifold.shapes import limbs
from domains.orbifold.shapes import torus as bent_torus

from nsm.domains import Disc, Square, Surface
from nsm.domains.common_seams import (
    aligned_keys,
    boundary_keys,
    corresponding_paths,
    edge_lengths,
    mutually_far,
    seam_costs,
)
from nsm.domains.joint_preparation import Mesh, prepare_jointly
from nsm.domains.matched_landmarks import matched_landmarks
from nsm.domains.orbifold.common_cones import choose_common_cones, distinct
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.cutting import cut_along_paths
from nsm.surfaces.shapes import hemisphere, torus


def ball(subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def nearest(vertices, points):
    return np.array([np.linalg.norm(vertices - p, axis=1).argmin() for p in np.array(points)])


POINTS = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]


@pytest.fixture(scope="module")
def pair():
    """A ball, and the same stretched and finer, with six landmarks each."""
    a, b = ball(2), ball(3)
    stretched = b[0] * [1.0, 1.5, 0.8]
    ids = [nearest(a[0], POINTS), nearest(b[0], POINTS)]
    return [Mesh("ball", *a), Mesh("egg", stretched, b[1])], ids


def test_branches_meet_at_landmarks_only_and_make_one_tree(pair):
    meshes, ids = pair
    paths = corresponding_paths([(m.vertices, m.faces) for m in meshes], ids)
    for mesh_paths, landmarks in zip(paths, ids, strict=True):
        inner = [v for p in mesh_paths for v in p[1:-1]]
        assert len(set(inner)) == len(inner)
        assert not set(inner) & set(landmarks.tolist())
        assert len(mesh_paths) == len(landmarks) - 1
    ends = [
        [tuple(int(np.flatnonzero(own == p[k])[0]) for k in (0, -1)) for p in mesh_paths]
        for mesh_paths, own in zip(paths, ids, strict=True)
    ]
    assert ends[0] == ends[1]


def test_the_walk_around_the_seam_passes_landmarks_in_the_same_order(pair):
    meshes, ids = pair
    paths = corresponding_paths([(m.vertices, m.faces) for m in meshes], ids)
    keys = []
    for mesh, path, landmarks in zip(meshes, paths, ids, strict=True):
        cut = cut_along_paths(mesh.vertices, mesh.faces, path)
        assert topology.is_disc(cut.faces)
        keys.append(boundary_keys(cut.origin, cut.loop, landmarks))
    assert len(keys[0]) == 2 * (len(POINTS) - 1)  # each branch is walked along twice
    alike = aligned_keys(keys)
    assert alike is not None
    assert (alike[0][:, 0] == alike[1][:, 0]).all()


def test_two_landmarks_side_by_side_are_no_seam_of_one_edge():
    vertices, faces = ball(2)
    far = nearest(vertices, POINTS[::3])
    ids = [far, faces[faces[:, 0] == far[0]][0, :2]]
    paths = corresponding_paths([(vertices, faces)] * 2, ids)
    assert paths is not None
    for own, path in zip(ids, paths, strict=True):
        assert [path[0][0], path[0][-1]] == own.tolist()
        assert topology.is_disc(cut_along_paths(vertices, faces, path).faces)


def test_walks_in_other_orders_are_not_alike():
    walk = np.array([[0, 5], [1, 6], [2, 7]])
    assert aligned_keys([walk, walk[[0, 2, 1]]]) is None
    turned = aligned_keys([walk, np.roll(walk, 1, axis=0)])
    assert turned is not None and (turned[1] == walk).all()


@pytest.mark.parametrize("domain", ["disc", "square"])
def test_landmarks_on_the_seam_have_the_same_place_in_all_domains(pair, domain):
    meshes, ids = pair
    surfaces = prepare_jointly(meshes, ids, domain=domain, seam="shortest", cache=False)
    p, q = matched_landmarks(surfaces, ids).points
    assert len(p) == 2 * (len(POINTS) - 1)
    assert np.abs(p - q).max() < 1e-12
    norm = np.linalg.norm(p, ord=2 if domain == "disc" else np.inf, axis=1)
    assert np.abs(norm - 1).max() < 1e-12
    for surface in surfaces:
        assert surface.quality["flipped_triangles"] == 0
    if domain == "square":  # four keys have become the corners
        assert (np.abs(p).min(axis=1) > 1 - 1e-12).sum() == 4


def test_the_seam_keeps_off_landmarks_that_it_does_not_pass_through(pair):
    meshes, ids = pair
    surfaces = prepare_jointly(meshes, ids, seam="hidden", seam_landmarks=3, cache=False)
    p, _ = matched_landmarks(surfaces, ids).points
    inner = np.linalg.norm(p, axis=1) < 1 - 1e-9
    assert inner.sum() == len(POINTS) - 3


def test_surfaces_cut_apart_have_all_landmarks_inside():
    meshes = [Mesh("ball", *ball(2)), Mesh("egg", ball(3)[0] * [1.0, 1.5, 0.8], ball(3)[1])]
    usual = [Surface.from_arrays(m.vertices, m.faces) for m in meshes]
    # all on the seams that they would have
    ids = [np.unique(s.source_vertex[s.seam_pairs])[::3][:6] for s in usual]
    surfaces = prepare_jointly(meshes, ids, seam="own", cache=False)
    matched = matched_landmarks(surfaces, ids)
    assert matched.on_boundary == 0 and list(matched.numbers) == list(range(6))
    for surface, on_seam in zip(surfaces, ids, strict=True):
        assert not np.isin(on_seam, surface.source_vertex[surface.seam_pairs]).any()


def test_the_best_of_several_seams_is_taken(pair):
    meshes, ids = pair
    surfaces = prepare_jointly(meshes, ids, cache=False)
    assert any("of 6 landmarks" in line for line in surfaces[0].log)
    matched_landmarks(surfaces, ids)


def test_prepared_surfaces_are_taken_from_the_cache(pair):
    meshes, ids = pair
    first = prepare_jointly(meshes, ids, seam="shortest")
    second = prepare_jointly(meshes, ids, seam="shortest")
    assert "prepared surface taken from the cache" in second[1].log
    assert (first[1].uv == second[1].uv).all()
    other = prepare_jointly(meshes, [i[::-1] for i in ids], seam="shortest")
    assert "prepared surface taken from the cache" not in other[1].log
    # cleaned, this mesh is the same, but its vertices have other numbers
    first, second = meshes
    shifted = Mesh("egg", np.concatenate([[[9, 9, 9]], second.vertices]), second.faces + 1)
    more = prepare_jointly([first, shifted], [ids[0], ids[1] + 1], seam="shortest")
    assert more[1].source_vertex.max() == len(second.vertices)


def test_open_meshes_are_left_whole():
    surfaces = [Surface.load(name, cache=False) for name in ("hemisphere", "saddle")]
    meshes = [Mesh(s.name, s.vertices, s.faces) for s in surfaces]
    together = prepare_jointly(meshes, [np.array([500, 600])] * 2, cache=False)
    for surface in together:
        assert len(surface.seam_pairs) == 0
    p, q = matched_landmarks(together, [np.array([500, 600])] * 2).points
    assert p.shape == q.shape == (2, 2)


def test_seams_that_do_not_correspond_are_refused(pair):
    meshes, ids = pair
    surfaces = [
        Surface.from_arrays(m.vertices, m.faces, name=m.name, seam_vertices=s)
        for m, s in zip(meshes, ([*ids[0][:3]], [*ids[1][1:4]]), strict=True)
    ]
    with pytest.raises(NsmError) as error:
        matched_landmarks(surfaces, ids)
    assert error.value.kind == "no_common_seam"


def test_hidden_seams_cost_more_where_a_surface_is_seen():
    vertices, faces = ball()
    length = edge_lengths(vertices, faces)
    # nothing hides a convex shape
    assert np.allclose(seam_costs(vertices, faces, "hidden"), 4 * length, rtol=0.05)
    assert (seam_costs(vertices, faces, "shortest") == length).all()
    with pytest.raises(NsmError) as error:
        seam_costs(vertices, faces, "other")
    assert (error.value.kind, error.value.key) == ("unknown_option", "seam.path")


def test_mutually_far_landmarks_are_opposite_ones():
    vertices, faces = ball()
    chosen = mutually_far([(vertices, faces)], [nearest(vertices, POINTS)], 2)
    assert abs(chosen[0] - chosen[1]) == 3
    assert len(mutually_far([(vertices, faces)], [nearest(vertices, POINTS)], None)) == 6


def test_fractions_run_counter_clockwise_from_corner_to_corner():
    t = np.array([0.0, 0.125, 0.25, 0.5, 0.75])
    expected = [[-1, -1], [0, -1], [1, -1], [1, 1], [-1, 1]]
    assert np.abs(Square().boundary_points(t) - expected).max() < 1e-12
    assert np.abs(Disc().boundary_points(t)[2] - [0, 1]).max() < 1e-12


def test_the_animals_are_cut_alike(shared_meshes):
    from nsm.surfaces.landmark_files import read_landmarks
    from nsm.surfaces.loading import load_mesh

    names = ["shrec07-384", "shrec07-388"]
    arrays = [load_mesh(shared_meshes / f"{n}.off")[:2] for n in names]
    ids = [np.array(read_landmarks(shared_meshes / "landmarks" / f"{n}.vts")) for n in names]
    paths = corresponding_paths(arrays, ids)
    keys = []
    for (vertices, faces), path, landmarks in zip(arrays, paths, ids, strict=True):
        cut = cut_along_paths(vertices, faces, path)
        keys.append(boundary_keys(cut.origin, cut.loop, landmarks))
    assert aligned_keys(keys) is not None


def test_the_common_seam_glues_each_branch_to_its_way_back(pair):
    meshes, ids = pair
    surfaces = prepare_jointly(meshes, ids, seam="shortest", cache=False)
    matched = matched_landmarks(surfaces, ids)
    seam = matched.seam(Disc(), 4)
    assert seam.shape == (4 * (len(POINTS) - 1), 2, 2)
    assert np.abs(np.linalg.norm(seam, axis=2) - 1).max() < 1e-12
    # close to a key, both copies are close to keys of one landmark
    keys, numbers = matched.points[0], matched.numbers
    ends = matched.seam(Disc(), 1000)
    first = [numbers[np.linalg.norm(keys - p, axis=1).argmin()] for p in ends[::1000, 0]]
    second = [numbers[np.linalg.norm(keys - p, axis=1).argmin()] for p in ends[::1000, 1]]
    assert first == second


@pytest.mark.parametrize("other", ["torus", "hemisphere"])
def test_meshes_of_another_topology_are_refused_before_any_layout(other):
    """A sphere beside a torus (genus 1), or beside a cap (one boundary loop)."""
    vertices, faces = {"torus": torus, "hemisphere": hemisphere}[other]()
    meshes = [Mesh("ball", *ball(2)), Mesh(other, vertices, faces)]
    with pytest.raises(NsmError) as error:
        prepare_jointly(meshes, [np.arange(3), np.arange(3)], cache=False)
    assert (error.value.kind, error.value.key) == ("wrong_topology", other)


# ---------------------------------------------------------------- closed domains


@pytest.fixture(scope="module")
def limbed():
    """A ball with four limbs and the same stretched; the tips are the landmarks 1, 2, 4 and 6."""
    points, faces, tips = limbs(3)
    inner = nearest(points, [[0, 0, 1], [0, 0, -1], [0.6, 0, 0.5], [0, 0.7, 0]])
    ids = np.array([inner[0], tips[0], tips[1], inner[1], tips[2], inner[2], tips[3], inner[3]])
    other = points * [1.2, 0.8, 1.1] + 0.1 * np.sin(points[:, ::-1])
    return [Mesh("one", points, faces), Mesh("other", other, faces)], [ids, ids]


TIPS = {1, 2, 4, 6}


def test_limbs_become_the_cones(limbed):
    meshes, ids = limbed
    numbers, score = choose_common_cones([(m.vertices, m.faces) for m in meshes], ids)
    assert set(numbers.tolist()) == TIPS
    assert 1.38 < score < 2.5


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5, 6, 7], [6, 3, 0, 5, 2, 7, 4, 1]])
def test_the_cones_are_the_same_landmarks_on_all_meshes(limbed, order):
    meshes, ids = limbed
    ids = [own[order] for own in ids]
    surfaces = prepare_jointly(meshes, ids, domain="orbifold", cache=False)
    matched = matched_landmarks(surfaces, ids)
    p, q = matched.points
    assert matched.on_boundary == 0 and matched.numbers.tolist() == list(range(8))
    np.testing.assert_array_equal(p, surfaces[0].preimages(ids[0]))
    np.testing.assert_array_equal(q, surfaces[1].preimages(ids[1]))
    for points in (p, q):
        at_cones = np.flatnonzero((points == np.rint(points)).all(axis=1))
        assert {order[k] for k in at_cones} == TIPS
    np.testing.assert_array_equal(p[at_cones], q[at_cones])
    for surface in surfaces:
        assert surface.quality["flipped_triangles"] == 0
        assert any("cones at landmarks" in line for line in surface.log)


def test_surfaces_with_common_cones_are_taken_from_the_cache(limbed):
    meshes, ids = limbed
    first = prepare_jointly(meshes, ids, domain="orbifold")
    second = prepare_jointly(meshes, ids, domain="orbifold")
    assert "prepared surface taken from the cache" in second[1].log
    np.testing.assert_array_equal(first[1].uv, second[1].uv)
    alone = Surface.from_arrays(meshes[1].vertices, meshes[1].faces, domain="orbifold", cache=True)
    assert "prepared surface taken from the cache" not in alone.log


def test_with_fewer_landmarks_each_mesh_has_its_own_cones(limbed):
    meshes, ids = limbed
    few = [own[:3] for own in ids]
    surfaces = prepare_jointly(meshes, few, domain="orbifold", cache=False)
    for surface, mesh in zip(surfaces, meshes, strict=True):
        alone = Surface.from_arrays(mesh.vertices, mesh.faces, domain="orbifold")
        np.testing.assert_array_equal(surface.uv, alone.uv)
    p, q = matched_landmarks(surfaces, few).points
    assert p.shape == q.shape == (3, 2)


def test_tori_are_laid_out_one_by_one():
    points, faces = bent_torus()
    meshes = [Mesh("one", points, faces), Mesh("other", points * [1, 1, 1.3], faces)]
    ids = [np.array([3, 50, 90, 120, 200])] * 2
    surfaces = prepare_jointly(meshes, ids, domain="torus", cache=False)
    p, q = matched_landmarks(surfaces, ids).points
    assert p.shape == q.shape == (5, 2)
    for surface in surfaces:
        assert surface.quality["flipped_triangles"] == 0


def test_landmarks_that_coincide_on_a_mesh_count_once():
    found = distinct([np.array([4, 5, 6, 4, 8]), np.array([1, 2, 3, 4, 2])])
    assert found.tolist() == [0, 1, 2]


def test_other_topology_is_refused_on_closed_domains(limbed):
    meshes, _ = limbed
    points, faces = bent_torus()
    for domain, pair in (
        ("orbifold", [meshes[0], Mesh("ring", points, faces)]),
        ("torus", meshes),
        ("orbifold", [Mesh("ring", points, faces)] * 2),
    ):
        with pytest.raises(NsmError) as error:
            prepare_jointly(pair, [np.arange(5)] * 2, domain=domain, cache=False)
        assert error.value.kind == "wrong_topology"


@pytest.mark.parametrize("domain", ["disc", "orbifold"])
def test_meshes_laid_out_side_by_side_are_those_of_one_after_the_other(domain):
    a, b = ball(2), ball(2)
    meshes = [Mesh("ball", *a), Mesh("egg", b[0] * [1.0, 1.5, 0.8], b[1])]
    ids = [nearest(a[0], POINTS)] * 2
    both = [
        prepare_jointly(
            meshes, ids, domain=domain, cache=False, parameterization="slim", processes=n
        )
        for n in (1, 2)
    ]
    for one, other in zip(*both, strict=True):
        assert (other.name, other.domain, other.log) == (one.name, one.domain, one.log)
        for name, array in one.arrays().items():
            np.testing.assert_array_equal(other.arrays()[name], array)
