"""An order of a mesh's vertices in which elimination fills in little: approximate minimum degree.

Amestoy, Davis and Duff 1996, "An approximate minimum degree ordering algorithm". A vertex that is
eliminated becomes an element: a list of what were its neighbours then, which are neighbours of each
other from then on. Vertices that come to have the same neighbours are eliminated together.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled


@compiled
def elimination_order(faces: np.ndarray, n: int) -> np.ndarray:
    """Vertices (N,) of faces (F, 3) as they are to be eliminated."""
    start, end, beside = _neighbours(faces, n)
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
    for v in range(n - 1, -1, -1):
        tail[v], degree[v] = v, end[v] - start[v]
        _insert(head, before, after, v, degree[v])
    done = step = comparison = least = 0
    while done < n:
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
def _neighbours(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The neighbours of each vertex, from start (N + 1,) to end (N,)."""
    start = np.zeros(n + 1, dtype=np.int64)
    for f in range(len(faces)):
        for k in range(3):
            start[faces[f, k] + 1] += 2
    for v in range(n):
        start[v + 1] += start[v]
    end, beside = np.empty(n, dtype=np.int64), np.empty(start[n], dtype=np.int64)
    for v in range(n):
        end[v] = start[v]
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            for turn in (1, 2):
                w, known = faces[f, (k + turn) % 3], False
                for q in range(start[v], end[v]):
                    known = known or beside[q] == w
                if not known:
                    beside[end[v]] = w
                    end[v] += 1
    return start, end, beside


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
