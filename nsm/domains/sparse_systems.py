"""Sparse systems of second derivatives by the coordinates of a mesh's vertices, and their solution.

No row is exchanged for another: that suffices for positive definite matrices.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled
from nsm.domains.elimination import fronts
from nsm.surfaces import topology


class Pattern:
    """Where second derivatives by the coordinates of corners go in a sparse matrix.

    The matrix is symmetric, with two rows and columns for each vertex. It is held in the panels of
    :class:`nsm.domains.elimination.Fronts`.

    Args:
        faces: (F, 3).
        count: of the vertices, V.

    Attributes:
        ids: (N,) the vertices that the faces name, as they are eliminated.
        corner: (F, 3) the faces by their numbers in ids.
        place: (F, 3, 3) where in the panels the derivative by the first coordinates of corners k
            and l is. That by the second of k is in the next place, that by the second of l in the
            next row. -1 where corner l is eliminated after k: the matrix is symmetric.
        width: (F, 3) of the rows of the front in which a corner is eliminated.
        size: of all panels.
    """

    def __init__(self, faces: np.ndarray, count: int) -> None:
        ids, local = topology.renumbered(faces, count)
        self._fronts = fronts(local[faces], len(ids))
        number, begin, first, row, _, _, panel, *_ = self._fronts
        self.ids = np.empty_like(ids)
        self.ids[number] = ids
        self.corner = number[local[faces]]
        self.place, self.width = _places(self.corner, begin, first, row, panel)
        self.size = int(panel[-1])

    def solution(
        self, panels: np.ndarray, right: np.ndarray, held: np.ndarray
    ) -> np.ndarray | None:
        """Solve for a right-hand side (N, 2), with rows and columns of some unknowns replaced by
        those of the identity.

        Args:
            panels: (size,) of the matrix; used up. Nothing is in these rows and columns.
            right: in the order of ids.
            held: (N, 2) mask of these unknowns, in that order.

        Returns:
            (N, 2); None if the matrix is singular.
        """
        found = right.copy()
        return (
            found
            if _solve(panels, found.reshape(-1), held.reshape(-1), *self._fronts[1:])
            else None
        )


@compiled
def _places(
    corner: np.ndarray, begin: np.ndarray, first: np.ndarray, row: np.ndarray, panel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Place (F, 3, 3) and width (F, 3), see :class:`Pattern`."""
    front = np.empty(begin[-1], dtype=np.int64)
    for s in range(len(begin) - 1):
        for j in range(begin[s], begin[s + 1]):
            front[j] = s
    place = np.empty((len(corner), 3, 3), dtype=np.int64)
    width = np.empty((len(corner), 3), dtype=np.int64)
    for f in range(len(corner)):
        for m in range(3):
            column = corner[f, m]
            s = front[column]
            width[f, m] = 2 * (first[s + 1] - first[s])
            for k in range(3):
                place[f, k, m] = -1
                if corner[f, k] >= column:
                    low, high = first[s], first[s + 1]
                    while high - low > 1:
                        middle = (low + high) // 2
                        if row[middle] <= corner[f, k]:
                            low = middle
                        else:
                            high = middle
                    at = panel[s] + 2 * (column - begin[s]) * width[f, m]
                    place[f, k, m] = at + 2 * (low - first[s])
    return place, width


