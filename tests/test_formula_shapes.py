"""Shapes by formula: the topology of their class, and landmarks that correspond."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from nsm.correspondence.distances import edge_distances
from nsm.surfaces.topology import genus_and_boundary
from nsm.surfaces.validation import clean

FILE = Path(__file__).parents[1] / "benchmarks" / "formula_shapes.py"


@pytest.fixture(scope="module")
def shapes():
    specification = importlib.util.spec_from_file_location("formula_shapes", FILE)
    module = importlib.util.module_from_spec(specification)
    sys.modules["formula_shapes"] = module
    specification.loader.exec_module(module)
    yield module
    del sys.modules["formula_shapes"]


KINDS = {"face": (0, 1), "fish": (0, 0), "glasses": (2, 0)}


@pytest.mark.parametrize(("name", "kind"), KINDS.items())
def test_both_poses_have_the_topology_of_their_class(shapes, name, kind):
    one, other = (shapes.made(name, pose, 1500) for pose in (0, 1))
    for shape in (one, other):
        mesh = clean(shape.vertices, shape.faces, name)
        assert genus_and_boundary(mesh.faces) == kind
        assert len(set(shape.landmarks.tolist())) == len(shape.landmarks) > shape.given
    assert one.given == other.given and len(one.landmarks) == len(other.landmarks)


def test_a_landmark_is_where_its_ray_leaves_the_solid(shapes):
    solid = shapes.Solid(blend=1e-3)
    solid.ball([0, 0, 0], [1, 0.5, 0.8])
    assert shapes._end(solid, np.zeros(3), np.array([0, 0.5, 0])) == pytest.approx(
        [0, 0.5, 0], abs=1e-3
    )


@pytest.mark.parametrize(("name", "order"), {"octopus": 8, "pliers": 2, "fish": 1}.items())
def test_rotations_of_a_shape_to_itself_exchange_landmarks(shapes, name, order):
    orders = shapes.symmetries(name)
    assert len({tuple(one.tolist()) for one in orders}) == len(orders) == order
    shape = shapes.made(name, 0)
    apart = edge_distances(shape.vertices, shape.faces, shape.landmarks)[:, shape.landmarks]
    for one in orders:
        assert sorted(one.tolist()) == list(range(len(one)))
        assert apart[np.ix_(one, one)] == pytest.approx(apart, abs=0.15)
    assert orders[0].tolist() == list(range(len(orders[0])))
