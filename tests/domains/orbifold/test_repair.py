"""Maps of closed domains repaired in the cover: no flips, no tears, cones and landmarks held."""

from __future__ import annotations

import time

import numpy as np
import pytest
from domains.orbifold.shapes import limbs, torus
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.domains import Orbifold, Surface, Torus, reinsertion
from nsm.domains.orbifold.repair import copied, isotopy_class, repaired, torn
from nsm.domains.planar_mesh import flipped, signed_areas
from nsm.surfaces import topology

POINTS, FACES, TIPS = limbs(3)
SURFACES = {
    "orbifold": Surface.from_arrays(POINTS, FACES, domain="orbifold", cones=TIPS),
    "torus": Surface.from_arrays(*torus(), domain="torus"),
}
CLASSES = [((1, 0), (0, 1)), ((1, 1), (0, 1)), ((2, 1), (1, 1)), ((0, -1), (1, 0))]
seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(sorted(SURFACES))
each = pytest.mark.parametrize("kind", sorted(SURFACES))


def firsts(surface):
    return np.setdiff1d(np.arange(len(surface.uv)), surface.seam_pairs[:, 1])


def cones(surface):
    integer = (surface.uv == np.rint(surface.uv)).all(axis=1)
    return np.flatnonzero(integer & surface.domain.even)


def equivariant(surface, random, matrix=CLASSES[0], size=0.03):
    """An equivariant map of the surface's vertices (V, 2): affine and a few waves."""
    x, even = surface.uv, surface.domain.even
    center = random.integers(-2, 3, 2) if even else random.normal(size=2)
    value = x @ np.transpose(matrix) + center
    for _ in range(4):
        phase = 0.0 if even else random.uniform(0, 2 * np.pi)
        wave = np.sin(np.pi * x @ random.integers(-2, 3, 2) + phase)
        value += size * wave[:, None] * random.normal(size=2)
    return value


def tangled(surface, random, hit, image):
    """The image with some vertices, and their copies, thrown across their stars."""
    size = 1.5 * np.sqrt(np.abs(signed_areas(image, surface.faces)).mean())
    image = image.copy()
    image[hit] += size * random.normal(size=(len(hit), 2))
    return copied(surface.uv, surface.seam_pairs, image, surface.domain.even)


def mended(surface, image, held=None):
    held = np.zeros(len(image), dtype=bool) if held is None else held
    arguments = (surface.uv, surface.faces, surface.seam_pairs, image, held, surface.domain.even)
    return repaired(*arguments)


def disagreements(surface, image):
    """Edges of the closed mesh whose two triangles do not see them as one edge of R²/Γ, exactly."""
    first = np.arange(len(image))
    first[surface.seam_pairs[:, 1]] = surface.seam_pairs[:, 0]
    pairs = topology.adjacent_faces(topology.edges_of(first[surface.faces]))
    flat = surface.faces.ravel()
    after = surface.faces[:, [1, 2, 0]].ravel()
    a, b = image[flat[pairs[:, 0]]], image[after[pairs[:, 0]]]
    d, c = image[flat[pairs[:, 1]]], image[after[pairs[:, 1]]]
    agree = np.zeros(len(pairs), dtype=bool)
    for s in (1, -1) if surface.domain.even else (1,):
        moves = a - s * c
        agree |= ((moves == b - s * d) & (np.mod(moves, 2) == 0)).all(axis=1)
    return int((~agree).sum())


def is_homeomorphism(surface, image):
    degree = signed_areas(image, surface.faces).sum() / (2 if surface.domain.even else 4)
    return (
        not flipped(image, surface.faces).any()
        and torn(surface.uv, surface.seam_pairs, image, surface.domain.even) == 0
        and disagreements(surface, image) == 0
        and degree == pytest.approx(1, abs=1e-9)
    )


@each
def test_the_identity_is_a_homeomorphism_and_left_as_it_is(kind):
    surface = SURFACES[kind]
    assert is_homeomorphism(surface, surface.uv)
    assert (mended(surface, surface.uv) == surface.uv).all()


