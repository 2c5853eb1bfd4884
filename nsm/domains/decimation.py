"""Decimation by half-edge collapses that can be undone in the plane.

A collapse moves a vertex onto a neighbour (Hoppe 1996, "Progressive meshes") and leaves a fan of
triangles around it. However the fan is laid out in the plane, as long as it has no flips, the
vertex can be reinserted near the neighbour without flips (Sander et al. 2002, "Signal-specialized
parametrization"). Collapses that do not touch each other form a round, computed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.compiled import compiled
from nsm.domains.sides import ends_of_sides
from nsm.surfaces import topology

# A new triangle's normal may turn by 70°, and its double area over its squared sides (0.29 if they
# are equal) may not be below this and the old one's.
_TURN, _SHAPE = 0.34, 0.03
_MOST_NEIGHBOURS = 12
_FEWEST_ON_BOUNDARY = 32
_LEAST_SHARE = 0.005  # of the vertices: a round that removes fewer is the last


@dataclass(frozen=True)
class Round:
    """Independent collapses of vertices (N,) onto neighbours, target (N,).

    before (N,): of a boundary vertex, its boundary neighbour other than the target; -1 inside.
    corners (M,): the flat indices 3f + k into the faces where a collapsed vertex was replaced by
    its target; star (M,): which of the N collapses each belongs to.
    """

    vertex: np.ndarray
    target: np.ndarray
    before: np.ndarray
    corners: np.ndarray
    star: np.ndarray

    def subset(self, keep: np.ndarray) -> Round:
        """The collapses that a mask (N,) keeps."""
        mine, number = keep[self.star], np.cumsum(keep) - 1
        return Round(
            self.vertex[keep],
            self.target[keep],
            self.before[keep],
            self.corners[mine],
            number[self.star[mine]],
        )


def coarsen(
    vertices: np.ndarray, faces: np.ndarray, held: np.ndarray, count: int
) -> tuple[np.ndarray, list[Round]]:
    """Collapse edges of a mesh (V, 3), (F, 3) until about ``count`` faces are left.

    Remaining vertices do not move. No inner edge comes to join two boundary vertices.

    Args:
        faces: those that are removed already have two equal corners.
        held: (V,) mask of vertices that are not collapsed.

    Returns:
        The faces (F, 3), where removed ones have two equal corners; and the rounds.
    """
    faces, alive = faces.copy(), np.flatnonzero(has_area(faces))
    ids, local = topology.renumbered(faces[alive], len(vertices))
    left = local[faces[alive]]  # the faces that are left, by the numbers of their vertices in ids
    rng = np.random.default_rng(0)
    rounds: list[Round] = []
    while len(alive) > count:
        rings = Rings(left, len(ids))
        # random costs: a collapse that fails in one round is tried differently in the next
        factor = rng.uniform(1.0, 1.7, len(rings.indices))
        arrays = rings.start, rings.indices, rings.on_boundary
        priority, into, before = _collapses(vertices[ids], left, held[ids], *arrays, factor)
        chosen = rings.apart(priority, 2)
        vertex = np.flatnonzero(chosen)
        if len(vertex) < _LEAST_SHARE * len(ids):
            break
        face, k = np.nonzero(chosen[left])
        corners, moved = 3 * alive[face] + k, left[face, k]
        left[face, k] = into[moved]
        faces.ravel()[corners] = ids[into[moved]]
        other = np.where(before[vertex] < 0, -1, ids[before[vertex]])
        star = np.searchsorted(vertex, moved)
        rounds.append(Round(ids[vertex], ids[into[vertex]], other, corners, star))
        keep = has_area(left)
        alive, left = alive[keep], left[keep]
        used, local = topology.renumbered(left, len(ids))
        ids, left = ids[used], local[left]
    return faces, rounds


def undo(faces: np.ndarray, step: Round) -> None:
    """Reinsert a round's vertices into the faces (F, 3), in place."""
    faces.ravel()[step.corners] = step.vertex[step.star]


def finer(faces: np.ndarray, rounds: list[Round], count: int) -> np.ndarray:
    """The faces (F, 3) that :func:`coarsen` would have left for a larger count, by what it left for
    a smaller one."""
    for step in reversed(rounds):
        before = faces.copy()
        undo(before, step)
        if len(present_faces(before)) > count:
            break
        faces = before
    return faces


def present_faces(faces: np.ndarray) -> np.ndarray:
    """Those of the faces (F, 3) that are not removed."""
    return faces[has_area(faces)]


def has_area(faces: np.ndarray) -> np.ndarray:
    """Mask (F,) of the faces (F, 3) that are there: those removed have two equal corners."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


class Rings:
    """The neighbours of each of n vertices, in rising order: indices[start[v] : start[v + 1]].

    Attributes:
        on_boundary: mask of the edges to them that have one face.
    """

    def __init__(self, faces: np.ndarray, n: int) -> None:
        self.start, self.indices, self.on_boundary = _rings(*ends_of_sides(faces, n))

    def apart(self, priority: np.ndarray, distance: int) -> np.ndarray:
        """Mask (N,) of vertices more than ``distance`` (1 or 2) edges apart.

        Those with the lowest finite priority come first. The set need not be maximal.
        """
        return _apart(self.start, self.indices, priority.copy(), distance)


@compiled
def _rings(start: np.ndarray, tails: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See :class:`Rings`; start and tails are those of :func:`ends_of_sides`."""
    n, heads = len(start) - 1, np.empty(len(tails), dtype=np.int64)
    # by their ends, those of each in rising order
    place = start.copy()
    for v in range(n):
        for q in range(start[v], start[v + 1]):
            heads[place[tails[q]]] = v
            place[tails[q]] += 1
    first, count = np.zeros(n + 1, dtype=np.int64), 0
    single = np.empty(start[n], dtype=np.bool_)
    for v in range(n):
        for q in range(start[v], start[v + 1]):
            if count > first[v] and heads[count - 1] == heads[q]:
                single[count - 1] = False
            else:
                heads[count], single[count] = heads[q], True
                count += 1
        first[v + 1] = count
    return first, heads[:count].copy(), single[:count].copy()


