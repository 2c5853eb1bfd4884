"""Hypotheses of several members, chosen together."""

from itertools import product

import numpy as np
import pytest

from nsm.correspondence.joint_choice import ways

TWO_SIDES = np.array([[0.0, 2.0], [2.0, 0.0]])  # maps that agree, and maps that do not


def least(own, between, pinned=None):
    """The least total over all choices, by trying them."""
    members = list(own)
    totals = []
    for numbers in product(*(range(len(own[i])) for i in members)):
        choice = dict(zip(members, numbers, strict=True))
        if pinned is None or choice[pinned[0]] == pinned[1]:
            alone = sum(own[i][n] for i, n in choice.items())
            both = sum(cost[choice[i], choice[j]] for (i, j), cost in between.items())
            totals.append((float(alone + both), choice))
    return min(totals, key=lambda entry: entry[0])


def test_the_least_of_all_choices_is_found():
    rng = np.random.default_rng(0)
    own = {3: rng.random(4), 1: rng.random(2), 2: rng.random(3)}
    between = {(3, 1): rng.random((4, 2)), (3, 2): rng.random((4, 3)), (1, 2): rng.random((2, 3))}
    found = ways(own, between)
    total, choice = least(own, between)
    assert found[0].choice == choice and found[0].total == pytest.approx(total)
    assert len(found) == 9 - 3 + 1  # one for each hypothesis that is not taken
    for way in found[1:]:
        assert way.choice[way.turned[0]] == way.turned[1] != choice[way.turned[0]]
        assert way.total >= least(own, between, way.turned)[0] - 1e-9
    assert [w.behind for w in found] == sorted(w.behind for w in found)


def test_what_all_members_exchange_together_is_nearly_tied():
    """Of one member alone the other side costs much, as it is at odds with the others."""
    own = {k: np.array([1.0, 1.1]) for k in range(4)}
    between = {(i, j): TWO_SIDES for i in range(4) for j in range(i + 1, 4)}
    first, *others = ways(own, between)
    assert set(first.choice.values()) == {0}
    assert all(set(way.choice.values()) == {1} for way in others)
    assert [way.behind for way in others] == pytest.approx([0.1] * 4)


def test_members_that_are_alone_or_without_a_choice():
    (only,) = ways({5: np.array([1.0])}, {})
    assert only.choice == {5: 0} and only.total == 1.0
    first, second = ways({5: np.array([1.5, 1.0])}, {})
    assert first.choice == {5: 1} and second.behind == pytest.approx(0.5)
