"""Landmarks of two shapes that fit each other, and those that do not."""

import numpy as np
import pytest
from rich.console import Console

from nsm.correspondence import agreement
from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.landmark_check import warn_of_landmarks
from nsm.surfaces.shapes import hemisphere, sphere


def shapes(scale=(5.0, 6.0, 4.0)):
    """A long sphere, and a bent copy in other units and with other vertex numbers."""
    vertices, faces = sphere()
    first = vertices * [1.0, 3.0, 1.0]
    order = np.random.default_rng(0).permutation(len(vertices))
    second = np.empty_like(vertices)
    second[order] = first * scale
    ids = np.linspace(0, len(vertices) - 1, 8).astype(int)
    return (first, faces), (second, order[faces]), ids, order[ids]


def test_right_landmarks_fit_whatever_the_units():
    one, other, a, b = shapes()
    found = agreement([one, other], [a, b])
    assert found.correlation > 0.9 and not found.doubtful
    same = agreement([one, (7 * one[0], one[1])], [a, a])
    assert same.correlation == pytest.approx(1) and same.spread.max() < 1e-12


def test_a_wrong_one_is_named_and_shuffled_ones_are_doubted():
    one, other, a, b = shapes()
    order = np.argsort(np.random.default_rng(1).random(8))
    assert agreement([one, other], [a, b[order]]).doubtful
    moved = a.copy()
    k = int(one[0][a, 1].argmin())
    moved[k] = one[0][:, 1].argmax()  # from one pole to the other
    found = agreement([one, one], [a, moved])
    assert found.doubtful and found.worst == k


def test_missing_ones_and_few_are_not_judged():
    one, other, a, b = shapes()
    lacking = np.where(np.arange(8) == 3, -1, b)
    found = agreement([one, other], [a, lacking])
    assert np.isnan(found.each[3]) and not found.doubtful
    assert agreement([one, other], [a[:4], b[:4]]) is None
    assert agreement([one, other], [a, np.where(np.arange(8) < 4, b, -1)]) is None


def test_an_open_shape_is_judged_too():
    vertices, faces = hemisphere()
    ids = np.linspace(0, len(vertices) - 1, 9).astype(int)
    assert not agreement([(vertices, faces)] * 2, [ids, ids]).doubtful
    assert agreement([(vertices, faces)] * 2, [ids, ids[[4, 7, 1, 8, 0, 6, 2, 5, 3]]]).doubtful


def test_the_warning_names_the_worst():
    one, other, a, b = shapes()
    meshes = [Mesh("dog", *one), Mesh("calf", *other)]
    console = Console(record=True, width=600)
    assert not warn_of_landmarks(meshes, [a, b], console)
    assert console.export_text() == ""
    order = np.argsort(np.random.default_rng(1).random(8))
    assert warn_of_landmarks(meshes, [a, b[order]], console)
    said, k = console.export_text(), agreement([one, other], [a, b[order]]).worst
    assert f"landmark {k} (vertex {a[k]} of dog, {b[order][k]} of calf)" in said
