"""Sparse matrices of second derivatives by the coordinates of a mesh's vertices, factorised.

Gaussian elimination by fronts (Duff and Reid 1983, "The multifrontal solution of indefinite sparse
symmetric linear equations"). Vertices with the same neighbours that are eliminated one after the
other form a dense front. What is left of a front when they are gone is added to that of the first
vertex which is eliminated next.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled
from nsm.domains.orbifold.elimination import elimination_order
from nsm.surfaces import topology


class Pattern:
    """Where second derivatives by the coordinates of corners go in a sparse matrix.

    The matrix is symmetric, with two rows and columns for each vertex. Of it there is a panel for
    each front: a row for each coordinate that is eliminated in it, with a column for each of the
    front.

    Args:
        faces: (F, 3) of a closed mesh.
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
        faces, n = local[faces], len(ids)
        number, *self._fronts = _fronts(faces, elimination_order(faces, n))
        self.ids = np.empty_like(ids)
        self.ids[number] = ids
        self.corner = number[faces]
        self.place, self.width = _places(self.corner, *self._fronts[:4])
        self.size = int(self._fronts[3][-1])

    def solution(
        self, panels: np.ndarray, right: np.ndarray, held: np.ndarray
    ) -> np.ndarray | None:
        """Solve for right-hand sides (N, 2), with rows and columns of some vertices replaced by
        those of the identity.

        Args:
            panels: (size,) of the matrix; used up. Nothing is added for these vertices.
            right: in the order of ids.
            held: (V,) mask of these vertices.

        Returns:
            (N, 2); None if the matrix is singular.
        """
        found = right.copy()
        return found if _solve(panels, found, held[self.ids], *self._fronts) else None


@compiled
def _none(n: int) -> np.ndarray:
    """No number yet, (N,)."""
    numbers = np.empty(n, dtype=np.int64)
    for i in range(n):
        numbers[i] = -1
    return numbers


