"""What a mesh hides of itself."""

import igl
import numpy as np
import pytest
import trimesh

from nsm.surfaces.geometry import ambient_occlusion


def arrays(mesh):
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_nothing_is_hidden_on_a_ball_and_all_within_another(size):
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=2, radius=size))
    assert (ambient_occlusion(vertices, faces) == 0).all()
    outer = trimesh.creation.icosphere(subdivisions=2, radius=2 * size)
    both = np.concatenate([vertices, outer.vertices])
    hidden = ambient_occlusion(both, np.concatenate([faces, np.array(outer.faces) + len(vertices)]))
    assert (hidden[: len(vertices)] == 1).all() and (hidden[len(vertices) :] == 0).all()


def test_it_comes_again_and_is_what_libigl_finds_in_directions_drawn_anew():
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=3))
    vertices[:, 2] += 3 * vertices[:, 0] ** 2  # a bowl
    found = ambient_occlusion(vertices, faces)
    assert np.array_equal(found, ambient_occlusion(vertices, faces))
    normals = igl.per_vertex_normals(vertices, faces)
    drawn = np.ravel(igl.ambient_occlusion(vertices, faces, vertices, normals, 2000))
    assert found.max() > 0.1
    assert np.abs(found - drawn).max() < 0.05 and np.abs(found - drawn).mean() < 0.01
