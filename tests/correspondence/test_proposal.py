"""Proposals without landmarks on shapes whose correspondence is known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from limbs import LIMBS, star

from nsm.correspondence import (
    collection_proposal,
    finer_maps,
    further_ends,
    proposal,
    proposed,
    proposed_for_all,
    search,
)
from nsm.correspondence.coarse_shape import coarse_shape
from nsm.correspondence.layouts import affine_maps, layout, quick_scores, table
from nsm.correspondence.mending import left_apart, mended
from nsm.correspondence.refinement import Sines
from nsm.correspondence.scores import score
from nsm.correspondence.search import Candidate, Round, missed, trained
from nsm.domains.orbifold import group
from nsm.domains.orbifold.cover import lifted_near, located
from nsm.errors import NsmError
from nsm.surfaces.shapes import hemisphere, torus

CORNERS = [(1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)]


def tetrapod():
    """A ball with four equal limbs, as a tetrahedron has corners."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    points = np.array(ball.vertices)
    angle = np.arccos(np.clip(points @ np.array(CORNERS).T / np.sqrt(3), -1, 1))
    radius = 1 + 2 * np.exp(-((angle / 0.35) ** 2)).sum(axis=1)
    return radius[:, None] * points, np.array(ball.faces)


@pytest.fixture(scope="module")
def pair():
    """A shape, and the same with other lengths, turned, with other numbers and in another unit."""
    rng = np.random.default_rng(0)
    lengths = np.array(list(LIMBS.values()))
    vertices, faces, tips = star(lengths)
    other, _, _ = star(lengths * rng.uniform(0.9, 1.1, 5))
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    number = rng.permutation(len(other))
    moved = np.empty_like(other)
    moved[number] = 40 * other @ turn.T + [5, 6, 7]
    return (vertices, faces), (moved, number[faces]), (tips, number[tips])


def quicken(monkeypatch):
    """A search of fewer maps, enough for shapes that are equal or nearly so."""
    rounds = (Round(60, 3, 10), Round(10, 6, 30))
    monkeypatch.setattr(search, "_SOURCE_SETS", 1)
    monkeypatch.setattr(search, "_TARGET_SETS", 6)
    monkeypatch.setattr(proposal, "candidates", lambda s, t: search.candidates(s, t, rounds))
    monkeypatch.setattr(proposal, "MENDING", ())
    monkeypatch.setattr(further_ends, "FACES", 1000)
    monkeypatch.setattr(further_ends, "ROUND", Round(0, 5, 30))
    monkeypatch.setattr(further_ends, "DRAWN", Round(0, 6, 30))
    monkeypatch.setattr(finer_maps, "FACES", 1200)
    monkeypatch.setattr(finer_maps, "ROUNDS", (Round(0, 4, 15), Round(0, 6, 15)))


@pytest.fixture
def quick(monkeypatch):
    quicken(monkeypatch)