@compiled
def _neighbours(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the neighbours of each vertex begin, (N + 1,), and these, each twice."""
    start = np.zeros(n + 1, dtype=np.int64)
    for f in range(len(faces)):
        for k in range(3):
            start[faces[f, k] + 1] += 2
    for v in range(n):
        start[v + 1] += start[v]
    place, beside = start.copy(), np.empty(6 * len(faces), dtype=np.int64)
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            for turn in (1, 2):
                beside[place[v]] = faces[f, (k + turn) % 3]
                place[v] += 1
    return start, beside


@compiled
def _tree(
    start: np.ndarray, beside: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The elimination tree (Liu 1990, "The role of elimination trees in sparse factorization") for
    vertices in an order: the order (N,) renewed so that those before a vertex that it depends on
    come right before it, the numbers of the vertices in it, and the parent of each number."""
    n = len(order)
    number = np.empty(n, dtype=np.int64)
    for j in range(n):
        number[order[j]] = j
    above, short = _none(n), _none(n)  # short cuts towards the root
    for j in range(n):
        for q in range(start[order[j]], start[order[j] + 1]):
            i = number[beside[q]]
            while i != -1 and i < j:
                following = short[i]
                short[i] = j
                if following == -1:
                    above[i] = j
                i = following
    child, sibling = _none(n), _none(n)
    for j in range(n - 1, -1, -1):
        if above[j] >= 0:
            sibling[j], child[above[j]] = child[above[j]], j
    renewed, stack = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    done = 0
    for root in range(n):
        if above[root] >= 0:
            continue
        stack[0], depth = root, 1
        while depth > 0:
            j = stack[depth - 1]
            if child[j] >= 0:
                stack[depth] = child[j]
                child[j] = sibling[child[j]]
                depth += 1
            else:
                renewed[j] = done
                done += 1
                depth -= 1
    parent, new = _none(n), np.empty(n, dtype=np.int64)
    for j in range(n):
        new[renewed[j]] = order[j]
        if above[j] >= 0:
            parent[renewed[j]] = renewed[above[j]]
    for j in range(n):
        number[new[j]] = j
    return new, number, parent


@compiled
def _fronts(faces: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, ...]:
    """The fronts in which the vertices of faces (F, 3) are eliminated, in about the given order.

    Returns:
        of the vertices their numbers (N,), as they are eliminated; of the fronts (S,) which numbers
        each eliminates, those from begin (S + 1,) on; where its other vertices begin, (S + 1,), and
        these numbers (R,); where its panel begins, (S + 1,); where what is left of it is kept,
        (S,), and first of (2,) how much room that takes; where its other vertices are in the front
        that this is added to, (R,); and the first of the fronts that are added to it, and the next
        of those that are added to the same, (S,).
    """
    n = len(order)
    start, beside = _neighbours(faces, n)
    order, number, parent = _tree(start, beside, order)
    # the vertices that a column of the factorised matrix has rows of: the paths in the tree from
    # the neighbours of each (Gilbert, Ng and Peyton 1994)
    count, mark = np.zeros(n, dtype=np.int64), _none(n)
    for i in range(n):
        for q in range(start[order[i]], start[order[i] + 1]):
            k = number[beside[q]]
            while k < i and mark[k] != i:
                mark[k] = i
                count[k] += 1
                k = parent[k]
    front = np.empty(n, dtype=np.int64)
    is_last = np.empty(n, dtype=np.bool_)
    fronts = 0
    for j in range(n):
        is_last[j] = j + 1 == n or parent[j] != j + 1 or count[j] != count[j + 1] + 1
        front[j] = fronts
        fronts += is_last[j]
    begin, other = np.zeros(fronts + 1, dtype=np.int64), np.zeros(fronts + 1, dtype=np.int64)
    for j in range(n):
        if is_last[j]:
            begin[front[j] + 1] = j + 1
            other[front[j] + 1] = other[front[j]] + count[j]
    row, place = np.empty(other[fronts], dtype=np.int64), other.copy()
    mark = _none(n)
    for i in range(n):
        for q in range(start[order[i]], start[order[i] + 1]):
            k = number[beside[q]]
            while k < i and mark[k] != i:
                mark[k] = i
                if is_last[k]:
                    row[place[front[k]]] = i
                    place[front[k]] += 1
                k = parent[k]
    panel = np.zeros(fronts + 1, dtype=np.int64)
    into, side = _none(fronts), np.zeros(fronts, dtype=np.int64)
    for s in range(fronts):
        own, rest = begin[s + 1] - begin[s], other[s + 1] - other[s]
        panel[s + 1] = panel[s] + 4 * own * (own + rest)
        if rest > 0:
            into[s] = front[row[other[s]]]
    # what is left is kept on two stacks, in turn from front to front up the tree: then a front is
    # made on the one while those that are added to it are taken from the other
    for s in range(fronts - 1, -1, -1):
        if into[s] >= 0:
            side[s] = 1 - side[into[s]]
    top, most = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    kept, below = np.zeros(fronts, dtype=np.int64), _none(fronts)
    relative = np.empty(other[fronts], dtype=np.int64)
    child, sibling = _none(fronts), _none(fronts)
    for s in range(fronts):
        if below[s] >= 0:
            top[1 - side[s]] = below[s]
        kept[s] = top[side[s]]
        top[side[s]] += 4 * (other[s + 1] - other[s]) ** 2
        most[side[s]] = max(most[side[s]], top[side[s]])
        p = into[s]
        if p < 0:
            continue
        if below[p] < 0:
            below[p] = kept[s]
        sibling[s], child[p] = child[p], s
        q = other[p]
        for i in range(other[s], other[s + 1]):
            if row[i] < begin[p + 1]:
                relative[i] = row[i] - begin[p]
                continue
            while row[q] != row[i]:
                q += 1
            relative[i] = begin[p + 1] - begin[p] + q - other[p]
    for s in range(fronts):
        if side[s] == 1:
            kept[s] += most[0]
    most[0] += most[1]
    return number, begin, other, row, panel, kept, most, relative, child, sibling


@compiled
def _places(
    corner: np.ndarray, begin: np.ndarray, other: np.ndarray, row: np.ndarray, panel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Place (F, 3, 3) and width (F, 3), see :class:`Pattern`."""
    front = np.empty(begin[-1], dtype=np.int64)
    for s in range(len(panel) - 1):
        for j in range(begin[s], begin[s + 1]):
            front[j] = s
    place = np.empty((len(corner), 3, 3), dtype=np.int64)
    width = np.empty((len(corner), 3), dtype=np.int64)
    for f in range(len(corner)):
        for m in range(3):
            column = corner[f, m]
            s = front[column]
            own = begin[s + 1] - begin[s]
            width[f, m] = 2 * (own + other[s + 1] - other[s])
            first = panel[s] + 2 * (column - begin[s]) * width[f, m]
            for k in range(3):
                i = corner[f, k]
                place[f, k, m] = -1
                if i < column:
                    continue
                at = i - begin[s]
                if i >= begin[s + 1]:
                    low, high = other[s], other[s + 1]
                    while high - low > 1:
                        middle = (low + high) // 2
                        if row[middle] <= i:
                            low = middle
                        else:
                            high = middle
                    at = own + low - other[s]
                place[f, k, m] = first + 2 * at
    return place, width


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


@compiled
def _solve(
    panels: np.ndarray,
    right: np.ndarray,
    held: np.ndarray,
    begin: np.ndarray,
    other: np.ndarray,
    row: np.ndarray,
    panel: np.ndarray,
    kept: np.ndarray,
    room: np.ndarray,
    relative: np.ndarray,
    child: np.ndarray,
    sibling: np.ndarray,
) -> bool:
    """Replace right-hand sides (N, 2) by the solution; whether there is one."""
    left, pivots = np.empty(room[0]), np.empty(2 * len(right))  # pivots are inverse
    for s in range(len(child)):
        own, rest = 2 * (begin[s + 1] - begin[s]), 2 * (other[s + 1] - other[s])
        width, first, pivot = own + rest, panel[s], pivots[2 * begin[s] : 2 * begin[s + 1]]
        for q in range(own):
            at = first + q * (width + 1)
            panels[at] = 1.0 if held[begin[s] + q // 2] else panels[at] * (1 + 1e-10)
        for at in range(kept[s], kept[s] + rest * rest):
            left[at] = 0.0
        c = child[s]
        while c >= 0:
            columns = relative[other[c] : other[c + 1]]
            _add_left(panels, left, first, own, width, kept[s], kept[c], columns)
            c = sibling[c]
        for q in range(0, own, 2):
            at = first + q * (width + 1)
            _less(panels, first, width, q, q, pivot, panels, at, width)
            pivot[q] = 1 / panels[at]
            factor = panels[at + 1] * pivot[q]
            for r in range(1, width - q):
                panels[at + width + r] -= factor * panels[at + r]
            pivot[q + 1] = 1 / panels[at + width + 1]
            if not (np.isfinite(pivot[q]) and np.isfinite(pivot[q + 1])):
                return False
        for q in range(0, rest, 2):
            at = kept[s] + q * (rest + 1)
            _less(panels, first, width, own, own + q, pivot, left, at, rest)
    for s in range(len(child)):
        own, at = begin[s + 1] - begin[s], panel[s]
        for p in range(2 * own):
            v = begin[s] + p // 2
            factor = right[v, p % 2] * pivots[2 * begin[s] + p]
            if p % 2 == 0:
                right[v, 1] -= factor * panels[at + p + 1]
            for i in range(p // 2 + 1, own):
                right[begin[s] + i, 0] -= factor * panels[at + 2 * i]
                right[begin[s] + i, 1] -= factor * panels[at + 2 * i + 1]
            at += 2 * own
            for i in range(other[s], other[s + 1]):
                right[row[i], 0] -= factor * panels[at]
                right[row[i], 1] -= factor * panels[at + 1]
                at += 2
    for s in range(len(child) - 1, -1, -1):
        own, width = (
            begin[s + 1] - begin[s],
            2 * (begin[s + 1] - begin[s] + other[s + 1] - other[s]),
        )
        for p in range(2 * own - 1, -1, -1):
            v, at = begin[s] + p // 2, panel[s] + p * width
            value = right[v, p % 2]
            if p % 2 == 0:
                value -= panels[at + p + 1] * right[v, 1]
            for i in range(p // 2 + 1, own):
                w = begin[s] + i
                value -= panels[at + 2 * i] * right[w, 0] + panels[at + 2 * i + 1] * right[w, 1]
            at += 2 * own
            for i in range(other[s], other[s + 1]):
                value -= panels[at] * right[row[i], 0] + panels[at + 1] * right[row[i], 1]
                at += 2
            right[v, p % 2] = value * pivots[2 * begin[s] + p]
    return True
