"""Corresponding seams of closed shapes with handles: further branches between the landmarks.

A tree through landmarks leaves a surface of genus g with g handles. Each of 2g further branches
runs through a handle, so that what is left stays connected; in the end it is a disc. As in the
tree, a branch leaves each landmark between the same others on every mesh. So the walk around the
cut passes the landmarks in the same order everywhere, and a map between the discs that keeps this
order is a map of the closed shapes (after Kraevoy and Sheffer 2004, "Cross-parameterization and
compatible remeshing of 3D models").

Whether a branch separates what is left is told by homology modulo 2
(:mod:`nsm.surfaces.homology`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from nsm.domains.common_seams import Tracer, with_nodes_between
from nsm.surfaces import topology
from nsm.surfaces.homology import crossings

# parts of a branch between landmarks, one after the other until there is room: where few edges meet
# at few landmarks, the branches that open handles leave from between these too
_PIECES = (1, 2, 4, 8)
_CLASSES = 6  # of a pair of sectors, the cheapest ones, are compared between meshes
# cost of a difference of distances to the landmarks, at the middles of corresponding branches, in
# units of their lengths: without it, a branch may run through another handle on another mesh
_UNLIKE = 2.0

Sector = tuple[int, int]  # landmark, and the name of the sector there


class _Way(NamedTuple):
    """A path on one mesh, its cost, and the distances (L,) of its middle from the landmarks."""

    cost: float
    path: list[int]
    middle: np.ndarray


def with_handles_opened(tree: Sequence[Tracer]) -> Sequence[Tracer] | None:
    """The branches of a tree on closed meshes of one genus, and further ones that leave a disc; or
    None: there are no such.

    Args:
        tree: of each mesh; it stays as it is.
    """
    if topology.genus_and_boundary(tree[0].faces)[0] == 0:
        return tree
    for pieces in _PIECES:
        tracers = with_nodes_between(tree, pieces)
        if open_handles(tracers):
            return tracers
    return None


def open_handles(tracers: Sequence[Tracer]) -> bool:
    """Lay further branches that leave a disc of closed meshes of one genus; whether there are such.

    Args:
        tracers: of each mesh, with the branches of a tree.
    """
    genus = topology.genus_and_boundary(tracers[0].faces)[0]
    for _ in range(2 * genus):
        found = _cheapest([_Rest(tracer) for tracer in tracers])
        if found is None:
            return False
        i, j, paths = found
        for tracer, path in zip(tracers, paths, strict=True):
            tracer.add(i, j, path)
    return True


class _Rest:
    """What the branches leave of one mesh: the free paths between sectors at the landmarks."""

    def __init__(self, tracer: Tracer) -> None:
        self.tracer, n = tracer, len(tracer.vertices)
        low, high = tracer.edges.T
        self.keys = low * n + high  # sorted
        self.bits = _crossings(tracer)
        inner = ~tracer.taken[low] & ~tracer.taken[high]
        # both ways along each edge
        self.ends = np.concatenate([tracer.edges[inner], tracer.edges[inner][:, ::-1]])
        self.length, self.passed = np.tile(tracer.cost[inner], 2), np.tile(self.bits[inner], 2)
        self.gates: dict[Sector, list[int]] = {}
        for i in range(len(tracer.landmarks)):
            for name, ring in tracer.sectors(i).items():
                gates = [v for v in ring if not tracer.taken[v]]
                if gates:
                    self.gates[i, name] = gates
        self.reach = {sector: self._reached(sector) for sector in self.gates}

    def _edge(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Numbers of the edges between vertices."""
        wanted = np.minimum(a, b) * len(self.tracer.vertices) + np.maximum(a, b)
        return np.searchsorted(self.keys, wanted)

    def _reached(self, sector: Sector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Costs (V,) from a landmark through a sector, what is before each vertex on the way, and
        the curves that the way crosses; vertex V is the landmark."""
        n, landmark = len(self.tracer.vertices), int(self.tracer.landmarks[sector[0]])
        gates = np.array(self.gates[sector])
        of_gate = self._edge(np.full(len(gates), landmark), gates)
        rows = np.concatenate([self.ends[:, 0], np.full(len(gates), n)])
        columns = np.concatenate([self.ends[:, 1], gates])
        costs = np.concatenate([self.length, self.tracer.cost[of_gate]])
        graph = csr_matrix((costs, (rows, columns)), shape=(n + 1, n + 1))
        distance, before = dijkstra(graph, indices=n, return_predecessors=True)
        before = before.astype(np.int64)
        before[before < 0] = n
        crossed = np.zeros(n + 1, dtype=np.int64)
        known = np.flatnonzero(np.isfinite(distance[:n]))
        came = np.where(before[known] == n, landmark, before[known])
        crossed[known] = self.bits[self._edge(known, came)]
        jump = before.copy()
        while (jump != n).any():  # along the way, twice as far each time
            crossed ^= crossed[jump]
            jump = jump[jump]
        return distance, before, crossed

    def least(self, a: Sector, b: Sector) -> list[tuple[float, int]]:
        """Cost of the cheapest path between two sectors of each class that does not separate what
        is left, and the edge where it meets; cheapest first."""
        first, second = self.reach[a], self.reach[b]
        x, y = self.ends.T
        cost = first[0][x] + self.length + second[0][y]
        crossed = first[2][x] ^ self.passed ^ second[2][y]
        some = np.flatnonzero((crossed != 0) & np.isfinite(cost))
        order = some[np.lexsort((cost[some], crossed[some]))]
        order = order[np.unique(crossed[order], return_index=True)[1]]
        order = order[np.argsort(cost[order], kind="stable")][:_CLASSES]
        return [(float(cost[e]), int(e)) for e in order]

    def way(self, a: Sector, b: Sector, cost: float, edge: int) -> _Way | None:
        """The path through an edge; None if it meets itself."""
        n, (x, y) = len(self.tracer.vertices), self.ends[edge].tolist()
        there, back = [x], [y]
        for path, sector in ((there, a), (back, b)):
            before = self.reach[sector][1]
            while int(before[path[-1]]) != n:
                path.append(int(before[path[-1]]))
        inner = there[::-1] + back
        if len(set(inner)) < len(inner):
            return None
        if a == b:  # out and back in the order of the ring, on all meshes alike
            ring = self.gates[a]
            if ring.index(inner[0]) > ring.index(inner[-1]):
                inner.reverse()
        ends = (int(self.tracer.landmarks[s[0]]) for s in (a, b))
        steps = np.linalg.norm(np.diff(self.tracer.vertices[inner], axis=0), axis=1).cumsum()
        half = int(np.searchsorted(steps, 0.5 * steps[-1]))
        return _Way(cost, [next(ends), *inner, next(ends)], self.tracer.away[:, inner[half]])


def _crossings(tracer: Tracer) -> np.ndarray:
    """(E,) of each edge, as bits, which closed curves of a basis cross it: curves on the faces
    that no branch cuts."""
    edges = topology.edges_of(tracer.faces).pairs
    on_seam = np.zeros(len(tracer.vertices), dtype=bool)
    on_seam[tracer.landmarks] = True
    cut = np.zeros(len(edges), dtype=bool)
    for path in tracer.laid:
        on_seam[path] = True
        cut[topology.edges_between(edges, np.stack([path[:-1], path[1:]], axis=1))] = True
    return crossings(tracer.faces, on_seam, cut)


def _cheapest(rests: Sequence[_Rest]) -> tuple[int, int, list[list[int]]] | None:
    """Landmarks, and a path on each mesh in the same sectors, which separates none of them: those
    that are cheapest in sum, and alike in their distances from the landmarks."""
    common = [s for s in rests[0].gates if all(s in rest.gates for rest in rests)]
    queue = []
    for k, a in enumerate(common):
        for b in common[k:]:
            found = [rest.least(a, b) for rest in rests]
            if all(found):
                queue.append((sum(each[0][0] for each in found), a, b, found))
    best, chosen = np.inf, None
    for bound, a, b, found in sorted(queue, key=lambda entry: entry[0]):
        if bound >= best:
            break
        ways = [
            [w for e in each if (w := rest.way(a, b, *e)) is not None]
            for rest, each in zip(rests, found, strict=True)
        ]
        for first in ways[0]:
            total, paths = first.cost, [first.path]
            for others in ways[1:]:
                costs = [_priced(first, other) for other in others]
                least = min(costs, default=np.inf)
                total += least
                if not np.isfinite(total):
                    break
                paths.append(others[costs.index(least)].path)
            if total < best:
                best, chosen = total, (a[0], b[0], paths)
    return chosen


def _priced(first: _Way, other: _Way) -> float:
    return other.cost + _UNLIKE * float(np.abs(first.middle - other.middle).mean())
