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

    Front s eliminates one of the given parts of the unknowns. Its own rows are dense: a panel, with
    columns for these unknowns and for those that come later and are linked to them, also through
    what was eliminated before.

    Args:
        graph: (N, N), with an entry wherever one of the matrices has one, on the diagonal and on
            both sides of it; in canonical format.
        parts: of the numbers below N, in the order of their elimination. Nested dissection
            (:func:`nsm.tasks.dissection.nested_dissection`) makes the factors small.

    Attributes:
        order: (N,) the unknowns, as they are eliminated.
        size: how many entries the factors have.
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
        self.size = int((own * width - own * (own - 1) // 2).sum())
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
        self._room = np.array([height.sum(), (own * width).max()])
        self._start, columns = graph.indptr.astype(np.int64), number[graph.indices]
        shape = self._begin, self._first, self._row
        self._place = _places(self._start, columns, self.order, *shape)

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
        rows = np.empty(self.size)
        matrix = entries, self._start, self._place, self.order
        tree = self._begin, self._first, self._into, self._relative, self._kept, self._room
        _factorise(rows, *matrix, *tree)
        return Factors(rows, self.order, self._begin, self._first, self._row)


class Factors:
    """The Cholesky factors of a matrix, made by :meth:`Elimination.factors`."""

    def __init__(self, rows: np.ndarray, order: np.ndarray, *fronts: np.ndarray) -> None:
        self._rows, self._order, self._fronts = rows, order, fronts

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse of the matrix times (N,)."""
        x, result = right[self._order], np.empty(len(right))
        _solve(self._rows, x, *self._fronts)
        result[self._order] = x
        return result


@compiled
def _places(
    start: np.ndarray,
    columns: np.ndarray,
    order: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    row: np.ndarray,
) -> np.ndarray:
    """Where in the panel of their front the entries of a graph go, (nnz,); -1 for those below the
    diagonal."""
    place, column_of = np.empty_like(columns), np.empty_like(order)
    for s in range(len(begin) - 1):
        width = first[s + 1] - first[s]
        for q in range(width):
            column_of[row[first[s] + q]] = q
        for j in range(begin[s], begin[s + 1]):
            at = (j - begin[s]) * width
            for p in range(start[order[j]], start[order[j] + 1]):
                place[p] = at + column_of[columns[p]] if columns[p] >= j else -1
    return place


@compiled
def _factorise(
    factor: np.ndarray,
    entries: np.ndarray,
    start: np.ndarray,
    place: np.ndarray,
    order: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    into: np.ndarray,
    relative: np.ndarray,
    kept: np.ndarray,
    room: np.ndarray,
) -> None:
    """Fill in the rows of the upper factor one after the other, each from its pivot on, which is
    inverse."""
    left, panel, done = np.empty(room[0]), np.empty(room[1]), 0
    given = np.empty(len(order))
    child, sibling = np.full(len(into), -1), np.full(len(into), -1)
    for s in range(len(into)):
        own, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rest = width - own
        for at in range(own * width):
            panel[at] = 0.0
        for q in range(own):
            unknown = order[begin[s] + q]
            for p in range(start[unknown], start[unknown + 1]):
                if place[p] >= 0:
                    panel[place[p]] = entries[p]
            given[q] = panel[q * (width + 1)]
        for i in range(rest):
            for at in range(kept[s] + i * (rest + 1), kept[s] + (i + 1) * rest):
                left[at] = 0.0
        c = child[s]
        while c >= 0:
            columns = relative[first[c] + begin[c + 1] - begin[c] : first[c + 1]]
            for i in range(len(columns)):
                source = left[kept[c] + i * len(columns) : kept[c] + (i + 1) * len(columns)]
                if columns[i] < own:
                    there = panel[columns[i] * width : (columns[i] + 1) * width]
                    for j in range(i, len(columns)):
                        there[columns[j]] += source[j]
                else:
                    at = kept[s] + (columns[i] - own) * rest
                    there = left[at : at + rest]
                    for j in range(i, len(columns)):
                        there[columns[j] - own] += source[j]
            c = sibling[c]
        for block in range(0, own, 8):
            above, count = block * width, min(8, own - block)
            for q in range(block, block + count):
                u = panel[q * (width + 1) : (q + 1) * width]
                _less(u, panel, above + q, width, q - block)
                if u[0] > _SMALL * given[q]:
                    inverse = 1 / np.sqrt(u[0])
                    u[0] = inverse
                    for r in range(1, len(u)):
                        u[r] *= inverse
                else:
                    u[0] = 1 / np.sqrt(given[q]) if given[q] > 0 else 1.0
                    for r in range(1, len(u)):
                        u[r] = 0.0
                for r in range(len(u)):
                    factor[done + r] = u[r]
                done += len(u)
            for q in range(block + count, own):
                u = panel[q * (width + 1) : (q + 1) * width]
                _less(u, panel, above + q, width, count)
            for q in range(rest):
                u = left[kept[s] + q * (rest + 1) : kept[s] + (q + 1) * rest]
                _less(u, panel, above + own + q, width, count)
        if into[s] >= 0:
            sibling[s], child[into[s]] = child[into[s]], s


@compiled
def _less(u: np.ndarray, panel: np.ndarray, at: int, width: int, count: int) -> None:
    """Take from the row of a pivot what up to 8 rows of a panel take: those from a place on, where
    the first has its entry in the pivot's column."""
    n = len(u)
    if count == 8:  # the others are few
        a, b = panel[at : at + n], panel[at + width : at + width + n]
        at += 2 * width
        c, d = panel[at : at + n], panel[at + width : at + width + n]
        at += 2 * width
        e, f = panel[at : at + n], panel[at + width : at + width + n]
        at += 2 * width
        g, h = panel[at : at + n], panel[at + width : at + width + n]
        ua, ub, uc, ud, ue, uf, ug, uh = a[0], b[0], c[0], d[0], e[0], f[0], g[0], h[0]
        for r in range(n):
            first = ua * a[r] + ub * b[r] + uc * c[r] + ud * d[r]
            u[r] -= first + (ue * e[r] + uf * f[r] + ug * g[r] + uh * h[r])
        return
    if count >= 4:
        a, b = panel[at : at + n], panel[at + width : at + width + n]
        at += 2 * width
        c, d = panel[at : at + n], panel[at + width : at + width + n]
        at += 2 * width
        ua, ub, uc, ud = a[0], b[0], c[0], d[0]
        for r in range(n):
            u[r] -= ua * a[r] + ub * b[r] + uc * c[r] + ud * d[r]
    for _ in range(count % 4):
        a = panel[at : at + n]
        ua = a[0]
        for r in range(n):
            u[r] -= ua * a[r]
        at += width


@compiled
def _solve(
    factor: np.ndarray,
    x: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    row: np.ndarray,
) -> None:
    """Replace a right-hand side (N,) by the solution.

    The factor is read in one go, forth and back: that is as fast as memory is.
    """
    y, at = np.empty(len(x)), 0  # y: of a front
    for s in range(len(begin) - 1):
        own, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rows = row[first[s] : first[s + 1]]
        for r in range(width):
            y[r] = x[rows[r]]
        for q in range(own):
            z, u = y[q:width], factor[at : at + width - q]
            value = z[0] * u[0]
            for r in range(1, len(z)):
                z[r] -= value * u[r]
            z[0] = value
            at += len(z)
        for r in range(width):
            x[rows[r]] = y[r]
    for s in range(len(begin) - 2, -1, -1):
        own, width = begin[s + 1] - begin[s], first[s + 1] - first[s]
        rows = row[first[s] : first[s + 1]]
        for r in range(width):
            y[r] = x[rows[r]]
        for q in range(own - 1, -1, -1):
            z, n = y[q:width], width - q
            at -= n
            u = factor[at : at + n]
            # eight sums at once: one would wait for each of its additions
            a = b = c = d = e = f = g = h = 0.0
            for k in range((n - 1) // 8):
                v, w = u[n - 8 * k - 8 : n - 8 * k], z[n - 8 * k - 8 : n - 8 * k]
                a += v[0] * w[0]
                b += v[1] * w[1]
                c += v[2] * w[2]
                d += v[3] * w[3]
                e += v[4] * w[4]
                f += v[5] * w[5]
                g += v[6] * w[6]
                h += v[7] * w[7]
            value = z[0] - ((a + b) + (c + d)) - ((e + f) + (g + h))
            for r in range(1, n - 8 * ((n - 1) // 8)):
                value -= u[r] * z[r]
            z[0] = value * u[0]
        for r in range(own):
            x[rows[r]] = y[r]
