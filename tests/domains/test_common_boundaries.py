"""Open meshes with several boundaries: those that correspond have the same places in Ω."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from nsm.domains.joint_preparation import Mesh, prepare_jointly
from nsm.domains.matched_landmarks import cut_together, matched_landmarks, with_ends
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.shapes import cylinder

HOLES = np.array([[1.0, 0, 0], [0, 1, 0.3], [-0.5, -0.5, -0.7]])


def mask(subdivisions, size, stretch=(1.0, 1.0, 1.0)):
    """A ball without three caps, from small to large."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    middle = vertices[faces].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    holes = HOLES / np.linalg.norm(HOLES, axis=1, keepdims=True)
    near = (middle @ holes.T > np.cos(size * np.array([1.0, 1.3, 1.6]))).any(axis=1)
    used, number = topology.renumbered(faces[~near], len(vertices))
    return vertices[used] * stretch, number[faces[~near]]


def nearest(vertices, points):
    return np.array([np.linalg.norm(vertices - p, axis=1).argmin() for p in np.array(points)])


INNER = np.array([[0, 0, 1.0], [0, -1, 0], [-0.7, 0.7, 0]])


@pytest.fixture(scope="module")
def masks():
    a, b = mask(3, 0.30), mask(3, 0.36, (1.0, 1.2, 0.9))
    ids = [nearest(a[0], INNER), nearest(b[0] / [1.0, 1.2, 0.9], INNER)]
    return [Mesh("one", *a), Mesh("two", *b)], ids


@pytest.fixture(scope="module", params=["disc", "square"])
def cut_alike(masks, request):
    meshes, ids = masks
    options = {"domain": request.param, "cache": False, "seam": "shortest"}
    return meshes, ids, prepare_jointly(meshes, ids, parameterization="tutte", **options)


def test_cuts_end_at_corresponding_places_of_boundaries(cut_alike):
    meshes, ids, surfaces = cut_alike
    assert cut_together(surfaces)
    assert all(s.quality["flipped_triangles"] == 0 for s in surfaces)
    every = with_ends(surfaces, ids)
    assert len(every[0]) == len(every[1]) > len(ids[0])
    matched = matched_landmarks(surfaces, every)
    on = matched.on_boundary
    p, q = (points[:on] for points in matched.points)
    assert np.abs(p - q).max() < 1e-12
    for surface, mesh in zip(surfaces, meshes, strict=True):
        assert np.isin(surface.ends[1:], np.concatenate(topology.boundary_loops(mesh.faces))).all()
    assert not cut_together([surfaces[0], replace(surfaces[1], ends=None)])


def test_equal_boundaries_take_equal_parts_of_the_domain(cut_alike):
    """The same arcs of ∂Ω belong to the boundaries that correspond, and the same to the cuts."""
    meshes, _, surfaces = cut_alike
    arcs = []
    for surface, mesh in zip(surfaces, meshes, strict=True):
        loop = topology.boundary_loops(surface.faces)[0]
        places = surface.domain.boundary_fractions(surface.uv[loop])
        number = np.full(len(mesh.vertices), -1)
        for k, own in enumerate(topology.boundary_loops(mesh.faces)):  # from large to small
            number[own] = k
        source = surface.source_vertex[loop]
        label = np.where(source >= 0, number[source], -1)
        # an arc begins where a vertex of a boundary, or of a cut, follows another kind
        begins = label != np.roll(label, 1)
        order = np.argsort(places[begins])
        arcs.append((label[begins][order], places[begins][order]))
    (first, begin), (second, other) = arcs
    assert first.tolist() == second.tolist() and set(first.tolist()) == {-1, 0, 1, 2}
    on_boundary = first >= 0  # arcs of a boundary begin at a key, those of a cut a side later
    assert np.abs(begin - other)[on_boundary].max() < 1e-9
    assert np.abs(begin - other).max() < 0.02


def test_landmarks_on_boundaries_say_which_correspond(masks):
    meshes, ids = masks
    loops = [topology.boundary_loops(m.faces) for m in meshes]
    # the largest of one with the smallest of the other: two landmarks in the same order
    wanted = [
        np.concatenate([own, [loop[0], loop[len(loop) // 2]]])
        for own, loop in zip(ids, (loops[0][0], loops[1][2]), strict=True)
    ]
    options = {"seam": "shortest", "seam_landmarks": 0, "parameterization": "tutte"}
    surfaces = prepare_jointly(meshes, wanted, cache=False, **options)
    matched = matched_landmarks(surfaces, with_ends(surfaces, wanted))
    assert {3, 4} <= set(matched.numbers[: matched.on_boundary].tolist())
    sizes = [len(loop) for loop in loops[1]]
    line = next(line for line in surfaces[1].log if "correspond to" in line)
    assert f"{sizes[2]}" in line.split("edges")[0].split(",")[0]


def test_landmarks_that_contradict_boundaries_are_refused(masks):
    meshes, ids = masks
    loops = [topology.boundary_loops(m.faces) for m in meshes]

    def kind(extra):
        wanted = [np.concatenate([own, more]) for own, more in zip(ids, extra, strict=True)]
        with pytest.raises(NsmError) as refused:
            prepare_jointly(meshes, wanted, cache=False)
        assert refused.value.key == "landmarks"
        return refused.value.kind

    one, two = loops[0], loops[1]
    inside = nearest(meshes[1].vertices, [[0.1, 0.1, 0.9]])[0]
    assert kind([[one[0][0]], [inside]]) == "no_common_seam"
    assert kind([[one[0][0], one[0][3]], [two[0][0], two[1][0]]]) == "no_common_seam"
    turned = [[one[0][0], one[0][4], one[0][8]], [two[0][0], two[0][8], two[0][4]]]
    assert kind(turned) == "no_common_seam"


def test_tubes_without_landmarks_are_cut_alike():
    vertices, faces = cylinder(32, 11)
    meshes = [Mesh("a", vertices, faces), Mesh("b", vertices * [1, 1, 1.5], faces)]
    none = [np.zeros(0, dtype=np.int64)] * 2
    options = {"seam": "shortest", "parameterization": "tutte"}
    surfaces = prepare_jointly(meshes, none, cache=False, **options)
    ends = with_ends(surfaces, none)
    assert len(ends[0]) == 2 and matched_landmarks(surfaces, ends).on_boundary == 4
