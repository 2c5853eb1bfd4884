"""Coarse splines among those of a fine grid, and the matrices of their curvature."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags, identity, kron
from scipy.sparse.linalg import splu
from torch import Tensor

from nsm.compiled import compiled
from nsm.maps import SplineField
from nsm.tasks.dissection import nested_dissection
from nsm.tasks.multigrid import refinement_along
from nsm.tasks.sparse_cholesky import Elimination

# of H¹ beside the curvature of the loss: it decides where no point sees a coefficient
_FLOOR = 1e-3
_SEEN = 9  # coefficients, by a point: those of a cell
Seen = tuple[Tensor, Tensor]


class Level:
    """The splines of n × n cells among those of a field's own grid.

    What it takes and gives are vectors of double precision, for the CPU as arrays of numpy: there
    its loops are compiled. For other devices :class:`nsm.tasks.device_level.DeviceLevel` does the
    same with tensors.

    Args:
        field: its coefficients' number, type and symmetry count.
        cells: n; the field has n times a power of two.

    Attributes:
        grid: a spline of n cells, of one value.
        up: (rows of the field, rows of the level): the same spline's coefficients on the fine grid.
        down: its transpose, from gradients by the fine coefficients to those by the level's.
        floor: (rows, rows), a little H¹ that the loss's curvature is added to.
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
        self.down = self.up.T
        inner, smooth = _forms(self.grid.side, cells, field.periodic)
        self.floor = (_FLOOR * (whole.T @ inner @ whole)).tocsr()
        self.smoothness = (whole.T @ smooth @ whole).tocsr()

    @staticmethod
    def vector(tensor: Tensor) -> np.ndarray:
        """A tensor as an array in double precision."""
        return tensor.detach().cpu().double().numpy()

    @staticmethod
    def tensor(vector: np.ndarray) -> Tensor:
        """The inverse of :meth:`vector`."""
        return torch.from_numpy(vector)

    @staticmethod
    def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
        """One vector of parts, each flattened."""
        return np.concatenate([part.ravel() for part in parts])

    @property
    def rows(self) -> int:
        """Coefficients of each component."""
        return int(self.up.shape[1])

    @cached_property
    def _of_cell(self) -> np.ndarray:
        """(cells², 9) the coefficients that points of each cell see."""
        along = torch.arange(1, 2 * self.cells, 2, dtype=torch.float64) / self.cells - 1
        rows, _ = self.grid.seen(torch.cartesian_prod(along, along), tangents=False)
        return rows.numpy()

    @cached_property
    def pattern(self) -> csr_matrix:
        """(rows, rows), with an entry wherever one of the level's matrices may have one."""
        cell = np.repeat(np.arange(self.cells**2), _SEEN)
        ones = np.ones(len(cell))
        sees = csr_matrix((ones, (cell, self._of_cell.ravel())), (self.cells**2, self.rows))
        pattern = (sees.T @ sees + abs(self.floor) + abs(self.smoothness)).tocsr()
        pattern.sum_duplicates()
        return pattern

    @cached_property
    def elimination(self) -> Elimination:
        """In which the level's matrices are factorised: by nested dissection."""
        row, column = np.divmod(np.arange(self.rows), self.grid.side)
        if self.grid.odd:  # the pillow's two sides lie on each other: neighbours are near
            column = np.minimum(column, self.grid.side - 1 - column)
        place = np.stack([row, column], axis=1)
        return Elimination(self.pattern, nested_dissection(self.pattern, place))

    @cached_property
    def _seen_together(self) -> tuple[np.ndarray, np.ndarray]:
        """By the coefficient in the middle of what a point sees: the first that it sees, (rows,),
        and where in the pattern the entries of all of them are, (rows, 9, 9). An odd spline has two
        cells with the same middle, which see the same in reverse: that is for one of both."""
        first = np.zeros(self.rows, dtype=np.int64)
        place = np.zeros((self.rows, _SEEN, _SEEN), dtype=np.int32)
        _places(self._of_cell, self.pattern.indptr, self.pattern.indices, first, place)
        return first, place

    @cached_property
    def places(self) -> np.ndarray:
        """Those of the pattern's entries (nnz,) in a matrix (rows, rows); they rise."""
        row = np.repeat(np.arange(self.rows), np.diff(self.pattern.indptr))
        return np.asarray(row * self.rows + self.pattern.indices)

    @cached_property
    def _entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Those of the floor and of the smoothness, (nnz,) each, in the pattern."""
        floor, smooth = np.zeros(self.pattern.nnz), np.zeros(self.pattern.nnz)
        for entries, matrix in ((floor, self.floor.tocoo()), (smooth, self.smoothness.tocoo())):
            wanted = matrix.row.astype(np.int64) * self.rows + matrix.col
            entries[np.searchsorted(self.places, wanted)] = matrix.data
        return floor, smooth

    def regularizer(self, smoothing: float) -> np.ndarray:
        """The floor and the second derivative of ``smoothing`` times cᵀ smoothness c, by the
        coefficients c: entries (nnz,) in the pattern."""
        floor, smooth = self._entries
        return floor + 2 * smoothing * smooth

    def restored(self, fine: Tensor) -> np.ndarray:
        """The level's coefficients (rows, d) of a spline of the level, given on the fine grid."""
        given = self.vector(fine)
        if self.up.shape[0] == self.up.shape[1]:
            return given
        normal = splu((self.down @ self.up).tocsc())
        return np.asarray(normal.solve(self.down @ given))

    def entries(self, smoothing: float, seen: Iterable[Seen]) -> np.ndarray:
        """Of the matrices of a step, (d, nnz) in the pattern, one for each component: what points
        see, and the :meth:`regularizer`.

        Args:
            smoothing: weight of the smoothness.
            seen: points and their blocks, as :meth:`matrices` takes them.
        """
        entries = np.tile(self.regularizer(smoothing), (self.out_dim, 1))
        for x, blocks in seen:
            entries += self.matrices(x, blocks)
        return entries

    def metric(self, entries: np.ndarray) -> Metric:
        """The metric of matrices given by their entries (d, nnz)."""
        return Metric(self, entries)

    def matrices(self, x: Tensor, blocks: Tensor) -> np.ndarray:
        """Σ Wᵀ H W over points, W their weights on the level.

        Args:
            x: (N, 2).
            blocks: H (d, N, 3, 3), by the value and both derivatives of each component.

        Returns:
            Entries (d, nnz), in the pattern, of d matrices.
        """
        rows, weights = self.grid.seen(x.cpu().double(), tangents=True)
        entries = np.zeros((len(blocks), self.pattern.nnz))
        each = blocks.cpu().double().contiguous().numpy()
        _add_up(rows.numpy(), weights.numpy(), each, *self._seen_together, entries)
        return entries