@pytest.fixture(scope="module")
def two_maps(pair):
    """The right hypothesis, and a wrong one."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        quicken(monkeypatch)
        return proposed(*pair[:2]).hypotheses[:2]


def test_a_turned_and_stretched_shape_is_recognised(pair, quick):
    source, target, tips = pair
    found = proposed(source, target)
    assert found.sure
    best = found.hypotheses[0]
    assert 4 <= len(best.vertices) <= 5
    for p, q in best.vertices:  # each near the tip of one and the same limb
        limb = np.linalg.norm(source[0][tips[0]] - source[0][p], axis=1)
        its = np.linalg.norm(target[0][tips[1]] - target[0][q], axis=1)
        assert limb.argmin() == its.argmin()
        assert limb.min() < 0.3 and its.min() < 40 * 0.3  # limbs are 1.3 long or more
    scores = [h.score for h in found.hypotheses]
    assert scores == sorted(scores) and found.margin == pytest.approx(scores[1] - scores[0])
    assert best.candidate.energy < 5 and best.score < np.log(5) + 0.4


def test_nothing_is_sure_where_all_is_alike(quick, monkeypatch):
    """Twelve rotations are equally good: far from each other, and with other limbs exchanged."""
    shape = coarse_shape(*tetrapod())
    found = proposal.candidates(shape, [shape])
    monkeypatch.setattr(proposal, "candidates", lambda *_: found)
    for apart in (0.2, np.inf):  # in the mean; at last the limbs alone tell maps from each other
        monkeypatch.setattr(proposal, "_DIFFERENT", apart)
        every = proposed(tetrapod(), tetrapod())
        assert not every.sure
        assert len(every.hypotheses) > 1
    ends = [tuple(sorted(h.vertices.tolist())) for h in every.hypotheses]
    assert len(set(map(str, ends))) == len(ends)


@pytest.mark.parametrize("mesh", [torus(), hemisphere()])
def test_other_topologies_are_refused(mesh):
    with pytest.raises(NsmError) as refused:
        coarse_shape(*mesh)
    assert (refused.value.kind, refused.value.key) == ("wrong_topology", "landmarks")


@pytest.fixture(scope="module")
def layouts(pair):
    shape = coarse_shape(*pair[0])
    sets, scores = quick_scores(shape)
    assert len(sets) == len(scores) and np.isfinite(scores).all()
    return layout(shape, sets[scores.argmin()]), layout(shape, sets[np.argsort(scores)[1]])


def test_a_coarse_shape_has_area_one_and_distances(pair):
    shape = coarse_shape(*pair[0])
    corner = shape.vertices[shape.faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(1)
    straight = np.linalg.norm(shape.vertices[:, None] - shape.vertices[None], axis=2)
    assert (shape.distance >= straight - 1e-9).all()
    assert shape.distance == pytest.approx(shape.distance.T)
    tips = pair[0][0][shape.ids[shape.tips]]
    limbs = pair[0][0][pair[2][0]]
    apart = np.linalg.norm(tips[:, None] - limbs[None], axis=2)
    assert (apart.min(axis=0) < 0.3).all()  # each limb's tip is found


def test_tables_have_the_symmetries_of_the_orbifold(layouts):
    one = layouts[0]
    looked_up = table(one)
    rng = np.random.default_rng(0)
    n = len(looked_up.vertex)
    points = 2 * rng.integers(-n, n, (300, 2)) / n  # points of the grid: nothing is rounded
    for image in (-points, points + [2, 0], [4, -2] - points):
        assert np.array_equal(looked_up.near(image), looked_up.near(points))
    places = located(one.embedding, points)
    corners = one.shape.faces[places.face]
    assert (corners == looked_up.near(points)[:, None]).any(axis=1).mean() > 0.98


def test_affine_maps_take_cones_to_cones_in_all_orders(layouts):
    source, target = layouts
    looked_up, orders = table(target), set()
    for matrix, shift in affine_maps(source, target):
        assert round(np.linalg.det(matrix)) == 1
        found = Candidate(source, target, looked_up, matrix, shift, 0, np.zeros((0, 2)), 0.0)
        cones = found.cones()
        assert cones[:, 0].tolist() == source.embedding.cones.tolist()
        image = found.planar(2 * group.CONES)
        at = np.array([np.flatnonzero(target.embedding.cones == v)[0] for v in cones[:, 1]])
        assert lifted_near(2 * group.CONES[at], image, True) == pytest.approx(image)
        orders.add(tuple(at.tolist()))
    assert len(orders) == 24


def test_a_limb_that_ends_elsewhere_is_drawn_to_its_place(pair):
    """Four limbs of five are cones, the map starts far from the isometry: the fifth goes astray."""
    shape = coarse_shape(*pair[0])
    limbs = np.flatnonzero(np.isin(shape.tips, shape.peaks()))
    assert len(limbs) == 5
    one = layout(shape, limbs[:4])
    fifth = shape.tips[limbs[4]]
    matrix, shift = next(
        (b, c)
        for b, c in affine_maps(one, one)
        if np.array_equal(np.abs(b), np.eye(2)) and not c.any()
    )
    astray = np.zeros((len(Sines.up_to(2).waves), 2))
    astray[:, 0] = 0.3 * np.sin(np.arange(len(astray)))
    start = Candidate(one, one, table(one), matrix, shift, 2, astray, 0.0)
    before = trained([start], Round(1, 2, 0))[0]
    off = shape.distance[before.images(np.array([fifth])), fifth]
    assert off > 0.2
    assert left_apart(before).tolist() == [[fifth, fifth]]
    drawn = trained([before], Round(1, 5, 30), drawn=[left_apart(before)])[0]
    after = mended([before], Round(1, 5, 30))[0]
    assert score(after) < score(before)
    for found in (drawn, after):
        assert shape.distance[found.images(np.array([fifth])), fifth] < 0.1
    # nothing is taken that makes a map worse
    assert mended([after], Round(1, 5, 0)) == [after]


def test_given_landmarks_are_kept_and_decide_between_symmetric_maps(quick):
    """Four equal limbs, as a tetrahedron has corners: two given limbs leave one rotation of twelve.

    Both lie beside the tips, so that they are no cones."""
    source, faces = tetrapod()
    tips = np.array([int((source @ c).argmax()) for c in CORNERS])
    beside = [np.flatnonzero(faces == v) for v in tips]
    beside = [int(faces[at[0] // 3][(at[0] % 3 + 1) % 3]) for at in beside]
    given = np.array([[beside[0], beside[1]], [beside[1], beside[0]]])
    found = proposed((source, faces), (source, faces), given)
    assert found.sure and found.given == 2
    best = found.hypotheses[0].vertices
    assert best[:2].tolist() == given.tolist()
    limb = ((source @ np.array(CORNERS).T).argmax(axis=1))[best]
    # the half-turn that exchanges the first two exchanges the others
    assert dict(limb.tolist()) == {0: 1, 1: 0, 2: 3, 3: 2}
    assert missed(found.hypotheses[0].candidate).mean() < 0.05


def test_limbs_without_a_landmark_complete_five_that_are_given(pair, monkeypatch):
    """Three limbs have landmarks; two landmarks lie between limbs; two limbs are left."""
    monkeypatch.setattr(proposal, "MENDING", (Round(4, 8, 30),))
    monkeypatch.setattr(search, "_THROUGH", Round(8, 5, 60))
    monkeypatch.setattr(further_ends, "FACES", 1000)
    monkeypatch.setattr(further_ends, "ROUND", Round(0, 5, 40))
    monkeypatch.setattr(further_ends, "DRAWN", Round(0, 6, 30))
    source, target, tips = pair
    between = np.abs(np.linalg.norm(source[0], axis=1) - 1).argsort()[[0, 40]]
    ours = np.concatenate([tips[0][:3], between])
    corner = [np.flatnonzero(source[1] == v)[0] for v in ours]  # the same in both lists of faces
    given = np.stack([ours, target[1].ravel()[corner]], axis=1)
    found = proposed(source, target, given)
    best = found.hypotheses[0].vertices
    assert found.sure and best[:5].tolist() == given.tolist()
    left = set()
    for p, q in best[5:]:
        limb = np.linalg.norm(source[0][tips[0]] - source[0][p], axis=1)
        its = np.linalg.norm(target[0][tips[1]] - target[0][q], axis=1)
        assert limb.argmin() == its.argmin()
        left.add(int(limb.argmin()))
    assert left == {3, 4}
    # where the map is far from an isometry, no ends are looked for
    monkeypatch.setattr(proposal, "LARGEST_SCORE", 0.1)
    monkeypatch.setattr(proposal, "further_ends", None)
    assert not proposed(source, target, given).sure


def test_finer_maps_tell_the_right_one_of_two_that_hardly_differ(
    pair, two_maps, quick, monkeypatch
):
    source, target, _ = pair
    first, second = two_maps
    candidates = [second.candidate, first.candidate]
    scores = finer_maps.finer_scores(candidates, [second.vertices, first.vertices])
    assert np.isfinite(scores).all() and scores[1] < scores[0]
    # a tie, with the wrong one ahead
    tie = [
        replace(second, score=1.0, whole=True),
        replace(first, score=1.1, whole=True),
        replace(first, score=1.5, whole=False),  # too far behind to be compared
    ]
    monkeypatch.setattr(proposal, "hypotheses", lambda *_: tie)
    found = proposed(source, target)
    best = found.hypotheses[0]
    assert best.candidate is first.candidate and best.whole and best.score == 1.0
    assert not found.sure and len(found.hypotheses) == 3
    assert found.margin == pytest.approx(0.1)  # the tie of the coarse maps stays one
    # of clear differences, and of five landmarks or more, no finer maps are made
    monkeypatch.setattr(proposal, "finer_scores", None)
    monkeypatch.setattr(proposal, "hypotheses", lambda *_: [tie[0], replace(tie[1], score=1.5)])
    assert proposed(source, target).sure


def test_a_collection_is_matched_with_one_hub(pair, quick):
    source, target, tips = pair
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    meshes = [source, target, (3 * source[0] @ turn.T, source[1])]
    found = proposed_for_all(meshes, np.array([[tips[0][0], tips[1][0], tips[0][0]]]))
    assert found.sure and found.given == 1 and found.scores == sorted(found.scores)
    best = found.vertices[0]
    assert len(best) >= 4
    assert best[0].tolist() == [tips[0][0], tips[1][0], tips[0][0]]
    ends = (tips[0], tips[1], tips[0])
    limbs = [
        np.linalg.norm(mesh[0][best[:, k], None] - mesh[0][ends[k]], axis=2).argmin(axis=1)
        for k, mesh in enumerate(meshes)
    ]
    assert np.array_equal(limbs[0], limbs[1]) and np.array_equal(limbs[0], limbs[2])
    for other in found.vertices[1:]:
        assert other[0].tolist() == best[0].tolist()  # the given one in every hypothesis


def test_near_ties_of_a_collection_are_decided_by_finer_maps(pair, two_maps, monkeypatch):
    """The coarse maps of two members are wrong, and hold each other there."""
    source, target, _ = pair
    first, second = two_maps
    tie = [replace(second, score=1.0, whole=True), replace(first, score=1.1, whole=True)]
    seen = []

    def finer(found, drawn):
        seen.append(found[0].target.shape.mesh)
        assert found[0].source.shape.mesh.vertices is source[0] and len(found) == len(drawn) == 2
        return np.array([3.0 if one is second.candidate else 2.0 for one in found])

    monkeypatch.setattr(proposal, "finer_scores", finer)
    monkeypatch.setattr(collection_proposal, "hub_of", lambda _: 0)
    monkeypatch.setattr(collection_proposal, "hypotheses", lambda *_: list(tie))
    found = proposed_for_all([source, target, target])
    assert len(seen) == 2 and all(mesh.vertices is target[0] for mesh in seen)
    assert set(map(tuple, found.vertices[0][:, :2])) == set(map(tuple, first.vertices))
    assert np.array_equal(found.vertices[0][:, 1], found.vertices[0][:, 2])
    assert found.margin == pytest.approx(0.1) and not found.sure  # as the coarse maps have it
    # no finer maps are made where the first is clearly ahead
    tie[1] = replace(first, score=1.5)
    assert proposed_for_all([source, target, target]).sure and len(seen) == 2


def test_ends_that_all_members_of_a_collection_have_complete_its_landmarks(
    pair, two_maps, monkeypatch
):
    """Five given landmarks, of which two are no tips: these, and the end that both others have."""
    source, target, tips = pair
    numbers = {id(source[0]): 0, id(target[0]): 1}
    seen = []

    def ends(meshes, known):
        seen.append((numbers[id(meshes[0][0])], numbers[id(meshes[1][0])], len(known)))
        both = [(tips[0][3], tips[1][3]), (tips[0][4], tips[1][4])]
        return np.array(both if len(seen) == 1 else both[1:])

    monkeypatch.setattr(proposal, "further_ends", ends)
    monkeypatch.setattr(collection_proposal, "hub_of", lambda _: 0)
    between = np.abs(np.linalg.norm(source[0], axis=1) - 1).argsort()[[0, 40]]
    images = np.abs(np.linalg.norm((target[0] - [5, 6, 7]) / 40, axis=1) - 1).argsort()[[0, 40]]
    ours, theirs = (np.append(t[:3], b) for t, b in zip(tips, (between, images), strict=True))
    given = np.stack([ours, theirs, theirs], axis=1)
    rows = np.concatenate([given[:, :2], np.stack([tips[0][4:], tips[1][4:]], axis=1)])
    right = replace(two_maps[0], vertices=rows, score=1.0, whole=False)
    monkeypatch.setattr(collection_proposal, "hypotheses", lambda *_: [right])
    found = proposed_for_all([source, target, target], given)
    assert found.sure and seen == [(0, 1, 5), (0, 1, 5)]
    assert found.vertices[0][:5].tolist() == given.tolist()
    assert found.vertices[0][5:].tolist() == [[tips[0][4], tips[1][4], tips[1][4]]]
