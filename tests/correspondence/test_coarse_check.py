"""Landmarks judged by coarse maps: which change of them is told, and when nothing is."""

import importlib

import numpy as np
import pytest
from limbs import star
from rich.console import Console

from nsm.correspondence import Agreement, CoarseCheck, CommonAgreement, coarse_check
from nsm.domains.joint_preparation import Mesh
from nsm.domains.orbifold.common_cones import choose_common_cones
from nsm.pipeline.landmark_check import LandmarkCheck, check_landmarks
from nsm.surfaces.shapes import hemisphere

module = importlib.import_module("nsm.correspondence.coarse_check")  # a function has its name
V, F, TIPS = star([1.5, 1.2, 0.9, 1.0, 1.4])
W, _, _ = star([1.3, 1.3, 1.0, 0.8, 1.5])  # the same tips
SHAPES = (V, F), (W, F)


def replaced(k):
    """The tips, but for one: it is beyond the middle of the shape."""
    other = TIPS.copy()
    other[k] = (W @ W[TIPS[k]]).argmin()
    return other


@pytest.fixture(scope="module")
def right():
    return coarse_check(*SHAPES, (TIPS, TIPS))


def test_right_landmarks_are_not_doubted(right):
    assert right.energy < 5 and right.best is None
    gains = {change.kind: change.gain for change in right.changes}
    assert gains["mirrored"] < -0.2


def test_a_wrong_one_is_named(right, k=2):
    found = coarse_check(*SHAPES, (TIPS, replaced(k)))
    assert found.energy > 1.5 * right.energy
    assert (found.best.kind, found.best.landmarks) == ("wrong", (k,))
    # without it, the energy is that of the four right ones
    assert found.energy * np.exp(-found.best.gain) == pytest.approx(right.energy, rel=0.2)


def test_two_exchanged_ones_are_named(right):
    found = coarse_check(*SHAPES, (TIPS[:4], TIPS[[1, 0, 2, 3]]))
    assert (found.best.kind, found.best.landmarks) == ("exchanged", (0, 1))
    assert found.energy * np.exp(-found.best.gain) < 1.2 * right.energy


def test_a_map_that_no_change_helps_is_told_as_a_whole():
    checks = {1: CoarseCheck(40.0, [], 4)}
    check = LandmarkCheck(["a", "b"], [TIPS, TIPS], None, checks)
    assert "a coarse map of a to b" in check.warning.plain and "40.0" in check.warning.plain
    check = LandmarkCheck(["a", "b"], [TIPS, TIPS], None, {1: CoarseCheck(12.0, [], 4)})
    assert check.warning is None and not check.figures["landmarks_doubtful"]


def test_distances_are_not_asked_where_a_good_map_meets_all():
    found = CommonAgreement({(0, 1): Agreement(0.3, np.full(5, 0.1), np.full(5, 0.6))})
    assert found.doubtful
    said = [
        LandmarkCheck(["a", "b"], [TIPS, TIPS], found, {1: CoarseCheck(energy, [], 5)}).warning
        for energy in (5.0, 12.0)
    ]
    assert said[0] is None and "correlated" in said[1].plain


def test_a_mirror_image_is_told():
    mirrored = W * [-1, 1, 1], F[:, ::-1]
    found = coarse_check((V, F), mirrored, (TIPS, TIPS))
    assert (found.best.kind, found.best.landmarks) == ("mirrored", ())


def test_few_landmarks_and_other_shapes_are_not_judged():
    assert coarse_check(*SHAPES, (TIPS[:3], TIPS[:3])) is None
    open_mesh = hemisphere()
    ids = np.arange(0, 50, 10)
    assert coarse_check(open_mesh, open_mesh, (ids, ids)) is None


def test_the_line_names_landmark_and_vertices_also_where_others_are_missing():
    ours, theirs = (np.insert(ids, 1, k) for ids, k in ((TIPS, 7), (replaced(2), -1)))
    console = Console(record=True, width=900)
    check = check_landmarks([Mesh("a", V, F), Mesh("b", W, F)], [ours, theirs], console)
    assert f"landmark 3 (vertex {ours[3]} of a, {theirs[3]} of b)" in check.warning.plain
    assert check.warning.plain in console.export_text()
    assert check.figures["landmarks_doubtful"]


def test_other_cones_are_tried_where_the_map_is_not_good(right, monkeypatch):
    """With thresholds at which any other set is taken, the best of the others is."""
    assert right.cones is None
    monkeypatch.setattr(module, "_ASTRAY", 0.0)
    monkeypatch.setattr(module, "_BETTER", 10.0)
    monkeypatch.setattr(module, "_EXCHANGED", 0)
    monkeypatch.setattr(module, "_SETS", 3)
    found = coarse_check(*SHAPES, (TIPS, TIPS))
    assert len(set(found.cones)) == 4 and found.energy == pytest.approx(right.energy, rel=0.2)
    numbers = 10 + np.arange(len(TIPS))
    assert found.numbered(numbers).cones == tuple(10 + k for k in found.cones)
    check = LandmarkCheck(["a", "b"], [TIPS, TIPS], None, {1: found})
    assert check.cones == found.cones
    four = choose_common_cones(SHAPES, [TIPS, TIPS], found.cones)[0]
    assert sorted(four.tolist()) == sorted(found.cones)
