"""Faces found among others, beside a search through all of them."""

import numpy as np

from nsm.surfaces.topology import equal_faces


def test_faces_are_found_by_their_vertices_in_any_order():
    generator = np.random.default_rng(0)
    there, here = (generator.integers(-2, 7, (n, 3)) for n in (60, 80))
    here[:20] = there[generator.integers(0, 60, 20)][:, [2, 0, 1]]
    rows, own = equal_faces(there.astype(np.int32), here)
    expected = {}
    for k, face in enumerate(here.tolist()):
        like = [j for j, other in enumerate(there.tolist()) if sorted(other) == sorted(face)]
        if like and min(face) >= 0:
            expected[k] = like[0]  # the first of equal ones
    assert dict(zip(own.tolist(), rows.tolist(), strict=True)) == expected
    assert len(own) == len(expected) > 10


def test_faces_of_large_numbers_are_told_apart():
    many = 2**31
    there = np.array([[many, 1, 0], [many, 0, 2], [many, many - 1, many - 2]])
    rows, own = equal_faces(there, there[::-1, ::-1])
    assert rows.tolist() == [2, 1, 0] and own.tolist() == [0, 1, 2]
