"""The last vertices of a coarse closed mesh drawn together, whatever that does to its shape.

:mod:`nsm.domains.decimation` keeps shapes, so it stops at some hundred triangles on a thin or
bent mesh. What remains here is a handful: no limb is left that an embedding could squeeze.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled
from nsm.domains.decimation import Round


def collapsed(
    vertices: np.ndarray, faces: np.ndarray, held: np.ndarray, count: int
) -> tuple[np.ndarray, list[Round]]:
    """Collapse the shortest edges of a closed mesh (V, 3), (F, 3) until ``count`` faces are left.

    Args:
        held: (V,) mask of vertices that stay.

    Returns:
        the faces, those that are gone with two equal corners, and the rounds.
    """
    faces = faces.copy()
    done, vertex, target, number, start, corners = _collapsed(vertices, faces, held, count)
    rounds = []
    for k in range(int(number[:done].max(initial=-1)) + 1):
        steps = np.flatnonzero(number[:done] == k)
        sizes = start[steps + 1] - start[steps]
        mine = np.concatenate([corners[start[step] : start[step + 1]] for step in steps])
        star = np.repeat(np.arange(len(steps)), sizes)
        rounds.append(Round(vertex[steps], target[steps], np.full(len(steps), -1), mine, star))
    return faces, rounds


@compiled
def _collapsed(
    points: np.ndarray, faces: np.ndarray, held: np.ndarray, count: int
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Collapse edges within the faces (F, 3).

    Returns:
        how many collapses N; and in the first places of arrays, of each (N,) the vertex, what it is
        drawn into, and its round, the first after all that touched its ring; where its corners
        3f + k begin, (N + 1,), and these.
    """
    n, corner = len(points), faces.reshape(-1)
    twin, out, degree = _half_edges(corner, n)
    best, into, mark = np.empty(n), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for v in range(n):
        best[v], into[v], mark[v] = np.inf, -1, -1
    last = np.zeros(n, dtype=np.int64)  # how many rounds touched a vertex or its ring
    for v in range(n):
        if degree[v] > 0 and not held[v]:
            _look(points, corner, twin, out, degree, mark, v, v, best, into)
    looks = n
    vertex, target = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    number, start = np.empty(n, dtype=np.int64), np.zeros(n + 1, dtype=np.int64)
    replaced, near = np.empty(6 * n, dtype=np.int64), np.empty(n, dtype=np.int64)
    left, done = len(faces), 0
    while left > count:
        v = 0
        for u in range(n):
            if best[u] < best[v]:
                v = u
        if not best[v] < np.inf:
            break
        w = into[v]
        first, end = start[done], start[done] + degree[v]
        if end > len(replaced):
            longer = np.empty(2 * end, dtype=np.int64)
            for i in range(first):
                longer[i] = replaced[i]
            replaced = longer
        h = edge = out[v]
        found, round_, looks = 0, last[v], looks + 1
        mark[v] = looks
        for i in range(first, end):
            at = i  # in rising order
            while at > first and replaced[at - 1] > h:
                replaced[at] = replaced[at - 1]
                at -= 1
            replaced[at] = h
            u = corner[_after(h)]
            if u == w:
                edge = h
            near[found], mark[u] = u, looks
            found += 1
            round_ = max(round_, last[u])
            h = twin[_before(h)]
        last[v] = round_ + 1
        for i in range(found):
            last[near[i]] = round_ + 1
        h = out[w]
        for _ in range(degree[w]):
            u = corner[_after(h)]
            if mark[u] != looks:
                near[found], mark[u] = u, looks
                found += 1
            h = twin[_before(h)]
        vertex[done], target[done], number[done], start[done + 1] = v, w, round_, end
        done += 1
        for i in range(first, end):
            corner[replaced[i]] = w
        # the triangles at the edge are gone: what was beyond their other two sides meets
        for h in (edge, twin[edge]):
            following, preceding = twin[_after(h)], twin[_before(h)]
            twin[following], twin[preceding] = preceding, following
            u = corner[_before(h)]
            out[u] = following if corner[following] == u else preceding
            out[w] = preceding if corner[following] == u else following
            degree[u] -= 1
        degree[w] += degree[v] - 4
        degree[v], best[v] = 0, np.inf
        left -= 2
        for i in range(found):
            if not held[near[i]]:
                looks += 1
                _look(points, corner, twin, out, degree, mark, looks, near[i], best, into)
    return done, vertex, target, number, start, replaced


@compiled
def _after(h: int) -> int:
    """The next half-edge around a triangle."""
    return h - 2 if h % 3 == 2 else h + 1


@compiled
def _before(h: int) -> int:
    """The half-edge before one around a triangle."""
    return h + 2 if h % 3 == 0 else h - 1


@compiled
def _half_edges(corner: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each half-edge (3F,), from corner (3F,) to corner of a closed mesh, that between the same
    vertices; of each vertex (V,) one that starts there, and how many do."""
    start = np.zeros(n + 1, dtype=np.int64)
    for h in range(len(corner)):
        start[corner[h] + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    place, around = start.copy(), np.empty(len(corner), dtype=np.int64)
    for h in range(len(corner)):
        around[place[corner[h]]] = h
        place[corner[h]] += 1
    twin = np.empty(len(corner), dtype=np.int64)
    for h in range(len(corner)):
        head = corner[_after(h)]
        for q in range(start[head], start[head + 1]):
            if corner[_after(around[q])] == corner[h]:
                twin[h] = around[q]
    out, degree = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for v in range(n):
        degree[v] = start[v + 1] - start[v]
        out[v] = around[start[v]] if degree[v] > 0 else -1
    return twin, out, degree


@compiled
def _look(
    points: np.ndarray,
    corner: np.ndarray,
    twin: np.ndarray,
    out: np.ndarray,
    degree: np.ndarray,
    mark: np.ndarray,
    number: int,
    v: int,
    best: np.ndarray,
    into: np.ndarray,
) -> None:
    """Find what a vertex is best drawn into, and at what cost; infinite if into nothing.

    Args:
        mark: (V,) of vertices, none of which is the number.
    """
    best[v], into[v] = np.inf, -1
    h = out[v]
    for _ in range(degree[v]):
        mark[corner[_after(h)]] = number
        h = twin[_before(h)]
    for _ in range(degree[v]):
        w = corner[_after(h)]
        h = twin[_before(h)]
        # the link condition, and no vertex with hardly any room around it
        size, common, least = degree[v] + degree[w], 0, 4
        g = out[w]
        for _ in range(degree[w]):
            u = corner[_after(g)]
            if mark[u] == number:
                common += 1
                least = min(least, degree[u])
            g = twin[_before(g)]
        if common != 2 or size < 7 or least < 4:
            continue
        square = 0.0
        for i in range(3):
            square += (points[v, i] - points[w, i]) ** 2
        # vertices of high degree are hard to place again
        cost = np.sqrt(square) * (max(size - 4, 6) / 6)
        if cost < best[v] or (cost == best[v] and w < into[v]):
            best[v], into[v] = cost, w
