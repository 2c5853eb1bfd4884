"""Vertices of flipped triangles taken out of a flat mesh, and put back where nothing is flipped."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.domains.kernels import innermost
from nsm.domains.planar_mesh import cross, flipped, signed_areas
from nsm.domains.reinsertion import reinserted, turned_back
from nsm.domains.untangling import untangled
from nsm.surfaces.shapes import ring_mesh
from nsm.surfaces.topology import boundary_loops

DISC, FACES = ring_mesh(10)
seeds = st.integers(0, 2**32 - 1)


def rim_of(uv, faces):
    fixed = np.zeros(len(uv), dtype=bool)
    fixed[boundary_loops(faces)[0]] = True
    return fixed


def with_needles(near):
    """The disc's mesh with five triangles split at a point that is nearly on a side, and again
    nearly at that point."""
    rest, faces = DISC.copy(), FACES.copy()
    for f in (40, 90, 150, 210, 260):
        last = len(faces)
        for face, weights in (
            (f, (0.5, 0.5 - near, near)),
            (last, (near, near, 1 - 2 * near)),
            (last + 1, (near, 2 * near, 1 - 3 * near)),
        ):
            a, b, c = faces[face]
            n = len(rest)
            rest = np.concatenate([rest, [np.array(weights) @ rest[[a, b, c]]]])
            faces = np.concatenate([faces, [[b, c, n], [c, a, n]]])
            faces[face] = [a, b, n]
    assert not flipped(rest, faces).any()
    return rest, faces


def bent(x):
    return x + 0.1 * np.sin(2 * x[:, ::-1] + 0.3)


@pytest.mark.parametrize(("near", "too_hard"), [(1e-6, False), (1e-11, True)])
def test_needles_that_single_precision_flips_are_turned_where_no_descent_turns_them(near, too_hard):
    rest, faces = with_needles(near)
    image = bent(rest).astype(np.float32).astype(float)
    fixed = rim_of(rest, faces)
    assert flipped(untangled(rest, faces, image, fixed), faces).any() == too_hard
    given_image = image.copy()
    result = turned_back(rest, faces, image, fixed, np.zeros(len(rest), dtype=bool))
    assert not flipped(result, faces).any() and (image == given_image).all()
    assert (result[fixed] == image[fixed]).all()
    alone = reinserted(rest, faces, image, fixed)
    assert not flipped(alone, faces).any()
    moved = np.flatnonzero((alone != image).any(axis=1))
    assert 0 < len(moved) <= 15 + 15  # the needles' vertices, and some that they are on
    assert np.linalg.norm(alone - image, axis=1).max() < 0.3


@given(seeds, st.floats(0.0, 0.2), st.floats(0.02, 0.2))
@examples(12)
def test_fewer_triangles_are_flipped_or_nothing_has_moved(seed, share, size):
    random, fixed = np.random.default_rng(seed), rim_of(DISC, FACES)
    hit = ~fixed & (random.random(len(DISC)) < share)
    image = np.where(hit[:, None], DISC + size * random.normal(size=DISC.shape), DISC)
    before = int(flipped(image, FACES).sum())
    result = reinserted(DISC, FACES, image, fixed)
    after = int(flipped(result, FACES).sum())
    assert after < before or (result == image).all()
    assert (result[fixed] == image[fixed]).all()
    if share < 0.1:
        assert after == 0
        assert signed_areas(result, FACES).sum() == pytest.approx(signed_areas(DISC, FACES).sum())


def test_a_vertex_thrown_across_its_star_comes_back_to_where_its_neighbours_want_it():
    center = int(np.linalg.norm(DISC - [0.3, 0.2], axis=1).argmin())
    image = DISC @ np.array([[1.2, 0.3], [0.0, 0.9]])
    wanted = image[center].copy()
    image[center] += [0.4, 0.1]
    result = reinserted(DISC, FACES, image, np.zeros(len(DISC), dtype=bool))
    moved = np.flatnonzero((result != image).any(axis=1))
    assert moved.tolist() == [center]
    assert np.linalg.norm(result[center] - wanted) < 1e-3


def test_what_cannot_be_turned_is_given_back():
    mirrored = DISC * [1.0, -1.0]
    everything = np.ones(len(DISC), dtype=bool)
    assert (reinserted(DISC, FACES, mirrored, everything) == mirrored).all()


@given(seeds)
@examples(20)
def test_the_innermost_point_of_a_star_sees_all_its_sides(seed):
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, 9))
    b = random.uniform(0.5, 1.5, 9)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    c = np.roll(b, -1, axis=0)
    heights = cross(b, c) / np.linalg.norm(c - b, axis=1)
    at = innermost(b, c)
    if (heights > 1e-9).all():  # the origin sees all sides
        found = cross(b - at, c - at) / np.linalg.norm(c - b, axis=1)
        assert found.min() >= heights.min() * (1 - 1e-9)
    elif at is not None:
        assert (cross(b - at, c - at) > 0).all()


def test_a_vertex_held_far_from_its_place_is_made_room_for():
    center = int(np.linalg.norm(DISC - [0.2, 0.1], axis=1).argmin())
    image = DISC.copy()
    image[center] += [0.35, 0.05]
    fixed = rim_of(DISC, FACES)
    fixed[center] = True
    result = reinserted(DISC, FACES, image, fixed)
    assert flipped(image, FACES).any() and not flipped(result, FACES).any()
    assert (result[fixed] == image[fixed]).all()
