"""Cholesky factors of sparse matrices that share a pattern, by dense fronts.

As in Duff and Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear systems":
the unknowns of a front are eliminated together, and what is left of it is added to that of the
front that follows in the tree. What depends on the pattern alone is done once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix

from nsm.compiled import compiled

_SMALL = 1e-14  # a pivot this small, beside the entry that it comes from, is a rounding error


class Elimination:
    """The fronts in which matrices of one pattern are factorised.

    Front s eliminates one of the given parts of the unknowns. Its own rows of the factor are dense:
    a panel, with columns for these unknowns and for those that come later and are linked to them,
    also through what was eliminated before.

    Args:
        graph: (N, N), with an entry wherever one of the matrices has one, on the diagonal and on
            both sides of it; in canonical format.
        parts: of the numbers below N, in the order of their elimination. Nested dissection
            (:func:`nsm.tasks.dissection.nested_dissection`) makes the factors small.

    Attributes:
        order: (N,) the unknowns, as they are eliminated.
        size: of all panels, entries below the diagonal included.
    """

    def __init__(self, graph: csr_matrix, parts: Sequence[np.ndarray]) -> None:
        parts = [part for part in parts if len(part)]
        self.order = np.concatenate(parts)
        number = np.empty_like(self.order)
        number[self.order] = np.arange(len(number))
        self._begin = np.cumsum([0, *map(len, parts)])
        rows, children = self._fronts(graph[self.order], number)
        self._row = np.concatenate(rows)
        self._first = np.cumsum([0, *map(len, rows)])
        own, width = np.diff(self._begin), np.diff(self._first)
        self._panel = np.concatenate([[0], np.cumsum(own * width)])
        self.size = int(self._panel[-1])
        self._into, self._relative = np.full(len(parts), -1), np.zeros_like(self._row)
        # What is left is kept on two stacks, in turn from front to front up the tree: so a front
        # is made on the one while its children, which go up in it, are on the other. Each begins
        # where those on its stack end that wait for a front further up.
        self._kept, side, height = np.zeros_like(own), np.zeros_like(own), np.zeros(2, dtype=int)
        for s in range(len(parts) - 1, -1, -1):
            top = self._kept[self._into[s]] if self._into[s] >= 0 else 0
            for c in children[s]:
                self._into[c], side[c], self._kept[c] = s, 1 - side[s], top
                top += (width[c] - own[c]) ** 2
                left = slice(self._first[c] + own[c], self._first[c + 1])
                self._relative[left] = np.searchsorted(rows[s], self._row[left])
            height[1 - side[s]] = max(height[1 - side[s]], top)
        self._kept += side * height[0]
        self._room = int(height.sum())
        start, columns = graph.indptr.astype(np.int64), number[graph.indices]
        self._place = _places(start, columns, number, self._begin, self._first, self._row)

    def _fronts(
        self, graph: csr_matrix, number: np.ndarray
    ) -> tuple[list[np.ndarray], list[list[int]]]:
        """For each front the unknowns of its columns, by their numbers, and which fronts are added
        to it; of a graph with its rows in order."""
        begin = self._begin
        rows: list[np.ndarray] = []
        children: list[list[int]] = []
        waiting: list[int] = []
        for s in range(len(begin) - 1):
            low, high = begin[s : s + 2]
            # from the first that it eliminates unknowns of: those behind may as well go up in it,
            # and then the last that wait are always the first that are wanted
            fitting = (k for k, c in enumerate(waiting) if rows[c][begin[c + 1] - begin[c]] < high)
            since = next(fitting, len(waiting))
            children.append(waiting[since:])
            del waiting[since:]
            linked = [number[graph.indices[graph.indptr[low] : graph.indptr[high]]]]
            linked += [rows[c] for c in children[s]]
            later = np.unique(np.concatenate(linked))
            later = later[later >= high]
            rows.append(np.concatenate([np.arange(low, high), later]))
            if len(later):
                waiting.append(s)
        return rows, children

    def factors(self, entries: np.ndarray) -> Factors:
        """Factorise a matrix.

        Args:
            entries: (nnz,) of a symmetric positive definite matrix, where the graph has its own.
                Where one is not positive definite, a pivot comes out that is not positive, or is a
                mere rounding error. Such an unknown is left to its entry on the diagonal alone, or
                to 1 if that is not positive either: so the factors are always those of a positive
                definite matrix.
        """
        panels = np.zeros(self.size)
        _put(panels, entries, self._place)
        shape = self._begin, self._first, self._panel
        _factorise(panels, *shape, self._into, self._relative, self._kept, self._room)
        return Factors(self.order, panels, (*shape, self._row))


class Factors:
    """The Cholesky factors of a matrix, made by :meth:`Elimination.factors`."""

    def __init__(
        self, order: np.ndarray, panels: np.ndarray, shape: tuple[np.ndarray, ...]
    ) -> None:
        self._order, self._panels, self._shape = order, panels, shape

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse of the matrix times (N,)."""
        x, result = right[self._order], np.empty(len(right))
        _solve(self._panels, x, *self._shape)
        result[self._order] = x
        return result


