"""In which order, and in which dense parts, the unknowns of a mesh's vertices are eliminated.

Little is filled in where vertices with few neighbours go first (Amestoy, Davis and Duff 1996, "An
approximate minimum degree ordering algorithm"). Gaussian elimination is done by fronts (Duff and
Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear equations"): what is
left of a front, when its vertices are gone, is added to that of the first vertex that follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nsm.compiled import compiled
from nsm.domains.sides import ends_of_sides


class Fronts(NamedTuple):
    """Sets of vertices that are eliminated one after the other, each with the same neighbours left.

    Attributes:
        number: (N,) of the vertices, as they are eliminated.
        begin: (S + 1,) the first number that each of the fronts eliminates.
        first: (S + 1,) where its vertices begin.
        row: (R,) these, by their numbers, which rise: those that it eliminates and the neighbours
            that are left.
        into: (S,) the front that what is left of it is added to; -1 for none.
        relative: (R,) where vertices that are left are in that front.
        panel: (S + 1,) where its panel begins, a row for each coordinate of vertices that it
            eliminates, with a column for each of all its vertices.
        kept: (S,) where what is left of it is kept.
        room: first of (2,), what all that is left takes.
    """

    number: np.ndarray
    begin: np.ndarray
    first: np.ndarray
    row: np.ndarray
    into: np.ndarray
    relative: np.ndarray
    panel: np.ndarray
    kept: np.ndarray
    room: np.ndarray


def fronts(faces: np.ndarray, n: int) -> Fronts:
    """Those of the vertices (N,) of faces (F, 3), in an order in which little is filled in."""
    start, beside = ends_of_sides(faces, n)
    end = _each_once(start, beside)
    order = _elimination_order(start, end.copy(), beside.copy())
    return Fronts(*_fronts(start, end, beside, order))


@compiled
def _fronts(
    start: np.ndarray, end: np.ndarray, beside: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, ...]:
    """The fronts for vertices with neighbours that are eliminated in about the given order."""
    n = len(order)
    order, number, parent = _tree(start, end, beside, order)
    # the vertices that a column of the factorised matrix has rows of: the paths in the tree from
    # the neighbours of each (Gilbert, Ng and Peyton 1994)
    count, mark = np.zeros(n, dtype=np.int64), _none(2 * n)
    for i in range(n):
        for q in range(start[order[i]], end[order[i]]):
            k = number[beside[q]]
            while k < i and mark[k] != i:
                mark[k] = i
                count[k] += 1
                k = parent[k]
    of, begin, first = _none(n), np.zeros(n + 1, dtype=np.int64), np.zeros(n + 1, dtype=np.int64)
    fronts = 0
    for j in range(n):
        of[j] = fronts
        if j + 1 == n or parent[j] != j + 1 or count[j] != count[j + 1] + 1:
            begin[fronts + 1] = j + 1
            first[fronts + 1] = first[fronts] + j + 1 - begin[fronts] + count[j]
            fronts += 1
    row, place = np.empty(first[fronts], dtype=np.int64), first.copy()
    for i in range(n):
        row[place[of[i]]] = i
        place[of[i]] += 1
        for q in range(start[order[i]], end[order[i]]):
            k = number[beside[q]]
            while k < i and mark[n + k] != i:
                mark[n + k] = i
                if k + 1 == begin[of[k] + 1] and of[i] != of[k]:
                    row[place[of[k]]] = i
                    place[of[k]] += 1
                k = parent[k]
    panel, into = np.zeros(fronts + 1, dtype=np.int64), _none(fronts)
    # what is left is kept on two stacks, in turn from front to front up the tree: then a front is
    # made on the one while those that are added to it are taken from the other
    side, below = np.zeros(fronts, dtype=np.int64), _none(fronts)
    for s in range(fronts - 1, -1, -1):
        rest = first[s] + begin[s + 1] - begin[s]
        if rest < first[s + 1]:
            into[s] = of[row[rest]]
            side[s] = 1 - side[into[s]]
    top, most = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    kept, relative = np.empty(fronts, dtype=np.int64), np.empty(first[fronts], dtype=np.int64)
    for s in range(fronts):
        own, whole = begin[s + 1] - begin[s], first[s + 1] - first[s]
        panel[s + 1] = panel[s] + 4 * own * whole
        if below[s] >= 0:
            top[1 - side[s]] = below[s]
        kept[s] = top[side[s]]
        top[side[s]] += 4 * (whole - own) ** 2
        most[side[s]] = max(most[side[s]], top[side[s]])
        if into[s] >= 0:
            if below[into[s]] < 0:
                below[into[s]] = kept[s]
            q = first[into[s]]
            for i in range(first[s] + own, first[s + 1]):
                while row[q] != row[i]:
                    q += 1
                relative[i] = q - first[into[s]]
    for s in range(fronts):
        kept[s] += side[s] * most[0]
    most[0] += most[1]
    return number, begin[: fronts + 1], first[: fronts + 1], row, into, relative, panel, kept, most


@compiled
def _tree(
    start: np.ndarray, end: np.ndarray, beside: np.ndarray, order: np.ndarray
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
        for q in range(start[order[j]], end[order[j]]):
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
def _elimination_order(start: np.ndarray, end: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Vertices (N,) with neighbours as they are to be eliminated; end and neighbours are used up.

    Approximate minimum degree. A vertex that is eliminated becomes an element: a list of what were
    its neighbours then, which are neighbours of each other from then on. Vertices that come to have
    the same neighbours are eliminated together.
    """
    n = len(end)
    # beside a vertex are first its elements, so many, then neighbours that are in none of these
    elements = np.zeros(n, dtype=np.int64)
    # how many vertices one stands for; 0 if it is eliminated, or another one stands for it
    count, behind, tail = np.ones(n, dtype=np.int64), _none(n), _none(n)
    # where the members of an element are, how many vertices these stand for, and for how many those
    # that are not in the latest element
    first, last = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    whole, outside = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    members, used = np.empty(16 * n, dtype=np.int64), 0
    # lists of the vertices of each degree, and of those of each sum of the numbers beside them
    degree, head, before, after = np.empty(n, dtype=np.int64), _none(n), _none(n), _none(n)
    code, bucket, following = np.zeros(n, dtype=np.int64), _none(n), _none(n)
    mark, seen, found = (
        np.zeros(n, dtype=np.int64),
        np.zeros(n, dtype=np.int64),
        np.zeros(n, dtype=np.int64),
    )
    order, kept = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    left = n
    for v in range(n - 1, -1, -1):
        tail[v], degree[v] = v, end[v] - start[v]
        if degree[v] > 16 + 10 * np.sqrt(n):  # the last: to count its neighbours takes long
            count[v] = 0
            left -= 1
            order[left] = v
        else:
            _insert(head, before, after, v, degree[v])
    done = step = comparison = least = 0
    while done < left:
        step += 1
        while head[least] < 0:
            least += 1
        v = head[least]
        _remove(head, before, after, v, least)
        w = v
        while w >= 0:
            order[done] = w
            done += 1
            w = behind[w]
        if used + n > len(members):
            longer = np.empty(2 * len(members) + n, dtype=np.int64)
            for p in range(used):
                longer[p] = members[p]
            members = longer
        # the new element: neighbours, and members of the elements, which go up in it
        count[v], first[v] = 0, used
        for q in range(start[v], end[v]):
            e = beside[q]
            is_element = q < start[v] + elements[v]
            for p in range(first[e], last[e] if is_element else first[e] + 1):
                u = members[p] if is_element else e
                if count[u] > 0 and mark[u] != step:
                    mark[u], members[used] = step, u
                    used += 1
                    whole[v] += count[u]
            if is_element:
                whole[e] = 0
        last[v] = used
        for p in range(first[v], used):
            u = members[p]
            for q in range(start[u], start[u] + elements[u]):
                e = beside[q]
                if seen[e] != step:
                    seen[e], outside[e] = step, whole[e]
                outside[e] -= count[u]
        for p in range(first[v], used):
            u = members[p]
            place, others, bound, total = start[u], 0, whole[v] - count[u], v
            for q in range(start[u], end[u]):
                e = beside[q]
                if q < start[u] + elements[u]:
                    if whole[e] > 0 and outside[e] > 0:  # not a part of the new one
                        beside[place] = e
                        place += 1
                        bound += outside[e]
                        total += e
                elif count[e] > 0 and mark[e] != step:
                    kept[others] = e
                    others += 1
                    bound += count[e]
                    total += e
            elements[u] = place + 1 - start[u]
            beside[place] = v
            for q in range(others):
                beside[place + 1 + q] = kept[q]
            end[u] = place + 1 + others
            _remove(head, before, after, u, degree[u])
            degree[u] = min(degree[u] + whole[v] - count[u], bound, n - done - count[u])
            _insert(head, before, after, u, degree[u])
            least = min(least, degree[u])
            code[u] = total % n
            following[u], bucket[code[u]] = bucket[code[u]], u
        for p in range(first[v], used):
            u = bucket[code[members[p]]]
            bucket[code[members[p]]] = -1
            while u >= 0:
                comparison += 1
                for q in range(start[u], end[u]):
                    found[beside[q]] = comparison
                previous, w = u, following[u]
                while w >= 0:
                    alike = elements[w] == elements[u] and end[w] - start[w] == end[u] - start[u]
                    for q in range(start[w], end[w]):
                        alike = alike and found[beside[q]] == comparison
                    if alike:  # u stands for w
                        behind[tail[u]], tail[u] = w, tail[w]
                        _remove(head, before, after, w, degree[w])
                        _remove(head, before, after, u, degree[u])
                        degree[u] -= count[w]
                        _insert(head, before, after, u, degree[u])
                        least = min(least, degree[u])
                        count[u] += count[w]
                        count[w] = 0
                        following[previous] = following[w]
                    else:
                        previous = w
                    w = following[w]
                u = following[u]
    return order


