"""Symmetric systems on the tables of a spline grid, by conjugate gradients behind multigrid."""

from __future__ import annotations

from math import comb
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, kron
from scipy.sparse.linalg import splu

# so few cells a side, or an odd number, are solved directly
_DIRECT = 64
_TOLERANCE = 1e-5
_ITERATIONS = 60
_POWERS = 10
# of the reciprocal of the largest eigenvalue: a step of Jacobi's method that damps the upper half
_RELAXED = 1.2


def solve(matrix: csr_matrix, right: np.ndarray, cells: int, degree: int) -> np.ndarray:
    """x (rows, m) of ``matrix @ x = right``, to a relative residual of 1e-5.

    Args:
        matrix: (rows, rows), symmetric and positive definite, between the uniform B-splines of a
            grid of ``cells`` by ``cells``; rows is (cells + degree)².
        right: (rows, m).
        cells, degree: of the grid.
    """
    cycle = _Cycle(matrix, cells, degree)
    x, left = np.zeros_like(right), right.copy()
    aim = _TOLERANCE * np.linalg.norm(right, axis=0)
    direction, before = np.zeros_like(right), np.ones(right.shape[1])
    for _ in range(_ITERATIONS):
        if (np.linalg.norm(left, axis=0) <= aim).all():
            break
        guess = cycle(left)
        product = (left * guess).sum(axis=0)
        direction = guess + product / before * direction
        image = matrix @ direction
        # a column that is solved has nothing to step along
        step = product / np.maximum((direction * image).sum(axis=0), np.finfo(float).tiny)
        x += step * direction
        left -= step * image
        before = np.where(product > 0, product, 1.0)
    return x


class _Cycle:
    """One V-cycle: a Jacobi step, the coarser grid's correction, and a Jacobi step."""

    def __init__(self, matrix: csr_matrix, cells: int, degree: int) -> None:
        self.matrix = matrix
        self.coarser: _Cycle | None = None
        self.factors: Any = None
        if cells <= _DIRECT or cells % 2:
            # symmetric and positive: no pivoting, and an ordering that knows it
            self.factors = splu(
                matrix.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            return
        self.up = refinement(cells // 2, degree)
        self.down = self.up.T.tocsr()
        self.coarser = _Cycle((self.down @ matrix @ self.up).tocsr(), cells // 2, degree)
        inverse = 1 / matrix.diagonal()
        x = np.random.default_rng(0).standard_normal(len(inverse))
        for _ in range(_POWERS):
            x = inverse * (matrix @ x)
            x /= np.linalg.norm(x)
        largest = x @ (inverse * (matrix @ x))
        self.jacobi = (_RELAXED / largest * inverse)[:, None]

    def __call__(self, right: np.ndarray) -> np.ndarray:
        if self.coarser is None:
            solved: np.ndarray = self.factors.solve(right)
            return solved
        x = self.jacobi * right
        x = x + self.up @ self.coarser(self.down @ (right - self.matrix @ x))
        return x + self.jacobi * (right - self.matrix @ x)


def refinement(cells: int, degree: int) -> csr_matrix:
    """From the table of a grid to that of twice as many cells a side, for the same spline."""
    coarse = np.arange(cells + degree)
    rows, columns, weights = [], [], []
    for k in range(degree + 2):
        fine = 2 * coarse - degree + k
        there = (fine >= 0) & (fine < 2 * cells + degree)
        rows.append(fine[there])
        columns.append(coarse[there])
        weights.append(np.full(there.sum(), comb(degree + 1, k) / 2**degree))
    along = csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(2 * cells + degree, cells + degree),
    )
    return kron(along, along).tocsr()