@given(seeds, kinds, st.sampled_from(CLASSES))
@examples(30)
def test_a_map_of_any_class_is_made_exact_and_its_flips_turned_back(seed, kind, matrix):
    surface, random = SURFACES[kind], np.random.default_rng(seed)
    image = equivariant(surface, random, matrix)
    found, _ = isotopy_class(surface.uv, surface.seam_pairs, image, surface.domain.even)
    assert found.tolist() == [list(row) for row in matrix]
    hit = random.choice(np.setdiff1d(firsts(surface), cones(surface)), 12, replace=False)
    before = tangled(surface, random, hit, image)
    assert flipped(before, surface.faces).any()
    assert torn(surface.uv, surface.seam_pairs, before, surface.domain.even) == 0
    after = mended(surface, before)
    assert is_homeomorphism(surface, after)
    assert (after[cones(surface)] == before[cones(surface)]).all()
    assert (after == before).all(axis=1).any()  # only what is near a flip moves


@given(seeds, kinds)
@examples(20)
def test_flips_at_copies_and_around_cones_are_turned_back(seed, kind):
    surface, random = SURFACES[kind], np.random.default_rng(seed)
    fixed = cones(surface)
    around = surface.faces[np.isin(surface.faces, fixed).any(axis=1)]
    near = np.union1d(surface.seam_pairs[:, 0], np.intersect1d(around, firsts(surface)))
    near = np.setdiff1d(near, fixed)
    hit = random.choice(near, 8, replace=False)
    before = tangled(surface, random, hit, equivariant(surface, random))
    after = mended(surface, before)
    assert is_homeomorphism(surface, after)
    assert (after[fixed] == before[fixed]).all()


@each
def test_flips_at_copies_and_around_cones_are_turned_back_without_descent(kind, monkeypatch):
    monkeypatch.setattr(reinsertion, "untangled", lambda rest, faces, image, *more: image)
    surface = SURFACES[kind]
    near = np.setdiff1d(np.unique(surface.seam_pairs[:, 0]), cones(surface))
    for seed in range(4):
        random = np.random.default_rng(seed)
        hit = random.choice(near, 8, replace=False)
        before = tangled(surface, random, hit, equivariant(surface, random, CLASSES[1]))
        after = mended(surface, before)
        assert flipped(before, surface.faces).any() and is_homeomorphism(surface, after)
        assert (after[cones(surface)] == before[cones(surface)]).all()


@given(seeds, kinds)
@examples(6)
def test_landmarks_stay_where_that_is_possible_and_move_where_it_is_not(seed, kind):
    surface, random = SURFACES[kind], np.random.default_rng(seed)
    free = np.setdiff1d(firsts(surface), cones(surface))
    hit = random.choice(free, 6, replace=False)
    image = copied(
        surface.uv, surface.seam_pairs, equivariant(surface, random), surface.domain.even
    )
    before = tangled(surface, random, hit, image)
    held = np.zeros(len(image), dtype=bool)
    apart = np.setdiff1d(free, hit)
    held[random.choice(apart, 5, replace=False)] = True
    after = mended(surface, before, held)
    assert is_homeomorphism(surface, after) and (after[held] == before[held]).all()
    # two neighbours that are sent to one point cannot both stay
    a, b = next((p, q) for p, q, _ in surface.faces.tolist() if p in apart and q in apart)
    image[b] = image[a]
    image = copied(surface.uv, surface.seam_pairs, image, surface.domain.even)
    held[:] = False
    held[[a, b]] = True
    after = mended(surface, image, held)
    assert is_homeomorphism(surface, after) and (after[held] != image[held]).any()


@given(seeds, kinds, st.sampled_from([1, -1]), st.integers(-3, 3), st.integers(-3, 3))
@examples(20)
def test_a_map_and_its_other_lifts_are_repaired_alike(seed, kind, sign, m, n):
    surface, random = SURFACES[kind], np.random.default_rng(seed)
    sign = sign if surface.domain.even else 1
    move = 2.0 * np.array([m, n])
    hit = random.choice(np.setdiff1d(firsts(surface), cones(surface)), 6, replace=False)
    image = tangled(surface, random, hit, equivariant(surface, random))
    here, there = mended(surface, image), mended(surface, sign * image + move)
    assert is_homeomorphism(surface, there)
    still = (here == image).all(axis=1)
    assert (there[still] == sign * here[still] + move).all()


