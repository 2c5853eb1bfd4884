"""Corresponding seams: closed shapes cut through their landmarks along the same tree.

The nodes of the tree are landmarks, its branches shortest paths on each mesh. Branches meet only at
landmarks and leave each landmark in the same cyclic order on every mesh. The walk around the seam
then passes the landmarks in the same order everywhere, and a map between the discs that keeps this
order is a map of the closed shapes.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut
from nsm.surfaces.geometry import ambient_occlusion

# A sector at a landmark is named by the branch before it, counter-clockwise; -1 without branches.
_WHOLE = -1


@dataclass
class Tracer:
    """Paths on one closed mesh (V, 3), (F, 3) between landmarks (L,), disjoint except for ends."""

    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray
    cost: np.ndarray  # (E,) of each edge
    # per landmark: the number of a branch's end, 2b or 2b + 1, by the first vertex on the way out
    spokes: list[dict[int, int]] = field(init=False)
    laid: list[list[int]] = field(init=False)  # the branches

    def __post_init__(self) -> None:
        self.laid = []
        self.edges = topology.edges_of(self.faces).pairs
        self.taken = np.zeros(len(self.vertices), dtype=bool)
        self.taken[self.landmarks] = True
        self.spokes = [{} for _ in self.landmarks]
        self.rings = [_ring(self.faces, int(v)) for v in self.landmarks]

    @cached_property
    def away(self) -> np.ndarray:
        """(L, V) costs of the cheapest paths from landmarks, ignoring branches."""
        n = len(self.vertices)
        graph = csr_matrix((self.cost, tuple(self.edges.T)), shape=(n, n))
        return np.asarray(dijkstra(graph, directed=False, indices=self.landmarks))

    def distances(self) -> np.ndarray:
        """(L, L) of these, between landmarks."""
        return self.away[:, self.landmarks]

    def sectors(self, landmark: int) -> dict[int, list[int]]:
        """Neighbours of a landmark by sector, along which a further branch may leave."""
        ring, spokes = self.rings[landmark], self.spokes[landmark]
        if not spokes:
            return {_WHOLE: ring}
        start = next(k for k, v in enumerate(ring) if v in spokes)
        result: dict[int, list[int]] = {}
        current = -1
        for vertex in ring[start:] + ring[:start]:
            if vertex in spokes:
                current = spokes[vertex]
                result[current] = []
            else:
                result[current].append(vertex)
        return result

    def path(self, i: int, j: int, leave: list[int], arrive: list[int]) -> tuple[float, list[int]]:
        """The cheapest free path between landmarks i and j, and its cost (inf if there is none).

        Its second vertex is one of ``leave`` (or j itself, where there are further landmarks), its
        last but one of ``arrive``.
        """
        a, b = int(self.landmarks[i]), int(self.landmarks[j])
        x, y = self.edges.T
        keep = ~self.taken[x] & ~self.taken[y]
        for end, gates, other in ((a, leave, b), (b, arrive, a)):
            far = np.where(x == end, y, x)
            touches = (x == end) | (y == end)
            keep |= touches & np.isin(far, gates) & ~self.taken[far]
            # with no further branch, a seam of one edge would leave the mesh closed
            straight = len(self.landmarks) > 2
            if straight and other in gates and end in (arrive if other == b else leave):
                keep |= touches & (far == other)
        n = len(self.vertices)
        graph = csr_matrix((self.cost[keep], (x[keep], y[keep])), shape=(n, n))
        distance, before = dijkstra(graph, directed=False, indices=a, return_predecessors=True)
        if not np.isfinite(distance[b]):
            return float("inf"), []
        path = [b]
        while path[-1] != a:
            path.append(int(before[path[-1]]))
        return float(distance[b]), path[::-1]

    def add(self, i: int, j: int, path: list[int]) -> None:
        """Add a path between landmarks i and j to the seam as its next branch."""
        branch = len(self.laid)
        self.laid.append(path)
        self.taken[path] = True
        self.spokes[i][path[1]] = 2 * branch
        self.spokes[j][path[-2]] = 2 * branch + 1


def with_nodes_between(tracers: Sequence[Tracer], pieces: int) -> list[Tracer]:
    """The same branches with further nodes on them, at the same shares of their lengths.

    Args:
        tracers: of each mesh, with branches; they stay as they are.
        pieces: how many parts each branch is to have; one stays whole that has too few edges on one
            of the meshes.
    """
    parts = []  # of each branch, and on each mesh, places in its path
    for paths in zip(*(t.laid for t in tracers), strict=True):
        places = [_shares(t, path, pieces) for t, path in zip(tracers, paths, strict=True)]
        whole = any(len(set(at)) <= pieces for at in places)
        parts.append(
            [[0, len(p) - 1] if whole else at for p, at in zip(paths, places, strict=True)]
        )
    result = []
    for m, old in enumerate(tracers):
        ways = [(path, at[m]) for path, at in zip(old.laid, parts, strict=True)]
        nodes = [*old.landmarks.tolist(), *(path[k] for path, at in ways for k in at[1:-1])]
        new = Tracer(old.vertices, old.faces, np.array(nodes, dtype=np.int64), old.cost)
        new.taken |= old.taken
        number = {v: k for k, v in enumerate(nodes)}
        for path, at in ways:
            for begin, end in itertools.pairwise(at):
                new.add(number[path[begin]], number[path[end]], path[begin : end + 1])
        result.append(new)
    return result


def _shares(tracer: Tracer, path: list[int], pieces: int) -> list[int]:
    """Places in a path that part its length as evenly as its vertices allow, with both ends."""
    steps = np.linalg.norm(np.diff(tracer.vertices[path], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return [int(np.abs(along - k / pieces).argmin()) for k in range(pieces + 1)]


def _ring(faces: np.ndarray, vertex: int) -> list[int]:
    """The neighbours of an inner vertex, counter-clockwise."""
    following: dict[int, int] = {}
    for face in faces[(faces == vertex).any(axis=1)]:
        k = int(np.flatnonzero(face == vertex)[0])
        following[int(face[(k + 1) % 3])] = int(face[(k + 2) % 3])
    first = next(iter(following))
    ring = [first]
    while following[ring[-1]] != first:
        ring.append(following[ring[-1]])
    return ring


def corresponding_paths(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    landmarks: Sequence[np.ndarray],
    costs: Sequence[np.ndarray] | None = None,
    avoid: Sequence[np.ndarray] | None = None,
    begun: Sequence[tuple[int, int]] = (),
) -> list[list[list[int]]] | None:
    """For each mesh, the L - 1 branches of one tree through all of its landmarks.

    Args:
        meshes: closed genus-0 manifolds, (V, 3) and (F, 3) each.
        landmarks: (L,) different vertices of each mesh, L at least 2, in the same order.
        costs: (E,) of each edge of :func:`topology.edges_of`, per mesh; by default its length.
        avoid: further vertices of each mesh that no branch may touch.
        begun: pairs of landmarks that an edge joins on every mesh, in the same cyclic order around
            each landmark: the first branches.

    Returns:
        Per mesh, the branches as lists of vertices; branch b joins the same landmarks everywhere.
        None if no tree was found (landmarks too close together for the mesh's edges).
    """
    tracers = tracers_of(meshes, landmarks, costs, avoid)
    return [t.laid for t in tracers] if lead_tree(tracers, begun) else None


def tracers_of(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    landmarks: Sequence[np.ndarray],
    costs: Sequence[np.ndarray] | None = None,
    avoid: Sequence[np.ndarray] | None = None,
) -> list[Tracer]:
    """What leads branches on each mesh; arguments as of :func:`corresponding_paths`, any genus."""
    tracers = []
    for m, (vertices, faces) in enumerate(meshes):
        unit = np.sqrt(topology.face_areas(vertices, faces).sum())
        cost = edge_lengths(vertices, faces) if costs is None else costs[m]
        tracers.append(Tracer(vertices, faces, np.asarray(landmarks[m]), cost / unit))
        if avoid is not None:
            tracers[-1].taken[avoid[m]] = True
    return tracers


def lead_tree(tracers: Sequence[Tracer], begun: Sequence[tuple[int, int]] = ()) -> bool:
    """Lay the branches of a tree through all landmarks; whether there is one.

    Args:
        tracers: of each mesh, without branches.
        begun: as for :func:`corresponding_paths`.
    """
    mean = np.sum([t.distances() for t in tracers], axis=0)
    count = len(tracers[0].landmarks)
    queue = [(float(mean[i, j]), i, j) for i, j in itertools.combinations(range(count), 2)]
    heapq.heapify(queue)
    component = list(range(count))
    for i, j in begun:
        for tracer in tracers:
            tracer.add(i, j, [int(tracer.landmarks[i]), int(tracer.landmarks[j])])
        component = [component[i] if c == component[j] else c for c in component]
    while len(tracers[0].laid) < count - 1:
        if not queue:
            return False
        _, i, j = heapq.heappop(queue)
        if component[i] == component[j]:
            continue
        total, paths = _cheapest(tracers, i, j)
        if not np.isfinite(total):
            continue
        if queue and total > queue[0][0] + 1e-12:
            heapq.heappush(queue, (total, i, j))  # others may be shorter now
            continue
        for tracer, path in zip(tracers, paths, strict=True):
            tracer.add(i, j, path)
        old, new = component[j], component[i]
        component = [new if c == old else c for c in component]
    return True


def _cheapest(tracers: Sequence[Tracer], i: int, j: int) -> tuple[float, list[list[int]]]:
    """The paths from i to j, one per mesh, in the same sectors, that are cheapest in sum."""
    best: tuple[float, list[list[int]]] = (float("inf"), [])
    for s, t in itertools.product(tracers[0].sectors(i), tracers[0].sectors(j)):
        total, paths = 0.0, []
        for tracer in tracers:
            cost, path = tracer.path(i, j, tracer.sectors(i)[s], tracer.sectors(j)[t])
            total += cost
            paths.append(path)
            if total >= best[0]:
                break
        else:
            best = (total, paths)
    return best


SEAMS = ("shortest", "hidden")
_VISIBLE_COST = 3.0  # extra cost of an edge that is visible from all sides, times its length


def seam_costs(vertices: np.ndarray, faces: np.ndarray, seam: str) -> np.ndarray:
    """Costs (E,) of a seam along each edge.

    Args:
        vertices, faces: the mesh (V, 3), (F, 3).
        seam: ``shortest``, the edge's length; or ``hidden``, more for visible edges (after Sheffer
            and Hart 2002, "Seamster").

    Raises:
        NsmError: ``unknown_option``.
    """
    length = edge_lengths(vertices, faces)
    if seam == "shortest":
        return length
    if seam != "hidden":
        raise NsmError(
            f"seam.path={seam} is not one of {', '.join(SEAMS)}",
            kind="unknown_option",
            key="seam.path",
        )
    visible = 1 - ambient_occlusion(vertices, faces)[topology.edges_of(faces).pairs].mean(axis=1)
    return length * (1 + _VISIBLE_COST * visible)


def mutually_far(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    landmarks: Sequence[np.ndarray],
    count: int | None,
) -> np.ndarray:
    """Numbers of ``count`` landmarks that are far from each other on all meshes, ascending."""
    total = len(landmarks[0])
    if count is None or count >= total:
        return np.arange(total)
    distance = np.zeros((total, total))
    for (vertices, faces), ids in zip(meshes, landmarks, strict=True):
        unit = np.sqrt(topology.face_areas(vertices, faces).sum())
        cost = edge_lengths(vertices, faces) / unit
        distance += Tracer(vertices, faces, np.asarray(ids), cost).distances()
    chosen = [int(k) for k in np.unravel_index(distance.argmax(), distance.shape)]
    while len(chosen) < count:
        chosen.append(int(distance[chosen].min(axis=0).argmax()))
    return np.sort(np.array(chosen, dtype=np.int64))


def edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Lengths (E,) of the edges of :func:`topology.edges_of`."""
    pairs = topology.edges_of(faces).pairs
    return np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)


