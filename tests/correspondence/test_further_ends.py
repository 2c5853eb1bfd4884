"""Ends of limbs without a landmark, matched by maps through given ones."""

import numpy as np
import pytest
from limbs import LIMBS, star

from nsm.correspondence import further_ends as module
from nsm.correspondence.further_ends import further_ends
from nsm.correspondence.search import Round


@pytest.fixture(scope="module")
def shapes():
    """Two shapes with five limbs, and the vertices at their tips, the same of both."""
    lengths = np.array(list(LIMBS.values()))
    vertices, faces, tips = star(lengths)
    return (vertices, faces), (star(lengths * [1.1, 0.9, 1.0, 1.1, 0.9])[0], faces), tips


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(module, "FACES", 800)
    monkeypatch.setattr(module, "ROUND", Round(0, 4, 30))
    monkeypatch.setattr(module, "DRAWN", Round(0, 5, 20))


def test_limbs_without_a_landmark_are_matched(shapes, quick):
    source, target, tips = shapes
    between = np.abs(np.linalg.norm(source[0], axis=1) - 1).argsort()[[0, 40]]
    given = np.repeat(np.concatenate([tips[:3], between])[:, None], 2, axis=1)
    pairs = further_ends((source, target), given)
    assert len(pairs) == 2
    for k, (mesh, own) in enumerate(zip((source, target), pairs.T, strict=True)):
        apart = np.linalg.norm(mesh[0][tips[3:], None] - mesh[0][own], axis=2)
        assert apart.min(axis=1).max() < 0.3, k  # limbs are 1.6 long or more
    assert (
        apart.argmin(axis=1)
        == np.linalg.norm(source[0][tips[3:], None] - source[0][pairs[:, 0]], axis=2).argmin(axis=1)
    ).all()


def test_the_largest_set_that_is_worth_its_cost_is_taken():
    one, two, other = [(0, 0)], [(0, 0), (1, 1)], [(0, 1), (1, 0)]
    tried = [[], two, other, one]
    assert module._largest(tried, np.array([2.0, 2.09, 2.05, 1.9])) == other
    assert module._largest(tried, np.array([2.0, 2.12, 2.3, 2.04])) == one
    assert module._largest(tried, np.array([2.0, 2.12, 2.3, 2.06])) == []
    # of two that are nearly as good, what both have
    assert module._largest(tried, np.array([2.0, 2.05, 2.06, 1.9])) == []
    tried = [[], two, [(0, 0), (2, 1)]]
    assert module._largest(tried, np.array([2.0, 2.05, 2.06])) == one


def test_nothing_is_added_where_all_limbs_have_landmarks(shapes, monkeypatch):
    source, target, tips = shapes
    monkeypatch.setattr(module, "trained", None)
    given = np.stack([tips, tips], axis=1)
    assert further_ends((source, target), given).shape == (0, 2)


LARGE = np.ones(2)


@pytest.mark.parametrize(
    ("apart", "ours", "theirs", "expected"),
    [
        # both may be, and one alone leaves another that is farther
        ([[0.1, 0.3], [0.3, 0.1]], LARGE, LARGE, [[(0, 0), (1, 1)], [(0, 1), (1, 0)], [(0, 0)]]),
        # either of two ends would do: none is taken
        ([[0.2], [0.22]], LARGE, LARGE[:1], []),
        ([[0.2, 0.22]], LARGE[:1], LARGE, []),
        # but for one that is much smaller
        ([[0.2], [0.22]], np.array([1.0, 0.5]), LARGE[:1], [[(0, 0)]]),
        # too far
        ([[0.5]], LARGE[:1], LARGE[:1], []),
    ],
)
def test_matchings_leave_out_what_is_ambiguous(apart, ours, theirs, expected):
    found = module._matchings(np.array(apart), ours, theirs)
    assert [sorted(one) for one in found[: len(expected)]] == expected
    assert bool(found) == bool(expected)
