"""Repairs that keep the shape, and the kinds of errors for other meshes."""

import numpy as np
import pytest
import trimesh

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.validation import Repairs, clean
from nsm.wording import number_of

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
    """A tetrahedron with one edge of face 0 split on that face only: degenerate triangles."""
    vertices, faces = TETRAHEDRON
    steps = np.linspace(0, 1, parts + 1)[1:-1, None]
    points = (1 - steps) * vertices[0] + steps * vertices[2]
    chain = [0, *range(4, 3 + parts), 2]
    split = [(a, b, 1) for a, b in zip(chain, chain[1:], strict=False)]
    slivers = [(0, b, a) for a, b in zip(chain[1:], chain[2:], strict=False)]
    return np.vstack([vertices, points]), np.vstack([split, slivers, faces[1:]])


@pytest.mark.parametrize("parts", [2, 3, 6])
def test_degenerate_triangles_are_flipped_without_a_hole(parts):
    vertices, faces = with_midpoints(parts)
    mesh = clean(vertices, faces)
    assert f"{number_of(parts - 1, 'degenerate triangle')} removed by edge flips" in mesh.log
    assert len(mesh.faces) == len(faces)
    assert topology.euler_characteristic(mesh.faces) == 2
    assert topology.boundary_loops(mesh.faces) == []
    areas = topology.face_areas(mesh.vertices, mesh.faces)
    assert areas.min() > 1e-3
    assert areas.sum() == pytest.approx(1.5 + 3**0.5 / 2)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(1 / 6)


def test_a_degenerate_triangle_on_the_boundary_is_removed():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]])
    mesh = clean(vertices, np.array([[0, 3, 2], [3, 1, 2], [0, 1, 3]]))
    assert "1 degenerate triangle removed" in mesh.log
    assert len(mesh.faces) == 2


def test_unreferenced_and_duplicate_vertices_are_logged():
    vertices, faces = soup(*ball())
    mesh = clean(np.vstack([vertices, [[9.0, 9, 9]]]), faces)
    assert "1 unreferenced vertex removed" in mesh.log
    assert any("duplicate vertices welded" in line for line in mesh.log)
    assert mesh.merged[-1] == -1
    assert np.allclose(mesh.vertices[mesh.merged[:-1]], vertices)
    assert np.allclose(mesh.vertices, vertices[mesh.source_vertex])


def test_small_components_are_removed():
    vertices, faces = ball()
    crumb, crumb_faces = TETRAHEDRON
    mesh = clean(
        np.vstack([vertices, 0.1 * crumb + 3]), np.vstack([faces, crumb_faces + len(vertices)])
    )
    assert len(mesh.faces) == len(faces)
    assert any("small connected component" in line for line in mesh.log)
    assert (mesh.merged[-4:] == -1).all()


def test_a_non_manifold_vertex_is_split():
    """A torus with two far vertices merged."""
    vertices, faces = catalogue_mesh("torus")
    pinched = faces.copy()
    pinched[pinched == 1024] = 0
    mesh = clean(vertices, pinched)
    assert any("1 non-manifold vertex split" in line for line in mesh.log)
    assert topology.euler_characteristic(mesh.faces) == 0


def test_duplicates_whose_welding_would_make_an_edge_non_manifold_are_kept():
    quad = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]])
    wing = np.array([[1.0, 0, 0], [1, 1, 0], [1, 0, 0.01], [1, 1, 0.01]])
    faces = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2], [6, 8, 9], [6, 9, 7]]
    mesh = clean(np.vstack([quad, wing]), np.array(faces))
    assert any("duplicate vertices kept" in line for line in mesh.log)
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
    faces += [(n - 1, n, 0), (n - 1, 0, 2 * n - 1)]  # the last pair crosses over
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


