"""Flipped triangles found with exact signs, and turned back."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.domains import domain, untangling
from nsm.domains.planar_mesh import flipped, order_violations
from nsm.domains.untangling import untangled
from nsm.surfaces.predicates import orientation
from nsm.surfaces.shapes import grid_mesh, ring_mesh
from nsm.surfaces.topology import boundary_loops

DISC, DISC_FACES = ring_mesh(10)
SQUARE, SQUARE_FACES = grid_mesh(12)
finite = st.floats(-1e100, 1e100, allow_subnormal=True)


def exact(a, b, c):
    (ax, ay), (bx, by), (cx, cy) = ([Fraction(x) for x in p] for p in (a, b, c))
    return np.sign(float((bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0)) - float(
        (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0
    )


@given(st.lists(finite, min_size=6, max_size=6))
@examples(100)
def test_signs_of_areas_are_exact(x):
    a, b, c = x[:2], x[2:4], x[4:]
    assert orientation([a], [b], [c])[0] == exact(a, b, c)


@given(st.integers(-50, 50), st.integers(-50, 50), st.integers(0, 2))
@examples(100)
def test_signs_are_exact_next_to_a_line(i, j, which):
    """Points a few roundings off the diagonal, where the rounded determinant often errs."""
    x = [[0.5 + i * 2.0**-53, 0.5 + j * 2.0**-53], [12.0, 12.0], [24.0, 24.0]]
    a, b, c = x[which:] + x[:which]
    assert orientation([a], [b], [c])[0] == exact(a, b, c)


def test_what_is_not_finite_has_no_orientation():
    assert orientation([[0, 0], [0, np.nan]], [1, 0], [[np.inf, 1], [0, 1]]).tolist() == [0, 0]


def rim_of(uv, faces):
    fixed = np.zeros(len(uv), dtype=bool)
    fixed[boundary_loops(faces)[0]] = True
    return fixed


@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.0, 1.0),
    st.floats(0.02, 0.2),
    st.sampled_from([(DISC, DISC_FACES), (SQUARE, SQUARE_FACES)]),
)
@examples(25)
def test_a_tangled_mesh_is_untangled_whatever_the_tangle(seed, share, size, mesh):
    rest, faces = mesh
    random = np.random.default_rng(seed)
    fixed = rim_of(rest, faces)
    tangled = np.where(
        (~fixed & (random.random(len(rest)) < share))[:, None],
        rest + size * random.normal(size=rest.shape),
        rest,
    )
    before = tangled.copy()
    result = untangled(rest, faces, tangled, fixed)
    assert (tangled == before).all()
    a, b, c = (result[faces[:, k]] for k in range(3))
    areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (areas > 0).all() and areas.sum() == pytest.approx(
        2 * (4 if rest is SQUARE else areas.sum() / 2)
    )
    assert (result[fixed] == rest[fixed]).all()


def test_only_what_lies_around_a_flip_is_moved():
    center = int(np.linalg.norm(DISC - [0.3, 0.2], axis=1).argmin())
    tangled = DISC.copy()
    tangled[center] += [0.25, 0.0]
    assert flipped(tangled, DISC_FACES).any()
    result = untangled(DISC, DISC_FACES, tangled, rim_of(DISC, DISC_FACES))
    moved = np.flatnonzero((result != tangled).any(axis=1))
    assert not flipped(result, DISC_FACES).any()
    assert 0 < len(moved) < 20
    assert np.linalg.norm(DISC[moved] - DISC[center], axis=1).max() < 0.5


def test_a_mesh_without_flips_is_left_alone():
    image = DISC @ np.array([[0.8, 0.3], [-0.1, 1.2]])
    assert (untangled(DISC, DISC_FACES, image, rim_of(DISC, DISC_FACES)) == image).all()


@pytest.mark.parametrize("epsilon", [1e-3, 0.5])
def test_the_gradient_is_that_of_the_energy(epsilon):
    """Also by points that another one follows, turned around, and with flipped triangles."""
    random = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [0, 2, 4]])
    inverse = random.normal(size=(len(faces), 2, 2))
    which, sign, shift = np.array([-1, 0, 1, 2, 1]), np.array([1.0, 1, 1, 1, -1]), np.zeros((5, 2))
    shift[4] = 2.0, -1.0
    points, x = random.normal(size=(5, 2)), random.normal(size=(3, 2))

    def energy(x):
        untangling._place(x, which, sign, shift, points)
        gradient = np.zeros_like(x)
        return untangling._energy(points, faces, inverse, epsilon, which, sign, gradient), gradient

    held = points[0].copy()
    value, gradient = energy(x)
    assert (points[0] == held).all() and (points[4] == shift[4] - x[1]).all()
    sides = np.stack([points[faces[:, k]] - points[faces[:, 0]] for k in (1, 2)], axis=2)
    jacobian = sides @ inverse
    det = np.linalg.det(jacobian)
    top = (jacobian**2).sum(axis=(1, 2)) + det**2 + 1
    assert (det < 0).any() and (det > 0).any()
    assert value == pytest.approx((top * 2 / (det + np.sqrt(epsilon**2 + det**2))).sum(), rel=1e-9)
    for k in range(3):
        for i in range(2):
            step = np.zeros_like(x)
            step[k, i] = 1e-6
            slope = (energy(x + step)[0] - energy(x - step)[0]) / 2e-6
            assert gradient[k, i] == pytest.approx(slope, rel=1e-4, abs=1e-5 * abs(gradient).max())


def test_the_work_is_bounded(monkeypatch):
    """A rim turned inside out can never be untangled: what is evaluated stays within the bound."""
    spent = []
    of_energy = untangling._energy

    def counted(points, faces, *others):
        spent.append(max(len(faces), untangling._SMALL))
        return of_energy(points, faces, *others)

    monkeypatch.setattr(untangling, "_energy", counted)
    monkeypatch.setattr(untangling, "_LEAST_WORK", 0)
    monkeypatch.setattr(untangling, "_WORK", 20)
    rim = rim_of(DISC, DISC_FACES)
    image = DISC.copy()
    image[~rim] = np.random.default_rng(0).permutation(image[~rim])
    image[np.flatnonzero(rim)[:2]] = image[np.flatnonzero(rim)[1::-1]]  # two of the rim exchanged
    left = flipped(untangled(DISC, DISC_FACES, image, rim), DISC_FACES)
    assert left.any()
    whole = 20 * len(DISC_FACES)
    assert 0.9 * whole < sum(spent) < whole + 25 * max(spent)


def test_what_cannot_be_untangled_is_given_back_for_the_caller_to_count():
    mirrored = DISC * [1.0, -1.0]
    result = untangled(DISC, DISC_FACES, mirrored, np.ones(len(DISC), dtype=bool))
    assert (result == mirrored).all() and flipped(result, DISC_FACES).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.15), st.sampled_from(["disc", "square"]))
@examples(50)
def test_a_boundary_is_put_in_order_along_the_domain(seed, size, name):
    random, omega = np.random.default_rng(seed), domain(name)
    t = np.arange(40) / 40
    rest = omega.boundary_points(t)
    jumbled = omega.boundary_points(np.mod(t + 0.3 + size * (random.random(40) - 0.5), 1))
    result = omega.in_order(jumbled, rest)
    fractions = omega.boundary_fractions(result)
    steps = np.mod(np.diff(fractions, append=fractions[0]), 1)
    assert (steps > 0).all() and steps.sum() == pytest.approx(1)
    if order_violations(jumbled) == 0:
        assert (result == jumbled).all()
    if name == "disc":
        assert order_violations(result) == 0
    # no point goes farther than the jumble went
    assert np.linalg.norm(result - jumbled, axis=1).max() <= 8 * size + 1e-9


def test_order_is_violated_by_steps_back_double_turns_and_the_wrong_way():
    t = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    assert order_violations(circle) == 0
    assert order_violations(circle[::-1]) == 24
    twice = np.concatenate([circle, circle])
    assert order_violations(twice) == 1
    swapped = circle.copy()
    swapped[[3, 4]] = swapped[[4, 3]]
    assert order_violations(swapped) == 1
    stalled = circle.copy()
    stalled[3] = stalled[4]
    assert order_violations(stalled) == 1
