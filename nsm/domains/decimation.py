"""Decimation by half-edge collapses that can be undone in the plane.

A collapse moves a vertex onto a neighbour (Hoppe 1996, "Progressive meshes") and leaves a fan of
triangles around it. However the fan is laid out in the plane, as long as it has no flips, the
vertex can be reinserted near the neighbour without flips (Sander et al. 2002, "Signal-specialized
parametrization"). Collapses that do not touch each other form a round, computed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

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
    """Collapse edges of a disc-shaped mesh (V, 3), (F, 3) until about ``count`` faces are left.

    Remaining vertices do not move. No inner edge comes to join two boundary vertices.

    Args:
        held: (V,) mask of vertices that are not collapsed.

    Returns:
        The faces (F, 3), where removed ones have two equal corners; and the rounds.
    """
    faces, flat, places = faces.copy(), np.arange(3), np.ascontiguousarray(vertices.T)
    alive = np.arange(len(faces))
    rng = np.random.default_rng(0)
    rounds: list[Round] = []
    while len(alive) > count:
        present = faces[alive]
        ids, local = topology.renumbered(present, len(vertices))
        vertex, target, before = _collapses(
            places.take(ids, axis=1), local[present], held[ids], rng
        )
        if len(vertex) < _LEAST_SHARE * len(ids):
            break
        number = np.full(len(vertices), -1)
        number[ids[vertex]] = np.arange(len(vertex))
        star = number[present]
        touched = star >= 0
        corners = (3 * alive[:, None] + flat)[touched]
        star = star[touched]
        faces.ravel()[corners] = ids[target][star]
        rounds.append(
            Round(ids[vertex], ids[target], np.where(before < 0, -1, ids[before]), corners, star)
        )
        alive = alive[_has_area(faces[alive])]
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
    return faces[_has_area(faces)]


def _has_area(faces: np.ndarray) -> np.ndarray:
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


class Rings:
    """The neighbours of each of n vertices, all in faces: indices[start[v] : start[v + 1]].

    Attributes:
        row: the vertex whose neighbours indices are.
        on_boundary: mask of the edges to them that have one face.
    """

    def __init__(self, faces: np.ndarray, n: int) -> None:
        tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
        forth, back = np.sort(n * tail + head), np.sort(n * head + tail)
        if np.array_equal(forth, back):  # closed
            keys, self.on_boundary = forth, np.zeros(len(forth), dtype=bool)
        else:
            keys, count = np.unique(np.concatenate([forth, back]), return_counts=True)
            self.on_boundary = count == 1
        self.row = keys // n
        self.indices = keys - n * self.row
        self.degree = np.bincount(self.row, minlength=n)
        self.start = np.cumsum(self.degree) - self.degree

    def common(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """How many neighbours vertices (N,) have in common with others (N,)."""
        indptr = np.append(self.start, len(self.row))
        shape = (len(self.start), len(self.start))
        ones = csr_matrix((np.ones(len(self.row), dtype=np.int16), self.indices, indptr), shape)
        return np.asarray(ones[one].multiply(ones[other]).sum(axis=1)).ravel()

    def least(self, value: np.ndarray) -> np.ndarray:
        """The least value (N,) over each vertex and its neighbours."""
        return np.minimum(value, np.minimum.reduceat(value.take(self.indices), self.start))

    def apart(self, priority: np.ndarray, distance: int) -> np.ndarray:
        """Mask (N,) of vertices more than ``distance`` (1 or 2) edges apart.

        Those with the lowest finite priority come first. The set need not be maximal.
        """
        priority, chosen = priority.copy(), np.zeros(len(priority), dtype=bool)
        for _ in range(3):
            lowest = priority
            for _ in range(distance):
                lowest = self.least(lowest)
            chosen |= np.isfinite(priority) & (priority == lowest)
            near = chosen.copy()
            for _ in range(distance):
                near[self.indices[near[self.row]]] = True
            priority[near] = np.inf
        return chosen


def _collapses(
    points: np.ndarray, faces: np.ndarray, held: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (N,) of those at points (3, V) to collapse, their targets, and their other boundary
    neighbours or -1."""
    n = points.shape[1]
    rings = Rings(faces, n)
    row, column, on_boundary = rings.row, rings.indices, rings.on_boundary
    boundary = np.bincount(row[on_boundary], minlength=n) > 0
    boundary_neighbours = np.bincount(row, weights=boundary[column], minlength=n)
    # inner vertices move onto the boundary only if that makes no chord; boundary ones stay on it
    allowed = np.where(boundary[row], on_boundary & (boundary_neighbours[row] == 2), True)
    allowed &= boundary[row] | ~boundary[column] | (boundary_neighbours[row] == 1)
    allowed &= ~held[row]
    if boundary.sum() <= _FEWEST_ON_BOUNDARY:
        allowed &= ~boundary[row]
    side = points.take(row, axis=1) - points.take(column, axis=1)
    length = np.sqrt(_dot(side, side))
    # random costs: a collapse that fails in one round is tried differently in the next
    cost = np.where(allowed, length * rng.uniform(1.0, 1.7, len(row)), np.inf)
    least = np.minimum.reduceat(cost, rings.start)
    place = np.flatnonzero(np.isfinite(cost) & (cost == least[row]))
    place = place[np.diff(row[place], prepend=-1) > 0]  # one for each vertex
    vertex, target = row[place], column[place]

    good = rings.common(vertex, target) == np.where(boundary[vertex], 1, 2)
    good &= rings.degree[vertex] + rings.degree[target] - 4 <= _MOST_NEIGHBOURS
    vertex, target = vertex[good], target[good]
    into = np.full(n, -1)
    into[vertex] = target
    bad = _leaves_bad_triangles(points, faces, into)
    priority = np.where((into >= 0) & ~bad, least, np.inf)
    vertex = np.flatnonzero(rings.apart(priority, 2))
    before = np.full(n, -1)
    other = on_boundary & (column != into[row])
    before[row[other]] = column[other]
    return vertex, into[vertex], np.where(boundary[vertex], before[vertex], -1)


def _leaves_bad_triangles(points: np.ndarray, faces: np.ndarray, into: np.ndarray) -> np.ndarray:
    """Mask (V,) of vertices at points (3, V) that leave bad triangles if collapsed onto others,
    ``into``."""
    result = np.zeros(len(into), dtype=bool)
    corner = [points.take(faces[:, k], axis=1) for k in range(3)]
    sides = np.stack([corner[k - 1] - corner[k - 2] for k in range(3)], axis=1)  # opposite each
    normal = topology.cross_product(sides[:, 1], sides[:, 2])
    double = np.sqrt(_dot(normal, normal))
    squares = _dot(sides, sides)
    shape = double / squares.sum(axis=0)
    for k in range(3):
        v, b, c = faces[:, k], faces[:, k - 2], faces[:, k - 1]
        w = into.take(v)
        kept = np.flatnonzero((w >= 0) & (w != b) & (w != c))
        to = points.take(w[kept], axis=1)
        to_b, to_c = corner[k - 2].take(kept, axis=1) - to, corner[k - 1].take(kept, axis=1) - to
        new = topology.cross_product(to_b, to_c)
        new_double = np.sqrt(_dot(new, new))
        new_shape = new_double / (squares[k][kept] + _dot(to_b, to_b) + _dot(to_c, to_c))
        bad = _dot(normal.take(kept, axis=1), new) < _TURN * new_double * double[kept]
        bad |= new_shape < np.minimum(_SHAPE, shape[kept])
        result[v[kept[bad]]] = True
    return result


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of vectors (3, ...), by coordinates."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
