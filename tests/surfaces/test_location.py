"""Nearest points on meshes."""

import copy
import pickle
import subprocess
import sys

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nsm.energies import symmetric_dirichlet
from nsm.results.map_metrics import triangle_metric
from nsm.surfaces import shapes
from nsm.surfaces.geometry import triangle_distortion
from nsm.surfaces.location import Locator, locate


@given(st.integers(0, 2**31))
def test_a_point_of_a_triangle_is_found_there(seed):
    random = np.random.default_rng(seed)
    uv, faces = shapes.ring_mesh(6)
    face = random.integers(len(faces), size=50)
    weights = random.dirichlet(np.ones(3), size=50)
    points = np.einsum("nk,nkd->nd", weights, uv[faces[face]])
    places = locate(points, uv, faces)
    assert np.abs(places.take(uv, faces) - points).max() < 1e-9
    inside = weights.min(axis=1) > 1e-6
    assert (places.face[inside] == face[inside]).all()


def test_points_outside_go_to_the_nearest_point():
    uv, faces = shapes.grid_mesh(5)
    places = locate(np.array([[2.0, 0.25], [-3.0, 3.0]]), uv, faces)
    assert np.abs(places.take(uv, faces) - [[1, 0.25], [-1, 1]]).max() < 1e-12


def test_a_locator_serves_many_calls_and_can_be_copied():
    vertices, faces = shapes.sphere(3)
    locator = Locator(vertices, faces)
    for one in (locator, copy.deepcopy(locator), pickle.loads(pickle.dumps(locator))):
        for points in (vertices[:5] * 1.1, vertices[5:50] * 0.9, vertices[:0]):
            face, weights = one.locate(points)
            alone = locate(points, vertices, faces)
            np.testing.assert_array_equal(face, alone.face)
            np.testing.assert_array_equal(weights, alone.weights)


def test_a_locator_that_lives_to_the_end_of_python_is_not_warned_of():
    code = """
import ctypes
from nsm.surfaces import shapes
from nsm.surfaces.location import Locator
kept = Locator(*shapes.sphere(2))
ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_values_of_any_shape_are_interpolated():
    vertices, faces = shapes.sphere(3)
    places = locate(vertices[:10], vertices, faces)
    values = np.arange(len(vertices) * 6, dtype=float).reshape(-1, 2, 3)
    assert np.abs(places.take(values, faces) - values[:10]).max() < 1e-6


def test_triangle_distortion_is_that_of_the_energies():
    vertices, faces = shapes.sphere(2)
    image = vertices * [1.3, 0.7, 2.0]
    expected = symmetric_dirichlet(triangle_metric(vertices, faces), triangle_metric(image, faces))
    value = triangle_distortion(vertices, image, faces)
    assert np.abs(value / expected.numpy() - 1).max() < 1e-9
    assert np.abs(triangle_distortion(vertices, vertices, faces) - (2 + 2 / 1.01)).max() < 1e-9
    assert np.isinf(triangle_distortion(0 * vertices, image, faces)).all()
