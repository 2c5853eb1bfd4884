"""Sparse matrices of second derivatives by the coordinates of a mesh's vertices."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU

from nsm.domains.orbifold.tutte import factorised
from nsm.surfaces import topology


class Pattern:
    """Where second derivatives by the coordinates of corners go in a sparse matrix.

    Args:
        faces: (F, 3).
        count: of the vertices, V.

    Attributes:
        ids: (N,) the vertices that the faces name, in an order in which elimination fills in
            little; two rows and columns of the matrix belong to each.
    """

    def __init__(self, faces: np.ndarray, count: int) -> None:
        ids, local = topology.renumbered(faces, count)
        n = len(ids)
        number = _elimination(local[faces], n)
        self.ids = np.empty_like(ids)
        self.ids[number] = ids
        corner = number[local[faces]].T
        keys = corner[:, None] + n * corner  # row of corner k, column of corner l
        unique, entry = np.unique(keys, return_inverse=True)
        self._row, self._column = unique % n, unique // n
        # a column for each coordinate, with both rows of one vertex after the other
        count_of = np.bincount(self._column, minlength=n)
        start = np.cumsum(count_of) - count_of
        first = 2 * (start[self._column] + np.arange(len(unique)))
        step = 2 * count_of[self._column]
        self._place = np.array([[first, first + step], [first + 1, first + step + 1]])
        self._of_corners = self._place.take(entry, axis=2).ravel()
        self._diagonal = self._place[:, :, self._row == self._column][[0, 1], [0, 1]]
        indices = np.empty(4 * len(unique), dtype=np.int32)
        for i in range(2):
            indices[self._place[i]] = 2 * self._row + i
        indptr = np.append(4 * start[:, None] + 2 * count_of[:, None] * [0, 1], 4 * len(unique))
        self._matrix = csc_matrix(
            (np.zeros(len(indices)), indices, indptr.astype(np.int32)), shape=(2 * n, 2 * n)
        )

    def factorised(self, values: np.ndarray, held: np.ndarray) -> SuperLU:
        """The sum of second derivatives, factorised, with rows and columns of some vertices
        replaced by those of the identity.

        Args:
            values: (2, 2, 3, 3, F) by the coordinates i and j of the corners k and l.
            held: (V,) mask of these vertices.

        Raises:
            RuntimeError: it is singular.
        """
        data = np.bincount(self._of_corners, values.ravel(), self._matrix.nnz)
        stays = held[self.ids]
        data[self._place[:, :, stays[self._row] | stays[self._column]]] = 0.0
        data[self._diagonal] = np.where(stays, 1.0, data[self._diagonal] * (1 + 1e-10))
        self._matrix.data = data
        return factorised(self._matrix, ordered=True)


def _elimination(faces: np.ndarray, n: int) -> np.ndarray:
    """Numbers (N,) of vertices in an order in which elimination fills in little."""
    i, j, every = faces.ravel(), faces[:, [1, 2, 0]].ravel(), np.arange(n)
    values = np.repeat([-1.0, float(faces.size)], [2 * len(i), n])
    ends = (np.concatenate([i, j, every]), np.concatenate([j, i, every]))
    order: np.ndarray = factorised(csc_matrix((values, ends), shape=(n, n))).perm_c
    return order
