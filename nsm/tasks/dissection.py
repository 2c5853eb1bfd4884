"""An order in which sparse matrices between neighbours of a grid fill in little."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

_FEW = 32  # so few are not divided


def nested_dissection(graph: csr_matrix, place: np.ndarray) -> list[np.ndarray]:
    """Halves of the plane first, what separates them last, and each half likewise (George 1973).

    On grids the factors are about as small as by minimum degree, and most of their entries are in a
    few large dense parts.

    Args:
        graph: (N, N), not zero between neighbours.
        place: (N, 2) coordinates; neighbours need not be near, as across the sides of a torus.

    Returns:
        Parts of the numbers below N, in their order: separators and what is not divided.
    """
    parts: list[np.ndarray] = []
    left = [np.arange(len(place))]
    there = np.zeros(len(place), dtype=bool)
    while left:
        mine = left.pop()
        if len(mine) <= _FEW:
            parts.append(mine)
            continue
        pieces, piece = connected_components(graph[mine][:, mine], directed=False)
        if pieces > 1:  # they would be eliminated in common fronts
            left += [mine[piece == k] for k in range(pieces)]
            continue
        along = place[mine, np.ptp(place[mine], axis=0).argmax()]
        first = along < np.median(along)
        there[mine[~first]] = True
        near = graph[mine[first]]
        beside = np.repeat(np.arange(near.shape[0]), np.diff(near.indptr))[there[near.indices]]
        there[mine[~first]] = False
        between = np.zeros(near.shape[0], dtype=bool)
        between[beside] = True
        # from the last to the first: what separates comes after both halves
        parts.append(mine[first][between])
        left += [mine[first][~between], mine[~first]]
    return parts[::-1]