@compiled
def _apart(
    start: np.ndarray, indices: np.ndarray, priority: np.ndarray, distance: int
) -> np.ndarray:
    """See :meth:`Rings.apart`; the priorities are used up."""
    n = len(priority)
    chosen = np.zeros(n, dtype=np.bool_)
    lowest, before = np.empty(n), np.empty(n)
    for _ in range(3):
        for v in range(n):
            lowest[v] = priority[v]
        for _ in range(distance):
            for v in range(n):
                before[v] = lowest[v]
            for v in range(n):
                for q in range(start[v], start[v + 1]):
                    lowest[v] = min(lowest[v], before[indices[q]])
        for v in range(n):
            if priority[v] == lowest[v] and priority[v] < np.inf:
                chosen[v] = True
                _bar(start, indices, priority, v, distance)
    return chosen


@compiled
def _bar(
    start: np.ndarray, indices: np.ndarray, priority: np.ndarray, v: int, distance: int
) -> None:
    """Vertices within a distance (1 or 2) of one are not chosen any more."""
    priority[v] = np.inf
    for q in range(start[v], start[v + 1]):
        w = indices[q]
        priority[w] = np.inf
        if distance == 2:
            for r in range(start[w], start[w + 1]):
                priority[indices[r]] = np.inf


@compiled
def _collapses(
    points: np.ndarray,
    faces: np.ndarray,
    held: np.ndarray,
    start: np.ndarray,
    indices: np.ndarray,
    on_boundary: np.ndarray,
    factor: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each vertex, at points (V, 3), may be collapsed onto.

    Args:
        factor: (E,) on the lengths of the edges to neighbours; the shortest of a vertex is taken.

    Returns:
        the costs (V,), infinite where nothing is good; the neighbours (V,) that it would be
        collapsed onto; and of boundary vertices the other boundary neighbour (V,), -1 for none.
    """
    n = len(points)
    boundary, around = np.zeros(n, dtype=np.bool_), 0
    for v in range(n):
        for q in range(start[v], start[v + 1]):
            boundary[v] = boundary[v] or on_boundary[q]
        around += boundary[v]
    into, before = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    priority, mark = np.empty(n), np.empty(n, dtype=np.int64)
    for v in range(n):
        into[v] = before[v] = mark[v] = -1
        priority[v] = np.inf
    for v in range(n):
        if held[v] or (boundary[v] and around <= _FEWEST_ON_BOUNDARY):
            continue
        beside = 0  # neighbours on the boundary
        for q in range(start[v], start[v + 1]):
            beside += boundary[indices[q]]
            mark[indices[q]] = v
        for q in range(start[v], start[v + 1]):
            w = indices[q]
            # inner vertices move onto the boundary only if that makes no chord; boundary ones stay
            # on it
            if boundary[v]:
                allowed = on_boundary[q] and beside == 2
            else:
                allowed = not boundary[w] or beside == 1
            if allowed:
                square = 0.0
                for i in range(3):
                    square += (points[v, i] - points[w, i]) ** 2
                cost = np.sqrt(square) * factor[q]
                if cost < priority[v]:
                    priority[v], into[v] = cost, w
        if into[v] >= 0:
            w, common = into[v], 0
            for q in range(start[w], start[w + 1]):
                common += mark[indices[q]] == v
            crowd = start[v + 1] - start[v] + start[w + 1] - start[w] - 4
            if common != 2 - boundary[v] or crowd > _MOST_NEIGHBOURS:
                priority[v], into[v] = np.inf, -1
        if boundary[v]:
            for q in range(start[v], start[v + 1]):
                if on_boundary[q] and indices[q] != into[v]:
                    before[v] = indices[q]
    bad = _leave_bad_triangles(points, faces, into)
    for v in range(n):
        if bad[v]:
            priority[v] = np.inf
    return priority, into, before


@compiled
def _leave_bad_triangles(points: np.ndarray, faces: np.ndarray, into: np.ndarray) -> np.ndarray:
    """Mask (V,) of vertices at points (V, 3) that leave bad triangles if collapsed onto others,
    ``into`` (V,); -1 for those that stay."""
    result = np.zeros(len(into), dtype=np.bool_)
    old, new = np.empty(5), np.empty(5)
    for f in range(len(faces)):
        known = False
        for k in range(3):
            v, b, c = faces[f, k], faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            w = into[v]
            if w < 0 or w in (b, c) or result[v]:
                continue
            if not known:
                _measure(points, faces[f, 0], faces[f, 1], faces[f, 2], old)
                known = True
            _measure(points, w, b, c, new)
            along = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
            flat = new[4] < min(_SHAPE, old[4])
            result[v] = flat or along < _TURN * new[3] * old[3]
    return result


@compiled
def _measure(points: np.ndarray, a: int, b: int, c: int, into: np.ndarray) -> None:
    """A triangle's normal (3,), its double area, and that over its squared sides, into (5,)."""
    squares = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        uj, uk = points[b, j] - points[a, j], points[b, k] - points[a, k]
        vj, vk = points[c, j] - points[a, j], points[c, k] - points[a, k]
        into[i] = uj * vk - uk * vj
        squares += uj * uj + vj * vj + (vj - uj) * (vj - uj)
    into[3] = np.sqrt(into[0] * into[0] + into[1] * into[1] + into[2] * into[2])
    into[4] = into[3] / squares
