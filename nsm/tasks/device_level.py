"""The levels of splines on other devices than the CPU: vectors and matrices stay there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from nsm.tasks.spline_level import Level, Seen

# what the diagonal gains, relative to itself, until a matrix has a factor
_RAISED = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class DeviceLevel:
    """As :class:`nsm.tasks.spline_level.Level`, with vectors that are tensors on a device.

    Args:
        level: the same, for the CPU.
        device: where the field is.

    Attributes:
        up, down, smoothness: those of the level.
    """

    def __init__(self, level: Level, device: torch.device) -> None:
        self._level, self.device = level, device
        self.rows, self.out_dim = level.rows, level.out_dim
        self.up, self.down = Rows(level.up, device), Rows(level.down, device)
        self.smoothness = Rows(level.smoothness, device)

    @staticmethod
    def vector(tensor: Tensor) -> Tensor:
        """A tensor in double precision."""
        return tensor.detach().double()

    @staticmethod
    def tensor(vector: Tensor) -> Tensor:
        """The inverse of :meth:`vector`."""
        return vector

    @staticmethod
    def joined(parts: Sequence[Tensor]) -> Tensor:
        """One vector of parts, each flattened."""
        return torch.cat([part.flatten() for part in parts])

    def restored(self, fine: Tensor) -> Tensor:
        """The level's coefficients (rows, d) of a spline of the level, given on the fine grid."""
        if len(fine) == self.rows:
            return self.vector(fine)
        # by way of the host, once in a step on a coarse level
        return torch.from_numpy(self._level.restored(fine)).to(self.device)

    @cached_property
    def _places(self) -> Tensor:
        return torch.from_numpy(self._level.places).to(self.device)

    def entries(self, smoothing: float, seen: Iterable[Seen]) -> Tensor:
        """As :meth:`nsm.tasks.spline_level.Level.entries`."""
        regularizer = torch.from_numpy(self._level.regularizer(smoothing)).to(self.device)
        entries = regularizer.repeat(self.out_dim, 1)
        for x, blocks in seen:
            rows, weights = self._level.grid.seen(x.double(), tangents=True)
            pairs = (rows[:, :, None] * self.rows + rows[:, None]).flatten()
            place = torch.searchsorted(self._places, pairs)
            w = weights.transpose(0, 1)  # (N, 3, 9)
            for own, block in zip(entries, blocks.double(), strict=True):
                own.index_add_(0, place, (w.mT @ block @ w).flatten())
        return entries

    def metric(self, entries: Tensor) -> DenseMetric:
        """As :meth:`nsm.tasks.spline_level.Level.metric`.

        One matrix after the other is made and factorised: that of a spline of 128 × 128 cells
        takes 2.3 GB.
        """
        factors = []
        for own in entries:
            flat = own.new_zeros(self.rows**2)
            flat[self._places] = own
            factors.append(_factor(flat.view(self.rows, self.rows)))
        return DenseMetric(factors)


class DenseMetric:
    """Symmetric positive definite matrices on a level's coefficients, each component apart.

    Args:
        factors: (rows, rows) of each component, lower triangles.
    """

    def __init__(self, factors: Sequence[Tensor]) -> None:
        self.factors = factors

    def solve(self, right: Tensor) -> Tensor:
        """The matrices' inverses times the columns of (rows, d)."""
        columns = zip(right.split(1, dim=1), self.factors, strict=True)
        return torch.cat([torch.cholesky_solve(*each) for each in columns], dim=1)


def _factor(matrix: Tensor) -> Tensor:
    """The Cholesky factor of a matrix (rows, rows), which is changed; where it is not positive
    definite, that of one with a larger diagonal."""
    diagonal = matrix.diagonal().clone()
    for more in _RAISED:
        matrix.diagonal().copy_((1 + more) * diagonal)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if not failed:
            return factor
    return torch.where(diagonal > 0, diagonal, 1.0).sqrt().diag()


class Rows:
    """A sparse matrix on a device: the entries of its rows, each with zeros up to the same number.

    Args:
        matrix: the matrix.
        device: where it is wanted.
    """

    def __init__(self, matrix: csr_matrix, device: torch.device) -> None:
        matrix = matrix.tocsr()
        count = np.diff(matrix.indptr)
        row = np.repeat(np.arange(len(count)), count)
        place = np.arange(matrix.nnz) - matrix.indptr[row]
        columns = np.zeros((len(count), count.max()), dtype=np.int64)
        values = np.zeros(columns.shape)
        columns[row, place], values[row, place] = matrix.indices, matrix.data
        self._columns = torch.from_numpy(columns).to(device)
        self._values = torch.from_numpy(values).to(device)

    def __matmul__(self, x: Tensor) -> Tensor:
        """(columns, d) to (rows, d)."""
        seen = x.index_select(0, self._columns.flatten()).view(*self._columns.shape, -1)
        return (self._values[..., None] * seen).sum(dim=1)
