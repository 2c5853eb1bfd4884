"""Cuts and lifts: every mesh, every four cones."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from domains.orbifold.shapes import TETRAHEDRON, hull, torus
from hypothesis import given, settings
from hypothesis import strategies as st

from nsm.domains.orbifold import group
from nsm.domains.orbifold.certificate import certificate, torn_edges
from nsm.domains.orbifold.lifts import cone_lifts, torus_lifts
from nsm.domains.orbifold.tutte import WEIGHTS, edge_weights, tutte
from nsm.errors import NsmError


def test_every_order_of_a_tetrahedrons_corners_can_be_cones() -> None:
    vertices, faces = TETRAHEDRON
    for cones in permutations(range(4)):
        lift, paths = cone_lifts(vertices, faces, cones)
        assert len(paths) == 3
        x, _ = tutte(faces, lift, np.ones((4, 3)), np.array(cones))
        found = certificate(faces, lift, x, np.array(cones))
        assert found.torn == 0 and found.cones_held


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(8, 60), weights=st.sampled_from(WEIGHTS))
def test_tutte_is_a_homeomorphism(seed: int, count: int, weights: str) -> None:
    vertices, faces = hull(seed, count)
    cones = np.random.default_rng(seed).choice(len(vertices), 4, replace=False)
    lift, _ = cone_lifts(vertices, faces, cones.tolist())
    x, quadratic = tutte(faces, lift, edge_weights(vertices, faces, weights), cones)
    found = certificate(faces, lift, x, cones)
    assert found.torn == 0 and found.degree == pytest.approx(1.0, abs=1e-9)
    if weights == "uniform":  # others may squeeze triangles below what digits hold
        assert found.injective
    assert np.linalg.eigvalsh(quadratic).min() > 0


def test_paths_join_the_cones_and_meet_nowhere_else() -> None:
    vertices, faces = hull(3, 30)
    cones = [0, 7, 13, 21]
    _, paths = cone_lifts(vertices, faces, cones)
    for path, start, goal in zip(paths, cones[:-1], cones[1:], strict=True):
        np.testing.assert_array_equal(path[[0, -1]], vertices[[start, goal]])
    inner = np.concatenate([path[:-1] for path in paths] + [paths[-1][-1:]])
    assert len(np.unique(inner, axis=0)) == len(inner)


def test_around_a_cone_the_plane_turns_by_half_and_elsewhere_not_at_all() -> None:
    vertices, faces = hull(5, 30)
    cones = [2, 9, 17, 25]
    lift, _ = cone_lifts(vertices, faces, cones)
    for v in range(len(vertices)):
        # walk once around v; carry the placement of each face's third corner to the next face
        at = {}
        for f in np.flatnonzero((faces == v).any(axis=1)):
            k = faces[f].tolist().index(v)
            at[int(faces[f, (k + 1) % 3])] = (f, k)
        start = now = next(iter(at))
        whole = group.IDENTITY
        for _ in range(len(at)):
            f, k = at[now]
            now = int(faces[f, (k + 2) % 3])
            g, j = at[now]
            bring = group.compose(lift[f, (k + 2) % 3], group.inverse(lift[g, (j + 1) % 3]))
            if now in cones and v in cones:
                return  # the common edge of two cones does not tell which lift it is
            if now in cones:
                bring = group.compose(lift[f, k], group.inverse(lift[g, j]))
            whole = group.compose(whole, bring)
        assert now == start
        assert whole[0] == (-1 if v in cones else 1)
        if v not in cones:
            np.testing.assert_array_equal(whole, group.IDENTITY)


def test_a_torus_goes_around_once_each_way() -> None:
    _, faces = torus()
    lift = torus_lifts(faces)
    assert torn_edges(faces, lift) == 0
    x, _ = tutte(faces, lift, np.ones(faces.shape))
    assert certificate(faces, lift, x).injective


def test_wrong_surfaces_and_cones_are_refused() -> None:
    vertices, faces = torus()
    with pytest.raises(NsmError) as error:
        cone_lifts(vertices, faces, [0, 1, 2, 3])
    assert error.value.kind == "wrong_topology"
    vertices, faces = hull(0)
    with pytest.raises(NsmError) as error:
        torus_lifts(faces)
    assert error.value.kind == "wrong_topology"
    with pytest.raises(NsmError) as error:
        cone_lifts(vertices, faces[1:], [0, 1, 2, 3])
    assert error.value.kind == "wrong_topology"
    for cones in ([0, 1, 2], [0, 1, 2, 2], [0, 1, 2, len(vertices)]):
        with pytest.raises(NsmError) as error:
            cone_lifts(vertices, faces, cones)
        assert error.value.kind == "wrong_cones"


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_the_group(seed: int, symmetric: bool) -> None:
    rng = np.random.default_rng(seed)
    g, h = (
        np.concatenate([rng.choice([-1, 1], (5, 1)), rng.integers(-9, 9, (5, 2))], axis=1)
        for _ in range(2)
    )
    x = group.rounded(rng.uniform(-5, 5, (5, 2)))
    np.testing.assert_array_equal(
        group.moved(group.compose(g, h), x), group.moved(g, group.moved(h, x))
    )
    np.testing.assert_array_equal(group.moved(group.inverse(g), group.moved(g, x)), x)
    y, element = group.into_domain(x, symmetric)
    np.testing.assert_array_equal(group.moved(element, x), y)
    assert (y >= (-0.5, 0 if symmetric else -0.5)).all() and (y <= 0.5).all()
    assert symmetric or (element[:, 0] == 1).all()
    np.testing.assert_array_equal(
        group.moved(group.half_turn(group.CONES), group.CONES), group.CONES
    )
