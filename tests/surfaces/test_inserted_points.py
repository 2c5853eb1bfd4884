"""Points made vertices of a mesh: they lie where they were given, and the shape stays the same."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.surfaces import topology
from nsm.surfaces.inserted_points import with_points
from nsm.surfaces.location import Places
from nsm.surfaces.shapes import hemisphere, torus

MESHES = [torus(), hemisphere()]
# inside, on edges and at corners; few faces, so that they share faces and edges
WEIGHTS = st.sampled_from(
    [
        (0.2, 0.3, 0.5),
        (0.6, 0.3, 0.1),
        (0.5, 0.5, 0.0),
        (0.0, 0.25, 0.75),
        (0.5, 0.0, 0.5),
        (1, 0, 0),
    ]
)
POINTS = st.lists(st.tuples(st.integers(0, 5), WEIGHTS), max_size=8)


@given(st.sampled_from(MESHES), POINTS)
@examples(60)
def test_points_become_vertices_and_the_surface_stays(mesh, points):
    vertices, faces = mesh
    places = np.array([[face, *weights] for face, weights in points]).reshape(-1, 4)
    wanted = Places(places[:, 0].astype(int), places[:, 1:]).take(vertices, faces)
    new, new_faces, ids = with_points(vertices, faces, places)
    assert np.allclose(new[ids], wanted, atol=1e-9)
    assert np.array_equal(new[: len(vertices)], vertices)
    # equal points are one vertex, and only new points are new vertices
    assert len(new) - len(vertices) == len(np.unique(ids[ids >= len(vertices)]))
    area = topology.face_areas(new, new_faces)
    assert np.isclose(area.sum(), topology.face_areas(vertices, faces).sum())
    assert (area > 0).all()
    assert topology.genus_and_boundary(new_faces) == topology.genus_and_boundary(faces)
    # normals of the pieces are those of the faces
    assert topology.edges_of(new_faces).count.max() == 2
    cross = np.cross(*(new[new_faces[:, k]] - new[new_faces[:, 0]] for k in (1, 2)))
    before = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    assert np.allclose(cross.sum(axis=0), before.sum(axis=0))