def with_index(number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = ball()
    faces[3, 1] = number
    return vertices, faces


NOTHING = np.zeros((0, 3))


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [
        (with_value(np.nan), "not_finite"),
        (with_value(np.inf), "not_finite"),
        (fin(), "non_manifold"),
        (soup(*fin()), "non_manifold"),
        (twice(), "disconnected"),
        (moebius(), "not_orientable"),
        (with_index(10_000), "out_of_range"),
        (with_index(-1), "out_of_range"),
        ((NOTHING, NOTHING.astype(int)), "not_a_mesh"),
        ((ball()[0], NOTHING.astype(int)), "not_a_mesh"),
        ((ball()[0], np.zeros((2, 4), int)), "wrong_shape"),
        ((ball()[0][:, :2], ball()[1]), "wrong_shape"),
        ((ball()[0].astype(str), ball()[1]), "wrong_type"),
        ((ball()[0], ball()[1] + 0.5), "wrong_type"),
        ((np.zeros((4, 3)), TETRAHEDRON[1]), "degenerate"),
        ((TETRAHEDRON[0], np.array([[0, 0, 1], [2, 2, 3]])), "degenerate"),
        ((ball()[0] * [1, 0, 0], ball()[1]), "degenerate"),
        ((ball()[0] * 1e40, ball()[1]), "out_of_range"),
        ((ball()[0] * 1e-40, ball()[1]), "out_of_range"),
    ],
)
def test_other_meshes_are_refused(mesh, kind):
    with pytest.raises(NsmError) as caught:
        clean(*mesh, "shape")
    assert (caught.value.kind, caught.value.key) == (kind, "shape")
    assert "\n" not in str(caught.value)


def test_small_faces_beside_a_long_spike_are_kept():
    """Their area is tiny relative to the square of the diagonal."""
    vertices, faces = ball()
    vertices[5] *= 1e7
    mesh = clean(vertices, faces)
    assert np.array_equal(mesh.faces, faces)
    assert mesh.log == ()


def test_neighbours_at_one_place_are_welded_without_a_hole():
    vertices, faces = ball()
    corner = faces[0, 0]
    twin = len(vertices)
    ring = np.flatnonzero((faces == corner).any(axis=1))
    first = ring[0]
    p, q = (v for v in faces[first] if v != corner)
    faces[first][faces[first] == corner] = twin
    faces = np.vstack([faces, [(corner, p, twin), (twin, q, corner)]])
    mesh = clean(np.vstack([vertices, vertices[corner] + 1e-15]), faces)
    assert any("edges of zero length" in line for line in mesh.log)
    assert topology.euler_characteristic(mesh.faces) == 2
    assert topology.boundary_loops(mesh.faces) == []
    assert mesh.merged[twin] == mesh.merged[corner]


def two_balls() -> tuple[np.ndarray, np.ndarray]:
    """A ball of radius 2, after one of radius 1."""
    vertices, faces = ball()
    return np.vstack([vertices, 2 * vertices + 9]), np.vstack([faces, faces + len(vertices)])


@pytest.mark.parametrize(("parts", "first"), [("largest", True), (0, True), (1, False)])
def test_the_component_that_the_user_chooses_is_kept(parts, first):
    vertices, faces = two_balls()
    half = len(vertices) // 2
    mesh = clean(vertices, faces, repairs=Repairs(parts=parts))
    assert np.array_equal(mesh.source_vertex >= half, np.full(half, first))
    assert np.array_equal(mesh.vertices, vertices[mesh.source_vertex])
    assert (mesh.merged[:half] < 0).all() == first


def test_a_component_that_is_not_there_is_refused():
    with pytest.raises(NsmError) as caught:
        clean(*two_balls(), "scan", Repairs(parts=2))
    assert (caught.value.kind, caught.value.key) == ("out_of_range", "scan")


def test_a_fin_is_cut_off_and_the_rest_is_as_it_was():
    mesh = clean(*fin(), repairs=Repairs("largest", "split"))
    alone = clean(*TETRAHEDRON)
    assert np.array_equal(mesh.source_vertex[mesh.faces], alone.source_vertex[alone.faces])


def walled_tube(n: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A square tube with a wall from one of its long edges to the opposite one."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    z = np.arange(n, dtype=float)
    vertices = np.array([[x, y, h] for h in z for x, y in corners])
    faces = []
    for k in range(n - 1):
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2)):
            p, q, r, s = 4 * k + a, 4 * k + b, 4 * k + 4 + b, 4 * k + 4 + a
            faces += [(p, q, r), (p, r, s)]
    return vertices, np.array(faces)


def test_walls_are_cut_off_at_their_edges():
    vertices, faces = walled_tube()
    with pytest.raises(NsmError) as caught:
        clean(vertices, faces)
    assert caught.value.kind == "non_manifold"
    mesh = clean(vertices, faces, repairs=Repairs(0, "split"))
    assert topology.edges_of(mesh.faces).count.max() == 2
    assert np.array_equal(mesh.vertices, vertices[mesh.source_vertex])
    assert topology.is_disc(mesh.faces)
    assert topology.face_areas(mesh.vertices, mesh.faces).sum() == pytest.approx(10)
