"""Cholesky factors by dense fronts: against a general solver, and where there are none."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix, diags, identity, kron, random_array
from scipy.sparse.linalg import spsolve

from nsm.tasks.dissection import nested_dissection
from nsm.tasks.sparse_cholesky import Elimination


def grid(n, m):
    """The Laplacian of n × m points, which is singular, and their places."""
    one, other = (
        diags([-np.ones(k - 1), 2 * np.ones(k), -np.ones(k - 1)], [-1, 0, 1]).tolil()
        for k in (n, m)
    )
    for line in (one, other):
        line[0, 0] = line[-1, -1] = 1
    place = np.stack(np.divmod(np.arange(n * m), m), axis=1)
    return (kron(one, identity(m)) + kron(identity(n), other)).tocsr(), place


def check(matrix, parts, rtol=1e-8):
    matrix.sort_indices()
    right = np.random.default_rng(1).standard_normal(matrix.shape[0])
    elimination = Elimination(matrix, parts)
    assert np.array_equal(np.sort(elimination.order), np.arange(len(right)))
    found = elimination.factors(matrix.data).solve(right)
    np.testing.assert_allclose(found, spsolve(matrix.tocsc(), right), rtol=rtol)


@pytest.mark.parametrize("n, m", [(1, 1), (3, 5), (9, 8), (40, 31), (3, 200)])
def test_a_system_on_a_grid_is_solved(n, m):
    laplacian, place = grid(n, m)
    matrix = (laplacian + 0.1 * identity(n * m)).tocsr()
    check(matrix, nested_dissection(matrix, place))


@pytest.mark.parametrize("seed", range(6))
def test_any_parts_in_any_order_serve(seed):
    generator = np.random.default_rng(seed)
    half = random_array((90, 90), density=0.02 * (1 + seed % 3), rng=generator)
    matrix = csr_matrix(half @ half.T + identity(90))
    cuts = np.sort(generator.integers(0, 90, 12))  # some parts are empty
    check(matrix, np.split(generator.permutation(90), cuts))


def test_pieces_that_are_not_linked_are_apart():
    laplacian, place = grid(20, 20)
    matrix = kron(identity(2), laplacian + identity(400), format="csr")
    parts = nested_dissection(matrix, np.concatenate([place, place]))
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(800))
    assert all(len({int(k) // 400 for k in part}) == 1 for part in parts if len(part) > 32)
    check(matrix, parts)


@pytest.mark.parametrize("shift", [0.0, -1.0])
def test_factors_are_positive_where_a_matrix_is_not(shift):
    laplacian, place = grid(12, 12)
    matrix = (laplacian + shift * identity(144)).tocsr()
    factors = Elimination(matrix, nested_dissection(matrix, place)).factors(matrix.data)
    inverse = np.stack([factors.solve(column) for column in np.eye(144)])
    np.testing.assert_allclose(inverse, inverse.T, rtol=1e-6, atol=1e-9 * abs(inverse).max())
    assert np.linalg.eigvalsh(inverse + inverse.T).min() > 0


def test_a_matrix_of_zeros_is_replaced_by_the_identity():
    laplacian, place = grid(5, 5)
    elimination = Elimination(laplacian, nested_dissection(laplacian, place))
    right = np.arange(25.0)
    np.testing.assert_array_equal(elimination.factors(0 * laplacian.data).solve(right), right)
