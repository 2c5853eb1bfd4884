"""Cut a connected oriented manifold mesh of any topology open to a disc.

The seam is a tree of shortest paths that joins the boundary loops and the seam vertices, and, for
handles, the shortest loops of a tree-cotree decomposition (Erickson and Whittlesey 2005, "Greedy
optimal homotopy and homology generators"): what is left of the surface is a disc by construction,
and is checked all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree

from nsm.errors import NsmError
from nsm.surfaces import topology

EXTREMAL_POINTS = 5
# A boundary shorter than this times the square root of the area (a disc: 3.5, a hemisphere: 2.5)
# is a small hole in an almost closed shape: stretching it over the whole circle would be worse
# than a longer seam.
SMALL_BOUNDARY = 1.2


@dataclass(frozen=True)
class Cut:
    """A disc: vertices (V,3), faces (F,3), origin (V,) index before the cut or -1 for inserted
    points, seam_pairs (T,2) pairs of cut vertices that were one, loop (B,) the boundary, log."""

    vertices: np.ndarray
    faces: np.ndarray
    origin: np.ndarray
    seam_pairs: np.ndarray
    loop: np.ndarray
    log: tuple[str, ...]


def first_copies(origin: np.ndarray, count: int) -> np.ndarray:
    """Of each of ``count`` vertices the first (count,) that came from it, or -1, by the origin (V,)
    of these, which is -1 for inserted ones."""
    known = np.flatnonzero(origin >= 0)[::-1]
    first = np.full(count, -1, dtype=np.int64)
    first[origin[known]] = known  # the first copy wins
    return first


class _Graph:
    """The edge graph of a mesh with each boundary loop drawn together to one node."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, edges: topology.Edges) -> None:
        self.loops = topology.boundary_loops(faces)
        self.node = np.arange(len(vertices))
        for loop in self.loops:
            self.node[loop] = loop.min()
        self.ends = self.node[edges.pairs]
        pairs = edges.pairs
        self.length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        # between two nodes keep the shortest of parallel edges: a csr matrix would add them up
        low, high = self.ends.min(axis=1), self.ends.max(axis=1)
        order = np.lexsort((self.length, high, low))
        order = order[low[order] != high[order]]
        key = low[order] * len(vertices) + high[order]
        self.keys, first = np.unique(key, return_index=True)
        self.kept = keep = order[first]
        n = self.n = len(vertices)
        self.matrix = csr_matrix((self.length[keep], (low[keep], high[keep])), shape=(n, n))

    def edge(self, a: int | np.ndarray, b: int | np.ndarray) -> np.ndarray:
        """The edges, as numbered in the mesh, between neighbouring nodes."""
        key = np.minimum(a, b) * self.n + np.maximum(a, b)
        return self.kept[np.searchsorted(self.keys, key)]

    def distances(self, sources: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the nearest source and the predecessor on the way there, per node."""
        distance, predecessor, _ = dijkstra(
            self.matrix,
            directed=False,
            indices=np.asarray(sources),
            min_only=True,
            return_predecessors=True,
        )
        return distance, predecessor

    def path(self, predecessor: np.ndarray, node: int) -> tuple[list[int], list[int]]:
        """Nodes and edges from a node back to its source."""
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
    name: str = "mesh",
) -> Cut:
    """Cut (V,3), (F,3) to a disc through seam_vertices, or through chosen extremal points.

    A disc is left whole unless seam_vertices are given. NsmError if a seam vertex does not exist
    or the seam would not leave a disc.
    """
    edges = topology.edges_of(faces)
    graph = _Graph(vertices, faces, edges)
    log: list[str] = []
    euler = topology.euler_characteristic(faces)
    genus = (2 - euler - len(graph.loops)) // 2
    terminals = [int(loop.min()) for loop in graph.loops]
    if seam_vertices is not None:
        for v in seam_vertices:
            if not 0 <= int(v) < len(vertices):
                raise NsmError(f"{name}: seam vertex {v} does not exist (0 to {len(vertices) - 1})")
        given = [int(graph.node[int(v)]) for v in seam_vertices]
        terminals += [v for v in dict.fromkeys(given) if v not in terminals]
        log.append(f"seam led through {len(given)} given vertices")
        if not graph.loops and genus == 0 and len(terminals) < 2:
            raise NsmError(f"{name}: a closed shape needs at least two different seam vertices")
    elif genus == 0 and _almost_closed(vertices, faces, graph.loops):
        extremal = extremal_points(graph, terminals, EXTREMAL_POINTS)
        terminals += [v for v in extremal if v not in terminals]
        log.append(f"seam led through {len(extremal)} mutually far vertices")

    seam = _shortest_seam(graph, edges, terminals, genus)
    if seam:
        log.append(
            f"cut along {len(seam)} edges (genus {genus}, {len(graph.loops)} boundary loops)"
        )
    return _opened(vertices, faces, seam, log, name)


def cut_along_paths(
    vertices: np.ndarray, faces: np.ndarray, paths: Sequence[Sequence[int]], *, name: str = "mesh"
) -> Cut:
    """Cut (V,3), (F,3) open along paths of neighbouring vertices.

    NsmError if that does not leave a disc.
    """
    edges = topology.edges_of(faces)
    keys = edges.pairs[:, 0] * len(vertices) + edges.pairs[:, 1]  # in rising order
    steps = [np.sort(np.stack([path[:-1], path[1:]], axis=1), axis=1) for path in paths]
    low, high = np.concatenate(steps).astype(np.int64).T
    seam = np.searchsorted(keys, low * len(vertices) + high).tolist()
    log = [f"cut along {len(seam)} edges between {len(paths) + 1} landmarks"]
    return _opened(vertices, faces, seam, log, name)


def _opened(
    vertices: np.ndarray, faces: np.ndarray, seam: list[int], log: list[str], name: str
) -> Cut:
    is_cut = np.zeros(len(topology.edges_of(faces).pairs), dtype=bool)
    is_cut[seam] = True
    cut_faces, origin = topology.cut_along(faces, is_cut)
    if not topology.is_disc(cut_faces):
        raise NsmError(
            f"{name}: the seam does not leave a disc (Euler characteristic "
            f"{topology.euler_characteristic(cut_faces)}, "
            f"{len(topology.boundary_loops(cut_faces))} boundary loops); give other seam_vertices"
        )
    points, cut_faces, inserted = split_chords(vertices[origin], cut_faces)
    if inserted:
        log = [*log, f"{inserted} inner edges between boundary vertices split in the middle"]
    origin = np.concatenate([origin, np.full(inserted, -1)])
    loop = topology.boundary_loops(cut_faces)[0]
    return Cut(points, cut_faces, origin, _twins(origin), loop, tuple(log))


def _almost_closed(vertices: np.ndarray, faces: np.ndarray, loops: list[np.ndarray]) -> bool:
    longest = max(
        (
            float(np.linalg.norm(vertices[loop] - vertices[np.roll(loop, -1)], axis=1).sum())
            for loop in loops
        ),
        default=0.0,
    )
    return longest < SMALL_BOUNDARY * float(np.sqrt(topology.face_areas(vertices, faces).sum()))


def extremal_points(graph: _Graph, start: Sequence[int], count: int) -> list[int]:
    """Nodes chosen one after the other, each the farthest from those before it."""
    if start:
        chosen: list[int] = []
        distance, _ = graph.distances(start)
    else:
        # the far end from anywhere is a tip of the shape
        anywhere = int(graph.ends[0, 0])
        distance, _ = graph.distances([anywhere])
        chosen = [int(_finite(distance).argmax())]
        distance, _ = graph.distances(chosen)
    while len(chosen) < count and _finite(distance).max() > 0:
        chosen.append(int(_finite(distance).argmax()))
        distance = np.minimum(distance, graph.distances(chosen[-1:])[0])
    return chosen


def _finite(distance: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(distance), distance, -1.0)


def _shortest_seam(
    graph: _Graph, edges: topology.Edges, terminals: list[int], genus: int
) -> list[int]:
    """Edge numbers of a short seam through all terminals that opens every handle."""
    if terminals:
        seam, nodes = _join(graph, terminals)
        return sorted(set(seam) | set(_open_handles(graph, edges, seam, nodes, genus)))
    # a closed shape with handles: the loops meet in a vertex of our choice
    roots = extremal_points(graph, [], 4) + [int(graph.ends[len(graph.ends) // 2, 0])]
    seams = [sorted(set(_open_handles(graph, edges, [], [root], genus))) for root in roots]
    return min(seams, key=lambda seam: float(graph.length[seam].sum()))


def _join(graph: _Graph, terminals: list[int]) -> tuple[list[int], list[int]]:
    """A tree of shortest paths through the terminals, grown by the nearest terminal each time."""
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


def _open_handles(
    graph: _Graph, edges: topology.Edges, seam: list[int], nodes: list[int], genus: int
) -> list[int]:
    """Edges of 2*genus short loops that hang on the given tree of nodes."""
    if genus == 0:
        return []
    distance, predecessor = graph.distances(nodes)
    blocked = edges.count == 1
    blocked[seam] = True
    reached = np.flatnonzero(predecessor >= 0)
    blocked[graph.edge(reached, predecessor[reached].astype(np.int64))] = True
    # longest loops go into the dual spanning tree, so that the shortest ones are left over
    loop_length = distance[graph.ends].sum(axis=1) + graph.length
    free = np.flatnonzero(~blocked)
    mask = ~blocked
    corners = topology.adjacent_faces(edges, mask)
    crossing = edges.of_corner.ravel()[corners[:, 0]]
    n_faces = len(edges.of_corner)
    face_pairs = corners // 3
    low, high = face_pairs.min(axis=1), face_pairs.max(axis=1)
    # two faces that share two edges: the dual tree may cross only one of them, the longer
    order = np.lexsort((-loop_length[crossing], high, low))
    keep = order[np.unique(low[order] * n_faces + high[order], return_index=True)[1]]
    longest = loop_length.max()  # relative to it, so that the unit of length is all the same
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
    """Put a vertex in the middle of each inner edge that joins two boundary vertices.

    Flattened onto a side of the square such an edge would fold its triangles to nothing, and
    near a circle it leaves slivers. New vertices come after the old ones.
    """
    edges = topology.edges_of(faces)
    on_boundary = np.zeros(len(vertices), dtype=bool)
    on_boundary[edges.pairs[edges.count == 1]] = True
    chord = (edges.count == 2) & on_boundary[edges.pairs].all(axis=1)
    inserted = int(chord.sum())
    if inserted == 0:
        return vertices, faces, 0
    middle = np.full(len(edges.pairs), -1, dtype=np.int64)
    middle[chord] = len(vertices) + np.arange(inserted)
    points = np.concatenate([vertices, vertices[edges.pairs[chord]].mean(axis=1)])
    touched = chord[edges.of_corner].any(axis=1)
    new: list[tuple[int, int, int]] = []
    for f in np.flatnonzero(touched).tolist():
        corner, mid = faces[f].tolist(), middle[edges.of_corner[f]].tolist()
        number = sum(m >= 0 for m in mid)
        if number == 3:
            (a, b, c), (ab, bc, ca) = corner, mid
            new += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            continue
        # turn the face so that the split edge comes first, and the whole edge last if two split
        turn = next(k for k in range(3) if mid[k] >= 0 and (number == 1 or mid[(k + 1) % 3] >= 0))
        a, b, c = (corner[(turn + k) % 3] for k in range(3))
        ab, bc = mid[turn], mid[(turn + 1) % 3]
        if number == 1:
            new += [(a, ab, c), (ab, b, c)]
        else:
            new += [(ab, b, bc), (a, ab, bc), (a, bc, c)]
    return points, np.concatenate([faces[~touched], np.array(new, dtype=np.int64)]), inserted


def _twins(origin: np.ndarray) -> np.ndarray:
    """Pairs (first copy, further copy) of vertices with the same origin."""
    known = np.flatnonzero(origin >= 0)
    order = known[np.argsort(origin[known], kind="stable")]
    value = origin[order]
    first = np.searchsorted(value, value, side="left")
    further = first != np.arange(len(value))
    return np.stack([order[first[further]], order[further]], axis=1).astype(np.int64)
