"""Repairs that keep the shape, and refusals in one line."""

import numpy as np
import pytest
import trimesh

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.validation import clean

TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
)


def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return np.array(mesh.vertices), np.array(mesh.faces)


def soup(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


def with_midpoints(parts: int) -> tuple[np.ndarray, np.ndarray]:
    """A tetrahedron, one side of face 0 split into parts on that face only: a fan of slivers."""
    vertices, faces = TETRAHEDRON
    steps = np.linspace(0, 1, parts + 1)[1:-1, None]
    points = (1 - steps) * vertices[0] + steps * vertices[2]
    chain = [0, *range(4, 3 + parts), 2]
    split = [(a, b, 1) for a, b in zip(chain, chain[1:], strict=False)]
    slivers = [(0, b, a) for a, b in zip(chain[1:], chain[2:], strict=False)]
    return np.vstack([vertices, points]), np.vstack([split, slivers, faces[1:]])


@pytest.mark.parametrize("parts", [2, 3, 6])
def test_slivers_are_flipped_away_without_a_hole(parts):
    vertices, faces = with_midpoints(parts)
    mesh = clean(vertices, faces)
    assert f"{parts - 1} zero-area faces removed by edge flips" in mesh.log
    assert len(mesh.faces) == len(faces)
    assert topology.euler_characteristic(mesh.faces) == 2
    assert topology.boundary_loops(mesh.faces) == []
    areas = topology.face_areas(mesh.vertices, mesh.faces)
    assert areas.min() > 1e-3
    assert areas.sum() == pytest.approx(1.5 + 3**0.5 / 2)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(1 / 6)


def test_a_sliver_on_the_boundary_is_dropped():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]])
    mesh = clean(vertices, np.array([[0, 3, 2], [3, 1, 2], [0, 1, 3]]))
    assert "1 zero-area faces removed" in mesh.log
    assert len(mesh.faces) == 2


def test_unreferenced_vertices_are_told_beside_merged_ones():
    vertices, faces = soup(*ball())
    mesh = clean(np.vstack([vertices, [[9.0, 9, 9]]]), faces)
    assert "1 unreferenced vertices removed" in mesh.log
    assert any("coincident vertices merged" in line for line in mesh.log)
    assert mesh.merged[-1] == -1
    # each given vertex knows where it went
    assert np.allclose(mesh.vertices[mesh.merged[:-1]], vertices)
    assert np.allclose(mesh.vertices, vertices[mesh.source_vertex])


def test_crumbs_are_dropped_and_told():
    vertices, faces = ball()
    crumb, crumb_faces = TETRAHEDRON
    mesh = clean(
        np.vstack([vertices, 0.1 * crumb + 3]), np.vstack([faces, crumb_faces + len(vertices)])
    )
    assert len(mesh.faces) == len(faces)
    assert any("small separate parts dropped" in line for line in mesh.log)
    assert (mesh.merged[-4:] == -1).all()


def test_a_pinched_vertex_is_split():
    """Two far vertices of a torus made one: the surface is a torus again once it is doubled."""
    vertices, faces = catalogue_mesh("torus")
    pinched = faces.copy()
    pinched[pinched == 1024] = 0
    mesh = clean(vertices, pinched)
    assert any("touch at a point" in line for line in mesh.log)
    assert topology.euler_characteristic(mesh.faces) == 0


def test_sheets_that_coincide_are_left_apart():
    """Merged, the rim of the lid would have three faces at an edge."""
    quad = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
    wing = np.array([[1.0, 0, 0], [1, 1, 0], [1, 0, 0.01], [1, 1, 0.01]])
    faces = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2], [6, 8, 9], [6, 9, 7]]
    mesh = clean(np.vstack([quad, wing]), np.array(faces))
    assert any("left apart" in line for line in mesh.log)
    assert len(mesh.faces) == 4