@compiled
def _solve(
    panels: np.ndarray,
    right: np.ndarray,
    held: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    row: np.ndarray,
    into: np.ndarray,
    relative: np.ndarray,
    panel: np.ndarray,
    kept: np.ndarray,
    room: np.ndarray,
) -> bool:
    """Replace a right-hand side (2N,) by the solution; whether there is one."""
    left, pivots = np.empty(room[0]), np.empty(len(right))  # pivots are inverse
    child, sibling = np.empty(len(into), dtype=np.int64), np.empty(len(into), dtype=np.int64)
    for s in range(len(into)):
        child[s] = -1
    for s in range(len(into)):
        own, width = 2 * (begin[s + 1] - begin[s]), 2 * (first[s + 1] - first[s])
        rest, pivot = width - own, pivots[2 * begin[s] : 2 * begin[s + 1]]
        for q in range(own):
            at = panel[s] + q * (width + 1)
            panels[at] = 1.0 if held[2 * begin[s] + q] else panels[at] * (1 + 1e-10)
        for at in range(kept[s], kept[s] + rest * rest):
            left[at] = 0.0
        c = child[s]
        while c >= 0:
            columns = relative[first[c] + begin[c + 1] - begin[c] : first[c + 1]]
            _add_left(panels, left, panel[s], own, width, kept[s], kept[c], columns)
            c = sibling[c]
        for q in range(0, width, 2):
            there, at, step = panels, panel[s] + q * (width + 1), width
            if q >= own:
                there, at, step = left, kept[s] + (q - own) * (rest + 1), rest
            _less(panels, panel[s], width, min(q, own), q, pivot, there, at, step)
            if q < own:
                pivot[q] = 1 / panels[at]
                factor = panels[at + 1] * pivot[q]
                for r in range(1, width - q):
                    panels[at + width + r] -= factor * panels[at + r]
                pivot[q + 1] = 1 / panels[at + width + 1]
                if not (np.isfinite(pivot[q]) and np.isfinite(pivot[q + 1])):
                    return False
        if into[s] >= 0:
            sibling[s], child[into[s]] = child[into[s]], s
    for s in range(len(into)):
        width, at = 2 * (first[s + 1] - first[s]), panel[s]
        for j in range(begin[s + 1] - begin[s]):
            v = 2 * (begin[s] + j)
            x = right[v] * pivots[v]
            right[v + 1] -= x * panels[at + 2 * j + 1]
            y = right[v + 1] * pivots[v + 1]
            for i in range(j + 1, first[s + 1] - first[s]):
                w, column = 2 * row[first[s] + i], at + 2 * i
                right[w] -= x * panels[column] + y * panels[column + width]
                right[w + 1] -= x * panels[column + 1] + y * panels[column + width + 1]
            at += 2 * width
    for s in range(len(into) - 1, -1, -1):
        width = 2 * (first[s + 1] - first[s])
        for j in range(begin[s + 1] - begin[s] - 1, -1, -1):
            v, at = 2 * (begin[s] + j), panel[s] + 2 * j * width
            x, y = right[v], right[v + 1]
            for i in range(j + 1, first[s + 1] - first[s]):
                w, column = 2 * row[first[s] + i], at + 2 * i
                x -= panels[column] * right[w] + panels[column + 1] * right[w + 1]
                column += width
                y -= panels[column] * right[w] + panels[column + 1] * right[w + 1]
            right[v + 1] = y * pivots[v + 1]
            right[v] = (x - panels[at + 2 * j + 1] * right[v + 1]) * pivots[v]
    return True


@compiled
def _less(
    panels: np.ndarray,
    first: int,
    width: int,
    count: int,
    column: int,
    pivots: np.ndarray,
    into: np.ndarray,
    at: int,
    step: int,
) -> None:
    """Take from two rows, at a place of an array, what the first rows of a panel take from those of
    a front with columns from ``column`` on; pivots are inverse."""
    n = width - column
    u, v = into[at : at + n], into[at + step : at + step + n]
    p = 0
    while p + 4 <= count:
        o = first + p * width + column
        a, b = panels[o : o + n], panels[o + width : o + width + n]
        o += 2 * width
        c, d = panels[o : o + n], panels[o + width : o + width + n]
        ua, ub = a[0] * pivots[p], b[0] * pivots[p + 1]
        uc, ud = c[0] * pivots[p + 2], d[0] * pivots[p + 3]
        va, vb = a[1] * pivots[p], b[1] * pivots[p + 1]
        vc, vd = c[1] * pivots[p + 2], d[1] * pivots[p + 3]
        for r in range(n):
            u[r] -= ua * a[r] + ub * b[r] + uc * c[r] + ud * d[r]
            v[r] -= va * a[r] + vb * b[r] + vc * c[r] + vd * d[r]
        p += 4
    while p < count:
        o = first + p * width + column
        a, b = panels[o : o + n], panels[o + width : o + width + n]
        ua, ub = a[0] * pivots[p], b[0] * pivots[p + 1]
        va, vb = a[1] * pivots[p], b[1] * pivots[p + 1]
        for r in range(n):
            u[r] -= ua * a[r] + ub * b[r]
            v[r] -= va * a[r] + vb * b[r]
        p += 2


@compiled
def _add_left(
    panels: np.ndarray,
    left: np.ndarray,
    first: int,
    own: int,
    width: int,
    into: int,
    at: int,
    relative: np.ndarray,
) -> None:
    """Add what is left of a front, from a place on, to another: to the panel of that one, where its
    own rows begin, and to what will be left of it, from a place on."""
    count, rest = len(relative), width - own
    for j in range(count):
        for b in range(2):
            to, row = 2 * relative[j] + b, at + (2 * j + b) * 2 * count
            if to < own:
                there, columns = panels, first + to * width
            else:
                there, columns = left, into + (to - own) * rest - own
            for i in range(j, count):
                place = columns + 2 * relative[i]
                there[place] += left[row + 2 * i]
                there[place + 1] += left[row + 2 * i + 1]