@compiled
def _places(
    start: np.ndarray,
    columns: np.ndarray,
    number: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    row: np.ndarray,
) -> np.ndarray:
    """Where in the panels the entries of a graph go, (nnz,); -1 for those below the diagonal."""
    unknown, place = np.empty_like(number), np.empty_like(columns)
    for i in range(len(number)):
        unknown[number[i]] = i
    column_of, panel = np.empty_like(number), 0
    for s in range(len(begin) - 1):
        width = first[s + 1] - first[s]
        for q in range(width):
            column_of[row[first[s] + q]] = q
        for j in range(begin[s], begin[s + 1]):
            for p in range(start[unknown[j]], start[unknown[j] + 1]):
                place[p] = panel + column_of[columns[p]] if columns[p] >= j else -1
            panel += width
    return place


@compiled
def _put(panels: np.ndarray, entries: np.ndarray, place: np.ndarray) -> None:
    for p in range(len(place)):
        if place[p] >= 0:
            panels[place[p]] = entries[p]


@compiled
def _factorise(
    panels: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    panel: np.ndarray,
    into: np.ndarray,
    relative: np.ndarray,
    kept: np.ndarray,
    room: int,
) -> None:
    """Replace a matrix, in its panels, by the upper factor, with inverse pivots."""
    left, given = np.empty(room), np.empty(begin[-1])
    child, sibling = np.full(len(into), -1), np.full(len(into), -1)
    for s in range(len(into)):
        own, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rest = width - own
        for q in range(own):
            given[begin[s] + q] = panels[panel[s] + q * (width + 1)]
        for i in range(rest):
            for at in range(kept[s] + i * (rest + 1), kept[s] + (i + 1) * rest):
                left[at] = 0.0
        c = child[s]
        while c >= 0:
            columns = relative[first[c] + begin[c + 1] - begin[c] : first[c + 1]]
            for i in range(len(columns)):
                source = left[kept[c] + i * len(columns) : kept[c] + (i + 1) * len(columns)]
                if columns[i] < own:
                    at = panel[s] + columns[i] * width
                    there = panels[at : at + width]
                    for j in range(i, len(columns)):
                        there[columns[j]] += source[j]
                else:
                    at = kept[s] + (columns[i] - own) * rest
                    there = left[at : at + rest]
                    for j in range(i, len(columns)):
                        there[columns[j] - own] += source[j]
            c = sibling[c]
        for block in range(0, own, 8):
            above, count = panel[s] + block * width, min(8, own - block)
            for q in range(block, block + count):
                u = panels[panel[s] + q * (width + 1) : panel[s] + (q + 1) * width]
                _less(u, panels, above + q, width, q - block)
                whole = given[begin[s] + q]
                if u[0] > _SMALL * whole:
                    inverse = 1 / np.sqrt(u[0])
                    u[0] = inverse
                    for r in range(1, width - q):
                        u[r] *= inverse
                else:
                    u[0] = 1 / np.sqrt(whole) if whole > 0 else 1.0
                    for r in range(1, width - q):
                        u[r] = 0.0
            for q in range(block + count, own):
                u = panels[panel[s] + q * (width + 1) : panel[s] + (q + 1) * width]
                _less(u, panels, above + q, width, count)
            for q in range(rest):
                u = left[kept[s] + q * (rest + 1) : kept[s] + (q + 1) * rest]
                _less(u, panels, above + own + q, width, count)
        if into[s] >= 0:
            sibling[s], child[into[s]] = child[into[s]], s