def boundary_keys(origin: np.ndarray, loop: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """(K, 2) int64: the landmark's number, and the cut vertex, of each copy of a landmark on the
    boundary loop (B,), in the loop's order."""
    number = {int(v): k for k, v in enumerate(landmarks) if v >= 0}
    rows = [(number[o], int(v)) for v in loop if (o := int(origin[v])) in number]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def branch_keys(cut: Cut, paths: Sequence[list[int]]) -> np.ndarray:
    """(K, 2) int64: as :func:`boundary_keys`, of the ends of a seam's branches, with the number of
    the end, 2b or 2b + 1, in place of the landmark's: the one along which the walk goes on."""
    number = {}
    for b, path in enumerate(paths):
        number[path[0], path[1]] = 2 * b
        number[path[-1], path[-2]] = 2 * b + 1
    own = cut.origin[cut.loop]
    steps = zip(own.tolist(), np.roll(own, -1).tolist(), strict=True)
    rows = [(number[s], int(v)) for s, v in zip(steps, cut.loop, strict=True) if s in number]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def aligned_keys(
    keys: Sequence[np.ndarray], places: Sequence[np.ndarray] | None = None
) -> list[np.ndarray] | None:
    """The keys (K, 2) of several loops, rotated so that their landmarks come in the same order;
    None if no rotation does that.

    Args:
        keys: of each loop.
        places: points (K, 2) of each loop's keys. Where several rotations serve, as of a seam with
            several branches between two landmarks, these are nearest by the one that is taken.
    """
    first = keys[0][:, 0].tolist()
    result = [keys[0]]
    for m, other in enumerate(keys[1:], 1):
        order = other[:, 0].tolist()
        turns = [k for k in range(len(order)) if order[k:] + order[:k] == first]
        if len(order) != len(first) or (not turns and first):
            return None
        if places is not None and len(turns) > 1:
            turns.sort(key=partial(_turned_apart, places[0], places[m]))
        result.append(np.roll(other, -turns[0] if turns else 0, axis=0))
    return result


def _turned_apart(here: np.ndarray, there: np.ndarray, turn: int) -> float:
    """How far points (K, 2) are from others, rotated in their order."""
    return float(np.abs(np.roll(there, -turn, axis=0) - here).sum())
