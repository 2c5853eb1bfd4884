"""Coarse splines among those of a fine grid, and the matrices of their curvature."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csc_matrix, csr_matrix, diags, identity, kron
from scipy.sparse.linalg import splu
from torch import Tensor

from nsm.compiled import compiled
from nsm.maps import SplineField
from nsm.tasks.dissection import nested_dissection
from nsm.tasks.multigrid import refinement_along

# of H¹ beside the curvature of the loss: it decides where no point sees a coefficient
_FLOOR = 1e-3
_HASH = 0x9E3779B97F4A7C15 - 2**64


class Level:
    """The splines of n × n cells among those of a field's own grid.

    Args:
        field: its coefficients' number, type and symmetry count.
        cells: n; the field has n times a power of two.

    Attributes:
        grid: a spline of n cells, of one value.
        up: (rows of the field, rows of the level): the same spline's coefficients on the fine grid.
        smoothness: (rows, rows), ∫ of the squared second derivatives in units of the cells' size
            to the power of -1: the mean squared change of the first derivatives over a cell.

    Raises:
        ValueError: the field's cells are not such a multiple.
    """

    def __init__(self, field: SplineField, cells: int) -> None:
        finer, along = cells, identity(cells if field.periodic else cells + 2, format="csr")
        while cells >= 3 and finer < field.cells:
            up = refinement_along(finer, periodic=field.periodic)
            along, finer = up @ along, 2 * finer
        if finer != field.cells:
            raise ValueError(
                f"map.cells {field.cells} is not optimizer.levels' {cells}, 3 or more, times a "
                "power of two"
            )
        self.cells, self.out_dim = cells, field.out_dim
        self.grid = SplineField(1, cells, field.periodic, field.odd)
        whole = _whole(self.grid)
        fine = field.side**2 // 2 if field.odd else field.side**2
        self.up = (kron(along, along).tocsr() @ whole)[:fine].tocsr()
        inner, smooth = _forms(self.grid.side, cells, field.periodic)
        self.floor = (_FLOOR * (whole.T @ inner @ whole)).tocsc()
        self.smoothness = (whole.T @ smooth @ whole).tocsc()

    @property
    def rows(self) -> int:
        """Coefficients of each component."""
        return int(self.up.shape[1])

    @cached_property
    def order(self) -> np.ndarray:
        """An order of the rows in which factors of their matrices fill in little."""
        row, column = np.divmod(np.arange(self.rows), self.grid.side)
        if self.grid.odd:  # the pillow's two sides lie on each other: neighbours are near
            column = np.minimum(column, self.grid.side - 1 - column)
        return nested_dissection(self.smoothness.tocsr(), np.stack([row, column], axis=1))

    def restored(self, fine: np.ndarray) -> np.ndarray:
        """The level's coefficients (rows, d) of a spline of the level, given on the fine grid."""
        if self.up.shape[0] == self.up.shape[1]:
            return fine
        normal = splu((self.up.T @ self.up).tocsc())
        return np.asarray(normal.solve(self.up.T @ fine))

    def matrices(self, x: Tensor, blocks: Tensor) -> list[csc_matrix]:
        """Σ Wᵀ H W over points, W their weights on the level.

        Args:
            x: (N, 2).
            blocks: H (d, N, 3, 3), by the value and both derivatives of each component.

        Returns:
            d matrices (rows, rows).
        """
        rows, weights = self.grid.seen(x.cpu().double(), tangents=True)
        # points of a cell see the same coefficients
        key = (rows * (torch.arange(1, 10) * _HASH)).sum(dim=1)
        _, cell = key.unique(return_inverse=True)
        count = int(cell.max()) + 1
        first = torch.empty(count, dtype=torch.int64)
        first[cell] = torch.arange(len(cell))
        of_cell = rows[first].numpy()
        i = np.repeat(of_cell, 9, axis=1).ravel()
        j = np.tile(of_cell, (1, 9)).ravel()
        result = []
        for block in blocks.cpu().double():
            entries = np.zeros((count, 9, 9))
            _add_up(cell.numpy(), weights.numpy(), block.contiguous().numpy(), entries)
            shape = (self.rows, self.rows)
            result.append(csr_matrix((entries.ravel(), (i, j)), shape=shape).tocsc())
        return result


@compiled
def _add_up(cell: np.ndarray, weights: np.ndarray, block: np.ndarray, entries: np.ndarray) -> None:
    """Add Wᵀ H W of each point, weights (3, N, 9) and H (N, 3, 3), to the entries (cells, 9, 9) of
    its cell (N,)."""
    seen = np.empty((3, 9))
    for p in range(len(cell)):
        for a in range(3):
            for k in range(9):
                seen[a, k] = 0.0
                for b in range(3):
                    seen[a, k] += block[p, a, b] * weights[b, p, k]
        for k in range(9):
            for m in range(9):
                for a in range(3):
                    entries[cell[p], k, m] += weights[a, p, k] * seen[a, m]


class Metric:
    """Symmetric positive definite matrices on a level's coefficients, each component apart.

    Args:
        matrices: one (rows, rows) for each component.
        order: (rows,) in which they are factorised.
    """

    def __init__(self, matrices: Sequence[csc_matrix], order: np.ndarray) -> None:
        self.order = order
        # symmetric and positive: no pivoting
        self.factors = [
            splu(
                matrix[order][:, order].tocsc(),
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            for matrix in matrices
        ]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The matrices' inverses times the columns of (rows, d)."""
        result = np.empty_like(right)
        for k, factor in enumerate(self.factors):
            result[self.order, k] = factor.solve(right[self.order, k])
        return result


def _whole(grid: SplineField) -> csr_matrix:
    """From a spline's coefficients to those of all cells, (side², rows)."""
    count = grid.side**2
    if not grid.odd:
        return identity(count, format="csr")
    half = identity(count // 2, format="csr")
    # the second half is the first in reverse, and negative
    place = np.concatenate([np.arange(count // 2), np.arange(count // 2)[::-1]])
    sign = np.repeat([1.0, -1.0], count // 2)
    return diags(sign) @ half[place]


def _forms(side: int, cells: int, periodic: bool) -> tuple[csr_matrix, csr_matrix]:
    """Squares of all coefficients (side², side²): of first differences, and of second ones."""
    one = identity(side, format="csr")
    step = diags([-np.ones(side), np.ones(side - 1)], [0, 1]).tolil()  # type: ignore[list-item]
    bend = diags([np.ones(side - 1), -2 * np.ones(side), np.ones(side - 1)], [-1, 0, 1]).tolil()  # type: ignore[list-item]
    if periodic:
        step[-1, 0] = bend[0, -1] = bend[-1, 0] = 1
    else:
        step[-1], bend[0], bend[-1] = 0, 0, 0
    step, bend = step.tocsr(), bend.tocsr()
    size = 2 / cells
    along = step.T @ step
    first = kron(along, one) + kron(one, along) + size**2 * kron(one, one)
    mixed = kron(step, step)
    sides = (kron(bend, one), kron(one, bend))
    second = sum((b.T @ b for b in sides), start=2 * mixed.T @ mixed)
    return first.tocsr(), (second / (size * cells) ** 2).tocsr()
