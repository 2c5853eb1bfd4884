"""Symmetric systems on the tables of a spline grid, by conjugate gradients behind multigrid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags, kron

from nsm.domains.positive_definite import factorise
from nsm.maps import LatticeSplineGrid
from nsm.maps.two_scale import two_scale_weights

# so few cells a side, or an odd number, are solved directly
_DIRECT = 64
_TOLERANCE = 1e-3
_ITERATIONS = 60
_POWERS = 10
# of the reciprocal of the largest eigenvalue: a step of Jacobi's method that damps the upper half
_RELAXED = 1.2


def solve(matrix: csr_matrix, right: np.ndarray, cells: int, degree: int) -> np.ndarray:
    """x (rows, m) of ``matrix @ x = right``, to a relative residual of a thousandth.

    Args:
        matrix: (rows, rows), symmetric and positive definite, between the uniform B-splines of a
            grid of ``cells`` by ``cells``; rows is (cells + degree)².
        right: (rows, m).
        cells, degree: of the grid.
    """
    return solve_through(matrix, right, refinements(cells, degree))


def solve_through(matrix: csr_matrix, right: np.ndarray, ups: Sequence[csr_matrix]) -> np.ndarray:
    """As :func:`solve`, on a grid of another kind.

    Args:
        ups: from the table of each coarser grid to the next finer one, the finest first.
    """
    cycle = _Cycle(matrix, ups)
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

    def __init__(self, matrix: csr_matrix, ups: Sequence[csr_matrix]) -> None:
        self.matrix = matrix
        self.coarser: _Cycle | None = None
        self.factors: Any = None
        if not ups:
            self.factors = factorise(matrix.tocsc())
            return
        self.up = ups[0]
        self.down = self.up.T.tocsr()
        self.coarser = _Cycle((self.down @ matrix @ self.up).tocsr(), ups[1:])
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


def refinements(cells: int, degree: int) -> list[csr_matrix]:
    """:func:`refinement` from each coarser grid, the finest first, down to one solved directly."""
    ups = []
    while cells > _DIRECT and cells % 2 == 0:
        cells //= 2
        ups.append(refinement(cells, degree))
    return ups


def lattice_refinements(grid: LatticeSplineGrid, level: int) -> list[csr_matrix]:
    """As :func:`refinements`, of a level of a grid on a closed domain."""
    n, m = grid.cells(level)
    ups = []
    while n * m > _DIRECT**2 and n % 2 == 0 and m % 4 == 0:
        n, m = n // 2, m // 2
        both = kron(*(refinement_along(side, periodic=True) for side in (n, m))).tocsr()
        fine, coarse = folding(grid, 2 * n, 2 * m), folding(grid, n, m)
        # the fine coefficients of an orbit are equal: their mean is each of them
        orbit = np.asarray(fine.sum(axis=0)).ravel()
        ups.append((diags(1 / orbit) @ fine.T @ both @ coarse).tocsr())
    return ups


def folding(grid: LatticeSplineGrid, n: int, m: int) -> csr_matrix:
    """From a table of n by m cells (rows) to all coefficients (n·m) of the periodic grid."""
    i, j = torch.meshgrid(torch.arange(n), torch.arange(m), indexing="ij")
    rows = grid.rows_of(i, j, (n, m)).flatten().numpy()
    ones = np.ones(n * m)
    return csr_matrix((ones, (np.arange(n * m), rows)), shape=(n * m, int(rows.max()) + 1))


def refinement(cells: int, degree: int) -> csr_matrix:
    """From the table of a grid to that of twice as many cells a side, for the same spline."""
    along = refinement_along(cells, degree)
    return kron(along, along).tocsr()


def refinement_along(cells: int, degree: int = 2, periodic: bool = False) -> csr_matrix:
    """The two-scale relation along an axis, (2·cells + degree, cells + degree), or (2·cells, cells)
    if it is periodic."""
    more = 0 if periodic else degree
    coarse = np.arange(cells + more)
    rows, columns, weights = [], [], []
    for k, weight in enumerate(two_scale_weights(degree)):
        # a periodic table begins with the spline in the middle of the first cell
        fine = (2 * coarse - degree // 2 + k) % (2 * cells) if periodic else 2 * coarse - degree + k
        there = (fine >= 0) & (fine < 2 * cells + more)
        rows.append(fine[there])
        columns.append(coarse[there])
        weights.append(np.full(there.sum(), weight))
    return csr_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(2 * cells + more, cells + more),
    )