@each
def test_exact_copies_differ_from_a_map_by_rounding_only(kind):
    surface, random = SURFACES[kind], np.random.default_rng(0)
    image = equivariant(surface, random, CLASSES[2])
    exact = copied(surface.uv, surface.seam_pairs, image, surface.domain.even)
    np.testing.assert_allclose(exact, image, rtol=0, atol=1e-12)
    assert disagreements(surface, exact) == 0


@each
def test_tears_are_counted_one_by_one(kind):
    surface = SURFACES[kind]
    uv, pairs, even = surface.uv, surface.seam_pairs, surface.domain.even
    for shift in (2.0**-40, 0.3):
        image = uv.copy()
        others = np.setdiff1d(pairs[:, 1], cones(surface))[:3]
        image[others] += shift
        assert torn(uv, pairs, image, even) == 3
        assert torn(uv, pairs, copied(uv, pairs, image, even), even) == 0
    # a lift of the right point, but not the one of the map's class
    image = uv.copy()
    image[others[0]] += [2.0, 0.0]
    assert torn(uv, pairs, image, even) == 1


def test_cones_off_their_points_are_counted_and_put_back():
    surface = SURFACES["orbifold"]
    image = surface.uv.copy()
    cone = np.setdiff1d(cones(surface), surface.seam_pairs)[0]
    image[cone] += 1e-5
    assert torn(surface.uv, surface.seam_pairs, image, True) == 1
    assert (copied(surface.uv, surface.seam_pairs, image, True) == surface.uv).all()


def test_far_lifts_are_exact_too():
    surface = SURFACES["orbifold"]
    image = surface.uv @ [[1.0, 0.0], [90.0, 1.0]] + [400.0, -30.0]
    image = copied(surface.uv, surface.seam_pairs, image + 1e-9, True)
    assert torn(surface.uv, surface.seam_pairs, image, True) == 0
    assert disagreements(surface, image) == 0


@pytest.mark.parametrize("closed", [Orbifold(), Torus()], ids=str)
def test_ten_thousand_vertices_take_no_time(closed):
    """A regular layout of about so many, twenty flips."""
    n = 100
    side = 2.0 * np.arange(n + 1) / n - 1
    x, y = np.meshgrid(side, side if not closed.even else np.linspace(0, 1, n + 1), indexing="ij")
    uv = np.stack([x.ravel(), y.ravel()], axis=1)
    # multiples of a power of two, so that lifts are exact
    uv = np.rint(uv * 2.0**40) / 2.0**40
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    pairs = [np.stack([number[0, 1:-1], number[-1, 1:-1]], axis=1)]
    if closed.even:
        for row in (number[:, 0], number[:, -1]):
            half = n // 2
            pairs.append(np.stack([row[1:half], row[::-1][1:half]], axis=1))
            pairs.append(np.stack([row[:1], row[-1:]], axis=1))
    else:
        pairs.append(np.stack([number[:-1, 0], number[:-1, -1]], axis=1))
        corner = number[0, 0]
        pairs.append(np.array([[corner, number[-1, 0]], [corner, number[-1, -1]]]))
    pairs = np.concatenate(pairs)
    assert torn(uv, pairs, uv, closed.even) == 0
    random = np.random.default_rng(0)
    inner = np.setdiff1d(np.arange(len(uv)), np.union1d(pairs, number[[0, -1]]))
    image = uv.copy()
    image[random.choice(inner, 20, replace=False)] += 0.03 * random.normal(size=(20, 2))
    image = copied(uv, pairs, image, closed.even)
    assert flipped(image, faces).any()
    start = time.perf_counter()
    image = repaired(uv, faces, pairs, image, np.zeros(len(uv), dtype=bool), closed.even)
    assert time.perf_counter() - start < 2
    assert not flipped(image, faces).any() and torn(uv, pairs, image, closed.even) == 0