@compiled
def _places(
    of_cell: np.ndarray,
    start: np.ndarray,
    columns: np.ndarray,
    first: np.ndarray,
    place: np.ndarray,
) -> None:
    """Fill in what :meth:`Level._seen_together` returns."""
    for rows in of_cell:
        middle = rows[4]
        first[middle] = rows[0]
        for k in range(len(rows)):
            for m in range(len(rows)):
                p = start[rows[k]]
                while columns[p] != rows[m]:
                    p += 1
                place[middle, k, m] = p


@compiled
def _add_up(
    rows: np.ndarray,
    weights: np.ndarray,
    blocks: np.ndarray,
    first: np.ndarray,
    place: np.ndarray,
    entries: np.ndarray,
) -> None:
    """Add Wᵀ H W of each point, which sees rows (N, 9) with weights (3, N, 9), to entries."""
    w, hw = np.empty((3, 9)), np.empty((3, 9))
    for p in range(len(rows)):
        middle = rows[p, 4]
        turned = first[middle] != rows[p, 0]
        for b in range(3):
            for k in range(9):
                w[b, 8 - k if turned else k] = weights[b, p, k]
        for c in range(len(blocks)):
            for a in range(3):
                for k in range(9):
                    hw[a, k] = 0.0
                    for b in range(3):
                        hw[a, k] += blocks[c, p, a, b] * w[b, k]
            for k in range(9):
                for m in range(9):
                    more = w[0, k] * hw[0, m] + w[1, k] * hw[1, m] + w[2, k] * hw[2, m]
                    entries[c, place[middle, k, m]] += more


class Metric:
    """Symmetric positive definite matrices on a level's coefficients, each component apart.

    Args:
        level: whose pattern they have.
        entries: (d, nnz) in it, of one matrix for each component.
    """

    def __init__(self, level: Level, entries: np.ndarray) -> None:
        self.factors = [level.elimination.factors(each) for each in entries]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The matrices' inverses times the columns of (rows, d)."""
        columns = zip(self.factors, right.T, strict=True)
        return np.stack([factors.solve(column) for factors, column in columns], axis=1)


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