@compiled
def _less(u: np.ndarray, panels: np.ndarray, at: int, width: int, count: int) -> None:
    """Take from the row of a pivot what up to 8 rows of a panel take: those from a place on, where
    the first has its entry in the pivot's column."""
    n = len(u)
    if count == 8:  # the others are few
        a, b = panels[at : at + n], panels[at + width : at + width + n]
        at += 2 * width
        c, d = panels[at : at + n], panels[at + width : at + width + n]
        at += 2 * width
        e, f = panels[at : at + n], panels[at + width : at + width + n]
        at += 2 * width
        g, h = panels[at : at + n], panels[at + width : at + width + n]
        ua, ub, uc, ud, ue, uf, ug, uh = a[0], b[0], c[0], d[0], e[0], f[0], g[0], h[0]
        for r in range(n):
            first = ua * a[r] + ub * b[r] + uc * c[r] + ud * d[r]
            u[r] -= first + (ue * e[r] + uf * f[r] + ug * g[r] + uh * h[r])
        return
    if count >= 4:
        a, b = panels[at : at + n], panels[at + width : at + width + n]
        at += 2 * width
        c, d = panels[at : at + n], panels[at + width : at + width + n]
        at += 2 * width
        ua, ub, uc, ud = a[0], b[0], c[0], d[0]
        for r in range(n):
            u[r] -= ua * a[r] + ub * b[r] + uc * c[r] + ud * d[r]
    for _ in range(count % 4):
        a = panels[at : at + n]
        ua = a[0]
        for r in range(n):
            u[r] -= ua * a[r]
        at += width


@compiled
def _solve(
    panels: np.ndarray,
    x: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    panel: np.ndarray,
    row: np.ndarray,
) -> None:
    """Replace a right-hand side (N,) by the solution."""
    y = np.empty(len(x))  # of a front
    for s in range(len(begin) - 1):
        own, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rows, q = row[first[s] : first[s + 1]], 0
        for r in range(width):
            y[r] = x[rows[r]]
        while q < own:
            at = panel[s] + q * width
            if q + 4 <= own:
                a, b = panels[at : at + width], panels[at + width : at + 2 * width]
                at += 2 * width
                c, d = panels[at : at + width], panels[at + width : at + 2 * width]
                ya = y[q] * a[q]
                yb = (y[q + 1] - ya * a[q + 1]) * b[q + 1]
                yc = (y[q + 2] - ya * a[q + 2] - yb * b[q + 2]) * c[q + 2]
                yd = (y[q + 3] - ya * a[q + 3] - yb * b[q + 3] - yc * c[q + 3]) * d[q + 3]
                y[q], y[q + 1], y[q + 2], y[q + 3] = ya, yb, yc, yd
                for r in range(q + 4, width):
                    y[r] -= ya * a[r] + yb * b[r] + yc * c[r] + yd * d[r]
                q += 4
            else:
                y[q] *= panels[at + q]
                for r in range(q + 1, width):
                    y[r] -= y[q] * panels[at + r]
                q += 1
        for r in range(width):
            x[rows[r]] = y[r]
    for s in range(len(begin) - 2, -1, -1):
        q, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rows = row[first[s] : first[s + 1]]
        for r in range(width):
            y[r] = x[rows[r]]
        while q > 0:
            if q >= 4:
                q -= 4
                at = panel[s] + q * width
                a, b = panels[at : at + width], panels[at + width : at + 2 * width]
                at += 2 * width
                c, d = panels[at : at + width], panels[at + width : at + 2 * width]
                ya, yb, yc, yd = y[q], y[q + 1], y[q + 2], y[q + 3]
                for r in range(q + 4, width):
                    ya -= a[r] * y[r]
                    yb -= b[r] * y[r]
                    yc -= c[r] * y[r]
                    yd -= d[r] * y[r]
                yd *= d[q + 3]
                yc = (yc - c[q + 3] * yd) * c[q + 2]
                yb = (yb - b[q + 3] * yd - b[q + 2] * yc) * b[q + 1]
                ya = (ya - a[q + 3] * yd - a[q + 2] * yc - a[q + 1] * yb) * a[q]
                y[q], y[q + 1], y[q + 2], y[q + 3] = ya, yb, yc, yd
            else:
                q -= 1
                at = panel[s] + q * width
                for r in range(q + 1, width):
                    y[q] -= panels[at + r] * y[r]
                y[q] *= panels[at + q]
        for r in range(begin[s + 1] - begin[s]):
            x[rows[r]] = y[r]
