"""Ambient occlusion."""

import igl
import numpy as np
import pytest
import trimesh

from nsm.surfaces.geometry import ambient_occlusion


def arrays(mesh):
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_sphere_hides_nothing_of_itself_and_all_of_a_sphere_inside(size):
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=2, radius=size))
    assert (ambient_occlusion(vertices, faces) == 0).all()
    outer = trimesh.creation.icosphere(subdivisions=2, radius=2 * size)
    both = np.concatenate([vertices, outer.vertices])
    hidden = ambient_occlusion(both, np.concatenate([faces, np.array(outer.faces) + len(vertices)]))
    assert (hidden[: len(vertices)] == 1).all() and (hidden[len(vertices) :] == 0).all()


def test_occlusion_is_reproducible_and_agrees_with_libigl():
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=3))
    vertices[:, 2] += 3 * vertices[:, 0] ** 2  # a bowl
    found = ambient_occlusion(vertices, faces)
    assert np.array_equal(found, ambient_occlusion(vertices, faces))
    normals = igl.per_vertex_normals(vertices, faces)
    drawn = np.ravel(igl.ambient_occlusion(vertices, faces, vertices, normals, 2000))
    assert found.max() > 0.1
    assert np.abs(found - drawn).max() < 0.05 and np.abs(found - drawn).mean() < 0.01