@compiled
def _none(n: int) -> np.ndarray:
    """No number yet, (N,)."""
    numbers = np.empty(n, dtype=np.int64)
    for i in range(n):
        numbers[i] = -1
    return numbers


@compiled
def _each_once(start: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Keep each neighbour of a vertex once, in the first of its places; where they end, (N,)."""
    n = len(start) - 1
    end, mark = np.empty(n, dtype=np.int64), _none(n)
    for v in range(n):
        end[v] = start[v]
        for q in range(start[v], start[v + 1]):
            w = beside[q]
            if mark[w] != v:
                mark[w], beside[end[v]] = v, w
                end[v] += 1
    return end


@compiled
def _insert(head: np.ndarray, before: np.ndarray, after: np.ndarray, v: int, degree: int) -> None:
    """Put a vertex in the list of a degree."""
    before[v], after[v] = -1, head[degree]
    if head[degree] >= 0:
        before[head[degree]] = v
    head[degree] = v


@compiled
def _remove(head: np.ndarray, before: np.ndarray, after: np.ndarray, v: int, degree: int) -> None:
    """Take a vertex out of the list of a degree."""
    if before[v] >= 0:
        after[before[v]] = after[v]
    else:
        head[degree] = after[v]
    if after[v] >= 0:
        before[after[v]] = before[v]