def moebius() -> tuple[np.ndarray, np.ndarray]:
    n = 12
    angle = 2 * np.pi * np.arange(n) / n
    rows = []
    for side in (-0.3, 0.3):
        reach = 1 + side * np.cos(angle / 2)
        rows.append(
            np.stack([reach * np.cos(angle), reach * np.sin(angle), side * np.sin(angle / 2)], 1)
        )
    faces = []
    for i in range(n - 1):
        faces += [(i, i + 1, n + i + 1), (i, n + i + 1, n + i)]
    faces += [(n - 1, n, 0), (n - 1, 0, 2 * n - 1)]  # the last pair is crossed over
    return np.vstack(rows), np.array(faces)


def fin() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = TETRAHEDRON
    return np.vstack([vertices, [[1.0, 1, -1]]]), np.vstack([faces, [[0, 1, 4]]])


def with_value(value: float) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    vertices[7, 1] = value
    return vertices, faces


def twice() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    return np.vstack([vertices, vertices + 3]), np.vstack([faces, faces + len(vertices)])


def renumbered(number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    faces[3, 1] = number
    return vertices, faces


NOTHING = np.zeros((0, 3))


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (with_value(np.nan), "vertex 7 is NaN"),
        (with_value(np.inf), "vertex 7 is NaN or infinite"),
        (fin(), "non-manifold edge"),
        (soup(*fin()), "non-manifold edge"),
        (twice(), "2 separate parts"),
        (moebius(), "one-sided"),
        (renumbered(10_000), "names vertex 10000"),
        (renumbered(-1), "names vertex -1"),
        ((NOTHING, NOTHING.astype(int)), "no 3D vertices"),
        ((ball()[0], NOTHING.astype(int)), "no faces"),
        ((ball()[0], np.zeros((2, 4), int)), r"faces of shape \(2, 4\)"),
        ((ball()[0][:, :2], ball()[1]), r"vertices of shape \(\d+, 2\)"),
        ((np.zeros((4, 3)), TETRAHEDRON[1]), "zero area"),
        ((TETRAHEDRON[0], np.array([[0, 0, 1], [2, 2, 3]])), "zero area"),
        ((ball()[0] * [1, 0, 0], ball()[1]), "zero area"),
    ],
)
def test_what_needs_a_decision_is_refused_in_one_line(mesh, words):
    with pytest.raises(NsmError, match=words) as caught:
        clean(*mesh, "shape")
    assert str(caught.value).startswith("shape: ")
    assert "\n" not in str(caught.value)


def test_small_faces_beside_a_long_spike_are_kept():
    """Their area is nothing beside the square of the diagonal, but they are the shape."""
    vertices, faces = ball()
    vertices[5] *= 1e7
    mesh = clean(vertices, faces)
    assert np.array_equal(mesh.faces, faces)
    assert mesh.log == ()


def test_a_vertex_that_was_written_down_twice_is_joined_without_a_hole():
    vertices, faces = ball()
    corner = faces[0, 0]
    twin = len(vertices)
    ring = np.flatnonzero((faces == corner).any(axis=1))
    first = ring[0]
    p, q = (v for v in faces[first] if v != corner)
    faces[first][faces[first] == corner] = twin
    faces = np.vstack([faces, [(corner, p, twin), (twin, q, corner)]])
    mesh = clean(np.vstack([vertices, vertices[corner] + 1e-15]), faces)
    assert any("neighbours at no distance" in line for line in mesh.log)
    assert topology.euler_characteristic(mesh.faces) == 2
    assert topology.boundary_loops(mesh.faces) == []
    assert mesh.merged[twin] == mesh.merged[corner]


@pytest.mark.parametrize(("scale", "word"), [(1e40, "too large"), (1e-40, "too small")])
def test_what_single_precision_cannot_hold_is_refused(scale, word):
    vertices, faces = ball()
    with pytest.raises(NsmError, match=word):
        clean(scale * vertices, faces)
