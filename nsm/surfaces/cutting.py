"""Cut a connected oriented manifold mesh of any topology open to a disc.

The seam is a tree of shortest paths through the boundary loops, the seam vertices and the tips of
limbs and, for handles, the shortest loops of a tree-cotree decomposition (Erickson and Whittlesey
2005, "Greedy optimal homotopy and homology generators"). The result is a disc by construction; this
is checked nevertheless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.limbs import limb_tips
from nsm.wording import number_of

FARTHEST_POINTS = 5
_ROUNDS = 4  # of limbs that branch off other limbs
_SEAM_KEY = "surface.seam_vertices"
_DETOUR = 1000.0  # how many times its length an edge may cost to keep the seam off its ends
# A boundary loop shorter than this times the square root of the area (a disc: 3.5, a hemisphere:
# 2.5) is a small hole in an almost closed surface: stretching it over the whole boundary of the
# domain would distort more than a longer seam.
SMALL_BOUNDARY = 1.2


@dataclass(frozen=True)
class Cut:
    """A mesh cut to a disc.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        origin: (V,) the index of each vertex before the cut, or -1 for inserted vertices.
        seam_pairs: (T, 2) copies of the same vertex.
        loop: (B,) the boundary loop.
        log: one line per change.
    """

    vertices: np.ndarray
    faces: np.ndarray
    origin: np.ndarray
    seam_pairs: np.ndarray
    loop: np.ndarray
    log: tuple[str, ...]


def first_copies(origin: np.ndarray, count: int) -> np.ndarray:
    """For each of ``count`` vertices its first copy (count,), or -1.

    Args:
        origin: (V,) the vertex that each vertex is a copy of, or -1 for inserted ones.
        count: number of vertices before the cut.
    """
    known = np.flatnonzero(origin >= 0)[::-1]
    first = np.full(count, -1, dtype=np.int64)
    first[origin[known]] = known  # in reverse: of several copies the first
    return first


def _seam_error(name: str, kind: str, reason: str) -> NsmError:
    return NsmError(f"{name}: {reason}", kind=kind, key=_SEAM_KEY)


class _Graph:
    """The edge graph of a mesh, with each boundary loop contracted to one node.

    Edges at ``avoided`` vertices count as longer than they are.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        edges: topology.Edges,
        avoided: Sequence[int] = (),
    ) -> None:
        self.loops = topology.boundary_loops(faces)
        self.node = np.arange(len(vertices))
        for loop in self.loops:
            self.node[loop] = loop.min()
        self.ends = self.node[edges.pairs]
        pairs = edges.pairs
        self.length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        on_loops = np.concatenate([*self.loops, np.zeros(0, dtype=np.int64)])
        self.avoided = np.setdiff1d(np.asarray(avoided, dtype=np.int64), on_loops)
        self.length[np.isin(pairs, self.avoided).any(axis=1)] *= _DETOUR
        # keep the shortest of parallel edges: a csr matrix would add their lengths
        low, high = self.ends.min(axis=1), self.ends.max(axis=1)
        order = np.lexsort((self.length, high, low))
        order = order[low[order] != high[order]]
        key = low[order] * len(vertices) + high[order]
        self.keys, first = np.unique(key, return_index=True)
        self.kept = keep = order[first]
        n = self.n = len(vertices)
        self.matrix = csr_matrix((self.length[keep], (low[keep], high[keep])), shape=(n, n))

    def edge(self, a: int | np.ndarray, b: int | np.ndarray) -> np.ndarray:
        """The indices of the mesh's edges between neighbouring nodes."""
        key = np.minimum(a, b) * self.n + np.maximum(a, b)
        return self.kept[np.searchsorted(self.keys, key)]

    def distances(self, sources: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """For each node the distance to the nearest source, and the predecessor on that path."""
        distance, predecessor, _ = dijkstra(
            self.matrix,
            directed=False,
            indices=np.asarray(sources),
            min_only=True,
            return_predecessors=True,
        )
        return distance, predecessor

    def path(self, predecessor: np.ndarray, node: int) -> tuple[list[int], list[int]]:
        """The nodes and edges of the path from a node back to its source."""
        nodes, edges = [node], []
        while predecessor[node] >= 0:
            previous = int(predecessor[node])
            edges.append(int(self.edge(node, previous)))
            nodes.append(previous)
            node = previous
        return nodes, edges


def cut_to_disc(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    seam_vertices: Sequence[int] | None = None,
    avoided: Sequence[int] = (),
    name: str = "mesh",
) -> Cut:
    """Cut a mesh to a disc; a disc stays uncut unless seam vertices are given.

    Args:
        vertices: (V, 3).
        faces: (F, 3), connected, oriented and manifold.
        seam_vertices: vertices that the seam visits; by default farthest points of a closed
            surface, and of an almost closed one, and tips of their limbs.
        avoided: vertices that the seam goes around where it can; those on boundaries do not count.
        name: of the mesh, for messages.

    Raises:
        NsmError: ``out_of_range`` or ``too_few`` for seam vertices that do not exist or do not
            suffice, ``not_a_disc`` for a seam that leaves no disc; the key is
            ``surface.seam_vertices``.
    """
    seam, log = disc_seam(vertices, faces, seam_vertices=seam_vertices, avoided=avoided, name=name)
    return cut_open(vertices, faces, seam, log, name)


def disc_seam(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    seam_vertices: Sequence[int] | None = None,
    avoided: Sequence[int] = (),
    name: str = "mesh",
) -> tuple[list[int], list[str]]:
    """The numbers of the edges (see :func:`nsm.surfaces.topology.edges_of`) along which
    :func:`cut_to_disc` cuts, and lines that say so; arguments and errors as there."""
    edges = topology.edges_of(faces)
    graph = _Graph(vertices, faces, edges, avoided)
    log: list[str] = []
    euler = topology.euler_characteristic(faces)
    genus = (2 - euler - len(graph.loops)) // 2
    terminals = [int(loop.min()) for loop in graph.loops]
    chosen = seam_vertices is None and almost_closed(vertices, faces, graph.loops)
    if seam_vertices is not None:
        for v in seam_vertices:
            if not 0 <= int(v) < len(vertices):
                reason = f"there is no seam vertex {v}; give vertices 0 to {len(vertices) - 1}"
                raise _seam_error(name, "out_of_range", reason)
        given = [int(graph.node[int(v)]) for v in seam_vertices]
        terminals += [v for v in dict.fromkeys(given) if v not in terminals]
        log.append(f"seam through {number_of(len(given), 'given vertex')}")
        if not graph.loops and genus == 0 and len(terminals) < 2:
            reason = "the surface is closed; give at least two different seam vertices"
            raise _seam_error(name, "too_few", reason)
    elif genus == 0 and chosen:
        farthest = _farthest_points(graph, terminals, FARTHEST_POINTS)
        terminals += [v for v in farthest if v not in terminals]
        log.append(f"seam through {number_of(len(farthest), 'farthest point')}")

    seam = _shortest_seam(graph, edges, terminals, genus)
    if chosen:
        seam, limbs = _led_into_limbs(graph, vertices, faces, seam)
        if limbs:
            log.append(f"seam led on to {number_of(limbs, 'tip')} of limbs")
    if seam:
        log.append(
            f"cut along {number_of(len(seam), 'edge')} (genus {genus}, "
            f"{number_of(len(graph.loops), 'boundary loop')})"
        )
    return seam, log


def cut_along_paths(
    vertices: np.ndarray, faces: np.ndarray, paths: Sequence[Sequence[int]], *, name: str = "mesh"
) -> Cut:
    """Cut a mesh (V, 3), (F, 3) open along paths of neighbouring vertices.

    Raises:
        NsmError: ``not_a_disc``, with the key ``surface.seam_vertices``.
    """
    steps = [np.stack([path[:-1], path[1:]], axis=1) for path in paths]
    ends = np.concatenate(steps).astype(np.int64)
    seam = topology.edges_between(topology.edges_of(faces).pairs, ends).tolist()
    log = [f"cut along {number_of(len(seam), 'edge')} in {number_of(len(paths), 'path')}"]
    return cut_open(vertices, faces, seam, log, name)


def cut_open(
    vertices: np.ndarray, faces: np.ndarray, seam: list[int], log: list[str], name: str
) -> Cut:
    """A mesh cut along the edges of a seam, which leaves a disc, with its chords split.

    Args:
        vertices, faces: the mesh (V, 3), (F, 3).
        seam: numbers of the edges of :func:`nsm.surfaces.topology.edges_of`.
        log: lines that say how it was found.
        name: of the mesh, for messages.

    Raises:
        NsmError: ``not_a_disc``.
    """
    is_cut = np.zeros(len(topology.edges_of(faces).pairs), dtype=bool)
    is_cut[seam] = True
    cut_faces, origin = topology.cut_along(faces, is_cut)
    if not topology.is_disc(cut_faces):
        euler, loops = topology.euler_characteristic(cut_faces), topology.boundary_loops(cut_faces)
        found = f"Euler characteristic {euler}, {number_of(len(loops), 'boundary loop')}"
        reason = f"the seam does not leave a disc ({found}); give other {_SEAM_KEY}"
        raise _seam_error(name, "not_a_disc", reason)
    points, cut_faces, inserted = split_chords(vertices[origin], cut_faces)
    if inserted:
        log = [*log, f"{number_of(inserted, 'interior edge')} between boundary vertices split"]
    origin = np.concatenate([origin, np.full(inserted, -1)])
    loop = topology.boundary_loops(cut_faces)[0]
    return Cut(points, cut_faces, origin, seam_pairs(origin), loop, tuple(log))


def almost_closed(vertices: np.ndarray, faces: np.ndarray, loops: list[np.ndarray]) -> bool:
    """Whether all boundary loops of a mesh (V, 3), (F, 3) are small, or there are none."""
    sides = [vertices[loop] - vertices[np.roll(loop, -1)] for loop in loops]
    longest = max((float(np.linalg.norm(side, axis=1).sum()) for side in sides), default=0.0)
    return longest < SMALL_BOUNDARY * float(np.sqrt(topology.face_areas(vertices, faces).sum()))


def _farthest_points(graph: _Graph, start: Sequence[int], count: int) -> list[int]:
    """Farthest point samples of the nodes: each is farthest from start and from those before it."""
    if start:
        chosen: list[int] = []
        distance, _ = graph.distances(start)
    else:
        # the farthest node from any node is a tip of the shape
        distance, _ = graph.distances([int(graph.ends[0, 0])])
        chosen = [int(_allowed(graph, distance).argmax())]
        distance, _ = graph.distances(chosen)
    while len(chosen) < count and _allowed(graph, distance).max() > 0:
        chosen.append(int(_allowed(graph, distance).argmax()))
        distance = np.minimum(distance, graph.distances(chosen[-1:])[0])
    return chosen


def _allowed(graph: _Graph, distance: np.ndarray) -> np.ndarray:
    """Distances (V,) of nodes that a path reaches and the seam may visit; -1 of others."""
    result = np.where(np.isfinite(distance), distance, -1.0)
    result[graph.avoided] = -1.0
    return result


def _led_into_limbs(
    graph: _Graph, vertices: np.ndarray, faces: np.ndarray, seam: list[int]
) -> tuple[list[int], int]:
    """The seam with branches to the tips of limbs that it does not reach, and their number."""
    edges, count = set(seam), 0
    for _ in range(_ROUNDS):
        nodes = np.unique(graph.ends[sorted(edges)])
        distance, predecessor = graph.distances(nodes.tolist())
        distance[graph.avoided] = np.inf
        tips = limb_tips(vertices, faces, distance[graph.node])
        if not tips:
            break
        for tip in tips:
            edges |= set(graph.path(predecessor, int(graph.node[tip]))[1])
        count += len(tips)
    return sorted(edges), count


def _shortest_seam(
    graph: _Graph, edges: topology.Edges, terminals: list[int], genus: int
) -> list[int]:
    """The edges of a short seam through all terminals that cuts every handle open."""
    if terminals:
        seam, nodes = _steiner_tree(graph, terminals)
        return sorted(set(seam) | set(_handle_loops(graph, edges, seam, nodes, genus)))
    # a closed surface with handles: all loops pass through one vertex, the best of these
    roots = _farthest_points(graph, [], 4) + [int(graph.ends[len(graph.ends) // 2, 0])]
    seams = [sorted(set(_handle_loops(graph, edges, [], [root], genus))) for root in roots]
    return min(seams, key=lambda seam: float(graph.length[seam].sum()))


def _steiner_tree(graph: _Graph, terminals: list[int]) -> tuple[list[int], list[int]]:
    """Edges and nodes of a tree of shortest paths that adds the nearest terminal at each step."""
    nodes, seam = [terminals[0]], []
    missing = set(terminals[1:])
    while missing:
        distance, predecessor = graph.distances(nodes)
        nearest = min(missing, key=lambda v: (float(distance[v]), v))
        path, path_edges = graph.path(predecessor, nearest)
        nodes += [v for v in path if v not in nodes]
        seam += path_edges
        missing -= set(path)
    return seam, nodes


def _handle_loops(
    graph: _Graph, edges: topology.Edges, seam: list[int], nodes: list[int], genus: int
) -> list[int]:
    """Edges of 2 * genus short loops through the nodes, which the edges of seam connect."""
    if genus == 0:
        return []
    distance, predecessor = graph.distances(nodes)
    blocked = edges.count == 1
    blocked[seam] = True
    reached = np.flatnonzero(predecessor >= 0)
    blocked[graph.edge(reached, predecessor[reached].astype(np.int64))] = True
    # the dual spanning tree takes the longest loops and leaves the shortest
    loop_length = distance[graph.ends].sum(axis=1) + graph.length
    free = np.flatnonzero(~blocked)
    corners = topology.adjacent_faces(edges, ~blocked)
    crossing = edges.of_corner.ravel()[corners[:, 0]]
    n_faces = len(edges.of_corner)
    face_pairs = corners // 3
    low, high = face_pairs.min(axis=1), face_pairs.max(axis=1)
    # of two edges between the same faces the dual tree may cross only one, the longer
    order = np.lexsort((-loop_length[crossing], high, low))
    keep = order[np.unique(low[order] * n_faces + high[order], return_index=True)[1]]
    longest = loop_length.max()  # makes the weights independent of the unit
    weight = 1.0 + (longest - loop_length[crossing[keep]]) / longest
    dual = csr_matrix((weight, (low[keep], high[keep])), shape=(n_faces, n_faces))
    tree = minimum_spanning_tree(dual).tocoo()
    row, column = tree.row.astype(np.int64), tree.col.astype(np.int64)
    in_tree = np.minimum(row, column) * n_faces + np.maximum(row, column)
    crossed = crossing[keep[np.isin(low[keep] * n_faces + high[keep], in_tree)]]
    result: list[int] = []
    for edge in np.setdiff1d(free, crossed).tolist():
        result.append(edge)
        for end in graph.ends[edge].tolist():
            result += graph.path(predecessor, end)[1]
    return result


def split_chords(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Split each interior edge between two boundary vertices at its midpoint.

    On a side of the square the triangles at such an edge would be degenerate, and on a circle
    slivers.

    Returns:
        Vertices (W, 3), the new ones last, faces (G, 3), and the number of split edges.
    """
    edges = topology.edges_of(faces)
    on_boundary = np.zeros(len(vertices), dtype=bool)
    on_boundary[edges.pairs[edges.count == 1]] = True
    chord = (edges.count == 2) & on_boundary[edges.pairs].all(axis=1)
    inserted = int(chord.sum())
    if inserted == 0:
        return vertices, faces, 0
    midpoint = np.full(len(edges.pairs), -1, dtype=np.int64)
    midpoint[chord] = len(vertices) + np.arange(inserted)
    points = np.concatenate([vertices, vertices[edges.pairs[chord]].mean(axis=1)])
    touched = chord[edges.of_corner].any(axis=1)
    new: list[tuple[int, int, int]] = []
    for f in np.flatnonzero(touched).tolist():
        corner, mid = faces[f].tolist(), midpoint[edges.of_corner[f]].tolist()
        number = sum(m >= 0 for m in mid)
        if number == 3:
            (a, b, c), (ab, bc, ca) = corner, mid
            new += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            continue
        # rotate the face: the split edge comes first, and if two are split, the whole one last
        turn = next(k for k in range(3) if mid[k] >= 0 and (number == 1 or mid[(k + 1) % 3] >= 0))
        a, b, c = (corner[(turn + k) % 3] for k in range(3))
        ab, bc = mid[turn], mid[(turn + 1) % 3]
        if number == 1:
            new += [(a, ab, c), (ab, b, c)]
        else:
            new += [(ab, b, bc), (a, ab, bc), (a, bc, c)]
    return points, np.concatenate([faces[~touched], np.array(new, dtype=np.int64)]), inserted


# The pieces that split_chords makes of a face, by the inserted ones among the first one's corners,
# and where in the pieces (row, corner) the face's own corners are.
_PIECES = {
    (False, True, False): (2, ((0, 0), (1, 1), (0, 2))),
    (True, False, True): (3, ((1, 0), (0, 1), (2, 2))),
    (False, True, True): (4, ((0, 0), (1, 1), (2, 2))),
}


def chords_joined(
    faces: np.ndarray, inserted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The faces of a disc before its chords were split.

    Args:
        faces: (G, 3) of a :class:`Cut`.
        inserted: (W,) mask of the vertices that it inserted.

    Returns:
        Faces (F, 3), a mask (F,) of those that were in pieces, and for each given face (G,) which
        of these it is, or is a piece of.
    """
    is_piece = inserted[faces].any(axis=1)
    pieces, joined, counts, at = faces[is_piece], [], [], 0
    while at < len(pieces):
        first, second, third = inserted[pieces[at]].tolist()
        count, own = _PIECES[first, second, third]
        joined.append([int(pieces[at + row, corner]) for row, corner in own])
        counts.append(count)
        at += count
    whole = faces[~is_piece]
    in_pieces = np.arange(len(whole) + len(joined)) >= len(whole)
    number = np.empty(len(faces), dtype=np.int64)
    number[~is_piece] = np.arange(len(whole))
    number[is_piece] = len(whole) + np.repeat(np.arange(len(joined)), counts)
    every = np.concatenate([whole, np.array(joined, dtype=np.int64).reshape(-1, 3)])
    return every, in_pieces, number


def seam_pairs(origin: np.ndarray) -> np.ndarray:
    """The first copy and each further copy (T, 2) of vertices with the same origin."""
    known = np.flatnonzero(origin >= 0)
    order = known[np.argsort(origin[known], kind="stable")]
    value = origin[order]
    first = np.searchsorted(value, value, side="left")
    further = first != np.arange(len(value))
    return np.stack([order[first[further]], order[further]], axis=1).astype(np.int64)
